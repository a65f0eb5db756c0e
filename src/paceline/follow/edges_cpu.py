"""The pixel loops of edge extraction, compiled by Numba."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]


@njit(cache=True, nogil=True, fastmath=True)
def gradient_row(image: Bytes, y: int, x0: int, x1: int, gx: Floats, gy: Floats) -> None:
    """Sobel's 3×3 gradient of row ``y``, columns ``x0`` to ``x1``, into rows of scratch that start at ``x0``; a step of
    n grey levels across x or y gives n."""
    above, here, below = image[y - 1], image[y], image[y + 1]
    for x in range(x0, x1):
        a, b, c = np.float32(above[x - 1]), np.float32(above[x]), np.float32(above[x + 1])
        d, e = np.float32(here[x - 1]), np.float32(here[x + 1])
        f, g, h = np.float32(below[x - 1]), np.float32(below[x]), np.float32(below[x + 1])
        gx[x - x0] = np.float32(0.25) * (c - a + np.float32(2.0) * (e - d) + h - f)
        gy[x - x0] = np.float32(0.25) * (f - a + np.float32(2.0) * (g - b) + h - c)


@njit(cache=True, nogil=True)
def _peak(before: float, here: float, after: float) -> float:
    """Where a parabola through three values is highest, in steps from the middle one, which is the highest."""
    bend = before - 2.0 * here + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0


@njit(cache=True, nogil=True)
def extract(
    image: Bytes,
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    threshold: float,
    tangent: float,
    subpixel: bool,
    gx: Floats,
    gy: Floats,
    near_vertical: Floats,
    near_horizontal: Floats,
) -> tuple[int, int]:
    """Stage 1 of [NIST]: edge points inside x0 ≤ x < x1, y0 ≤ y < y1 as rows (x, y, signed magnitude) of two lists.

    ``gx``, ``gy`` (3, W) are scratch. The sign is that of the step along +x of near-vertical and along +y of
    near-horizontal edges. Returns how many rows of each list were filled.
    """
    x0, y0 = max(x0, 2), max(y0, 2)
    x1, y1 = min(x1, image.shape[1] - 2), min(y1, image.shape[0] - 2)
    verticals = horizontals = 0
    if x1 <= x0 or y1 <= y0:
        return 0, 0
    least = threshold * threshold
    for y in range(y0 - 1, y1 + 1):
        gradient_row(image, y, x0 - 1, x1 + 1, gx[y % 3], gy[y % 3])
        if y <= y0:
            continue
        above, here, below = (y - 2) % 3, (y - 1) % 3, y % 3
        px, py = gx[here], gy[here]
        for i in range(1, x1 - x0 + 1):
            dx, dy = px[i], py[i]
            m = dx * dx + dy * dy
            if m < least:
                continue
            if abs(dy) <= tangent * abs(dx):
                a = px[i - 1] * px[i - 1] + py[i - 1] * py[i - 1]
                b = px[i + 1] * px[i + 1] + py[i + 1] * py[i + 1]
                if m > a and m >= b:
                    r = np.sqrt(m)
                    shift = _peak(np.sqrt(a), r, np.sqrt(b)) if subpixel else 0.0
                    near_vertical[verticals, 0] = x0 + i - 1 + shift
                    near_vertical[verticals, 1] = y - 1
                    near_vertical[verticals, 2] = r if dx > 0 else -r
                    verticals += 1
            elif abs(dx) <= tangent * abs(dy):
                a = gx[above, i] * gx[above, i] + gy[above, i] * gy[above, i]
                b = gx[below, i] * gx[below, i] + gy[below, i] * gy[below, i]
                if m > a and m >= b:
                    r = np.sqrt(m)
                    shift = _peak(np.sqrt(a), r, np.sqrt(b)) if subpixel else 0.0
                    near_horizontal[horizontals, 0] = x0 + i - 1
                    near_horizontal[horizontals, 1] = y - 1 + shift
                    near_horizontal[horizontals, 2] = r if dy > 0 else -r
                    horizontals += 1
    return verticals, horizontals
