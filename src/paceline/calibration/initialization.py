"""The initial rig for the bundle adjustment, robust to outlier views."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from paceline.arrays import Array
from paceline.calibration.parameters import LENS_PARAMETERS, N_LENS, Observations, Poses, RigState

FOCAL_LENGTH_SHARES = np.geomspace(0.4, 12.0, 30)  # candidates, of the image's width: fields of view of 103° to 5°
UNSOLVED_ERROR_PX = np.inf


def initial_rig(sizes: Sequence[tuple[int, int]], observations: Observations, views: int) -> tuple[RigState, Poses]:
    """A rig without distortion, and the poses of ``views`` views, each seen by at least one camera.

    The focal length of each camera is the one with the least median error over the views, which is robust while most
    views are right; so is the pose of the right camera.
    """
    lenses = np.zeros((2, N_LENS))
    poses = []
    for side in (0, 1):
        lenses[side], side_poses = _initial_lens(sizes[side], observations.select(observations.side == side), views)
        poses.append(side_poses)
    R, t = _initial_pose(lenses, poses, observations)
    rig = RigState(lenses, R, t)
    left, right = poses
    not_in_left = np.isnan(left.t[:, 0])  # by the left camera: where the right one sees it
    return rig, Poses(
        np.where(not_in_left[:, None, None], R.T @ right.R, left.R),
        np.where(not_in_left[:, None], (right.t - t) @ R, left.t),
    )


def _initial_lens(size: tuple[int, int], observations: Observations, views: int) -> tuple[Array, Poses]:
    """A lens (9,) and the poses of the views with it; NaN for views without corners."""
    best, min_error = None, np.inf
    for share in FOCAL_LENGTH_SHARES:
        lens = np.zeros(len(LENS_PARAMETERS))
        lens[:4] = share * size[0], share * size[0], (size[0] - 1) / 2, (size[1] - 1) / 2
        poses, errors = _poses(lens, observations, views)
        middle = float(np.nanmedian(errors))
        if middle < min_error:
            best, min_error = (lens, poses), middle
    assert best is not None
    return best


def _poses(lens: Array, observations: Observations, views: int) -> tuple[Poses, Array]:
    """Poses of the views and their errors (V,) px, through a lens without distortion."""
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    R, t, errors = np.full((views, 3, 3), np.nan), np.full((views, 3), np.nan), np.full(views, np.nan)
    for v in np.unique(observations.view):
        corners = observations.select(observations.view == v)
        n_solutions, rotations, shifts, error = cv2.solvePnPGeneric(
            corners.points, corners.pixels, K, np.zeros(0), flags=cv2.SOLVEPNP_IPPE
        )
        if n_solutions:
            best = int(np.argmin(error))
            R[v], t[v], errors[v] = (
                cv2.Rodrigues(rotations[best])[0],
                np.ravel(shifts[best]),
                float(np.ravel(error)[best]),
            )
        else:
            errors[v] = UNSOLVED_ERROR_PX
    return Poses(R, t), errors


def _initial_pose(lenses: Array, poses: list[Poses], observations: Observations) -> tuple[Array, Array]:
    """R and t of the right camera: of those of the single views, the one with the least median error over all views."""
    left, right = poses
    both = np.flatnonzero(np.isfinite(left.t[:, 0]) & np.isfinite(right.t[:, 0]))
    fx, fy, cx, cy = lenses[1, :4]
    corners = [observations.select((observations.view == v) & (observations.side == 1)) for v in both]
    best, min_error = None, np.inf
    for v in both:
        R = right.R[v] @ left.R[v].T
        t = right.t[v] - R @ left.t[v]
        errors = []
        for w, view_corners in zip(both, corners, strict=True):
            X = (view_corners.points @ left.R[w].T + left.t[w]) @ R.T + t
            pixels = X[:, :2] / X[:, 2:] * [fx, fy] + [cx, cy]
            errors.append(float(np.median(np.linalg.norm(pixels - view_corners.pixels, axis=1))))
        middle = float(np.median(errors))
        if middle < min_error or best is None:
            best, min_error = (R, t), middle
    assert best is not None
    return best
