"""Outlier views: detected by their residuals under a calibration from all other views, and reported with the reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Indices, Mask
from paceline.calibration.bundle_adjustment import RAYLEIGH_MEDIAN, adjust
from paceline.calibration.parameters import Observations, Poses, RigState, free_parameters
from paceline.errors import UnusableInput
from paceline.verdicts import Message, message

MAX_ERROR_DEVIATIONS = 4.0  # scaled median deviations of the log error beyond which a view is an outlier
MIN_ERROR_SPREAD = 0.12  # least scaled median deviation: boards nearer, farther or more oblique differ by that much
MAX_ROUNDS = 8
MAX_JOINT_ERROR_RATIO = 3.0  # ratio of the error with a common rig to that of each camera alone
MIN_ERROR_PX = 0.05  # error below which all errors are treated as equal
SCREENING_LENS_MODEL = "k1, k2"
NO_PARAMETERS: Indices = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class ViewErrors:
    """Standard deviation of a corner's coordinate in each of V views (V,), px, robustly: of the worse side with one
    pose for both cameras, and of each with a pose of its own; NaN where a camera does not see the board."""

    joint: Array
    left: Array
    right: Array


def select_consistent_views(
    rig: RigState, poses: Poses, observations: Observations
) -> tuple[RigState, Poses, Mask, list[str]]:
    """The rig fitted to consistent views, all poses, which views (V,) are consistent, and the reason for each other.

    Raises UnusableInput where no rig fits most of the views.
    """
    V = len(poses.t)
    used, free = np.ones(V, bool), free_parameters(SCREENING_LENS_MODEL)
    for _ in range(MAX_ROUNDS):
        used_observations = renumbered(observations, used)
        for parameters in (free_parameters("none"), free):
            adjusted = adjust(rig, poses.select(np.flatnonzero(used)), used_observations, parameters, "redescending")
            rig = adjusted.rig
        errors, poses = view_errors(rig, poses, observations)
        agree = ~outliers(errors.joint)
        if np.array_equal(agree, used):
            break
        used = agree
    _check_common_rig(errors, used)
    typical_px = float(np.median(errors.joint[used]))
    return rig, poses, used, ["" if used[v] else explain_outlier(errors, v, typical_px) for v in range(V)]


def view_errors(rig: RigState, poses: Poses, observations: Observations) -> tuple[ViewErrors, Poses]:
    """The errors of each view with ``rig``, and the poses that fit best."""
    V = len(poses.t)
    joint = adjust(rig, poses, observations, NO_PARAMETERS, "redescending")
    joint_errors = [
        robust_errors_px(joint.residuals[observations.side == s], observations.view[observations.side == s], V)
        for s in (0, 1)
    ]
    separate = []
    for side in (0, 1):
        of_side = observations.select(observations.side == side)
        has_corners = np.isin(np.arange(V), of_side.view)
        f = adjust(
            rig,
            joint.poses.select(np.flatnonzero(has_corners)),
            renumbered(of_side, has_corners),
            NO_PARAMETERS,
            "redescending",
        )
        error = np.full(V, np.nan)
        error[has_corners] = robust_errors_px(
            f.residuals, renumbered(of_side, has_corners).view, int(has_corners.sum())
        )
        separate.append(error)
    return ViewErrors(np.fmax(*joint_errors), separate[0], separate[1]), joint.poses


def robust_errors_px(residuals: Array, view: Indices, V: int) -> Array:
    """Standard deviation (V,) of a coordinate in each view from the median length of ``residuals`` (M, 2); NaN in views
    without any."""
    length = np.linalg.norm(residuals, axis=1)
    lengths_by_view = [length[view == v] for v in range(V)]
    return np.array([np.median(m) / RAYLEIGH_MEDIAN if len(m) else np.nan for m in lengths_by_view])


def outliers(errors: Array) -> Mask:
    """Which ``errors`` (V,) are too large to be of the same kind as most: by the median and the median deviation of
    their logarithms, as noise scales rather than adds."""
    scale = np.log(np.maximum(np.nan_to_num(errors, nan=np.inf), MIN_ERROR_PX))
    finite = scale[np.isfinite(scale)]
    middle = np.median(finite)
    spread = max(1.4826 * float(np.median(np.abs(finite - middle))), MIN_ERROR_SPREAD)
    return np.asarray(scale - middle > MAX_ERROR_DEVIATIONS * spread)


def explain_outlier(errors: ViewErrors, view: int, typical_px: float) -> Message:
    """Why a view is an outlier; ``typical_px`` is the median error, px."""
    left, right = errors.left[view], errors.right[view]
    max_px = np.nanmax([left, right])
    if max_px < 0.5 * errors.joint[view] and np.isfinite([left, right]).all():
        return message("board_moved", error_px=errors.joint[view], usual_px=typical_px)
    side = "left" if np.nan_to_num(left) >= np.nan_to_num(right) else "right"
    return message("corners_scatter", view=side, error_px=max_px, usual_px=typical_px)


def _check_common_rig(errors: ViewErrors, used: Mask) -> None:
    both = used & np.isfinite(errors.left) & np.isfinite(errors.right)
    joint_px = float(np.median(errors.joint[both])) if both.any() else np.nan
    separate_px = (
        max(float(np.median(np.concatenate([errors.left[both], errors.right[both]]))), MIN_ERROR_PX)
        if both.any()
        else 1.0
    )
    if (
        2 * both.sum() < np.isfinite(errors.left * errors.right).sum()
        or not joint_px < MAX_JOINT_ERROR_RATIO * separate_px
    ):
        raise UnusableInput(
            f"left and right: most pairs fit no common rig ({joint_px:.2f} px together, "
            f"{separate_px:.2f} px each alone); expected pictures "
            "of a board that stands still, taken at the same time and paired rightly"
        )


def renumbered(observations: Observations, used: Mask) -> Observations:
    """The corners of the ``used`` views (V,), the views renumbered."""
    remaining = observations.select(used[observations.view])
    return Observations((np.cumsum(used) - 1)[remaining.view], remaining.side, remaining.points, remaining.pixels)
