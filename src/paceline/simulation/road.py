"""Roads: axes in plan, and exact surfaces over them that slope and bank, with lanes and painted lines.

In plan x points east and y north, headings (rad) are counter-clockwise from x. Curvature (1/m) and lateral positions
(m) are positive to the right of growing arc length.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicHermiteSpline

from paceline.arrays import Array
from paceline.errors import UnusableInput

ROAD_KINDS = ("straight", "circle", "clothoid", "winding")
ROAD_MARGIN_M = 150.0  # m by which a road is known before its start and behind its end
POLYGON_STEP_M = 0.5  # m between the corners of a polygonal axis
_AXIS_STEP_M = 0.1  # m between the points that an integrated axis is interpolated from


class Axis(ABC):
    """The axis of a road in plan. It starts at the origin and there heads east."""

    @abstractmethod
    def curvature(self, s: Array | float) -> Array:
        """Curvature (…), 1/m, at arc lengths ``s`` (…), m."""

    @abstractmethod
    def pose(self, s: Array | float) -> tuple[Array, Array, Array]:
        """x, y (m) and the heading (rad), (…), at arc lengths ``s`` (…), m."""

    def frame(self, s: Array | float, lateral: Array | float = 0.0) -> tuple[Array, Array, Array]:
        """x, y (m) beside arc length ``s``, ``lateral`` metres to the right of the axis, and the axis's heading."""
        x, y, heading = self.pose(s)
        return x + lateral * np.sin(heading), y - lateral * np.cos(heading), heading

    def locate(self, x: Array | float, y: Array | float, near: Array | float = 0.0) -> tuple[Array, Array]:
        """Arc lengths and lateral positions (…), m, of points in plan, looked for from arc lengths ``near`` on."""
        s = near
        for _ in range(50):
            x0, y0, heading = self.pose(s)
            along = (x - x0) * np.cos(heading) + (y - y0) * np.sin(heading)
            s = s + along
            if np.abs(along).max() < 1e-6:
                break
        return np.asarray(s), (x - x0) * np.sin(heading) - (y - y0) * np.cos(heading)


class CircularAxis(Axis):
    """A circle, or a straight where its ``curvature`` is 0."""

    def __init__(self, curvature: float) -> None:
        self._curvature = curvature

    def curvature(self, s: Array | float) -> Array:
        return np.full(np.shape(s), self._curvature)

    def pose(self, s: Array | float) -> tuple[Array, Array, Array]:
        return *_arc_end(s, 0.0, -self._curvature), np.asarray(-self._curvature * s)

    def locate(self, x: Array | float, y: Array | float, near: Array | float = 0.0) -> tuple[Array, Array]:
        k = self._curvature
        if k == 0:
            return np.asarray(x), np.asarray(-y)
        radial = np.hypot(k * x, 1 + k * y)  # distance from the centre in radii
        return np.arctan2(k * x, 1 + k * y) / k, np.asarray(-(k * (x**2 + y**2) + 2 * y) / (1 + radial))


class IntegratedAxis(Axis):
    """An axis of any ``curvature``, a function of arc lengths (…) that is smooth but for kinks at 0 and ``length`` m.

    Heading and position are its integrals, off by well below a micrometre and known to `ROAD_MARGIN_M` beyond the ends.
    """

    def __init__(self, curvature: Callable[[Array], Array], length: float) -> None:
        self._curvature = curvature
        count = int(np.ceil(length / _AXIS_STEP_M))
        margin = int(np.ceil(ROAD_MARGIN_M * count / length))  # steps
        s = np.asarray(np.arange(-margin, count + margin + 1) * (length / count), float)
        heading = _integrate(curvature, s, margin)
        self._heading = CubicHermiteSpline(s, -heading, -curvature(s))
        self._position = CubicHermiteSpline(s, _integrate(self._tangent, s, margin), self._tangent(s))

    def _tangent(self, s: Array) -> Array:
        heading = self._heading(s)
        return np.stack([np.cos(heading), np.sin(heading)], -1)

    def curvature(self, s: Array | float) -> Array:
        return self._curvature(np.asarray(s, float))

    def pose(self, s: Array | float) -> tuple[Array, Array, Array]:
        position = self._position(s)
        return position[..., 0], position[..., 1], self._heading(s)


