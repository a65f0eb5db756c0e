"""Patch features and cross-view correlation of all particles on the CPU, compiled by Numba.

The features are those of [Zhu] (13), the correlation is (17). A row of samples takes three loops — indices and
fractions, a plain gather, unpack and interpolate — over an image whose 2×2 neighbourhoods are packed in one uint32. The
first and the last become vector instructions because separate scratch rows prove to the compiler that nothing aliases.

"""

from __future__ import annotations

import os
from typing import NamedTuple

# Read when Numba starts its threads: they sleep between two kernels instead of spinning, which would occupy the cores
# that the rest of a step needs: a step would take three times as long on two cores.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from paceline.arrays import Array, Floats
from paceline.numba_cache import cached_njit
from paceline.speed.filter import patch_features
from paceline.speed.filter.patch_features import CORRELATION_ROW_STEP, MIN_OVERLAP

_inline = njit(inline="always")
_sampling_bounds = _inline(patch_features.sampling_bounds)
_sample_centre = _inline(patch_features.sample_centre)
_row_terms = _inline(patch_features.row_terms)
_clamp = _inline(patch_features.clamp)
_inside = _inline(patch_features.inside)
_interpolate = _inline(patch_features.interpolate)
_average = _inline(patch_features.haar_average)
_left_right = _inline(patch_features.haar_left_right)
_up_down = _inline(patch_features.haar_up_down)
_diagonal = _inline(patch_features.haar_diagonal)
_correlation = njit(nogil=True)(patch_features.correlation)


THREAD_CHUNKS = 32  # chunks of particles that are distributed over the threads


class PackedImage(NamedTuple):
    """2×2 neighbourhoods of the pixels from (``left``, ``top``) on: ``words`` (height, width)."""

    words: NDArray[np.uint32]
    left: int
    top: int


