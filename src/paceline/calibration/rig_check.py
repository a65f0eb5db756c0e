"""Checks the rotation of a calibrated rig by matched scene points, and corrects it.

A point in one view lies on its epipolar line in the other, whatever its distance. Where the right camera has rotated,
points lie off their lines: by a constant after a nod, in proportion to x after a roll. A rotation about the vertical
axis moves points along their lines, as a change of distance does, and is observed only weakly, at the image's corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution
from scipy.stats import multivariate_normal

from paceline.arrays import Array, Mask
from paceline.blas import on_one_blas_thread
from paceline.calibration.scene_matches import SceneMatches
from paceline.calibration.speed_sensitivity import (
    VERDICT_DISTANCE_M,
    SpeedEffect,
    principal_points_as_turns,
    speed_effects,
    stated_uncertainty,
)
from paceline.cameras import RigUncertainty, StereoRig, perturbed_rig
from paceline.geometry import epipolar_distance
from paceline.units import COVERAGE_95
from paceline.verdicts import NO_REASON, Message, message

MIN_SCENE_MATCHES, MIN_TILES = 30, 12
MATCH_REDESCENDING_SIGMA = 3.0  # standard deviations at which a match has a quarter of the weight
MAX_MATCH_SIGMA = 4.0  # standard deviations beyond which a match is an outlier
MAX_ROTATION_STEPS = 30
SIGNIFICANCE_LEVEL = 1e-3  # p-value below which the rig has moved
# Tangential distortion p2 moves points off their lines as a rotation of 2 p2 about the vertical axis does, and no lens
# model determines the difference of the two cameras' p2 better than this.
TANGENTIAL_DISTORTION_STD = 7e-4
# A scene whose smooth residuals remain above this share of all (rms) is not explained by a rotation: it leaves a
# quarter of their squares
MAX_UNEXPLAINED_SHARE = 0.5
# Standard deviation of a common relative change of both cameras' focal lengths, as of videos that are cropped or
# stabilised: these show 5 to 20 % less
COMMON_FOCAL_CHANGE_STD = 0.1
MIN_UNEXPLAINED_PX = 0.3  # below, lenses of real cameras are no models, whatever a calibration states
# Standard deviations of the calibration up to which a correction, or what it does not explain, may be the calibration's
# own error
MAX_SHIFT_SIGMA = 3.0
MIN_ROTATION_LOG_ODDS = 3.0  # 20 to 1: of a rotation against a common change of the focal lengths
MAX_CORRECTED_SPEED_SHARE = 0.2  # half a 95 % interval of a speed at VERDICT_DISTANCE_M, from the calibration alone
PAN_AXIS = 1  # of a rotation vector: y
ROTATION_STEP_RAD = 1e-6  # step of central differences
PARAMETER_STEPS = np.array(
    [0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, ROTATION_STEP_RAD, ROTATION_STEP_RAD, ROTATION_STEP_RAD, 1e-5, 1e-5, 1e-5]
)


@dataclass(frozen=True, eq=False)
class RigCheck:
    """The rotation of a rig since its calibration, estimated from the scene.

    ``rotation`` (3,) rad is the right camera's, about its x, y, z axes; ``scene_covariance`` (3, 3) is that of the
    estimate, ``rig_covariance`` (3, 3) the part that the calibration's own uncertainty explains. ``p_value`` is the
    probability of so large a rotation in a rig that has not moved. ``residual_px`` is the standard deviation of the
    matches from their epipolar lines after the rotation is corrected, ``rotation_error_px`` the root mean square that
    the rotation causes. ``response`` (3, 14) is ∂rotation/∂(parameters of the rig). ``states_uncertainty``: whether
    rig.yaml states the calibration's uncertainty, or that there is none. ``points`` are the matches without outliers,
    and ``keystone`` (3,) rad is the rotation for which a tangential distortion of `TANGENTIAL_DISTORTION_STD` is taken.
    ``expected_px`` is the root mean square of their distances from epipolar lines by the calibration's uncertainty.
    """

    matches: int
    outliers: int
    tiles: int
    rotation: Array
    scene_covariance: Array
    rig_covariance: Array
    response: Array
    p_value: float
    residual_px: float
    rotation_error_px: float
    states_uncertainty: bool
    points: SceneMatches
    keystone: Array
    expected_px: float

    @property
    def moved(self) -> bool:
        return self.p_value < SIGNIFICANCE_LEVEL

    @property
    def std(self) -> Array:
        """Standard uncertainties (3,) rad of the rotation, the calibration's own included."""
        return np.asarray(np.sqrt(np.diag(self.scene_covariance + self.rig_covariance)))


