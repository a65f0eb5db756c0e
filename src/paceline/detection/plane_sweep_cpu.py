"""Loops over the cells of a sweep plane, compiled by Numba: both images warped to the plane, and their local NCC.

They compute what :mod:`paceline.detection.photo_consistency` defines, one plane at a time and without storing the
intermediate results of all planes.
"""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Bytes, Image, Mask
from paceline.detection.photo_consistency import MIN_CHANGE, MIN_STD_PRODUCT, NCC_RAMP
from paceline.numba_cache import cached_njit

REORDERED_SUMS = {"reassoc", "contract", "nsz"}  # fastmath flags: sums may be taken in another order


@cached_njit(nogil=True, fastmath=REORDERED_SUMS, error_model="numpy")
def warp(image: Image, H: Array, scale: float, warped: Image) -> None:
    """Fill ``warped`` (rows, columns) with ``image``, bilinearly, at ``scale`` times the pixels to which ``H`` (3, 3)
    maps its cells (column, row, 1), and subtract the mean, which leaves the sums of squares exact. The border
    repeats."""
    height, width = image.shape
    rows, columns = warped.shape
    x, y = np.empty(columns, np.float32), np.empty(columns, np.float32)
    right, bottom = np.float32(width - 1.001), np.float32(height - 1.001)
    total = 0.0
    for r in range(rows):
        out = warped[r]
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
            warped[r, c] -= mean


@cached_njit(nogil=True, fastmath=REORDERED_SUMS, error_model="numpy")
def _local_means(a: Image, b: Image, window: int, means: Image) -> None:
    """The ``means`` (H, W) of a·b over ``window`` × ``window`` cells about each, mirrored at the border."""
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


@cached_njit(nogil=True, fastmath=REORDERED_SUMS, error_model="numpy")
def _local_moments(image: Image, ones: Image, window: int, mean: Image, std: Image) -> None:
    """The local ``mean`` and standard deviation ``std`` of ``image``, all (H, W)."""
    _local_means(image, ones, window, mean)
    _local_means(image, image, window, std)
    for r in range(len(image)):
        for c in range(image.shape[1]):
            std[r, c] = np.sqrt(max(std[r, c] - mean[r, c] * mean[r, c], np.float32(0.0)))


@cached_njit(nogil=True, fastmath=REORDERED_SUMS, error_model="numpy")
def _local_ncc(a: Image, moments_a: Image, b: Image, moments_b: Image, window: int, ncc: Image) -> None:
    """The local ``ncc`` of two images (H, W), with means and standard deviations ``moments_a`` and ``moments_b``
    (2, H, W)."""
    _local_means(a, b, window, ncc)
    for r in range(len(a)):
        for c in range(a.shape[1]):
            contrast = moments_a[1, r, c] * moments_b[1, r, c]
            covariance = ncc[r, c] - moments_a[0, r, c] * moments_b[0, r, c]
            ncc[r, c] = covariance / contrast if contrast > MIN_STD_PRODUCT else np.float32(0.0)


@cached_njit(nogil=True, error_model="numpy")
def _warp_views(
    left: Image, right: Image, H: Array, scale: float, window: int, size: tuple[int, int]
) -> tuple[Image, Image]:
    """Two images warped to a plane of ``size`` (rows, columns), (2, rows, columns), and their local means and standard
    deviations (2, 2, rows, columns)."""
    ones, warped = np.ones(size, np.float32), np.empty((2, *size), np.float32)
    moments = np.empty((2, 2, *size), np.float32)
    for view, image in enumerate((left, right)):
        warp(image, H[view], scale, warped[view])
        _local_moments(warped[view], ones, window, moments[view, 0], moments[view, 1])
    return warped, moments


@cached_njit(nogil=True, error_model="numpy")
def correlate(left: Image, right: Image, H: Array, scale: float, window: int, ncc: Image, contrast: Image) -> None:
    """The local ``ncc`` of two images on a plane, ``H`` (2, 3, 3), and the local ``contrast`` of the left one, both
    (rows, columns)."""
    warped, moments = _warp_views(left, right, H, scale, window, ncc.shape)
    _local_ncc(warped[0], moments[0], warped[1], moments[1], window, ncc)
    for r in range(len(contrast)):  # by element: the check of an array's shape takes 5 s to compile
        for c in range(contrast.shape[1]):
            contrast[r, c] = moments[0, 1, r, c]


