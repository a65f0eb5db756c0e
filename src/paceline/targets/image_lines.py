"""The strong horizontal and vertical lines inside a box of an image: edge points vote for them, and each line runs
where edge points follow each other without wide gaps.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image

# Edges, in grey levels per pixel
MIN_GRADIENT = 2.5  # least gradient across an edge
SATURATION_GRADIENT = 30.0  # gradient above which edges have no more weight
MAX_TILT_TANGENT = np.tan(np.deg2rad(15.0))  # δ of [NIST] (7)
# Lines: px, and as a share of the box
LINE_TOLERANCE = (0.6, 0.008)  # distance of edge points from their line
MIN_LINE_LENGTH = (6.0, 0.1)
MIN_LINE_SPACING = (2.5, 0.04)  # least distance between parallel lines side by side
BOX_MARGIN = (1.5, 0.03)  # margin outside the box in which the vehicle's own outline may be
GAP_PENALTY = 1.0  # cost of a missing edge point on a line, in points
MAX_LINES_PER_DIRECTION = 7


@dataclass(frozen=True)
class Line:
    """A vertical line at ``place`` = x from ``start`` to ``stop`` = y (or, mirrored in x = y, a horizontal one), px."""

    place: float
    start: float
    stop: float
    strength: float  # summed gradients of its edge points, each up to SATURATION_GRADIENT

    @property
    def length(self) -> float:
        return self.stop - self.start


def find_lines(image: Image, box: tuple[float, float, float, float]) -> list[Line]:
    """The strongest vertical lines of ``image`` inside ``box``, from left to right."""
    x0, y0, x1, y1 = box
    across, along = x1 - x0, y1 - y0
    max_offset = LINE_TOLERANCE[0] + LINE_TOLERANCE[1] * max(across, along)
    shortest = max(MIN_LINE_LENGTH[0], MIN_LINE_LENGTH[1] * along)
    min_distance = max(MIN_LINE_SPACING[0], MIN_LINE_SPACING[1] * across)
    margin = max(BOX_MARGIN[0], BOX_MARGIN[1] * max(across, along))
    lines: list[Line] = []
    for sign in (1, -1):
        points = edge_points(sign * image, box, margin, MAX_TILT_TANGENT)
        while (
            len(points) and _max_count_within(points[:, 0], 2 * max_offset) > 0.5 * shortest
        ):  # fewer make no line so long
            line, inliers = _best_line(points, max_offset)
            if line.length >= shortest:
                lines.append(line)
            points = points[~inliers]
    chosen: list[Line] = []
    for line in sorted(lines, key=lambda line: -line.strength):
        if len(chosen) < MAX_LINES_PER_DIRECTION and not any(_too_close(line, other, min_distance) for other in chosen):
            chosen.append(line)
    return sorted(chosen, key=lambda line: line.place)


def edge_points(image: Image, box: tuple[float, float, float, float], margin: float, max_tilt_tangent: float) -> Array:
    """Where ``image`` grows brightest from left to right within ``margin`` px about ``box``: x to a fraction of a
    pixel, y, gradient; shape (N, 3)."""
    x0, y0, x1, y1 = box
    gx = cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8)
    gy = cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8)
    left, mid, right = gx[:, :-2], gx[:, 1:-1], gx[:, 2:]
    peak = (mid >= MIN_GRADIENT) & (mid > left) & (mid >= right) & (np.abs(gy[:, 1:-1]) < max_tilt_tangent * mid)
    y, x = np.nonzero(peak)
    a, b, c = (part[y, x].astype(float) for part in (left, mid, right))
    fraction = 0.5 * (a - c) / (a - 2 * b + c)
    points = np.column_stack([x + 1 + fraction, y, b])
    inside = (np.abs(points[:, 0] - 0.5 * (x0 + x1)) <= 0.5 * (x1 - x0) + margin) & (
        np.abs(points[:, 1] - 0.5 * (y0 + y1)) <= 0.5 * (y1 - y0) + margin
    )
    return np.asarray(points[inside])


def _best_line(points: Array, max_offset: float) -> tuple[Line, NDArray[np.bool_]]:
    """The line with the most edge points within ``max_offset``, and which of ``points`` (N, 3) it uses up."""
    x, y, gradient = points.T
    weight = np.minimum(gradient, SATURATION_GRADIENT)
    order = np.argsort(x, kind="stable")
    total = np.concatenate([[0.0], np.cumsum(weight[order])])
    counts = (
        total[np.searchsorted(x[order], x + max_offset, "right")] - total[np.searchsorted(x[order], x - max_offset)]
    )
    place = float(x[np.argmax(counts)])
    for _ in range(3):
        inliers = np.abs(x - place) <= max_offset
        start, stop = _longest_run(y[inliers])
        inliers &= (y >= start) & (y <= stop)
        place = float(np.average(x[inliers], weights=weight[inliers]))
    # a row's pixel reaches half a pixel beyond its centre
    return Line(place, start - 0.5, stop + 0.5, float(weight[inliers].sum())), inliers


def _max_count_within(x: Array, width: float) -> int:
    """How many of ``x`` (N,) lie in one interval of this ``width``, at most."""
    x = np.sort(x)
    return int((np.searchsorted(x, x + width, "right") - np.arange(len(x))).max())


def _longest_run(rows: Array) -> tuple[float, float]:
    """First and last of ``rows`` in the stretch where points outnumber gaps by most (the maximum-sum subarray)."""
    first = int(rows.min())
    score = np.full(int(rows.max()) - first + 1, -GAP_PENALTY)
    score[rows.astype(int) - first] = 1.0
    total = np.concatenate([[0.0], np.cumsum(score)])
    lowest = np.minimum.accumulate(total)
    stop = int(np.argmax(total - lowest))
    start = int(np.argmin(total[: stop + 1]))
    return float(first + start), float(first + stop - 1)


def _too_close(line: Line, other: Line, min_distance: float) -> bool:
    """Whether two lines are so near side by side that a tracker would confuse them."""
    overlap = min(line.stop, other.stop) - max(line.start, other.start)
    return overlap > 0 and abs(line.place - other.place) < min_distance
