"""The kernels that resample and move particles, one thread for each particle.

`memory_layout` describes the memory and the commands; the arguments of functions are those of `motion`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

from paceline.speed.filter.cuda import memory_layout as layout
from paceline.speed.filter.cuda.compiling import kernel
from paceline.speed.filter.cuda.motion import (
    draw,
    frame,
    move,
    prepare,
    propagate_along_path,
    propagate_free,
    set_identity,
    set_speed,
)
from paceline.speed.filter.resampling import SHRINKAGE


@cuda.jit(device=True)
def _resample(pool, q, p, command_buffer, command):
    """Particle ``p`` of systematic resampling, from the cumulative weights.

    The headings, static parameters, are shrunk to their mean and jittered [Liu and West 2001].
    """
    noise = cuda.local.array(2, np.float64)
    before, rows = pool[int(command[layout.HALF_BEFORE])], pool[int(command[layout.HALF_AFTER])]
    first, N = int(command[layout.FIRST_COLUMN]), int(command[layout.PARTICLE_COUNT])
    point = (p + command[layout.RESAMPLING_OFFSET]) / N
    low, high = 0, N - 1
    while low < high:
        half = (low + high) // 2
        if before[layout.CUMULATIVE_WEIGHT_ROW, first + half] < point:
            low = half + 1
        else:
            high = half
    for i in range(layout.CARRIED_ROW_COUNT):
        rows[i, q] = before[i, first + low]
    rows[layout.LOG_WEIGHT_ROW, q] = -math.log(float(N))
    rows[layout.WEIGHT_ROW, q] = 1.0 / N
    draw(command_buffer, command, layout.JITTER_KIND, 2, p, noise, 0)
    for k in range(2):
        mean = command[layout.MEAN_HEADING + k]
        rows[layout.HEADING_ROW + k, q] = (
            mean + SHRINKAGE * (rows[layout.HEADING_ROW + k, q] - mean) + noise[k] * command[layout.HEADING_STD + k]
        )


@cuda.jit(device=True)
def _set_plane_normal(rows, q, normal):
    """Give the plane the ``normal`` (3,), about its own centre."""
    distance = 0.0
    for i in range(3):
        rows[layout.NORMAL_ROW + i, q] = normal[i]
        distance += rows[layout.CENTRE_ROW + i, q] * normal[i]
    rows[layout.DISTANCE_ROW, q] = distance


@cuda.jit(device=True)
def _ensemble_kalman_update(rows, q, p, command_buffer, command, rig, knots):
    """`motion_models.ensemble_kalman_update`, with the motion's ``after_shift``: the ensemble Kalman step."""
    noise, innovation = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    change, dR = cuda.local.array(9, np.float64), cuda.local.array((3, 3), np.float64)
    place, factor, gain = (
        command[layout.KALMAN_STEP : layout.KALMAN_STEP + 3],
        command[layout.KALMAN_STEP + 3 : layout.KALMAN_STEP + 12],
        command[layout.KALMAN_STEP + 12 : layout.KALMAN_STEP + 39],
    )
    draw(command_buffer, command, layout.MEASUREMENT_NOISE_KIND, 3, p, noise, 0)
    for i in range(3):
        innovation[i] = place[i] - rows[layout.CENTRE_ROW + i, q]
        for j in range(i + 1):
            innovation[i] += factor[3 * i + j] * noise[j]
    for i in range(9):
        change[i] = 0.0
        for j in range(3):
            change[i] += gain[3 * i + j] * innovation[j]
    if command[layout.IS_FREE] != 0.0:
        for i in range(3):
            rows[layout.VELOCITY_ROW + i, q] += change[3 + i]
            rows[layout.TURN_RATE_ROW + i, q] += change[6 + i]
        set_speed(rows, q)
    else:
        rows[layout.SPEED_ROW, q] += change[3]
        rows[layout.HEADING_ROW, q] += change[4]
        rows[layout.HEADING_ROW + 1, q] += change[5]
        F = cuda.local.array((3, 3), np.float64)
        frame(knots, rows[layout.ARC_LENGTH_ROW, q], F)
        rows[layout.ARC_LENGTH_ROW, q] += change[0] * F[0, 0] + change[1] * F[1, 0] + change[2] * F[2, 0]
    set_identity(dR)
    move(rows, q, rig, dR, change)


@kernel
def execute(pool, command_buffer, rigs, knots, maps):
    """Execute the commands in ``command_buffer`` for all vehicles: y blocks are slots, x threads particles.

    ``rigs`` (rigs, 7, 3, 3) and ``knots`` (knots, KNOT_SIZE) are tables; `prepare` writes ``maps``
    (columns, SAMPLING_MAP).
    """
    v, p = cuda.blockIdx.y, cuda.grid(1)
    command = command_buffer[v * layout.COMMAND_SIZE : (v + 1) * layout.COMMAND_SIZE]
    if p >= int(command[layout.PARTICLE_COUNT]) or command[layout.IS_ACTIVE] == 0.0:
        return
    q = int(command[layout.FIRST_COLUMN]) + p
    rows, rig = pool[int(command[layout.HALF_AFTER])], rigs[int(command[layout.RIG_INDEX])]
    path = knots[
        int(command[layout.KNOT_TABLE_INDEX]) : int(command[layout.KNOT_TABLE_INDEX]) + int(command[layout.KNOT_COUNT])
    ]
    if command[layout.RESAMPLE] != 0.0:
        _resample(pool, q, p, command_buffer, command)
    if command[layout.SET_NORMAL] != 0.0:
        _set_plane_normal(rows, q, command[layout.TARGET_NORMAL : layout.TARGET_NORMAL + 3])
    if command[layout.PROPAGATE] != 0.0:
        if command[layout.IS_FREE] != 0.0:
            propagate_free(rows, q, p, command_buffer, command, rig)
        else:
            propagate_along_path(rows, q, p, command_buffer, command, rig, path)
    if command[layout.KALMAN_UPDATE] != 0.0:
        _ensemble_kalman_update(rows, q, p, command_buffer, command, rig, path)
    prepare(rows, q, rig, maps[q])


@kernel
def upload(source, pool, first):
    """Copy ``source`` (halves, rows, columns) into the pool, from the ``first`` column on; y blocks are rows."""
    i, p = cuda.blockIdx.y, cuda.grid(1)
    if p < source.shape[2]:
        for half in range(source.shape[0]):
            pool[half, i, first + p] = source[half, i, p]


@kernel
def download(pool, command_buffer, host):
    """Copies the states and log weights of all vehicles into ``host`` (STATE_ROW_COUNT + 1, all particles)."""
    v, p = cuda.blockIdx.y, cuda.grid(1)
    command = command_buffer[v * layout.COMMAND_SIZE : (v + 1) * layout.COMMAND_SIZE]
    if p >= int(command[layout.PARTICLE_COUNT]):
        return
    rows, q, column = (
        pool[int(command[layout.HALF_AFTER])],
        int(command[layout.FIRST_COLUMN]) + p,
        int(command[layout.HOST_COLUMN]) + p,
    )
    for i in range(layout.STATE_ROW_COUNT):
        host[i, column] = rows[i, q]
    host[layout.STATE_ROW_COUNT, column] = rows[layout.LOG_WEIGHT_ROW, q]
