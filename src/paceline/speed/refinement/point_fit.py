"""A second estimate of the speed: the chosen motion model fitted to tracked corners instead of to grey values.

Each corner is a point of the rigid vehicle with a place of its own in space: no plane is assumed and no texture shared.
What both estimates have in common — the rig, the times, the prior of the motion — is as the photometric fit has it.
Where they do not contradict each other the result is the mean of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array
from paceline.imaging.robust_weights import tukey_weights
from paceline.speed.refinement import robust_covariance
from paceline.speed.refinement.corner_tracks import CornerTracks, track_corners
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.model_selection import RefinedMotion
from paceline.speed.refinement.photometric_fit import MAX_LAST_STEP_SIGMA
from paceline.speed.refinement.trajectory import PARAMETER_INDEX

MIN_TRACKED_VIEWS = 4  # least views of either camera in which a corner is tracked
MIN_TRACKED_CORNERS = 8
CORNER_PLACE_STD_M = 10.0  # prior standard deviation of a corner's place: it decides only where nothing else does
MEDIAN_ERROR_LENGTH = np.sqrt(2 * np.log(2))  # median length of a plane error of standard deviation 1 along each axis
SCALE_ESTIMATION_STEPS, POINT_FIT_STEPS = 4, 8  # Gauss–Newton steps in which the errors' scale is estimated, and in all
CONVERGED_POINT_STEP_SIGMA = 0.05  # largest step of a motion parameter, in its standard deviations, at the end
# Correlation of the errors of both estimates, from the same pixels: 0.57 on 21 ray-traced straights, 0.62 and 0.70 on
# 24 drawn straights and 15 drawn bends, where a part of it is what all matches share
ESTIMATE_CORRELATION = 0.5
OUTLINE_PARAMETERS = "log_depth", "normal_yaw", "normal_tilt"  # of the plane: corners have places of their own


@dataclass(frozen=True, eq=False)
class SecondEstimate:
    """The motion ``theta`` (n,) by tracked corners, its ``covariance`` (n, n) and its mean ``speed`` (m/s).

    ``difference`` (m/s) is that from the mean speed of the photometric fit; its standard deviation ``difference_std``
    takes both estimates as independent. ``dof`` and ``difference_dof`` are the effective degrees of freedom of the
    variances of both. Covariances are by the scatter over corners, patches and frames, with the rig
    known and without the errors that all matches between the views share, which both estimates have in common.
    """

    theta: Array
    covariance: Array
    speed: float
    difference: float
    difference_std: float
    dof: float
    difference_dof: float

    def combined_with(self, refined: RefinedMotion) -> RefinedMotion:
        """The ``refined`` motion with the mean of both estimates; what it says of the images is the photometric fit's.

        Weights are inverse to the variances of the mean speeds. As few clusters determine these, that of the mean by
        them is added to each, which draws the weights together. The variance of the result is enlarged by the square
        of Birge's ratio (Birge 1932, "The calculation of errors by the method of least squares") where the estimates
        differ by more than their standard deviations.
        """
        gradient, rig = refined.trajectory.mean_speed_gradient, refined.rig_estimate
        photometric = refined.covariance_given_rig
        variances = np.array([gradient @ C @ gradient for C in (photometric, self.covariance)])
        common = ESTIMATE_CORRELATION * np.sqrt(variances.prod())
        weights = 1.0 / (variances + 1.0 / (1.0 / variances).sum())
        weights /= weights.sum()
        birge_squared = max(1.0, self.difference**2 / float(variances.sum() - 2.0 * common))
        parts = weights**2 * variances + weights.prod() * common  # each variance times the derivative by it
        variance = float(parts.sum())
        mixed = weights[0] * photometric + weights[1] * self.covariance
        given_rig = birge_squared * variance / float(weights @ variances) * mixed
        # what is by noise in the rig's estimate, which is the photometric fit's alone, stays
        by_rig = max(1.0 - float(variances[0] / (gradient @ refined.covariance @ gradient)), 0.0)
        return replace(
            refined,
            theta=refined.theta + weights[1] * (self.theta - refined.theta),
            covariance=given_rig + by_rig * refined.covariance,
            rig_estimate=None if rig is None else replace(rig, covariance=given_rig),
            dof=robust_covariance.effective_dof(parts, np.array([refined.dof, self.dof])),
        )


def second_estimate(refined: RefinedMotion, keyframes: Sequence[Keyframe]) -> SecondEstimate | None:
    """The `SecondEstimate` of a ``refined`` motion; None where too few corners are tracked to determine it."""
    trajectory = refined.trajectory
    try:
        tracks = track_corners(keyframes, trajectory.homographies(refined.theta)[0], refined.gamma)
    except np.linalg.LinAlgError:
        return None
    tracked = tracks.information > 0
    usable = np.minimum(tracked[:, ::2].sum(1), tracked[:, 1::2].sum(1)) >= MIN_TRACKED_VIEWS
    if usable.sum() < MIN_TRACKED_CORNERS:
        return None
    chosen = CornerTracks(*(a[usable] for a in (tracks.square, tracks.pixels, tracks.resampling, tracks.information)))
    gradient = trajectory.mean_speed_gradient
    try:
        theta, covariance, dof = PointFit(refined, chosen).solution()
    except np.linalg.LinAlgError:
        return None
    speed, variance = float(gradient @ theta), float(gradient @ covariance @ gradient)
    if not (np.isfinite(theta).all() and np.isfinite(covariance).all() and variance > 0.0):
        return None
    variances = np.array([variance, gradient @ refined.covariance_given_rig @ gradient])
    difference_dof = robust_covariance.effective_dof(variances, np.array([dof, refined.dof]))
    difference, difference_std = speed - float(gradient @ refined.theta), float(np.sqrt(variances.sum()))
    return SecondEstimate(theta, covariance, speed, difference, difference_std, dof, difference_dof)


class PointFit:
    """The motion and N corners' places fitted to where these are tracked, by Gauss–Newton with Tukey's weights."""

    def __init__(self, refined: RefinedMotion, tracks: CornerTracks) -> None:
        self.trajectory, self.tracks = refined.trajectory, tracks
        p = refined.prior
        free = ~np.isin(p.free, [PARAMETER_INDEX[name] for name in OUTLINE_PARAMETERS])
        self._free, self._mean, self._information = p.free[free], p.mean, p.information[np.ix_(free, free)]
        self.theta = refined.theta.copy()
        self._start = self.trajectory.places(self.theta, tracks.square)
        self.places = self._start.copy()
        self._from_view = np.linalg.inv(tracks.resampling)
        self._sigma = 1.0

    def solution(self) -> tuple[Array, Array, float]:
        """The parameters (n,), their covariance (n, n), zero for those that are held fixed, and the effective degrees
        of freedom of the mean speed's variance.

        Raises numpy.linalg.LinAlgError where the corners do not determine the motion, or the fit does not converge.
        """
        P, N = len(self._free), len(self.places)
        prior_matrix = robust_covariance.arrow_matrix(
            self._information, 0.0, np.tile(np.eye(3) / CORNER_PLACE_STD_M**2, (N, 1, 1))
        )
        for count in range(POINT_FIT_STEPS):
            cells_A, cells = self._cells(count < SCALE_ESTIMATION_STEPS)
            A = robust_covariance.assemble(cells_A, P) + prior_matrix
            score = robust_covariance.assemble_scores(cells, P)
            score[:P] += self._information @ (self.theta - self._mean)[self._free]
            score[P:] += (self.places - self._start).ravel() / CORNER_PLACE_STD_M**2
            change = -np.linalg.solve(A, score)
            self.theta[self._free] += change[:P]
            self.places = self.places + change[P:].reshape(N, 3)
            std = np.sqrt(np.diag(np.linalg.inv(A))[:P])
            step = float(np.abs(change[:P] / std).max())
            if count >= SCALE_ESTIMATION_STEPS and step < CONVERGED_POINT_STEP_SIGMA:
                break
        if not step < MAX_LAST_STEP_SIGMA:
            raise np.linalg.LinAlgError("the fit to the corners did not converge")
        gradient = self.trajectory.mean_speed_gradient[self._free]
        covariance = np.zeros((len(self.theta),) * 2)
        of_free = robust_covariance.covariance(A, prior_matrix, cells_A, cells, gradient, is_crossed=True)
        covariance[np.ix_(self._free, self._free)] = of_free.total
        return self.theta, covariance, of_free.dof(gradient, min(self.tracks.pixels.shape[1] // 2, N))

    def _cells(self, estimate_scale: bool) -> tuple[Array, Array]:
        """The cells (V, N, P + 3, P + 3) and (V, N, P + 3) of the normal equations, one for each corner in each view,
        with its place last; the scale of the errors is estimated anew if ``estimate_scale``."""
        P, V = len(self._free), self.tracks.pixels.shape[1]
        steps = self.trajectory.steps[self._free]
        change = np.zeros((P, len(self.theta)))
        change[np.arange(P), self._free] = steps
        thetas = self.theta + np.concatenate([np.zeros((1, len(self.theta))), change, -change])
        projections = self.trajectory.projections(thetas).reshape(len(thetas), V, 3, 4)
        rays = np.einsum("pvij,nj->pnvi", projections[..., :3], self.places) + projections[:, None, :, :, 3]
        rays = np.einsum("nvij,pnvj->pnvi", self._from_view, rays)
        pixels = rays[..., :2] / rays[..., 2:]
        by_motion = np.moveaxis((pixels[1 : P + 1] - pixels[P + 1 :]) / (2 * steps[:, None, None, None]), 0, -1)
        by_place = self._from_view @ projections[0, :, :, :3]
        by_place = (by_place[..., :2, :] - pixels[0, ..., None] * by_place[..., 2:, :]) / rays[0, ..., 2:, None]
        jacobian = np.concatenate([by_motion, by_place], axis=-1)
        residuals = pixels[0] - self.tracks.pixels
        information = self.tracks.information
        size = np.linalg.norm(residuals, axis=-1) * np.sqrt(information)
        if estimate_scale:
            self._sigma = max(float(np.median(size[information > 0])) / float(MEDIAN_ERROR_LENGTH), 1e-6)
        weights = information * tukey_weights(size, self._sigma) / self._sigma**2
        weighted = weights[..., None, None] * jacobian
        cells_A = np.swapaxes(jacobian, -1, -2) @ weighted
        cells = (weighted * residuals[..., None]).sum(-2)
        return np.swapaxes(cells_A, 0, 1), np.swapaxes(cells, 0, 1)
