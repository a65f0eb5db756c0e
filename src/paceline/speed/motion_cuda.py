"""What is done with particles on a GPU: resampling and the motions of `motion`, one thread for each particle.

How they lie in memory, and the orders for them, is told in `layout_cuda`. The functions for one particle take a half of
the pool as ``rows`` (ROWS, columns) and the particle's column ``q``; ``p`` is its number within the vehicle.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

from paceline.speed import regions
from paceline.speed.cloud import KEPT
from paceline.speed.layout_cuda import (
    AT_HOME,
    BEFORE,
    CORRECTED,
    COUNT,
    CROSSING_LEFT,
    CROSSING_RIGHT,
    CUMULATED,
    DISTANCE,
    DRAWS,
    DRIFT,
    DT,
    FIRST,
    FREE,
    HEADING,
    KEY,
    KNOT_COUNT,
    KNOTS,
    LEFT,
    LOG_WEIGHT,
    MAPS,
    MEAN,
    MOVED,
    MOVING,
    MOVING_NOISE,
    NORMAL,
    NOW,
    OFFSET,
    ORDER,
    PLACE,
    PREPARED,
    RESAMPLED,
    RIG,
    RIGHT,
    SEEN_NOISE,
    SPEED,
    SPREAD,
    SQUARED,
    STATE,
    STEP,
    STIRRING,
    TOWARDS,
    TURNING,
    TURNS,
    VELOCITY,
    WEIGHT,
    S,
)
from paceline.speed.randomness_cuda import counted_normals

_device = cuda.jit(device=True)
_carry = _device(regions.carry)
_cross_diagonals = _device(regions.cross_diagonals)
_unit_square_to = _device(regions.unit_square_to)
_inward_edges = _device(regions.inward_edges)

# what a rig comes to: (7, 3, 3), by place
K_LEFT, K_LEFT_INV, K_RIGHT, K_RIGHT_INV, R_RIG, ACROSS, SHIFTS = range(7)


@cuda.jit(device=True)
def _multiply(A, B, out):
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@cuda.jit(device=True)
def _multiply_transposed(A, B, out):
    """A Bᵀ."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[j, 0] + A[i, 1] * B[j, 1] + A[i, 2] * B[j, 2]


@cuda.jit(device=True)
def _apply(A, x, out):
    for i in range(3):
        out[i] = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2]


@cuda.jit(device=True)
def _fetch(rows, first, q, out):
    for i in range(3):
        out[i] = rows[first + i, q]


@cuda.jit(device=True)
def _fetch_region(rows, first, q, out):
    for v in range(4):
        out[v, 0] = rows[first + 2 * v, q]
        out[v, 1] = rows[first + 2 * v + 1, q]


@cuda.jit(device=True)
def _store_region(quad, rows, first, q):
    for v in range(4):
        rows[first + 2 * v, q] = quad[v, 0]
        rows[first + 2 * v + 1, q] = quad[v, 1]


@cuda.jit(device=True)
def _derive(rows, q, rig):
    """The rows that follow from the state."""
    quad = cuda.local.array((4, 2), np.float64)
    crossing = cuda.local.array(2, np.float64)
    for view in range(2):
        _fetch_region(rows, RIGHT if view else LEFT, q, quad)
        _cross_diagonals(quad, crossing)
        first = CROSSING_RIGHT if view else CROSSING_LEFT
        rows[first, q], rows[first + 1, q] = crossing[0], crossing[1]
    x, y, K_inv = rows[CROSSING_LEFT, q], rows[CROSSING_LEFT + 1, q], rig[K_LEFT_INV]
    a = K_inv[0, 0] * x + K_inv[0, 1] * y + K_inv[0, 2]
    b = K_inv[1, 0] * x + K_inv[1, 1] * y + K_inv[1, 2]
    c = K_inv[2, 0] * x + K_inv[2, 1] * y + K_inv[2, 2]
    depth = rows[DISTANCE, q] / (a * rows[NORMAL, q] + b * rows[NORMAL + 1, q] + c * rows[NORMAL + 2, q])
    rows[PLACE, q], rows[PLACE + 1, q], rows[PLACE + 2, q] = a * depth, b * depth, c * depth


