"""The geometry of every particle's regions, compiled by Numba: (5) and (11) of [Zhu], vertex by vertex.

The homographies are not written out as matrices: n/d enters as one inner product with the ray of a vertex.
"""

# mypy: allow-untyped-defs
from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def carry(quads, turns, shifts, planes, K, K_inv, carried):
    """(11): vertices (N, 4, 2) through the homographies K (ΔR + Δt nᵀ/d) K⁻¹ of (5), into ``carried`` (N, 4, 2).

    ``turns`` ΔR (N, 3, 3), or (1, 3, 3) for all; ``shifts`` Δt (N, 3); ``planes`` n/d (N, 3).
    """
    for p in range(len(quads)):
        R = turns[p if len(turns) > 1 else 0]
        for v in range(quads.shape[1]):
            x, y = quads[p, v, 0], quads[p, v, 1]
            a = K_inv[0, 0] * x + K_inv[0, 1] * y + K_inv[0, 2]
            b = K_inv[1, 0] * x + K_inv[1, 1] * y + K_inv[1, 2]
            c = K_inv[2, 0] * x + K_inv[2, 1] * y + K_inv[2, 2]
            share = planes[p, 0] * a + planes[p, 1] * b + planes[p, 2] * c
            X = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + share * shifts[p, 0]
            Y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + share * shifts[p, 1]
            Z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + share * shifts[p, 2]
            w = K[2, 0] * X + K[2, 1] * Y + K[2, 2] * Z
            carried[p, v, 0] = (K[0, 0] * X + K[0, 1] * Y + K[0, 2] * Z) / w
            carried[p, v, 1] = (K[1, 0] * X + K[1, 1] * Y + K[1, 2] * Z) / w


@njit(cache=True, nogil=True, error_model="numpy")
def cross_diagonals(quads, crossings):
    """Into ``crossings`` (N, 2) where the diagonals of the regions (N, 4, 2) meet."""
    for p in range(len(quads)):
        q = quads[p]
        ac_x, ac_y = q[2, 0] - q[0, 0], q[2, 1] - q[0, 1]
        bd_x, bd_y = q[3, 0] - q[1, 0], q[3, 1] - q[1, 1]
        ab_x, ab_y = q[1, 0] - q[0, 0], q[1, 1] - q[0, 1]
        share = (ab_x * bd_y - ab_y * bd_x) / (ac_x * bd_y - ac_y * bd_x)
        crossings[p, 0] = q[0, 0] + share * ac_x
        crossings[p, 1] = q[0, 1] + share * ac_y
