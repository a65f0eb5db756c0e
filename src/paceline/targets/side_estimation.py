"""Where the sides of a vehicle are: a box drawn by hand is the prior, edges beside it are the evidence.

A side is the border of the vehicle's outline, so nearly every row of the box has an edge there, brighter or darker than
what happens to lie behind it. A wheel, a lamp or a shadow has an edge in some of the rows only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array

BOX_SIDE_STD_PX = 1.0  # standard deviation of a side of a box drawn by hand
EDGE_SIDE_STD_PX = 0.3  # standard deviation of a side about its own edge; 0.20 to 0.27 where it was measured, see below
EDGE_SEARCH_PX = 4.0 * BOX_SIDE_STD_PX  # greatest distance of a side from the box's
EDGE_POINT_REACH_PX = 0.6  # greatest distance of edge points from their edge
EDGE_GRID_PX = 0.1  # spacing of the positions at which edges are looked for
MIN_EDGE_SHARE = 0.1  # of the rows: fewer are no edge
# Probabilistic data association, measured on 480 sides of 80 drawn vehicles (seeds 1 to 40 of `random_chase`, nist and
# hd): 90 to 97 % of them had an edge of their own in 0.3 of the rows or more, and there were 0.2 other edges per pixel.
DETECTION_PROBABILITY = 0.9
CLUTTER_DENSITY_PER_PX = 0.2
EDGE_SHARES = (0.1, 0.25, 0.35, 0.45, 0.55, 0.7)  # of the rows, and by how much likelier a side has that than another
SHARE_LIKELIHOOD_RATIOS = (0.01, 0.08, 0.35, 1.4, 4.0, 5.0)  # edge, as which frames and window posts are as long


@dataclass(frozen=True)
class SideEdge:
    """An edge that may be a vehicle's side: its ``position`` x, px, and the ``share`` of rows of the box with it."""

    position: float
    share: float


@dataclass(frozen=True)
class Side:
    """Where a vehicle's side is: ``position`` x, px, and its standard deviations: ``std``, that of its place if it were
    known which edge it is, and ``association_std``, that of not knowing which."""

    position: float
    std: float
    association_std: float

    @property
    def total_std(self) -> float:
        return float(np.hypot(self.std, self.association_std))


def side_edges(points: Array, drawn: float, rows: tuple[float, float]) -> list[SideEdge]:
    """The edges within EDGE_SEARCH_PX of a box's side ``drawn``, x in px, those in most rows first.

    ``points`` (N, 3) are edge points of either sign: x, y and gradient; ``rows`` are the box's upper and lower y, px.
    """
    first, last = int(np.ceil(rows[0])), int(np.floor(rows[1]))
    near = (np.abs(points[:, 0] - drawn) <= EDGE_SEARCH_PX) & (points[:, 1] >= first) & (points[:, 1] <= last)
    rest = points[near]
    grid = drawn + np.arange(-EDGE_SEARCH_PX, EDGE_SEARCH_PX + EDGE_GRID_PX, EDGE_GRID_PX)
    edges: list[SideEdge] = []
    while len(rest):
        position = _fullest(rest, grid, first, last)
        for _ in range(3):
            close = np.abs(rest[:, 0] - position) <= EDGE_POINT_REACH_PX
            position = float(np.average(rest[close, 0], weights=rest[close, 2])) if close.any() else position
        close = np.abs(rest[:, 0] - position) <= EDGE_POINT_REACH_PX
        share = len(np.unique(rest[close, 1])) / (last - first + 1)
        if share < MIN_EDGE_SHARE:
            break
        edges.append(SideEdge(position, share))
        rest = rest[~close]
    return edges


def _fullest(points: Array, grid: Array, first: int, last: int) -> float:
    """The middle of the positions on a ``grid`` (G,) px at which the most rows have an edge point."""
    has_point = np.zeros((last - first + 1, len(grid)), bool)
    close = np.abs(points[:, :1] - grid) <= EDGE_POINT_REACH_PX
    np.logical_or.at(has_point, points[:, 1].astype(int) - first, close)
    counts = has_point.sum(0)
    best = int(counts.argmax())
    end = best + int(np.argmin(np.append(counts[best:] == counts[best], False)))
    return float(grid[best:end].mean())


def estimate_side(drawn: float, edges: Sequence[SideEdge]) -> Side:
    """Mean and standard deviations of a side that a box has at x = ``drawn``, px, given the ``edges`` beside it.

    Probabilistic data association: each edge may be the side, the others being clutter, or the side has no edge. The
    likelihood of an edge is that of its distance from the box, and of its share of the rows.
    """
    spread = np.hypot(BOX_SIDE_STD_PX, EDGE_SIDE_STD_PX)
    positions, shares = np.array([(edge.position, edge.share) for edge in edges]).reshape(-1, 2).T
    distance_density = np.exp(-0.5 * ((positions - drawn) / spread) ** 2) / (np.sqrt(2.0 * np.pi) * spread)
    share_ratio = np.interp(shares, EDGE_SHARES, SHARE_LIKELIHOOD_RATIOS)
    likelihoods = DETECTION_PROBABILITY * distance_density * share_ratio / CLUTTER_DENSITY_PER_PX
    weights = np.append(1.0 - DETECTION_PROBABILITY, likelihoods)
    weights /= weights.sum()
    means = np.append(drawn, positions)  # the box adds nothing to what an edge tells so much more finely
    variances = np.append(BOX_SIDE_STD_PX**2, np.full(len(edges), EDGE_SIDE_STD_PX**2))
    mean = float(weights @ means)
    return Side(mean, float(np.sqrt(weights @ variances)), float(np.sqrt(weights @ (means - mean) ** 2)))


def width_std(left: Side, right: Side) -> float:
    """Standard deviation of the distance between two sides, px.

    A vehicle is symmetric: an edge that is taken for the left side has its like on the right, so what comes of not
    knowing which edge a side is adds up, while the errors of the hand and of the edges are independent.
    """
    return float(np.hypot(np.hypot(left.std, right.std), left.association_std + right.association_std))
