"""Refinement: one photometric fit to all keyframes and both views, with Bayesian selection of the motion model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from paceline.arrays import Array
from paceline.speed.configuration import DEFAULTS
from paceline.speed.refinement import robust_covariance
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.photometric_fit import MIN_MODEL_PROBABILITY, PhotometricFit
from paceline.speed.refinement.reference_point import ReferencePoint, mean_width
from paceline.speed.refinement.self_calibration import RigEstimate
from paceline.speed.refinement.trajectory import MOTION_TERMS, Prior, Trajectory, prior

MIN_KEYFRAMES = 5  # least keyframes for model selection


@dataclass(frozen=True, eq=False)
class RefinedMotion:
    """The refined motion: F frames, n parameters, Q directions in which the rig may shift.

    ``trajectory`` has the rig as it was corrected. ``rig_estimate`` is what the images determine of the rig, None where
    it is fixed. ``rig_shift_sigma`` (Q,) are the rig's shifts over the standard deviations that they have if the
    calibration is as uncertain as rig.yaml states.

    Four covariances (n, n) of ``theta`` (n,) add up: ``covariance`` from the scatter of the images,
    ``matching_covariance`` from errors that all matches between the views share, ``model_covariance`` from the choice
    among motion models, ``systematic_covariance`` from what remains unknown of the calibration (NaN where it is exact).

    ``residual_rms`` is the median RMS residual of a patch and ``contrast`` the RMS of the texture, both grey levels,
    which are light to the power 1 / ``gamma``.
    ``offsets`` (F, 2, 2) px are between each view's image and where the motion puts it; ``explained_share`` (F, 2) is
    the share of its weighted variance that the motion explains. Both are NaN where a view was not used.
    """

    trajectory: Trajectory
    rig_shift_sigma: Array
    theta: Array
    covariance: Array
    matching_covariance: Array
    model_covariance: Array
    systematic_covariance: Array
    rig_estimate: RigEstimate | None
    residual_rms: float
    contrast: float
    gamma: float
    offsets: Array
    explained_share: Array
    motion_terms: tuple[str, ...]  # of MOTION_TERMS, chosen by their evidence
    prior: Prior  # of the chosen model
    deviation_sigma: float  # RMS over the modes of the deviation from the path, in prior standard deviations
    dof: float  # effective degrees of freedom of the mean speed's variance by the covariance, …
    matching_dof: float  # … and by the matching_covariance
    converged: bool
    reference: ReferencePoint = ReferencePoint()  # whose speed it is

    def speeds(self) -> tuple[Array, Array]:
        """Speed (F,) at every frame and its standard deviation (F,), systematic part included where known; m/s."""
        g = self.trajectory.speed_jacobian
        variance = np.einsum("fi,ij,fj->f", g, self._total_covariance, g) + self.reference_variances
        return g @ self.theta + self.reference.shift * self._speeds_by_width, np.sqrt(variance)

    def of_outlines(self, right: Array, click_sigma: float) -> RefinedMotion:
        """The same motion, of the middle of the outlines in both views, of which that in the right view is ``right``
        (4, 2) px; their corners have a standard deviation of ``click_sigma`` px each."""
        shift = self.trajectory.middle_of_outlines(self.theta, right)
        return replace(self, reference=self.reference.moved(shift, click_sigma / mean_width(self.trajectory.quad)))

    @property
    def reference_variances(self) -> Array:
        """Variance of the speed (F,) at every frame, m²/s², as the outline does not show where the middle is."""
        return np.asarray((self.reference.std * self._speeds_by_width) ** 2)

    @property
    def _speeds_by_width(self) -> Array:
        """The speed (F,) m/s of a point one width to the right of the region's middle, relative to this."""
        return np.gradient(self._distance_across, self.trajectory.frame_times)

    @cached_property
    def _distance_across(self) -> Array:
        """How much farther (F,) than the region's middle a point one width to its right has come, m."""
        return self.trajectory.distance_across(self.theta)

    @property
    def reference_std(self) -> float:
        """Standard deviation of the mean speed (m/s) as the outline does not show where the vehicle's middle is."""
        return abs(self.reference.std * self._speed_by_width)

    @property
    def _speed_by_width(self) -> float:
        """The mean speed (m/s) of a point one width to the right of the region's middle, relative to this."""
        t = self.trajectory.frame_times
        return float((self._distance_across[-1] - self._distance_across[0]) / (t[-1] - t[0]))

    def accelerations(self) -> tuple[Array, Array]:
        """Accelerations (F − 1, 2) between successive frames along the path and across it, and their standard
        deviations (F − 1, 2), systematic part included where known; m/s²."""
        steps = np.diag(self.trajectory.steps)
        ahead, behind = (self.trajectory.accelerations(self.theta + sign * steps) for sign in (1, -1))
        gradient = (ahead - behind) / (2 * self.trajectory.steps[:, None, None])
        variance = np.einsum("nfa,nm,mfa->fa", gradient, self._total_covariance, gradient)
        return self.trajectory.accelerations(self.theta), np.sqrt(variance)

    @property
    def covariance_given_rig(self) -> Array:
        """Covariance (n, n) of ``theta`` from the scatter of the images, if the rig were known."""
        return self.covariance if self.rig_estimate is None else self.rig_estimate.covariance

    @property
    def _total_covariance(self) -> Array:
        """Covariance (n, n) of ``theta``, systematic part included where known."""
        random = self.covariance + self.matching_covariance + self.model_covariance
        return np.asarray(random + np.nan_to_num(self.systematic_covariance))

    def noise_dof(self, covariance: Array) -> float:
        """Effective degrees of freedom of the mean speed's variance from noise, of which the ``covariance`` (n, n) has
        ``dof``, by all that it and what all matches share have."""
        g = self.trajectory.mean_speed_gradient
        variances = np.array([g @ C @ g for C in (covariance, self.matching_covariance)])
        return robust_covariance.effective_dof(variances, np.array([self.dof, self.matching_dof]))

    def mean_speed(self) -> tuple[float, float, float, float]:
        """The mean speed and its standard deviations from noise, model choice and calibration; m/s."""
        g = self.trajectory.mean_speed_gradient
        covariances = self.covariance + self.matching_covariance, self.model_covariance, self.systematic_covariance
        noise, model, systematic = (float(np.sqrt(g @ C @ g)) for C in covariances)
        speed = float(g @ self.theta) + self.reference.shift * self._speed_by_width
        return speed, noise, float(np.hypot(model, self.reference_std)), systematic


