"""From corners to a rig: a rough start, bad views left out, the lens model that holds out best, all of it refined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from paceline.arrays import Array, Indices
from paceline.blas import on_one_blas_thread
from paceline.calibration.board_views import Views, observations
from paceline.calibration.bundle_adjustment import Fit, errors_by_view, fit
from paceline.calibration.initialization import first_rig
from paceline.calibration.outlier_views import NOTHING_FREE, numbered, screen
from paceline.calibration.parameters import (
    DISTORTIONS,
    LENS,
    NAMES,
    Observations,
    Poses,
    Rig,
    difference,
    free_parameters,
)
from paceline.calibration.speed_sensitivity import SpeedEffect, pinhole_covariance, speed_effects, stated_uncertainty
from paceline.cameras import StereoRig
from paceline.documents import plausibility
from paceline.errors import UnusableInput
from paceline.verdicts import message

LEAST_VIEWS, ENOUGH_VIEWS = 5, 12
FOLDS = 5
STRAY = 5.0  # standard deviations beyond which a single corner is left out
NEGLIGIBLE = 1e-3  # weight of a lens model that is left out
LOOSE = 0.05  # relative uncertainty of a focal length from which nothing can be measured
TILTED, ENOUGH_TILTED = 15.0, 4  # degrees; views
CELLS = (4, 3)  # of the image, across and down, in which corners are looked for
PLACES = (("left", "middle left", "middle right", "right"), ("top", "middle", "bottom"))


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated rig and what there is to judge it by.

    ``rig`` states its uncertainty. ``covariance`` (24, 24) is that of all parameters in the order of
    :data:`~paceline.calibration.parameters.NAMES`, about and along the right camera's axes. ``held_out`` says for every
    lens model tried how far, in px, corners of views lie off that had no part in the fit. ``used`` (V,) are the views
    the fit is made of; ``rejected`` says of the others what is wrong. ``advice`` is what to add for a better one.
    """

    views: Views
    rig: StereoRig
    fit: Fit
    seen: Observations
    distortion: str
    held_out: dict[str, float]
    covariance: Array
    used: list[int]
    rejected: dict[int, str]
    stray: int
    effects: list[SpeedEffect]
    advice: list[str]

    @property
    def names(self) -> list[str]:
        """The parameters that were estimated."""
        return [NAMES[k] for k in self.fit.free]

    @property
    def std(self) -> Array:
        """Standard uncertainties (24,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def factor(self) -> float:
        """Standard uncertainties in half a 95 % interval."""
        return float(stdtrit(max(len(self.used) - 1, 1), 0.975))

    @property
    def errors(self) -> Array:
        """Root mean square residual of each used view and side (len(used), 2), px."""
        V = len(self.used)
        sides = [self.seen.side == side for side in (0, 1)]
        return np.stack([errors_by_view(self.fit.residuals[s], self.seen.view[s], V) for s in sides], axis=1)


@on_one_blas_thread
def calibrate(views: Views) -> Calibration:
    """The rig that filmed ``views``.

    Raises UnusableInput where the views cannot tell it, saying what to add.
    """
    both = [v for v in views.views if len(v.left) and len(v.right)]
    if len(both) < LEAST_VIEWS:
        raise UnusableInput(
            f"{len(both)} of {len(views.views) + len(views.empty)} pairs show the board to both cameras; expected at "
            f"least {LEAST_VIEWS}, better {ENOUGH_VIEWS} to 30, the board tilted in various ways"
        )
    everything = observations(views.board, views.views)
    V = len(views.views)
    rig, poses, agree, wrong = screen(*first_rig(views.sizes, everything, V), everything)
    used = np.flatnonzero(agree)
    pairs = sum(len(views.views[v].left) > 0 and len(views.views[v].right) > 0 for v in used)
    if pairs < LEAST_VIEWS:
        raise UnusableInput(f"only {pairs} pairs agree with each other; expected at least {LEAST_VIEWS}")
    seen, stray = _without_strays(rig, poses.of(used), numbered(everything, agree))
    try:
        models = lens_models(rig, poses.of(used), seen)
        distortion = min(models, key=lambda name: models[name].held_out)
        final, covariance = models[distortion].fit, mixed_covariance(models, distortion)
    except np.linalg.LinAlgError:
        raise UnusableInput(UNDETERMINED) from None
    _refuse_if_loose(final, covariance)
    stereo = final.rig.stereo(views.sizes)
    for complaint in (plausibility.wrong_baseline(stereo), *map(plausibility.wrong_intrinsics, stereo.cameras)):
        if complaint:
            raise UnusableInput(f"the views give a rig that cannot be: {complaint}")
    pinhole = pinhole_covariance(final.rig, covariance, views.sizes)
    stereo = StereoRig(stereo.left, stereo.right, stereo.R, stereo.t, stated_uncertainty(stereo, pinhole))
    return Calibration(
        views=views,
        rig=stereo,
        fit=final,
        seen=seen,
        distortion=distortion,
        held_out={name: model.held_out for name, model in models.items()},
        covariance=covariance,
        used=used.tolist(),
        rejected={v: text for v, text in enumerate(wrong) if text},
        stray=stray,
        effects=speed_effects(stereo),
        advice=_advice(final, seen, views.sizes),
    )


@dataclass(frozen=True, eq=False)
class LensModel:
    """A lens model fitted; ``squares`` (V,) px² is the sum over the coordinates of each view when it is kept out of the
    fit, and ``held_out`` px their rms."""

    fit: Fit
    held_out: float
    squares: Array


def lens_models(rig: Rig, poses: Poses, seen: Observations) -> dict[str, LensModel]:
    """Every lens model, fitted to all views and judged on views held out, whose poses alone are then fitted."""
    V = len(poses.t)
    fold = np.arange(V) % min(FOLDS, V)
    models = {}
    for name in DISTORTIONS:
        free = free_parameters(name)
        whole = fit(_only(rig, free), poses, seen, free)
        squares, count = np.zeros(V), 0
        for k in range(fold.max() + 1):
            train, test = fold != k, fold == k
            fitted = fit(whole.rig, whole.poses.of(np.flatnonzero(train)), numbered(seen, train), free)
            of_test = numbered(seen, test)
            posed = fit(fitted.rig, whole.poses.of(np.flatnonzero(test)), of_test, NOTHING_FREE)
            each = posed.weights * (posed.residuals**2).sum(1)
            squares[test] = np.bincount(of_test.view, each, minlength=int(test.sum()))
            count += 2 * len(of_test.view) - 6 * int(test.sum())
        models[name] = LensModel(whole, float(np.sqrt(squares.sum() / max(count, 1))), squares)
        rig, poses = whole.rig, whole.poses  # a good start for the next richer model
    return models


def mixed_covariance(models: dict[str, LensModel], chosen: str) -> Array:
    """Covariance (24, 24) about the ``chosen`` model's parameters that holds the doubt between the models.

    Each counts by its likelihood on the views held out, given the benefit of one standard error that the comparison
    has from view to view; one that differs adds the square of the difference.
    """
    best = models[chosen]
    C, total = np.zeros((len(NAMES), len(NAMES))), 0.0
    for model in models.values():
        worse = (model.squares - best.squares) / best.held_out**2
        doubt = np.sqrt(len(worse)) * worse.std(ddof=1)
        weight = float(np.exp(-max(worse.sum() - doubt, 0.0) / 2))
        if weight > NEGLIGIBLE:
            d = difference(model.fit.rig, best.fit.rig)
            C += weight * (model.fit.covariance + np.outer(d, d))
            total += weight
    return C / total


def _only(rig: Rig, free: Indices) -> Rig:
    """``rig`` with nothing in its lenses' distortion that is not ``free``."""
    lenses = rig.lenses.copy()
    for side in (0, 1):
        for k in range(4, len(LENS)):
            if side * len(LENS) + k not in free:
                lenses[side, k] = 0.0
    return Rig(lenses, rig.R, rig.t)


