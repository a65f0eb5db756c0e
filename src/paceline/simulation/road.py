"""Roads as exact surfaces: an axis of given curvature and slope, banked, with lanes and painted lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_simpson
from scipy.interpolate import CubicHermiteSpline

from paceline.arrays import Array
from paceline.errors import UnusableInput

ROAD_KINDS = ("straight", "circle", "clothoid", "winding")
ROAD_MARGIN_M = 150.0  # m by which a road is known before its start and behind its end
_AXIS_STEP_M = 0.1  # m, between the points that the axis is interpolated from


@dataclass(frozen=True)
class RoadShape:
    """What a road looks like. Curvature and lateral positions are positive to the right of growing arc length.

    ``radius`` (m, of the plan) belongs to a circle, to a clothoid's end or to a winding road's tightest place.
    ``grade`` is the rise per metre of plan in the road's middle; with a ``crest_radius`` (m, positive a crest, negative
    a sag) it changes along the road. ``bank`` (rad) lowers the right edge. The edge lines are solid, the inner lines
    as ``markings``; ``wear`` goes from 0, fresh paint, to 1, nearly gone.
    """

    kind: str = "straight"  # straight | circle | clothoid | winding
    radius: float | None = None
    grade: float = 0.0
    bank: float = 0.0
    crest_radius: float | None = None
    lanes: int = 2
    lane_width: float = 3.6
    shoulder: float = 1.5
    markings: str = "dashed"  # dashed | solid | none
    wear: float = 0.3


class Road:
    """A road of ``length`` metres. It starts at the world's origin, there its axis heads east.

    Arc length is that of the axis in space; a surface point is given by it and by the lateral distance on the banked
    surface. Raises UnusableInput where the shape contradicts itself.
    """

    def __init__(self, shape: RoadShape, length: float, seed: int) -> None:
        _check_shape(shape, length)
        self.shape, self.length, self.seed = shape, length, seed
        half = shape.lanes / 2
        self.lanes = tuple((k + 0.5 - half) * shape.lane_width for k in range(shape.lanes))
        drawn = range(shape.lanes + 1) if shape.markings != "none" else (0, shape.lanes)
        self.markings = tuple((k - half) * shape.lane_width for k in drawn)
        self.half_width = half * shape.lane_width + shape.shoulder
        self._vertical = 0.0 if shape.crest_radius is None else -1 / shape.crest_radius
        self._middle = np.arctan(shape.grade)
        self._waves = _draw_curvature_waves(shape, np.random.default_rng([seed, 31]))
        self._tabulate()

    def _slope(self, s: Array) -> Array:
        """Angle of the axis above the horizontal."""
        return np.asarray(self._middle + self._vertical * (s - self.length / 2))

    def _curvature(self, plan: Array) -> Array:
        """Curvature of the plan at ``plan`` metres of its own length from the start; the end's holds beyond it."""
        kind, r = self.shape.kind, self.shape.radius
        if kind == "straight" or r is None:
            return np.zeros_like(plan)
        if kind == "circle":
            return np.full_like(plan, 1 / r)
        if kind == "clothoid":
            return np.asarray(np.clip(plan / self._plan_length, 0, 1) / r)
        wavelength, phase, weight = self._waves
        return np.asarray((weight * np.sin(2 * np.pi * plan[..., None] / wavelength + phase)).sum(-1) / r)

    def _tabulate(self) -> None:
        """Heading and position by integration of curvature and tangent; error well below a micrometre."""
        count = int(np.ceil((self.length + 2 * ROAD_MARGIN_M) / _AXIS_STEP_M)) + 1
        s = np.linspace(-ROAD_MARGIN_M, self.length + ROAD_MARGIN_M, count)
        slope = self._slope(s)
        plan = _integrate(np.cos(slope), s)
        start = np.interp(0.0, s, plan)
        self._plan_length = float(np.interp(self.length, s, plan) - start)
        turning = -self._curvature(plan - start) * np.cos(slope)  # of the heading, counter-clockwise, per metre of s
        heading = _integrate(turning, s)
        angle = CubicHermiteSpline(s, heading, turning)
        heading = heading - angle(0.0)
        self._heading = CubicHermiteSpline(s, heading, turning)
        tangent = np.stack([np.cos(slope) * np.cos(heading), np.cos(slope) * np.sin(heading), np.sin(slope)], -1)
        axis = CubicHermiteSpline(s, _integrate(tangent, s), tangent)
        self._axis, self._origin = axis, axis(0.0)

    def frame(self, s: ArrayLike, lateral: ArrayLike = 0.0) -> tuple[Array, Array]:
        """Points (..., 3) of the surface and its axes (..., 3, 3) there, whose columns are forward, left and up.

        ``s`` and ``lateral`` are broadcast. Forward runs along the line of that lateral; raises ValueError farther
        than `ROAD_MARGIN_M` from the road.
        """
        points, along, left = self.tangents(s, lateral)
        forward = along / np.linalg.norm(along, axis=-1, keepdims=True)
        return points, np.stack([forward, left, np.cross(forward, left)], -1)

    def tangents(self, s: ArrayLike, lateral: ArrayLike = 0.0) -> tuple[Array, Array, Array]:
        """Points (..., 3), their derivatives by arc length (..., 3), and unit vectors (..., 3) to the left, which are
        minus their derivatives by the lateral; the two are perpendicular."""
        s, lateral = np.broadcast_arrays(np.asarray(s, float), np.asarray(lateral, float))
        if s.size and (s.min() < -ROAD_MARGIN_M or s.max() > self.length + ROAD_MARGIN_M):
            raise ValueError(f"arc length {s.min():.1f} to {s.max():.1f} m: expected 0 to {self.length:g} m")
        heading, slope = self._heading(s), self._slope(s)
        turning, bending = self._heading(s, 1), self._vertical
        c, z = np.cos(heading), np.zeros_like(heading)
        n, cb, sb = np.sin(heading), np.cos(self.shape.bank), np.sin(self.shape.bank)
        cs, sn = np.cos(slope), np.sin(slope)
        T = np.stack([cs * c, cs * n, sn], -1)
        level = np.stack([-n, c, z], -1)  # left, without the bank
        up = np.stack([-sn * c, -sn * n, cs], -1)
        left = cb * level + sb * up
        d_level = -turning[..., None] * np.stack([c, n, z], -1)
        d_up = -bending * T - (turning * sn)[..., None] * level
        along = T - lateral[..., None] * (cb * d_level + sb * d_up)
        return self._axis(s) - self._origin - lateral[..., None] * left, along, left

    def locate(self, points: ArrayLike, s: ArrayLike, lateral: ArrayLike) -> tuple[Array, Array]:
        """Arc lengths and laterals of the surface points below or above ``points`` (..., 3), along the surface's
        normal, found by Newton's method from a guess nearby."""
        target, at_s, at_lateral = np.asarray(points, float), np.asarray(s, float), np.asarray(lateral, float)
        for _ in range(6):
            at, along, left = self.tangents(at_s, at_lateral)
            at_s = at_s + ((target - at) * along).sum(-1) / (along**2).sum(-1)
            at_lateral = at_lateral - ((target - at) * left).sum(-1)
        return at_s, at_lateral

    def line(self, lateral: float, start: float, end: float, step: float = 0.5) -> Array:
        """Points (N, 3) of the line at ``lateral`` from arc length ``start`` to ``end``, about ``step`` m apart."""
        count = max(2, int(np.ceil(abs(end - start) / step)) + 1)
        return self.tangents(np.linspace(start, end, count), lateral)[0]


