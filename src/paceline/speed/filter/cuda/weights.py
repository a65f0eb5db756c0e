"""Weights, moments and what resampling needs on a GPU, as in `filter.resampling`; the memory is that of
`memory_layout`.

Sums are taken in a fixed order, so that the same particles give the same numbers every time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

from paceline.speed.filter.cuda import memory_layout as at
from paceline.speed.filter.cuda.compiling import kernel

THREADS = 512  # at most, in a block that adds something up; a power of two
SHARES = 3  # numbers that a block leaves to those that go on with a vehicle's weights
SURVEYORS, SIDE_BY_SIDE = 64, 8  # threads at most for one quantity, and quantities, of a block that takes moments


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


@kernel
def survey(pool, desk, told):
    """What the weighted particles of all vehicles come to.

    Blocks are (x, for QUANTITIES and then SHOWN_ROWS, slots), of threads (x, SIDE_BY_SIDE quantities). Into ``told``
    go, for each slot, quantity and x block, two numbers: a sum over the block's share of particles and the first
    particle's own value, for first and second moments about the first particle, by PAIRS, and for Σ W²; for the
    EXTREMES the least and the greatest of the finite values. After them all come, for each slot, SHOWN_ROWS rows of
    every so many-th particle's projected centres.
    """
    b, v, t, y = cuda.blockIdx.x, cuda.blockIdx.z, cuda.threadIdx.x, cuda.threadIdx.y
    blocks, slots, quantity = cuda.gridDim.x, cuda.gridDim.z, cuda.blockIdx.y * SIDE_BY_SIDE + y
    low = cuda.shared.array((SIDE_BY_SIDE, SURVEYORS), np.float64)
    high = cuda.shared.array((SIDE_BY_SIDE, SURVEYORS), np.float64)
    order = desk[v * at.ORDER : (v + 1) * at.ORDER]
    N = int(order[at.COUNT])
    if N == 0:
        return
    rows, first = pool[int(order[at.NOW])], int(order[at.FIRST])
    begin, stride = b * cuda.blockDim.x + t, blocks * cuda.blockDim.x
    moments, extremes = slots * at.QUANTITIES * blocks * 2, at.EXTREMES <= quantity < at.QUANTITIES
    one, other = 0.0, 0.0
    if extremes:
        one, other = math.inf, -math.inf
        for p in range(first + begin, first + N, stride):
            value = rows[quantity - at.EXTREMES, p]
            if math.isfinite(value):
                one, other = min(one, value), max(other, value)
    elif quantity == at.SQUARES:
        for p in range(first + begin, first + N, stride):
            one += rows[at.WEIGHT, p] * rows[at.WEIGHT, p]
    elif quantity < at.MOMENTS:
        i, j = at.PAIRS[int(order[at.FREE]), quantity, 0], at.PAIRS[int(order[at.FREE]), quantity, 1]
        other = rows[i, first]
        for p in range(first + begin, first + N, stride):
            term = rows[at.WEIGHT, p] * (rows[i, p] - other)
            if j >= 0:
                term *= rows[j, p] - rows[j, first]
            one += term
    elif quantity < at.QUANTITIES + at.SHOWN_ROWS:
        row, every = quantity - at.QUANTITIES, int(order[at.EVERY])
        shown = (told.shape[0] - moments) // (slots * at.SHOWN_ROWS)
        start = moments + (v * at.SHOWN_ROWS + row) * shown
        for k in range(begin, (N + every - 1) // every, stride):
            told[start + k] = rows[at.CROSSING_LEFT + row, first + k * every]
    low[y, t], high[y, t] = one, other
    cuda.syncthreads()
    half = cuda.blockDim.x // 2
    while half > 0:
        if t < half and extremes:
            low[y, t], high[y, t] = min(low[y, t], low[y, t + half]), max(high[y, t], high[y, t + half])
        elif t < half:
            low[y, t] += low[y, t + half]
        cuda.syncthreads()
        half //= 2
    if t == 0 and quantity < at.QUANTITIES:
        start = 2 * ((v * at.QUANTITIES + quantity) * blocks + b)
        told[start], told[start + 1] = low[y, 0], high[y, 0]


@cuda.jit(device=True)
def _normalise(rows, first, last, stride, total):
    """Logarithms of weights whose sum is exp(``total``), from ``first`` to ``last``, made weights."""
    for p in range(first, last, stride):
        rows[at.LOG_WEIGHT, p] -= total
        rows[at.WEIGHT, p] = math.exp(rows[at.LOG_WEIGHT, p])


@cuda.jit(device=True)
def _logarithm(greatest, total):
    """Of the sum exp(``greatest``) · ``total``, −∞ where there is none."""
    return greatest + math.log(total) if total > 0.0 else -math.inf


@kernel
def reweigh(pool, sights, shares):
    """The normalised weights after an observation ([Zhu] (2)), in logarithms and as themselves.

    Blocks are (x, slots). The observation is the row LIKELIHOOD, log p(z | x). Where ``sights`` say so, the last one is
    taken back instead. A vehicle's x blocks leave the greatest logarithm of their weights, and the sum of the weights
    beside it, in ``shares`` (slots, x, SHARES), and `normalise` does the rest; a block of its own does it all.
    """
    b, v, t, n = cuda.blockIdx.x, cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    sight = sights[at.HEADER + v * at.SIGHT : at.HEADER + (v + 1) * at.SIGHT]
    times, N = sight[at.TIMES], int(sight[at.COUNT])
    if N == 0 or times == 0.0:
        return
    rows = pool[int(sight[at.BEFORE])]
    first, stride = int(sight[at.FIRST]) + b * n + t, cuda.gridDim.x * n
    last = int(sight[at.FIRST]) + N
    scratch = cuda.shared.array(THREADS, np.float64)
    if times < 0.0:
        for p in range(first, last, stride):
            rows[at.LOG_WEIGHT, p] = rows[at.UNWEIGHED, p]
            rows[at.WEIGHT, p] = math.exp(rows[at.LOG_WEIGHT, p])
        return
    greatest = -math.inf
    for p in range(first, last, stride):
        rows[at.UNWEIGHED, p] = rows[at.LOG_WEIGHT, p]
        rows[at.LOG_WEIGHT, p] += rows[at.LIKELIHOOD, p]
        if rows[at.LOG_WEIGHT, p] > greatest:
            greatest = rows[at.LOG_WEIGHT, p]
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
    for p in range(first, last, stride):
        total += math.exp(rows[at.LOG_WEIGHT, p] - greatest)
    total = _block_sum(total, scratch)
    if cuda.gridDim.x == 1:
        _normalise(rows, first, last, stride, _logarithm(greatest, total))
    elif t == 0:
        shares[v, b, 0], shares[v, b, 1] = greatest, total


@kernel
def normalise(pool, sights, shares):
    """What `reweigh` leaves to be done with the weights of vehicles that several blocks see to."""
    v = cuda.blockIdx.y
    sight = sights[at.HEADER + v * at.SIGHT : at.HEADER + (v + 1) * at.SIGHT]
    N, first = int(sight[at.COUNT]), int(sight[at.FIRST])
    if N == 0 or sight[at.TIMES] <= 0.0:
        return
    greatest, total = -math.inf, 0.0
    for b in range(cuda.gridDim.x):
        greatest = max(greatest, shares[v, b, 0])
    for b in range(cuda.gridDim.x):
        if shares[v, b, 0] > -math.inf:  # otherwise a block without a particle, or with none of any weight
            total += shares[v, b, 1] * math.exp(shares[v, b, 0] - greatest)
    total, stride = _logarithm(greatest, total), cuda.gridDim.x * cuda.blockDim.x
    _normalise(pool[int(sight[at.BEFORE])], first + cuda.grid(1), first + N, stride, total)


@cuda.jit(device=True)
def _points_below(total, u, N):
    """How many of the points (p + u)/N, p = 0 … N − 1, are no greater than ``total``."""
    return min(max(math.floor(total * N - u) + 1.0, 0.0), float(N))


@cuda.jit(device=True)
def _stretch(N):
    """Which of a vehicle's N particles this thread adds up, from the first to the last, excluded."""
    length = (N + cuda.gridDim.x * cuda.blockDim.x - 1) // (cuda.gridDim.x * cuda.blockDim.x)
    return min(cuda.grid(1) * length, N), min((cuda.grid(1) + 1) * length, N)


