"""Lines matched between the views: the road's surface is where both views put every line in the same place.

For a view, raising the surface by dh moves what it shows there over the ground, towards the camera, by dh times the
distance over the camera's height; across the road the two views then differ by dh·(baseline across the road)/(height).
So every line that runs across the baseline measures the height below it, and one that runs along it, as an epipolar
line does, none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.lanes.inverse_perspective import pixel_size
from paceline.lanes.line_detection import DEGREE, STRAY, TERMS, UNIT, Trace, along
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_surface import Surface

PIXEL = 0.15  # px, the noise of a measured stretch of paint
EDGE = 0.01  # m, how raggedly paint is laid and worn
FIRST_GUESS = np.array([0.15, 0.6, 0.4, 2.0, 0.6, 0.6])  # m at 30 m by which the first surface may be wrong
PARALLEL = np.array([0.12, 0.06, 0.04])  # m at 30 m by which the lines of one road depart from each other
GRAZING = 0.2  # m of descent below which a ray only skims the road
FREE = 30.0  # m: no constraint
ROUNDS = 4
HUBER = 2.0  # standard deviations
LEVEL = 0.18  # m of height within which the lines of one road lie against the first surface
ELEVATED = 0.10  # m from the road's surface: what lies farther from it is no marking
LEAST_TOLD = 0.15  # m, the standard deviation of a height that tells nothing


@dataclass(frozen=True, eq=False)
class Road:
    """Lines on one surface. ``curves`` (K, 5) are the lines' polynomials in road coordinates of ``course``;
    ``covariance`` (6 + 5K, 6 + 5K) is that of the surface's heights and of the curves; ``misfit`` is how many times the
    measured stretches scatter more than expected."""

    surface: Surface
    course: Alignment
    lines: tuple[Trace, ...]
    curves: Array
    covariance: Array
    misfit: float

    @property
    def common_course(self) -> Alignment:
        """The course with what all lines deviate from it in common."""
        return replace(self.course, deviation=self.course.deviation + [0.0, *self.curves[:, 1:].mean(0)])


@dataclass(frozen=True, eq=False)
class Observations:
    """N measured stretches: pixels (N, 2) seen from ``side`` (N,) on the line of index ``line`` (N,)."""

    pixels: Array
    side: NDArray[np.int64]
    line: NDArray[np.int64]

    @classmethod
    def of(cls, lines: list[Trace]) -> Observations:
        parts = [(p, side, k) for k, line in enumerate(lines) for side, p in enumerate((line.left, line.right))]
        return cls(
            np.concatenate([p for p, _, _ in parts]),
            np.concatenate([np.full(len(p), side) for p, side, _ in parts]),
            np.concatenate([np.full(len(p), k) for p, _, k in parts]),
        )

    def on(self, rig: StereoRig, surface: Surface, course: Alignment) -> tuple[Array, Array]:
        """Road coordinates s and d (N,) on a surface."""
        ground = np.empty_like(self.pixels)
        for side in (0, 1):
            mine = self.side == side
            ground[mine] = surface.seen_at(rig, side, self.pixels[mine])
        return course.from_ground(ground)


def match(rig: StereoRig, first: Surface, course: Alignment, lines: list[Trace]) -> Road | None:
    """The road on which the ``lines`` lie, without those that lie above or below it; None where no line tells its
    height.

    By their parallax against the ``first`` surface most of the paint lies at one height; guard rails, their shadows on
    the verge and the tops of posts at others. Once the road is fitted its own lines are judged again.
    """
    heights = np.array([_elevation(rig, first, course, line, line.curve) for line in lines])
    lines = [line for line, height in zip(lines, heights, strict=True) if np.isfinite(height)]
    heights = heights[np.isfinite(heights)]
    if not lines:
        return None
    amount = np.array([len(line.left) + len(line.right) for line in lines])
    within = np.abs(heights[:, None] - heights) <= LEVEL / 2
    middle = int(np.argmax((within * amount).sum(1) - np.abs(heights)))
    kept = [line for line, near in zip(lines, within[middle], strict=True) if near]
    road = _fitted(rig, first, course, kept)
    off = np.array([_elevation(rig, road.surface, course, line, c) for line, c in zip(kept, road.curves, strict=True)])
    level = [line for line, height in zip(kept, off, strict=True) if abs(height - np.median(off)) <= ELEVATED]
    return _fitted(rig, first, course, level) if 2 <= len(level) < len(kept) else road


def _fitted(rig: StereoRig, first: Surface, course: Alignment, lines: list[Trace]) -> Road:
    """Gauss–Newton over the surface's heights, the course's deviation and the lines' own curves at once, robust against
    single stretches. The course may change freely, as on another surface it looks different; the lines of a road are
    parallel but for `PARALLEL`."""
    seen = Observations.of(lines)
    count = 6 + TERMS - 1 + (DEGREE + 1) * len(lines)
    spread = np.concatenate([FIRST_GUESS, np.full(TERMS - 1, FREE), np.tile([FREE, *PARALLEL], len(lines))])
    surface, expected = first, np.concatenate([first.heights, np.zeros(count - 6)])
    weight, own = np.ones(len(seen.line)), 5 + TERMS + (DEGREE + 1) * seen.line
    for _ in range(ROUNDS):
        s, d = seen.on(rig, surface, course)
        usable = np.isfinite(s) & np.isfinite(d)
        s, d = np.where(usable, s, 0.0), np.where(usable, d, 0.0)
        sigma = _noise(rig, surface, course, s)
        rise = _across_per_height(rig, surface, course, s, d, seen.side)
        J = np.zeros((len(s), count))
        J[:, :6] = -rise[:, None] * surface.basis(course.to_ground(s, d))
        powers = (s[:, None] / UNIT) ** np.arange(TERMS)
        J[:, 6 : 5 + TERMS] = powers[:, 1:]
        for j in range(DEGREE + 1):
            J[np.arange(len(s)), own + j] = powers[:, j]
        target = d + J[:, :6] @ surface.heights  # linear about these heights
        W = usable * weight / sigma**2
        information = (J * W[:, None]).T @ J
        right = (J * W[:, None]).T @ target + expected / spread**2
        x = np.asarray(np.linalg.solve(information + np.diag(spread**-2), right))
        surface = surface.with_heights(x[:6])
        miss = np.abs(target - J @ x) / sigma
        scale = max(1.0, float(np.median(miss[usable])) / 0.6745)
        weight = np.minimum(1.0, HUBER * scale / np.maximum(miss, 1e-9))
    free = max(1.0, usable.sum() - (DEGREE + 1) * len(lines))
    misfit = max(1.0, float(np.sqrt((weight * miss**2)[usable].sum() / free)))
    known = np.linalg.inv(information / misfit**2 + np.diag(spread**-2))
    to_curves = _curves_of(len(lines), count)
    covariance: Array = np.asarray(to_curves @ known @ to_curves.T, np.float64)
    curves = np.asarray((to_curves @ x)[6:].reshape(len(lines), TERMS))
    return Road(surface, course, tuple(lines), curves, covariance, misfit)


def _curves_of(lines: int, count: int) -> Array:
    """The matrix that takes (heights, deviation, own curves) to (heights, whole curves)."""
    M = np.zeros((6 + TERMS * lines, count))
    M[:6, :6] = np.eye(6)
    for k in range(lines):
        M[7 + TERMS * k : 6 + TERMS * (k + 1), 6 : 5 + TERMS] = np.eye(TERMS - 1)
        own = 5 + TERMS + (DEGREE + 1) * k
        M[6 + TERMS * k : 7 + TERMS * k + DEGREE, own : own + DEGREE + 1] = np.eye(DEGREE + 1)
    return M


def _noise(rig: StereoRig, surface: Surface, course: Alignment, s: Array) -> Array:
    """Standard deviations (N,) m across of measured stretches at ``s`` (N,)."""
    return np.hypot(PIXEL * pixel_size(rig, surface, course, s, 0.0)[:, 1], EDGE)


def _across_per_height(
    rig: StereoRig, surface: Surface, course: Alignment, s: Array, d: Array, side: NDArray[np.int64]
) -> Array:
    """∂d/∂h (N,): by how much what a view shows moves to the right when the surface is raised by 1 m."""
    ground = course.to_ground(s, d)
    local = (rig.centres[side] - surface.origin) @ surface.axes
    above = local[:, 1] - surface.basis(ground) @ surface.heights
    away = ground - local[:, [0, 2]]
    descent = above + (surface.slopes(ground) * away).sum(1)  # of the ray towards the surface, over the way to it
    return np.asarray(-(away * course.across(s)).sum(1) / np.maximum(descent, GRAZING))


def _elevation(rig: StereoRig, surface: Surface, course: Alignment, line: Trace, curve: Array) -> float:
    """Height of a line, which runs about along ``curve``, above ``surface`` in metres, by its parallax; infinite where
    it has none that tells."""
    seen = Observations.of([line])
    s, d = seen.on(rig, surface, course)
    usable = np.isfinite(s)
    if usable.sum() < DEGREE + 3:
        return np.inf
    s, d, side = s[usable], d[usable], seen.side[usable]
    sigma = _noise(rig, surface, course, s)
    rise = _across_per_height(rig, surface, course, s, d, side)
    J = np.column_stack([-rise, (s[:, None] / UNIT) ** np.arange(DEGREE + 1)]) / sigma[:, None]
    covariance = np.linalg.pinv(J.T @ J + np.diag([0.0, 0.0, *STRAY**-2]))
    if covariance[0, 0] > LEAST_TOLD**2:
        return np.inf
    return float((covariance @ J.T @ ((d - along(curve, s)) / sigma))[0])