@cached_njit(nogil=True, error_model="numpy")
def consistency(
    left: Image, right: Image, left_background: Image, right_background: Image, H: Array, scale: float, window: int,
    min_contrast: float, min_cells: float, result: Image,
) -> None:  # fmt: skip
    """The photo-consistency of two images on a plane (rows, columns), 0 to 1: 0 where either has a contrast below
    ``min_contrast`` grey levels or looks like its background, and everywhere where the sum is below ``min_cells``."""
    rows, columns = result.shape
    warped, moments = _warp_views(left, right, H, scale, window, result.shape)
    _local_ncc(warped[0], moments[0], warped[1], moments[1], window, result)
    total = 0.0
    for r in range(rows):
        for c in range(columns):
            agree = min(max((result[r, c] - NCC_RAMP[0]) / (NCC_RAMP[1] - NCC_RAMP[0]), 0.0), 1.0)
            result[r, c] = agree if min(moments[0, 1, r, c], moments[1, 1, r, c]) > min_contrast else 0.0
            total += result[r, c]
    background = np.empty((rows, columns), np.float32)
    background_moments = np.empty((2, rows, columns), np.float32)
    ones, unchanged = np.ones((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    for view, image in enumerate((left_background, right_background)):
        if total >= min_cells:
            warp(image, H[view], scale, background)
            _local_moments(background, ones, window, background_moments[0], background_moments[1])
            _local_ncc(warped[view], moments[view], background, background_moments, window, unchanged)
            total = 0.0
            for r in range(rows):
                for c in range(columns):
                    if unchanged[r, c] >= 1 - MIN_CHANGE:
                        result[r, c] = 0.0
                    total += result[r, c]
    if total < min_cells:
        result[:] = np.float32(0.0)


@cached_njit(nogil=True, error_model="numpy")
def clear_masked(consistency: Image, mask: Bytes, H: Array) -> None:
    """Set ``consistency`` to 0 at the cells of a plane, ``H`` (3, 3), that lie in the ``mask`` of an image."""
    height, width = mask.shape
    for r in range(consistency.shape[0]):
        for c in range(consistency.shape[1]):
            if consistency[r, c] == 0.0:
                continue
            w = 1.0 / (H[2, 0] * c + H[2, 1] * r + H[2, 2])
            x = (H[0, 0] * c + H[0, 1] * r + H[0, 2]) * w + 0.5
            y = (H[1, 0] * c + H[1, 1] * r + H[1, 2]) * w + 0.5
            if 0.0 <= x < width and 0.0 <= y < height and mask[int(y), int(x)]:
                consistency[r, c] = 0.0


@cached_njit(nogil=True, fastmath=REORDERED_SUMS, error_model="numpy")
def weighted_sum(consistency: Image, weights: Image) -> float:
    """The sum of ``consistency`` (rows, columns), its columns weighted by ``weights`` (columns,)."""
    total = 0.0
    for r in range(consistency.shape[0]):
        for c in range(consistency.shape[1]):
            total += consistency[r, c] * weights[c]
    return total


@cached_njit(nogil=True, error_model="numpy")
def weighted_ncc(left: Image, right: Image, H: Array, scale: float, window: int, mask: Mask) -> float:
    """The mean local NCC of two images inside a ``mask`` (rows, columns) of a plane, ``H`` (2, 3, 3), weighted by
    contrast, −1 to 1."""
    warped, moments = _warp_views(left, right, H, scale, window, mask.shape)
    ncc = np.empty(mask.shape, np.float32)
    _local_ncc(warped[0], moments[0], warped[1], moments[1], window, ncc)
    agreement, contrast = 0.0, 1e-9
    for r in range(mask.shape[0]):
        for c in range(mask.shape[1]):
            if mask[r, c]:
                a, b = moments[0, 1, r, c], moments[1, 1, r, c]
                agreement += ncc[r, c] * min(a, b) ** 2
                contrast += max(a, b) ** 2
    return agreement / contrast
