"""Lines of paint in the unrolled road: where it stands out again and again along one slow curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_direction import Votes
from paceline.lanes.road_rectification import REACH, Strip
from paceline.lanes.road_surface import Surface

UNIT = 30.0  # m of s in which a line's polynomial counts
DEGREE = 3  # of it, while it is traced
TERMS = 5  # of it, once it is matched
STRAY = np.array([0.3, 0.2, 0.1])  # m by which a line's slope, bend and third term depart from the course's, at UNIT
CELL = 0.05  # m of the histogram over d
SMOOTHING = 5  # of its cells
NARROWING = (0.5, 0.4, 0.3, 0.25, 0.2, 0.15, 0.15)  # m from a line within which paint is gathered, round by round
APART = 0.45  # m between lines: a double line is one
LEAST_PAINT = 4.0  # m in each view
LEAST_SPAN = 12.0  # m from a line's first paint to its last
ABOVE_CHANCE = 3.0  # times the paint found beside it
SOLID = 0.65  # share of a line's visible length that is painted where it counts as solid
BLOCK = 14.0, 1.5  # px and m along, at least, that are measured as one
LONGEST_BLOCK = 4.5  # m
MOST_LINES = 24


@dataclass(frozen=True, eq=False)
class Hits:
    """Paint found in one view: ``s``, ``d`` (N,) of each place and the ``length`` (N,) m it stands for."""

    s: Array
    d: Array
    length: Array


@dataclass(frozen=True, eq=False)
class Trace:
    """One line in both views. ``curve`` (4,) are the coefficients of d over s / UNIT; ``left`` and ``right`` are its
    measured pixels (N, 2) and (M, 2), from near to far, each the mean of a short stretch; ``painted`` is the share of
    the visible length that is painted, ``span`` the s between which both views show it."""

    curve: Array
    left: Array
    right: Array
    painted: float
    span: tuple[float, float]

    @property
    def kind(self) -> str:
        return "solid" if self.painted >= SOLID else "broken"


def along(curve: Array, s: Array) -> Array:
    """d (…) of a line at ``s`` (…)."""
    return np.asarray(np.polynomial.polynomial.polyval(np.asarray(s) / UNIT, curve))


def hits_of(strip: Strip) -> Hits:
    row, column = np.nonzero(strip.stands_out)
    return Hits(strip.s[row], strip.places(row, column), strip.step[row])


def as_votes(strips: tuple[Strip, Strip], course: Alignment) -> Votes:
    """The paint of both strips as votes for the course."""
    hits = [hits_of(strip) for strip in strips]
    s, d, length = (np.concatenate(parts) for parts in zip(*((h.s, h.d, h.length) for h in hits), strict=True))
    return Votes(course.to_ground(s, d), course.direction(s), length)


def trace(rig: StereoRig, surface: Surface, course: Alignment, strips: tuple[Strip, Strip]) -> list[Trace]:
    """The lines that both views show, from left to right."""
    views = [hits_of(strip) for strip in strips]
    both = Hits(*(np.concatenate([getattr(h, name) for h in views]) for name in ("s", "d", "length")))
    curves: list[Array] = []
    for start in _peaks(both):
        curve = _gathered(both, start)
        s = both.s[np.abs(both.d - along(curve, both.s)) < NARROWING[-1]]
        if all(np.median(np.abs(along(curve, s) - along(other, s))) > APART for other in curves) and len(s):
            curves.append(curve)
    found = []
    for curve in curves:
        if all(_is_line(h, curve) for h in views):
            left, right = (_blocks(rig, surface, course, side, views[side], curve) for side in (0, 1))
            if min(len(left), len(right)) >= 3:
                found.append(Trace(curve, left, right, _painted(strips, views, curve), _span(views, curve)))
    return sorted(found, key=lambda line: line.curve[0])


def _peaks(hits: Hits) -> list[float]:
    """d of the histogram's peaks, the greatest first."""
    cells = int(2 * REACH / CELL)
    count = np.bincount(np.clip(((hits.d + REACH) / CELL).astype(int), 0, cells - 1), hits.length, cells)
    smooth = uniform_filter1d(count, SMOOTHING, mode="constant") * SMOOTHING
    peaks = []
    for _ in range(MOST_LINES):
        top = int(np.argmax(smooth))
        if smooth[top] < LEAST_PAINT:
            break
        peaks.append((top + 0.5) * CELL - REACH)
        reach = round(APART / 2 / CELL)
        smooth[max(0, top - reach) : top + reach + 1] = 0.0
    return peaks