@cached_njit(nogil=True)
def pack(image: Floats, packed: PackedImage) -> None:
    """Fill ``packed`` with 2×2 neighbourhoods of ``image`` (H, W) float32 0–255; at the right and lower border pixels
    repeat."""
    height, width = packed.words.shape
    levels = np.empty((2, width + 1), np.uint32)
    for y in range(height + 1):
        row = levels[y % 2]
        source = image[min(packed.top + y, image.shape[0] - 1), packed.left :]
        for x in range(min(width + 1, len(source))):
            row[x] = np.uint32(min(max(source[x] + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))
        if len(source) == width:
            row[width] = row[width - 1]
        if y > 0:
            above, target = levels[(y - 1) % 2], packed.words[y - 1]
            for x in range(width):
                target[x] = above[x] | (above[x + 1] << 8) | (row[x] << 16) | (row[x + 1] << 24)


@cached_njit(nogil=True)
def finite_bounds(places: Array) -> tuple[float, float, float, float]:
    """Least x, y and greatest x, y of the finite coordinates of ``places`` (N, 2); ∞ and −∞ where there is none."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for p in range(len(places)):
        x, y = places[p, 0], places[p, 1]
        if np.isfinite(x):
            low_x, high_x = min(low_x, x), max(high_x, x)
        if np.isfinite(y):
            low_y, high_y = min(low_y, y), max(high_y, y)
    return low_x, low_y, high_x, high_y


@_inline
def _sample_row(flat, bounds, H, v, n, px, py, index, fx, fy, word, out):
    """``out`` (n,): the packed image at the row ``v`` of the unit square's grid, mapped to (px, py) by ``H`` (9,)."""
    left, right, top, bottom, width, first = bounds
    last = np.uint32(len(flat) - 1)
    ax, bx = _row_terms(H[0], H[1], H[2], v)
    ay, by = _row_terms(H[3], H[4], H[5], v)
    az, bz = _row_terms(H[6], H[7], H[8], v)
    step = np.float32(1.0) / np.float32(n)
    for i in range(n):
        u = _sample_centre(i, step)
        z = np.float32(1.0) / (az * u + bz)
        x = (ax * u + bx) * z
        y = (ay * u + by) * z
        px[i] = x
        py[i] = y
        x = _clamp(x, left, right)
        y = _clamp(y, top, bottom)
        ix = np.int32(x)
        iy = np.int32(y)
        fx[i] = x - np.float32(ix)
        fy[i] = y - np.float32(iy)
        index[i] = min(np.uint32(iy * width + ix - first), last)  # the coordinates of a degenerate region may be NaN
    for i in range(n):
        word[i] = flat[index[i]]
    for i in range(n):
        out[i] = _interpolate(word[i], fx[i], fy[i])


@_inline
def _sum_blocks(totals, blocks, samples):
    """Block sums of a row of sample ``totals``, ``samples`` of them to each block; the totals start anew."""
    for b in range(blocks.shape[0]):
        total = np.float32(0.0)
        for i in range(b * samples, (b + 1) * samples):
            total += totals[i]
            totals[i] = 0.0
        blocks[b] = total


@cached_njit(nogil=True, fastmath=True)
def _wavelets(blocks: Floats, across: int, features: Floats) -> None:
    """Two-level Haar coefficients (parts, 16) of block sums (4 rows a part, 4 columns a part).

    Order: average, then left-right, up-down and diagonal of the coarse level, then of the four fine squares.
    """
    coarse = np.empty(4, np.float32)
    for part in range(features.shape[0]):
        y, x = 4 * (part // across), 4 * (part % across)
        f = features[part]
        for q in range(4):
            i, j = y + 2 * (q // 2), x + 2 * (q % 2)
            a, b, c, d = blocks[i, j], blocks[i, j + 1], blocks[i + 1, j], blocks[i + 1, j + 1]
            coarse[q] = _average(a, b, c, d)
            f[4 + 3 * q] = _left_right(a, b, c, d)
            f[5 + 3 * q] = _up_down(a, b, c, d)
            f[6 + 3 * q] = _diagonal(a, b, c, d)
        a, b, c, d = coarse[0], coarse[1], coarse[2], coarse[3]
        f[0] = _average(a, b, c, d)
        f[1] = _left_right(a, b, c, d)
        f[2] = _up_down(a, b, c, d)
        f[3] = _diagonal(a, b, c, d)


@cached_njit(nogil=True, fastmath=True, parallel=True, error_model="numpy")
def observe(
    left: PackedImage,
    right: PackedImage,
    H: Floats,
    edges: Floats,
    across: int,
    down: int,
    samples: tuple[int, int],
    features: Floats,
    ncc: Floats,
) -> None:
    """Wavelet features of every particle in both views, and the correlation across the views.

    ``left``, ``right`` the packed images; ``H`` (N, 3, 9) homographies of the unit square to the left region, the
    right region, and the left region transferred to the right view by (15); ``edges`` (N, 4, 3) lines of the right
    region, positive inside; ``across`` × ``down`` parts with ``samples`` (x, y) a block. Writes ``features``
    (N, 2, parts, 16) and ``ncc`` (N,), the normalised cross-correlation (17) over R_∩, −1 where R_∩ is nearly empty.
    """
    N = H.shape[0]
    n = across * 4 * samples[0]
    rows = down * 4 * samples[1]
    flat_left, flat_right = left.words.reshape(-1), right.words.reshape(-1)
    within_left = _sampling_bounds(left.words.shape, left.left, left.top)
    within_right = _sampling_bounds(right.words.shape, right.left, right.top)
    min_samples = np.float32(MIN_OVERLAP) * n * rows / CORRELATION_ROW_STEP
    chunks = min(N, THREAD_CHUNKS)
    for chunk in prange(chunks):
        px, py = np.empty(n, np.float32), np.empty(n, np.float32)
        fx, fy = np.empty(n, np.float32), np.empty(n, np.float32)
        index, word = np.empty(n, np.uint32), np.empty(n, np.uint32)
        value, crossed = np.empty(n, np.float32), np.empty(n, np.float32)
        total_left, total_right = np.zeros(n, np.float32), np.zeros(n, np.float32)
        blocks = np.empty((2, down * 4, across * 4), np.float32)
        sums = np.empty(6, np.float32)
        for p in range(chunk * N // chunks, (chunk + 1) * N // chunks):
            sums[:] = 0.0
            to_left, to_right, across_views, e = H[p, 0], H[p, 1], H[p, 2], edges[p]
            for r in range(rows):
                v = (np.float32(r) + np.float32(0.5)) / np.float32(rows)
                _sample_row(flat_left, within_left, to_left, v, n, px, py, index, fx, fy, word, value)
                for i in range(n):
                    total_left[i] += value[i]
                if r % CORRELATION_ROW_STEP == 0:
                    _sample_row(flat_right, within_right, across_views, v, n, px, py, index, fx, fy, word, crossed)
                    _correlate_row(value, crossed, px, py, e, sums)
                _sample_row(flat_right, within_right, to_right, v, n, px, py, index, fx, fy, word, value)
                for i in range(n):
                    total_right[i] += value[i]
                if r % samples[1] == samples[1] - 1:
                    _sum_blocks(total_left, blocks[0, r // samples[1]], samples[0])
                    _sum_blocks(total_right, blocks[1, r // samples[1]], samples[0])
            _wavelets(blocks[0], across, features[p, 0])
            _wavelets(blocks[1], across, features[p, 1])
            ncc[p] = _correlation(sums, min_samples)


@_inline
def _correlate_row(a, b, px, py, e, sums):
    """Add to ``sums`` = Σ1, Σa, Σb, Σaa, Σbb, Σab over the samples whose (px, py) lie inside the edges ``e`` (4, 3)."""
    s0 = s1 = s2 = s3 = s4 = s5 = np.float32(0.0)
    for i in range(a.shape[0]):
        inside = _inside(e, px[i], py[i])
        left, right = (a[i] - np.float32(128.0)) * inside, (b[i] - np.float32(128.0)) * inside
        s0 += inside
        s1 += left
        s2 += right
        s3 += left * left
        s4 += right * right
        s5 += left * right
    sums[0] += s0
    sums[1] += s1
    sums[2] += s2
    sums[3] += s3
    sums[4] += s4
    sums[5] += s5


@cached_njit(nogil=True)
def _median(values: Floats, scratch: Floats) -> float:
    """Median of a few ``values``, sorted in ``scratch`` of the same length."""
    n = len(values)
    for i in range(n):
        v, j = values[i], i
        while j > 0 and scratch[j - 1] > v:
            scratch[j] = scratch[j - 1]
            j -= 1
        scratch[j] = v
    median: float = np.float32(0.5) * (scratch[(n - 1) // 2] + scratch[n // 2])
    return median


@cached_njit(nogil=True, fastmath=True, parallel=True)
def normalise(features: Floats, floor: np.float32) -> None:
    """Remove brightness and contrast from wavelet features (N, parts, 16), in place; see `likelihood.normalised`."""
    N, parts, coefficients = features.shape
    for p in prange(N):
        brightness, norm2 = np.empty(parts, np.float32), np.empty(parts, np.float32)
        scratch = np.empty(parts, np.float32)
        f = features[p]
        for i in range(parts):
            brightness[i] = f[i, 0]
        middle = _median(brightness, scratch)
        for i in range(parts):
            f[i, 0] -= middle
            total = np.float32(0.0)
            for c in range(coefficients):
                total += f[i, c] * f[i, c]
            norm2[i] = total
        min_norm2 = floor * floor * _median(norm2, scratch) + np.float32(1.0)
        for i in range(parts):
            scale = np.float32(1.0) / np.sqrt(norm2[i] + min_norm2)
            for c in range(coefficients):
                f[i, c] *= scale


@cached_njit(nogil=True, fastmath=True)
def capped_distances(features: Floats, reference: Floats, cap: np.float32, out: Floats) -> None:
    """``out`` (N,): the sum over parts of squared distances (at most ``cap`` each) of (N, parts, 16) to (parts, 16)."""
    N, parts, coefficients = features.shape
    for p in range(N):
        total = np.float32(0.0)
        for i in range(parts):
            distance = np.float32(0.0)
            for c in range(coefficients):
                d = features[p, i, c] - reference[i, c]
                distance += d * d
            total += min(distance, cap)
        out[p] = total