def refine(
    trajectory: Trajectory,
    keyframes: list[Keyframe],
    speed: float,
    on_path: bool,
    min_log_odds: float = DEFAULTS.model.min_log_odds,
) -> RefinedMotion:
    """Fit one motion to all ``keyframes``.

    ``trajectory`` moves the operator's outline along the path; ``speed`` (m/s) is the filter's mean. The model is
    constant speed along the path, or without one straight on unless the images show a curvature; terms for a constant
    acceleration, a lane change and, on a path, a varying acceleration are added where the logarithms of their Bayes
    factors exceed ``min_log_odds`` times the number of terms. Without one of acceleration a speed that drivers hold
    competes with one that is constant. Raises numpy.linalg.LinAlgError where the images determine nothing.
    """
    terms: tuple[str, ...] = () if on_path else ("curvature",)
    fit = PhotometricFit(trajectory, keyframes, prior(trajectory, speed, terms)).with_free_rig()
    straight = prior(trajectory, speed)
    if terms and fit.log_bayes_factor("curvature", straight) < min_log_odds:
        terms, fit = (), PhotometricFit(trajectory, keyframes, straight).with_free_rig()
    excluded = "curvature" if on_path else "varying_acceleration"
    others: list[tuple[float, PhotometricFit]] = []
    log_odds = min_log_odds * (1 + len(terms))
    while len(keyframes) >= MIN_KEYFRAMES:
        added = [t for t in MOTION_TERMS if t != excluded and t not in terms]
        extended = {t: fit.with_term(prior(trajectory, speed, (*terms, t)), t, min_log_odds) for t in added}
        others = list(extended.values())
        supported = [t for t in extended if extended[t][0] >= log_odds]
        if "acceleration" in supported:  # whether it varies is tested in the next round
            supported = [t for t in supported if t != "varying_acceleration"]
        best = max(supported, key=lambda t: extended[t][0], default=None)
        if best is None:
            break
        terms, fit = (*terms, best), extended[best][1]
        log_odds += min_log_odds
    if not {"acceleration", "varying_acceleration"} & {*terms}:
        constant = prior(trajectory, speed, terms, is_constant=True)
        if (odds := -fit.log_bayes_factor("acceleration", constant)) > 0:
            others = [(log_odds - odds, fit), *((evidence - odds, other) for evidence, other in others)]
            fit = fit.under(constant)
    chosen, fit = fit, fit.with_view_dependence()
    offset, theta, variance = fit.average_over_grids()
    reduction = variance / fit.mean_speed_variance
    matching_covariance, matching_dof = fit.matching_error()
    # Bayesian model averaging: a model that was not chosen keeps its posterior probability
    probabilities = np.exp([0.0, *(evidence - log_odds for evidence, _ in others)])
    probabilities /= probabilities.sum()
    covariance, given_rig = probabilities[0] * fit.full_covariance, probabilities[0] * fit.covariance_given_rig
    model_covariance = np.zeros_like(covariance)
    for probability, (_, other) in zip(probabilities[1:], others, strict=True):
        if probability > MIN_MODEL_PROBABILITY:
            difference = other.theta - chosen.theta
            covariance += probability * other.full_covariance
            given_rig += probability * other.covariance_given_rig
            model_covariance += probability * np.outer(difference, difference)
    return RefinedMotion(
        fit.trajectory_with(offset),
        fit.rig_shift_sigma,
        theta,
        reduction * covariance,
        matching_covariance,
        model_covariance,
        fit.systematic_covariance,
        fit.rig_estimate(offset, reduction * given_rig),
        fit.residual_rms,
        fit.contrast,
        fit.gamma,
        *fit.residual_offsets(),
        terms,
        fit.prior,
        fit.deviation_sigma,
        fit.dof,
        matching_dof,
        fit.converged,
        fit.reference_point,
    )
