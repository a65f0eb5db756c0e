"""The motion of vehicles along a road: exact poses on its surface, at any time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from paceline.arrays import Array
from paceline.errors import UnusableInput
from paceline.simulation.lane_change import LaneChange
from paceline.simulation.road import ROAD_MARGIN_M, Road

MIN_TIME_S = -5.0  # s
MAX_TIME_S = 7200.0  # s
ROAD_END_DISTANCE_M = 20.0  # m that a vehicle stays away from where its road is not known any more


@dataclass(frozen=True)
class DrivingPlan:
    """How a vehicle drives: ``speed`` (m/s) at time 0, changed by ``acceleration`` (m/s²) from ``acceleration_start``
    (s) for ``acceleration_duration`` (s) or until the vehicle stands.

    The body's origin starts at arc length ``start`` (m) and ``lateral`` (m, positive to the right of growing arc
    length). An ``oncoming`` vehicle drives towards smaller arc length. ``lane_change`` counts the distance from time 0
    on."""

    start: float
    speed: float
    lateral: float
    acceleration: float = 0.0
    acceleration_start: float = 0.0
    acceleration_duration: float = np.inf
    lane_change: LaneChange | None = None
    oncoming: bool = False

    def speed_at(self, t: float) -> float:
        phase = min(max(t - self.acceleration_start, 0.0), self.acceleration_duration)
        return max(self.speed + self.acceleration * phase, 0.0)

    def distance_at(self, t: float) -> float:
        """Distance from time 0 to ``t``, negative before it: the integral of the speed."""
        return self._integral(t) - self._integral(0.0)

    def _integral(self, t: float) -> float:
        """Of the speed, from ``acceleration_start`` to ``t``."""
        if t <= self.acceleration_start:
            return self.speed * (t - self.acceleration_start)
        change = self.acceleration_duration
        if self.acceleration < 0:
            change = min(change, -self.speed / self.acceleration)
        phase = min(t - self.acceleration_start, change)
        steady_distance = self.speed_at(t) * (t - self.acceleration_start - phase)
        return self.speed * phase + self.acceleration * phase**2 / 2 + (steady_distance if steady_distance > 0 else 0.0)

    def lateral_at(self, distance: float) -> tuple[float, float]:
        """Lateral (m) after so many metres of the drive, and its change per metre."""
        if self.lane_change is None:
            return self.lateral, 0.0
        right = -1.0 if self.oncoming else 1.0
        shift, slope = self.lane_change.shift_at(distance), self.lane_change.slope_at(distance)
        return self.lateral + right * float(shift), right * float(slope)

    def with_lane_change(self, start: float, duration: float, shift: float) -> DrivingPlan:
        """The same drive with a move by ``shift`` metres, positive to the right of growing arc length, from ``start`` s
        on for ``duration`` s."""
        before, after = self.distance_at(start), self.distance_at(start + duration)
        return replace(self, lane_change=LaneChange(before, after - before, -shift if self.oncoming else shift))


class VehicleMotion:
    """A drive on a road by a vehicle whose front axle is ``wheelbase`` metres before its origin.

    The origin moves at the plan's speed along its own path, whatever the road and the lane change do, and the body
    points along it, so its rear axle never slips sideways. Both axles stand on the surface: over a crest the body is
    the chord between them. The pose is known while the origin is on the road or within `ROAD_MARGIN_M` −
    `ROAD_END_DISTANCE_M` of it: ``span`` are the first and the last time, s.
    """

    def __init__(self, road: Road, drive: DrivingPlan, wheelbase: float) -> None:
        self.road, self.drive, self.wheelbase = road, drive, wheelbase
        self._sign = -1.0 if drive.oncoming else 1.0
        self._check()
        ends = drive.distance_at(MIN_TIME_S) - 1.0, drive.distance_at(MAX_TIME_S) + 1.0  # m, a standing one's path, too
        self._pieces = self._solve(ends[0])[::-1] + self._solve(ends[1])
        self.span = self._time_at(self._pieces[0][0]), self._time_at(self._pieces[-1][1])

    def _check(self) -> None:
        d = self.drive
        if not 0 <= d.start <= self.road.length:
            raise UnusableInput(f"start {d.start:g} m: expected a place on the road, 0 to {self.road.length:g} m")
        if d.speed < 0:
            raise UnusableInput(f"speed {d.speed:g} m/s: expected no negative one; towards turns the vehicle round")
        if d.lane_change:
            if d.lane_change.length <= 0:
                raise UnusableInput(f"lane change of {d.lane_change.length:g} m: expected some length")
            if d.lane_change.max_slope > 0.5:
                raise UnusableInput("lane change: faster sideways than half the vehicle's speed")

    def _rate(self, distance: float, s: float) -> float:
        """Arc length per metre driven: what the lateral move leaves of it; the two are perpendicular."""
        lateral, slope = self.drive.lateral_at(distance)
        _, along, _ = self.road.tangents(np.clip(s, -ROAD_MARGIN_M, self.road.length + ROAD_MARGIN_M), lateral)
        return float(self._sign * np.sqrt(1 - slope**2) / np.linalg.norm(along))

    def _solve(self, end: float) -> list[tuple[float, float, object]]:
        """Arc length over the distance driven, from 0 to ``end`` m or the road's end, smooth from break to break."""
        low, high = -ROAD_MARGIN_M + ROAD_END_DISTANCE_M, self.road.length + ROAD_MARGIN_M - ROAD_END_DISTANCE_M

        def leaves(distance: float, y: Array) -> float:
            return float(min(y[0] - low, high - y[0]))

        leaves.terminal = True  # type: ignore[attr-defined]
        change = self.drive.lane_change
        breaks = (change.start, change.start + change.length) if change else ()
        inner = sorted((b for b in breaks if min(0.0, end) < b < max(0.0, end)), reverse=end < 0)
        pieces, s = [], self.drive.start
        for a, b in zip([0.0, *inner], [*inner, end], strict=True):
            solution = solve_ivp(
                lambda distance, y: [self._rate(distance, y[0])],
                (a, b),
                [s],
                "DOP853",
                dense_output=True,
                events=leaves,
                rtol=1e-11,
                atol=1e-9,
            )
            reached = float(solution.t[-1])
            pieces.append((min(a, reached), max(a, reached), solution.sol))
            s = float(solution.y[0, -1])
            if solution.status == 1:
                break
        return pieces

    def _time_at(self, distance: float) -> float:
        """When the vehicle has driven so far, or the first or last time where that is beyond it."""
        if self.drive.distance_at(MIN_TIME_S) >= distance:
            return MIN_TIME_S
        if self.drive.distance_at(MAX_TIME_S) <= distance:
            return MAX_TIME_S
        return float(brentq(lambda t: self.drive.distance_at(t) - distance, MIN_TIME_S, MAX_TIME_S))

    def _place(self, t: float) -> tuple[float, float]:
        """Distance driven and arc length, m. Raises ValueError outside ``span``."""
        if not self.span[0] <= t <= self.span[1]:
            raise ValueError("time {:g} s: the vehicle is on the road from {:.2f} to {:.2f} s".format(t, *self.span))
        distance = min(max(self.drive.distance_at(t), self._pieces[0][0]), self._pieces[-1][1])
        solution = next(solution for a, b, solution in self._pieces if a <= distance <= b)
        return distance, float(solution(distance)[0])  # type: ignore[operator]

    def position(self, t: float) -> tuple[float, float]:
        """Arc length and lateral (m) of the body's origin. Raises ValueError outside ``span``."""
        distance, s = self._place(t)
        return s, self.drive.lateral_at(distance)[0]

    def pose(self, t: float) -> tuple[Array, Array]:
        """R (3, 3) and t (3,) of world = R body + t."""
        distance, s = self._place(t)
        lateral, slope = self.drive.lateral_at(distance)
        origin, along, left = self.road.tangents(s, lateral)
        rate = self._rate(distance, s)
        ahead = origin + self.wheelbase * (along * rate - left * slope)
        front = self.road.locate(ahead, s + self.wheelbase * rate, lateral + self.wheelbase * slope)
        at_front, axes = self.road.frame(*front)
        x = at_front - origin
        x /= np.linalg.norm(x)
        up = self.road.frame(s, lateral)[1][:, 2] + axes[:, 2]
        y = np.cross(up, x)
        y /= np.linalg.norm(y)
        return np.stack([x, y, np.cross(x, y)], -1), origin

    def speed(self, t: float) -> float:
        """Of the body's origin, m/s."""
        return self.drive.speed_at(t)

    def distance(self, t: float) -> float:
        """Distance driven since time 0, m."""
        return self.drive.distance_at(t)
