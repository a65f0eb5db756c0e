"""How sure a fit is, from how the scores of frames and of patches really scatter, not from the pixels' noise.

Normal equations come in *cells*, one for each patch of each view: matrices (views, K, P + S, P + S) and scores
(views, K, P + S) over the P parameters that patches share and, last, the S of the patch's own relief.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from paceline.arrays import Array

LEAST_LEFT = 0.5  # share of estimates' variance that their mean has left, at least
LEAST_REST = 0.05  # share of the information that a single cluster leaves to the others, at least


def joined(cells_A: Array, P: int) -> Array:
    """Normal matrices of cells as one (P + K S, P + K S) over ``P`` shared parameters and the reliefs."""
    by_patch = cells_A.sum(0)
    of_reliefs = by_patch[:, P:, :P].reshape(-1, P)
    return np.block([[by_patch[:, :P, :P].sum(0), of_reliefs.T], [of_reliefs, block_diag(*by_patch[:, P:, P:])]])


def joined_scores(cells: Array, P: int) -> Array:
    """Scores of cells as one (P + K S,)."""
    by_patch = cells.sum(0)
    return np.concatenate([by_patch[:, :P].sum(0), by_patch[:, P:].ravel()])


def covariance(A: Array, known: Array, cells_A: Array, cells: Array, judged: Array) -> Array:
    """Covariance (P, P) of the shared parameters, whose normal matrix is ``A`` and prior information ``known``.

    Errors that a patch repeats in every frame and that a frame makes in every patch do not average out over pixels:
    the scores are summed within each before they are squared. That is a sandwich estimate, clustered both ways and
    freed of its small-sample bias (Bell and McCaffrey 2002, "CR2"), of which that is taken which is wider for
    ``judged`` (P,), a linear function of the parameters. Raises numpy.linalg.LinAlgError where the parameters are not
    determined.
    """
    views, K, _ = cells.shape
    P = len(judged)
    inverse = np.linalg.inv(A)
    frames = [np.s_[v : v + 2] for v in range(0, views, 2)]
    by_frame = [(joined(cells_A[f], P), joined_scores(cells[f], P)) for f in frames]
    only = np.eye(K)[:, :, None, None]
    by_patch = [(joined(cells_A * only[k], P), joined_scores(cells * only[k, :, 0], P)) for k in range(K)]
    candidates = []
    for clusters in (by_frame, by_patch):
        meat = sum((np.outer(s, s) for s in _unbiased(A, clusters)), known)
        candidates.append((inverse @ meat @ inverse)[:P, :P])
    return max(candidates, key=lambda C: float(judged @ C @ judged))


def _unbiased(A: Array, clusters: list[tuple[Array, Array]]) -> list[Array]:
    """Cluster scores, enlarged for having drawn the fit to themselves: L (I − B)^−½ L⁻¹ s, B = L⁻¹ Aᵢ L⁻ᵀ, A = L Lᵀ."""
    L = np.linalg.cholesky(A)
    back = np.linalg.inv(L)
    scores = []
    for A_i, s in clusters:
        share, axes = np.linalg.eigh(back @ A_i @ back.T)
        enlarged = axes / np.sqrt(np.maximum(1.0 - share, LEAST_REST)) @ axes.T
        scores.append(L @ enlarged @ back @ s)
    return scores


def averaged(values: Array, variances: Array) -> tuple[Array, float]:
    """The weights (N,) of N estimates of one number in their mean, and the variance of that.

    They rest on the same pictures, so their errors do not average out as independent ones would; but by what they
    differ from each other they cannot all be wrong. The squared error of a weighted mean is the mean squared error less
    the spread about the mean (Krogh and Vedelsby 1995). ``variances`` (N,) are themselves known from few scores, and a
    small one may be so by chance: each is weighed by its own and the mean one together.
    """
    weights = 1.0 / (variances + variances.mean())
    weights /= weights.sum()
    mean_variance = float(weights @ variances)
    spread = float(weights @ (values - weights @ values) ** 2)
    return weights, max(mean_variance - spread, LEAST_LEFT * mean_variance)
