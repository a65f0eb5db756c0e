"""Bundle adjustment: both cameras, their relative pose, and the board's pose in every pair of images at once.

Levenberg–Marquardt on the detected corners of the board, with the board's poses eliminated (Schur complement) and
robust weights; the covariance takes each pair of images as a cluster.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from paceline.arrays import Array, Indices
from paceline.calibration.parameters import N_RIG, Observations, Poses, RigState
from paceline.calibration.projection import project

Weighting = Literal["huber", "redescending"]

CORNER_HUBER_SIGMA = 2.5  # standard deviations above which a corner is downweighted
CORNER_REDESCENDING_SIGMA = (
    6.0  # standard deviations at which a corner has a quarter of the weight, before outliers are removed
)
MAX_ADJUSTMENT_STEPS = 60
CONVERGENCE_TOLERANCE = 1e-7  # relative change of the sum of squares
MIN_SIGMA_PX = 1e-3  # lower limit that keeps the weights of exact corners finite
RAYLEIGH_MEDIAN = 1.1774  # median length of a two-dimensional error, in standard deviations of a coordinate


@dataclass(frozen=True, eq=False)
class BundleAdjustment:
    """The adjusted rig and poses; ``free`` (P,) are the rig's parameters that were estimated.

    ``residuals`` (M, 2) px are observed minus predicted, ``weights`` (M,) those of the corners. ``information``
    (V, P, P) is that of every view on the free parameters once its pose is eliminated, ``scores`` (V, P) its gradient,
    both for corners of a standard deviation of one pixel.
    """

    rig: RigState
    poses: Poses
    free: Indices
    residuals: Array
    weights: Array
    information: Array
    scores: Array
    converged: bool

    @property
    def sigma(self) -> float:
        """Standard deviation of a corner's coordinate, px, from the residuals."""
        unknown = len(self.free) + 6 * len(self.poses.t)
        dof = 2 * self.weights.sum() - unknown
        return float(np.sqrt((self.weights[:, None] * self.residuals**2).sum() / max(dof, 1.0)))

    @property
    def cluster_variance(self) -> float:
        """Variance of a corner's coordinate, px², estimated with the views as clusters.

        Errors common to the corners of a view (a board that is not flat, blur, a finder that errs all one way) do not
        average out within it. Under independent errors the scores s_v have the covariance σ² (A_v − A_v A⁻¹ A_v), so
        that Σ s_vᵀ A⁻¹ s_v estimates σ² Σ tr (A⁻¹ A_v (1 − A⁻¹ A_v)); larger scores mean larger clusters of error.
        """
        inverse = np.linalg.inv(self.information.sum(0))
        share = inverse @ self.information
        expected = np.trace(share - share @ share, axis1=1, axis2=2).sum()
        weighted_squares = np.einsum("vi,ij,vj->", self.scores, inverse, self.scores)
        return float(weighted_squares / max(expected, 1e-9))

    @property
    def covariance(self) -> Array:
        """Covariance (24, 24) of all parameters of the rig; zero for those that were fixed.

        From independent corners or from views as clusters, whichever is wider. Raises numpy.linalg.LinAlgError where
        the views do not determine the parameters.
        """
        inverse = np.linalg.inv(self.information.sum(0))
        C = np.zeros((N_RIG, N_RIG))
        C[np.ix_(self.free, self.free)] = max(self.sigma**2, self.cluster_variance) * inverse
        return C


