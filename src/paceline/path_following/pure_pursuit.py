"""Steering along the recorded path of the vehicle ahead ([NIST] stage 9): pure pursuit."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, cos, exp, hypot, nan, sin

import numpy as np

from paceline.arrays import Array
from paceline.numba_cache import cached_njit
from paceline.path_following.steering_goal import SteeringGoal
from paceline.recordings.odometry import Pose

PATH_SPACING_M = 0.5  # distance between two stored points of the path
MAX_PATH_POINTS = 512  # greatest number of stored points, 256 m
# Once the lead is no longer detected, the last points of its path are discarded: the occluder pulled them sideways.
# With them go the points that were uncertain and some before these, unless there are too many: no occluder takes so
# long to cover a vehicle, but in dim light every point is uncertain.
UNRELIABLE_END_POINTS = 4
UNRELIABLE_MARGIN_POINTS, MAX_UNRELIABLE_POINTS = 2, 12
# Extrapolation: a parabola through the last points, with the standard deviation of each across the path, and that of
# the path's curvature as vehicles drive (lateral acceleration over speed², or the limit).
FITTED_POINTS = 24
LATERAL_STD_M = 0.1  # standard deviation of a point across the path; neighbouring points have similar errors
LATERAL_ACCELERATION_STD_MPS2, MAX_CURVATURE_STD_PER_M = 1.5, 0.05
SPEED_SMOOTHING_S = 0.3  # time constant of the chase vehicle's speed


@dataclass(frozen=True)
class SteeringSettings:
    """Settings of pure pursuit and of the vehicle that is steered."""

    wheelbase: float  # m
    camera_ahead: float  # m from the rear axle to the camera
    lookahead_time: float  # s of driving to the point that is pursued
    lookahead_min: float  # m
    lookahead_max: float  # m
    steering_limit: float  # rad


def to_world(pose: Pose, ahead: float, right: float) -> tuple[float, float]:
    """World x and y of a point ``ahead`` and to the ``right`` of the camera, metres."""
    c, s = cos(pose.heading), sin(pose.heading)
    return pose.x + c * ahead + s * right, pose.y + s * ahead - c * right


def to_camera(pose: Pose, path: Array) -> Array:
    """World points (N, 2) as (ahead, right) of the camera, metres."""
    return np.asarray(_rotated(path, pose.x, pose.y, cos(pose.heading), sin(pose.heading)))


@cached_njit(nogil=True, error_model="numpy")
def _rotated(path: Array, x: float, y: float, c: float, s: float) -> Array:
    """``path`` (N, 2) in axes whose origin is x, y: the first has the direction (c, s), the second is to its right."""
    out = np.empty_like(path)
    for i in range(len(path)):
        dx, dy = path[i, 0] - x, path[i, 1] - y
        out[i, 0], out[i, 1] = c * dx + s * dy, s * dx - c * dy
    return out


def pure_pursuit(ahead: float, right: float, wheelbase: float) -> float:
    """Steering angle, rad, positive to the right, of the arc from the vehicle's rear axle through a point: the arc's
    curvature is twice the point's offset over its squared distance."""
    return atan(2.0 * wheelbase * right / max(ahead**2 + right**2, 1e-6))


@cached_njit(nogil=True, error_model="numpy")
def goal_point(path: Array, lookahead: float) -> tuple[float, float]:
    """The point (ahead, right) at which ``path`` (N, 2), seen from the vehicle and in driving order, leaves the circle
    of radius ``lookahead`` after its point nearest to the vehicle; its end where it does not reach so far. Its points
    are close beside each other as compared with the circle."""
    distance = np.hypot(path[:, 0], path[:, 1])
    nearest = k = int(distance.argmin())
    while k < len(path) - 1 and distance[k] < lookahead:
        k += 1
    if k == nearest or distance[k] < lookahead:
        return path[k, 0], path[k, 1]
    share = (lookahead - distance[k - 1]) / (distance[k] - distance[k - 1])
    last, step = path[k - 1], path[k] - path[k - 1]
    return last[0] + share * step[0], last[1] + share * step[1]


