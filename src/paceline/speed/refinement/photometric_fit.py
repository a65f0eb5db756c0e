"""Photometric (direct) fit of one motion model to the whole track in both views, by Gauss–Newton on grey values.

All frames of both views share one texture of the plane, which is eliminated exactly (variable projection). Each patch
of each view has its own gain and offset, each row of a patch a small depth offset from the plane, and patches that do
not fit (glare, a pole) are down-weighted. The camera's gamma is estimated with the motion. At the end the covariance of
view-dependent appearance is added. The division into patches is arbitrary but changes the speed by as much as noise
does, so the result is the mean over several patch grids.

Unless the calibration is exact, the rig is estimated together with the motion, with the calibration's uncertainty, as
rig.yaml states it or as it is assumed, for its prior. The images contribute to it, because the growth of the vehicle in
the image determines the ratio of its depths, and therefore the ratio of its disparities.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from paceline.arrays import Array
from paceline.speed.refinement import robust_covariance
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.pyramid import ROWS_PER_PATCH, PatchGrid, PyramidLevel, areas, build_levels
from paceline.speed.refinement.reference_point import ReferencePoint, reference_point
from paceline.speed.refinement.robust_covariance import RobustCovariance
from paceline.speed.refinement.self_calibration import RigEstimate, RigParameters, fixed_rig, rig_directions
from paceline.speed.refinement.trajectory import PARAMETER_INDEX, Prior, Trajectory

# The stages of a fit: the smoothing at the farthest view (px), and whether the finer pyramid levels are used
LEVEL_SCHEDULE = ((2.5, False), (1.2, False), (0.7, True))
# The grids over which the result is averaged, besides the default one of about 15 patches over the whole outline: fewer
# and smaller patches, and patches over the central 80 % of its width or height
PATCH_GRIDS = PatchGrid(8), PatchGrid(30), PatchGrid(share=(0.8, 1.0)), PatchGrid(share=(1.0, 0.8))
MAX_FIT_STEPS = 10  # steps of a fit that starts from the filter's estimates, in each stage
MAX_RESTART_STEPS = 6  # steps of a fit that starts from another fit, in which the rig or the appearance was not free
MAX_GRID_STEPS = 3  # steps of a fit that starts from a fit on another patch grid
# Largest step of a motion parameter, in its standard deviations, …
CONVERGED_STEP_SIGMA = 0.1  # … below which the last stage ends
COARSE_STEP_SIGMA = 1.0  # … below which an earlier stage ends
MAX_LAST_STEP_SIGMA = 1.0  # … above which a fit has not converged, if it is the last one
DEPTH_OFFSET_STD_M = 0.04, 0.05  # prior std of a patch's depth offset from the plane, and of each row's from the patch
GAMMA_PRIOR = 1.7, 0.6  # mean and standard deviation of γ; a grey value is the linear light to the power 1 / γ
GAMMA_RANGE = 1.0, 2.4  # range of γ, outside which other changes of the image may look like a γ
FIXED_INFORMATION = 1e8  # information of a parameter that is held fixed
ABSENT_TERM_SCALE = 1e-4  # prior standard deviation of an absent motion term over that of a present one
MIN_MODEL_PROBABILITY = 1e-3  # least probability of a model in the average
MIN_INFORMATION_SHARE = 0.05  # least reduction of a rig direction's variance by the images, as a share of the prior's
# Standard deviations (px) of errors that all matches between the views have in common, by how both cameras sample the
# same edges: along the epipolar lines, measured with benchmarks/bends.py, and across them, by the
# offsets between the views that the fit finds in clips whose offset is known
COMMON_DISPARITY_STD_PX, COMMON_EPIPOLAR_STD_PX = 0.009, 0.005
# Standard deviation of a further common error, as gloss shows both cameras another picture of the surface, over that
# between the patches: what of their errors is common does not show between them, but is the larger where they differ.
# Measured with benchmarks/bends.py on 41 ray-traced clips
COMMON_SHIFT_RATIO = 0.7

DEPTH_OFFSET_INFORMATION = np.linalg.inv(
    np.full((ROWS_PER_PATCH, ROWS_PER_PATCH), DEPTH_OFFSET_STD_M[0] ** 2)
    + DEPTH_OFFSET_STD_M[1] ** 2 * np.eye(ROWS_PER_PATCH)
)


class PhotometricFit:
    """One motion model fitted to the images, coarse to fine; at first with the rig of rig.yaml.

    ``theta`` (n,) are the parameters of the motion, of which P are free under the prior; ``rig_offset`` (Q,) is the
    rig's offset from rig.yaml in prior standard deviations, along the Q directions in which it is uncertain (0 while it
    is fixed); ``depth_offsets`` (K, ROWS_PER_PATCH) m are those of the K patches. ``A`` is the normal matrix of all
    fitted parameters: the P free ones, Q, γ, and the depth offsets. H (views, 3, 3) are homographies from the outline
    to the views, and H_d their derivative by the plane's distance.

    Raises numpy.linalg.LinAlgError where the images do not determine the motion.
    """

    def __init__(self, trajectory: Trajectory, keyframes: list[Keyframe], prior: Prior) -> None:
        self.trajectory, self.keyframes, self.prior = trajectory, keyframes, prior
        self._rig = fixed_rig(trajectory)
        self.rig_offset = np.zeros(0)  # prior standard deviations; Q is 0 while the rig is fixed
        self._view_dependent = False
        self.theta, self.depth_offsets, self.gamma = (
            self._parameters_from_filter(),
            np.zeros((0, ROWS_PER_PATCH)),
            GAMMA_PRIOR[0],
        )
        for smoothing, fine in LEVEL_SCHEDULE:
            self.levels = build_levels(keyframes, trajectory.quads(self.theta), self.gamma, smoothing, fine)
            if len(self.depth_offsets) != self.levels[0].patches:
                self.depth_offsets = _zero_depth_offsets(self.levels)
            self.gauss_newton(CONVERGED_STEP_SIGMA if fine else COARSE_STEP_SIGMA)

    def with_term(self, prior: Prior, term: str, min_log_odds: float) -> tuple[float, PhotometricFit]:
        """The log Bayes factor of a model with a further motion ``term`` over this one, and the fit of that model, as a
        tuple.

        The fit is one Gauss–Newton step from this one, under ``prior``. If that step's log Bayes factor exceeds
        ``min_log_odds``, the model is fitted anew from the filter's estimates, because the lack of the term may have
        biased this fit.
        """
        other = self.under(prior, max_steps=1)
        evidence = other._log_evidence(term, self.prior, 1.0)
        if evidence < np.log(MIN_MODEL_PROBABILITY):
            return evidence, other
        if evidence > min_log_odds:
            other = PhotometricFit(self._rig.stated, self.keyframes, prior).with_free_rig()
        return other.log_bayes_factor(term, self.prior), other

    def under(self, prior: Prior, max_steps: int = MAX_RESTART_STEPS) -> PhotometricFit:
        """The same model fitted under another ``prior``, starting from this fit."""
        other = self._restarted()
        other.prior = prior
        other.gauss_newton(CONVERGED_STEP_SIGMA, max_steps)
        return other

    def log_bayes_factor(self, term: str, narrower: Prior) -> float:
        """Log Bayes factor of this model over the same one under a ``narrower`` prior of its motion ``term``."""
        return self._log_evidence(term, narrower, self._covariance_inflation)

    def on_outline(self, quad: Array, max_steps: int) -> PhotometricFit:
        """The same model fitted to another outline ``quad`` (4, 2) px of the first left view, in at most ``max_steps``
        steps from this fit."""
        other = copy(self)
        other.trajectory = replace(self.trajectory, quad=quad)
        other._rig = replace(self._rig, stated=replace(self._rig.stated, quad=quad))
        quads = other.trajectory.quads(self.theta)
        other._reset(self.theta, build_levels(self.keyframes, quads, self.gamma, *LEVEL_SCHEDULE[-1]))
        other.gauss_newton(CONVERGED_STEP_SIGMA, max_steps)
        return other

    def on_grid(self, grid: PatchGrid) -> PhotometricFit:
        """The same model fitted on another patch ``grid``, starting from this fit.

        Raises numpy.linalg.LinAlgError where the grid's patches do not determine the motion.
        """
        other = copy(self)
        other._reset(self.theta, [level.on_grid(grid) for level in self.levels])
        other.gauss_newton(CONVERGED_STEP_SIGMA, MAX_GRID_STEPS)
        return other

    def with_free_rig(self) -> PhotometricFit:
        """The same model fitted with the cameras free under their prior, starting from this fit; this fit itself
        where the calibration is exact and so are the exposures."""
        directions, exposures = rig_directions(self.trajectory), len(self.trajectory.timing.modes)
        if not len(directions) + exposures:
            return self
        other = self._restarted()
        other.rig_offset = np.zeros(len(directions) + exposures)
        # The prior is weighted by the ratio of the actual covariance to that of pixel noise, which is right
        # only once the rig is free.
        for fit in (self, other):
            other._rig = RigParameters(self.trajectory, directions, fit._covariance_inflation)
            other.gauss_newton(CONVERGED_STEP_SIGMA, MAX_RESTART_STEPS)
        return other

    def with_view_dependence(self) -> PhotometricFit:
        """The same model fitted with view-dependent appearance, starting from this fit.

        This is the last extension: the residuals of any other error of the model, such as a missing acceleration or a
        wrong rig, would be attributed to view-dependent appearance.
        """
        other = self._restarted()
        other._view_dependent = True
        other.gauss_newton(CONVERGED_STEP_SIGMA, MAX_RESTART_STEPS)
        if len(self.rig_offset):
            other._rig = replace(self._rig, prior_weight=other._covariance_inflation)
            other.gauss_newton(CONVERGED_STEP_SIGMA, MAX_RESTART_STEPS)
        return other

    def average_over_grids(self) -> tuple[Array, Array, float]:
        """The mean over several patch grids, as a tuple: the rig's offset (Q,), the parameters (n,) and the variance of
        the mean speed, m²/s²."""
        fits = [self]
        for grid in PATCH_GRIDS:
            try:
                other = self.on_grid(grid)
            except np.linalg.LinAlgError:  # its patches are too small for the texture
                continue
            if other.converged:
                fits.append(other)
        speeds = np.array([self.trajectory.mean_speed_gradient @ fit.theta for fit in fits])
        weights, variance = robust_covariance.mean_of_estimates(
            speeds, np.array([fit.mean_speed_variance for fit in fits])
        )
        offset = weights @ np.array([fit.rig_offset for fit in fits])
        theta = weights @ np.array([fit.theta for fit in fits])
        return offset, theta, variance

    def trajectory_with(self, rig_offset: Array) -> Trajectory:
        """The trajectory with the rig at ``rig_offset`` (Q,)."""
        return self._rig.trajectory(rig_offset) if len(rig_offset) else self.trajectory

    def _restarted(self) -> PhotometricFit:
        """A copy of this fit with pyramid levels of its own."""
        other = copy(self)
        other._reset(self.theta, [copy(level) for level in self.levels], self.depth_offsets)
        return other

    def _reset(self, theta: Array, levels: list[PyramidLevel], depth_offsets: Array | None = None) -> None:
        """Sets the initial values: ``theta`` (n,), the ``levels`` and ``depth_offsets``, zero unless given."""
        self.theta, self.levels = theta.copy(), levels
        self.depth_offsets = _zero_depth_offsets(levels) if depth_offsets is None else depth_offsets.copy()

    @property
    def noise_std(self) -> float:
        """Standard deviation of the mean speed (m/s) by pixel noise alone.

        Raises numpy.linalg.LinAlgError where the images do not determine the mean speed.
        """
        gradient = np.zeros(len(self.A))
        gradient[: len(self.prior.free)] = self._mean_speed_gradient
        root = np.linalg.cholesky(self.A)
        response = np.linalg.solve(root.T, np.linalg.solve(root, gradient))
        rig_prior_variance = self._rig.prior_weight * np.square(response[self._rig_slice]).sum()
        if not (variance := float(gradient @ response - rig_prior_variance)) > 0.0:
            raise np.linalg.LinAlgError("the images do not determine the mean speed")
        return float(np.sqrt(variance))

    @property
    def _rig_slice(self) -> slice:
        """The slice of the rig's offset in the vector of all fitted parameters."""
        return slice(len(self.prior.free), len(self.prior.free) + len(self.rig_offset))

    @property
    def _covariance_inflation(self) -> float:
        """The mean speed's variance by the scatter of scores over that by pixel noise, at least 1."""
        return max(self.mean_speed_variance / self.noise_std**2, 1.0)

    @property
    def mean_speed_variance(self) -> float:
        """Variance of the mean speed (m²/s²) by the scatter of scores."""
        g = self._mean_speed_gradient
        return float(g @ self.covariance @ g)

    @property
    def _mean_speed_gradient(self) -> Array:
        """Derivative of the mean speed by each free parameter."""
        return self.trajectory.mean_speed_gradient[self.prior.free]

    def _log_evidence(self, term: str, narrower: Prior, inflation: float) -> float:
        """Log Bayes factor of this model over the same model under a ``narrower`` prior of its ``term``.

        It is the Savage–Dickey ratio, generalised to two Gaussian priors. The covariance is taken to be ``inflation``
        times that of pixel noise.
        """
        free = np.isin(self.prior.free, self.trajectory.index(term))
        precision = np.linalg.inv(inflation * np.linalg.inv(self.A)[: len(free), : len(free)][np.ix_(free, free)])
        wide = self.prior.information[np.ix_(free, free)]
        in_term = np.isin(narrower.free, self.trajectory.index(term))
        of_term = narrower.information[np.ix_(in_term, in_term)] if in_term.any() else wide / ABSENT_TERM_SCALE**2
        score = precision @ (self.theta - self.prior.mean)[self.trajectory.index(term)]
        confined = precision - wide + of_term
        logdet = [np.linalg.slogdet(m)[1] for m in (precision, wide, confined, of_term)]
        misfit = score @ (np.linalg.solve(precision, score) - np.linalg.solve(confined, score))
        return float(0.5 * (misfit - logdet[0] + logdet[1] + logdet[2] - logdet[3]))

    def gauss_newton(self, converged_step: float, max_steps: int = MAX_FIT_STEPS) -> None:
        """Gauss–Newton steps until no free motion parameter changes by ``converged_step`` of its standard deviations,
        ``max_steps`` at most."""
        P, Q = len(self.prior.free), len(self.rig_offset)
        for _ in range(max_steps):
            self.A, score, *self._cells = self._assemble()
            change = -np.linalg.solve(self.A, score)
            gamma_index = P + Q
            # where the step would take γ out of its range, γ is held at the limit of that range
            if not GAMMA_RANGE[0] <= self.gamma + change[gamma_index] <= GAMMA_RANGE[1]:
                self.A[gamma_index, gamma_index] += FIXED_INFORMATION
                score[gamma_index] -= FIXED_INFORMATION * (
                    np.clip(self.gamma + change[gamma_index], *GAMMA_RANGE) - self.gamma
                )
                change = -np.linalg.solve(self.A, score)
            if not np.isfinite(change).all():
                raise np.linalg.LinAlgError("the normal equations are singular")
            self.theta[self.prior.free] += change[:P]
            self.rig_offset = self.rig_offset + change[P:gamma_index]
            self.gamma = float(np.clip(self.gamma + change[gamma_index], *GAMMA_RANGE))
            self.depth_offsets += change[gamma_index + 1 :].reshape(self.depth_offsets.shape)
            if Q:
                self.trajectory = self._rig.trajectory(self.rig_offset)
            step = float(np.abs(change[:P] / np.sqrt(np.diag(np.linalg.inv(self.A))[:P])).max())
            if step < converged_step:
                break
        self.converged = step < MAX_LAST_STEP_SIGMA
        self.__dict__.pop("_robust_covariance", None)

    def _parameters_from_filter(self) -> Array:
        """Parameters (n,) from a robust least-squares fit to the filter's quadrilaterals.

        Their errors are in px where the region is smallest, and elsewhere as many times larger as the region is: the
        filter follows a slightly different region, and a near vehicle's pixels are not to outweigh all others.
        """
        quads = np.array([k.quads for k in self.keyframes])
        size = np.sqrt(areas(quads))[..., None, None]
        scale = size.min() / size
        p = self.prior
        root = np.linalg.cholesky(p.information).T
        theta = p.mean.copy()
        along = p.mean.copy()  # along the path itself: on a bend that is the arc through the filter's places
        along[self.trajectory.index("deviation")] = along[PARAMETER_INDEX["curvature"]] = 0.0

        def residuals(x: Array) -> Array:
            theta[p.free] = x
            errors = scale * (self.trajectory.quads(theta) - quads)
            return np.concatenate([errors.ravel(), root @ (x - p.mean[p.free])])

        def jacobian(x: Array) -> Array:
            theta[p.free] = x
            perturbed, steps = self._perturbed(theta, p.free)
            ahead, behind = (scale * self.trajectory.quads(perturbed)).reshape(2, len(x), -1)
            return np.concatenate([((ahead - behind) / (2 * steps[:, None])).T, root])

        optimum = least_squares(residuals, along[p.free], jacobian, x_scale="jac", loss="soft_l1", max_nfev=40)
        theta[p.free] = optimum.x
        return theta

    def _derivatives(self, index: NDArray[np.int64]) -> Array:
        """∂H/∂θ (views, 3, 3, len(index)) by central differences."""
        perturbed, steps = self._perturbed(self.theta, index)
        ahead, behind = self.trajectory.homographies(perturbed)[0].reshape(2, len(index), -1, 3, 3)
        return np.moveaxis((ahead - behind) / (2 * steps[:, None, None, None]), 0, -1)

    def _perturbed(self, theta: Array, index: NDArray[np.int64]) -> tuple[Array, Array]:
        """``theta`` (n,) with each of the parameters at ``index`` changed by plus and minus its step, (2, len(index),
        n), and the steps, (len(index),)."""
        steps = self.trajectory.steps[index]
        change = np.zeros((len(index), len(theta)))
        change[np.arange(len(index)), index] = steps
        return theta + np.stack([change, -change]), steps

    def _assemble(self) -> tuple[Array, Array, Array, Array]:
        """The normal matrix and the score with the prior's part, and the cells whose sums they are, as a tuple.

        The parameters are the P free ones of the motion, the rig's offset (Q), γ and the depth offsets. A cell is the
        part of one patch of one view. The cells are (views, K, m, m) and (views, K, m), m = P + Q + 1 + ROWS_PER_PATCH,
        with the patch's own depth offsets last.
        """
        p, P, Q = self.prior, len(self.prior.free), len(self.rig_offset)
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        shared = P + Q + 1
        cells_A, cells = self._assemble_cells(H, H_d, self._homography_jacobian(H))
        A, score = self._prior_information(self._rig.prior_weight), np.zeros(shared + self.depth_offsets.size)
        score[:P] = p.information @ (self.theta - p.mean)[p.free]
        score[P : P + Q] = self._rig.prior_weight * self.rig_offset
        score[shared - 1] = (self.gamma - GAMMA_PRIOR[0]) / GAMMA_PRIOR[1] ** 2
        score[shared:] = (self.depth_offsets @ DEPTH_OFFSET_INFORMATION).ravel()
        return (
            A + robust_covariance.assemble(cells_A, shared),
            score + robust_covariance.assemble_scores(cells, shared),
            cells_A,
            cells,
        )

    def _homography_jacobian(self, H: Array) -> Array:
        """∂H/∂(θ, rig's offset) (views, 3, 3, P + Q)."""
        by_motion = self._derivatives(self.prior.free)
        if not len(self.rig_offset):
            return by_motion
        by_rig = self._rig.homography_jacobian(self.trajectory, self.theta, self.rig_offset, H)
        return np.concatenate([by_motion, by_rig], axis=-1)

    def _assemble_cells(self, H: Array, H_d: Array, dH: Array) -> tuple[Array, Array]:
        """The cells of all levels, with the derivatives ``dH`` (views, 3, 3, C) by C shared parameters beside γ."""
        size = dH.shape[-1] + 1 + ROWS_PER_PATCH
        cells = np.zeros((len(H), len(self.depth_offsets), size))
        cells_A = np.zeros((*cells.shape, size))
        viewing_directions = self.trajectory.directions(self.theta).reshape(-1, 3) if self._view_dependent else None
        for level in self.levels:
            a, s = level.normal_equations(H, H_d, self.depth_offsets, self.gamma, dH, viewing_directions)
            cells_A[level.views] += a
            cells[level.views] += s
        return cells_A, cells

    def matching_error(self) -> tuple[Array, float]:
        """Covariance (n, n) of all parameters by errors that all matches between the views share, along and across the
        epipolar lines, and the effective degrees of freedom of the mean speed's variance by it, as a tuple."""
        response, known, between = self.matching_response()
        by_shift = np.square(self.trajectory.mean_speed_gradient @ response)
        variances = np.array([by_shift @ stds**2 for stds in (known, between)])
        dof = robust_covariance.effective_dof(variances, np.array([np.inf, len(self.depth_offsets) - 1.0]))
        return np.asarray(response * (known**2 + between**2) @ response.T), dof

    def matching_response(self) -> tuple[Array, Array, Array]:
        """Derivatives (n, 2) of all parameters by a shift of the right view by 1 px along and across the epipolar
        lines, and the standard deviations (2,) px of such shifts that all matches share: known beforehand, and (2,) by
        what the patches tell, as a tuple."""
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        (x, y) = self.trajectory.rig.t[:2] / np.linalg.norm(self.trajectory.rig.t[:2])
        shift = np.zeros((*H.shape, 2))
        shift[1::2, :2] = np.array([[x, -y], [y, x]])[:, None] * H[1::2, 2:, :, None]
        jacobian = self._homography_jacobian(H)
        shared = jacobian.shape[-1]
        cells_A, cells = self._assemble_cells(H, H_d, np.concatenate([jacobian, shift], axis=-1))
        A = robust_covariance.assemble(cells_A, shared + 3)
        shifts = [shared, shared + 1]
        others = np.delete(np.arange(len(A)), shifts)
        fitted = A[np.ix_(others, others)] + self._prior_information(self._rig.prior_weight)
        response = np.zeros((len(self.theta), 2))
        response[self.prior.free] = np.linalg.solve(fitted, A[np.ix_(others, shifts)])[: len(self.prior.free)]
        by_patch = cells_A.sum(0), cells.sum(0)
        by_patch[0][:, -ROWS_PER_PATCH:, -ROWS_PER_PATCH:] += DEPTH_OFFSET_INFORMATION
        by_patch[1][:, -ROWS_PER_PATCH:] += self.depth_offsets @ DEPTH_OFFSET_INFORMATION
        between = robust_covariance.scatter_of_shifts(*by_patch, shifts, ROWS_PER_PATCH)
        return response, np.array([COMMON_DISPARITY_STD_PX, COMMON_EPIPOLAR_STD_PX]), COMMON_SHIFT_RATIO * between

    def _prior_information(self, rig_information: float) -> Array:
        """Prior information matrix of the free parameters, the rig's offset (``rig_information`` in each direction), γ
        and the depth offsets."""
        P, Q, K = len(self.prior.free), len(self.rig_offset), len(self.depth_offsets)
        shared = np.diag([*np.zeros(P), *np.full(Q, rig_information), GAMMA_PRIOR[1] ** -2])
        shared[:P, :P] = self.prior.information
        return robust_covariance.arrow_matrix(shared, 0.0, np.tile(DEPTH_OFFSET_INFORMATION, (K, 1, 1)))

    @property
    def covariance(self) -> Array:
        """Cluster-robust covariance (P, P) of the free parameters, without the calibration's part."""
        return self._robust_covariance.total

    @cached_property
    def _robust_covariance(self) -> RobustCovariance:
        return self._covariance(len(self.rig_offset))

    def _covariance(self, Q: int) -> RobustCovariance:
        """Cluster-robust covariance of the free parameters, with the rig unknown in ``Q`` directions: all of
        ``rig_offset``, or none."""
        P, fixed = len(self.prior.free), self._rig_slice if Q == 0 else slice(0)
        prior, (cells_A, cells) = self._prior_information(0.0), self._cells
        A, prior = (np.delete(np.delete(m, fixed, 0), fixed, 1) for m in (self.A, prior))
        cells_A, cells = np.delete(np.delete(cells_A, fixed, -2), fixed, -1), np.delete(cells, fixed, -1)
        gradient = np.append(self._mean_speed_gradient, np.zeros(Q + 1))
        shared = robust_covariance.covariance(A, prior, cells_A, cells, gradient)
        return RobustCovariance(shared.of_prior[:P, :P], shared.of_scatter[:P, :P])

    @property
    def full_covariance(self) -> Array:
        """Covariance (n, n) of all parameters, zero for those that are not free."""
        return self._embed(self.covariance)

    @property
    def covariance_given_rig(self) -> Array:
        """Covariance (n, n) of all parameters if the rig were known, zero for those that are not free."""
        return self._embed(self._covariance(0).total) if len(self.rig_offset) else self.full_covariance

    def _embed(self, covariance: Array) -> Array:
        """The free parameters' ``covariance`` (P, P) as a covariance (n, n) of all parameters."""
        full = np.zeros((len(self.theta),) * 2)
        full[np.ix_(self.prior.free, self.prior.free)] = covariance
        return full

    @property
    def deviation_sigma(self) -> float:
        """RMS of the amplitudes of the deviation from the path, each of prior standard deviation 1."""
        amplitudes = (self.theta - self.prior.mean)[np.intersect1d(self.trajectory.index("deviation"), self.prior.free)]
        return float(np.sqrt((amplitudes**2).mean())) if len(amplitudes) else 0.0

    @property
    def dof(self) -> float:
        """Effective degrees of freedom of the mean speed's variance: what scatter tells of it is known from frames or
        patches, whichever are fewer."""
        clusters = min(len(self.keyframes), len(self.depth_offsets))
        return self._robust_covariance.dof(self._mean_speed_gradient, clusters)

    @property
    def residual_rms(self) -> float:
        """Median RMS residual of a patch (grey levels), in the view where it is larger."""
        base = self.levels[0]
        sides = (base.variance[base.views % 2 == side] for side in (0, 1))
        return float(np.sqrt(max(np.median(variance) for variance in sides if len(variance))))

    @property
    def reference_point(self) -> ReferencePoint:
        """Where in the outline the middle of the vehicle is."""
        return reference_point(*self.levels[0].patch_variances())

    @property
    def contrast(self) -> float:
        """RMS contrast of the texture within patches (grey levels)."""
        texture = self.levels[0].texture
        assert texture is not None
        return float(np.sqrt(texture.var(-1).mean()))

    def residual_offsets(self) -> tuple[Array, Array]:
        """Each view's image offset (F, 2, 2) px from the fitted motion, and the share (F, 2) of its weighted variance
        that the motion explains; NaN where a view was not used."""
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        offsets, explained_share = np.full((len(H), 2), np.nan), np.full(len(H), np.nan)
        base = self.levels[0]
        offsets[base.views], explained_share[base.views] = base.residual_offsets(H, H_d, self.depth_offsets, self.gamma)
        return offsets.reshape(-1, 2, 2), explained_share.reshape(-1, 2)

    @property
    def rig_shift_sigma(self) -> Array:
        """The rig's offset (Q,) in the standard deviations that are expected if rig.yaml states the right uncertainty.

        These are less than those of the prior, because the prior shrinks the estimate towards zero. The result is zero
        in directions that the images hardly determine.
        """
        variance_reduction = 1.0 - self._rig.prior_weight * np.diag(np.linalg.inv(self.A))[self._rig_slice]
        expected_std = np.sqrt(np.maximum(variance_reduction, MIN_INFORMATION_SHARE))
        return np.where(variance_reduction > MIN_INFORMATION_SHARE, self.rig_offset / expected_std, 0.0)

    @property
    def systematic_covariance(self) -> Array:
        """Covariance (n, n) of all parameters by that part of the calibration's uncertainty that the images do not
        remove; NaN where it is exact."""
        n, p = len(self.theta), self.prior.free
        if self.trajectory.rig.uncertainty is None and not len(self.rig_offset):
            return np.full((n, n), np.nan)
        response = np.zeros((n, len(self.rig_offset)))
        response[p] = self._rig.prior_weight * np.linalg.inv(self.A)[: len(p), self._rig_slice]
        return np.asarray(response @ response.T)

    def rig_estimate(self, offset: Array, covariance: Array) -> RigEstimate | None:
        """What the images determine of the rig, or None where it is fixed.

        ``offset`` (Q,) is the mean of its offset over the patch grids, and ``covariance`` (n, n) that of the parameters
        if the rig were known.
        """
        if not len(offset):
            return None
        p, inverse = self.prior.free, np.linalg.inv(self.A)
        precision = np.linalg.inv(inverse[self._rig_slice, self._rig_slice])
        response = np.zeros((len(self.theta), len(offset)))
        response[p] = inverse[: len(p), self._rig_slice] @ precision
        information_ratio, axes = np.linalg.eigh(precision / self._rig.prior_weight)  # of posterior and prior
        information = (
            axes * np.maximum(information_ratio - 1.0, 0.0) @ axes.T
        )  # images cannot reduce the prior information
        return RigEstimate(offset, information, response, covariance)


def _zero_depth_offsets(levels: list[PyramidLevel]) -> Array:
    """Depth offsets (K, ROWS_PER_PATCH) of zero."""
    return np.zeros((levels[0].patches, ROWS_PER_PATCH))
