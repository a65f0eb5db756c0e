"""Stage 1 of [NIST]: edge points inside a moving window, as two lists."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import radians, tan

import numpy as np

from paceline.arrays import Array, Bytes, Floats
from paceline.follow import edges_cpu
from paceline.follow.configuration import FollowConfiguration

Window = tuple[int, int, int, int]  # x0, y0, x1, y1: the pixels x0 ≤ x < x1, y0 ≤ y < y1

SIZES = 7  # of the window
STEP = 2**-0.5  # from one size to the next smaller


@dataclass(frozen=True, eq=False)
class EdgeLists:
    """Edge points as rows (x, y, signed magnitude), px and grey levels.

    The sign is that of the step in brightness along +x for near-vertical, along +y for near-horizontal edges.
    """

    near_vertical: Floats  # (N, 3)
    near_horizontal: Floats  # (M, 3)

    def __iter__(self) -> Iterator[Floats]:
        return iter((self.near_vertical, self.near_horizontal))


class EdgeExtractor:
    """Finds edge points in images of one size, into lists that are made once."""

    def __init__(self, image_size: tuple[int, int], configuration: FollowConfiguration) -> None:
        width, height = image_size
        self._threshold = configuration.edge_threshold
        self._tangent = tan(radians(configuration.direction_tolerance))
        self._subpixel = configuration.subpixel
        self._scratch = np.zeros((3, 3, width), np.float32)
        # of two neighbours across the edge only one is an edge point
        self.capacity = max((width // 2 + 1) * height, (height // 2 + 1) * width)
        self._points = np.zeros((2, self.capacity, 3), np.float32)

    def extract(self, image: Bytes, window: Window) -> EdgeLists:
        """The edge points of ``image`` (H, W) in ``window``: 3×3 gradient (3)–(4), the greatest across the edge,
        threshold. The lists are views that the next call overwrites."""
        verticals, horizontals = self._points
        n, m = edges_cpu.extract(
            image, *window, self._threshold, self._tangent, self._subpixel, self._scratch, verticals, horizontals
        )
        return EdgeLists(verticals[:n], horizontals[:m])


def window_around(center: Array, half: Array, image_size: tuple[int, int]) -> Window:
    """The smallest of the seven windows that reaches ``half`` (2,) px to either side, about ``center`` (2,) px.

    Each is smaller than the last by √2, the largest is the whole image; what lies outside of the image is cut off.
    """
    width, height = image_size
    (x, y), (reach_x, reach_y) = center.tolist(), half.tolist()
    size = 1.0
    for _ in range(SIZES - 1):
        if size * STEP * width < 2.0 * reach_x or size * STEP * height < 2.0 * reach_y:
            break
        size *= STEP
    rx, ry = (0.5 * size * width, 0.5 * size * height) if size < 1.0 else (float(width), float(height))
    return (
        min(max(round(x - rx), 0), width),
        min(max(round(y - ry), 0), height),
        min(max(round(x + rx) + 1, 0), width),
        min(max(round(y + ry) + 1, 0), height),
    )