def extrapolated_path(path: Array, reach: float, speed: float, uncertain: int = 0) -> Array:
    """``path`` (N, 2), in driving order, extrapolated by ``reach`` metres beyond its reliable points, one every
    ``PATH_SPACING_M``: along the arc fitted to its end, for as long as the fitted part, then straight on.

    ``speed`` in m/s limits the curvature; the last ``uncertain`` points are those at which the lead was not detected
    reliably.
    """
    discarded = UNRELIABLE_END_POINTS
    if uncertain <= MAX_UNRELIABLE_POINTS:
        discarded = max(UNRELIABLE_END_POINTS, uncertain + UNRELIABLE_MARGIN_POINTS)
    known = path[: max(len(path) - discarded, (len(path) + 1) // 2, 2)]
    last = known[-FITTED_POINTS:]
    along = last[-1] - last[0]
    length = hypot(along[0], along[1])
    if not length > 0:
        return path
    axes = np.array([along, [-along[1], along[0]]]) / length
    s = (last - last[-1]) @ axes.T
    curvature_std = min(LATERAL_ACCELERATION_STD_MPS2 / max(speed, 1.0) ** 2, MAX_CURVATURE_STD_PER_M)
    # lateral = slope · s + curvature · s² / 2 + offset, with a Gaussian prior on the curvature
    rows = np.column_stack([s[:, 0], 0.5 * s[:, 0] ** 2, np.ones(len(s))]) / LATERAL_STD_M
    A = np.vstack([rows, [0.0, 1.0 / curvature_std, 0.0]])
    slope, curvature, offset = np.linalg.lstsq(A, np.append(s[:, 1] / LATERAL_STD_M, 0.0), rcond=None)[0]
    steps = np.arange(PATH_SPACING_M, reach + PATH_SPACING_M, PATH_SPACING_M)
    heading = np.arctan(slope) + curvature * np.minimum(steps - 0.5 * PATH_SPACING_M, length)
    ahead = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0) * PATH_SPACING_M
    return np.vstack([known, known[-1] + (ahead + [0.0, offset]) @ axes])


class Steering:
    """Steers a vehicle towards its ``goal``: the path of the vehicle ahead, that vehicle itself, or nothing; None: the
    path if there is odometry, the vehicle otherwise."""

    def __init__(self, settings: SteeringSettings, goal: SteeringGoal | None = None) -> None:
        self._c, self._goal = settings, goal
        self._points = np.zeros((MAX_PATH_POINTS, 2))
        self._count = 0
        self._uncertain = 0  # points at its end at which the vehicle ahead was not detected reliably
        self._last: tuple[float, Pose] | None = None
        self.speed = 0.0  # m/s, of the chase vehicle

    @property
    def path(self) -> Array:
        """World points (N, 2), m, that the vehicle ahead has passed, oldest first; the oldest are discarded."""
        return self._points[: self._count]

    def angle(
        self, time: float, ahead: float, right: float, detected: bool, pose: Pose | None, reliable: bool = True
    ) -> float:
        """Steering angle, rad, positive to the right, at ``time``, s, with the vehicle ahead at ``ahead`` and ``right``
        metres in the camera's axes; ``detected``: measured, not only predicted; ``reliable``: with full confidence. NaN
        where nothing is steered for, and for a path without a ``pose``."""
        c = self._c
        if self._goal == "none" or (self._goal == "path" and pose is None):
            return nan
        goal = ahead, right
        if pose is not None and self._goal != "lead":
            self._move(time, pose)
            if detected:
                added = self._append(*to_world(pose, ahead, right))
                self._uncertain = 0 if reliable else self._uncertain + added
            if self._count:
                lookahead = min(max(self.speed * c.lookahead_time, c.lookahead_min), c.lookahead_max)
                path = self.path
                if not detected:  # the lead has driven on, and the vehicle may have passed its last position
                    distance = hypot(*(path[-1] - (pose.x, pose.y)))
                    path = extrapolated_path(path, distance + c.lookahead_max, self.speed, self._uncertain)
                goal = goal_point(to_camera(pose, path), lookahead)
        angle = pure_pursuit(goal[0] + c.camera_ahead, goal[1], c.wheelbase)
        return min(max(angle, -c.steering_limit), c.steering_limit)

    def _move(self, time: float, pose: Pose) -> None:
        if self._last is not None and time > self._last[0]:
            dt = time - self._last[0]
            speed = hypot(pose.x - self._last[1].x, pose.y - self._last[1].y) / dt
            self.speed += (1.0 - exp(-dt / SPEED_SMOOTHING_S)) * (speed - self.speed)
        self._last = time, pose

    def _append(self, x: float, y: float) -> int:
        """Extends the path to a point, straight where the vehicle ahead was not detected in between; returns how many
        points were added."""
        if not self._count:
            self._add(x, y)
            return 1
        last = self.path[-1].copy()
        step = np.array([x, y]) - last
        length = hypot(*step)
        n = int(length / PATH_SPACING_M)
        for k in range(max(1, n + 1 - MAX_PATH_POINTS), n + 1):
            self._add(*(last + k * PATH_SPACING_M / length * step))
        return n

    def _add(self, x: float, y: float) -> None:
        if self._count == MAX_PATH_POINTS:
            self._points[: MAX_PATH_POINTS // 2] = self._points[MAX_PATH_POINTS // 2 :]
            self._count = MAX_PATH_POINTS // 2
        self._points[self._count] = x, y
        self._count += 1
