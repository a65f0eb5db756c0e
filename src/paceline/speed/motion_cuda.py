"""How particles move on a GPU: the motions of `motion`, one thread for each particle.

A cloud of N particles is one array (ROWS, N): every number of its state is a row, so that the threads of a warp read
side by side. The last rows are what follows from the state and is asked for by the filter: where the planes' centres
are in space and in both views.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

from paceline.speed import regions

LEFT, RIGHT, NORMAL, DISTANCE, SPEED, S, HEADING, VELOCITY, TURNING = 0, 8, 16, 19, 20, 21, 22, 24, 27
STATE = 30  # rows of the state itself
PLACE, CROSSING_LEFT, CROSSING_RIGHT = 30, 33, 35
ROWS = 37

MAPS = 39  # three homographies and the four edges of the right region

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
def _fetch(rows, first, p, out):
    for i in range(3):
        out[i] = rows[first + i, p]


@cuda.jit(device=True)
def _fetch_region(rows, first, p, out):
    for v in range(4):
        out[v, 0] = rows[first + 2 * v, p]
        out[v, 1] = rows[first + 2 * v + 1, p]


@cuda.jit(device=True)
def _store_region(quad, rows, first, p):
    for v in range(4):
        rows[first + 2 * v, p] = quad[v, 0]
        rows[first + 2 * v + 1, p] = quad[v, 1]


@cuda.jit(device=True)
def _derive(rows, p, rig):
    """The rows that follow from the state."""
    quad = cuda.local.array((4, 2), np.float64)
    crossing = cuda.local.array(2, np.float64)
    for view in range(2):
        _fetch_region(rows, RIGHT if view else LEFT, p, quad)
        _cross_diagonals(quad, crossing)
        first = CROSSING_RIGHT if view else CROSSING_LEFT
        rows[first, p], rows[first + 1, p] = crossing[0], crossing[1]
    x, y, K_inv = rows[CROSSING_LEFT, p], rows[CROSSING_LEFT + 1, p], rig[K_LEFT_INV]
    a = K_inv[0, 0] * x + K_inv[0, 1] * y + K_inv[0, 2]
    b = K_inv[1, 0] * x + K_inv[1, 1] * y + K_inv[1, 2]
    c = K_inv[2, 0] * x + K_inv[2, 1] * y + K_inv[2, 2]
    depth = rows[DISTANCE, p] / (a * rows[NORMAL, p] + b * rows[NORMAL + 1, p] + c * rows[NORMAL + 2, p])
    rows[PLACE, p], rows[PLACE + 1, p], rows[PLACE + 2, p] = a * depth, b * depth, c * depth


@cuda.jit(device=True)
def _move(rows, p, rig, dR, shift):
    """`motion.moved` of one particle: (5)–(8), (10), (11)."""
    n, n_right = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift_right, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    plane = cuda.local.array(3, np.float64)
    product, dR_right = cuda.local.array((3, 3), np.float64), cuda.local.array((3, 3), np.float64)
    quad, carried = cuda.local.array((4, 2), np.float64), cuda.local.array((4, 2), np.float64)
    R, t, d = rig[R_RIG], rig[SHIFTS, 0], rows[DISTANCE, p]
    _fetch(rows, NORMAL, p, n)
    _apply(R, n, n_right)
    d_right = d + (n_right[0] * t[0] + n_right[1] * t[1] + n_right[2] * t[2])
    _multiply(R, dR, product)
    _multiply_transposed(product, R, dR_right)
    _apply(R, shift, shift_right)
    _apply(dR_right, t, turned)
    for i in range(3):
        shift_right[i] = shift_right[i] + t[i] - turned[i]
        plane[i] = n[i] / d
    _fetch_region(rows, LEFT, p, quad)
    _carry(quad, dR, shift, plane, rig[K_LEFT], rig[K_LEFT_INV], carried)
    _store_region(carried, rows, LEFT, p)
    for i in range(3):
        plane[i] = n_right[i] / d_right
    _fetch_region(rows, RIGHT, p, quad)
    _carry(quad, dR_right, shift_right, plane, rig[K_RIGHT], rig[K_RIGHT_INV], carried)
    _store_region(carried, rows, RIGHT, p)
    _apply(dR, n, turned)
    for i in range(3):
        rows[NORMAL + i, p] = turned[i]
    rows[DISTANCE, p] = d + (shift[0] * turned[0] + shift[1] * turned[1] + shift[2] * turned[2])
    _derive(rows, p, rig)


@cuda.jit(device=True)
def _identity(dR):
    for i in range(3):
        for j in range(3):
            dR[i, j] = 1.0 if i == j else 0.0


# --- along a path --------------------------------------------------------------------------------------------------


@cuda.jit(device=True)
def _interval(breaks, s):
    low, high = 0, breaks.shape[0] - 2
    while low < high:
        half = (low + high + 1) // 2
        if breaks[half] <= s:
            low = half
        else:
            high = half - 1
    return low


@cuda.jit(device=True)
def _tangent(breaks, cubics, s, out):
    """C′(s), ``s`` on the path."""
    i = _interval(breaks, s)
    x = s - breaks[i]
    for axis in range(3):
        c = cubics[i, axis]
        out[axis] = (3.0 * c[0] * x + 2.0 * c[1]) * x + c[2]


@cuda.jit(device=True)
def _at(breaks, cubics, s, out):
    """`paths.Path.at`: C(s), beyond the ends straight on."""
    within = min(max(s, breaks[0]), breaks[breaks.shape[0] - 1])
    i = _interval(breaks, within)
    x = within - breaks[i]
    for axis in range(3):
        c = cubics[i, axis]
        slope = (3.0 * c[0] * x + 2.0 * c[1]) * x + c[2]
        out[axis] = ((c[0] * x + c[1]) * x + c[2]) * x + c[3] + (s - within) * slope


@cuda.jit(device=True)
def _frame(breaks, cubics, roll, s, F):
    """`paths.Path.frames`: columns T, P, B."""
    T = cuda.local.array(3, np.float64)
    within = min(max(s, breaks[0]), breaks[breaks.shape[0] - 1])
    _tangent(breaks, cubics, within, T)
    norm = math.sqrt(T[0] * T[0] + T[1] * T[1] + T[2] * T[2])
    x, y, z = T[0] / norm, T[1] / norm, T[2] / norm
    length = math.sqrt(x * x + z * z)
    if length < 1e-6:
        px, pz = 1.0, 0.0
    else:
        px, pz = z / length, -x / length
    i = _interval(breaks, within)
    share = (within - breaks[i]) / (breaks[i + 1] - breaks[i])
    angle = roll[i] + share * (roll[i + 1] - roll[i])
    cos, sin = math.cos(angle), math.sin(angle)
    bx, by, bz = y * pz, z * px - x * pz, -y * px
    F[0, 0], F[1, 0], F[2, 0] = x, y, z
    F[0, 1], F[1, 1], F[2, 1] = cos * px + sin * bx, sin * by, cos * pz + sin * bz
    F[0, 2], F[1, 2], F[2, 2] = cos * bx - sin * px, cos * by, cos * bz - sin * pz


@cuda.jit(cache=True)
def propagate_along_path(rows, noise, rig, breaks, cubics, roll, turns, drift_across, drift_down, dt):
    """`motion.PathMotion.propagate`: (22)–(24) on a line, (25)–(27) where the path ``turns``.

    ``noise`` (6, N): m/s of the speed, m along the path, rad of the heading's yaw and pitch, and standard normal ones
    of the drift across and down.
    """
    p = cuda.grid(1)
    if p >= rows.shape[1]:
        return
    start, end = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    F, after, dR = (
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
    )
    before = rows[S, p]
    speed = rows[SPEED, p] + noise[0, p]
    length = speed * dt + noise[1, p]
    rows[HEADING, p] += noise[2, p]
    rows[HEADING + 1, p] += noise[3, p]
    s = before + length
    _at(breaks, cubics, before, start)
    if turns:
        sign = 1.0 if length > 0.0 else -1.0 if length < 0.0 else 0.0
        for _ in range(2):  # (25): two secant steps from the arc to the chord
            _at(breaks, cubics, s, end)
            x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
            s += sign * (abs(length) - math.sqrt(x * x + y * y + z * z))
    _at(breaks, cubics, s, end)
    _frame(breaks, cubics, roll, before, F)
    ahead = 0.0
    for i in range(3):
        ahead += (end[i] - start[i]) * F[i, 0]
    for i in range(3):
        aside = F[i, 1] * rows[HEADING, p] + F[i, 2] * rows[HEADING + 1, p]
        shift[i] = end[i] - start[i] + ahead * aside
    _identity(dR)
    if turns:
        _frame(breaks, cubics, roll, s, after)
        _multiply_transposed(after, F, dR)  # (26)
        _apply(dR, start, turned)
        across, down = noise[4, p] * drift_across, noise[5, p] * drift_down
        for i in range(3):
            shift[i] += start[i] - turned[i] + (after[i, 1] * across + after[i, 2] * down)  # (27)
    rows[SPEED, p] = speed
    rows[S, p] = s
    _move(rows, p, rig, dR, shift)


# --- without a path ------------------------------------------------------------------------------------------------


@cuda.jit(cache=True)
def propagate_freely(rows, noise, rig, dt):
    """`motion.FreeMotion.propagate`: (9)–(11). ``noise`` (6, N): rad/s of the turning, m/s of the velocity."""
    p = cuda.grid(1)
    if p >= rows.shape[1]:
        return
    centre, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift, dR = cuda.local.array(3, np.float64), cuda.local.array((3, 3), np.float64)
    for i in range(3):
        rows[TURNING + i, p] += noise[i, p]
        rows[VELOCITY + i, p] += noise[3 + i, p]
    a, b, c = rows[TURNING, p] * dt, rows[TURNING + 1, p] * dt, rows[TURNING + 2, p] * dt
    ca, sa, cb, sb, cc, sc = math.cos(a), math.sin(a), math.cos(b), math.sin(b), math.cos(c), math.sin(c)
    dR[0, 0], dR[0, 1], dR[0, 2] = cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa  # about x, then y, then z
    dR[1, 0], dR[1, 1], dR[1, 2] = sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa
    dR[2, 0], dR[2, 1], dR[2, 2] = -sb, cb * sa, cb * ca
    _fetch(rows, PLACE, p, centre)
    _apply(dR, centre, turned)
    for i in range(3):
        shift[i] = centre[i] + rows[VELOCITY + i, p] * dt - turned[i]
    _move(rows, p, rig, dR, shift)
    _set_speed(rows, p)


@cuda.jit(device=True)
def _set_speed(rows, p):
    x, y, z = rows[VELOCITY, p], rows[VELOCITY + 1, p], rows[VELOCITY + 2, p]
    rows[SPEED, p] = math.sqrt(x * x + y * y + z * z)


# --- both ----------------------------------------------------------------------------------------------------------


@cuda.jit(cache=True)
def correct(rows, noise, rig, step, linear, breaks, cubics, roll, free):
    """`motion.corrected`, with the motion's ``followed``: the ensemble Kalman step of every particle.

    ``noise`` (3, N) standard normal; ``step`` (7 + k, 3) is where the planes' centre was seen, the root (3, 3) of that
    covariance, and the gain (3 + k, 3) of the centre and the rows ``linear`` (k,).
    """
    p = cuda.grid(1)
    if p >= rows.shape[1]:
        return
    off, shift = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    dR = cuda.local.array((3, 3), np.float64)
    for i in range(3):
        stirred = step[1 + i, 0] * noise[0, p] + step[1 + i, 1] * noise[1, p] + step[1 + i, 2] * noise[2, p]
        off[i] = step[0, i] + stirred - rows[PLACE + i, p]
    for i in range(3):
        shift[i] = step[4 + i, 0] * off[0] + step[4 + i, 1] * off[1] + step[4 + i, 2] * off[2]
    for k in range(linear.shape[0]):
        g = step[7 + k]
        rows[linear[k], p] += g[0] * off[0] + g[1] * off[1] + g[2] * off[2]
    if free:
        _set_speed(rows, p)
    else:
        F = cuda.local.array((3, 3), np.float64)
        _frame(breaks, cubics, roll, rows[S, p], F)
        rows[S, p] += shift[0] * F[0, 0] + shift[1] * F[1, 0] + shift[2] * F[2, 0]
    _identity(dR)
    _move(rows, p, rig, dR, shift)


@cuda.jit(cache=True)
def derive(rows, rig):
    """The rows that follow from a state just uploaded."""
    p = cuda.grid(1)
    if p < rows.shape[1]:
        _derive(rows, p, rig)


@cuda.jit(cache=True)
def square(rows, normal):
    """Every plane through its own centre, square to ``normal`` (3,)."""
    p = cuda.grid(1)
    if p >= rows.shape[1]:
        return
    distance = 0.0
    for i in range(3):
        rows[NORMAL + i, p] = normal[i]
        distance += rows[PLACE + i, p] * normal[i]
    rows[DISTANCE, p] = distance


@cuda.jit(cache=True)
def prepare(rows, rig, maps, first):
    """Into ``maps`` (M, 39), from the ``first`` on, what the likelihood samples by.

    That is homographies (9 each) of the unit square to the left region, to the right region, and to the left region
    carried into the right view by (15), and the right region's edges (12). A region without area has no map: it is
    looked at in one pixel, where it resembles nothing.
    """
    p = cuda.grid(1)
    if p >= rows.shape[1]:
        return
    quad, edges = cuda.local.array((4, 2), np.float64), cuda.local.array((4, 3), np.float64)
    H, cross, carried = (
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
    )
    out, K_inv, across, moved = maps[first + p], rig[K_LEFT_INV], rig[ACROSS], rig[SHIFTS, 1]
    for j in range(3):
        plane = 0.0
        for i in range(3):
            plane += rows[NORMAL + i, p] / rows[DISTANCE, p] * K_inv[i, j]
        for i in range(3):
            cross[i, j] = across[i, j] + moved[i] * plane
    _fetch_region(rows, LEFT, p, quad)
    _unit_square_to(quad, H)
    _multiply(cross, H, carried)
    for i in range(9):
        out[i], out[18 + i] = H[i // 3, i % 3], carried[i // 3, i % 3]
    _fetch_region(rows, RIGHT, p, quad)
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
