"""A vehicle's own path: the drawn one with changes of yaw and pitch, integrated over the distance; compiled by Numba.

A drawn path is given as cubics over its arc length, as `paceline.speed.geometry.paths.Path.pieces` returns them.
"""

from __future__ import annotations

import math

import numpy as np

from paceline.arrays import Array
from paceline.numba_cache import cached_njit

NEAREST_STEPS, NEAREST_PRECISION_M = 20, 1e-9  # of the search for the place on a path that is nearest to a point
MIN_HORIZONTAL_SHARE = 1e-6  # of a unit tangent; below, the path runs along the camera's y axis


@cached_njit(nogil=True, error_model="numpy")
def own_path_frames(
    breaks: Array,
    cubics: Array,
    path_roll: Array,
    starts: Array,
    u: Array,
    yaw: Array,
    pitch: Array,
    distances: Array,
    frames: Array,
    places: Array,
) -> None:
    """Fill ``frames`` (N, L, 3, 3), columns T, P, B as of `Path.frames`, and ``places`` (N, L, 3), m, of the own paths
    of N vehicles after ``distances`` (N, L), m.

    They begin at ``starts`` (N, 3) beside the path and differ from its direction by ``yaw`` and ``pitch`` (N, M) rad at
    evenly spaced distances ``u`` (M,), M ≥ 4, which hold all others. ``places`` are relative to that at ``u[0]``.
    """
    N, M = yaw.shape
    step = u[1] - u[0]
    frame, tangents, integral, roll = np.empty((3, 3)), np.empty((M, 3)), np.zeros((M, 3)), np.zeros(M)
    for n in range(N):
        s = _nearest(breaks, cubics, path_roll, starts[n])
        for m in range(M):
            _frame_at(breaks, cubics, path_roll, s + u[m], frame)
            length = math.sqrt(1.0 + yaw[n, m] ** 2 + pitch[n, m] ** 2)
            for i in range(3):
                tangents[m, i] = (frame[i, 0] + yaw[n, m] * frame[i, 1] + pitch[n, m] * frame[i, 2]) / length
        _integrate(tangents, step, integral)
        _rotation_minimising_roll(tangents, roll)
        for k in range(distances.shape[1]):
            _own_frame(tangents, integral, roll, (distances[n, k] - u[0]) / step, step, frames[n, k], places[n, k])


@cached_njit(nogil=True, error_model="numpy")
def _nearest(breaks: Array, cubics: Array, roll: Array, point: Array) -> float:
    """Arc length at which the plane through ``point`` (3,) normal to the path meets it."""
    s, least = breaks[0], np.inf
    for k in range(len(cubics)):
        squared = 0.0
        for i in range(3):
            squared += (cubics[k, i, 3] - point[i]) ** 2
        if squared < least:
            s, least = breaks[k], squared
    frame = np.empty((3, 3))
    for _ in range(NEAREST_STEPS):
        piece, inside = _piece(breaks, s)
        _frame_at(breaks, cubics, roll, s, frame)
        further = 0.0
        for i in range(3):
            cubic, x = cubics[piece, i], inside - breaks[piece]
            place = ((cubic[0] * x + cubic[1]) * x + cubic[2]) * x + cubic[3] + (s - inside) * frame[i, 0]
            further += frame[i, 0] * (point[i] - place)
        s += further
        if abs(further) < NEAREST_PRECISION_M:
            break
    return float(s)


@cached_njit(nogil=True, error_model="numpy")
def _piece(breaks: Array, s: float) -> tuple[int, float]:
    """The piece of the path that holds the arc length ``s``, and this, or that of the path's nearer end."""
    inside = min(max(s, breaks[0]), breaks[-1])
    piece = min(max(np.searchsorted(breaks, inside, "right") - 1, 0), len(breaks) - 2)
    return piece, inside


@cached_njit(nogil=True, error_model="numpy")
def _frame_at(breaks: Array, cubics: Array, roll: Array, s: float, frame: Array) -> None:
    """Fill ``frame`` (3, 3) with that of the path at arc length ``s``."""
    piece, inside = _piece(breaks, s)
    x = inside - breaks[piece]
    tangent = np.empty(3)
    for i in range(3):
        cubic = cubics[piece, i]
        tangent[i] = (3 * cubic[0] * x + 2 * cubic[1]) * x + cubic[2]
    share = x / (breaks[piece + 1] - breaks[piece])
    _rolled_frame(tangent, (1.0 - share) * roll[piece] + share * roll[piece + 1], frame)


