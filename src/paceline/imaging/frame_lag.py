"""Which frames of two videos belong together, where the cameras were started by hand.

At each lag between the views, features of what moves in the left one are matched with those in the right one. At the
true lag they lie on their epipolar lines, at others they are off by their motion until then.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.geometry import epipolar_distance
from paceline.imaging.epipolar_fit import MIN_MOVING_MATCHES, OUTLIER_PX, velocity_across
from paceline.imaging.feature_matches import frames_looked_at, left_motion, velocity_step
from paceline.imaging.moving_features import MAX_RATIO, Features, MovingFeatures, moving_features
from paceline.recordings.stereo import StereoRecording
from paceline.sift_features import match_descriptors

MAX_LAG_S = 2.0  # between videos that were started by hand
MAX_LAG_INSTANTS = 60  # instants with something moving that are looked at
MIN_MOTION_PX = 1.0  # of a feature across its epipolar line from one instant to the next: else it tells no lag
OFFSET_STEPS = 21  # offsets that are tried between two lags
MIN_LAG_RATIO = 3.0  # of matches at a lag to those at none
MIN_SIDELOBE_RATIO = 2.0  # of matches at a lag to those at any other that is not beside it


@dataclass(frozen=True, eq=False)
class LaggedMatches:
    """Epipolar distances (N,) px of matches at one lag, and their velocities across the epipolar lines (N,) px/s."""

    distance: Array
    velocity: Array

    def agreement(self, interval: float) -> tuple[int, float]:
        """How many agree with one offset of at most half an ``interval`` (s) from the lag, and that offset (s)."""
        moving = np.abs(self.velocity) * interval > MIN_MOTION_PX
        offsets = np.linspace(-0.5, 0.5, OFFSET_STEPS) * interval
        misfit = np.abs(self.distance[moving] - offsets[:, None] * self.velocity[moving])
        best = int(np.argmin(np.minimum(misfit, OUTLIER_PX).sum(1)))
        return int((misfit[best] < OUTLIER_PX).sum()), float(offsets[best])


def estimate_lag(recording: StereoRecording) -> float:
    """The time (s) by which the right exposures are later than their time stamps say, to the nearest frame interval.

    It is 0 unless far more of what moves agrees with another.
    """
    found = instants_with_motion(recording, MAX_LAG_INSTANTS)
    if len(found) < 3:
        return 0.0
    interval = float(np.median(np.diff([f.time for f in found])))
    reach = int(MAX_LAG_S / interval)
    lags = np.arange(-reach, reach + 1)
    numbered = {round(f.time / interval): f for f in found}
    left = {
        n: in_motion(numbered[n - 1], f, numbered[n + 1])
        for n, f in numbered.items()
        if {n - 1, n + 1} <= numbered.keys()
    }
    right = {n: f.right for n, f in numbered.items()}
    agreements = [matches_at(recording.rig, left, right, k).agreement(interval) for k in lags.tolist()]
    counts = np.array([count for count, _ in agreements])
    best = int(np.argmax(counts))
    others = counts[np.abs(lags - lags[best]) > 1]
    is_peak = counts[best] >= MIN_MOVING_MATCHES and counts[best] > MIN_SIDELOBE_RATIO * others.max(initial=0)
    if not is_peak or counts[best] <= MIN_LAG_RATIO * counts[reach]:
        return 0.0
    frame_interval = recording.pairing.interval
    return frame_interval * round((float(lags[best]) * interval + agreements[best][1]) / frame_interval)


def instants_with_motion(recording: StereoRecording, count: int) -> list[MovingFeatures]:
    """The features of up to ``count`` instants of the beginning of ``recording`` at which something moves."""
    step = velocity_step(recording)
    numbers = frozenset(recording.indices[step : frames_looked_at(recording) - step : step].tolist())
    frames = recording.frames(0, max(numbers, default=-1) + step + 1)
    features = (f for _, f in moving_features(recording.rig, frames, numbers))
    return list(islice((f for f in features if len(f.left[0]) or len(f.right[0])), count))


def in_motion(before: MovingFeatures, f: MovingFeatures, after: MovingFeatures) -> tuple[Features, Array]:
    """The left features (N,) of ``f`` that are found ``before`` and ``after``, and their velocities (N, 2) px/s."""
    rows, velocity, _ = left_motion(before, f, after)
    return (f.left[0][rows], f.left[1][rows]), velocity


def matches_at(
    rig: StereoRig, moving: dict[int, tuple[Features, Array]], right: dict[int, Features], lag: int
) -> LaggedMatches:
    """The matches between the ``moving`` features of each instant's left view and those of the ``right`` one ``lag``
    instants before."""
    distances, velocities = [np.zeros(0)], [np.zeros(0)]
    for n, ((places, descriptors), velocity) in moving.items():
        if (lagged := right.get(n - lag)) is not None:
            i, j = match_descriptors(descriptors, lagged[1], MAX_RATIO)
            pair = places[i], lagged[0][j]
            distances.append(epipolar_distance(rig, *pair))
            velocities.append(velocity_across(rig, *pair, velocity[i]))
    return LaggedMatches(np.concatenate(distances), np.concatenate(velocities))
