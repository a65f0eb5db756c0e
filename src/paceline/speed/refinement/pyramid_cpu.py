"""The loops over a band's samples, compiled by Numba: how the parameters move the intensities, and what follows."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Floats
from paceline.numba_cache import cached_njit

SUMS = {"reassoc", "contract", "nsz"}  # sums may be taken in another order


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
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
    (views, patches, 9 + S + 1, samples); and these and what the last row holds freed of what ``free_of`` (C, patches,
    samples) holds: fields that have nothing in common.

    ``x`` (views, 2, N) px is where the N samples at ``places`` (3, N) of the unit square lie, ``z`` (views, N) their
    scale and ``B`` (views, 2, 2, N) ∂x over the square; ``g`` (2, N) the texture's slope there. ``H_d`` (views, 9) is
    the change of H per metre off the plane, ``strips`` (S, samples) are 1 where a patch's samples are of each.
    """
    V, K, _, m = M.shape
    c, off = np.empty((3, m), np.float32), np.empty(m, np.float32)
    for k in range(K):
        first = k * m
        gone = np.ascontiguousarray(free_of[:, k])
        by_sample = gone.T.copy()
        for v in range(V):
            own = M[v, k]
            for i in range(m):
                n = first + i
                det = (B[v, 0, 0, n] * B[v, 1, 1, n] - B[v, 0, 1, n] * B[v, 1, 0, n]) * z[v, n]
                ax = (g[0, n] * B[v, 1, 1, n] - g[1, n] * B[v, 1, 0, n]) / det
                ay = (g[1, n] * B[v, 0, 0, n] - g[0, n] * B[v, 0, 1, n]) / det
                c[0, i], c[1, i], c[2, i] = ax, ay, -(ax * x[v, 0, n] + ay * x[v, 1, n])
            off[:] = 0.0
            for j in range(9):
                row, factor, place = own[j], c[j // 3], places[j % 3, first : first + m]
                per_metre = np.float32(H_d[v, j])
                for i in range(m):
                    row[i] = factor[i] * place[i]
                for i in range(m):
                    off[i] += per_metre * row[i]
            for j in range(len(strips)):
                row, strip = own[9 + j], strips[j]
                for i in range(m):
                    row[i] = off[i] * strip[i]
            own -= np.dot(np.dot(own, by_sample), gone)


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def normal_equations(M: Floats, dH: Floats, white: Floats, r: Floats, A: Array, score: Array) -> None:
    """The normal matrices ``A`` (views, patches, n, n) and scores ``score`` (views, patches, n) of residuals ``r``
    (patches, views, samples), by ``M`` of `linearise`, over n = P + 1 + S parameters: those that move H by ``dH``
    (views, P, 9), γ, and the strips' relief.

    ``white`` (patches, views, views) weighs and joins each patch's views, and leaves out what all have in common: the
    shared texture moves along with the parameters, so that this tells nothing. Products are summed in double precision.
    ``white`` and ``r`` are contiguous.
    """
    V, K, rows, m = M.shape
    P, n = dH.shape[1], A.shape[-1]
    J = np.empty((V, n, m), np.float32)
    for k in range(K):
        for v in range(V):
            J[v, :P] = np.dot(dH[v], M[v, k, :9])
            J[v, P] = M[v, k, rows - 1]
            J[v, P + 1 :] = M[v, k, 9 : rows - 1]
        told = np.dot(white[k], J.reshape(V, n * m)).reshape(V, n, m)
        left = np.dot(white[k], r[k])
        for v in range(V):
            own = told[v].astype(np.float64)
            A[v, k] = np.dot(own, own.T)
            score[v, k] = np.dot(own, left[v].astype(np.float64))