def _gathered(hits: Hits, start: float) -> Array:
    curve = np.array([start, *np.zeros(DEGREE)])
    powers = (hits.s[:, None] / UNIT) ** np.arange(DEGREE + 1)
    prior = np.diag([0.0, *STRAY**-2])
    for reach in NARROWING:
        aside = np.abs(hits.d - powers @ curve)
        weight = hits.length * np.maximum(1 - (aside / reach) ** 2, 0.0) ** 2
        # a metre of paint says where the line is to about a fifth of the reach
        information = (powers * weight[:, None]).T @ powers / (0.2 * reach) ** 2
        curve = np.linalg.lstsq(
            information + prior, (powers * weight[:, None]).T @ hits.d / (0.2 * reach) ** 2, rcond=None
        )[0]
    return curve


def _is_line(hits: Hits, curve: Array) -> bool:
    """Whether one view has enough paint along ``curve``, over a long enough stretch, and much more than beside it."""
    aside = np.abs(hits.d - along(curve, hits.s))
    on = aside < NARROWING[-1]
    if hits.length[on].sum() < LEAST_PAINT or np.ptp(hits.s[on]) < LEAST_SPAN:
        return False
    first, last = hits.s[on].min(), hits.s[on].max()
    beside = (aside > 2 * NARROWING[-1]) & (aside < 5 * NARROWING[-1]) & (hits.s >= first) & (hits.s <= last)
    return bool(hits.length[on].sum() > ABOVE_CHANCE * hits.length[beside].sum() / 3)


def _span(views: list[Hits], curve: Array) -> tuple[float, float]:
    on = [hits.s[np.abs(hits.d - along(curve, hits.s)) < NARROWING[-1]] for hits in views]
    return max(float(s.min()) for s in on), min(float(s.max()) for s in on)


def _painted(strips: tuple[Strip, Strip], views: list[Hits], curve: Array) -> float:
    """Share of the line's length, where a view shows the road there, that is painted; of the view that shows more."""
    shares = []
    for strip, hits in zip(strips, views, strict=True):
        on = np.abs(hits.d - along(curve, hits.s)) < NARROWING[-1]
        at = np.searchsorted(strip.d, along(curve, strip.s)).clip(0, len(strip.d) - 1)
        inside = (strip.s >= hits.s[on].min()) & (strip.s <= hits.s[on].max())
        length = float(strip.step[inside & strip.seen[np.arange(len(strip.s)), at]].sum())
        shares.append(float(hits.length[on].sum()) / max(length, 1e-6))
    return min(1.0, max(shares))


def _blocks(rig: StereoRig, surface: Surface, course: Alignment, side: int, hits: Hits, curve: Array) -> Array:
    """Pixels (N, 2) of a line in a view, near to far: its paint's means over stretches of at least `BLOCK`."""
    on = np.abs(hits.d - along(curve, hits.s)) < NARROWING[-1]
    order = np.argsort(hits.s[on])
    s, d, length = (values[on][order] for values in (hits.s, hits.d, hits.length))
    points = surface.points(course.to_ground(s, d))
    pixels = rig.cameras[side].project(points if side == 0 else rig.to_right(points))
    found, first = [], 0
    for k in range(1, len(s) + 1):
        if k < len(s):
            away, metres = np.linalg.norm(pixels[k] - pixels[first]), s[k] - s[first]
            if metres < BLOCK[1] or (away < BLOCK[0] and metres < LONGEST_BLOCK):
                continue
        mine = slice(first, k)
        aside = d[mine] - along(curve, s[mine])
        scatter = np.abs(aside - np.median(aside))
        steady = scatter < 0.06 + 3 * np.median(scatter)
        if steady.sum() >= 2:
            middle = np.asarray(np.average(s[mine], weights=length[mine] * steady))
            found.append((middle, along(curve, middle) + np.average(aside, weights=length[mine] * steady)))
        first = k
    middles = np.array(found).reshape(-1, 2)
    points = surface.points(course.to_ground(middles[:, 0], middles[:, 1]))
    return rig.cameras[side].project(points if side == 0 else rig.to_right(points))
