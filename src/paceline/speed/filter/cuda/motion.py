"""The motion of a particle on a GPU, as in `motion_models`, and the maps by which the likelihood samples it.

`memory_layout` describes the memory and the commands. The functions take a half of the pool
as ``rows`` (ROW_COUNT, columns) and the particle's column ``q``; ``p`` is its number within the vehicle.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

from paceline.speed.filter.cuda import memory_layout as layout
from paceline.speed.filter.cuda.random_numbers import counter_normals
from paceline.speed.geometry import quadrilaterals

_device = cuda.jit(device=True)
_transfer = _device(quadrilaterals.transfer)
_cross_diagonals = _device(quadrilaterals.cross_diagonals)
_unit_square_to = _device(quadrilaterals.unit_square_to)
_inward_edges = _device(quadrilaterals.inward_edges)

# indices of the matrices of a rig, (7, 3, 3)
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
        _fetch_region(rows, layout.RIGHT_REGION_ROW if view else layout.LEFT_REGION_ROW, q, quad)
        _cross_diagonals(quad, crossing)
        first = layout.RIGHT_CROSSING_ROW if view else layout.LEFT_CROSSING_ROW
        rows[first, q], rows[first + 1, q] = crossing[0], crossing[1]
    x, y, K_inv = rows[layout.LEFT_CROSSING_ROW, q], rows[layout.LEFT_CROSSING_ROW + 1, q], rig[K_LEFT_INV]
    a = K_inv[0, 0] * x + K_inv[0, 1] * y + K_inv[0, 2]
    b = K_inv[1, 0] * x + K_inv[1, 1] * y + K_inv[1, 2]
    c = K_inv[2, 0] * x + K_inv[2, 1] * y + K_inv[2, 2]
    depth = rows[layout.DISTANCE_ROW, q] / (
        a * rows[layout.NORMAL_ROW, q] + b * rows[layout.NORMAL_ROW + 1, q] + c * rows[layout.NORMAL_ROW + 2, q]
    )
    rows[layout.CENTRE_ROW, q], rows[layout.CENTRE_ROW + 1, q], rows[layout.CENTRE_ROW + 2, q] = (
        a * depth,
        b * depth,
        c * depth,
    )


@cuda.jit(device=True)
def move(rows, q, rig, dR, shift):
    """`motion_models.apply_rigid_motion` of one particle: (5)–(8), (10), (11)."""
    n, n_right = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift_right, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    plane = cuda.local.array(3, np.float64)
    product, dR_right = cuda.local.array((3, 3), np.float64), cuda.local.array((3, 3), np.float64)
    quad, transferred = cuda.local.array((4, 2), np.float64), cuda.local.array((4, 2), np.float64)
    R, t, apparent, d = rig[R_RIG], rig[SHIFTS, 0], rig[SHIFTS, 2], rows[layout.DISTANCE_ROW, q]
    _fetch(rows, layout.NORMAL_ROW, q, n)
    _apply(R, n, n_right)
    d_right = d + (n_right[0] * apparent[0] + n_right[1] * apparent[1] + n_right[2] * apparent[2])
    _multiply(R, dR, product)
    _multiply_transposed(product, R, dR_right)
    _apply(R, shift, shift_right)
    _apply(dR_right, t, turned)
    for i in range(3):
        shift_right[i] = shift_right[i] + t[i] - turned[i]
        plane[i] = n[i] / d
    _fetch_region(rows, layout.LEFT_REGION_ROW, q, quad)
    _transfer(quad, dR, shift, plane, rig[K_LEFT], rig[K_LEFT_INV], transferred)
    _store_region(transferred, rows, layout.LEFT_REGION_ROW, q)
    for i in range(3):
        plane[i] = n_right[i] / d_right
    _fetch_region(rows, layout.RIGHT_REGION_ROW, q, quad)
    _transfer(quad, dR_right, shift_right, plane, rig[K_RIGHT], rig[K_RIGHT_INV], transferred)
    _store_region(transferred, rows, layout.RIGHT_REGION_ROW, q)
    _apply(dR, n, turned)
    for i in range(3):
        rows[layout.NORMAL_ROW + i, q] = turned[i]
    rows[layout.DISTANCE_ROW, q] = d + (shift[0] * turned[0] + shift[1] * turned[1] + shift[2] * turned[2])
    _derive(rows, q, rig)


@cuda.jit(device=True)
def set_identity(dR):
    for i in range(3):
        for j in range(3):
            dR[i, j] = 1.0 if i == j else 0.0


@cuda.jit(device=True)
def draw(command_buffer, command, kind, k, p, out, first):
    """``k`` numbers of a ``kind`` of noise for particle ``p``, into ``out`` from the ``first`` on."""
    source, sigma = int(command[layout.NOISE_SOURCES + 2 * kind]), command[layout.NOISE_SOURCES + 2 * kind + 1]
    if source < 0:
        counter_normals(command[layout.GENERATOR_KEY : layout.GENERATOR_KEY + 4], -1 - source, sigma, p, k, out, first)
    else:
        for i in range(k):
            out[first + i] = command_buffer[source + p * k + i]


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
def frame(knots, s, F):
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
def propagate_along_path(rows, q, p, command_buffer, command, rig, knots):
    """`motion.PathMotion.propagate`: (22)–(24) on a line, (25)–(27) where the path turns."""
    noise = cuda.local.array(6, np.float64)
    start, end = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    F, after, dR = (
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
    )
    turns = command[layout.IS_CURVE] != 0.0
    for i in range(4):  # of the speed, along the path, of the heading's yaw and pitch
        draw(command_buffer, command, layout.PROCESS_NOISE_KIND + i, 1, p, noise, i)
    before = rows[layout.ARC_LENGTH_ROW, q]
    speed = rows[layout.SPEED_ROW, q] + noise[0]
    length = speed * command[layout.TIME_STEP] + noise[1]
    rows[layout.HEADING_ROW, q] += noise[2]
    rows[layout.HEADING_ROW + 1, q] += noise[3]
    s = before + length
    _at(knots, before, start)
    if turns:
        sign = 1.0 if length > 0.0 else -1.0 if length < 0.0 else 0.0
        for _ in range(2):  # (25): two secant steps from the arc to the chord
            _at(knots, s, end)
            x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
            s += sign * (abs(length) - math.sqrt(x * x + y * y + z * z))
    _at(knots, s, end)
    frame(knots, before, F)
    ahead = 0.0
    for i in range(3):
        ahead += (end[i] - start[i]) * F[i, 0]
    for i in range(3):
        offset = F[i, 1] * rows[layout.HEADING_ROW, q] + F[i, 2] * rows[layout.HEADING_ROW + 1, q]
        shift[i] = end[i] - start[i] + ahead * offset
    set_identity(dR)
    if turns:
        frame(knots, s, after)
        _multiply_transposed(after, F, dR)  # (26)
        _apply(dR, start, turned)
        draw(command_buffer, command, layout.PROCESS_NOISE_KIND + 4, 2, p, noise, 4)
        across, down = noise[4] * command[layout.DRIFT_STD], noise[5] * command[layout.DRIFT_STD + 1]
        for i in range(3):
            shift[i] += start[i] - turned[i] + (after[i, 1] * across + after[i, 2] * down)  # (27)
    rows[layout.SPEED_ROW, q] = speed
    rows[layout.ARC_LENGTH_ROW, q] = s
    move(rows, q, rig, dR, shift)


# --- without a path ------------------------------------------------------------------------------------------------


@cuda.jit(device=True)
def propagate_free(rows, q, p, command_buffer, command, rig):
    """`motion_models.FreeMotion.propagate`, (9)–(11), or `motion_models.CoordinatedTurn.propagate`."""
    noise, dt = cuda.local.array(6, np.float64), command[layout.TIME_STEP]
    centre, turned = cuda.local.array(3, np.float64), cuda.local.array(3, np.float64)
    shift, dR = cuda.local.array(3, np.float64), cuda.local.array((3, 3), np.float64)
    for i in range(2):  # of the turning and of the velocity
        draw(command_buffer, command, layout.PROCESS_NOISE_KIND + i, 3, p, noise, 3 * i)
    for i in range(3):
        rows[layout.TURN_RATE_ROW + i, q] += noise[i]
        rows[layout.VELOCITY_ROW + i, q] += noise[3 + i]
    a, b, c = (
        rows[layout.TURN_RATE_ROW, q] * dt,
        rows[layout.TURN_RATE_ROW + 1, q] * dt,
        rows[layout.TURN_RATE_ROW + 2, q] * dt,
    )
    ca, sa, cb, sb, cc, sc = math.cos(a), math.sin(a), math.cos(b), math.sin(b), math.cos(c), math.sin(c)
    dR[0, 0], dR[0, 1], dR[0, 2] = cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa  # about x, then y, then z
    dR[1, 0], dR[1, 1], dR[1, 2] = sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa
    dR[2, 0], dR[2, 1], dR[2, 2] = -sb, cb * sa, cb * ca
    _fetch(rows, layout.CENTRE_ROW, q, centre)
    _apply(dR, centre, turned)
    vx, vy, vz = rows[layout.VELOCITY_ROW, q], rows[layout.VELOCITY_ROW + 1, q], rows[layout.VELOCITY_ROW + 2, q]
    along, across = 1.0, 0.0
    if command[layout.IS_COORDINATED_TURN] != 0.0:
        half = 0.5 * b
        chord = math.sin(half) / half if half != 0.0 else 1.0
        along, across = chord * math.cos(half), chord * math.sin(half)
        rows[layout.VELOCITY_ROW, q], rows[layout.VELOCITY_ROW + 2, q] = cb * vx + sb * vz, cb * vz - sb * vx
    shift[0] = centre[0] + (along * vx + across * vz) * dt - turned[0]
    shift[1] = centre[1] + vy * dt - turned[1]
    shift[2] = centre[2] + (along * vz - across * vx) * dt - turned[2]
    move(rows, q, rig, dR, shift)
    set_speed(rows, q)


@cuda.jit(device=True)
def set_speed(rows, q):
    x, y, z = rows[layout.VELOCITY_ROW, q], rows[layout.VELOCITY_ROW + 1, q], rows[layout.VELOCITY_ROW + 2, q]
    rows[layout.SPEED_ROW, q] = math.sqrt(x * x + y * y + z * z)


@cuda.jit(device=True)
def prepare(rows, q, rig, out):
    """Write the sampling map of the likelihood to ``out`` (SAMPLING_MAP,).

    That is homographies (9 each) of the unit square to the left region, to the right region, and to the left region
    carried into the right view by (15), and the right region's edges (12). A degenerate region has no homography: it
    is sampled at one pixel, which resembles nothing.
    """
    quad, edges = cuda.local.array((4, 2), np.float64), cuda.local.array((4, 3), np.float64)
    H, cross, transferred = (
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
        cuda.local.array((3, 3), np.float64),
    )
    K_inv, across, K_t = rig[K_LEFT_INV], rig[ACROSS], rig[SHIFTS, 1]
    for j in range(3):
        plane = 0.0
        for i in range(3):
            plane += rows[layout.NORMAL_ROW + i, q] / rows[layout.DISTANCE_ROW, q] * K_inv[i, j]
        for i in range(3):
            cross[i, j] = across[i, j] + K_t[i] * plane
    _fetch_region(rows, layout.LEFT_REGION_ROW, q, quad)
    _unit_square_to(quad, H)
    _multiply(cross, H, transferred)
    for i in range(9):
        out[i], out[18 + i] = H[i // 3, i % 3], transferred[i // 3, i % 3]
    _fetch_region(rows, layout.RIGHT_REGION_ROW, q, quad)
    _unit_square_to(quad, H)
    _inward_edges(quad, edges)
    for i in range(9):
        out[9 + i] = H[i // 3, i % 3]
    for i in range(12):
        out[27 + i] = edges[i // 3, i % 3]
    finite = True
    for i in range(layout.SAMPLING_MAP):
        finite = finite and math.isfinite(out[i])
    if not finite:
        for i in range(layout.SAMPLING_MAP):
            out[i] = np.float32(0.0)
        out[8] = out[17] = out[26] = np.float32(1.0)
        for i in range(4):
            out[27 + 3 * i + 2] = np.float32(-1.0)
