"""The loops over the cells of a card, compiled by Numba: both pictures laid out, and how they agree place by place.

As :mod:`paceline.detection.photo_consistency` has it, for one card after the other without storing what lies between.
"""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Bytes, Image, Mask
from paceline.detection import photo_consistency
from paceline.numba_cache import cached_njit

AGREE, CHANGED, FLAT = photo_consistency.AGREE, photo_consistency.CHANGED, photo_consistency.FLAT
SUMS = {"reassoc", "contract", "nsz"}  # sums may be taken in another order


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def lay_out(image: Image, H: Array, scale: float, card: Image) -> None:
    """Fill ``card`` (rows, columns) with ``image`` at ``scale`` times the pixels that ``H`` (3, 3) makes of its cells
    (column, row, 1), and take off the mean, which leaves the sums of squares exact; the border repeats."""
    height, width = image.shape
    rows, columns = card.shape
    x, y = np.empty(columns, np.float32), np.empty(columns, np.float32)
    right, bottom = np.float32(width - 1.001), np.float32(height - 1.001)
    total = 0.0
    for r in range(rows):
        out = card[r]
        for c in range(columns):
            w = scale / (H[2, 0] * c + H[2, 1] * r + H[2, 2])
            x[c] = min(max((H[0, 0] * c + H[0, 1] * r + H[0, 2]) * w, 0.0), right)
            y[c] = min(max((H[1, 0] * c + H[1, 1] * r + H[1, 2]) * w, 0.0), bottom)
        for c in range(columns):
            i, j = int(x[c]), int(y[c])
            f, g = x[c] - np.float32(i), y[c] - np.float32(j)
            above = image[j, i] + f * (image[j, i + 1] - image[j, i])
            below = image[j + 1, i] + f * (image[j + 1, i + 1] - image[j + 1, i])
            out[c] = above + g * (below - above)
        for c in range(columns):
            total += out[c]
    mean = np.float32(total / (rows * columns))
    for r in range(rows):
        for c in range(columns):
            card[r, c] -= mean


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def _means(a: Image, b: Image, window: int, means: Image) -> None:
    """The ``means`` (H, W) of a·b over ``window`` × ``window`` places about each, mirrored at the border."""
    rows, columns = a.shape
    half = window // 2
    across, padded = np.zeros((rows, columns), np.float32), np.empty(columns + 2 * half, np.float32)
    for r in range(rows):
        for c in range(columns):
            padded[half + c] = a[r, c] * b[r, c]
        for c in range(half):
            padded[c], padded[half + columns + c] = padded[2 * half - 1 - c], padded[half + columns - 1 - c]
        row = across[r]
        for k in range(window):
            for c in range(columns):
                row[c] += padded[c + k]
    share = np.float32(1.0 / window**2)
    for r in range(rows):
        mean = means[r]
        mean[:] = np.float32(0.0)
        for k in range(r - half, r + half + 1):
            row = across[-1 - k if k < 0 else 2 * rows - 1 - k if k >= rows else k]
            for c in range(columns):
                mean[c] += share * row[c]


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def _moments(card: Image, ones: Image, window: int, mean: Image, std: Image) -> None:
    """The local ``mean`` and standard deviation of a ``card``, all (H, W)."""
    _means(card, ones, window, mean)
    _means(card, card, window, std)
    for r in range(len(card)):
        for c in range(card.shape[1]):
            std[r, c] = np.sqrt(max(std[r, c] - mean[r, c] * mean[r, c], np.float32(0.0)))


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def _correlated(a: Image, of_a: Image, b: Image, of_b: Image, window: int, correlation: Image) -> None:
    """The local ``correlation`` of two cards (H, W), with means and standard deviations ``of_a`` and ``of_b``
    (2, H, W)."""
    _means(a, b, window, correlation)
    for r in range(len(a)):
        for c in range(a.shape[1]):
            contrast = of_a[1, r, c] * of_b[1, r, c]
            covariance = correlation[r, c] - of_a[0, r, c] * of_b[0, r, c]
            correlation[r, c] = covariance / contrast if contrast > FLAT else np.float32(0.0)


@cached_njit(nogil=True, error_model="numpy")
def _laid_out(
    left: Image, right: Image, H: Array, scale: float, window: int, size: tuple[int, int]
) -> tuple[Image, Image]:
    """What two pictures show on a card of ``size`` (rows, columns), (2, rows, columns), with the local means and
    standard deviations (2, 2, rows, columns)."""
    ones, cards = np.ones(size, np.float32), np.empty((2, *size), np.float32)
    moments = np.empty((2, 2, *size), np.float32)
    for view, image in enumerate((left, right)):
        lay_out(image, H[view], scale, cards[view])
        _moments(cards[view], ones, window, moments[view, 0], moments[view, 1])
    return cards, moments


