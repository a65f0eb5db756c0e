"""A target model from one image: the strong horizontal and vertical lines inside a box around a vehicle's rear.

In [NIST] 2.2 an operator measures the model with a ruler. Here edge points vote for lines; each line runs where edge
points follow each other without wide gaps; ends that meet share a corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from string import ascii_lowercase

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.cameras import Camera
from paceline.documents.loading import TargetDocument
from paceline.errors import UnusableInput
from paceline.targets.side_estimation import EDGE_SEARCH_PX, Side, estimate_side, side_edges, width_std
from paceline.targets.stated_width import ASSUMED_WIDTH_SHARE, StatedWidth
from paceline.units import COVERAGE_95
from paceline.verdicts import Message, message

End = tuple[str, int, int]  # h or v, which line, 0 for its start and 1 for its stop

# Edges, in grey levels per pixel
BLUR_SIGMA_PX = 0.7  # blur that removes the pixel noise before the gradient
MIN_GRADIENT = 2.5  # least gradient across an edge
SATURATION_GRADIENT = 30.0  # gradient above which edges have no more weight
MAX_TILT_TANGENT = np.tan(np.deg2rad(15.0))  # δ of [NIST] (7)
MAX_SIDE_TILT_TANGENT = 1.0  # of the edge points that show a side, which what lies behind it interrupts
# Lines: px, and as a share of the box
LINE_TOLERANCE = (0.6, 0.008)  # distance of edge points from their line
MIN_LINE_LENGTH = (6.0, 0.1)
MIN_LINE_SPACING = (2.5, 0.04)  # least distance between parallel lines side by side
BOX_MARGIN = (1.5, 0.03)  # margin outside the box in which the vehicle's own outline may be
MAX_CORNER_GAP = (3.0, 0.06)  # greatest distance between the ends of two lines that share a corner
GAP_PENALTY = 1.0  # cost of a missing edge point on a line, in points
MIN_LINES_PER_DIRECTION, MAX_LINES_PER_DIRECTION, MIN_LINES = 2, 7, 5
MIN_BOX_PX = 16.0


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


@dataclass(frozen=True, eq=False)
class LearnedTarget:
    """A model, and its position in the image from which it was learned: scale 1 with its centre at ``center``."""

    target: TargetDocument
    width: StatedWidth
    center: Array  # (2,) px of the image as recorded
    corners: Array  # (C, 2) px of the image as recorded
    notices: tuple[Message, ...] = ()

    @property
    def relative_std(self) -> float:
        """Standard deviation of every range by this model, as a share of the range."""
        return self.target.tolerance / float(np.ptp(self.target.ends[:, 0]))


def learn_target(
    image: Image, box: tuple[float, float, float, float], width: StatedWidth, camera: Camera, name: str
) -> LearnedTarget:
    """The line model of the vehicle inside ``box`` (x0, y0, x1, y1) of ``image`` (H, W), 0–255.

    ``width`` is that of the vehicle, whose sides are estimated from the box and the edges beside it; the remaining
    uncertainty of their distance, and that of the width itself, are the model's tolerance.
    Raises UnusableInput for a box that cannot be, or that encloses too few lines.
    """
    if image.shape != camera.image_size[::-1]:
        size_text = f"{image.shape[1]} × {image.shape[0]}"
        raise UnusableInput(f"the image has {size_text} pixels, but the camera has {camera.image_size[0]} × "
                            f"{camera.image_size[1]}")  # fmt: skip
    _check(box, camera.image_size)
    x0, y0, x1, y1 = box
    size = np.array([x1 - x0, y1 - y0])
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR_SIGMA_PX), np.float32)
    vertical = find_lines(smooth, box)
    horizontal = find_lines(np.ascontiguousarray(smooth.T), (y0, x0, y1, x1))
    if min(len(vertical), len(horizontal)) < MIN_LINES_PER_DIRECTION or len(vertical) + len(horizontal) < MIN_LINES:
        raise UnusableInput(
            f"the box shows {len(horizontal)} horizontal and {len(vertical)} vertical lines; expected at least "
            f"{MIN_LINES_PER_DIRECTION} of each and {MIN_LINES} in all; draw it around the whole rear, or choose a "
            "sharper or nearer picture"
        )
    rising, falling = (_edge_points(sign * smooth, box, EDGE_SEARCH_PX, MAX_SIDE_TILT_TANGENT) for sign in (1, -1))
    points = np.concatenate([rising, falling])
    left, right = (estimate_side(x, side_edges(points, x, (y0, y1))) for x in (x0, x1))
    corners, segments = join_lines(horizontal, vertical, np.maximum(MAX_CORNER_GAP[0], MAX_CORNER_GAP[1] * size))
    center = np.array([0.5 * (left.position + right.position), 0.5 * (y0 + y1)])

    ideal = camera.undistort_points(corners)
    middle = camera.undistort_points(center)
    sides = camera.undistort_points(np.array([[side.position, center[1]] for side in (left, right)]))
    f = camera.K[[0, 1], [0, 1]]
    width_px = float(sides[1, 0] - sides[0, 0])
    nominal_range = f[0] * width.metres / width_px
    metres = _axis_aligned((ideal - middle) * nominal_range / f, segments)
    relative_std = np.hypot(width_std(left, right) / width_px, width.std / width.metres)
    tolerance = float(relative_std * np.ptp(metres[:, 0]))
    target = TargetDocument(
        name, round(float(nominal_range), 4), np.round(metres, 4), segments, round(tolerance, 4), width.assumed
    )
    notices = (*_width_assumed(width), *_lines_beyond_sides(vertical, left, right))
    return LearnedTarget(target, width, np.round(center, 2), corners, notices)


def _width_assumed(width: StatedWidth) -> tuple[Message, ...]:
    """A notice where nobody has stated how uncertain the ``width`` is."""
    return (message("width_uncertainty_assumed", percent=100 * ASSUMED_WIDTH_SHARE),) if width.assumed else ()


def _lines_beyond_sides(vertical: list[Line], left: Side, right: Side) -> tuple[Message, ...]:
    """A notice where vertical lines lie outside of the 95 % intervals of the vehicle's sides."""
    distances = [d for line in vertical for d in (left.position - line.place, line.place - right.position)]
    limits = [COVERAGE_95 * std for _ in vertical for std in (left.total_std, right.total_std)]
    beyond = [d for d, limit in zip(distances, limits, strict=True) if d > limit]
    if not beyond:
        return ()
    width, std = right.position - left.position, width_std(left, right)
    return (message("lines_beyond_sides", distance_px=max(beyond), width_px=width, std_px=std),)