def _without_strays(rig: Rig, poses: Poses, seen: Observations) -> tuple[Observations, int]:
    """``seen`` without single corners far off, and how many those were."""
    found = fit(rig, poses, seen, free_parameters("k1, k2, p1, p2"))
    length = np.linalg.norm(found.residuals, axis=1)
    view = errors_by_view(found.residuals * np.sqrt(found.weights)[:, None], seen.view, len(poses.t))
    keep = length <= STRAY * np.maximum(view[seen.view], np.median(view)) * np.sqrt(2)
    return seen.where(keep), int((~keep).sum())


UNDETERMINED = (
    "the views do not determine the cameras: add views in which the board is tilted by 20 to 45 degrees, to all four "
    "sides, and some near the image's corners"
)


def _refuse_if_loose(final: Fit, covariance: Array) -> None:
    focal = final.rig.lenses[:, :2].ravel()
    std = np.sqrt(np.diag(covariance))[[0, 1, len(LENS), len(LENS) + 1]]
    worst = float(np.max(std / np.abs(focal)))
    if not worst < LOOSE:
        raise UnusableInput(f"{UNDETERMINED} (a focal length is known to ± {100 * worst:.0f} % only)")


def _advice(final: Fit, seen: Observations, sizes: tuple[tuple[int, int], tuple[int, int]]) -> list[str]:
    """What is missing among the views, one plain line each."""
    said: list[str] = []
    V = len(final.poses.t)
    if V < ENOUGH_VIEWS:
        said.append(message("few_views", views=V, min_views=ENOUGH_VIEWS))
    normal = final.poses.R[:, :, 2]
    towards = final.poses.t / np.linalg.norm(final.poses.t, axis=1, keepdims=True)
    tilt = np.degrees(np.arccos(np.clip(np.abs((normal * towards).sum(1)), 0, 1)))
    if (tilt > TILTED).sum() < min(ENOUGH_TILTED, V):
        said.append(message("few_tilted_views", tilted=(tilt > TILTED).sum(), views=V, tilt=TILTED))
    for side, name in enumerate(("left", "right")):
        empty = empty_cells(seen.pixels[seen.side == side], sizes[side])
        if empty:
            said.append(message("image_part_uncovered", view=name, parts=", ".join(empty)))
    if not final.settled:
        said.append(message("adjustment_unsettled"))
    return said


def empty_cells(pixels: Array, size: tuple[int, int]) -> list[str]:
    """Parts of an image of that (width, height) in which none of ``pixels`` (n, 2) lies, in words."""
    cells = np.clip((pixels / np.array(size) * CELLS).astype(int), 0, np.array(CELLS) - 1)
    hit = {(int(x), int(y)) for x, y in cells}
    return [f"{PLACES[1][y]} {PLACES[0][x]}" for y in range(CELLS[1]) for x in range(CELLS[0]) if (x, y) not in hit]
