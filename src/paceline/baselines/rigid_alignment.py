"""The positions of a rigid body in all frames, from its triangulated points.

The points are fixed in the body, and the body rotates with the direction of its path. The error of a triangulated point
is mostly in its depth and grows with the square of the depth; so each point is weighted by depth⁻⁴, and outliers are
down-weighted. The points are eliminated, which leaves a small system in the positions alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Mask

MAX_ALIGNMENT_ITERATIONS = 20
ALIGNMENT_HUBER_SIGMA = (
    0.9  # standard deviations, for each of three coordinates: the errors of matches are heavy-tailed
)
CONVERGENCE_M = 1e-6
MEDIAN_CHI = 1.538  # median of the chi distribution of three degrees of freedom
MIN_SCATTER_PER_M = 1e-9


@dataclass(frozen=True, eq=False)
class RigidAlignment:
    """``places`` (K, 3) m of the body, the first as given, and the ``covariance`` (3(K−1), 3(K−1)) of the others
    relative to it."""

    places: Array
    covariance: Array


def align(points: Array, observed: Mask, turns: Array, places: Array) -> RigidAlignment:
    """Aligns the ``points`` (P, K, 3) m of a body where they are ``observed`` (P, K), X = place + turn · point.

    ``turns`` (K, 3, 3) are known; ``places`` (K, 3) are where to begin. Raises numpy.linalg.LinAlgError where the
    frames are not joined by common points.
    """
    in_two_frames = observed.sum(1) >= 2
    points, observed = points[in_two_frames], observed[in_two_frames]
    if not observed.any(axis=0).all():
        raise np.linalg.LinAlgError("a frame shares no point with the others")
    K = len(places)
    depths = np.array([np.median(p[s, 2]) for p, s in zip(points.swapaxes(0, 1), observed.T, strict=True)])
    body_axes_points = np.einsum("kji,pkj->pki", turns, points - places[0])  # turned back, as seen from the first place
    relative_rotations = np.einsum("kab,lcb->kalc", turns, turns)
    w, places_estimate = observed.astype(float), places
    for _ in range(MAX_ALIGNMENT_ITERATIONS):
        W = w / depths**4
        total = W.sum(1)
        S = -np.einsum("pk,pl,p->kl", W, W, 1 / total, optimize=True)[:, None, :, None] * relative_rotations
        S[np.arange(K), :, np.arange(K)] += W.sum(0)[:, None, None] * np.eye(3)
        mean = (W[..., None] * body_axes_points).sum(1) / total[:, None]
        pull = np.einsum("pk,kij,pkj->ki", W, turns, body_axes_points - mean[:, None], optimize=True)
        information = S[1:, :, 1:].reshape(3 * (K - 1), 3 * (K - 1))
        before = places_estimate
        places_estimate = places[0] + np.concatenate(
            [np.zeros(3), np.linalg.solve(information, pull[1:].ravel())]
        ).reshape(K, 3)
        back = body_axes_points - np.einsum("kji,kj->ki", turns, places_estimate - places[0])
        body = (W[..., None] * back).sum(1) / total[:, None]
        distance = np.linalg.norm(back - body[:, None], axis=-1) / depths**2
        scatter = max(float(np.median(distance[observed])) / MEDIAN_CHI, MIN_SCATTER_PER_M)
        w = np.where(
            observed, np.minimum(1.0, ALIGNMENT_HUBER_SIGMA * np.sqrt(3) * scatter / np.maximum(distance, 1e-15)), 0.0
        )
        if np.abs(places_estimate - before).max() < CONVERGENCE_M:
            break
    return RigidAlignment(places_estimate, scatter**2 * np.linalg.inv(information))