def corner_names(count: int) -> list[str]:
    """a, b, …, z, aa, ab, …"""
    return [*ascii_lowercase, *map("".join, product(ascii_lowercase, repeat=2))][:count]


def _check(box: tuple[float, float, float, float], image_size: tuple[int, int]) -> None:
    x0, y0, x1, y1 = box
    box_text = ",".join(f"{v:g}" for v in box)
    if not np.isfinite(box).all() or x1 - x0 < MIN_BOX_PX or y1 - y0 < MIN_BOX_PX:
        raise UnusableInput(f"--box {box_text}: expected x0,y0,x1,y1 with x1 and y1 at least {MIN_BOX_PX:g} px beyond "
                            "x0 and y0")  # fmt: skip
    if x0 < -0.5 or y0 < -0.5 or x1 > image_size[0] - 0.5 or y1 > image_size[1] - 0.5:
        raise UnusableInput(f"--box {box_text}: lies outside the image of {image_size[0]} × {image_size[1]} pixels")


# --- lines ---------------------------------------------------------------------------------------------------------


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
        points = _edge_points(sign * image, box, margin, MAX_TILT_TANGENT)
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


def _edge_points(image: Image, box: tuple[float, float, float, float], margin: float, max_tilt_tangent: float) -> Array:
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


# --- corners -------------------------------------------------------------------------------------------------------


def join_lines(horizontal: list[Line], vertical: list[Line], max_gap: Array) -> tuple[Array, NDArray[np.int64]]:
    """Corners (C, 2) in pixels and segments (S, 2) of the lines, top to bottom, then left to right.

    Ends of a horizontal and a vertical line within ``max_gap`` (2,) px across and down of each other share a corner.
    """
    ends: dict[End, tuple[float, float]] = {}
    for i, line in enumerate(horizontal):
        ends["h", i, 0], ends["h", i, 1] = (line.start, line.place), (line.stop, line.place)
    for i, line in enumerate(vertical):
        ends["v", i, 0], ends["v", i, 1] = (line.place, line.start), (line.place, line.stop)
    pairs: list[tuple[float, End, End, tuple[float, float]]] = []
    for (i, across), (j, down) in product(enumerate(horizontal), enumerate(vertical)):
        for a, b in product((0, 1), (0, 1)):
            tip, foot = (across.start, across.stop)[a], (down.start, down.stop)[b]
            distances = np.abs([tip - down.place, foot - across.place]) / max_gap
            if distances.max() <= 1:
                pairs.append((float(distances.sum()), ("h", i, a), ("v", j, b), (down.place, across.place)))
    shared: dict[End, End] = {}
    for _, h, v, corner in sorted(pairs):
        if h not in shared and v not in shared:
            shared[h], shared[v] = v, h
            ends[h] = ends[v] = corner
    corners: list[tuple[float, float]] = []
    place: dict[End, int] = {}
    for end, corner in ends.items():
        other = shared.get(end)
        if other in place:
            place[end] = place[other]
        else:
            place[end] = len(corners)
            corners.append(corner)
    lines = [("h", i) for i in range(len(horizontal))] + [("v", i) for i in range(len(vertical))]
    segments = np.array([[place[d, i, 0], place[d, i, 1]] for d, i in lines], np.int64)
    return np.array(corners), segments


def _axis_aligned(corners: Array, segments: NDArray[np.int64]) -> Array:
    """Corners (C, 2) with every segment exactly horizontal or vertical again, which a lens leaves only nearly so."""
    level = corners.copy()
    for a, b in segments:
        axis = int(np.argmin(np.abs(corners[a] - corners[b])))
        level[[a, b], axis] = 0.5 * (corners[a, axis] + corners[b, axis])
    return level