@dataclass(frozen=True, eq=False)
class RotationCorrection:
    """A rig with the corrected rotation.

    ``rotation`` (3,) rad is the correction, ``std`` (3,) its standard uncertainties, ``scene_share`` (3,) the share by
    which the scene has reduced each angle's variance. ``explained_px`` and ``unexplained_px`` are the root mean squares
    of the distances from epipolar lines that it takes away, and of what remains of them that varies smoothly over the
    picture. ``shift_sigma`` is how large it is in standard deviations of the calibration (the Mahalanobis distance).
    ``log_odds`` are those of a knock, which rotates a camera about every axis alike, against a common change of both
    cameras' focal lengths.
    """

    rig: StereoRig
    rotation: Array
    std: Array
    scene_share: Array
    effects: list[SpeedEffect]
    explained_px: float
    unexplained_px: float
    shift_sigma: float
    log_odds: float


def has_enough_matches(matches: SceneMatches) -> bool:
    """Whether the matches are enough, in number and spread, to check a rig."""
    return len(matches) >= MIN_SCENE_MATCHES and len(np.unique(matches.tile)) >= MIN_TILES


@on_one_blas_thread
def check_rig(rig: StereoRig, matches: SceneMatches) -> RigCheck:
    """Estimates the rotation of the right camera by robust least squares of the distances from epipolar lines."""
    rotation, keep, residual_px = _fit_rotation(rig, matches)
    inliers = matches.select(keep)
    rotated = rotated_rig(rig, rotation)
    J = _rotation_jacobian(rotated, inliers)
    residuals = epipolar_distance(rotated, inliers.left, inliers.right)
    scene = clustered_covariance(J, residuals, inliers.tile)
    keystone = np.linalg.pinv(J) @ _tangential_change(rotated, inliers)
    scene += np.outer(keystone, keystone)
    by_parameters = _parameter_jacobian(rotated, inliers)
    response = np.linalg.pinv(J) @ by_parameters  # the rotation that errors of rig.yaml cause
    uncertainty = rig.uncertainty or RigUncertainty()
    root = response @ uncertainty.covariance_root.T
    of_rig = root @ root.T
    tiles = len(np.unique(inliers.tile))
    distance = float(rotation @ np.linalg.solve(scene + of_rig, rotation))
    p_value = float(f_distribution.sf(distance / 3 * (tiles - 3) / (tiles - 1), 3, tiles - 3))  # Hotelling's T²
    return RigCheck(
        matches=len(inliers),
        outliers=len(matches) - len(inliers),
        tiles=tiles,
        rotation=rotation,
        scene_covariance=scene,
        rig_covariance=of_rig,
        response=response,
        p_value=p_value,
        residual_px=residual_px,
        rotation_error_px=float(np.sqrt(((J @ rotation) ** 2).mean())),
        states_uncertainty=not uncertainty.is_assumed,
        points=inliers,
        keystone=keystone,
        expected_px=float(np.sqrt(((by_parameters @ uncertainty.covariance_root.T) ** 2).sum(axis=1).mean())),
    )


