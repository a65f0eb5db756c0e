"""The kernels of the weights, their moments and what resampling needs, as in `filter.resampling`.

`memory_layout` describes the memory. Sums are taken in a fixed order, so that the same particles always give the same
numbers.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

from paceline.speed.filter.cuda import memory_layout as layout
from paceline.speed.filter.cuda.compiling import kernel

MAX_THREADS_PER_BLOCK = 512  # of kernels that add something up; a power of two
PARTIAL_SUMS = 3  # numbers that each of the blocks that share a vehicle writes
THREADS_PER_QUANTITY, QUANTITIES_PER_BLOCK = 64, 8  # of `reduce_moments`, the threads at most


@cuda.jit(device=True)
def _block_sum(value, scratch):
    """The sum of ``value`` over the block's threads, returned to each of them."""
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
def reduce_moments(pool, command_buffer, results):
    """Moments, extremes and Σ W² of the weighted particles of all vehicles.

    Blocks are (x, groups of QUANTITIES_PER_BLOCK of QUANTITY_COUNT + DRAWN_ROW_COUNT quantities, slots), threads (x,
    quantities of the group). ``results`` holds for each slot, quantity and x block two numbers: for first and second
    moments about the first particle, by MOMENT_PAIRS, and for Σ W² the sum over the block's particles and the first
    particle's own value; for the extremes the least and the greatest of the finite values. After these come for each
    slot DRAWN_ROW_COUNT rows: the projected centres of every DRAWN_STRIDE-th particle.
    """
    b, v, t, y = cuda.blockIdx.x, cuda.blockIdx.z, cuda.threadIdx.x, cuda.threadIdx.y
    blocks, slots, quantity = cuda.gridDim.x, cuda.gridDim.z, cuda.blockIdx.y * QUANTITIES_PER_BLOCK + y
    low = cuda.shared.array((QUANTITIES_PER_BLOCK, THREADS_PER_QUANTITY), np.float64)
    high = cuda.shared.array((QUANTITIES_PER_BLOCK, THREADS_PER_QUANTITY), np.float64)
    command = command_buffer[v * layout.COMMAND_SIZE : (v + 1) * layout.COMMAND_SIZE]
    N = int(command[layout.PARTICLE_COUNT])
    if N == 0:
        return
    rows, first = pool[int(command[layout.HALF_AFTER])], int(command[layout.FIRST_COLUMN])
    begin, stride = b * cuda.blockDim.x + t, blocks * cuda.blockDim.x
    moments, extremes = (
        slots * layout.QUANTITY_COUNT * blocks * 2,
        layout.FIRST_EXTREME <= quantity < layout.QUANTITY_COUNT,
    )
    one, other = 0.0, 0.0
    if extremes:
        one, other = math.inf, -math.inf
        for p in range(first + begin, first + N, stride):
            value = rows[quantity - layout.FIRST_EXTREME, p]
            if math.isfinite(value):
                one, other = min(one, value), max(other, value)
    elif quantity == layout.SUM_OF_SQUARES:
        for p in range(first + begin, first + N, stride):
            one += rows[layout.WEIGHT_ROW, p] * rows[layout.WEIGHT_ROW, p]
    elif quantity < layout.MOMENT_COUNT:
        i, j = (
            layout.MOMENT_PAIRS[int(command[layout.IS_FREE]), quantity, 0],
            layout.MOMENT_PAIRS[int(command[layout.IS_FREE]), quantity, 1],
        )
        other = rows[i, first]
        for p in range(first + begin, first + N, stride):
            term = rows[layout.WEIGHT_ROW, p] * (rows[i, p] - other)
            if j >= 0:
                term *= rows[j, p] - rows[j, first]
            one += term
    elif quantity < layout.QUANTITY_COUNT + layout.DRAWN_ROW_COUNT:
        row, every = quantity - layout.QUANTITY_COUNT, int(command[layout.DRAWN_STRIDE])
        n_drawn = (results.shape[0] - moments) // (slots * layout.DRAWN_ROW_COUNT)
        start = moments + (v * layout.DRAWN_ROW_COUNT + row) * n_drawn
        for k in range(begin, (N + every - 1) // every, stride):
            results[start + k] = rows[layout.LEFT_CROSSING_ROW + row, first + k * every]
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
    if t == 0 and quantity < layout.QUANTITY_COUNT:
        start = 2 * ((v * layout.QUANTITY_COUNT + quantity) * blocks + b)
        results[start], results[start + 1] = low[y, 0], high[y, 0]


@cuda.jit(device=True)
def _normalise(rows, first, last, stride, total):
    """Normalise log weights whose sum is exp(``total``), from ``first`` to ``last``."""
    for p in range(first, last, stride):
        rows[layout.LOG_WEIGHT_ROW, p] -= total
        rows[layout.WEIGHT_ROW, p] = math.exp(rows[layout.LOG_WEIGHT_ROW, p])


@cuda.jit(device=True)
def _logarithm(greatest, total):
    """The logarithm of exp(``greatest``) · ``total``, −∞ where that is zero."""
    return greatest + math.log(total) if total > 0.0 else -math.inf


@kernel
def update_weights(pool, observations, shares):
    """Update the weights by the row LIKELIHOOD, log p(z | x), and normalise them ([Zhu] (2)).

    Blocks are (x, slots). Where WEIGHT_UPDATE is −1 the weights before the last update are restored instead. Where
    several blocks share a vehicle, each writes the greatest log weight and the sum of weights relative to it to
    ``shares`` (slots, x, PARTIAL_SUMS), and `normalise` does the rest.
    """
    b, v, t, n = cuda.blockIdx.x, cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    observation = observations[
        layout.HEADER_SIZE + v * layout.OBSERVATION_SIZE : layout.HEADER_SIZE + (v + 1) * layout.OBSERVATION_SIZE
    ]
    times, N = observation[layout.WEIGHT_UPDATE], int(observation[layout.PARTICLE_COUNT])
    if N == 0 or times == 0.0:
        return
    rows = pool[int(observation[layout.HALF_BEFORE])]
    first, stride = int(observation[layout.FIRST_COLUMN]) + b * n + t, cuda.gridDim.x * n
    last = int(observation[layout.FIRST_COLUMN]) + N
    scratch = cuda.shared.array(MAX_THREADS_PER_BLOCK, np.float64)
    if times < 0.0:
        for p in range(first, last, stride):
            rows[layout.LOG_WEIGHT_ROW, p] = rows[layout.PREVIOUS_LOG_WEIGHT_ROW, p]
            rows[layout.WEIGHT_ROW, p] = math.exp(rows[layout.LOG_WEIGHT_ROW, p])
        return
    greatest = -math.inf
    for p in range(first, last, stride):
        rows[layout.PREVIOUS_LOG_WEIGHT_ROW, p] = rows[layout.LOG_WEIGHT_ROW, p]
        rows[layout.LOG_WEIGHT_ROW, p] += rows[layout.LIKELIHOOD_ROW, p]
        if rows[layout.LOG_WEIGHT_ROW, p] > greatest:
            greatest = rows[layout.LOG_WEIGHT_ROW, p]
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
        total += math.exp(rows[layout.LOG_WEIGHT_ROW, p] - greatest)
    total = _block_sum(total, scratch)
    if cuda.gridDim.x == 1:
        _normalise(rows, first, last, stride, _logarithm(greatest, total))
    elif t == 0:
        shares[v, b, 0], shares[v, b, 1] = greatest, total


@kernel
def normalise(pool, observations, shares):
    """Normalise the weights of vehicles that several blocks share, from the sums of `update_weights`."""
    v = cuda.blockIdx.y
    observation = observations[
        layout.HEADER_SIZE + v * layout.OBSERVATION_SIZE : layout.HEADER_SIZE + (v + 1) * layout.OBSERVATION_SIZE
    ]
    N, first = int(observation[layout.PARTICLE_COUNT]), int(observation[layout.FIRST_COLUMN])
    if N == 0 or observation[layout.WEIGHT_UPDATE] <= 0.0:
        return
    greatest, total = -math.inf, 0.0
    for b in range(cuda.gridDim.x):
        greatest = max(greatest, shares[v, b, 0])
    for b in range(cuda.gridDim.x):
        if shares[v, b, 0] > -math.inf:  # otherwise a block without a particle, or with none of any weight
            total += shares[v, b, 1] * math.exp(shares[v, b, 0] - greatest)
    total, stride = _logarithm(greatest, total), cuda.gridDim.x * cuda.blockDim.x
    _normalise(pool[int(observation[layout.HALF_BEFORE])], first + cuda.grid(1), first + N, stride, total)


@cuda.jit(device=True)
def _points_below(total, u, N):
    """How many of the points (p + u)/N, p = 0 … N − 1, are no greater than ``total``."""
    return min(max(math.floor(total * N - u) + 1.0, 0.0), float(N))


@cuda.jit(device=True)
def _thread_range(N):
    """The range of a vehicle's N particles that this thread adds up: first, and last excluded."""
    length = (N + cuda.gridDim.x * cuda.blockDim.x - 1) // (cuda.gridDim.x * cuda.blockDim.x)
    return min(cuda.grid(1) * length, N), min((cuda.grid(1) + 1) * length, N)


@cuda.jit(device=True)
def _range_sum(rows, first, last):
    """The sum of the weights from ``first`` to ``last``."""
    total = 0.0
    for p in range(first, last):
        total += rows[layout.WEIGHT_ROW, p]
    return total


@kernel
def sum_weights(pool, command_buffer, shares):
    """The sum of the weights of each of a vehicle's x blocks of `cumulate_weights`, into ``shares``."""
    v = cuda.blockIdx.y
    command = command_buffer[v * layout.COMMAND_SIZE : (v + 1) * layout.COMMAND_SIZE]
    if command[layout.RESAMPLE] == 0.0:
        return
    begin, (first, last) = int(command[layout.FIRST_COLUMN]), _thread_range(int(command[layout.PARTICLE_COUNT]))
    partial_sum = _range_sum(pool[int(command[layout.HALF_BEFORE])], begin + first, begin + last)
    partial_sum = _block_sum(partial_sum, cuda.shared.array(MAX_THREADS_PER_BLOCK, np.float64))
    if cuda.threadIdx.x == 0:
        shares[v, cuda.blockIdx.x, 0] = partial_sum


@kernel
def cumulate_weights(pool, command_buffer, shares):
    """Cumulative weights of each vehicle to be resampled, the last one 1, and the mean heading of the survivors.

    Blocks are (x, slots); every thread adds up a range of its own. Where several blocks share a vehicle, they start
    with the sums of `sum_weights`, and write their part of the headings to ``shares`` (slots, x, PARTIAL_SUMS), for
    `average_headings`.
    """
    b, v, t, n = cuda.blockIdx.x, cuda.blockIdx.y, cuda.threadIdx.x, cuda.blockDim.x
    command = command_buffer[v * layout.COMMAND_SIZE : (v + 1) * layout.COMMAND_SIZE]
    if command[layout.RESAMPLE] == 0.0:
        return
    rows, begin, N, u = (
        pool[int(command[layout.HALF_BEFORE])],
        int(command[layout.FIRST_COLUMN]),
        int(command[layout.PARTICLE_COUNT]),
        command[layout.RESAMPLING_OFFSET],
    )
    scratch = cuda.shared.array(MAX_THREADS_PER_BLOCK, np.float64)
    first, last = _thread_range(N)
    scratch[t] = _range_sum(rows, begin + first, begin + last)
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
        total += rows[layout.WEIGHT_ROW, begin + p]
        rows[layout.CUMULATIVE_WEIGHT_ROW, begin + p] = total if p < N - 1 else 1.0
        end = _points_below(total, u, N) if p < N - 1 else float(N)
        yaw += (end - below) * rows[layout.HEADING_ROW, begin + p]
        pitch += (end - below) * rows[layout.HEADING_ROW + 1, begin + p]
        below = end
    yaw = _block_sum(yaw, scratch)
    pitch = _block_sum(pitch, scratch)
    if t == 0:
        shares[v, b, 1], shares[v, b, 2] = yaw, pitch
        if cuda.gridDim.x == 1:
            command[layout.MEAN_HEADING], command[layout.MEAN_HEADING + 1] = yaw / N, pitch / N


@kernel
def average_headings(command_buffer, shares):
    """The mean headings of survivors, from the partial sums of `cumulate_weights`; one thread a vehicle."""
    v = cuda.grid(1)
    if v >= shares.shape[0] or command_buffer[v * layout.COMMAND_SIZE + layout.RESAMPLE] == 0.0:
        return
    yaw, pitch, N = 0.0, 0.0, command_buffer[v * layout.COMMAND_SIZE + layout.PARTICLE_COUNT]
    for b in range(shares.shape[1]):
        yaw += shares[v, b, 1]
        pitch += shares[v, b, 2]
    (
        command_buffer[v * layout.COMMAND_SIZE + layout.MEAN_HEADING],
        command_buffer[v * layout.COMMAND_SIZE + layout.MEAN_HEADING + 1],
    ) = yaw / N, pitch / N