@cuda.jit(device=True)
def _move(rows, q, rig, dR, shift):
    """`motion.moved` of one particle: (5)–(8), (10), (11)."""
    n, n_right = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift_right, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    plane = cuda.local.array(3, np.float64)
    product, dR_right = cuda.local.array((3, 3), np.float64), cuda.local.array((3, 3), np.float64)
    quad, carried = cuda.local.array((4, 2), np.float64), cuda.local.array((4, 2), np.float64)
    R, t, d = rig[R_RIG], rig[SHIFTS, 0], rows[DISTANCE, q]
    _fetch(rows, NORMAL, q, n)
    _apply(R, n, n_right)
    d_right = d + (n_right[0] * t[0] + n_right[1] * t[1] + n_right[2] * t[2])
    _multiply(R, dR, product)
    _multiply_transposed(product, R, dR_right)
    _apply(R, shift, shift_right)
    _apply(dR_right, t, turned)
    for i in range(3):
        shift_right[i] = shift_right[i] + t[i] - turned[i]
        plane[i] = n[i] / d
    _fetch_region(rows, LEFT, q, quad)
    _carry(quad, dR, shift, plane, rig[K_LEFT], rig[K_LEFT_INV], carried)
    _store_region(carried, rows, LEFT, q)
    for i in range(3):
        plane[i] = n_right[i] / d_right
    _fetch_region(rows, RIGHT, q, quad)
    _carry(quad, dR_right, shift_right, plane, rig[K_RIGHT], rig[K_RIGHT_INV], carried)
    _store_region(carried, rows, RIGHT, q)
    _apply(dR, n, turned)
    for i in range(3):
        rows[NORMAL + i, q] = turned[i]
    rows[DISTANCE, q] = d + (shift[0] * turned[0] + shift[1] * turned[1] + shift[2] * turned[2])
    _derive(rows, q, rig)


@cuda.jit(device=True)
def _identity(dR):
    for i in range(3):
        for j in range(3):
            dR[i, j] = 1.0 if i == j else 0.0


@cuda.jit(device=True)
def _draw(desk, order, draw, k, p, out, first):
    """``k`` numbers of one kind of noise for particle ``p``, into ``out`` from the ``first`` on."""
    where, sigma = int(order[DRAWS + 2 * draw]), order[DRAWS + 2 * draw + 1]
    if where < 0:
        counted_normals(order[KEY : KEY + 4], -1 - where, sigma, p, k, out, first)
    else:
        at = where + p * k
        for i in range(k):
            out[first + i] = desk[at + i]


# --- along a path --------------------------------------------------------------------------------------------------


@cuda.jit(device=True)
def _interval(knots, s):
    low, high = 0, knots.shape[0] - 2
    while low < high:
        half = (low + high + 1) // 2
        if knots[half, 0] <= s:
            low = half
        else:
            high = half - 1
    return low


@cuda.jit(device=True)
def _at(knots, s, out):
    """`paths.Path.at`: C(s), beyond the ends straight on."""
    within = min(max(s, knots[0, 0]), knots[knots.shape[0] - 1, 0])
    i = _interval(knots, within)
    x = within - knots[i, 0]
    for axis in range(3):
        a, b, c, d = knots[i, 2 + 4 * axis], knots[i, 3 + 4 * axis], knots[i, 4 + 4 * axis], knots[i, 5 + 4 * axis]
        slope = (3.0 * a * x + 2.0 * b) * x + c
        out[axis] = ((a * x + b) * x + c) * x + d + (s - within) * slope


