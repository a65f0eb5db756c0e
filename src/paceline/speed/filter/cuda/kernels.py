"""What is done with particles on a GPU, one thread for each: resampling, and all that moves them.

How they lie in memory, and the orders for them, is told in `memory_layout`; the arguments of functions are those of
`motion`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

from paceline.speed.filter.cuda import memory_layout as at
from paceline.speed.filter.cuda.compiling import kernel
from paceline.speed.filter.cuda.motion import along_path, draw, frame, freely, identity, move, prepare, set_speed
from paceline.speed.filter.resampling import KEPT


@cuda.jit(device=True)
def _survive(pool, q, p, desk, order):
    """Systematic resampling, by the running sums of the weights: what survives as particle ``p``, stirred.

    The headings, static parameters, are drawn to their mean as they are stirred.
    """
    noise = cuda.local.array(2, np.float64)
    before, rows = pool[int(order[at.BEFORE])], pool[int(order[at.NOW])]
    first, N = int(order[at.FIRST]), int(order[at.COUNT])
    point = (p + order[at.OFFSET]) / N
    low, high = 0, N - 1
    while low < high:
        half = (low + high) // 2
        if before[at.CUMULATED, first + half] < point:
            low = half + 1
        else:
            high = half
    for i in range(at.MOVING):
        rows[i, q] = before[i, first + low]
    rows[at.LOG_WEIGHT, q] = -math.log(float(N))
    rows[at.WEIGHT, q] = 1.0 / N
    draw(desk, order, at.STIRRING, 2, p, noise, 0)
    for k in range(2):
        mean = order[at.MEAN + k]
        rows[at.HEADING + k, q] = mean + KEPT * (rows[at.HEADING + k, q] - mean) + noise[k] * order[at.SPREAD + k]


@cuda.jit(device=True)
def _square(rows, q, normal):
    """The plane through its own centre, square to ``normal`` (3,)."""
    distance = 0.0
    for i in range(3):
        rows[at.NORMAL + i, q] = normal[i]
        distance += rows[at.PLACE + i, q] * normal[i]
    rows[at.DISTANCE, q] = distance


@cuda.jit(device=True)
def _correct(rows, q, p, desk, order, rig, knots):
    """`motion_models.corrected`, with the motion's ``followed``: the ensemble Kalman step."""
    noise = cuda.local.array(3, np.float64)
    off, shift = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    change, dR = cuda.local.array(3, np.float64), cuda.local.array((3, 3), np.float64)
    place, root, gain = (
        order[at.STEP : at.STEP + 3],
        order[at.STEP + 3 : at.STEP + 12],
        order[at.STEP + 12 : at.STEP + 30],
    )
    draw(desk, order, at.SEEN_NOISE, 3, p, noise, 0)
    for i in range(3):
        stirred = root[3 * i] * noise[0] + root[3 * i + 1] * noise[1] + root[3 * i + 2] * noise[2]
        off[i] = place[i] + stirred - rows[at.PLACE + i, q]
    for i in range(3):
        shift[i] = gain[3 * i] * off[0] + gain[3 * i + 1] * off[1] + gain[3 * i + 2] * off[2]
        change[i] = gain[9 + 3 * i] * off[0] + gain[10 + 3 * i] * off[1] + gain[11 + 3 * i] * off[2]
    if order[at.FREE] != 0.0:
        for i in range(3):
            rows[at.VELOCITY + i, q] += change[i]
        set_speed(rows, q)
    else:
        rows[at.SPEED, q] += change[0]
        rows[at.HEADING, q] += change[1]
        rows[at.HEADING + 1, q] += change[2]
        F = cuda.local.array((3, 3), np.float64)
        frame(knots, rows[at.S, q], F)
        rows[at.S, q] += shift[0] * F[0, 0] + shift[1] * F[1, 0] + shift[2] * F[2, 0]
    identity(dR)
    move(rows, q, rig, dR, shift)


@kernel
def carry_out(pool, desk, rigs, knots, maps):
    """The orders at the beginning of ``desk``, for all vehicles at once: y blocks for slots, x threads for particles.

    ``rigs`` (rigs, 7, 3, 3) and ``knots`` (knots, KNOT) are tables, ``maps`` (columns, MAPS) what `prepare` makes.
    """
    v, p = cuda.blockIdx.y, cuda.grid(1)
    order = desk[v * at.ORDER : (v + 1) * at.ORDER]
    if p >= int(order[at.COUNT]) or order[at.PREPARED] == 0.0:
        return
    q = int(order[at.FIRST]) + p
    rows, rig = pool[int(order[at.NOW])], rigs[int(order[at.RIG])]
    path = knots[int(order[at.KNOTS]) : int(order[at.KNOTS]) + int(order[at.KNOT_COUNT])]
    if order[at.RESAMPLED] != 0.0:
        _survive(pool, q, p, desk, order)
    if order[at.SQUARED] != 0.0:
        _square(rows, q, order[at.TOWARDS : at.TOWARDS + 3])
    if order[at.MOVED] != 0.0:
        if order[at.FREE] != 0.0:
            freely(rows, q, p, desk, order, rig)
        else:
            along_path(rows, q, p, desk, order, rig, path)
    if order[at.CORRECTED] != 0.0:
        _correct(rows, q, p, desk, order, rig, path)
    prepare(rows, q, rig, maps[q])


@kernel
def settle(source, pool, first):
    """The numbers ``source`` (halves, rows, columns) into the pool, from the ``first`` column on; y blocks for rows."""
    i, p = cuda.blockIdx.y, cuda.grid(1)
    if p < source.shape[2]:
        for half in range(source.shape[0]):
            pool[half, i, first + p] = source[half, i, p]


@kernel
def collect(pool, desk, home):
    """The states and log weights of all vehicles, side by side into ``home`` (STATE + 1, all particles)."""
    v, p = cuda.blockIdx.y, cuda.grid(1)
    order = desk[v * at.ORDER : (v + 1) * at.ORDER]
    if p >= int(order[at.COUNT]):
        return
    rows, q, to = pool[int(order[at.NOW])], int(order[at.FIRST]) + p, int(order[at.AT_HOME]) + p
    for i in range(at.STATE):
        home[i, to] = rows[i, q]
    home[at.STATE, to] = rows[at.LOG_WEIGHT, q]
