"""The loop over a band's samples, compiled by Numba: how the parameters of the homographies move the intensities."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

SUMS = {"reassoc", "contract", "nsz"}  # sums may be taken in another order


@njit(cache=True, nogil=True, fastmath=SUMS, error_model="numpy")
def linearise(
    x: Array,
    z: Array,
    B: Array,
    places: Array,
    g: Array,
    H_d: Array,
    strips: Floats,
    free_of: Floats,
    M: Floats,
) -> None:
    """∂I/∂H, and by how far each of the S strips stands off the plane, into the first 9 and the next S rows of ``M``
    (views, patches, 9 + S + 1, samples); and these and what the last row holds freed of each patch's mean and of what
    ``free_of`` (C, patches, samples; of length 1) holds, one after the other.

    ``x`` (views, 2, N) px is where the N samples at ``places`` (3, N) of the unit square lie, ``z`` (views, N) their
    scale and ``B`` (views, 2, 2, N) ∂x over the square; ``g`` (2, N) the texture's slope there. ``H_d`` (views, 9) is
    the change of H per metre off the plane, ``strips`` (S, samples) are 1 where a patch's samples are of each.
    """
    V, K, rows, m = M.shape
    c, off = np.empty((3, m), np.float32), np.empty(m, np.float32)
    for v in range(V):
        for k in range(K):
            own, first = M[v, k], k * m
            for i in range(m):
                n = first + i
                det = (B[v, 0, 0, n] * B[v, 1, 1, n] - B[v, 0, 1, n] * B[v, 1, 0, n]) * z[v, n]
                ax = (g[0, n] * B[v, 1, 1, n] - g[1, n] * B[v, 1, 0, n]) / det
                ay = (g[1, n] * B[v, 0, 0, n] - g[0, n] * B[v, 0, 1, n]) / det
                c[0, i], c[1, i], c[2, i] = ax, ay, -(ax * x[v, 0, n] + ay * x[v, 1, n])
                off[i] = 0.0
                for j in range(9):
                    off[i] += H_d[v, j] * c[j // 3, i] * places[j % 3, n]
            for j in range(rows):
                row = own[j]
                if 9 <= j < rows - 1:
                    for i in range(m):
                        row[i] = off[i] * strips[j - 9, i]
                elif j < 9:
                    factor, place = c[j // 3], places[j % 3, first : first + m]
                    for i in range(m):
                        row[i] = factor[i] * place[i]
                total = 0.0
                for i in range(m):
                    total += row[i]
                mean = np.float32(total / m)
                for i in range(m):
                    row[i] -= mean
                for known in free_of[:, k]:
                    share = np.float32(0.0)
                    for i in range(m):
                        share += row[i] * known[i]
                    for i in range(m):
                        row[i] -= share * known[i]
