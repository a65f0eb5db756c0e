"""The loops of carrying a picture from image to image, compiled by Numba."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np

from paceline.arrays import Floats
from paceline.follow.picture_cpu import SUMS
from paceline.numba_cache import cached_njit

FAINT = 0.1  # grey levels: what varies by less shows nothing


@cached_njit(nogil=True, error_model="numpy")
def _taps(at: float) -> tuple[float, float, float, float]:
    """What the four samples about a place count for, ``at`` (0 to 1) from the second to the third: Keys' cubic with a
    slope of −3/4, as usual for images."""
    a = -0.75
    before, behind = 1.0 + at, 2.0 - at
    first = ((a * before - 5.0 * a) * before + 8.0 * a) * before - 4.0 * a
    second = ((a + 2.0) * at - (a + 3.0)) * at * at + 1.0
    last = ((a * behind - 5.0 * a) * behind + 8.0 * a) * behind - 4.0 * a
    return first, second, 1.0 - first - second - last, last


@cached_njit(nogil=True, error_model="numpy")
def sampled(pixels: Floats, x0: float, y0: float, step: float, out: Floats) -> None:
    """``out`` (h, w): ``pixels`` (H, W) at x0 + step·column, y0 + step·row, interpolated by cubics; the border goes
    on."""
    height, width = pixels.shape
    left = np.empty((4, out.shape[1]), np.int64)
    share = np.empty((4, out.shape[1]), np.float32)
    for c in range(out.shape[1]):
        x = x0 + step * c
        whole = int(floor(x))
        share[0, c], share[1, c], share[2, c], share[3, c] = _taps(x - whole)
        for k in range(4):
            left[k, c] = min(max(whole - 1 + k, 0), width - 1)
    line = np.empty(width, np.float32)
    for r in range(out.shape[0]):
        y = y0 + step * r
        whole = int(floor(y))
        f0, f1, f2, f3 = _taps(y - whole)
        t0, t1, t2, t3 = np.float32(f0), np.float32(f1), np.float32(f2), np.float32(f3)
        one = pixels[min(max(whole - 1, 0), height - 1)]
        two = pixels[min(max(whole, 0), height - 1)]
        three = pixels[min(max(whole + 1, 0), height - 1)]
        four = pixels[min(max(whole + 2, 0), height - 1)]
        for c in range(width):
            line[c] = t0 * one[c] + t1 * two[c] + t2 * three[c] + t3 * four[c]
        here = out[r]
        for c in range(out.shape[1]):
            here[c] = (
                share[0, c] * line[left[0, c]]
                + share[1, c] * line[left[1, c]]
                + share[2, c] * line[left[2, c]]
                + share[3, c] * line[left[3, c]]
            )


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def _dot(one: Floats, other: Floats) -> float:
    """The sum of the products of two arrays (n,)."""
    total = np.float32(0.0)
    for k in range(one.size):
        total += one[k] * other[k]
    return float(total)


@cached_njit(nogil=True, error_model="numpy")
def products(picture: Floats, part: Floats) -> Floats:
    """(H − h + 1, W − w + 1): the sums of the products of a ``picture`` (h, w) with ``part`` (H, W) at every whole
    sample at which it lies in that."""
    (h, w), (height, width) = picture.shape, part.shape
    padded = np.zeros((h, width), np.float32)  # as wide as the part, so that one long sum does: zeros count for nothing
    for y in range(h):  # by element: the check of an array's shape takes seconds to compile
        for x in range(w):
            padded[y, x] = picture[y, x]
    long = (h - 1) * width + w
    wanted, given = padded.ravel()[:long], part.ravel()
    sums = np.empty((height - h + 1, width - w + 1), np.float32)
    for y in range(height - h + 1):
        for x in range(width - w + 1):
            first = y * width + x
            sums[y, x] = _dot(wanted, given[first : first + long])
    return sums


@cached_njit(nogil=True, error_model="numpy")
def normalise(scores: Floats, part: Floats, h: int, w: int) -> None:
    """Make ``scores`` (H − h + 1, W − w + 1), `products` of a picture (h, w) of mean 0 and norm 1 with ``part`` (H, W),
    its correlations; 0 where nothing shows."""
    height, width = part.shape
    sums = np.zeros((height + 1, width + 1))  # of all samples above and to the left,
    squares = np.zeros((height + 1, width + 1))  # and of their squares
    for y in range(height):
        s = q = 0.0
        for x in range(width):
            value = float(part[y, x])
            s += value
            q += value * value
            sums[y + 1, x + 1] = sums[y, x + 1] + s
            squares[y + 1, x + 1] = squares[y, x + 1] + q
    for y in range(height - h + 1):
        for x in range(width - w + 1):
            s = sums[y + h, x + w] - sums[y, x + w] - sums[y + h, x] + sums[y, x]
            q = squares[y + h, x + w] - squares[y, x + w] - squares[y + h, x] + squares[y, x]
            spread = q - s * s / (h * w)
            if spread > FAINT**2 * h * w:
                scores[y, x] /= np.float32(sqrt(spread))
            else:
                scores[y, x] = 0.0
