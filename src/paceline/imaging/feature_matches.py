"""Matches between the two views, of points that move, with their velocities, and of points that do not.

Features of what moves are matched between the views and over time, those of the rest between the views only. The places
in the right view are refined to sub-pixels by Lucas–Kanade.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields

import numpy as np

from paceline.arrays import Array, Indices, Mask
from paceline.imaging.moving_features import (
    MAX_RATIO,
    MovingFeatures,
    feature_detector,
    match_pair,
    motion_mask,
    moving_features,
    reduced_features,
    views,
    with_margin,
)
from paceline.recordings.stereo import StereoFrame, StereoRecording
from paceline.sift_features import match_descriptors

MAX_SECONDS = 60.0  # of a recording that are looked at
MAX_INSTANTS = 16  # instants of these at which moving features are matched
VELOCITY_STEP_S = 0.1  # least time between two frames from which a velocity is taken
MAX_ACCELERATION_SHARE = 0.5  # difference between a point's displacements before and after over their sum
MIN_DISPLACEMENT_PX = 1.0


@dataclass(frozen=True, eq=False)
class Matches:
    """Points ``left`` and ``right`` (N, 2) px that match, the left ones' ``velocity`` (N, 2) px/s, the ``growth``
    (N,) 1/s of their pictures as they come nearer: their speed over their depth, and the ``times`` (N,) of their frames
    in seconds since the middle of the recording."""

    left: Array
    right: Array
    velocity: Array
    growth: Array
    times: Array

    def later(self, dt: float | Array) -> Matches:
        """The same with the left points as they are ``dt`` s later, or each by its own (N,), by constant velocities in
        space."""
        nearer = 1.0 / (1.0 - dt * self.growth)
        left = self.left + (dt * nearer)[:, None] * self.velocity
        return Matches(left, self.right, nearer[:, None] ** 2 * self.velocity, nearer * self.growth, self.times)


NO_MATCHES = Matches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


class InstantFeatures:
    """The features of what moves at the instants of ``recording`` at which views are matched, and at those from which
    its velocities are taken."""

    def __init__(self, recording: StereoRecording) -> None:
        self._recording = recording
        self._instants = instants(recording)
        self._needed = frozenset(self._instants.ravel().tolist())
        self._features: dict[int, MovingFeatures] = {}

    def passing(
        self, features: Iterable[tuple[StereoFrame, MovingFeatures]]
    ) -> Iterator[tuple[StereoFrame, MovingFeatures]]:
        """The ``features`` of frames, of which those of the instants are kept."""
        for frame, found in features:
            if frame.index in self._needed:
                self._features[frame.index] = found
            yield frame, found

    def matches(self) -> Matches:
        """The matches between the views: the left points as they are when, by its time stamp, the right picture is
        exposed. Where no features have passed by, they are detected first."""
        if not self._features:
            frames = self._recording.frames(0, max(self._needed, default=-1) + 2)
            for _ in self.passing(moving_features(self._recording.rig, frames, self._needed)):
                pass
        found, middle = [NO_MATCHES], middle_of(self._recording.times)
        for triple in self._instants.tolist():
            if all(number in self._features for number in triple):
                before, f, after = (self._features[number] for number in triple)
                found.append(_matches_in_motion(before, f, after, middle))
        return Matches(*(np.concatenate([getattr(m, f.name) for m in found]) for f in fields(Matches)))


def match_static(recording: StereoRecording) -> Matches:
    """Matches between the views where nothing moves in the first of the `instants` of ``recording``; features are
    detected in the reduced pictures."""
    for triple in instants(recording):
        frames = list(recording.selected(triple))
        if len(frames) == 3:
            break
    else:
        return NO_MATCHES
    found, (before, frame, after) = [], map(views, frames)
    for side, image in enumerate(frame):
        moving = motion_mask(image, before[side]) | motion_mask(image, after[side])
        found.append(reduced_features(feature_detector(), image, (with_margin(moving) == 0).astype(np.uint8)))
    matched, right = match_pair(recording.rig, frames[1], found[0], found[1])
    still = np.zeros(len(right))
    times = np.full(len(right), frames[1].time - middle_of(recording.times))
    return Matches(found[0][0][matched], right, np.zeros_like(right), still, times)


def middle_of(times: Array) -> float:
    """The middle (s) of a recording with frames at ``times`` (N,)."""
    return float(times.min() + times.max()) / 2


def _matches_in_motion(before: MovingFeatures, f: MovingFeatures, after: MovingFeatures, middle: float) -> Matches:
    """The matches of ``f`` that are found ``before`` and ``after``; ``middle`` (s) is that of the recording."""
    rows, velocity, growth = left_motion(before, f, after)
    _, i, j = np.intersect1d(rows, f.matched, return_indices=True)
    times = np.full(len(i), f.time - middle)
    return Matches(f.left[0][rows[i]], f.places[j], velocity[i], growth[i], times).later(f.skew)


def left_motion(before: MovingFeatures, f: MovingFeatures, after: MovingFeatures) -> tuple[Indices, Array, Array]:
    """Which left features of ``f`` are found ``before`` and ``after`` (n,), their velocities (n, 2) px/s and growths
    (n,) 1/s."""
    left, described = f.left
    places = []
    for other in (before, after):
        i, j = match_descriptors(described, other.left[1], MAX_RATIO)
        place = np.full_like(left, np.nan)
        place[i] = other.left[0][j]
        places.append(place)
    behind, ahead = left - places[0], places[1] - left
    rows = np.flatnonzero(_is_steady(behind, ahead))
    return rows, *velocity_and_growth(behind[rows], ahead[rows], 0.5 * (after.time - before.time))


def _is_steady(behind: Array, ahead: Array) -> Mask:
    """Which points (N,), that move by ``behind`` and ``ahead`` (N, 2) px, move on, and much alike before and after."""
    shorter = np.minimum(np.linalg.norm(behind, axis=1), np.linalg.norm(ahead, axis=1))
    total = np.linalg.norm(ahead + behind, axis=1)
    is_uniform = np.linalg.norm(ahead - behind, axis=1) < MAX_ACCELERATION_SHARE * total
    return np.asarray(is_uniform & (shorter > MIN_DISPLACEMENT_PX))


def velocity_step(recording: StereoRecording) -> int:
    """Frames from one to the other of those from which a velocity is taken."""
    return max(1, round(VELOCITY_STEP_S / recording.pairing.interval))


def frames_looked_at(recording: StereoRecording) -> int:
    """How many frames of the beginning of ``recording`` are looked at for a lag."""
    return min(len(recording), int(MAX_SECONDS / recording.pairing.interval))


def instants(recording: StereoRecording) -> Indices:
    """The frames of up to about `MAX_INSTANTS` instants (n, 3), evenly spread over the ``recording``: each between
    those from which its velocities are taken."""
    step = velocity_step(recording)
    count = len(recording) - 2 * step
    first = np.arange(0, count, max(1, count // MAX_INSTANTS))
    return np.asarray(recording.indices[first[:, None] + step * np.arange(3)])


def velocity_and_growth(behind: Array, ahead: Array, dt: float) -> tuple[Array, Array]:
    """The velocities (N, 2) px/s and growths (N,) 1/s of points that move by ``behind`` and ``ahead`` (N, 2) px in the
    ``dt`` s before and after.

    At a constant velocity in space a point is at x + v t / (1 − g t), with g its growth.
    """
    total = ahead + behind
    growing = ((ahead - behind) * total).sum(1) / (total**2).sum(1)  # g dt
    return 0.5 / dt * (1.0 - growing**2)[:, None] * total, growing / dt
