"""Vehicles found as they drive by: a frame in, the outlines of the vehicles that have gone out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from paceline.arrays import Array, Image
from paceline.detection.background_model import Scene
from paceline.detection.detector import Lookout, Sighting
from paceline.detection.face_height import trimmed
from paceline.detection.lane_paths import Way
from paceline.detection.planar_face import Aligned, Face, course, face_of, likeness, nearer_half, showing_face
from paceline.detection.tracks import Linker, Track, off_course, slope
from paceline.documents.loading import VehicleDocument
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import DEFAULTS
from paceline.verdicts import NO_REASON, Message, message

LEAST_SIGHTINGS = 4  # and half as many as there are frames between them in which it is not seen; in all, as many
UNSTEADY = 0.4, 0.5  # from which on it does not drive, but two things were seen in turn: bushes in the wind; more is
FAR = 10.0  # allowed to what has come so many m
QUIET, OFTEN = 0.5, 8  # px of disparity, rms, and sightings: so far beside its course what drives is measured, too; a
# track as smooth and long only has to fit the course better than two places
ASIDE, BRIEFLY = 1.9, 0.25  # m from the middle of the way, and share of its sightings: what is farther in more of them
# does not drive on it, and what is nearer in some may be changing its lane
LEAST_AREA = 0.7  # m² of a face that both views agree on, in the median, times the root of the number of sightings:
# two lamps in the dark are small, but there again and again
MANY = 16  # of them, from which on more say no more
LEAST_HEIGHT = 0.8  # m above the road that a vehicle reaches: less is a shadow,
CLEARLY = 10.0  # unless the views agree so many times better than if it lay on the road: lamps in the dark
UPRIGHT = 2.5  # times better that the views agree than if it lay on the road, in the median: two shadows one behind the
# other reached 2.0, of 260 vehicles by day the least upright 4.4, a dim one at night 2.9
SMALLEST = 16.0, 6.0  # px, width and height of an outline
OFF = 1.0, 1.0  # m, and px of disparity, by which it is off at most
MOST_OFF = 2.0  # of these errors: what is more off says no more against a course
NO_SAY = 1e3  # times its error, with which a place has no say
KNOWN = 8  # vehicles of which a next one may be a part
ALIKE = 0.9  # of the usual likeness to the face's picture, in the frame in which it is outlined: nothing hides it there
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
    reason: Message
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

    def __init__(self, ways: list[Way], scene: Scene) -> None:
        self._lookout, self._linker, self._scene = Lookout(ways), Linker(), scene
        self._register = Register()

    @property
    def rows(self) -> slice:
        """The rows of the pictures outside which nothing is looked at."""
        return self._lookout.rows

    def see(self, frame: StereoFrame) -> list[Found]:
        """The vehicles that have gone by the time of ``frame``."""
        return self._outlined(self.gone(frame))

    def finish(self) -> list[Found]:
        """The vehicles that were still there at the last frame."""
        return self._outlined(self.rest())

    def _outlined(self, tracks: list[Track]) -> list[Found]:
        both = [(track, found_on(track)) for track in tracks]
        return [found for track, found in both if self._register.is_new(track, found)]

    def gone(self, frame: StereoFrame) -> list[Track]:
        """As `see`, but what was seen of them, on which `found_on` has yet to find what can be measured: that takes
        longer than a frame lasts, and a program that has to keep up leaves it to another process."""
        if frame.duplicate:
            return []
        before = self._scene.before(frame, self.rows)
        sightings = self._lookout.see(frame, before.images, before.noise)
        self._scene.follow(frame, self.rows)
        gone = [track for track in self._linker.link(frame.time, sightings) if is_vehicle(track)]
        return [track for track in gone if not any(goes_on(track, other) for other in self._linker.tracks)]

    @property
    def in_view(self) -> list[Track]:
        """What moves along the ways in the last frame, and may turn out to be a vehicle."""
        return [track for track in self._linker.tracks if not track.unseen and track.moves]

    def rest(self) -> list[Track]:
        """As `finish`, of what was seen."""
        tracks, self._linker = self._linker.tracks, Linker()
        return [track for track in tracks if is_vehicle(track)]


class Register:
    """The last vehicles that were found, so that none is told twice: at night two lamps, or a halo and what is in it,
    may have been followed apart from each other."""

    def __init__(self) -> None:
        self._known: deque[Track] = deque(maxlen=KNOWN)

    def is_new(self, track: Track, found: Found) -> bool:
        """Whether what was ``found`` on a ``track`` is none of those; from now on it is known."""
        if any(track.is_of(other) for other in self._known):
            return False
        if found.vehicle is not None:
            self._known.append(track)
        return True


def is_vehicle(track: Track) -> bool:
    """Whether what was seen is upright and large enough, and drives along its way."""
    if not track.moves:
        return False
    count = len(track.times)
    area = float(np.median(track.areas))
    if count < max(LEAST_SIGHTINGS + track.missed / 2, track.missed) or area * np.sqrt(min(count, MANY)) < LEAST_AREA:
        return False
    upright = float(np.median(track.upright))
    if upright < UPRIGHT or (_height(track) < LEAST_HEIGHT and upright < CLEARLY):
        return False
    aside = np.abs([s.middle for s in track.kept])
    if float(np.quantile(aside, BRIEFLY)) > ASIDE or len(showing_face(track)) < 2:
        return False
    quiet = count >= OFTEN and track.roughness < QUIET
    return track.unsteadiness < (1.0 if quiet else UNSTEADY[abs(track.travel) > FAR])


def goes_on(track: Track, other: Track) -> bool:
    """Whether the vehicle of a ``track`` that has ended is followed further, and better, by another one."""
    return len(other.times) > len(track.times) and is_vehicle(other) and other.is_of(track)


def as_seen(track: Track, reason: Message) -> Found:
    """The vehicle that a track saw, without an outline for a ``reason``."""
    first = track.first
    return Found(
        path=first.way.name,
        times=(track.times[0], track.times[-1]),
        width=track.width,
        height=_height(track),
        place=first.place,
        vehicle=None,
        reason=reason,
        crops=first.crops,
        corners=first.corners,
    )


def found_on(track: Track) -> Found:
    """The vehicle that a track saw, with its outline in the first frame that shows it well; where all that was seen of
    it leaves none, by the nearer half, for farther away another one may hide most of it."""
    shown = showing_face(track)
    whole = _found_by(track, shown)
    if whole.vehicle is not None or not shown:
        return whole
    nearer = _found_by(track, nearer_half(shown))
    return whole if nearer.vehicle is None else nearer


def _found_by(track: Track, shown: list[Sighting]) -> Found:
    """The vehicle that a track saw, with its outline by some of its sightings, in which it is ``shown``."""
    face = face_of(shown)
    if face is None:
        return as_seen(track, message("no_planar_face"))
    steady = in_step(face.aligned)
    clear = [at for at in steady if _is_clear(face, at)]
    if not clear:
        return as_seen(track, message("face_never_clear", min_width_px=SMALLEST[0], min_height_px=SMALLEST[1]))
    alike = likeness(face, clear)
    at = clear[int(np.argmax(alike >= ALIKE * np.median(alike)))]
    seen = steady[steady.index(at) :]
    face = trimmed(face, seen, partial(_is_clear, at=at))
    sighting = at.sighting
    left, right = sighting.way.pixels(at.s, face.corners(at))
    document = VehicleDocument("", sighting.way.name, sighting.frame, left, right, "front", first_speed(seen))
    return replace(
        as_seen(track, NO_REASON),
        path=sighting.way.name,
        vehicle=document,
        crops=sighting.crops,
        corners=sighting.corners,
    )


def _height(track: Track) -> float:
    return float(np.median([s.y[1] for s in track.kept]))


def in_step(aligned: list[Aligned]) -> list[Aligned]:
    """Those that are on the course of all, or of all but one, which far off at an end would bend it to itself."""
    t, s = course(aligned)
    error, no_say = np.array([a.sighting.error(*OFF) for a in aligned]), np.where(np.eye(len(t)), NO_SAY, 1.0)
    courses = [off_course(t, s, error), *(doubt * off_course(t, s, doubt * error) for doubt in no_say)]
    off = min(courses, key=lambda off: float(np.minimum(np.abs(off), MOST_OFF).sum()))
    return [a for a, one in zip(aligned, off, strict=True) if abs(one) <= 1]


def first_speed(seen: list[Aligned]) -> float | None:
    """About how fast it drives at first, m/s, by the first half of where it was ``seen``; None where that is too
    little to tell, or it hardly moves there."""
    early = seen[: max(LEAST_SIGHTINGS, len(seen) // 2)]
    if len(early) < LEAST_SIGHTINGS:
        return None
    speed = round(abs(slope(*course(early))), 1)
    return speed if speed >= DEFAULTS.start.speed_range[0] else None


def _is_clear(face: Face, at: Aligned) -> bool:
    """Whether a face is large enough in a frame, and wholly inside both pictures."""
    way = at.sighting.way
    for quad, camera in zip(way.pixels(at.s, face.corners(at)), way.rig.cameras, strict=True):
        inside = (quad >= BORDER) & (quad <= np.array(camera.image_size) - 1 - BORDER)
        if not inside.all() or (np.ptp(quad, axis=0) < SMALLEST).any():
            return False
    return True
