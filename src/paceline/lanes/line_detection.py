"""Detection of painted lines in the rectified road: a line is much paint along one smooth curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_direction import DirectionVotes
from paceline.lanes.road_rectification import HALF_WIDTH_M, RectifiedRoad
from paceline.lanes.road_surface import RoadSurface

UNIT_M = 30.0  # of s at which each term of a line's polynomial is 1
DETECTION_DEGREE = 3  # of the polynomial in the detection,
CURVE_TERMS = 5  # number of its terms in the adjustment
# standard deviations, m at `UNIT_M`, of a line's slope, bend and third term relative to the road's alignment
CURVE_PRIOR_STD = np.array([0.3, 0.2, 0.1])
BIN_M = 0.05  # bin width of the histogram over d
SMOOTHING_BINS = 5
GATES_M = (0.5, 0.4, 0.3, 0.25, 0.2, 0.15, 0.15)  # distance from a line within which paint is used, by iteration
MIN_LINE_SPACING_M = 0.45  # a double line is one
MIN_PAINT_M = 4.0  # least length of paint in each view
MIN_SPAN_M = 12.0  # least distance from a line's first paint to its last
MIN_PAINT_RATIO = 3.0  # least ratio of the paint on a line to that beside it
MIN_SOLID_SHARE = 0.65  # painted share of a line's visible length above which it is solid
MIN_SEGMENT_PX, MIN_SEGMENT_M, MAX_SEGMENT_M = 14.0, 1.5, 4.5  # length of a stretch that is measured as one
MAX_LINES = 24


@dataclass(frozen=True, eq=False)
class PaintSamples:
    """Paint found in one view: ``s`` and ``d`` (N,) of each sample and the ``length`` (N,) m along the road that it
    represents."""

    s: Array
    d: Array
    length: Array


@dataclass(frozen=True, eq=False)
class LaneLine:
    """One line in both views. ``curve`` (4,) are the coefficients of d over s / `UNIT_M`; ``left`` and ``right`` are
    its measured pixels (N, 2) and (M, 2), from near to far, each the mean of a short stretch; ``painted_share`` is that
    of the visible length that is painted, ``span`` the s between which both views show it."""

    curve: Array
    left: Array
    right: Array
    painted_share: float
    span: tuple[float, float]

    @property
    def kind(self) -> str:
        return "solid" if self.painted_share >= MIN_SOLID_SHARE else "broken"


def lateral_offset(curve: Array, s: Array) -> Array:
    """d (…) of a line at ``s`` (…)."""
    return np.asarray(np.polynomial.polynomial.polyval(np.asarray(s) / UNIT_M, curve))


def paint_samples(road: RectifiedRoad) -> PaintSamples:
    row, column = np.nonzero(road.is_paint)
    return PaintSamples(road.s[row], road.paint_offsets(row, column), road.step[row])


def direction_votes(roads: tuple[RectifiedRoad, RectifiedRoad], alignment: Alignment) -> DirectionVotes:
    """The paint in both views, ``roads``, as votes for the road's direction."""
    samples = [paint_samples(road) for road in roads]
    s, d, length = (np.concatenate(parts) for parts in zip(*((h.s, h.d, h.length) for h in samples), strict=True))
    return DirectionVotes(alignment.to_ground(s, d), alignment.direction(s), length)


def detect_lines(
    rig: StereoRig, surface: RoadSurface, alignment: Alignment, roads: tuple[RectifiedRoad, RectifiedRoad]
) -> list[LaneLine]:
    """The lines that both views show, from left to right."""
    views = [paint_samples(road) for road in roads]
    both = PaintSamples(*(np.concatenate([getattr(h, name) for h in views]) for name in ("s", "d", "length")))
    curves: list[Array] = []
    for start in _peaks(both):
        curve = _fit_curve(both, start)
        s = both.s[np.abs(both.d - lateral_offset(curve, both.s)) < GATES_M[-1]]
        if all(
            np.median(np.abs(lateral_offset(curve, s) - lateral_offset(other, s))) > MIN_LINE_SPACING_M
            for other in curves
        ) and len(s):
            curves.append(curve)
    lines = []
    for curve in curves:
        if all(_is_line(h, curve) for h in views):
            left, right = (_segment_pixels(rig, surface, alignment, side, views[side], curve) for side in (0, 1))
            if min(len(left), len(right)) >= 3:
                lines.append(LaneLine(curve, left, right, _painted_share(roads, views, curve), _span(views, curve)))
    return sorted(lines, key=lambda line: line.curve[0])


def _peaks(samples: PaintSamples) -> list[float]:
    """d of the peaks of the histogram of paint, the highest first."""
    cells = int(2 * HALF_WIDTH_M / BIN_M)
    count = np.bincount(np.clip(((samples.d + HALF_WIDTH_M) / BIN_M).astype(int), 0, cells - 1), samples.length, cells)
    smooth = uniform_filter1d(count, SMOOTHING_BINS, mode="constant") * SMOOTHING_BINS
    peaks = []
    for _ in range(MAX_LINES):
        top = int(np.argmax(smooth))
        if smooth[top] < MIN_PAINT_M:
            break
        peaks.append((top + 0.5) * BIN_M - HALF_WIDTH_M)
        reach = round(MIN_LINE_SPACING_M / 2 / BIN_M)
        smooth[max(0, top - reach) : top + reach + 1] = 0.0
    return peaks


