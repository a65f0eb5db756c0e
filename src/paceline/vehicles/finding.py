"""Vehicles found as they drive by: a frame in, the outlines of the vehicles that have gone out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from paceline.cameras import StereoRig
from paceline.documents import VehicleDocument
from paceline.recordings import StereoFrame
from paceline.vehicles.plane import Aligned, Face, face_of
from paceline.vehicles.scene import EmptyScene
from paceline.vehicles.sightings import Lookout
from paceline.vehicles.tracks import Linker, Track
from paceline.vehicles.ways import Way

Array = NDArray[np.float64]
Image = NDArray[np.float32]

LEAST_SIGHTINGS = 4
LEAST_TRAVEL = 1.5  # m: what moves less stands
LEAST_AREA = 0.35  # m² of a face that both views agree on, in the median
LEAST_HEIGHT = 0.8  # m above the road that a vehicle reaches: less is a shadow
SMALLEST = 16.0, 6.0  # px, width and height of an outline
BORDER = 4.0  # px between an outline and the edge of the picture


@dataclass(frozen=True, eq=False)
class Found:
    """A vehicle that has driven by: where and when it was seen, and its outline as clip.yaml holds it, or None with a
    ``reason`` where it has no part that could be measured.

    ``path`` is the name of its path, ``times`` (2,) when it was first and last seen, s; ``width`` and ``height`` are
    metres as far as they were seen; ``crops`` of both views show it in the outline's frame from the pixels ``corners``
    (2, 2) on.
    """

    path: str
    times: tuple[float, float]
    width: float
    height: float
    place: Array  # (3,) m, at the road, where it was first seen
    vehicle: VehicleDocument | None
    reason: str
    crops: tuple[Image, Image]
    corners: Array


class Finder:
    """Finds vehicles along the ways of a rig that stands still::

        finder = Finder(ways, scene)
        for frame in recording.frames():
            for found in finder.see(frame):
                ...
        finder.finish()

    Memory does not grow with the recording.
    """

    def __init__(self, ways: list[Way], scene: EmptyScene) -> None:
        self._lookout, self._linker, self._scene = Lookout(ways), Linker(), scene

    def see(self, frame: StereoFrame) -> list[Found]:
        """The vehicles that have gone by the time of ``frame``."""
        if frame.duplicate:
            return []
        sightings = self._lookout.see(frame, self._scene.images)
        self._scene.follow(frame)
        return [found_on(track) for track in self._linker.link(frame.time, sightings) if is_vehicle(track)]

    def finish(self) -> list[Found]:
        """The vehicles that were still there at the last frame."""
        tracks, self._linker = self._linker.tracks, Linker()
        return [found_on(track) for track in tracks if is_vehicle(track)]


def is_vehicle(track: Track) -> bool:
    """Whether what was seen is upright and large enough, and drives along its way."""
    if len(track.times) < LEAST_SIGHTINGS or float(np.median(track.areas)) < LEAST_AREA:
        return False
    return _height(track) >= LEAST_HEIGHT and abs(track.way_s[-1] - track.way_s[0]) >= LEAST_TRAVEL


def found_on(track: Track) -> Found:
    """The vehicle that a track saw, with its outline in the first frame that shows it well."""
    first = track.first
    found = Found(
        path=first.way.name,
        times=(track.times[0], track.times[-1]),
        width=float(np.median([s.x[1] - s.x[0] for s in track.kept])),
        height=_height(track),
        place=first.place,
        vehicle=None,
        reason="",
        crops=first.crops,
        corners=first.corners,
    )
    face = face_of(track)
    if face is None:
        return replace(found, reason="no part of its face keeps its picture in both views and over time")
    at = _first_clear(face, first.way.rig)
    if at is None:
        return replace(found, reason="its face is never large enough and wholly inside both pictures")
    sighting = at.sighting
    left, right = sighting.way.pixels(at.s, face.corners(at))
    document = VehicleDocument("", sighting.way.name, sighting.frame, left, right, "front", None)
    return replace(found, path=sighting.way.name, vehicle=document, crops=sighting.crops, corners=sighting.corners)


def _height(track: Track) -> float:
    return float(np.median([s.y[1] for s in track.kept]))


def _first_clear(face: Face, rig: StereoRig) -> Aligned | None:
    """The first frame in which a face is large enough, and wholly inside both pictures."""
    for at in face.aligned:
        for quad, camera in zip(at.sighting.way.pixels(at.s, face.corners(at)), rig.cameras, strict=True):
            inside = (quad >= BORDER) & (quad <= np.array(camera.image_size) - 1 - BORDER)
            if not inside.all() or (np.ptp(quad, axis=0) < SMALLEST).any():
                break
        else:
            return at
    return None
