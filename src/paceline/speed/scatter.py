"""How sure a fit is, from how the scores of frames and of patches really scatter, not from the pixels' noise.

Normal equations come in *cells*, one for each patch of each view: matrices (views, K, P + 1, P + 1) and scores
(views, K, P + 1) over the P parameters that patches share and, last, the patch's own relief.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_LEFT = 0.5  # share of estimates' variance that their mean has left, at least
LEAST_REST = 0.05  # share of the information that a single cluster leaves to the others, at least


def joined(cells_A: Array) -> Array:
    """Normal matrices of cells as one (P + K, P + K) over parameters and reliefs."""
    by_patch = cells_A.sum(0)
    K, P = len(by_patch), by_patch.shape[-1] - 1
    A = np.zeros((P + K, P + K))
    A[:P, :P] = by_patch[:, :P, :P].sum(0)
    A[P:, :P] = by_patch[:, P, :P]
    A[:P, P:] = by_patch[:, P, :P].T
    A[range(P, P + K), range(P, P + K)] = by_patch[:, P, P]
    return A


def joined_scores(cells: Array) -> Array:
    """Scores of cells as one (P + K,)."""
    by_patch = cells.sum(0)
    return np.concatenate([by_patch[:, :-1].sum(0), by_patch[:, -1]])


def covariance(A: Array, known: Array, cells_A: Array, cells: Array, judged: Array) -> Array:
    """Covariance (P, P) of the shared parameters, whose normal matrix is ``A`` and prior information ``known``.

    Errors that a patch repeats in every frame and that a frame makes in every patch do not average out over pixels:
    the scores are summed within each before they are squared. That is a sandwich estimate, clustered both ways and
    freed of its small-sample bias (Bell and McCaffrey 2002, "CR2"), of which that is taken which is wider for
    ``judged`` (P,), a linear function of the parameters. Raises numpy.linalg.LinAlgError where the parameters are not
    determined.
    """
    views, K, n = cells.shape
    inverse = np.linalg.inv(A)
    frames = [np.s_[v : v + 2] for v in range(0, views, 2)]
    by_frame = [(joined(cells_A[f]), joined_scores(cells[f])) for f in frames]
    only = np.eye(K)[:, :, None, None]
    by_patch = [(joined(cells_A * only[k]), joined_scores(cells * only[k, :, 0])) for k in range(K)]
    candidates = []
    for clusters in (by_frame, by_patch):
        meat = sum((np.outer(s, s) for s in _unbiased(A, clusters)), known)
        candidates.append((inverse @ meat @ inverse)[: n - 1, : n - 1])
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