def _fit_curve(samples: PaintSamples, start: float) -> Array:
    curve = np.array([start, *np.zeros(DETECTION_DEGREE)])
    powers = (samples.s[:, None] / UNIT_M) ** np.arange(DETECTION_DEGREE + 1)
    prior = np.diag([0.0, *CURVE_PRIOR_STD**-2])
    for reach in GATES_M:
        residuals = np.abs(samples.d - powers @ curve)
        weight = samples.length * np.maximum(1 - (residuals / reach) ** 2, 0.0) ** 2
        # a metre of paint locates the line to about a fifth of the gate
        information = (powers * weight[:, None]).T @ powers / (0.2 * reach) ** 2
        curve = np.linalg.lstsq(
            information + prior, (powers * weight[:, None]).T @ samples.d / (0.2 * reach) ** 2, rcond=None
        )[0]
    return curve


def _is_line(samples: PaintSamples, curve: Array) -> bool:
    """Whether one view has enough paint along ``curve``, over a long enough stretch, and much more than beside it."""
    offsets = np.abs(samples.d - lateral_offset(curve, samples.s))
    inliers = offsets < GATES_M[-1]
    if samples.length[inliers].sum() < MIN_PAINT_M or np.ptp(samples.s[inliers]) < MIN_SPAN_M:
        return False
    first, last = samples.s[inliers].min(), samples.s[inliers].max()
    at_sides = (offsets > 2 * GATES_M[-1]) & (offsets < 5 * GATES_M[-1]) & (samples.s >= first) & (samples.s <= last)
    return bool(samples.length[inliers].sum() > MIN_PAINT_RATIO * samples.length[at_sides].sum() / 3)


def _span(views: list[PaintSamples], curve: Array) -> tuple[float, float]:
    inlier_positions = [
        samples.s[np.abs(samples.d - lateral_offset(curve, samples.s)) < GATES_M[-1]] for samples in views
    ]
    return max(float(s.min()) for s in inlier_positions), min(float(s.max()) for s in inlier_positions)


def _painted_share(roads: tuple[RectifiedRoad, RectifiedRoad], views: list[PaintSamples], curve: Array) -> float:
    """Share of the line's length, where a view shows the road there, that is painted; of the view that shows more."""
    shares = []
    for road, samples in zip(roads, views, strict=True):
        inliers = np.abs(samples.d - lateral_offset(curve, samples.s)) < GATES_M[-1]
        column = np.searchsorted(road.d, lateral_offset(curve, road.s)).clip(0, len(road.d) - 1)
        inside = (road.s >= samples.s[inliers].min()) & (road.s <= samples.s[inliers].max())
        length = float(road.step[inside & road.visible[np.arange(len(road.s)), column]].sum())
        shares.append(float(samples.length[inliers].sum()) / max(length, 1e-6))
    return min(1.0, max(shares))


def _segment_pixels(
    rig: StereoRig, surface: RoadSurface, alignment: Alignment, side: int, samples: PaintSamples, curve: Array
) -> Array:
    """Pixels (N, 2) of a line in a view, near to far: its paint's means over stretches of at least `MIN_SEGMENT_PX` and
    `MIN_SEGMENT_M`."""
    inliers = np.abs(samples.d - lateral_offset(curve, samples.s)) < GATES_M[-1]
    order = np.argsort(samples.s[inliers])
    s, d, length = (values[inliers][order] for values in (samples.s, samples.d, samples.length))
    points = surface.points(alignment.to_ground(s, d))
    pixels = rig.cameras[side].project(points if side == 0 else rig.to_right(points))
    segments, first = [], 0
    for k in range(1, len(s) + 1):
        if k < len(s):
            length_px, metres = np.linalg.norm(pixels[k] - pixels[first]), s[k] - s[first]
            if metres < MIN_SEGMENT_M or (length_px < MIN_SEGMENT_PX and metres < MAX_SEGMENT_M):
                continue
        in_segment = slice(first, k)
        offsets = d[in_segment] - lateral_offset(curve, s[in_segment])
        scatter = np.abs(offsets - np.median(offsets))
        consistent = scatter < 0.06 + 3 * np.median(scatter)
        if consistent.sum() >= 2:
            middle = np.asarray(np.average(s[in_segment], weights=length[in_segment] * consistent))
            segments.append(
                (middle, lateral_offset(curve, middle) + np.average(offsets, weights=length[in_segment] * consistent))
            )
        first = k
    middles = np.array(segments).reshape(-1, 2)
    points = surface.points(alignment.to_ground(middles[:, 0], middles[:, 1]))
    return rig.cameras[side].project(points if side == 0 else rig.to_right(points))
