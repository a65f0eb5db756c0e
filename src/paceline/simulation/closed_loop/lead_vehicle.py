"""The motion of the vehicle ahead: its speed profile, slower in bends, its lane changes and its weaving."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from paceline.arrays import Array
from paceline.simulation.chase.motion import RoadPose, road_pose
from paceline.simulation.closed_loop.drive_yaml import LaneChangeModel, WeaveModel
from paceline.simulation.lane_change import LaneChange, smoothstep
from paceline.simulation.road import POLYGON_STEP_M, PolygonalAxis

PLAN_STEP_S = 0.02  # s between the rows of the plan
BEND_BRAKING_MPS2 = 1.2  # m/s², braking for a bend
WEAVE_BLEND_M = 12.0  # m over which weaving begins and ends


class LeadVehicle:
    """The pose of the lead at any time. Its lateral position is a function of arc length alone, so that its path is a
    curve, known before and behind it.

    ``speeds`` (N, 2) are times (s) and speeds (m/s), joined by straight lines; it accelerates by at most
    ``max_acceleration`` (m/s²) and slows for bends to at most ``max_lateral_acceleration`` (m/s²). It drives
    ``duration`` seconds from ``start`` metres along the ``road``.
    """

    def __init__(
        self,
        road: PolygonalAxis,
        start: float,
        duration: float,
        speeds: Array,
        changes: Sequence[LaneChangeModel] = (),
        weaves: Sequence[WeaveModel] = (),
        max_acceleration: float = 2.0,
        max_lateral_acceleration: float = 1.8,
    ) -> None:
        self.road, self.start = road, start
        self.time = np.arange(0.0, duration + 2 * PLAN_STEP_S, PLAN_STEP_S)
        desired_speeds = np.interp(self.time, speeds[:, 0], speeds[:, 1])
        allowed = curve_speed_limits(road, max_lateral_acceleration)
        self.speed, self.arc = np.empty_like(self.time), np.empty_like(self.time)
        v, s = min(float(desired_speeds[0]), float(np.interp(start, road.s, allowed))), start
        for k, desired_speed in enumerate(desired_speeds.tolist()):
            target = min(desired_speed, _interpolate(allowed, s / POLYGON_STEP_M))
            before, v = v, max(min(target, v + max_acceleration * PLAN_STEP_S), 0.0)
            s += 0.5 * (before + v) * PLAN_STEP_S if k else 0.0
            self.speed[k], self.arc[k] = v, s
        self.rate = np.gradient(self.speed, PLAN_STEP_S)
        self._changes = [self._lane_change(c) for c in changes]
        self._weaves = [self._weave_interval(w) for w in weaves]

    def _lane_change(self, c: LaneChangeModel) -> LaneChange:
        """Along the road, as long as ``duration`` seconds at the speed where it begins, 1 m at least."""
        return LaneChange(self.arc_at(c.at), max(self.speed_at(c.at) * c.duration, 1.0), c.shift)

    def _weave_interval(self, w: WeaveModel) -> tuple[float, float, float, float]:
        begin, end = self.arc_at(w.start), self.arc_at(w.stop)
        mean = (end - begin) / max(w.stop - w.start, PLAN_STEP_S)
        return begin, end, w.amplitude, max(mean * w.period, 1.0)

    def arc_at(self, time: float) -> float:
        """m along the road's axis."""
        return float(np.interp(time, self.time, self.arc))

    def speed_at(self, time: float) -> float:
        return float(np.interp(time, self.time, self.speed))

    def acceleration_at(self, time: float) -> float:
        return float(np.interp(time, self.time, self.rate))

    def lateral(self, arc: Array | float) -> Array:
        """m to the right of the road's axis at arc length ``arc``."""
        arc = np.asarray(arc, float)
        total = np.zeros_like(arc)
        for change in self._changes:
            total += change.shift_at(arc)
        for begin, end, amplitude, wave in self._weaves:
            inside = smoothstep((arc - begin) / WEAVE_BLEND_M) * smoothstep((end - arc) / WEAVE_BLEND_M)
            total += amplitude * inside * np.sin(2 * np.pi * (arc - begin) / wave)
        return total

    def pose_at_arc(self, arc: float) -> RoadPose:
        """The lead's place and heading where its rear plane is at ``arc``."""
        before, lateral, after = self.lateral(np.array([arc - 0.05, arc, arc + 0.05])).tolist()
        return road_pose(self.road, arc, lateral, (after - before) / 0.1)

    def pose_at(self, time: float) -> RoadPose:
        return self.pose_at_arc(self.arc_at(time))

    def path_offset(self, x: float, y: float, start_arc: float) -> tuple[float, float]:
        """How far (m) a point lies to the right of the lead's path, and the arc length beside it, looked for from
        ``start_arc`` on."""
        arc = start_arc
        for _ in range(20):
            p = self.pose_at_arc(arc)
            c, s = np.cos(p.heading), np.sin(p.heading)
            along = (x - p.x) * c + (y - p.y) * s
            arc += along
            if abs(along) < 1e-6:
                break
        p = self.pose_at_arc(arc)
        return float((x - p.x) * np.sin(p.heading) - (y - p.y) * np.cos(p.heading)), float(arc)


def curve_speed_limits(road: PolygonalAxis, lateral: float) -> Array:
    """(N,) m/s: the greatest speed with ``lateral`` m/s² to the side at every corner of the axis, braked for
    in time."""
    limit = np.sqrt(lateral / np.maximum(np.abs(road.curvature(road.s)), 1e-6))
    squares = limit**2
    for k in range(len(squares) - 2, -1, -1):
        squares[k] = min(squares[k], squares[k + 1] + 2 * BEND_BRAKING_MPS2 * POLYGON_STEP_M)
    return np.asarray(np.sqrt(squares), float)


def _interpolate(table: Array, place: float) -> float:
    """The table's value between two rows; a plain look-up, as there are many."""
    k = min(int(place), len(table) - 2)
    return float(table[k] + (place - k) * (table[k + 1] - table[k]))


def road_from_pieces(pieces: list[tuple[float, float]], length: float, blend: float = 8.0) -> PolygonalAxis:
    """A road of ``pieces`` (metres, curvature in 1/m to the right), blended over ``blend`` metres; straight after."""
    s = np.arange(0.0, length + POLYGON_STEP_M, POLYGON_STEP_M)
    curvature, ends = np.zeros_like(s), np.cumsum([p[0] for p in pieces])
    for (metres, bend), end in zip(pieces, ends, strict=True):
        curvature[(s >= end - metres) & (s < end)] = bend
    kernel = np.ones(max(int(blend / POLYGON_STEP_M), 1))
    return PolygonalAxis(np.convolve(curvature, kernel / kernel.sum(), mode="same"), length)
