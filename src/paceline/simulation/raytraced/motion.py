"""The motion of vehicles along a road: exact poses on its surface, at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from paceline.arrays import Array
from paceline.errors import UnusableInput
from paceline.simulation.road import ROAD_MARGIN_M, Road

MIN_TIME_S = -5.0  # s
MAX_TIME_S = 7200.0  # s
ROAD_END_DISTANCE_M = 20.0  # m that a vehicle stays away from where its road is not known any more


@dataclass(frozen=True)
class LaneChange:
    """A move by ``shift`` metres, positive to the right of growing arc length, from ``start`` s for ``duration`` s."""

    start: float
    duration: float
    shift: float

    def shift_at(self, t: float) -> tuple[float, float]:
        """The part of the shift (m) done at ``t`` and its rate (m/s): a quintic with rate and acceleration zero at
        both ends."""
        u = min(max((t - self.start) / self.duration, 0.0), 1.0)
        rate = 30 * u**2 * (1 - u) ** 2 / self.duration
        return self.shift * u**3 * (10 - 15 * u + 6 * u**2), self.shift * rate


@dataclass(frozen=True)
class DrivingPlan:
    """How a vehicle drives: ``speed`` (m/s) at time 0, changed by ``acceleration`` (m/s²) from ``acceleration_start``
    (s) for ``acceleration_duration`` (s) or until the vehicle stands.

    The body's origin starts at arc length ``start`` (m) and ``lateral`` (m, positive to the right of growing arc
    length). An ``oncoming`` vehicle drives towards smaller arc length."""

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
        steady = self.speed_at(t) * (t - self.acceleration_start - phase)
        return self.speed * phase + self.acceleration * phase**2 / 2 + (steady if steady > 0 else 0.0)

    def lateral_at(self, t: float) -> tuple[float, float]:
        """Lateral (m) and its rate (m/s)."""
        shift, rate = self.lane_change.shift_at(t) if self.lane_change else (0.0, 0.0)
        return self.lateral + shift, rate


class VehicleMotion:
    """A drive on a road by a vehicle whose front axle is ``wheelbase`` metres before its origin.

    The origin moves at the plan's speed along its own path, whatever the road and the lane change do, and the body
    points along it, so its rear axle never slips sideways. Both axles stand on the surface: over a crest the body is
    the chord between them. The pose is known while the origin is on the road or within `ROAD_MARGIN_M` −
    `ROAD_END_DISTANCE_M` of it.
    """

    def __init__(self, road: Road, drive: DrivingPlan, wheelbase: float) -> None:
        self.road, self.drive, self.wheelbase = road, drive, wheelbase
        self._sign = -1.0 if drive.oncoming else 1.0
        self._check()
        change = drive.lane_change
        breaks = [0.0, drive.acceleration_start, drive.acceleration_start + drive.acceleration_duration]
        breaks += [change.start, change.start + change.duration] if change else []
        if drive.acceleration < 0:
            breaks.append(drive.acceleration_start - drive.speed / drive.acceleration)
        self._pieces = self._solve(0.0, MIN_TIME_S, breaks)[::-1] + self._solve(0.0, MAX_TIME_S, breaks)

    def _check(self) -> None:
        d = self.drive
        if not 0 <= d.start <= self.road.length:
            raise UnusableInput(f"start {d.start:g} m: expected a place on the road, 0 to {self.road.length:g} m")
        if d.speed < 0:
            raise UnusableInput(f"speed {d.speed:g} m/s: expected no negative one; towards turns the vehicle round")
        if d.lane_change:
            if d.lane_change.duration <= 0:
                raise UnusableInput(f"lane change of {d.lane_change.duration:g} s: expected some time")
            for t in d.lane_change.start + np.linspace(0.01, 0.99, 99) * d.lane_change.duration:
                if abs(d.lateral_at(float(t))[1]) > 0.5 * d.speed_at(float(t)):
                    raise UnusableInput("lane change: faster sideways than half the vehicle's speed")

    def _rate(self, t: float, s: float) -> float:
        """Arc length per second: what the lateral move leaves of the speed; the two are perpendicular."""
        lateral, sideways = self.drive.lateral_at(t)
        _, along, _ = self.road.tangents(np.clip(s, -ROAD_MARGIN_M, self.road.length + ROAD_MARGIN_M), lateral)
        ahead = np.sqrt(max(self.drive.speed_at(t) ** 2 - sideways**2, 0.0))
        return float(self._sign * ahead / np.linalg.norm(along))

    def _solve(self, start: float, end: float, breaks: list[float]) -> list[tuple[float, float, object]]:
        """Arc length over time from ``start`` to ``end`` or the road's end, smooth from break to break."""
        low, high = -ROAD_MARGIN_M + ROAD_END_DISTANCE_M, self.road.length + ROAD_MARGIN_M - ROAD_END_DISTANCE_M

        def leaves(t: float, y: Array) -> float:
            return float(min(y[0] - low, high - y[0]))

        leaves.terminal = True  # type: ignore[attr-defined]
        forward = end > start
        inner = sorted({b for b in breaks if min(start, end) < b < max(start, end)}, reverse=not forward)
        pieces, s = [], self.drive.start
        for a, b in zip([start, *inner], [*inner, end], strict=True):
            found = solve_ivp(
                lambda t, y: [self._rate(t, y[0])],
                (a, b),
                [s],
                "DOP853",
                dense_output=True,
                events=leaves,
                rtol=1e-11,
                atol=1e-9,
            )
            reached = float(found.t[-1])
            pieces.append((min(a, reached), max(a, reached), found.sol))
            s = float(found.y[0, -1])
            if found.status == 1:
                break
        return pieces

    @property
    def span(self) -> tuple[float, float]:
        """The first and the last time (s) at which the pose is known."""
        return self._pieces[0][0], self._pieces[-1][1]

    def position(self, t: float) -> tuple[float, float]:
        """Arc length and lateral (m) of the body's origin. Raises ValueError outside `span`."""
        for a, b, solution in self._pieces:
            if a <= t <= b:
                return float(solution(t)[0]), self.drive.lateral_at(t)[0]  # type: ignore[operator]
        raise ValueError("time {:g} s: the vehicle is on the road from {:.2f} to {:.2f} s".format(t, *self.span))

    def pose(self, t: float) -> tuple[Array, Array]:
        """R (3, 3) and t (3,) of world = R body + t."""
        s, lateral = self.position(t)
        origin, along, left = self.road.tangents(s, lateral)
        sideways, rate = self.drive.lateral_at(t)[1], self._rate(t, s)
        velocity = along * rate - left * sideways
        if not np.any(velocity):
            velocity = self._sign * along
        heading = velocity / np.linalg.norm(velocity)
        ahead = origin + self.wheelbase * heading
        step = self.wheelbase / np.linalg.norm(velocity)
        front = self.road.locate(ahead, s + step * rate, lateral + step * sideways)
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
