"""One model of a vehicle's motion, fitted to its whole track in both views by Gauss–Newton on intensities.

One texture of the plane is shared by every frame of both views. It is eliminated exactly (variable projection), each
patch of each view has its own gain and offset, strips of patches may stand a little before or behind the plane, and a
patch that does not fit — glare, a pole — loses its say. How the camera's values go as light is found with the motion.
Last of all, what patches show may drift with the direction that they are seen from. Into which patches the plane is
divided is arbitrary, and moves the speed by as much as noise does: the motion is the mean over several layouts.

Where rig.yaml states how well the cameras are known, that is a prior as well, and no rail: they are moved along with
the motion. A vehicle that comes nearer tells by how its pictures grow what its disparities ought to be.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from paceline.arrays import Array
from paceline.speed.refinement import robust_covariance
from paceline.speed.refinement.keyframes import Glimpse
from paceline.speed.refinement.pyramid import STRIPS, Band, Layout, bands_of
from paceline.speed.refinement.self_calibration import FreeRig, RigFit, held
from paceline.speed.refinement.trajectory import Prior, Trajectory

LEVELS = ((2.5, False), (1.2, False), (0.7, True))  # smoothing at the farthest view, px; whether the finer bands join
LAYOUTS = Layout(8), Layout(30), Layout(share=(0.8, 1.0)), Layout(share=(1.0, 0.8))  # besides the first one
RESUMED = 6  # steps of a fit that goes on from another one under wider assumptions, at most
UNTOLD = 0.05  # share of the variance of a move that pictures have to take away to tell anything of it
RELAID = 3  # steps of a fit to another layout, at most
RELIEF = 0.04, 0.05  # m, how far a patch may stand from the plane, and each of its strips from that
GAMMA = 1.7, 0.6  # γ of a camera, whose values go as light to the power 1 / γ
GAMMAS = 1.0, 2.4  # the least and the most: what else changes from picture to picture may pass for any
FIRM = 1e8  # information of what is held
STEP = 0.1  # standard deviations: converged
COARSE_STEP = 1.0  # the same before the last level, which starts where this ends
UNSETTLED = 1.0  # a last step from which no motion can be said to have been found
MOST_STEPS = 10
RARE = 3.0  # log odds, 20 to 1, against an extra of the motion before any picture is seen; a second is as rare again
HELD = 1e-4  # of its usual size: what an extra may be that is not there
NEGLIGIBLE = 1e-3  # probability of a model that need not be thought of
# What scores cannot show: errors that all frames and patches share. Measured on rendered clips, benchmarks/accuracy.py.
CALIBRATION = 1.4

RELIEF_INFORMATION = np.linalg.inv(np.full((STRIPS, STRIPS), RELIEF[0] ** 2) + RELIEF[1] ** 2 * np.eye(STRIPS))


class Fit:
    """One model fitted to the images, coarse to fine, with the rig as it is stated."""

    def __init__(self, trajectory: Trajectory, glimpses: list[Glimpse], prior: Prior) -> None:
        self.trajectory, self.glimpses, self.prior = trajectory, glimpses, prior
        self._rig = held(trajectory)
        self.moves = np.zeros(0)  # of the rig, in standard uncertainties
        self._drifts = False
        self.theta, self.relief, self.gamma = self._from_filter(), np.zeros((0, STRIPS)), GAMMA[0]
        for smoothing, fine in LEVELS:
            self.bands = bands_of(glimpses, trajectory.quads(self.theta), self.gamma, smoothing, fine)
            if len(self.relief) != self.bands[0].patches:
                self.relief = _flat(self.bands)
            self.descend(STEP if fine else COARSE_STEP)

    def extended(self, prior: Prior, extra: str) -> tuple[float, Fit]:
        """A model that has an ``extra`` too, and the log Bayes factor by which the evidence speaks for it.

        Where one step from here finds little that does, it is left there; where it finds much, it is fitted from the
        beginning, for what this one lacks may have led it astray.
        """
        other = self._resumed()
        other.prior = prior
        other.descend(STEP, most=1)
        evidence = other._log_evidence(extra, self.prior, 1.0)
        if evidence < np.log(NEGLIGIBLE):
            return evidence, other
        if evidence > RARE:
            other = Fit(self._rig.stated, self.glimpses, prior).with_rig_free()
        return other._log_evidence(extra, self.prior, other._wider), other

    def outlined(self, quad: Array, most: int) -> Fit:
        """The same model fitted to another outline ``quad`` (4, 2) of its plane, px of the first left view, in at most
        so many steps from here."""
        other = copy(self)
        other.trajectory = replace(self.trajectory, quad=quad)
        other._rig = replace(self._rig, stated=replace(self._rig.stated, quad=quad))
        quads = other.trajectory.quads(self.theta)
        other._begin_at(self.theta, bands_of(self.glimpses, quads, self.gamma, *LEVELS[-1]))
        other.descend(STEP, most)
        return other

    def laid_out(self, layout: Layout) -> Fit:
        """The same model fitted to patches of another ``layout``, from here. Raises numpy.linalg.LinAlgError where
        these determine nothing."""
        other = copy(self)
        other._begin_at(self.theta, [band.laid_out(layout) for band in self.bands])
        other.descend(STEP, RELAID)
        return other

    def with_rig_free(self) -> Fit:
        """The same model with the rig free as far as it is uncertain, from here; itself where the rig states no
        uncertainty."""
        uncertainty = self.trajectory.rig.uncertainty
        if uncertainty is None:
            return self
        other = self._resumed()
        directions = uncertainty.covariance_root
        directions = directions[directions.any(1)]
        other.moves = np.zeros(len(directions))
        # pictures tell less than their pixels' noise makes believe: how much less is seen once the rig misleads no more
        for fit in (self, other):
            other._rig = FreeRig(self.trajectory, directions, fit._wider)
            other.descend(STEP, RESUMED)
        return other

    def with_drift(self) -> Fit:
        """The same model where what the face shows drifts with the direction that it is seen from, from here.

        It comes last: while the model lacks something, an acceleration or a move of the rig, what that leaves over
        would pass for a drift.
        """
        other = self._resumed()
        other._drifts = True
        other.descend(STEP, RESUMED)
        if len(self.moves):
            other._rig = replace(self._rig, firmness=other._wider)
            other.descend(STEP, RESUMED)
        return other

    def over_layouts(self) -> tuple[Array, Array, float]:
        """The mean over several layouts, each weighed by how well it tells the mean speed: the rig's moves (Q,), the
        parameters (n,), and the variance of the mean speed, m²/s²."""
        fits = [self]
        for layout in LAYOUTS:
            try:
                other = self.laid_out(layout)
            except np.linalg.LinAlgError:  # patches too small for what they show: the others tell
                continue
            if other.converged:
                fits.append(other)
        speeds = np.array([self.trajectory.mean_speed_shares @ fit.theta for fit in fits])
        weights, variance = robust_covariance.averaged(speeds, np.array([fit.variance for fit in fits]))
        moves = weights @ np.array([fit.moves for fit in fits])
        theta = weights @ np.array([fit.theta for fit in fits])
        return moves, theta, variance

    def trajectory_by(self, moves: Array) -> Trajectory:
        """The trajectory with the rig moved by ``moves`` (Q,), where it is free."""
        return self._rig.trajectory(moves) if len(moves) else self.trajectory

    def _resumed(self) -> Fit:
        """A fit that goes on from here, with bands of its own."""
        other = copy(self)
        other._begin_at(self.theta, [copy(band) for band in self.bands], self.relief)
        return other

    def _begin_at(self, theta: Array, bands: list[Band], relief: Array | None = None) -> None:
        """Take ``bands`` for its own, and begin at ``theta`` (n,), with patches in the plane unless their ``relief``
        is known."""
        self.theta, self.bands = theta.copy(), bands
        self.relief = _flat(bands) if relief is None else relief.copy()

    @property
    def noise(self) -> float:
        """Standard deviation of the mean speed, m/s, if the pixels' noise were all. Raises numpy.linalg.LinAlgError
        where the images do not determine it."""
        shares = np.zeros(len(self.A))
        shares[: len(self.prior.free)] = self._mean_speed
        root = np.linalg.cholesky(self.A)
        response = np.linalg.solve(root.T, np.linalg.solve(root, shares))
        of_rig = self._rig.firmness * np.square(response[self._rig_rows]).sum()
        if not (variance := float(shares @ response - of_rig)) > 0.0:
            raise np.linalg.LinAlgError("the images do not determine the mean speed")
        return float(np.sqrt(variance))

    @property
    def _rig_rows(self) -> slice:
        """Where the rig's moves stand among all that is fitted."""
        return slice(len(self.prior.free), len(self.prior.free) + len(self.moves))

    @property
    def _wider(self) -> float:
        """The mean speed's variance by the scores' scatter over that by the pixels' noise, at least 1."""
        return max(self.variance / self.noise**2, 1.0)

    @property
    def variance(self) -> float:
        """That of the mean speed, m²/s², by the scores' scatter."""
        g = self._mean_speed
        return float(g @ self.covariance @ g)

    @property
    def _mean_speed(self) -> Array:
        """What each free parameter contributes to the mean speed."""
        return self.trajectory.mean_speed_shares[self.prior.free]

    def _log_evidence(self, extra: str, narrower: Prior, wider: float) -> float:
        """Log Bayes factor against the same model under a ``narrower`` prior of its ``extra``, its covariance being
        ``wider`` times what the pixels' noise leaves (Savage–Dickey, of two Gaussian priors)."""
        free = np.isin(self.prior.free, self.trajectory.index(extra))
        precision = np.linalg.inv(wider * np.linalg.inv(self.A)[: len(free), : len(free)][np.ix_(free, free)])
        wide = self.prior.information[np.ix_(free, free)]
        held = np.isin(narrower.free, self.trajectory.index(extra))
        narrow = narrower.information[np.ix_(held, held)] if held.any() else wide / HELD**2
        pull = precision @ self.theta[self.trajectory.index(extra)]
        confined = precision - wide + narrow
        logdet = [np.linalg.slogdet(m)[1] for m in (precision, wide, confined, narrow)]
        misfit = pull @ (np.linalg.solve(precision, pull) - np.linalg.solve(confined, pull))
        return float(0.5 * (misfit - logdet[0] + logdet[1] + logdet[2] - logdet[3]))

    def descend(self, enough: float, most: int = MOST_STEPS) -> None:
        """Gauss–Newton until no parameter moves by ``enough`` of its standard deviation."""
        P, Q = len(self.prior.free), len(self.moves)
        for _ in range(most):
            self.A, score, *self._cells = self._assemble()
            change = -np.linalg.solve(self.A, score)
            at = P + Q  # γ: it goes as far as it can, and the others with it
            if not GAMMAS[0] <= self.gamma + change[at] <= GAMMAS[1]:
                self.A[at, at] += FIRM
                score[at] -= FIRM * (np.clip(self.gamma + change[at], *GAMMAS) - self.gamma)
                change = -np.linalg.solve(self.A, score)
            if not np.isfinite(change).all():
                raise np.linalg.LinAlgError("the images determine no step")
            self.theta[self.prior.free] += change[:P]
            self.moves = self.moves + change[P:at]
            self.gamma = float(np.clip(self.gamma + change[at], *GAMMAS))
            self.relief += change[at + 1 :].reshape(self.relief.shape)
            if Q:
                self.trajectory = self._rig.trajectory(self.moves)
            step = float(np.abs(change[:P] / np.sqrt(np.diag(np.linalg.inv(self.A))[:P])).max())
            if step < enough:
                break
        self.converged = step < UNSETTLED
        self.__dict__.pop("covariance", None)

    def _from_filter(self) -> Array:
        """Parameters that fit the filter's regions best, robustly."""
        seen = np.array([g.quads for g in self.glimpses])
        p = self.prior
        root = np.linalg.cholesky(p.information).T
        theta = p.mean.copy()

        def residuals(x: Array) -> Array:
            theta[p.free] = x
            return np.concatenate([(self.trajectory.quads(theta) - seen).ravel(), root @ (x - p.mean[p.free])])

        def slopes(x: Array) -> Array:
            theta[p.free] = x
            moved, steps = self._moved(theta, p.free)
            ahead, behind = self.trajectory.quads(moved).reshape(2, len(x), -1)
            return np.concatenate([((ahead - behind) / (2 * steps[:, None])).T, root])

        found = least_squares(residuals, p.mean[p.free], slopes, x_scale="jac", loss="soft_l1", max_nfev=40)
        theta[p.free] = found.x
        return theta

    def _derivatives(self, index: NDArray[np.int64]) -> Array:
        """∂H/∂θ (views, 3, 3, len(index)) by central differences."""
        moved, steps = self._moved(self.theta, index)
        ahead, behind = self.trajectory.homographies(moved)[0].reshape(2, len(index), -1, 3, 3)
        return np.moveaxis((ahead - behind) / (2 * steps[:, None, None, None]), 0, -1)

    def _moved(self, theta: Array, index: NDArray[np.int64]) -> tuple[Array, Array]:
        """``theta`` (n,) with each of the parameters at ``index`` moved ahead and back, (2, len(index), n), and by how
        much, (len(index),)."""
        steps = self.trajectory.steps[index]
        change = np.zeros((len(index), len(theta)))
        change[np.arange(len(index)), index] = steps
        return theta + np.stack([change, -change]), steps

    def _assemble(self) -> tuple[Array, Array, Array, Array]:
        """The normal matrix and score over free parameters, the rig's moves, gamma and relief, prior included, and what
        each view's patches give to them: (views, patches, n, n) and (views, patches, n) with n = P + Q + 1 + STRIPS,
        their own relief last."""
        p, P, Q, K = self.prior, len(self.prior.free), len(self.moves), len(self.relief)
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        dH = self._derivatives(p.free)
        if Q:
            dH = np.concatenate([dH, self._rig.slopes(self.trajectory, self.theta, self.moves, H)], axis=-1)
        shared = P + Q + 1
        cells = np.zeros((len(H), K, shared + STRIPS))
        cells_A = np.zeros((*cells.shape, shared + STRIPS))
        directions = self.trajectory.directions(self.theta).reshape(-1, 3) if self._drifts else None
        for band in self.bands:
            a, s = band.normal_equations(H, H_d, self.relief, self.gamma, dH, directions)
            cells_A[band.views] += a
            cells[band.views] += s
        A, score = self._prior_information(self._rig.firmness), np.zeros(shared + self.relief.size)
        score[:P] = p.information @ (self.theta - p.mean)[p.free]
        score[P : P + Q] = self._rig.firmness * self.moves
        score[shared - 1] = (self.gamma - GAMMA[0]) / GAMMA[1] ** 2
        score[shared:] = (self.relief @ RELIEF_INFORMATION).ravel()
        return (
            A + robust_covariance.joined(cells_A, shared),
            score + robust_covariance.joined_scores(cells, shared),
            cells_A,
            cells,
        )

    def _prior_information(self, of_rig: float) -> Array:
        """Information of the prior over free parameters, the rig's moves, ``of_rig`` for each, gamma and relief."""
        P, Q, K = len(self.prior.free), len(self.moves), len(self.relief)
        shared = np.diag([*np.zeros(P), *np.full(Q, of_rig), GAMMA[1] ** -2])
        shared[:P, :P] = self.prior.information
        return np.asarray(block_diag(shared, *[RELIEF_INFORMATION] * K))

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the free parameters, from the scatter of the scores: but for what the calibration does."""
        return self._covariance(len(self.moves))

    def _covariance(self, Q: int) -> Array:
        """The same where ``Q`` moves of the rig are not known: all that are free, or none."""
        P, held = len(self.prior.free), self._rig_rows if Q == 0 else slice(0)
        known, (cells_A, cells) = self._prior_information(0.0), self._cells
        A, known = (np.delete(np.delete(m, held, 0), held, 1) for m in (self.A, known))
        cells_A, cells = np.delete(np.delete(cells_A, held, -2), held, -1), np.delete(cells, held, -1)
        judged = np.append(self._mean_speed, np.zeros(Q + 1))
        return CALIBRATION**2 * robust_covariance.covariance(A, known, cells_A, cells, judged)[:P, :P]

    @property
    def whole_covariance(self) -> Array:
        """The covariance (n, n) of all parameters: zero for those that are not free."""
        return self._whole(self.covariance)

    @property
    def covariance_by_rig(self) -> Array:
        """The same if the rig were known, as it is where it may not move."""
        return self._whole(self._covariance(0)) if len(self.moves) else self.whole_covariance

    def _whole(self, covariance: Array) -> Array:
        """That of the free parameters among those of all."""
        whole = np.zeros((len(self.theta),) * 2)
        whole[np.ix_(self.prior.free, self.prior.free)] = covariance
        return whole

    @property
    def deviation_sigma(self) -> float:
        """How far the vehicle's own way departs from the drawn one: rms of the bends' amplitudes, each of which has a
        standard deviation of 1."""
        amplitudes = self.theta[np.intersect1d(self.trajectory.index("way"), self.prior.free)]
        return float(np.sqrt((amplitudes**2).mean())) if len(amplitudes) else 0.0

    @property
    def dof(self) -> float:
        """Degrees of freedom of the covariance: the fewer of frames and patches, less one."""
        return float(min(len(self.glimpses), len(self.relief)) - 1)

    @property
    def residual_rms(self) -> float:
        """Median rms (grey levels) of what a patch leaves unexplained, in the view that shows it worse."""
        base = self.bands[0]
        sides = (base.variance[base.views % 2 == side] for side in (0, 1))
        return float(np.sqrt(max(np.median(variance) for variance in sides if len(variance))))

    @property
    def contrast(self) -> float:
        """Rms (grey levels) of the texture about each patch's mean."""
        texture = self.bands[0].texture
        assert texture is not None
        return float(np.sqrt(texture.var(-1).mean()))

    def agreement(self) -> tuple[Array, Array]:
        """Pixels (F, 2, 2) by which each view's picture lies off the fitted motion, and the share (F, 2) of its
        contrast, squared, that the motion explains, as far as each place is trusted; NaN where it was not used."""
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        off, explained_share = np.full((len(H), 2), np.nan), np.full(len(H), np.nan)
        base = self.bands[0]
        off[base.views], explained_share[base.views] = base.agreement(H, H_d, self.relief, self.gamma)
        return off.reshape(-1, 2, 2), explained_share.reshape(-1, 2)

    @property
    def rig_shift_sigma(self) -> Array:
        """The rig's moves (Q,) over the standard deviations that they have if the calibration is as uncertain as it
        states: the less the pictures tell of one, the less it moves. Zero for those of which they hardly tell."""
        told = 1.0 - self._rig.firmness * np.diag(np.linalg.inv(self.A))[self._rig_rows]
        return np.where(told > UNTOLD, self.moves / np.sqrt(np.maximum(told, UNTOLD)), 0.0)

    @property
    def systematic_covariance(self) -> Array:
        """Covariance (n, n) that is due to the calibration: how the fit responds where the rig is off by each of its
        standard uncertainties, less what the pictures put right of it. NaN where none is stated."""
        n, p = len(self.theta), self.prior.free
        if self.trajectory.rig.uncertainty is None:
            return np.full((n, n), np.nan)
        response = np.zeros((n, len(self.moves)))
        response[p] = self._rig.firmness * np.linalg.inv(self.A)[: len(p), self._rig_rows]
        return np.asarray(response @ response.T)

    def rig_fit(self, moves: Array, known: Array) -> RigFit | None:
        """What the pictures tell of the rig, which the mean over layouts moves by ``moves`` (Q,); ``known`` (n, n) is
        the covariance of the parameters if it were known. None where it may not move."""
        if not len(moves):
            return None
        p, inverse = self.prior.free, np.linalg.inv(self.A)
        precision = np.linalg.inv(inverse[self._rig_rows, self._rig_rows])
        response = np.zeros((len(self.theta), len(moves)))
        response[p] = inverse[: len(p), self._rig_rows] @ precision
        share, axes = np.linalg.eigh(precision / self._rig.firmness)
        information = axes * np.maximum(share - 1.0, 0.0) @ axes.T  # no picture takes anything from what is stated
        return RigFit(moves, information, response, known)


def _flat(bands: list[Band]) -> Array:
    """The relief (patches, STRIPS) of a face that is the plane."""
    return np.zeros((bands[0].patches, STRIPS))
