"""The pixel loops of edge extraction, compiled by Numba."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Bytes, Floats
from paceline.numba_cache import cached_njit


@cached_njit(nogil=True, error_model="numpy")
def gradient_row(image: Bytes, y: int, x0: int, x1: int, gx: Floats, gy: Floats) -> None:
    """Sobel's 3×3 gradient of row ``y``, columns ``x0`` to ``x1``, into rows of scratch that start at ``x0``; a step of
    n grey levels across x or y gives n."""
    above, here, below = image[y - 1, x0 - 1 : x1 + 1], image[y, x0 - 1 : x1 + 1], image[y + 1, x0 - 1 : x1 + 1]
    for i in range(x1 - x0):  # from 0, so that the compiler need not fear an index below
        a, b, c = np.int32(above[i]), np.int32(above[i + 1]), np.int32(above[i + 2])
        d, e = np.int32(here[i]), np.int32(here[i + 2])
        f, g, h = np.int32(below[i]), np.int32(below[i + 1]), np.int32(below[i + 2])
        gx[i] = np.float32(0.25) * np.float32(c - a + np.int32(2) * (e - d) + h - f)
        gy[i] = np.float32(0.25) * np.float32(f - a + np.int32(2) * (g - b) + h - c)


@cached_njit(nogil=True, error_model="numpy")
def _peak(before: float, here: float, after: float) -> float:
    """Where a parabola through three values is highest, in steps from the middle one, which is the highest."""
    bend = before - 2.0 * here + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0


@cached_njit(nogil=True, error_model="numpy")
def extract(
    image: Bytes,
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    threshold: float,
    tangent: float,
    subpixel: bool,
    scratch: Floats,
    near_vertical: Floats,
    near_horizontal: Floats,
) -> tuple[int, int]:
    """Stage 1 of [NIST]: edge points inside x0 ≤ x < x1, y0 ≤ y < y1 as rows (x, y, signed magnitude) of two lists.

    ``scratch`` (3, 3, W) holds the gradient along x and y and its squared magnitude of three rows. The sign is that of
    the step along +x of near-vertical and along +y of near-horizontal edges. Returns how many rows of each list were
    filled.
    """
    x0, y0 = max(x0, 2), max(y0, 2)
    x1, y1 = min(x1, image.shape[1] - 2), min(y1, image.shape[0] - 2)
    verticals = horizontals = 0
    if x1 <= x0 or y1 <= y0:
        return 0, 0
    least = np.float32(threshold * threshold)
    t = np.float32(tangent)
    w = x1 - x0
    edge, found = np.empty(w, np.bool_), np.empty(w, np.int64)
    for y in range(y0 - 1, y1 + 1):
        dx, dy, squares = scratch[0, y % 3, : w + 2], scratch[1, y % 3, : w + 2], scratch[2, y % 3, : w + 2]
        gradient_row(image, y, x0 - 1, x1 + 1, dx, dy)
        for i in range(w + 2):
            squares[i] = dx[i] * dx[i] + dy[i] * dy[i]
        if y <= y0:
            continue
        row = (y - 1) % 3
        dx, dy, m = scratch[0, row, 1 : w + 1], scratch[1, row, 1 : w + 1], scratch[2, row, 1 : w + 1]
        left, right = scratch[2, row, :w], scratch[2, row, 2 : w + 2]
        above, below = scratch[2, (y - 2) % 3, 1 : w + 1], scratch[2, y % 3, 1 : w + 1]
        # which pixels are edge points is told of all of them alike: a branch for each would be guessed wrong too often
        for i in range(w):
            across, down = abs(dx[i]), abs(dy[i])
            upright = (down <= t * across) & (m[i] > left[i]) & (m[i] >= right[i])
            level = (across <= t * down) & (m[i] > above[i]) & (m[i] >= below[i])
            edge[i] = (m[i] >= least) & (upright | level)
        n = 0
        for i in range(w):
            found[n] = i
            n += edge[i]
        for i in found[:n]:
            r = np.sqrt(m[i])
            if abs(dy[i]) <= t * abs(dx[i]):
                shift = _peak(np.sqrt(left[i]), r, np.sqrt(right[i])) if subpixel else 0.0
                near_vertical[verticals, 0] = x0 + i + shift
                near_vertical[verticals, 1] = y - 1
                near_vertical[verticals, 2] = r if dx[i] > 0 else -r
                verticals += 1
            else:
                shift = _peak(np.sqrt(above[i]), r, np.sqrt(below[i])) if subpixel else 0.0
                near_horizontal[horizontals, 0] = x0 + i
                near_horizontal[horizontals, 1] = y - 1 + shift
                near_horizontal[horizontals, 2] = r if dy[i] > 0 else -r
                horizontals += 1
    return verticals, horizontals
