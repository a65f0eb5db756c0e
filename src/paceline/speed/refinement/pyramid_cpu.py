"""Jacobian and normal equations of a pyramid level, compiled by Numba."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Floats
from paceline.numba_cache import cached_njit

FASTMATH_FLAGS = {"reassoc", "contract", "nsz"}  # sums may be reordered


@cached_njit(nogil=True, fastmath=FASTMATH_FLAGS, error_model="numpy")
def linearise(
    x: Array,
    z: Array,
    B: Array,
    points: Array,
    g: Array,
    H_d: Array,
    rows: Floats,
    nuisance: Floats,
    M: Floats,
) -> None:
    """Fill ``M`` (views, patches, 9 + S + 1, samples) with ∂I/∂H in its first 9 rows and ∂I/∂(depth offset) in S more.

    These and the last row, which is given, are made orthogonal to the C orthonormal fields ``nuisance`` (C, patches,
    samples). ``x`` (views, 2, N) px are the images of the N sample points ``points`` (3, N) of the unit square, ``z``
    (views, N) their homogeneous scale and ``B`` (views, 2, 2, N) ∂x over the square; ``g`` (2, N) is the texture's
    slope there. ``H_d`` (views, 9) is the change of H per metre off the plane; ``rows`` (S, samples) are 1 where a
    sample belongs to a row of its patch.
    """
    V, K, _, m = M.shape
    c, by_offset = np.empty((3, m), np.float32), np.empty(m, np.float32)
    for k in range(K):
        first = k * m
        fields = np.ascontiguousarray(nuisance[:, k])
        by_sample = fields.T.copy()
        for v in range(V):
            patch_rows = M[v, k]
            for i in range(m):
                n = first + i
                det = (B[v, 0, 0, n] * B[v, 1, 1, n] - B[v, 0, 1, n] * B[v, 1, 0, n]) * z[v, n]
                ax = (g[0, n] * B[v, 1, 1, n] - g[1, n] * B[v, 1, 0, n]) / det
                ay = (g[1, n] * B[v, 0, 0, n] - g[0, n] * B[v, 0, 1, n]) / det
                c[0, i], c[1, i], c[2, i] = ax, ay, -(ax * x[v, 0, n] + ay * x[v, 1, n])
            by_offset[:] = 0.0
            for j in range(9):
                row, factor, place = patch_rows[j], c[j // 3], points[j % 3, first : first + m]
                per_metre = np.float32(H_d[v, j])
                for i in range(m):
                    row[i] = factor[i] * place[i]
                for i in range(m):
                    by_offset[i] += per_metre * row[i]
            for j in range(len(rows)):
                row, row_mask = patch_rows[9 + j], rows[j]
                for i in range(m):
                    row[i] = by_offset[i] * row_mask[i]
            patch_rows -= np.dot(np.dot(patch_rows, by_sample), fields)


@cached_njit(nogil=True, fastmath=FASTMATH_FLAGS, error_model="numpy")
def normal_equations(M: Floats, dH: Floats, whitening: Floats, r: Floats, A: Array, score: Array) -> None:
    """Fill in normal matrices ``A`` (views, patches, n, n) and scores ``score`` (views, patches, n).

    The n = P + 1 + S parameters are those that change H by ``dH`` (views, P, 9), γ and the depth offsets; ``M`` is that
    of `linearise` and ``r`` (patches, views, samples) are the residuals. ``whitening`` (patches, views, views) weights
    the views of each patch and removes their common part, which the shared texture explains. Sums are in double
    precision; ``whitening`` and ``r`` have to be contiguous.
    """
    V, K, rows, m = M.shape
    P, n = dH.shape[1], A.shape[-1]
    J = np.empty((V, n, m), np.float32)
    for k in range(K):
        for v in range(V):
            np.dot(dH[v], M[v, k, :9], J[v, :P])
            for i in range(m):  # by element: the check of an array's shape takes 5 s to compile
                J[v, P, i] = M[v, k, rows - 1, i]
            for row in range(9, rows - 1):
                for i in range(m):
                    J[v, P + row - 8, i] = M[v, k, row, i]
        whitened = np.dot(whitening[k], J.reshape(V, n * m)).reshape(V, n, m)
        residuals = np.dot(whitening[k], r[k])
        for v in range(V):
            view_rows = whitened[v].astype(np.float64)
            np.dot(view_rows, view_rows.T, A[v, k])
            np.dot(view_rows, residuals[v].astype(np.float64), score[v, k])
