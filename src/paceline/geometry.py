"""Epipolar distances and triangulation. Pixels are ideal ones (undistorted); leading axes broadcast."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig


def homogeneous(pixels: Array) -> Array:
    """``pixels`` (…, 2) with a third coordinate 1, shape (…, 3)."""
    p = np.asarray(pixels, float)
    return np.concatenate([p, np.ones((*p.shape[:-1], 1))], axis=-1)


def epipolar_distance(rig: StereoRig, left: Array, right: Array) -> Array:
    """Signed distance (…) in pixels of the right pixels (…, 2) from the epipolar lines of the left ones (…, 2)."""
    line = homogeneous(left) @ rig.fundamental.T
    return np.asarray((line * homogeneous(right)).sum(-1) / np.hypot(line[..., 0], line[..., 1]))


def triangulate(rig: StereoRig, left: Array, right: Array) -> Array:
    """World points (…, 3) in metres, seen at ``left`` (…, 2) and ``right`` (…, 2).

    Optimal: both pixels are first moved by the least sum of squares that makes their rays meet. A point behind the
    left camera has a negative z; parallel rays give infinities.
    """
    left, right = correct_matches(rig, left, right)
    a = rig.left.rays(left)
    b = rig.right.rays(right) @ rig.R  # in world axes
    centre = -rig.t @ rig.R
    aa, ab, bb = (a * a).sum(-1), (a * b).sum(-1), (b * b).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (bb * (a @ centre) - ab * (b @ centre)) / (aa * bb - ab * ab)
        return np.asarray(depth[..., None] * a)


def correct_matches(rig: StereoRig, left: Array, right: Array) -> tuple[Array, Array]:
    """The pixels nearest to ``left`` (…, 2) and ``right`` (…, 2) that satisfy the epipolar constraint.

    Lindstrom, "Triangulation made easy", CVPR 2010 (his algorithm ``niter2``).
    """
    F = rig.fundamental
    x, y = homogeneous(right), homogeneous(left)
    E = F[:2, :2]
    n = (y @ F.T)[..., :2]  # normals of the epipolar lines in the right and the left view
    m = (x @ F)[..., :2]
    a = ((n @ E) * m).sum(-1)
    b = 0.5 * ((n * n).sum(-1) + (m * m).sum(-1))
    c = (x * (y @ F.T)).sum(-1)
    d = np.sqrt(np.maximum(b * b - a * c, 0.0))
    step = (c / (b + d))[..., None]
    n, m = n - (step * m) @ E.T, m - (step * n) @ E
    step = step * (2 * d / ((n * n).sum(-1) + (m * m).sum(-1)))[..., None]
    return y[..., :2] - step * m, x[..., :2] - step * n