def adjust(
    rig: RigState, poses: Poses, observations: Observations, free: Indices, weighing: Weighting = "huber"
) -> BundleAdjustment:
    """Adjusts the rig's ``free`` parameters and all poses to the ``observations``, from an approximate start.

    With no free parameters only the poses are fitted. Every view must hold corners, listed in the views' order.
    """
    V, P, damping = len(poses.t), len(free), 1e-3
    expected, J, Q = project(rig, poses, observations)
    residuals = observations.pixels - expected
    weights, settled = _weights(residuals, weighing), False
    for _ in range(MAX_ADJUSTMENT_STEPS):
        blocks = _normal_equations(J[..., free], Q, residuals, weights, observations.view, V)
        cost = _cost(residuals, weights)
        while True:
            step, poses_step = _solve(blocks, damping)
            rig_step = np.zeros(N_RIG)
            rig_step[free] = step
            new_rig, new_poses = rig.updated(rig_step), poses.updated(poses_step)
            new_expected, new_J, new_Q = project(new_rig, new_poses, observations)
            new_residuals = observations.pixels - new_expected
            new_cost = _cost(new_residuals, weights)
            if np.isfinite(new_cost) and new_cost <= cost:
                break
            damping *= 10
            if damping > 1e10:
                break
        if not new_cost <= cost:  # no step reduces the cost any more
            settled = True
            break
        rig, poses, residuals, J, Q = new_rig, new_poses, new_residuals, new_J, new_Q
        damping = max(damping / 10, 1e-12)
        if cost - new_cost <= CONVERGENCE_TOLERANCE * cost:
            settled = True
            break
        weights = _weights(residuals, weighing)
    A, B, C, a, b = _normal_equations(J[..., free], Q, residuals, weights, observations.view, V)
    eliminated = np.linalg.solve(C, np.concatenate([B.transpose(0, 2, 1), b[..., None]], axis=2))
    information, scores = A - B @ eliminated[..., :P], a - (B @ eliminated[..., P:])[..., 0]
    return BundleAdjustment(rig, poses, free, residuals, weights, information, scores, settled)


Blocks = tuple[Array, Array, Array, Array, Array]


def _normal_equations(J: Array, Q: Array, residuals: Array, weights: Array, view: Indices, V: int) -> Blocks:
    """By view: the rig's block (V, P, P), coupling (V, P, 6), the pose's block (V, 6, 6), gradients (V, P), (V, 6)."""
    D = np.concatenate([J, Q, residuals[..., None]], axis=2)
    P, n = J.shape[2], D.shape[2]
    rows = (D * np.sqrt(weights)[:, None, None]).reshape(-1, n)
    N = np.array([part.T @ part for part in np.split(rows, 2 * np.searchsorted(view, np.arange(1, V)))])
    return N[:, :P, :P], N[:, :P, P:-1], N[:, P:-1, P:-1], N[:, :P, -1], N[:, P:-1, -1]


def _solve(blocks: Blocks, damping: float) -> tuple[Array, Array]:
    """Steps of the rig (P,) and of the poses (V, 6)."""
    A, B, C, a, b = blocks
    P = A.shape[1]
    damped = C + damping * C * np.eye(6)
    eliminated = np.linalg.solve(damped, np.concatenate([B.transpose(0, 2, 1), b[..., None]], axis=2))
    step = np.zeros(P)
    if P:
        total = A.sum(0)
        reduced = total + damping * total * np.eye(P) - (B @ eliminated[..., :P]).sum(0)
        step = np.linalg.lstsq(reduced, a.sum(0) - (B @ eliminated[..., P:])[..., 0].sum(0), rcond=1e-14)[0]
    return step, eliminated[..., P] - eliminated[..., :P] @ step


def _weights(residuals: Array, weighing: Weighting) -> Array:
    length = np.linalg.norm(residuals, axis=1)
    sigma = max(float(np.median(length)) / RAYLEIGH_MEDIAN, MIN_SIGMA_PX)
    if weighing == "huber":
        return np.asarray(np.minimum(1.0, CORNER_HUBER_SIGMA * sigma / np.maximum(length, 1e-12)))
    return np.asarray(1.0 / (1.0 + (length / (CORNER_REDESCENDING_SIGMA * sigma)) ** 2) ** 2)


def _cost(residuals: Array, weights: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float((weights[:, None] * residuals**2).sum())


def rms_by_view(residuals: Array, view: Indices, V: int) -> Array:
    """Root mean square (V,) px of the coordinates of ``residuals`` (M, 2) in every view; NaN where there are none."""
    count = np.bincount(view, minlength=V)
    squares = np.bincount(view, (residuals**2).sum(1), minlength=V)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(squares / (2 * count)))