@cuda.jit(device=True)
def _frame(knots, s, F):
    """`paths.Path.frames`: columns T, P, B."""
    T = cuda.local.array(3, np.float64)
    within = min(max(s, knots[0, 0]), knots[knots.shape[0] - 1, 0])
    i = _interval(knots, within)
    along = within - knots[i, 0]
    for axis in range(3):
        a, b, c = knots[i, 2 + 4 * axis], knots[i, 3 + 4 * axis], knots[i, 4 + 4 * axis]
        T[axis] = (3.0 * a * along + 2.0 * b) * along + c
    norm = math.sqrt(T[0] * T[0] + T[1] * T[1] + T[2] * T[2])
    x, y, z = T[0] / norm, T[1] / norm, T[2] / norm
    length = math.sqrt(x * x + z * z)
    if length < 1e-6:
        px, pz = 1.0, 0.0
    else:
        px, pz = z / length, -x / length
    share = along / (knots[i + 1, 0] - knots[i, 0])
    angle = knots[i, 1] + share * (knots[i + 1, 1] - knots[i, 1])
    cos, sin = math.cos(angle), math.sin(angle)
    bx, by, bz = y * pz, z * px - x * pz, -y * px
    F[0, 0], F[1, 0], F[2, 0] = x, y, z
    F[0, 1], F[1, 1], F[2, 1] = cos * px + sin * bx, sin * by, cos * pz + sin * bz
    F[0, 2], F[1, 2], F[2, 2] = cos * bx - sin * px, cos * by, cos * bz - sin * pz


@cuda.jit(device=True)
def _along_path(rows, q, p, desk, order, rig, knots):
    """`motion.PathMotion.propagate`: (22)–(24) on a line, (25)–(27) where the path turns."""
    noise = cuda.local.array(6, np.float64)
    start, end = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    F, after, dR = (
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
    )
    turns = order[TURNS] != 0.0
    for i in range(4):  # of the speed, along the path, of the heading's yaw and pitch
        _draw(desk, order, MOVING_NOISE + i, 1, p, noise, i)
    before = rows[S, q]
    speed = rows[SPEED, q] + noise[0]
    length = speed * order[DT] + noise[1]
    rows[HEADING, q] += noise[2]
    rows[HEADING + 1, q] += noise[3]
    s = before + length
    _at(knots, before, start)
    if turns:
        sign = 1.0 if length > 0.0 else -1.0 if length < 0.0 else 0.0
        for _ in range(2):  # (25): two secant steps from the arc to the chord
            _at(knots, s, end)
            x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
            s += sign * (abs(length) - math.sqrt(x * x + y * y + z * z))
    _at(knots, s, end)
    _frame(knots, before, F)
    ahead = 0.0
    for i in range(3):
        ahead += (end[i] - start[i]) * F[i, 0]
    for i in range(3):
        aside = F[i, 1] * rows[HEADING, q] + F[i, 2] * rows[HEADING + 1, q]
        shift[i] = end[i] - start[i] + ahead * aside
    _identity(dR)
    if turns:
        _frame(knots, s, after)
        _multiply_transposed(after, F, dR)  # (26)
        _apply(dR, start, turned)
        _draw(desk, order, MOVING_NOISE + 4, 2, p, noise, 4)
        across, down = noise[4] * order[DRIFT], noise[5] * order[DRIFT + 1]
        for i in range(3):
            shift[i] += start[i] - turned[i] + (after[i, 1] * across + after[i, 2] * down)  # (27)
    rows[SPEED, q] = speed
    rows[S, q] = s
    _move(rows, q, rig, dR, shift)


# --- without a path ------------------------------------------------------------------------------------------------


@cuda.jit(device=True)
def _freely(rows, q, p, desk, order, rig):
    """`motion.FreeMotion.propagate`: (9)–(11)."""
    noise, dt = cuda.local.array(6, np.float64), order[DT]
    centre, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift, dR = cuda.local.array(3, np.float64), cuda.local.array((3, 3), np.float64)
    for i in range(2):  # of the turning and of the velocity
        _draw(desk, order, MOVING_NOISE + i, 3, p, noise, 3 * i)
    for i in range(3):
        rows[TURNING + i, q] += noise[i]
        rows[VELOCITY + i, q] += noise[3 + i]
    a, b, c = rows[TURNING, q] * dt, rows[TURNING + 1, q] * dt, rows[TURNING + 2, q] * dt
    ca, sa, cb, sb, cc, sc = math.cos(a), math.sin(a), math.cos(b), math.sin(b), math.cos(c), math.sin(c)
    dR[0, 0], dR[0, 1], dR[0, 2] = cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa  # about x, then y, then z
    dR[1, 0], dR[1, 1], dR[1, 2] = sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa
    dR[2, 0], dR[2, 1], dR[2, 2] = -sb, cb * sa, cb * ca
    _fetch(rows, PLACE, q, centre)
    _apply(dR, centre, turned)
    for i in range(3):
        shift[i] = centre[i] + rows[VELOCITY + i, q] * dt - turned[i]
    _move(rows, q, rig, dR, shift)
    _set_speed(rows, q)