class PolygonalAxis(Axis):
    """An axis of ``length`` metres with a ``curvature`` (N,) at every `POLYGON_STEP_M`: a polygon, quick to look up.

    The heading turns evenly from corner to corner. Between them the curve lies beside it: 0.3 mm at a radius of 110 m.
    """

    def __init__(self, curvature: Array, length: float) -> None:
        self.s, self.length = np.asarray(POLYGON_STEP_M * np.arange(len(curvature)), float), length
        self._curvature, self._heading = curvature, -cumulative_trapezoid(curvature, dx=POLYGON_STEP_M, initial=0.0)
        middle = self._heading[:-1] + np.diff(self._heading) / 2
        self._x = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * POLYGON_STEP_M])
        self._y = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * POLYGON_STEP_M])

    def curvature(self, s: Array | float) -> Array:
        return np.asarray(np.interp(s, self.s, self._curvature))

    def pose(self, s: Array | float) -> tuple[Array, Array, Array]:
        return np.interp(s, self.s, self._x), np.interp(s, self.s, self._y), np.interp(s, self.s, self._heading)


@dataclass(frozen=True)
class RoadShape:
    """What a road looks like.

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
    """A road of ``length`` metres along an `Axis` in plan; in elevation it is straight or a circle.

    It starts at the world's origin. Arc length is that of its middle line in space; a surface point is given by it and
    by the lateral distance on the banked surface. Raises UnusableInput where the shape contradicts itself.
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
        self._middle = float(np.arctan(shape.grade))
        self.axis = self._make_axis()

    def _profile(self, s: Array | float) -> tuple[Array, Array, Array]:
        """Length in plan and height (m) from the start to ``s``, an arc of a circle, and the slope (rad) there."""
        start = self._middle - self._vertical * self.length / 2
        return *_arc_end(s, start, self._vertical), np.asarray(start + self._vertical * s)

    def _make_axis(self) -> Axis:
        kind, r = self.shape.kind, self.shape.radius
        if kind == "straight" or r is None:
            return CircularAxis(0.0)
        if kind == "circle":
            return CircularAxis(1 / r)
        length = float(self._profile(self.length)[0])
        if kind == "clothoid":
            return IntegratedAxis(lambda s: np.clip(s / length, 0, 1) / r, length)
        wavelength, phase, weight = _draw_curvature_waves(r, np.random.default_rng([self.seed, 31]))
        return IntegratedAxis(
            lambda s: (weight * np.sin(2 * np.pi * s[..., None] / wavelength + phase)).sum(-1) / r, length
        )

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
        plan, height, slope = self._profile(s)
        x, y, heading = self.axis.pose(plan)
        c, n, z = np.cos(heading), np.sin(heading), np.zeros_like(heading)
        cb, sb = np.cos(self.shape.bank), np.sin(self.shape.bank)
        cs, sn = np.cos(slope), np.sin(slope)
        turning, bending = -self.axis.curvature(plan) * cs, self._vertical
        T = np.stack([cs * c, cs * n, sn], -1)
        level = np.stack([-n, c, z], -1)  # left, without the bank
        up = np.stack([-sn * c, -sn * n, cs], -1)
        left = cb * level + sb * up
        d_level = -turning[..., None] * np.stack([c, n, z], -1)
        d_up = -bending * T - (turning * sn)[..., None] * level
        along = T - lateral[..., None] * (cb * d_level + sb * d_up)
        return np.stack([x, y, height], -1) - lateral[..., None] * left, along, left

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


def _arc_end(length: Array | float, heading: float, turning: float) -> tuple[Array, Array]:
    """x, y of the end of an arc of a circle that starts at the origin with a ``heading`` and turns by ``turning`` rad/m
    counter-clockwise."""
    chord, middle = length * np.sinc(turning * length / (2 * np.pi)), heading + turning * length / 2
    return np.asarray(chord * np.cos(middle)), np.asarray(chord * np.sin(middle))


def _integrate(f: Callable[[Array], Array], s: Array, origin: int) -> Array:
    """The integral of ``f`` from ``s[origin]`` to each of ``s`` (N,), equally far apart, by Simpson's rule."""
    parts = (s[1] - s[0]) / 6 * (f(s[:-1]) + 4 * f((s[:-1] + s[1:]) / 2) + f(s[1:]))
    integral = np.concatenate([np.zeros_like(parts[:1]), np.cumsum(parts, axis=0)])
    return np.asarray(integral - integral[origin])


def _draw_curvature_waves(radius: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Wavelengths (m), phases and weights of a winding road's curvature, whose peak is 1 at most."""
    scale = 6 * np.sqrt(abs(radius))  # tighter roads wind faster: about 85 m at 200 m
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
