"""Weights, moments and resampling on a GPU, as in `particles`; a cloud is an array (ROWS, N) as in `motion_cuda`.

Sums are taken in a fixed order, so that the same cloud gives the same numbers every time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

THREADS = 512  # at most, in a block that adds something up; a power of two


@cuda.jit(device=True)
def _block_sum(value, scratch):
    """The sum of ``value`` over the block's threads, to every one of them."""
    t, half = cuda.threadIdx.x, cuda.blockDim.x // 2
    scratch[t] = value
    cuda.syncthreads()
    while half > 0:
        if t < half:
            scratch[t] += scratch[t + half]
        cuda.syncthreads()
        half //= 2
    total = scratch[0]
    cuda.syncthreads()
    return total


@cuda.jit(cache=True)
def moments(rows, W, pairs, partial):
    """Weighted first and second moments about the first particle, into ``partial`` (pairs, blocks + 1).

    ``pairs`` (P, 2) are two rows, or one and −1. The last column is the first particle's own value of the first row.
    """
    pair, b, t = cuda.blockIdx.y, cuda.blockIdx.x, cuda.threadIdx.x
    i, j = pairs[pair, 0], pairs[pair, 1]
    scratch = cuda.shared.array(THREADS, np.float64)
    total, stride = 0.0, cuda.gridDim.x * cuda.blockDim.x
    for p in range(b * cuda.blockDim.x + t, rows.shape[1], stride):
        term = W[p] * (rows[i, p] - rows[i, 0])
        if j >= 0:
            term *= rows[j, p] - rows[j, 0]
        total += term
    total = _block_sum(total, scratch)
    if t == 0:
        partial[pair, b] = total
        if b == 0:
            partial[pair, cuda.gridDim.x] = rows[i, 0]


@cuda.jit(cache=True)
def extremes(rows, found):
    """Least and greatest of the finite values in each of the first rows, into ``found`` (rows, 2); one block a row."""
    row, t = cuda.blockIdx.x, cuda.threadIdx.x
    low = cuda.shared.array(THREADS, np.float64)
    high = cuda.shared.array(THREADS, np.float64)
    least, greatest = math.inf, -math.inf
    for p in range(t, rows.shape[1], cuda.blockDim.x):
        value = rows[row, p]
        if math.isfinite(value):
            least, greatest = min(least, value), max(greatest, value)
    low[t], high[t] = least, greatest
    cuda.syncthreads()
    half = cuda.blockDim.x // 2
    while half > 0:
        if t < half:
            low[t], high[t] = min(low[t], low[t + half]), max(high[t], high[t + half])
        cuda.syncthreads()
        half //= 2
    if t == 0:
        found[row, 0], found[row, 1] = low[0], high[0]


@cuda.jit(cache=True)
def reweigh(lw, log_likelihood, first, times, W, told):
    """The normalised weights after an observation ([Zhu] (2)), in logarithms ``lw`` (N,) and as ``W`` (N,).

    Theirs are the ``log_likelihood`` (M,) from the ``first`` on; ``times`` is 1, and −1 takes an observation back.
    ``told`` (2,) becomes the logarithm of what all weighed together, and Σ W². By one block.
    """
    t, n = cuda.threadIdx.x, cuda.blockDim.x
    scratch = cuda.shared.array(THREADS, np.float64)
    greatest = -math.inf
    for p in range(t, lw.shape[0], n):
        lw[p] += times * log_likelihood[first + p]
        if lw[p] > greatest:
            greatest = lw[p]
    scratch[t] = greatest
    cuda.syncthreads()
    half = n // 2
    while half > 0:
        if t < half:
            scratch[t] = max(scratch[t], scratch[t + half])
        cuda.syncthreads()
        half //= 2
    greatest = scratch[0]
    cuda.syncthreads()
    total = 0.0
    for p in range(t, lw.shape[0], n):
        total += math.exp(lw[p] - greatest)
    total = _block_sum(total, scratch)
    total = greatest + math.log(total) if total > 0.0 else -math.inf
    squares = 0.0
    for p in range(t, lw.shape[0], n):
        lw[p] -= total
        W[p] = math.exp(lw[p])
        squares += W[p] * W[p]
    squares = _block_sum(squares, scratch)
    if t == 0:
        told[0], told[1] = total, squares


@cuda.jit(cache=True)
def cumulate(W, cumulative):
    """Running sums of ``W`` (N,), the last one 1, by one block: every thread adds up a stretch of its own."""
    t, n, N = cuda.threadIdx.x, cuda.blockDim.x, W.shape[0]
    scratch = cuda.shared.array(THREADS, np.float64)
    stretch = (N + n - 1) // n
    first, last = min(t * stretch, N), min((t + 1) * stretch, N)
    own = 0.0
    for p in range(first, last):
        own += W[p]
    scratch[t] = own
    cuda.syncthreads()
    reach = 1
    while reach < n:
        before = scratch[t - reach] if t >= reach else 0.0
        cuda.syncthreads()
        scratch[t] += before
        cuda.syncthreads()
        reach *= 2
    total = scratch[t - 1] if t > 0 else 0.0
    for p in range(first, last):
        total += W[p]
        cumulative[p] = total if p < N - 1 else 1.0


@cuda.jit(cache=True)
def survive(rows, cumulative, u, kept, lw, W):
    """Systematic resampling: ``kept`` (ROWS, N) is what survives of ``rows`` with the offset ``u``; weights equal."""
    p = cuda.grid(1)
    N = rows.shape[1]
    if p >= N:
        return
    point = (p + u) / N
    low, high = 0, N - 1
    while low < high:
        half = (low + high) // 2
        if cumulative[half] < point:
            low = half + 1
        else:
            high = half
    for i in range(rows.shape[0]):
        kept[i, p] = rows[i, low]
    lw[p] = -math.log(N)
    W[p] = 1.0 / N


@cuda.jit(cache=True)
def stir(rows, first, partial, keep, noise, spread_of_first, spread_of_second):
    """Draw two static rows from ``first`` on to their means, by ``keep``, and stir them by ``noise`` (2, N) times
    their spreads; ``partial`` is what `moments` gives for them."""
    p = cuda.grid(1)
    if p >= rows.shape[1]:
        return
    for k in range(2):
        mean = 0.0
        for b in range(partial.shape[1]):
            mean += partial[k, b]
        spread = spread_of_first if k == 0 else spread_of_second
        rows[first + k, p] = mean + keep * (rows[first + k, p] - mean) + noise[k, p] * spread


@cuda.jit(cache=True)
def thin(rows, first, every, shown):
    """``shown`` (K, M): every so many-th particle's K rows from ``first`` on."""
    p = cuda.grid(1)
    if p < shown.shape[1]:
        for i in range(shown.shape[0]):
            shown[i, p] = rows[first + i, p * every]
