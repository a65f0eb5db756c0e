"""The top of a face that is left away: what adds little to what is known of the motion, and may lie behind the plane.

A bonnet or a windscreen above a face agrees in both views and over time nearly as well as the face does. Far away no
parallax tells it from the face, but in the fit of the motion it passes for a lean, and what it could tell goes into
that. So the motion is fitted to outlines of several heights, and the lowest is taken that tells the speed nearly as
well as any.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from paceline.arrays import Array
from paceline.detection.planar_face import Aligned, Face, course
from paceline.detection.tracks import slope
from paceline.documents.loading import VehicleDocument
from paceline.speed.configuration import DEFAULT_LIMITS
from paceline.speed.geometry.initial_plane import plane_from_outlines
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.path_deviation import deviation_of
from paceline.speed.refinement.photometric_fit import PhotometricFit
from paceline.speed.refinement.trajectory import Trajectory, prior

LOWER = 0.075  # m by which one outline of a face is lower than the next
LOWEST = 0.35  # m, of an outline
KNOWN = 0.03  # relative standard deviation of a speed of which something is known
NEARLY = 1.15  # times the smallest standard deviation of the speed
HOPELESS = 1.4  # times the same, from which on no lower outline is tried
OUTLINED = 0.5  # px, as by hand
STEPS = 2  # of a fit that begins where one to nearly the same outline ended


def trimmed(face: Face, seen: list[Aligned], is_clear: Callable[[Face], bool]) -> Face:
    """The lowest outline of a ``face``, cut at its top, that ``is_clear`` enough and by which what was ``seen`` of it
    (in order of time) tells the speed nearly as well as by any."""
    low, high = face.y
    lower = [replace(face, y=(low, top)) for top in np.arange(high - LOWER, low + LOWEST, -LOWER).tolist()]
    outlines = [face, *filter(is_clear, lower)]
    if len(outlines) == 1 or len(seen) < DEFAULT_LIMITS.min_frames:
        return face
    doubts = _doubts(outlines, seen)
    return outlines[int(np.flatnonzero(doubts <= NEARLY * doubts.min())[-1])]


def _doubts(outlines: list[Face], seen: list[Aligned]) -> Array:
    """The standard deviations of the mean speed, m/s, by what is ``seen`` in each of the ``outlines``, if the pixels'
    noise were all; only of the first ones where the others tell too little."""
    keyframes = [_glimpse(outlines[0], at) for at in seen]
    found: list[float] = []
    try:
        trajectory, speed = _carried(keyframes, seen)
        fit = PhotometricFit(trajectory, keyframes, prior(trajectory, speed))
        found.append(fit.noise_std)
        for face in outlines[1:]:
            if found[-1] > HOPELESS * min(found) or found[0] > KNOWN * speed:
                break
            fit = fit.on_outline(_pixels(face, seen[0])[0], STEPS)
            found.append(fit.noise_std)
    except np.linalg.LinAlgError:
        pass  # of what determines nothing no part does: the whole stays, or what was fitted by then
    return np.array(found or [0.0])


def _pixels(face: Face, at: Aligned) -> Array:
    """An outline (2, 4, 2) in both views of a frame, px."""
    return np.stack(at.sighting.way.pixels(at.s, face.corners(at)))


def _glimpse(face: Face, at: Aligned) -> Keyframe:
    s = at.sighting
    return Keyframe(s.frame, (s.time, s.time), s.crops, s.corners, _pixels(face, at))


def _carried(keyframes: list[Keyframe], seen: list[Aligned]) -> tuple[Trajectory, float]:
    """The outline in the first of the ``keyframes`` carried along its way, and how fast, m/s."""
    way, (left, right) = seen[0].sighting.way, keyframes[0].quads
    times = np.array([g.times for g in keyframes]) - keyframes[0].times[0]
    speed = slope(*course(seen))
    path = way.path if speed > 0 else way.path.reversed()
    document = VehicleDocument("", way.name, keyframes[0].frame, left, right, "front", None)
    plane = plane_from_outlines(way.rig, document, path, OUTLINED)
    bends = deviation_of(path, plane, times, abs(speed), on_path=True)
    return Trajectory(way.rig, left, plane, path, times, bends), abs(speed)
