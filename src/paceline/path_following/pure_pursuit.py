"""Steering along the path that the vehicle ahead has driven ([NIST] stage 9): pure pursuit."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, cos, exp, hypot, sin

import numpy as np

from paceline.arrays import Array
from paceline.numba_cache import compiled
from paceline.recordings.odometry import Pose

SPACING = 0.5  # m between two stored points of the path
LONGEST = 512  # points kept, 256 m: a day's run holds no more than that
DOUBTED = 4  # points at its end that are not believed of a lead that is not seen any more: what hid it drew them aside
BEFORE, HIDING = 2, 12  # points before those that were not seen for sure, which are not believed either unless there
# are more than so many of them: nothing takes so long to hide a vehicle, but in dim light it is never sure
STRETCH = 24  # points before those that tell where the path leads on, as far on as they reach back,
ASIDE = 0.1  # m, by how much each may be off it, as several next to each other are alike,
TURN, SHARPEST = 1.5, 0.05  # m/s² and 1/m, and how hard vehicles turn
SMOOTH = 0.3  # s over which the chase vehicle's speed is averaged


@dataclass(frozen=True)
class SteeringSettings:
    """What is pursued, and by what vehicle."""

    wheelbase: float  # m
    camera_ahead: float  # m from the rear axle to the camera
    lookahead_time: float  # s of driving to the point that is pursued
    lookahead_min: float  # m
    lookahead_max: float  # m
    steering_limit: float  # rad


def in_world(pose: Pose, ahead: float, right: float) -> tuple[float, float]:
    """World x and y of a point ``ahead`` and to the ``right`` of the camera, metres."""
    c, s = cos(pose.heading), sin(pose.heading)
    return pose.x + c * ahead + s * right, pose.y + s * ahead - c * right


def seen_from(pose: Pose, path: Array) -> Array:
    """World points (N, 2) as (ahead, right) of the camera, metres."""
    return np.asarray(_turned(path, pose.x, pose.y, cos(pose.heading), sin(pose.heading)))


@compiled(nogil=True, error_model="numpy")
def _turned(path: Array, x: float, y: float, c: float, s: float) -> Array:
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


@compiled(nogil=True, error_model="numpy")
def goal_on(path: Array, lookahead: float) -> tuple[float, float]:
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


def prolonged(path: Array, reach: float, speed: float, unsure: int = 0) -> Array:
    """``path`` (N, 2), in driving order, carried on by ``reach`` metres beyond what is believed of it, every `SPACING`:
    by the arc that its end goes on to, as a vehicle turns at a ``speed`` in m/s, and from where that is not told
    straight on. At its last ``unsure`` points the lead was not seen for sure."""
    doubted = max(DOUBTED, unsure + BEFORE) if unsure <= HIDING else DOUBTED
    known = path[: max(len(path) - doubted, (len(path) + 1) // 2, 2)]
    last = known[-STRETCH:]
    along = last[-1] - last[0]
    length = hypot(along[0], along[1])
    if not length > 0:
        return path
    axes = np.array([along, [-along[1], along[0]]]) / length
    s, sharp = (last - last[-1]) @ axes.T, min(TURN / max(speed, 1.0) ** 2, SHARPEST)
    # a parabola aside = slope · s + bend · s² / 2 + off at its points, of a bend that is known beforehand to be small
    rows = np.column_stack([s[:, 0], 0.5 * s[:, 0] ** 2, np.ones(len(s))]) / ASIDE
    A = np.vstack([rows, [0.0, 1.0 / sharp, 0.0]])
    slope, bend, off = np.linalg.lstsq(A, np.append(s[:, 1] / ASIDE, 0.0), rcond=None)[0]
    steps = np.arange(SPACING, reach + SPACING, SPACING)
    heading = np.arctan(slope) + bend * np.minimum(steps - 0.5 * SPACING, length)
    on = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0) * SPACING
    return np.vstack([known, known[-1] + (on + [0.0, off]) @ axes])


class Steering:
    """The angle that makes a vehicle follow the path of the one ahead; without odometry, the one ahead itself."""

    def __init__(self, settings: SteeringSettings) -> None:
        self._c = settings
        self._points = np.zeros((LONGEST, 2))
        self._count = 0
        self._unsure = 0  # points at its end at which the vehicle ahead was not seen for sure
        self._last: tuple[float, Pose] | None = None
        self.speed = 0.0  # m/s, of the chase vehicle

    @property
    def path(self) -> Array:
        """World points (N, 2), m, that the vehicle ahead has passed, the oldest first; the oldest are forgotten."""
        return self._points[: self._count]

    def angle(
        self, time: float, ahead: float, right: float, seen: bool, pose: Pose | None, sure: bool = True
    ) -> float:
        """Steering angle, rad, positive to the right, at ``time``, s, with the vehicle ahead at ``ahead`` and ``right``
        metres in the camera's axes; ``seen``: measured, not only expected there; ``sure``: as well as ever."""
        c = self._c
        goal = ahead, right
        if pose is not None:
            self._move(time, pose)
            if seen:
                added = self._append(*in_world(pose, ahead, right))
                self._unsure = 0 if sure else self._unsure + added
            if self._count:
                lookahead = min(max(self.speed * c.lookahead_time, c.lookahead_min), c.lookahead_max)
                path = self.path
                if not seen:  # the lead has driven on, and the vehicle may have passed where it was seen last
                    gone = hypot(*(path[-1] - (pose.x, pose.y)))
                    path = prolonged(path, gone + c.lookahead_max, self.speed, self._unsure)
                goal = goal_on(seen_from(pose, path), lookahead)
        angle = pure_pursuit(goal[0] + c.camera_ahead, goal[1], c.wheelbase)
        return min(max(angle, -c.steering_limit), c.steering_limit)

    def _move(self, time: float, pose: Pose) -> None:
        if self._last is not None and time > self._last[0]:
            dt = time - self._last[0]
            speed = hypot(pose.x - self._last[1].x, pose.y - self._last[1].y) / dt
            self.speed += (1.0 - exp(-dt / SMOOTH)) * (speed - self.speed)
        self._last = time, pose

    def _append(self, x: float, y: float) -> int:
        """Lead the path on to a point, straight where the vehicle ahead was not seen on its way there; by how many
        points it has grown."""
        if not self._count:
            self._add(x, y)
            return 1
        last = self.path[-1].copy()
        way = np.array([x, y]) - last
        length = hypot(*way)
        n = int(length / SPACING)
        for k in range(max(1, n + 1 - LONGEST), n + 1):
            self._add(*(last + k * SPACING / length * way))
        return n

    def _add(self, x: float, y: float) -> None:
        if self._count == LONGEST:
            self._points[: LONGEST // 2] = self._points[LONGEST // 2 :]
            self._count = LONGEST // 2
        self._points[self._count] = x, y
        self._count += 1