@on_one_blas_thread
def correct_rotation(rig: StereoRig, check: RigCheck) -> RotationCorrection:
    """``rig`` with its rotation corrected by the scene, and the uncertainty that it then has.

    The prior is the rig's calibration. Where the rig has moved, the prior of the rotation is widened: a knock rotates a
    camera about every axis alike, so the rotation about the well observed axes (x, z) estimates the possible one about
    y. Only the rotation is corrected; the uncertainty of the other parameters is kept (consider filter: S. F. Schmidt,
    1966). Principal points that are off count as rotations: a rotation that makes up for them is no error. A keystone
    that would take a larger pan than prior and scene allow is put down to the lenses.
    """
    U = (rig.uncertainty or RigUncertainty()).covariance_root @ principal_points_as_turns(rig).T
    prior = U.T @ U
    chance = check.scene_covariance + check.rig_covariance
    knock = check.rotation**2 - (np.diag(chance) if check.moved else 0.0)
    knock_variance = max(float(knock[[0, 2]].max()), ROTATION_STEP_RAD**2)
    calibrated = prior[8:11, 8:11] + ROTATION_STEP_RAD**2 * np.eye(3)
    if check.moved or rig.uncertainty is None:
        prior[8:11, 8:11] += knock_variance * np.eye(3)
    G = check.response
    S = G @ prior @ G.T + check.scene_covariance
    excess_pan = max(float(check.rotation[PAN_AXIS] ** 2 - S[PAN_AXIS, PAN_AXIS]), 0.0)
    excess = excess_pan / max(float(check.keystone[PAN_AXIS] ** 2), 1e-300)
    scene = check.scene_covariance + excess * np.outer(check.keystone, check.keystone)
    S += scene - check.scene_covariance
    gain = np.zeros((14, 3))
    gain[8:11] = (prior @ G.T @ np.linalg.inv(S))[8:11]
    keep = np.eye(14) - gain @ G
    posterior = keep @ prior @ keep.T + gain @ scene @ gain.T
    correction = gain[8:11] @ check.rotation
    before, after = np.diag(prior)[8:11], np.diag(posterior)[8:11]
    corrected = rotated_rig(rig, correction)
    stated = stated_uncertainty(corrected, posterior)
    corrected = StereoRig(corrected.left, corrected.right, corrected.R, corrected.t, stated, check.matches)
    share = 1 - after / np.maximum(before, 1e-300)
    by_focal_lengths = COMMON_FOCAL_CHANGE_STD * G @ _common_focal_change(rig)
    shift_sigma = float(np.sqrt(correction @ np.linalg.solve(calibrated, correction)))
    log_densities = [
        float(multivariate_normal.logpdf(check.rotation, cov=chance + change))
        for change in (knock_variance * np.eye(3), np.outer(by_focal_lengths, by_focal_lengths))
    ]
    return RotationCorrection(
        rig=corrected,
        rotation=correction,
        std=np.sqrt(after),
        scene_share=np.clip(share, 0.0, 1.0),
        effects=speed_effects(corrected),
        explained_px=float(np.sqrt(((_rotation_jacobian(rig, check.points) @ correction) ** 2).mean())),
        unexplained_px=smooth_residual(corrected, check.points),
        shift_sigma=0.0 if rig.uncertainty is None else shift_sigma,  # an exact one is judged by `RigCheck.moved`
        log_odds=log_densities[0] - log_densities[1],
    )


def correction_refusal(check: RigCheck, correction: RotationCorrection) -> Message:
    """Why the ``correction`` may not be used; empty where it may.

    Epipolar lines show neither a common change of all focal lengths nor a rotation about the vertical axis, and speeds
    depend on both: what is put down to a rotation must be one, and leave speeds that can be used.
    """
    explained, unexplained = correction.explained_px, correction.unexplained_px
    is_error = check.moved or unexplained > max(MAX_SHIFT_SIGMA * check.expected_px, MIN_UNEXPLAINED_PX)
    if is_error and unexplained > MAX_UNEXPLAINED_SHARE * np.hypot(explained, unexplained):
        return message(
            "rotation_unexplained",
            unexplained_px=unexplained,
            explained_px=explained,
            max_share=MAX_UNEXPLAINED_SHARE,
        )
    is_knock = check.moved or correction.shift_sigma > MAX_SHIFT_SIGMA
    if is_knock and correction.log_odds < MIN_ROTATION_LOG_ODDS:
        return message("rotation_ambiguous", odds=np.exp(correction.log_odds), min_odds=np.exp(MIN_ROTATION_LOG_ODDS))
    share = COVERAGE_95 * next(e.along for e in correction.effects if e.distance == VERDICT_DISTANCE_M)
    if share > MAX_CORRECTED_SPEED_SHARE:
        return message(
            "rotation_uncertain", share=share, distance_m=VERDICT_DISTANCE_M, max_share=MAX_CORRECTED_SPEED_SHARE
        )
    return NO_REASON


def smooth_residual(rig: StereoRig, points: SceneMatches) -> float:
    """Root mean square, px, of that part of the distances from epipolar lines which varies smoothly over the picture, a
    polynomial of second degree, beyond what chance makes of it."""
    residuals = epipolar_distance(rig, points.left, points.right)
    width, height = rig.right.image_size
    x, y = (2.0 * points.right / [width, height] - 1.0).T
    basis = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    fit, *_ = np.linalg.lstsq(basis, residuals, rcond=None)
    covariance = clustered_covariance(basis, residuals - basis @ fit, points.tile)
    chance = float(np.einsum("ni,ij,nj->", basis, covariance, basis)) / len(basis)
    return float(np.sqrt(max(float(((basis @ fit) ** 2).mean()) - chance, 0.0)))