@cuda.jit(device=True)
def _set_speed(rows, q):
    x, y, z = rows[VELOCITY, q], rows[VELOCITY + 1, q], rows[VELOCITY + 2, q]
    rows[SPEED, q] = math.sqrt(x * x + y * y + z * z)


@cuda.jit(device=True)
def _prepare(rows, q, rig, out):
    """Into ``out`` (MAPS,) what the likelihood samples by.

    That is homographies (9 each) of the unit square to the left region, to the right region, and to the left region
    carried into the right view by (15), and the right region's edges (12). A region without area has no map: it is
    looked at in one pixel, where it resembles nothing.
    """
    quad, edges = cuda.local.array((4, 2), np.float64), cuda.local.array((4, 3), np.float64)
    H, cross, carried = (
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
    )
    K_inv, across, moved = rig[K_LEFT_INV], rig[ACROSS], rig[SHIFTS, 1]
    for j in range(3):
        plane = 0.0
        for i in range(3):
            plane += rows[NORMAL + i, q] / rows[DISTANCE, q] * K_inv[i, j]
        for i in range(3):
            cross[i, j] = across[i, j] + moved[i] * plane
    _fetch_region(rows, LEFT, q, quad)
    _unit_square_to(quad, H)
    _multiply(cross, H, carried)
    for i in range(9):
        out[i], out[18 + i] = H[i // 3, i % 3], carried[i // 3, i % 3]
    _fetch_region(rows, RIGHT, q, quad)
    _unit_square_to(quad, H)
    _inward_edges(quad, edges)
    for i in range(9):
        out[9 + i] = H[i // 3, i % 3]
    for i in range(12):
        out[27 + i] = edges[i // 3, i % 3]
    finite = True
    for i in range(MAPS):
        finite = finite and math.isfinite(out[i])
    if not finite:
        for i in range(MAPS):
            out[i] = np.float32(0.0)
        out[8] = out[17] = out[26] = np.float32(1.0)
        for i in range(4):
            out[27 + 3 * i + 2] = np.float32(-1.0)


# --- all that can be ordered ---------------------------------------------------------------------------------------


@cuda.jit(device=True)
def _survive(pool, q, p, desk, order):
    """Systematic resampling, by the running sums of the weights: what survives as particle ``p``, stirred.

    The headings, static parameters, are drawn to their mean as they are stirred.
    """
    noise = cuda.local.array(2, np.float64)
    before, rows = pool[int(order[BEFORE])], pool[int(order[NOW])]
    first, N = int(order[FIRST]), int(order[COUNT])
    point = (p + order[OFFSET]) / N
    low, high = 0, N - 1
    while low < high:
        half = (low + high) // 2
        if before[CUMULATED, first + half] < point:
            low = half + 1
        else:
            high = half
    for i in range(MOVING):
        rows[i, q] = before[i, first + low]
    rows[LOG_WEIGHT, q] = -math.log(float(N))
    rows[WEIGHT, q] = 1.0 / N
    _draw(desk, order, STIRRING, 2, p, noise, 0)
    for k in range(2):
        mean = order[MEAN + k]
        rows[HEADING + k, q] = mean + KEPT * (rows[HEADING + k, q] - mean) + noise[k] * order[SPREAD + k]


@cuda.jit(device=True)
def _square(rows, q, normal):
    """The plane through its own centre, square to ``normal`` (3,)."""
    distance = 0.0
    for i in range(3):
        rows[NORMAL + i, q] = normal[i]
        distance += rows[PLACE + i, q] * normal[i]
    rows[DISTANCE, q] = distance


@cuda.jit(device=True)
def _correct(rows, q, p, desk, order, rig, knots):
    """`motion.corrected`, with the motion's ``followed``: the ensemble Kalman step."""
    noise = cuda.local.array(3, np.float64)
    off, shift = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    change, dR = cuda.local.array(3, np.float64), cuda.local.array((3, 3), np.float64)
    place, root, gain = order[STEP : STEP + 3], order[STEP + 3 : STEP + 12], order[STEP + 12 : STEP + 30]
    _draw(desk, order, SEEN_NOISE, 3, p, noise, 0)
    for i in range(3):
        stirred = root[3 * i] * noise[0] + root[3 * i + 1] * noise[1] + root[3 * i + 2] * noise[2]
        off[i] = place[i] + stirred - rows[PLACE + i, q]
    for i in range(3):
        shift[i] = gain[3 * i] * off[0] + gain[3 * i + 1] * off[1] + gain[3 * i + 2] * off[2]
        change[i] = gain[9 + 3 * i] * off[0] + gain[10 + 3 * i] * off[1] + gain[11 + 3 * i] * off[2]
    if order[FREE] != 0.0:
        for i in range(3):
            rows[VELOCITY + i, q] += change[i]
        _set_speed(rows, q)
    else:
        rows[SPEED, q] += change[0]
        rows[HEADING, q] += change[1]
        rows[HEADING + 1, q] += change[2]
        F = cuda.local.array((3, 3), np.float64)
        _frame(knots, rows[S, q], F)
        rows[S, q] += shift[0] * F[0, 0] + shift[1] * F[1, 0] + shift[2] * F[2, 0]
    _identity(dR)
    _move(rows, q, rig, dR, shift)


@cuda.jit(cache=True)
def carry_out(pool, desk, rigs, knots, maps):
    """The orders at the beginning of ``desk``, for all vehicles at once: y blocks for slots, x threads for particles.

    ``rigs`` (rigs, 7, 3, 3) and ``knots`` (knots, KNOT) are tables, ``maps`` (columns, MAPS) what `_prepare` makes.
    """
    v, p = cuda.blockIdx.y, cuda.grid(1)
    order = desk[v * ORDER : (v + 1) * ORDER]
    if p >= int(order[COUNT]) or order[PREPARED] == 0.0:
        return
    q = int(order[FIRST]) + p
    rows, rig = pool[int(order[NOW])], rigs[int(order[RIG])]
    path = knots[int(order[KNOTS]) : int(order[KNOTS]) + int(order[KNOT_COUNT])]
    if order[RESAMPLED] != 0.0:
        _survive(pool, q, p, desk, order)
    if order[SQUARED] != 0.0:
        _square(rows, q, order[TOWARDS : TOWARDS + 3])
    if order[MOVED] != 0.0:
        if order[FREE] != 0.0:
            _freely(rows, q, p, desk, order, rig)
        else:
            _along_path(rows, q, p, desk, order, rig, path)
    if order[CORRECTED] != 0.0:
        _correct(rows, q, p, desk, order, rig, path)
    _prepare(rows, q, rig, maps[q])


@cuda.jit(cache=True)
def settle(source, pool, first):
    """The numbers ``source`` (halves, rows, columns) into the pool, from the ``first`` column on; y blocks for rows."""
    i, p = cuda.blockIdx.y, cuda.grid(1)
    if p < source.shape[2]:
        for half in range(source.shape[0]):
            pool[half, i, first + p] = source[half, i, p]


@cuda.jit(cache=True)
def collect(pool, desk, home):
    """The states and log weights of all vehicles, side by side into ``home`` (STATE + 1, all particles)."""
    v, p = cuda.blockIdx.y, cuda.grid(1)
    order = desk[v * ORDER : (v + 1) * ORDER]
    if p >= int(order[COUNT]):
        return
    rows, q, at = pool[int(order[NOW])], int(order[FIRST]) + p, int(order[AT_HOME]) + p
    for i in range(STATE):
        home[i, at] = rows[i, q]
    home[STATE, at] = rows[LOG_WEIGHT, q]
