"""Cluster-robust covariance (CR2) of a fit, from the scatter of its scores over frames and patches.

Normal equations come in *cells*, one for each patch of each view: matrices (views, K, P + S, P + S) and scores
(views, K, P + S) over the P parameters that all patches share and, last, the S depth offsets of the patch itself.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from paceline.arrays import Array

MIN_VARIANCE_SHARE = 0.5  # least variance of a mean of estimates, as a share of their mean variance
MIN_INFORMATION_LEFT = 0.05  # share of the information that is assumed outside a single cluster


def assemble(cells_A: Array, P: int) -> Array:
    """The normal matrix (P + K S, P + K S) of all cells, over ``P`` shared parameters and the depth offsets."""
    by_patch = cells_A.sum(0)
    of_offsets = by_patch[:, P:, :P].reshape(-1, P)
    return np.block([[by_patch[:, :P, :P].sum(0), of_offsets.T], [of_offsets, block_diag(*by_patch[:, P:, P:])]])


def assemble_scores(cells: Array, P: int) -> Array:
    """The score (P + K S,) of all cells."""
    by_patch = cells.sum(0)
    return np.concatenate([by_patch[:, :P].sum(0), by_patch[:, P:].ravel()])


def covariance(A: Array, prior: Array, cells_A: Array, cells: Array, gradient: Array) -> Array:
    """Covariance (P, P) of the shared parameters, with normal matrix ``A`` and ``prior`` information.

    Errors that a patch repeats in every frame, or a frame in every patch, do not average out over pixels: scores are
    summed within each before they are squared. A sandwich estimate for each way of clustering, with the small-sample
    correction of Bell and McCaffrey 2002 ("CR2"); returned is the one with the larger variance of the linear function
    ``gradient`` (P,). Raises numpy.linalg.LinAlgError where the parameters are not determined.
    """
    views, K, _ = cells.shape
    P = len(gradient)
    inverse = np.linalg.inv(A)
    frames = [np.s_[v : v + 2] for v in range(0, views, 2)]
    by_frame = [(assemble(cells_A[f], P), assemble_scores(cells[f], P)) for f in frames]
    only = np.eye(K)[:, :, None, None]
    by_patch = [(assemble(cells_A * only[k], P), assemble_scores(cells * only[k, :, 0], P)) for k in range(K)]
    candidates = []
    for clusters in (by_frame, by_patch):
        score_covariance = sum((np.outer(s, s) for s in _corrected_scores(A, clusters)), prior)
        candidates.append((inverse @ score_covariance @ inverse)[:P, :P])
    return max(candidates, key=lambda C: float(gradient @ C @ gradient))


def _corrected_scores(A: Array, clusters: list[tuple[Array, Array]]) -> list[Array]:
    """CR2-corrected scores of clusters: L (I − B)^−½ L⁻¹ s with B = L⁻¹ Aᵢ L⁻ᵀ and A = L Lᵀ."""
    L = np.linalg.cholesky(A)
    back = np.linalg.inv(L)
    scores = []
    for A_i, s in clusters:
        share, axes = np.linalg.eigh(back @ A_i @ back.T)
        enlarged = axes / np.sqrt(np.maximum(1.0 - share, MIN_INFORMATION_LEFT)) @ axes.T
        scores.append(L @ enlarged @ back @ s)
    return scores


def mean_of_estimates(values: Array, variances: Array) -> tuple[Array, float]:
    """Weights (N,) of N estimates of one quantity for their mean, and the variance of that mean.

    The estimates come from the same images, so their errors are not independent. The squared error of a weighted mean
    is the mean squared error less the spread about the mean (Krogh and Vedelsby 1995). ``variances`` (N,) are uncertain
    themselves, so each estimate is weighted by its own variance plus the mean one.
    """
    weights = 1.0 / (variances + variances.mean())
    weights /= weights.sum()
    mean_variance = float(weights @ variances)
    spread = float(weights @ (values - weights @ values) ** 2)
    return weights, max(mean_variance - spread, MIN_VARIANCE_SHARE * mean_variance)