def _common_focal_change(rig: StereoRig) -> Array:
    """The change (14,) of the rig's parameters where all focal lengths are larger by their whole length."""
    (a, b), (c, d) = (camera.K[[0, 1], [0, 1]] for camera in rig.cameras)
    return np.array([a, b, 0.0, 0.0, c, d, *np.zeros(8)])


def rotated_rig(rig: StereoRig, rotation: Array) -> StereoRig:
    """``rig`` with its right camera rotated about its own axes by ``rotation`` (3,) rad, in place."""
    R = np.asarray(cv2.Rodrigues(rotation)[0])
    return StereoRig(rig.left, rig.right, R @ rig.R, R @ rig.t, rig.uncertainty)


def _fit_rotation(rig: StereoRig, matches: SceneMatches) -> tuple[Array, Mask, float]:
    """The rotation (3,), the inliers among the matches, and their standard deviation from their lines, px."""
    rotation = np.zeros(3)
    e = epipolar_distance(rig, matches.left, matches.right)
    scale = 1.4826 * float(np.median(np.abs(e - np.median(e))))  # about the median, as a nod shifts all points alike
    for _ in range(MAX_ROTATION_STEPS):
        rotated = rotated_rig(rig, rotation)
        e = epipolar_distance(rotated, matches.left, matches.right)
        J = _rotation_jacobian(rotated, matches)
        w = 1.0 / (1.0 + (e / (MATCH_REDESCENDING_SIGMA * scale)) ** 2) ** 2
        step = -np.linalg.solve((J * w[:, None]).T @ J, (J * w[:, None]).T @ e)
        rotation = rotation + step
        scale = 1.4826 * float(np.median(np.abs(e + J @ step)))
        if np.abs(step).max() < 1e-9:
            break
    keep = np.abs(epipolar_distance(rotated_rig(rig, rotation), matches.left, matches.right)) < MAX_MATCH_SIGMA * scale
    inliers = matches.select(keep)
    for _ in range(3):  # unweighted steps, so that the least-squares covariance holds
        rotated = rotated_rig(rig, rotation)
        J = _rotation_jacobian(rotated, inliers)
        rotation = rotation - np.linalg.lstsq(J, epipolar_distance(rotated, inliers.left, inliers.right), rcond=None)[0]
    return rotation, keep, float(np.std(epipolar_distance(rotated_rig(rig, rotation), inliers.left, inliers.right)))


def clustered_covariance(J: Array, residuals: Array, cluster: NDArray[np.int64]) -> Array:
    """Cluster-robust covariance (P, P) of the least-squares solution with the design ``J`` (N, P).

    ``residuals`` (N,) may be correlated within each ``cluster`` (N,): the sandwich estimator with the usual correction
    for few clusters.
    """
    _, numbers = np.unique(cluster, return_inverse=True)
    scores = np.zeros((numbers.max() + 1, J.shape[1]))
    np.add.at(scores, numbers, J * residuals[:, None])
    n, (N, P) = len(scores), J.shape
    bread = np.linalg.inv(J.T @ J)
    return np.asarray(bread @ (scores.T @ scores) @ bread * n / (n - 1) * (N - 1) / (N - P))


def _tangential_change(rig: StereoRig, matches: SceneMatches) -> Array:
    """Change (N,) px of the epipolar distance by a tangential distortion p2 of ``TANGENTIAL_DISTORTION_STD``."""
    K = rig.right.K
    x, y = rig.right.rays(matches.right)[:, :2].T
    shift = TANGENTIAL_DISTORTION_STD * np.stack([K[0, 0] * (3 * x * x + y * y), K[1, 1] * 2 * x * y], axis=-1)
    before = epipolar_distance(rig, matches.left, matches.right)
    return np.asarray(epipolar_distance(rig, matches.left, matches.right + shift) - before)


def _rotation_jacobian(rig: StereoRig, matches: SceneMatches) -> Array:
    """∂(epipolar distance)/∂rotation (N, 3), px/rad."""
    return _parameter_jacobian(rig, matches)[:, 8:11]


def _parameter_jacobian(rig: StereoRig, matches: SceneMatches) -> Array:
    """∂(epipolar distance)/∂(the rig's 14 parameters) (N, 14), by central differences."""
    ends = []
    for sign in (1, -1):
        moves = sign * np.diag(PARAMETER_STEPS)
        ends.append([epipolar_distance(perturbed_rig(rig, m), matches.left, matches.right) for m in moves])
    return np.asarray(((np.array(ends[0]) - np.array(ends[1])) / (2 * PARAMETER_STEPS[:, None])).T)