@cuda.jit(device=True)
def _stretch_sum(rows, first, last):
    """The sum of the weights from ``first`` to ``last``."""
    total = 0.0
    for p in range(first, last):
        total += rows[at.WEIGHT, p]
    return total


@kernel
def add_up(pool, desk, shares):
    """The sum of the weights that each of a vehicle's x blocks of `cumulate` will see to, into ``shares``."""
    v = cuda.blockIdx.y
    order = desk[v * at.ORDER : (v + 1) * at.ORDER]
    if order[at.RESAMPLED] == 0.0:
        return
    begin, (first, last) = int(order[at.FIRST]), _stretch(int(order[at.COUNT]))
    own = _stretch_sum(pool[int(order[at.BEFORE])], begin + first, begin + last)
    own = _block_sum(own, cuda.shared.array(THREADS, np.float64))
    if cuda.threadIdx.x == 0:
        shares[v, cuda.blockIdx.x, 0] = own


@kernel
def cumulate(pool, desk, shares):
    """Running sums of the weights of each vehicle to be resampled, the last one 1, and the mean headings of those of
    its particles that will survive, into its order.

    Blocks are (x, slots); every thread adds up a stretch of its own. A vehicle's x blocks go on from the sums that
    `add_up` found, and leave their part of the headings in ``shares`` (slots, x, SHARES), for `average`; a block of
    its own needs neither.
    """
    b, v, t, n = cuda.blockIdx.x, cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    order = desk[v * at.ORDER : (v + 1) * at.ORDER]
    if order[at.RESAMPLED] == 0.0:
        return
    rows, begin, N, u = pool[int(order[at.BEFORE])], int(order[at.FIRST]), int(order[at.COUNT]), order[at.OFFSET]
    scratch = cuda.shared.array(THREADS, np.float64)
    first, last = _stretch(N)
    scratch[t] = _stretch_sum(rows, begin + first, begin + last)
    cuda.syncthreads()
    reach = 1
    while reach < n:
        before = scratch[t - reach] if t >= reach else 0.0
        cuda.syncthreads()
        scratch[t] += before
        cuda.syncthreads()
        reach *= 2
    total = scratch[t - 1] if t > 0 else 0.0
    cuda.syncthreads()
    for other in range(b):
        total += shares[v, other, 0]
    yaw, pitch, below = 0.0, 0.0, _points_below(total, u, N) if first > 0 else 0.0
    for p in range(first, last):
        total += rows[at.WEIGHT, begin + p]
        rows[at.CUMULATED, begin + p] = total if p < N - 1 else 1.0
        then = _points_below(total, u, N) if p < N - 1 else float(N)
        yaw += (then - below) * rows[at.HEADING, begin + p]
        pitch += (then - below) * rows[at.HEADING + 1, begin + p]
        below = then
    yaw = _block_sum(yaw, scratch)
    pitch = _block_sum(pitch, scratch)
    if t == 0:
        shares[v, b, 1], shares[v, b, 2] = yaw, pitch
        if cuda.gridDim.x == 1:
            order[at.MEAN], order[at.MEAN + 1] = yaw / N, pitch / N


@kernel
def average(desk, shares):
    """The mean headings of survivors, from the parts that `cumulate` left; one thread a vehicle."""
    v = cuda.grid(1)
    if v >= shares.shape[0] or desk[v * at.ORDER + at.RESAMPLED] == 0.0:
        return
    yaw, pitch, N = 0.0, 0.0, desk[v * at.ORDER + at.COUNT]
    for b in range(shares.shape[1]):
        yaw += shares[v, b, 1]
        pitch += shares[v, b, 2]
    desk[v * at.ORDER + at.MEAN], desk[v * at.ORDER + at.MEAN + 1] = yaw / N, pitch / N