@cached_njit(nogil=True, error_model="numpy")
def correlate(
    left: Image, right: Image, H: Array, scale: float, window: int, correlation: Image, contrast: Image
) -> None:
    """The local ``correlation`` of what two pictures show on a card, ``H`` (2, 3, 3), and the local ``contrast`` of the
    left one, both (rows, columns)."""
    cards, moments = _laid_out(left, right, H, scale, window, correlation.shape)
    _correlated(cards[0], moments[0], cards[1], moments[1], window, correlation)
    contrast[:] = moments[0, 1]


@cached_njit(nogil=True, error_model="numpy")
def count(
    left: Image, right: Image, left_before: Image, right_before: Image, H: Array, scale: float, window: int,
    least: float, enough: float, counts: Image,
) -> None:  # fmt: skip
    """How much each place of a card counts (rows, columns), 0 to 1: where two pictures of it have a contrast of
    ``least`` grey levels and agree with each other, and neither with what it showed ``before``. Nothing does where
    they count less than ``enough`` in all."""
    rows, columns = counts.shape
    cards, moments = _laid_out(left, right, H, scale, window, counts.shape)
    _correlated(cards[0], moments[0], cards[1], moments[1], window, counts)
    total = 0.0
    for r in range(rows):
        for c in range(columns):
            agree = min(max((counts[r, c] - AGREE[0]) / (AGREE[1] - AGREE[0]), 0.0), 1.0)
            counts[r, c] = agree if min(moments[0, 1, r, c], moments[1, 1, r, c]) > least else 0.0
            total += counts[r, c]
    before, of_before = np.empty((rows, columns), np.float32), np.empty((2, rows, columns), np.float32)
    ones, same = np.ones((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    for view, image in enumerate((left_before, right_before)):
        if total >= enough:
            lay_out(image, H[view], scale, before)
            _moments(before, ones, window, of_before[0], of_before[1])
            _correlated(cards[view], moments[view], before, of_before, window, same)
            total = 0.0
            for r in range(rows):
                for c in range(columns):
                    if same[r, c] >= 1 - CHANGED:
                        counts[r, c] = 0.0
                    total += counts[r, c]
    if total < enough:
        counts[:] = np.float32(0.0)


@cached_njit(nogil=True, error_model="numpy")
def hide(counts: Image, explained: Bytes, H: Array) -> None:
    """Count nothing at the cells of a card, ``H`` (3, 3), that lie in the ``explained`` part of a picture."""
    height, width = explained.shape
    for r in range(counts.shape[0]):
        for c in range(counts.shape[1]):
            if counts[r, c] == 0.0:
                continue
            w = 1.0 / (H[2, 0] * c + H[2, 1] * r + H[2, 2])
            x = (H[0, 0] * c + H[0, 1] * r + H[0, 2]) * w + 0.5
            y = (H[1, 0] * c + H[1, 1] * r + H[1, 2]) * w + 0.5
            if 0.0 <= x < width and 0.0 <= y < height and explained[int(y), int(x)]:
                counts[r, c] = 0.0


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def weighted(counts: Image, weights: Image) -> float:
    """The sum of ``counts`` (rows, columns) by the ``weights`` (columns,) of the columns."""
    total = 0.0
    for r in range(counts.shape[0]):
        for c in range(counts.shape[1]):
            total += counts[r, c] * weights[c]
    return total


@cached_njit(nogil=True, error_model="numpy")
def sharpness(left: Image, right: Image, H: Array, scale: float, window: int, piece: Mask) -> float:
    """The correlation of what two pictures show in a ``piece`` (rows, columns) of a card, ``H`` (2, 3, 3), the more of
    it the more contrast both have, −1 to 1."""
    cards, moments = _laid_out(left, right, H, scale, window, piece.shape)
    correlation = np.empty(piece.shape, np.float32)
    _correlated(cards[0], moments[0], cards[1], moments[1], window, correlation)
    alike, contrast = 0.0, 1e-9
    for r in range(piece.shape[0]):
        for c in range(piece.shape[1]):
            if piece[r, c]:
                a, b = moments[0, 1, r, c], moments[1, 1, r, c]
                alike += correlation[r, c] * min(a, b) ** 2
                contrast += max(a, b) ** 2
    return alike / contrast
