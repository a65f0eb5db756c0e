"""The positions of a rigid body in all frames, from its triangulated points and its known rotations.

The points are fixed in the body. The rotations are inputs, and the positions are the only unknowns. The error of a
triangulated point is mostly in its depth and grows with the square of the depth. Each observation is therefore weighted
by d⁻⁴, where d is the median depth of the points in its frame, and outliers are down-weighted (Huber). The points in
body axes are eliminated by the Schur complement, which leaves a small linear system in the positions alone.

All positions are in the left camera's axes: x right, y down, z forward, m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Mask

MAX_ALIGNMENT_ITERATIONS = 20
# Huber threshold in standard deviations of one coordinate; it is low because the errors of matches are heavy-tailed
ALIGNMENT_HUBER_SIGMA = 0.9
CONVERGENCE_M = 1e-6  # change of every coordinate of the positions below which the iterations end
MEDIAN_CHI = 1.538  # median of the chi distribution of three degrees of freedom
MIN_SCATTER_PER_M = 1e-9  # least scatter, 1/m, so that exact points have a threshold above zero
MIN_SCALED_RESIDUAL_PER_M = 1e-15  # least divisor of the Huber threshold, 1/m; prevents a division by zero


@dataclass(frozen=True, eq=False)
class RigidAlignment:
    """``positions`` (K, 3) m of the body, the first as given, and the ``covariance`` (3(K−1), 3(K−1)) m² of the others
    relative to it."""

    positions: Array
    covariance: Array


def align(points: Array, observed: Mask, rotations: Array, initial_positions: Array) -> RigidAlignment:
    """Aligns the ``points`` X (P, K, 3) m of a body where they are ``observed`` (P, K).

    X = position + rotation · x, where x is the point in body axes, the same in all frames.
    ``rotations`` (K, 3, 3) from body axes to the camera's are known; ``initial_positions`` (K, 3) m are the initial
    values, of which the first is kept. Raises numpy.linalg.LinAlgError where the frames are not joined by common
    points.
    """
    in_two_frames = observed.sum(1) >= 2
    points, observed = points[in_two_frames], observed[in_two_frames]
    if not observed.any(axis=0).all():
        raise np.linalg.LinAlgError("a frame shares no point with the others")
    K = len(initial_positions)
    origin = initial_positions[0]
    depths = np.array([np.median(p[s, 2]) for p, s in zip(points.swapaxes(0, 1), observed.T, strict=True)])
    rotated_points = np.einsum("kji,pkj->pki", rotations, points - origin)  # in body axes, from the first position
    relative_rotations = np.einsum("kab,lcb->kalc", rotations, rotations)
    robust_weights, positions = observed.astype(float), initial_positions
    for _ in range(MAX_ALIGNMENT_ITERATIONS):
        weights = robust_weights / depths**4  # (P, K)
        point_weights = weights.sum(1)
        normal_matrix = (  # (K, 3, K, 3), the Schur complement of the points
            -np.einsum("pk,pl,p->kl", weights, weights, 1 / point_weights, optimize=True)[:, None, :, None]
            * relative_rotations
        )
        normal_matrix[np.arange(K), :, np.arange(K)] += weights.sum(0)[:, None, None] * np.eye(3)
        mean = (weights[..., None] * rotated_points).sum(1) / point_weights[:, None]
        right_hand_side = np.einsum("pk,kij,pkj->ki", weights, rotations, rotated_points - mean[:, None], optimize=True)
        information = normal_matrix[1:, :, 1:].reshape(3 * (K - 1), 3 * (K - 1))
        previous_positions = positions
        positions = origin + np.concatenate(
            [np.zeros(3), np.linalg.solve(information, right_hand_side[1:].ravel())]
        ).reshape(K, 3)
        body_points = rotated_points - np.einsum("kji,kj->ki", rotations, positions - origin)  # (P, K, 3), body axes
        mean_body_points = (weights[..., None] * body_points).sum(1) / point_weights[:, None]
        scaled_residuals = np.linalg.norm(body_points - mean_body_points[:, None], axis=-1) / depths**2
        scatter = max(float(np.median(scaled_residuals[observed])) / MEDIAN_CHI, MIN_SCATTER_PER_M)
        # √3: the threshold is one coordinate's, and the norm of three has √3 times its RMS
        threshold = ALIGNMENT_HUBER_SIGMA * np.sqrt(3) * scatter
        robust_weights = np.where(
            observed, np.minimum(1.0, threshold / np.maximum(scaled_residuals, MIN_SCALED_RESIDUAL_PER_M)), 0.0
        )
        if np.abs(positions - previous_positions).max() < CONVERGENCE_M:
            break
    return RigidAlignment(positions, scatter**2 * np.linalg.inv(information))
