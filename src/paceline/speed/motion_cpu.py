"""The geometry of every particle's regions, compiled by Numba: (5) and (11) of [Zhu]."""

# mypy: allow-untyped-defs
from __future__ import annotations

from numba import njit

from paceline.speed import regions

_carry = njit(inline="always")(regions.carry)
_cross_diagonals = njit(inline="always")(regions.cross_diagonals)


@njit(cache=True, nogil=True, error_model="numpy")
def carry(quads, turns, shifts, planes, K, K_inv, carried):
    """(11): vertices (N, 4, 2) through the homographies K (ΔR + Δt nᵀ/d) K⁻¹ of (5), into ``carried`` (N, 4, 2).

    ``turns`` ΔR (N, 3, 3), or (1, 3, 3) for all; ``shifts`` Δt (N, 3); ``planes`` n/d (N, 3).
    """
    for p in range(len(quads)):
        _carry(quads[p], turns[p if len(turns) > 1 else 0], shifts[p], planes[p], K, K_inv, carried[p])


@njit(cache=True, nogil=True, error_model="numpy")
def cross_diagonals(quads, crossings):
    """Into ``crossings`` (N, 2) where the diagonals of the regions (N, 4, 2) meet."""
    for p in range(len(quads)):
        _cross_diagonals(quads[p], crossings[p])
