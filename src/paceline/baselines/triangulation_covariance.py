"""The covariance of a triangulated point: L. Matthies, S. A. Shafer, "Error modeling in stereo navigation", 1987."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig


def image_jacobian(rig: StereoRig, points: Array) -> Array:
    """∂(x_left, y_left, x_right, y_right)/∂(X, Y, Z), shape (…, 4, 3), px/m, of world ``points`` (…, 3)."""
    left = _projection_jacobian(rig.left.K, points)
    right = _projection_jacobian(rig.right.K, rig.to_right(points)) @ rig.R
    return np.concatenate([left, right], axis=-2)


def triangulation_information(rig: StereoRig, points: Array, sigma: float) -> Array:
    """Inverse covariance (…, 3, 3) of optimally triangulated ``points`` (…, 3), each of the four pixel coordinates of
    which has the standard deviation ``sigma``."""
    J = image_jacobian(rig, points)
    return np.asarray(np.swapaxes(J, -1, -2) @ J) / sigma**2


def triangulation_covariance(rig: StereoRig, points: Array, sigma: float) -> Array:
    """First-order covariance (…, 3, 3), m², of optimally triangulated points: the inverse of that information."""
    return np.asarray(np.linalg.inv(triangulation_information(rig, points, sigma)))


def _projection_jacobian(K: Array, points: Array) -> Array:
    """∂pixel/∂point (…, 2, 3) for points in the camera's own frame."""
    p = points @ K.T
    w = p[..., 2:3, None]
    return np.asarray((K[:2] - (p[..., :2] / p[..., 2:3])[..., None] * K[2]) / w)
