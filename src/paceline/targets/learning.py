"""A target model from one image: the strong horizontal and vertical lines inside a box around a vehicle's rear.

In [NIST] 2.2 an operator measures the model with a ruler. Here the lines are found in the image; ends that meet share a
corner.
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
from paceline.number_format import format_uncertain
from paceline.targets.image_lines import Line, edge_points, find_lines
from paceline.targets.model_quality import ModelQuality, judge_model
from paceline.targets.side_estimation import EDGE_SEARCH_PX, Side, estimate_side, side_edges, width_std
from paceline.targets.stated_width import ASSUMED_WIDTH_SHARE, StatedWidth
from paceline.units import COVERAGE_95
from paceline.verdicts import Message, message

End = tuple[str, int, int]  # h or v, which line, 0 for its start and 1 for its stop

BLUR_SIGMA_PX = 0.7  # of the blur that removes the pixel noise before the gradient
MAX_SIDE_TILT_TANGENT = 1.0  # of the edge points that show a side, which what lies behind it interrupts
MAX_CORNER_GAP = (3.0, 0.06)  # px and share of the box: greatest distance between ends of lines that share a corner
MIN_LINES_PER_DIRECTION, MIN_LINES = 2, 5
MIN_BOX_PX = 16.0


@dataclass(frozen=True, eq=False)
class LearnedTarget:
    """A model, and its position in the image from which it was learned: scale 1 with its centre at ``center``."""

    target: TargetDocument
    width: StatedWidth
    center: Array  # (2,) px of the image as recorded
    corners: Array  # (C, 2) px of the image as recorded
    quality: ModelQuality
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
    rising, falling = (edge_points(sign * smooth, box, EDGE_SEARCH_PX, MAX_SIDE_TILT_TANGENT) for sign in (1, -1))
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
    quality = judge_model(image, horizontal, vertical, center)
    notices = (*quality.doubts(), *_width_assumed(width), *_lines_beyond_sides(vertical, left, right))
    return LearnedTarget(target, width, np.round(center, 2), corners, quality, notices)


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
    return (message("lines_beyond_sides", distance_px=max(beyond), width=format_uncertain(width, COVERAGE_95 * std)),)


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
