"""What epipolar residuals tell: the time between the views, and how the rig differs from its calibration.

Where the right camera exposes later by δ, a moving point is off its epipolar line there by δ times its velocity across
that line; static points are not. Where a camera reads its rows one after another, δ differs from row to row. What
static points and moving ones have in common is the calibration's error, as far as it shows in one picture: the height
and the roll of one view against the other, and the ratio of their focal lengths.

Compare Albl et al. 2017, "On the two-view geometry of unsynchronized cameras", which needs no calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import eval_legendre

from paceline.arrays import Array
from paceline.cameras import Quantity, StereoRig, perturbed_rig
from paceline.geometry import epipolar_distance, homogeneous
from paceline.imaging.feature_matches import Matches
from paceline.imaging.robust_weights import robust_sigma, tukey_weights

MIN_MOVING_MATCHES = 12
MIN_MATCH_RESIDUAL_PX = 0.03  # residuals of refined matches are at least those of interpolation
CORRELATED_MATCHES = 4.0  # neighbouring matches that share their errors …
INDEPENDENT_PER_TILE = 4.0  # … and most that do not in a tile of the picture, where they err by what no model describes
# Standard deviation of an epipolar residual that all matches of moving points share, by what else than the vehicle lies
# in their windows; seen on clips with known offsets
COMMON_MOVING_RESIDUAL_PX = 0.03
# Degrees of freedom of Student's distribution of a calibration's errors about what it states: rigs are knocked and
# lenses turned after they were calibrated, and then all may be off by a multiple of it, what one picture does not show
# included
CALIBRATION_DOF = 4.0
# Standard deviation (px) of each term of the epipolar residuals that a lens's distortion leaves which its calibration
# does not describe, cubic over the picture: ordinary calibrations have residuals of 0.1 to 0.3 px. Those that are not
# linear, as what is linear and larger is the rig's, are Student's, too: boards seldom reach the corners, and a careful
# calibration (KITTI's) is off there by 1.4 px in one of its terms.
DISTORTION_RESIDUAL_PX = 0.15
DISTORTION_DEGREES = [(i, degree - i) for degree in range(4) for i in range(degree + 1)]  # in x and y
LINEAR_TERMS = 3  # of degree 0 and 1, which are the first ones
EVIDENCE_TILES = 8, 6  # across and down the picture; within one, what no model describes is alike
RIG_STEP_SIGMA = 1e-2  # step of finite differences, in prior standard deviations
RESIDUAL_FIT_STEPS = 30
FREE_PRECISION, FREE_STEPS = 1e-2, 5  # of the prior of what explains first, and for how many steps
MIN_STD_S = 1e-6  # of an offset or a readout that is exact
MIN_RATE_STD = 1e-9  # of a rate that is exact, s/s
OFFSET_STEP_S = 0.001  # between offsets that are tried before the fit
OUTLIER_PX = 1.0  # epipolar residual of a match that is wrong


@dataclass(frozen=True, eq=False)
class EpipolarFit:
    """What the residuals of static and moving matches tell.

    ``rig`` is the one that they and its calibration together determine, with the uncertainty that remains.
    ``rig_shift_sigma`` is how far that is from the calibration, in prior standard deviations (the Mahalanobis
    distance), and ``epipolar_px`` the RMS residual of the static points that it explains, None where none was matched.
    ``offset`` (s) is that of the right exposures in the middle of the recording, and ``rate`` (s/s) that by which it
    grows; both are None where fewer than `MIN_MOVING_MATCHES` move.
    """

    rig: StereoRig
    rig_shift_sigma: float
    epipolar_px: Quantity | None
    offset: Quantity | None
    rate: Quantity | None = None


def fit_epipolar_residuals(
    rig: StereoRig,
    static: Matches,
    moving: Matches,
    expected: Quantity,
    readout_difference_std: float,
    rate_std: float = MIN_RATE_STD,
) -> EpipolarFit:
    """A robust fit (Tukey's weights) of the rig, the offset, the rate by which it grows, and the difference between the
    readouts, right minus left.

    The rig has its calibration's uncertainty as its prior, scaled as in Student's distribution where it is off by more;
    what the lenses' distortion leaves is a nuisance beside it, of the same kind. The offset's prior is that which is
    ``expected``; the readouts' difference is 0 with the standard deviation ``readout_difference_std`` (s), and so is
    the rate with ``rate_std`` (s/s). What moves along the epipolar lines shows none of them. As motion in the picture
    is not uniform, the fit is made once more with the left points moved on to the right exposure.
    """
    fit = _fit_offset(rig, static, moving, expected, Quantity(0.0, rate_std, "assumed"), readout_difference_std)
    if fit.offset is None or fit.rate is None:
        return fit
    found, rate = fit.offset.value, fit.rate.value
    further = replace(expected, value=expected.value - found)
    moved = moving.later(found + rate * moving.times)
    fit = _fit_offset(rig, static, moved, further, Quantity(-rate, rate_std, "assumed"), readout_difference_std)
    if fit.offset is None or fit.rate is None:
        return fit
    offset = replace(fit.offset, value=found + fit.offset.value)
    return replace(fit, offset=offset, rate=replace(fit.rate, value=rate + fit.rate.value))


def _fit_offset(
    rig: StereoRig,
    static: Matches,
    moving: Matches,
    expected: Quantity,
    expected_rate: Quantity,
    readout_difference_std: float,
) -> EpipolarFit:
    """As `fit_epipolar_residuals`, of points that move uniformly."""
    left, right = np.concatenate([static.left, moving.left]), np.concatenate([static.right, moving.right])
    root = np.zeros((0, 14)) if rig.uncertainty is None else rig.uncertainty.covariance_root
    residual = epipolar_distance(rig, left, right)
    by_rig = [
        (residual - epipolar_distance(perturbed_rig(rig, RIG_STEP_SIGMA * change), left, right)) / RIG_STEP_SIGMA
        for change in root
    ]
    across = velocity_across(rig, left, right, np.concatenate([static.velocity, moving.velocity]))
    times = np.concatenate([static.times, moving.times])
    residual = residual - (expected.value + expected_rate.value * times) * across  # what remains is by a difference
    offset_std = max(expected.std, MIN_STD_S)
    rows = (right[:, 1] + 0.5) / rig.right.image_size[1] - 0.5
    Q, is_moving = len(root), len(moving.left) >= MIN_MOVING_MATCHES
    by_distortion = DISTORTION_RESIDUAL_PX * _cubic_terms(left, rig.left.image_size) if Q else np.zeros((len(left), 0))
    smooth = Q + by_distortion.shape[1]  # what static points and moving ones have in common
    across_moving = is_moving * across
    X = np.column_stack([*by_rig, by_distortion, across_moving, across_moving * rows, across_moving * times])
    rate_std = max(expected_rate.std, MIN_RATE_STD)
    prior = np.diag([*np.ones(smooth), offset_std**-2.0, readout_difference_std**-2.0, rate_std**-2.0])
    start = np.zeros(smooth + 3)
    if is_moving:
        of_static = float(np.median(residual[: len(static.left)])) if len(static.left) else 0.0
        start[smooth] = _likely_offset(residual[len(static.left) :] - of_static, across[len(static.left) :], offset_std)
    calibrated = [slice(0, Q), *(slice(k, k + 1) for k in range(Q + LINEAR_TERMS, smooth))]
    tiles = _occupied_tiles(left, rig.left.image_size)
    x, covariance, weights = _robust_fit(X, residual, prior, start, calibrated, tiles)
    shift = float(np.linalg.norm(x[:Q]))
    by_static = X[: len(static.left), :smooth]
    explained, spread = by_static @ x[:smooth], ((by_static @ covariance[:smooth, :smooth]) * by_static).sum(1)
    epipolar_px = None
    if len(static.left):
        epipolar_px = Quantity(float(np.sqrt((explained**2).mean())), float(np.sqrt(spread.mean())), "estimated")
    corrected = rig
    if rig.uncertainty is not None:
        remaining = replace(rig.uncertainty, covariance=root.T @ covariance[:Q, :Q] @ root)
        corrected = replace(perturbed_rig(rig, x[:Q] @ root), uncertainty=remaining)
    used = weights[len(static.left) :] > 0
    if used.sum() < MIN_MOVING_MATCHES:
        return EpipolarFit(corrected, shift, epipolar_px, None)
    speed = float(np.sqrt((across[len(static.left) :][used] ** 2).mean()))
    common = COMMON_MOVING_RESIDUAL_PX / max(speed, 1e-9)  # s
    std = float(np.hypot(np.sqrt(covariance[smooth, smooth]), common))
    common_rate = common / max(float(moving.times[used].std()), common / rate_std)
    std_of_rate = float(np.hypot(np.sqrt(covariance[-1, -1]), common_rate))
    return EpipolarFit(
        corrected,
        shift,
        epipolar_px,
        Quantity(expected.value + float(x[smooth]), min(std, offset_std), "estimated"),
        Quantity(expected_rate.value + float(x[-1]), min(std_of_rate, rate_std), "estimated"),
    )


def _cubic_terms(pixels: Array, image_size: tuple[int, int]) -> Array:
    """Products of Legendre polynomials of `DISTORTION_DEGREES` (N, 10) at ``pixels`` (N, 2), over the picture."""
    x, y = (2 * pixels / np.array(image_size) - 1).T
    return np.column_stack([eval_legendre(i, x) * eval_legendre(j, y) for i, j in DISTORTION_DEGREES])


def _occupied_tiles(pixels: Array, image_size: tuple[int, int]) -> int:
    """How many of the `EVIDENCE_TILES` of the picture hold some of the ``pixels`` (N, 2)."""
    tiles = np.floor(pixels / np.array(image_size) * EVIDENCE_TILES).clip(0, np.array(EVIDENCE_TILES) - 1)
    return len(np.unique(tiles, axis=0))


def _likely_offset(residual: Array, across: Array, reach: float) -> float:
    """The offset, at most ``reach`` s either way, that leaves least of the ``residual`` (N,) px of points that move by
    ``across`` (N,) px/s.

    Each point counts by at most `OUTLIER_PX`, so that the least is that of most points: a fit that weights residuals
    would take those of a large offset for outliers.
    """
    offsets = np.arange(-reach, reach + OFFSET_STEP_S / 2, OFFSET_STEP_S)
    misfit = np.minimum(np.abs(residual - offsets[:, None] * across), OUTLIER_PX).mean(1)
    return float(offsets[np.argmin(misfit)])


def _robust_fit(
    X: Array, residual: Array, prior: Array, start: Array, calibrated: list[slice], tiles: int
) -> tuple[Array, Array, Array]:
    """The parameters x (n,) of ``residual`` (N,) px = X x under a ``prior`` information (n, n) about 0, their
    covariance (n, n), and the weights (N,), from a ``start`` (n,).

    The priors of the groups of ``calibrated`` parameters, each of standard deviation 1, are Student's: the first one is
    the rig's, the others are a lens's. So what is far off may be explained by either, and the posterior may have two
    maxima. Both are found, and averaged by their evidence; in that the residuals of one of the ``tiles`` count once.
    """
    rig, *lens = calibrated
    explained_first = ([rig], lens) if lens else ([rig],)
    maxima = [_local_fit(X, residual, prior, start, calibrated, first, tiles) for first in explained_first]
    evidence = np.array([maximum.log_evidence for maximum in maxima])
    share = np.exp(evidence - evidence.max())
    share /= share.sum()
    x = np.asarray(sum(p * maximum.x for p, maximum in zip(share, maxima, strict=True)))
    covariance = np.zeros_like(prior)
    for p, maximum in zip(share, maxima, strict=True):
        covariance += p * (maximum.covariance + np.outer(maximum.x - x, maximum.x - x))
    return x, covariance, maxima[int(np.argmax(share))].weights


@dataclass(frozen=True, eq=False)
class _Maximum:
    """A local maximum of the posterior: the parameters x (n,), their covariance (n, n), the weights (N,) of the
    residuals, and the logarithm of the evidence by Laplace's method, but for a constant."""

    x: Array
    covariance: Array
    weights: Array
    log_evidence: float


def _local_fit(
    X: Array,
    residual: Array,
    prior: Array,
    start: Array,
    calibrated: list[slice],
    first: list[slice],
    tiles: int,
) -> _Maximum:
    """The maximum that is reached where the groups ``first`` explain what they can.

    The scales of Student's distributions are found by expectation maximisation and are at least 1.
    """
    x, information, weights, sigma = start, prior, np.ones(len(X)), MIN_MATCH_RESIDUAL_PX
    correlated = max(CORRELATED_MATCHES, len(X) / (INDEPENDENT_PER_TILE * max(tiles, 1)))
    scaled = prior.copy()
    for group in first:
        scaled[group, group] *= FREE_PRECISION
    for step in range(RESIDUAL_FIT_STEPS if len(X) else 0):
        misfit = np.abs(residual - X @ x)
        sigma = robust_sigma(misfit, MIN_MATCH_RESIDUAL_PX)
        weights = tukey_weights(misfit, sigma)
        of_matches = (X.T * weights) / (correlated * sigma**2)
        information = of_matches @ X + scaled
        x = np.asarray(np.linalg.solve(information, of_matches @ residual), float)
        if step < FREE_STEPS:
            continue
        variances = np.diag(np.linalg.inv(information))
        for group in calibrated:
            count, squares = group.stop - group.start, float(x[group] @ x[group] + variances[group].sum())
            precision = min((CALIBRATION_DOF + count) / (CALIBRATION_DOF + squares), 1.0)
            scaled[group, group] = precision * prior[group, group]
    evidence = _log_evidence(X, x, prior, calibrated, weights, sigma, tiles)
    return _Maximum(x, np.asarray(np.linalg.inv(information)), weights, evidence)


def _log_evidence(
    X: Array, x: Array, prior: Array, calibrated: list[slice], weights: Array, sigma: float, tiles: int
) -> float:
    """The logarithm of the evidence of a maximum ``x`` (n,) by Laplace's method, but for a constant: with the residuals
    of a tile, of standard deviation ``sigma`` px, as one observation, and the curvature of Student's distributions."""
    log_evidence, curvature = -max(tiles, len(x)) * float(np.log(sigma)), prior.copy()
    for group in calibrated:
        count, squares = int(X[:, group].any(axis=0).sum()), float(x[group] @ x[group])
        log_evidence -= 0.5 * (CALIBRATION_DOF + count) * float(np.log1p(squares / CALIBRATION_DOF))
        curvature[group, group] *= (CALIBRATION_DOF + count) / (CALIBRATION_DOF + squares)
    curvature = curvature + (X.T * weights) @ X * (tiles / max(len(X), 1) / sigma**2)
    return log_evidence - 0.5 * float(np.linalg.slogdet(curvature)[1])


def velocity_across(rig: StereoRig, left: Array, right: Array, velocity: Array) -> Array:
    """Velocities (N,) px/s across the epipolar lines in the right view of points at ``left``, ``right`` (N, 2) px.

    ``velocity`` (N, 2) px/s is the left one. A point's xᵣᵀ F xₗ stays 0, so the velocities in both views, across the
    epipolar lines, balance.
    """
    in_right, in_left = homogeneous(left) @ rig.fundamental.T, homogeneous(right) @ rig.fundamental
    return np.asarray(-(in_left[:, :2] * velocity).sum(-1) / np.hypot(in_right[:, 0], in_right[:, 1]))
