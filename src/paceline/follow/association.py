"""Stage 2 of [NIST]: which edge points belong to which feature of the model."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Floats, Indices, Mask
from paceline.numba_cache import cached_njit

NOBODY = -1


@cached_njit(nogil=True, error_model="numpy")
def associate(
    points: Floats,
    upright: bool,
    vertical: Mask,
    places: Array,
    spans: Array,
    gates: Array,
    brighter: Indices,
    owners: Indices,
) -> None:
    """``owners`` (≥ N,): for each edge point the nearest feature in reach, or NOBODY: (8)–(11) and the gate ζ.

    ``points`` (N, 3) are rows (x, y, signed magnitude) of the near-vertical list where ``upright``, else of the
    near-horizontal one; their direction (7) was tested when the list was made. ``places`` (S,) px is where every
    feature is predicted across itself, ``spans`` (S, 2) px where along itself, ``gates`` (S,) px how far a point may
    be. A feature whose ``brighter`` (S,) is 1 or −1 takes only edges with a step of this sign; 0 takes either.
    """
    across, along = (0, 1) if upright else (1, 0)
    mine = np.flatnonzero(vertical == upright)
    place, reach, first, last = places[mine], gates[mine], spans[mine, 0], spans[mine, 1]
    for i in range(len(points)):
        p, q = points[i, across], points[i, along]
        owner, least = NOBODY, np.inf
        for k in range(len(mine)):
            d = abs(place[k] - p)
            if d < reach[k] and d < least and first[k] < q < last[k] and brighter[mine[k]] * points[i, 2] >= 0.0:
                owner, least = mine[k], d
        owners[i] = owner