def _integrate(values: Array, s: Array) -> Array:
    return np.asarray(cumulative_simpson(values, x=s, axis=0, initial=0))


def _draw_curvature_waves(shape: RoadShape, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Wavelengths (m), phases and weights of a winding road's curvature, whose peak is 1 at most."""
    scale = 6 * np.sqrt(abs(shape.radius or 100.0))  # tighter roads wind faster: about 85 m at 200 m
    wavelength = scale * rng.uniform([1.8, 0.9], [3.2, 1.5])
    weight = np.array([1.0, rng.uniform(0.2, 0.6)])
    return wavelength, rng.uniform(0, 2 * np.pi, 2), weight / weight.sum()


def _check_shape(shape: RoadShape, length: float) -> None:
    if shape.kind not in ROAD_KINDS:
        raise UnusableInput(f"road kind {shape.kind!r}: expected one of {', '.join(ROAD_KINDS)}")
    if shape.kind != "straight" and shape.radius is None:
        raise UnusableInput(f"road radius: a {shape.kind} road needs one")
    if shape.kind == "straight" and shape.radius is not None:
        raise UnusableInput("road radius: a straight road has none")
    if shape.markings not in ("dashed", "solid", "none"):
        raise UnusableInput(f"road markings {shape.markings!r}: expected dashed, solid or none")
    if shape.lanes < 1 or length <= 0:
        raise UnusableInput(f"road of {shape.lanes} lanes and {length:g} m: expected at least one lane and some length")
    half = shape.lanes / 2 * shape.lane_width + shape.shoulder
    if shape.radius is not None and abs(shape.radius) < 1.5 * half:
        raise UnusableInput(f"road radius {shape.radius:g} m: expected more than 1.5 times its half width {half:g} m")
    if shape.crest_radius is not None and abs(shape.crest_radius) < length + 2 * ROAD_MARGIN_M:
        raise UnusableInput(
            f"crest radius {shape.crest_radius:g} m: expected more than {length + 2 * ROAD_MARGIN_M:g} m"
        )
