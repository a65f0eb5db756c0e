"""The geometry of every particle's regions, compiled by Numba: (5) and (11) of [Zhu]."""

from __future__ import annotations

import numpy as np
from numba import njit

from paceline.arrays import Array
from paceline.numba_cache import cached_njit
from paceline.speed.geometry import quadrilaterals

_transfer = njit(inline="always")(quadrilaterals.transfer)
_cross_diagonals = njit(inline="always")(quadrilaterals.cross_diagonals)
_unit_square_to = njit(inline="always")(quadrilaterals.unit_square_to)
_inward_edges = njit(inline="always")(quadrilaterals.inward_edges)


@cached_njit(nogil=True, error_model="numpy")
def transfer(
    quads: Array, turns: Array, shifts: Array, planes: Array, K: Array, K_inv: Array, transferred: Array
) -> None:
    """(11): vertices (N, 4, 2) through the homographies K (ΔR + Δt nᵀ/d) K⁻¹ of (5), into ``transferred`` (N, 4, 2).

    ``turns`` ΔR (N, 3, 3), or (1, 3, 3) for all; ``shifts`` Δt (N, 3); ``planes`` n/d (N, 3).
    """
    for p in range(len(quads)):
        _transfer(quads[p], turns[p if len(turns) > 1 else 0], shifts[p], planes[p], K, K_inv, transferred[p])


@cached_njit(nogil=True, error_model="numpy")
def cross_diagonals(quads: Array, crossings: Array) -> None:
    """Writes the intersections of the diagonals of the regions (N, 4, 2) into ``crossings`` (N, 2)."""
    for p in range(len(quads)):
        _cross_diagonals(quads[p], crossings[p])


def unit_square_to(quads: Array) -> Array:
    """Homographies (N, 3, 3) that take the unit square's corners tl, tr, br, bl to ``quads`` (N, 4, 2)."""
    H = np.empty((len(quads), 3, 3))
    _unit_squares_to(np.ascontiguousarray(quads, float), H)
    return H


def inward_edges(quads: Array) -> Array:
    """Lines (N, 4, 3) along the sides of ``quads`` (N, 4, 2), tl, tr, br, bl, positive inside."""
    edges = np.empty((len(quads), 4, 3))
    _all_inward_edges(np.ascontiguousarray(quads, float), edges)
    return edges


@cached_njit(nogil=True, error_model="numpy")
def _unit_squares_to(quads: Array, H: Array) -> None:
    """`unit_square_to`, into ``H`` (N, 3, 3)."""
    for p in range(len(quads)):
        _unit_square_to(quads[p], H[p])


@cached_njit(nogil=True, error_model="numpy")
def _all_inward_edges(quads: Array, edges: Array) -> None:
    """`inward_edges`, into ``edges`` (N, 4, 3)."""
    for p in range(len(quads)):
        _inward_edges(quads[p], edges[p])
