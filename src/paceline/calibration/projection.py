"""Projection of board corners into both images, with its derivatives by the calibration's parameters."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array
from paceline.calibration.parameters import N_LENS, N_RIG, POSE_SLICE, Observations, Poses, RigState


def lens_projection(lenses: Array, points: Array) -> tuple[Array, Array, Array]:
    """Distorted pixels (M, 2) of ``points`` (M, 3) in camera axes through ``lenses`` (M, 9), one for each point, with
    ∂pixel/∂lens (M, 2, 9) and ∂pixel/∂point (M, 2, 3). OpenCV's model with k1, k2, p1, p2, k3."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lenses.T
    X, Y, Z = points.T
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + 3 * r2 * k3)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    zero, one = np.zeros_like(x), np.ones_like(x)
    of_lens = np.array(
        [
            [xd, zero, one, zero, fx * x * r2, fx * x * r2**2, fx * 2 * x * y, fx * (r2 + 2 * x * x), fx * x * r2**3],
            [zero, yd, zero, one, fy * y * r2, fy * y * r2**2, fy * (r2 + 2 * y * y), fy * 2 * x * y, fy * y * r2**3],
        ]
    )
    across = 2 * (x * y * slope + p1 * x + p2 * y)
    xd_x, yd_y = (
        radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )
    u_x, u_y, v_x, v_y = fx * xd_x, fx * across, fy * across, fy * yd_y
    of_point = np.array([[u_x, u_y, -(u_x * x + u_y * y)], [v_x, v_y, -(v_x * x + v_y * y)]]) / Z
    return np.stack([fx * xd + cx, fy * yd + cy], -1), of_lens.transpose(2, 0, 1), of_point.transpose(2, 0, 1)


def project(rig: RigState, poses: Poses, observations: Observations) -> tuple[Array, Array, Array]:
    """Predicted pixels (M, 2) of the corners, with derivatives by the rig (M, 2, 24) and by their own view's pose
    (M, 2, 6)."""
    R, right = poses.R[observations.view], (observations.side == 1)[:, None]
    in_left = np.einsum("mij,mj->mi", R, observations.points) + poses.t[observations.view]
    in_right = in_left @ rig.R.T + rig.t
    pixels, of_lens, of_point = lens_projection(rig.lenses[observations.side], np.where(right, in_right, in_left))

    by_rig = np.zeros((len(pixels), 2, N_RIG))
    left_side, right_side = observations.side == 0, observations.side == 1
    by_rig[left_side, :, :N_LENS] = of_lens[left_side]
    by_rig[right_side, :, N_LENS : 2 * N_LENS] = of_lens[right_side]
    by_rig[right_side, :, POSE_SLICE] = _pose_jacobian(of_point[right_side], in_right[right_side])
    of_left = np.where(right[..., None], of_point @ rig.R, of_point)
    return pixels, by_rig, _pose_jacobian(of_left, in_left)


def _pose_jacobian(of_point: Array, points: Array) -> Array:
    """∂pixel/∂(turn, shift) (M, 2, 6) of ``points`` (M, 3) about and along the axes that they are given in."""
    (X, Y, Z), (a, b, c) = points.T[..., None], np.moveaxis(of_point, -1, 0)
    return np.stack([Y * c - Z * b, Z * a - X * c, X * b - Y * a, a, b, c], axis=-1)  # g · (ω × X) = ω · (X × g)
