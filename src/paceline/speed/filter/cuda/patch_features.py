"""The likelihood kernel: from the pixels to the log-likelihood of every particle.

A thread block computes one particle, a thread one block of samples of the wavelet grid, in both views and across them.
Block sums and the sums of the correlation are in shared memory; the features of a particle never leave its thread
block. The mathematics is that of `filter.patch_features`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

from paceline.speed.filter import patch_features
from paceline.speed.filter.cuda import memory_layout as layout
from paceline.speed.filter.cuda.compiling import kernel
from paceline.speed.filter.patch_features import CORRELATION_ROW_STEP, MIN_OVERLAP

_BLOCKS = 16 * layout.MAX_PARTS  # of the wavelet grid, in one view
_PARTS = 2 * layout.MAX_PARTS  # of both views
_SUMS = 6  # Σ1, Σa, Σb, Σaa, Σbb, Σab
_LANES = 8  # threads that add up one of these sums

_device = cuda.jit(device=True)
_sampling_bounds = _device(patch_features.sampling_bounds)
_sample_centre = _device(patch_features.sample_centre)
_row_terms = _device(patch_features.row_terms)
_clamp = _device(patch_features.clamp)
_inside = _device(patch_features.inside)
_correlation = _device(patch_features.correlation)
_interpolate = _device(patch_features.interpolate)
_average = _device(patch_features.haar_average)
_left_right = _device(patch_features.haar_left_right)
_up_down = _device(patch_features.haar_up_down)
_diagonal = _device(patch_features.haar_diagonal)


@cuda.jit(device=True)
def _map_point(H, first, u, v):
    """Pixel to which the homography whose nine entries begin at ``H[first]`` takes (u, v) of the unit square."""
    ax, bx = _row_terms(H[first], H[first + 1], H[first + 2], v)
    ay, by = _row_terms(H[first + 3], H[first + 4], H[first + 5], v)
    az, bz = _row_terms(H[first + 6], H[first + 7], H[first + 8], v)
    z = np.float32(1.0) / (az * u + bz)
    return (ax * u + bx) * z, (ay * u + by) * z


@cuda.jit(device=True)
def _sample(flat, bounds, x, y):
    """The packed image at (x, y), at its border beyond it."""
    left, right, top, bottom, width, first = bounds
    x = _clamp(x, left, right)
    y = _clamp(y, top, bottom)
    ix = np.int32(x)
    iy = np.int32(y)
    index = min(np.uint32(iy * width + ix - first), np.uint32(flat.shape[0] - 1))
    return _interpolate(flat[index], x - np.float32(ix), y - np.float32(iy))


@cuda.jit(device=True)
def _wavelets(blocks, across, part, f):
    """Two-level Haar coefficients ``f`` (16,) of a ``part``, in the order of `patch_features_cpu`, of the sums
    ``blocks`` of one view's grid, row by row."""
    row = 4 * across
    corner = 4 * (part // across) * row + 4 * (part % across)
    coarse = cuda.local.array(4, np.float32)
    for q in range(4):
        i = corner + 2 * (q // 2) * row + 2 * (q % 2)
        a, b, c, d = blocks[i], blocks[i + 1], blocks[i + row], blocks[i + row + 1]
        coarse[q] = _average(a, b, c, d)
        f[4 + 3 * q] = _left_right(a, b, c, d)
        f[5 + 3 * q] = _up_down(a, b, c, d)
        f[6 + 3 * q] = _diagonal(a, b, c, d)
    a, b, c, d = coarse[0], coarse[1], coarse[2], coarse[3]
    f[0] = _average(a, b, c, d)
    f[1] = _left_right(a, b, c, d)
    f[2] = _up_down(a, b, c, d)
    f[3] = _diagonal(a, b, c, d)


@cuda.jit(device=True)
def _settle_median(values, start, parts, i, middles):
    """Called for each ``i`` of ``parts`` numbers from ``values[start]`` on: those in the middle of their order enter
    ``middles`` (2,)."""
    value, rank = values[start + i], 0
    for j in range(parts):
        other = values[start + j]
        if other < value or (other == value and j < i):
            rank += 1
    if rank == (parts - 1) // 2:
        middles[0] = value
    if rank == parts // 2:
        middles[1] = value


@cuda.jit(device=True)
def _frame(observations, first):
    """Bounds of the packed image whose frame begins at ``sights[first]``."""
    shape = np.int32(observations[first]), np.int32(observations[first + 1])
    return _sampling_bounds(shape, np.int32(observations[first + 2]), np.int32(observations[first + 3]))


@kernel(fastmath=True)
def log_likelihood(pixels, maps, observations, pool):
    """log p(z | x) by (12), (13), (18), into the row LIKELIHOOD, of all vehicles whose WEIGHT_UPDATE is not 0.

    ``pixels`` are the packed images row by row, the left and then the right; ``maps`` (columns, SAMPLING_MAP) is
    written by `motion.prepare`. Blocks are (particles, slots), with 16 threads for each part.
    """
    t = cuda.threadIdx.x
    homographies = cuda.shared.array(27, np.float32)
    e = cuda.shared.array((4, 3), np.float32)
    blocks = cuda.shared.array((2, _BLOCKS), np.float32)
    sums = cuda.shared.array((_SUMS, _BLOCKS), np.float32)
    folded = cuda.shared.array((_SUMS, _LANES), np.float32)
    brightness = cuda.shared.array(_PARTS, np.float32)
    norm2 = cuda.shared.array(_PARTS, np.float32)
    middles = cuda.shared.array((4, 2), np.float32)
    observation = observations[
        layout.HEADER_SIZE + cuda.blockIdx.y * layout.OBSERVATION_SIZE : layout.HEADER_SIZE
        + (cuda.blockIdx.y + 1) * layout.OBSERVATION_SIZE
    ]
    if cuda.blockIdx.x >= int(observation[layout.PARTICLE_COUNT]) or observation[layout.WEIGHT_UPDATE] == 0.0:
        return
    particle = int(observation[layout.FIRST_COLUMN]) + cuda.blockIdx.x
    across, down = int(observation[layout.PART_GRID]), int(observation[layout.PART_GRID + 1])
    sx, sy = int(observation[layout.PART_GRID + 2]), int(observation[layout.PART_GRID + 3])
    parts = across * down
    if t < 27:
        homographies[t] = maps[particle, t]
    elif t < 39:
        e[(t - 27) // 3, (t - 27) % 3] = maps[particle, t]
    cuda.syncthreads()

    words = int(observations[layout.WORD_COUNTS])
    left, right = pixels[:words], pixels[words : words + int(observations[layout.WORD_COUNTS + 1])]
    within_left, within_right = _frame(observations, layout.LEFT_FRAME), _frame(observations, layout.RIGHT_FRAME)
    first_row, first_column = (t // (4 * across)) * sy, (t % (4 * across)) * sx
    rows = np.float32(4 * down * sy)
    step = np.float32(1.0) / np.float32(4 * across * sx)
    total_left = total_right = np.float32(0.0)
    s0 = s1 = s2 = s3 = s4 = s5 = np.float32(0.0)
    for j in range(sy):
        r = first_row + j
        v = (np.float32(r) + np.float32(0.5)) / rows
        crossed = r % CORRELATION_ROW_STEP == 0
        for i in range(sx):
            u = _sample_centre(first_column + i, step)
            x, y = _map_point(homographies, 0, u, v)
            value = _sample(left, within_left, x, y)
            total_left += value
            x, y = _map_point(homographies, 9, u, v)
            total_right += _sample(right, within_right, x, y)
            if crossed:
                x, y = _map_point(homographies, 18, u, v)
                inside = _inside(e, x, y)
                a = (value - np.float32(128.0)) * inside
                b = (_sample(right, within_right, x, y) - np.float32(128.0)) * inside
                s0 += inside
                s1 += a
                s2 += b
                s3 += a * a
                s4 += b * b
                s5 += a * b
    blocks[0, t], blocks[1, t] = total_left, total_right
    sums[0, t], sums[1, t], sums[2, t], sums[3, t], sums[4, t], sums[5, t] = s0, s1, s2, s3, s4, s5
    cuda.syncthreads()

    # from here on a thread has one part of one view, or a share of one of the correlation's sums
    view, part = t // parts, t % parts
    f = cuda.local.array(16, np.float32)
    if view < 2:
        _wavelets(blocks[view], across, part, f)
        brightness[t] = f[0]
    if t < _SUMS * _LANES:
        total = np.float32(0.0)
        for i in range(t % _LANES, 16 * parts, _LANES):
            total += sums[t // _LANES, i]
        folded[t // _LANES, t % _LANES] = total
    cuda.syncthreads()
    if view < 2:
        _settle_median(brightness, view * parts, parts, part, middles[view])
    cuda.syncthreads()
    if view < 2:
        f[0] -= np.float32(0.5) * (middles[view, 0] + middles[view, 1])
        total = np.float32(0.0)
        for c in range(16):
            total += f[c] * f[c]
        norm2[t] = total
    cuda.syncthreads()
    if view < 2:
        _settle_median(norm2, view * parts, parts, part, middles[2 + view])
    cuda.syncthreads()
    if view < 2:
        floor = np.float32(observations[layout.CONTRAST_FLOOR_INDEX])
        min_norm2 = floor * floor * (np.float32(0.5) * (middles[2 + view, 0] + middles[2 + view, 1])) + np.float32(1.0)
        scale = np.float32(1.0) / math.sqrt(norm2[t] + min_norm2)
        distance = np.float32(0.0)
        for c in range(16):
            d = f[c] * scale - np.float32(observation[layout.REFERENCE_FEATURES + 16 * t + c])
            distance += d * d
        brightness[t] = min(distance, np.float32(observations[layout.DISTANCE_CAP_INDEX]))
    cuda.syncthreads()
    if t == 0:
        single = np.float32(0.0)
        for i in range(2 * parts):
            single += brightness[i]
        s = cuda.local.array(_SUMS, np.float32)
        for k in range(_SUMS):
            s[k] = np.float32(0.0)
            for i in range(_LANES):
                s[k] += folded[k, i]
        min_norm2 = np.float32(MIN_OVERLAP) * (np.float32(4 * across * sx) * rows / np.float32(CORRELATION_ROW_STEP))
        ncc = _correlation(s, min_norm2)
        unlike = (1.0 - ncc) * (1.0 - ncc)
        ll = -observations[layout.LAMBDA_SINGLE_INDEX] * single - observations[layout.LAMBDA_CROSS_INDEX] * unlike
        pool[int(observation[layout.HALF_BEFORE]), layout.LIKELIHOOD_ROW, particle] = ll
