"""Cluster-robust covariance (CR2) of a fit, from the scatter of its scores over frames and patches.

Normal equations come in *cells*, one for each patch of each view: matrices (views, K, P + S, P + S) and scores
(views, K, P + S) over the P parameters that all patches share and, last, the S depth offsets of the patch itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from paceline.arrays import Array

MIN_VARIANCE_SHARE = 0.5  # least variance of a mean of estimates, as a share of their mean variance
MIN_INFORMATION_LEFT = 0.05  # share of the information that is assumed outside a single cluster


@dataclass(frozen=True, eq=False)
class RobustCovariance:
    """Covariance (P, P) of the shared parameters: the part ``of_prior`` is known, that ``of_scatter`` is estimated."""

    of_prior: Array
    of_scatter: Array

    @property
    def total(self) -> Array:
        return np.asarray(self.of_prior + self.of_scatter)

    def dof(self, gradient: Array, clusters: int) -> float:
        """Effective degrees of freedom of the variance of the linear function ``gradient`` (P,), of whose scatter that
        of so many ``clusters`` is known."""
        variances = np.array([gradient @ C @ gradient for C in (self.of_scatter, self.of_prior)])
        return effective_dof(variances, np.array([clusters - 1.0, np.inf]))


def effective_dof(variances: Array, dofs: Array) -> float:
    """Degrees of freedom of the sum of ``variances`` (N,) that have these ``dofs`` (N,), infinite where they are known
    (Satterthwaite 1946, "An approximate distribution of estimates of variance components")."""
    return float(variances.sum() ** 2 / max(float((variances**2 / dofs).sum()), np.finfo(float).tiny))


def assemble(cells_A: Array, P: int) -> Array:
    """The normal matrix (P + K S, P + K S) of all cells, over ``P`` shared parameters and the depth offsets."""
    by_patch = cells_A.sum(0)
    return arrow_matrix(by_patch[:, :P, :P].sum(0), by_patch[:, P:, :P], by_patch[:, P:, P:])


def arrow_matrix(shared: Array, border: Array | float, blocks: Array) -> Array:
    """The symmetric matrix (P + K S, P + K S) of ``shared`` (P, P), K ``blocks`` (K, S, S) on the diagonal after it,
    and their ``border`` (K, S, P) with it."""
    P, (K, S) = len(shared), blocks.shape[:2]
    diagonal = np.zeros((K, S, K, S))
    diagonal[np.arange(K), :, np.arange(K)] = blocks
    A = np.empty((P + K * S,) * 2)
    A[:P, :P], A[P:, P:] = shared, diagonal.reshape(K * S, K * S)
    A[P:, :P] = np.broadcast_to(border, (K, S, P)).reshape(K * S, P)
    A[:P, P:] = A[P:, :P].T
    return A


def assemble_scores(cells: Array, P: int) -> Array:
    """The score (P + K S,) of all cells."""
    by_patch = cells.sum(0)
    return np.concatenate([by_patch[:, :P].sum(0), by_patch[:, P:].ravel()])


def covariance(
    A: Array, prior: Array, cells_A: Array, cells: Array, gradient: Array, is_crossed: bool = False
) -> RobustCovariance:
    """The covariance of the shared parameters, with normal matrix ``A`` and ``prior`` information.

    Errors that a patch repeats in every frame, or a frame in every patch, do not average out over pixels: scores are
    summed within each before they are squared. A sandwich estimate for each way of clustering, with the small-sample
    correction of Bell and McCaffrey 2002 ("CR2"); returned is the one with the larger variance of the linear function
    ``gradient`` (P,), or their sum if errors of both kinds are there at once (``is_crossed``; Cameron, Gelbach and
    Miller 2011, "Robust inference with multiway clustering", without taking off what is of single cells: neighbouring
    patches share pixels). Raises numpy.linalg.LinAlgError where the parameters are not determined.
    """
    views, K, n = cells.shape
    P = len(gradient)
    inverse = np.linalg.inv(A)
    of_prior = (inverse @ prior @ inverse)[:P, :P]
    by_frame = []
    for v in range(0, views, 2):
        s = _corrected_score(A, assemble(cells_A[v : v + 2], P), assemble_scores(cells[v : v + 2], P))
        by_frame.append(inverse[:P] @ s)
    by_patch = []
    for k in range(K):
        own = np.r_[:P, P + k * (n - P) : P + (k + 1) * (n - P)]
        marginal = np.linalg.inv(inverse[np.ix_(own, own)])
        by_patch.append(inverse[:P, own] @ _corrected_score(marginal, cells_A[:, k].sum(0), cells[:, k].sum(0)))
    scatters = [changes.T @ changes for changes in (np.array(by_frame), np.array(by_patch))]
    scatter = scatters[0] + scatters[1] if is_crossed else max(scatters, key=lambda C: float(gradient @ C @ gradient))
    return RobustCovariance(of_prior, np.asarray(scatter))


def _corrected_score(A: Array, A_i: Array, s: Array) -> Array:
    """CR2-corrected score (r,) of a cluster: L (I − B)^−½ L⁻¹ s with B = L⁻¹ Aᵢ L⁻ᵀ and A = L Lᵀ.

    ``A`` (r, r) is the normal matrix of the cluster's parameters with all others eliminated, ``A_i`` (r, r) the
    cluster's part of it, and ``s`` (r,) its score.
    """
    share, V = eigh(A_i, A)
    enlarged = 1.0 / np.sqrt(np.maximum(1.0 - share, MIN_INFORMATION_LEFT))
    return np.asarray(s + A @ V @ ((enlarged - 1.0) * (V.T @ s)))


def scatter_of_shifts(patches_A: Array, patches: Array, shifts: Sequence[int], own: int) -> Array:
    """Standard deviations (2,) over K patches of what is left of two shifts in each, weighted by their information.

    ``patches_A`` (K, m, m) and ``patches`` (K, m) are the patches' normal equations, the last ``own`` of whose
    parameters are the patch's own and are eliminated; ``shifts`` are the indices of the two.
    """
    of_shifts = np.array(shifts)
    border = patches_A[:, of_shifts, -own:]
    eliminated = border @ np.linalg.inv(patches_A[:, -own:, -own:])
    information = patches_A[:, of_shifts[:, None], of_shifts] - eliminated @ np.swapaxes(border, 1, 2)
    score = patches[:, of_shifts] - (eliminated @ patches[:, -own:, None])[..., 0]
    left = -(np.linalg.pinv(information, hermitian=True) @ score[..., None])[..., 0]
    weights = np.diagonal(information, axis1=1, axis2=2)
    mean = (weights * left).sum(0) / weights.sum(0)
    return np.asarray(np.sqrt((weights * (left - mean) ** 2).sum(0) / weights.sum(0)))


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
