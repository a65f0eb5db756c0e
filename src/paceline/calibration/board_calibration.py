"""Stereo calibration from board corners.

Initial rig, removal of outlier views and corners, choice of the lens model by cross-validation, bundle adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from paceline.arrays import Array, Indices
from paceline.blas import on_one_blas_thread
from paceline.calibration.board_views import BoardViews, observations
from paceline.calibration.bundle_adjustment import BundleAdjustment, adjust, rms_by_view
from paceline.calibration.initialization import initial_rig
from paceline.calibration.outlier_views import NO_PARAMETERS, renumbered, select_consistent_views
from paceline.calibration.parameters import (
    LENS_MODELS,
    LENS_PARAMETERS,
    RIG_PARAMETER_NAMES,
    Observations,
    Poses,
    RigState,
    free_parameters,
    parameter_step,
)
from paceline.calibration.speed_sensitivity import SpeedEffect, pinhole_covariance, speed_effects, stated_uncertainty
from paceline.cameras import StereoRig
from paceline.documents import plausibility
from paceline.errors import UnusableInput
from paceline.verdicts import message

MIN_BOARD_VIEWS, RECOMMENDED_VIEWS = 5, 12
CROSS_VALIDATION_FOLDS = 5
MAX_CORNER_SIGMA = 5.0  # standard deviations beyond which a corner is an outlier
MIN_MODEL_WEIGHT = 1e-3  # least weight of a lens model in the average
MAX_FOCAL_UNCERTAINTY = 0.05  # relative uncertainty above which speeds cannot be measured
MIN_TILT_DEG, MIN_TILTED_VIEWS = 15.0, 4
COVERAGE_CELLS = (4, 3)  # across and down the image; each should hold corners
CELL_NAMES = (("left", "middle left", "middle right", "right"), ("top", "middle", "bottom"))


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated rig and its quality figures.

    ``rig`` states its uncertainty. ``covariance`` (24, 24) is that of all parameters in the order of
    :data:`~paceline.calibration.parameters.RIG_PARAMETER_NAMES`, about and along the right camera's axes.
    ``cross_validation_px`` is the rms residual, for each lens model, of views that were held out of the fit. ``used``
    (V,) are the views of the fit; ``rejected`` holds the reason for each of the others. ``advice`` lists which views to
    add for a better calibration.
    """

    views: BoardViews
    rig: StereoRig
    fit: BundleAdjustment
    seen: Observations
    distortion: str
    cross_validation_px: dict[str, float]
    covariance: Array
    used: list[int]
    rejected: dict[int, str]
    outlier_corners: int
    effects: list[SpeedEffect]
    advice: list[str]

    @property
    def names(self) -> list[str]:
        """The parameters that were estimated."""
        return [RIG_PARAMETER_NAMES[k] for k in self.fit.free]

    @property
    def std(self) -> Array:
        """Standard uncertainties (24,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def coverage_factor(self) -> float:
        """Coverage factor: standard uncertainties in half a 95 % interval (Student's t)."""
        return float(stdtrit(max(len(self.used) - 1, 1), 0.975))

    @property
    def view_rms_px(self) -> Array:
        """Root mean square residual of each used view and side (len(used), 2), px."""
        V = len(self.used)
        sides = [self.seen.side == side for side in (0, 1)]
        return np.stack([rms_by_view(self.fit.residuals[s], self.seen.view[s], V) for s in sides], axis=1)


@on_one_blas_thread
def calibrate(views: BoardViews) -> Calibration:
    """Calibrates the rig that recorded ``views``.

    Raises UnusableInput where the views do not determine it, stating which to add.
    """
    both = [v for v in views.views if len(v.left) and len(v.right)]
    if len(both) < MIN_BOARD_VIEWS:
        raise UnusableInput(
            f"{len(both)} of {len(views.views) + len(views.empty)} pairs show the board to both cameras; expected at "
            f"least {MIN_BOARD_VIEWS}, better {RECOMMENDED_VIEWS} to 30, the board tilted in various ways"
        )
    all_corners = observations(views.board, views.views)
    V = len(views.views)
    rig, poses, agree, reasons = select_consistent_views(*initial_rig(views.sizes, all_corners, V), all_corners)
    used = np.flatnonzero(agree)
    pairs = sum(len(views.views[v].left) > 0 and len(views.views[v].right) > 0 for v in used)
    if pairs < MIN_BOARD_VIEWS:
        raise UnusableInput(f"only {pairs} pairs agree with each other; expected at least {MIN_BOARD_VIEWS}")
    inlier_corners, outlier_corners = _without_outliers(rig, poses.select(used), renumbered(all_corners, agree))
    try:
        models = fit_lens_models(rig, poses.select(used), inlier_corners)
        distortion = min(models, key=lambda name: models[name].cross_validation_px)
        final, covariance = models[distortion].fit, model_averaged_covariance(models, distortion)
    except np.linalg.LinAlgError:
        raise UnusableInput(UNDETERMINED_MESSAGE) from None
    _check_focal_length(final, covariance)
    stereo = final.rig.stereo(views.sizes)
    for complaint in (plausibility.check_baseline(stereo), *map(plausibility.check_intrinsics, stereo.cameras)):
        if complaint:
            raise UnusableInput(f"the views give a rig that cannot be: {complaint}")
    pinhole = pinhole_covariance(final.rig, covariance, views.sizes)
    stereo = StereoRig(stereo.left, stereo.right, stereo.R, stereo.t, stated_uncertainty(stereo, pinhole))
    return Calibration(
        views=views,
        rig=stereo,
        fit=final,
        seen=inlier_corners,
        distortion=distortion,
        cross_validation_px={name: model.cross_validation_px for name, model in models.items()},
        covariance=covariance,
        used=used.tolist(),
        rejected={v: text for v, text in enumerate(reasons) if text},
        outlier_corners=outlier_corners,
        effects=speed_effects(stereo),
        advice=_advice(final, inlier_corners, views.sizes),
    )


@dataclass(frozen=True, eq=False)
class LensModel:
    """A fitted lens model; ``squared_errors`` (V,) px² sums the coordinates of each view, held out of the fit, and
    ``cross_validation_px`` is their rms."""

    fit: BundleAdjustment
    cross_validation_px: float
    squared_errors: Array


def fit_lens_models(rig: RigState, poses: Poses, observations: Observations) -> dict[str, LensModel]:
    """Every lens model, fitted to all views, and cross-validated: of held-out views only the poses are fitted."""
    V = len(poses.t)
    fold = np.arange(V) % min(CROSS_VALIDATION_FOLDS, V)
    models = {}
    for name in LENS_MODELS:
        free = free_parameters(name)
        fit_to_all = adjust(_with_lens_parameters(rig, free), poses, observations, free)
        squares, count = np.zeros(V), 0
        for k in range(fold.max() + 1):
            train, test = fold != k, fold == k
            fitted = adjust(
                fit_to_all.rig, fit_to_all.poses.select(np.flatnonzero(train)), renumbered(observations, train), free
            )
            of_test = renumbered(observations, test)
            posed = adjust(fitted.rig, fit_to_all.poses.select(np.flatnonzero(test)), of_test, NO_PARAMETERS)
            weighted_squares = posed.weights * (posed.residuals**2).sum(1)
            squares[test] = np.bincount(of_test.view, weighted_squares, minlength=int(test.sum()))
            count += 2 * len(of_test.view) - 6 * int(test.sum())
        models[name] = LensModel(fit_to_all, float(np.sqrt(squares.sum() / max(count, 1))), squares)
        rig, poses = fit_to_all.rig, fit_to_all.poses  # the start for the next richer model
    return models


def model_averaged_covariance(models: dict[str, LensModel], chosen: str) -> Array:
    """Covariance (24, 24) about the ``chosen`` model's parameters, averaged over the lens models.

    Each model is weighted by its likelihood on the held-out views, after allowing for one standard error of the
    comparison (from the scatter between views); differences of the parameters add their squares.
    """
    best = models[chosen]
    C, total = np.zeros((len(RIG_PARAMETER_NAMES), len(RIG_PARAMETER_NAMES))), 0.0
    for model in models.values():
        excess = (model.squared_errors - best.squared_errors) / best.cross_validation_px**2
        standard_error = np.sqrt(len(excess)) * excess.std(ddof=1)
        weight = float(np.exp(-max(excess.sum() - standard_error, 0.0) / 2))
        if weight > MIN_MODEL_WEIGHT:
            d = parameter_step(model.fit.rig, best.fit.rig)
            C += weight * (model.fit.covariance + np.outer(d, d))
            total += weight
    return C / total


def _with_lens_parameters(rig: RigState, free: Indices) -> RigState:
    """``rig`` with all distortion coefficients that are not ``free`` set to zero."""
    lenses = rig.lenses.copy()
    for side in (0, 1):
        for k in range(4, len(LENS_PARAMETERS)):
            if side * len(LENS_PARAMETERS) + k not in free:
                lenses[side, k] = 0.0
    return RigState(lenses, rig.R, rig.t)


def _without_outliers(rig: RigState, poses: Poses, observations: Observations) -> tuple[Observations, int]:
    """``observations`` without outlier corners, and the number removed."""
    adjusted = adjust(rig, poses, observations, free_parameters("k1, k2, p1, p2"))
    length = np.linalg.norm(adjusted.residuals, axis=1)
    view_rms = rms_by_view(adjusted.residuals * np.sqrt(adjusted.weights)[:, None], observations.view, len(poses.t))
    keep = length <= MAX_CORNER_SIGMA * np.maximum(view_rms[observations.view], np.median(view_rms)) * np.sqrt(2)
    return observations.select(keep), int((~keep).sum())


UNDETERMINED_MESSAGE = (
    "the views do not determine the cameras: add views in which the board is tilted by 20 to 45 degrees, to all four "
    "sides, and some near the image's corners"
)


def _check_focal_length(final: BundleAdjustment, covariance: Array) -> None:
    focal = final.rig.lenses[:, :2].ravel()
    std = np.sqrt(np.diag(covariance))[[0, 1, len(LENS_PARAMETERS), len(LENS_PARAMETERS) + 1]]
    max_share = float(np.max(std / np.abs(focal)))
    if not max_share < MAX_FOCAL_UNCERTAINTY:
        raise UnusableInput(f"{UNDETERMINED_MESSAGE} (a focal length is known to ± {100 * max_share:.0f} % only)")


def _advice(
    final: BundleAdjustment, observations: Observations, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> list[str]:
    """Messages on missing views: their number, tilt and coverage of the images."""
    messages: list[str] = []
    V = len(final.poses.t)
    if V < RECOMMENDED_VIEWS:
        messages.append(message("few_views", views=V, min_views=RECOMMENDED_VIEWS))
    normal = final.poses.R[:, :, 2]
    towards = final.poses.t / np.linalg.norm(final.poses.t, axis=1, keepdims=True)
    tilt = np.degrees(np.arccos(np.clip(np.abs((normal * towards).sum(1)), 0, 1)))
    if (tilt > MIN_TILT_DEG).sum() < min(MIN_TILTED_VIEWS, V):
        messages.append(message("few_tilted_views", tilted=(tilt > MIN_TILT_DEG).sum(), views=V, tilt=MIN_TILT_DEG))
    for side, name in enumerate(("left", "right")):
        empty = empty_cells(observations.pixels[observations.side == side], sizes[side])
        if empty:
            messages.append(message("image_part_uncovered", view=name, parts=", ".join(empty)))
    if not final.converged:
        messages.append(message("adjustment_unsettled"))
    return messages


def empty_cells(pixels: Array, size: tuple[int, int]) -> list[str]:
    """The names of the parts of an image of that (width, height) that contain none of the ``pixels`` (n, 2)."""
    cells = np.clip((pixels / np.array(size) * COVERAGE_CELLS).astype(int), 0, np.array(COVERAGE_CELLS) - 1)
    hit = {(int(x), int(y)) for x, y in cells}
    return [
        f"{CELL_NAMES[1][y]} {CELL_NAMES[0][x]}"
        for y in range(COVERAGE_CELLS[1])
        for x in range(COVERAGE_CELLS[0])
        if (x, y) not in hit
    ]