@cached_njit(nogil=True, error_model="numpy")
def _rolled_frame(tangent: Array, roll: float, frame: Array) -> None:
    """Fill ``frame`` (3, 3) with the level one along ``tangent`` (3,), turned about it by ``roll``."""
    length = math.sqrt(tangent[0] ** 2 + tangent[1] ** 2 + tangent[2] ** 2)
    x, y, z = tangent[0] / length, tangent[1] / length, tangent[2] / length
    horizontal = math.sqrt(x**2 + z**2)
    px, pz = (1.0, 0.0) if horizontal < MIN_HORIZONTAL_SHARE else (z / horizontal, -x / horizontal)
    bx, by, bz = y * pz, z * px - x * pz, -y * px
    c, s = math.cos(roll), math.sin(roll)
    frame[0, 0], frame[1, 0], frame[2, 0] = x, y, z
    frame[0, 1], frame[1, 1], frame[2, 1] = c * px + s * bx, s * by, c * pz + s * bz
    frame[0, 2], frame[1, 2], frame[2, 2] = c * bx - s * px, c * by, c * bz - s * pz


@cached_njit(nogil=True, error_model="numpy")
def _integrate(values: Array, step: float, integral: Array) -> None:
    """Fill ``integral`` (M, 3) with that of ``values`` (M, 3), ``step`` apart: of the cubic through each four."""
    for m in range(len(values) - 1):
        first = min(max(m - 1, 0), len(values) - 4)
        for i in range(3):
            a, b, c, d = values[first, i], values[first + 1, i], values[first + 2, i], values[first + 3, i]
            if first == m:
                area = 9 * a + 19 * b - 5 * c + d
            elif first == m - 1:
                area = -a + 13 * b + 13 * c - d
            else:
                area = a - 5 * b + 19 * c + 9 * d
            integral[m + 1, i] = integral[m, i] + step / 24 * area


@cached_njit(nogil=True, error_model="numpy")
def _rotation_minimising_roll(tangents: Array, roll: Array) -> None:
    """Fill ``roll`` (M,) as `paths.rotation_minimising_roll` of the level frames along ``tangents`` (M, 3)."""
    before, level = np.empty((3, 3)), np.empty((3, 3))
    _rolled_frame(tangents[0], 0.0, before)
    for m in range(1, len(tangents)):
        _rolled_frame(tangents[m], 0.0, level)
        turn = 0.0
        for i in range(3):
            turn += 0.5 * (level[i, 1] - before[i, 1]) * (level[i, 2] + before[i, 2])
        roll[m] = roll[m - 1] - turn
        for i in range(3):
            before[i, 1], before[i, 2] = level[i, 1], level[i, 2]


@cached_njit(nogil=True, error_model="numpy")
def _own_frame(
    tangents: Array, integral: Array, roll: Array, knot: float, step: float, frame: Array, place: Array
) -> None:
    """Fill ``frame`` (3, 3) and ``place`` (3,) at the distance of ``knot``, a fraction of knots."""
    M = len(tangents)
    m = min(max(int(math.floor(knot)), 0), M - 2)
    first = min(max(m - 1, 0), M - 4)
    # Lagrange's cubic through four tangents; Hermite's through two places
    x, w = knot - first, knot - m
    tangent = np.empty(3)
    for i in range(3):
        a, b, c, d = tangents[first, i], tangents[first + 1, i], tangents[first + 2, i], tangents[first + 3, i]
        tangent[i] = (
            -a * (x - 1) * (x - 2) * (x - 3) / 6
            + b * x * (x - 2) * (x - 3) / 2
            - c * x * (x - 1) * (x - 3) / 2
            + d * x * (x - 1) * (x - 2) / 6
        )
        place[i] = (
            integral[m, i] * (1 + 2 * w) * (1 - w) ** 2
            + step * tangents[m, i] * w * (1 - w) ** 2
            + integral[m + 1, i] * w**2 * (3 - 2 * w)
            - step * tangents[m + 1, i] * w**2 * (1 - w)
        )
    _rolled_frame(tangent, (1.0 - w) * roll[m] + w * roll[m + 1], frame)
