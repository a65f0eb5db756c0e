"""Least-squares adjustment of lines and road surface: on the surface both views give every line the same position.

If the surface is raised by dh, each view's image of it moves over the ground towards its camera, by dh times the
distance over the camera's height; across the road the two views then differ by dh·(baseline across the road)/(height).
So every line that runs across the baseline measures the height below it; one that runs along it, like an epipolar line,
does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.lanes.inverse_perspective import pixel_size
from paceline.lanes.line_detection import (
    CURVE_PRIOR_STD,
    CURVE_TERMS,
    DETECTION_DEGREE,
    UNIT_M,
    LaneLine,
    lateral_offset,
)
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_surface import RoadSurface

PAINT_STD_PX = 0.15  # standard deviation of a measured stretch of paint by image noise,
PAINT_STD_M = 0.01  # and by the irregularity of paint as it is applied and worn
SURFACE_PRIOR_STD_M = np.array([0.15, 0.6, 0.4, 2.0, 0.6, 0.6])  # at 30 m, of the initial surface's heights
PARALLEL_STD_M = np.array([0.12, 0.06, 0.04])  # at 30 m, of the terms by which the lines of a road differ
MIN_DESCENT_M = 0.2  # least descent of a ray per metre, below which it is nearly parallel to the road
UNCONSTRAINED_STD_M = 30.0  # standard deviation that means no constraint
GAUSS_NEWTON_STEPS = 4
HUBER_SIGMA = 2.0
LEVEL_RANGE_M = 0.18  # of the heights of one road's lines above the initial surface
MAX_ELEVATION_M = 0.10  # greatest height of a marking above the road's surface
MAX_HEIGHT_STD_M = 0.15  # standard deviation above which the height of a line is unknown


@dataclass(frozen=True, eq=False)
class RoadModel:
    """Lines on one surface. ``curves`` (K, 5) are the lines' polynomials in road coordinates of ``alignment``;
    ``covariance`` (6 + 5K, 6 + 5K) is that of the surface's heights and of the curves; ``misfit`` is how many times the
    measured stretches scatter more than expected."""

    surface: RoadSurface
    alignment: Alignment
    lines: tuple[LaneLine, ...]
    curves: Array
    covariance: Array
    misfit: float

    @property
    def common_alignment(self) -> Alignment:
        """The alignment, with the mean deviation of all lines added."""
        return replace(self.alignment, deviation=self.alignment.deviation + [0.0, *self.curves[:, 1:].mean(0)])


@dataclass(frozen=True, eq=False)
class Observations:
    """N measured stretches: pixels (N, 2) seen from ``side`` (N,) on the line of index ``line`` (N,)."""

    pixels: Array
    side: NDArray[np.int64]
    line: NDArray[np.int64]

    @classmethod
    def of(cls, lines: list[LaneLine]) -> Observations:
        parts = [(p, side, k) for k, line in enumerate(lines) for side, p in enumerate((line.left, line.right))]
        return cls(
            np.concatenate([p for p, _, _ in parts]),
            np.concatenate([np.full(len(p), side) for p, side, _ in parts]),
            np.concatenate([np.full(len(p), k) for p, _, k in parts]),
        )

    def road_coordinates(self, rig: StereoRig, surface: RoadSurface, alignment: Alignment) -> tuple[Array, Array]:
        """Road coordinates s and d (N,) on a surface."""
        ground = np.empty_like(self.pixels)
        for side in (0, 1):
            in_view = self.side == side
            ground[in_view] = surface.ground_at(rig, side, self.pixels[in_view])
        return alignment.from_ground(ground)


def adjust(rig: StereoRig, first: RoadSurface, alignment: Alignment, lines: list[LaneLine]) -> RoadModel | None:
    """The road with those of the ``lines`` that are on its surface; None where the height
    of no line is known.

    By their parallax relative to the ``first`` surface most of the paint lies at one height; guard rails, their shadows
    on the verge and the tops of posts at others. The lines are checked again against the fitted surface.
    """
    heights = np.array([_elevation(rig, first, alignment, line, line.curve) for line in lines])
    lines = [line for line, height in zip(lines, heights, strict=True) if np.isfinite(height)]
    heights = heights[np.isfinite(heights)]
    if not lines:
        return None
    amount = np.array([len(line.left) + len(line.right) for line in lines])
    within = np.abs(heights[:, None] - heights) <= LEVEL_RANGE_M / 2
    middle = int(np.argmax((within * amount).sum(1) - np.abs(heights)))
    candidates = [line for line, is_near in zip(lines, within[middle], strict=True) if is_near]
    road = _gauss_newton(rig, first, alignment, candidates)
    elevations = np.array(
        [_elevation(rig, road.surface, alignment, line, c) for line, c in zip(candidates, road.curves, strict=True)]
    )
    level = [
        line
        for line, height in zip(candidates, elevations, strict=True)
        if abs(height - np.median(elevations)) <= MAX_ELEVATION_M
    ]
    return _gauss_newton(rig, first, alignment, level) if 2 <= len(level) < len(candidates) else road


def _gauss_newton(rig: StereoRig, first: RoadSurface, alignment: Alignment, lines: list[LaneLine]) -> RoadModel:
    """Gauss–Newton over the surface's heights, the alignment's deviation and the lines' own curves at once, robust
    against single stretches. The alignment may change freely, as on another surface it looks different; the lines of a
    road are parallel but for `PARALLEL`."""
    observations = Observations.of(lines)
    count = 6 + CURVE_TERMS - 1 + (DETECTION_DEGREE + 1) * len(lines)
    spread = np.concatenate(
        [
            SURFACE_PRIOR_STD_M,
            np.full(CURVE_TERMS - 1, UNCONSTRAINED_STD_M),
            np.tile([UNCONSTRAINED_STD_M, *PARALLEL_STD_M], len(lines)),
        ]
    )
    surface, expected = first, np.concatenate([first.heights, np.zeros(count - 6)])
    weight, first_column = np.ones(len(observations.line)), 5 + CURVE_TERMS + (DETECTION_DEGREE + 1) * observations.line
    for _ in range(GAUSS_NEWTON_STEPS):
        s, d = observations.road_coordinates(rig, surface, alignment)
        usable = np.isfinite(s) & np.isfinite(d)
        s, d = np.where(usable, s, 0.0), np.where(usable, d, 0.0)
        sigma = _segment_std(rig, surface, alignment, s)
        rise = _shift_per_height(rig, surface, alignment, s, d, observations.side)
        J = np.zeros((len(s), count))
        J[:, :6] = -rise[:, None] * surface.basis(alignment.to_ground(s, d))
        powers = (s[:, None] / UNIT_M) ** np.arange(CURVE_TERMS)
        J[:, 6 : 5 + CURVE_TERMS] = powers[:, 1:]
        for j in range(DETECTION_DEGREE + 1):
            J[np.arange(len(s)), first_column + j] = powers[:, j]
        target = d + J[:, :6] @ surface.heights  # linear about these heights
        W = usable * weight / sigma**2
        information = (J * W[:, None]).T @ J
        right = (J * W[:, None]).T @ target + expected / spread**2
        x = np.asarray(np.linalg.solve(information + np.diag(spread**-2), right))
        surface = surface.with_heights(x[:6])
        residuals = np.abs(target - J @ x) / sigma
        scale = max(1.0, float(np.median(residuals[usable])) / 0.6745)
        weight = np.minimum(1.0, HUBER_SIGMA * scale / np.maximum(residuals, 1e-9))
    free = max(1.0, usable.sum() - (DETECTION_DEGREE + 1) * len(lines))
    misfit = max(1.0, float(np.sqrt((weight * residuals**2)[usable].sum() / free)))
    known = np.linalg.inv(information / misfit**2 + np.diag(spread**-2))
    to_curves = _curve_map(len(lines), count)
    covariance: Array = np.asarray(to_curves @ known @ to_curves.T, np.float64)
    curves = np.asarray((to_curves @ x)[6:].reshape(len(lines), CURVE_TERMS))
    return RoadModel(surface, alignment, tuple(lines), curves, covariance, misfit)


def _curve_map(lines: int, count: int) -> Array:
    """The matrix that takes (heights, deviation, own curves) to (heights, whole curves)."""
    M = np.zeros((6 + CURVE_TERMS * lines, count))
    M[:6, :6] = np.eye(6)
    for k in range(lines):
        M[7 + CURVE_TERMS * k : 6 + CURVE_TERMS * (k + 1), 6 : 5 + CURVE_TERMS] = np.eye(CURVE_TERMS - 1)
        first_column = 5 + CURVE_TERMS + (DETECTION_DEGREE + 1) * k
        M[
            6 + CURVE_TERMS * k : 7 + CURVE_TERMS * k + DETECTION_DEGREE,
            first_column : first_column + DETECTION_DEGREE + 1,
        ] = np.eye(DETECTION_DEGREE + 1)
    return M


def _segment_std(rig: StereoRig, surface: RoadSurface, alignment: Alignment, s: Array) -> Array:
    """Standard deviations (N,) m across of measured stretches at ``s`` (N,)."""
    return np.hypot(PAINT_STD_PX * pixel_size(rig, surface, alignment, s, 0.0)[:, 1], PAINT_STD_M)


def _shift_per_height(
    rig: StereoRig, surface: RoadSurface, alignment: Alignment, s: Array, d: Array, side: NDArray[np.int64]
) -> Array:
    """∂d/∂h (N,): shift of a view's samples to the right per metre by which the surface is raised."""
    ground = alignment.to_ground(s, d)
    local = (rig.centres[side] - surface.origin) @ surface.axes
    above = local[:, 1] - surface.basis(ground) @ surface.heights
    from_camera = ground - local[:, [0, 2]]
    descent = above + (surface.slopes(ground) * from_camera).sum(
        1
    )  # of the ray towards the surface, over the way to it
    return np.asarray(-(from_camera * alignment.lateral_axis(s)).sum(1) / np.maximum(descent, MIN_DESCENT_M))


def _elevation(rig: StereoRig, surface: RoadSurface, alignment: Alignment, line: LaneLine, curve: Array) -> float:
    """Height of a line, which runs about along ``curve``, above ``surface`` in metres, from its parallax; infinite
    where this does not determine it."""
    observations = Observations.of([line])
    s, d = observations.road_coordinates(rig, surface, alignment)
    usable = np.isfinite(s)
    if usable.sum() < DETECTION_DEGREE + 3:
        return np.inf
    s, d, side = s[usable], d[usable], observations.side[usable]
    sigma = _segment_std(rig, surface, alignment, s)
    rise = _shift_per_height(rig, surface, alignment, s, d, side)
    J = np.column_stack([-rise, (s[:, None] / UNIT_M) ** np.arange(DETECTION_DEGREE + 1)]) / sigma[:, None]
    covariance = np.linalg.pinv(J.T @ J + np.diag([0.0, 0.0, *CURVE_PRIOR_STD**-2]))
    if covariance[0, 0] > MAX_HEIGHT_STD_M**2:
        return np.inf
    return float((covariance @ J.T @ ((d - lateral_offset(curve, s)) / sigma))[0])
