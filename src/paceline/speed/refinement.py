"""Joint estimation of a vehicle's motion from its whole track, both views, all frames.

One texture of the plane is shared by every frame of both views; depth, speed, the path's direction and the plane's
normal are found so that all of them agree, by Gauss–Newton on intensities. The texture is eliminated exactly
(variable projection), each patch of each view has its own gain and offset, patches may stand a little before or
behind the plane, and a patch that does not fit — glare, a pole — loses its say.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from paceline.cameras import Camera, RigUncertainty, StereoRig
from paceline.speed.bands import Glimpse, bands_of
from paceline.speed.trajectory import INDEX, STEPS, Prior, Trajectory, prior

Array = NDArray[np.float64]

LEVELS = ((2.5, False), (1.2, False), (0.7, True))  # smoothing at the farthest view, px; whether the finer bands join
RELIEF = 0.04  # m, how far a patch may stand from the plane
STEP = 0.1  # standard deviations: converged
# What scores cannot show: errors that all frames and patches share. Measured on rendered clips, benchmarks/accuracy.py;
# on a curve the road's true shape has more freedom than the polynomial of the heading.
CALIBRATION = {"line": 1.4, "curve": 2.0}
COARSE_STEP = 1.0  # the same before the last level, which starts where this ends


@dataclass(frozen=True, eq=False)
class Refined:
    """The refined motion: parameters ``theta`` (12,), their random ``covariance`` and the systematic one (12, 12).

    ``systematic`` is NaN where the rig states no uncertainty. ``residual`` is the median rms of a patch in grey
    levels, ``contrast`` that of the texture; ``offsets`` (F, 2, 2) are the pixels by which each view's picture lies
    off the motion (NaN where it was not used).
    """

    trajectory: Trajectory
    theta: Array
    covariance: Array
    systematic: Array
    residual: float
    contrast: float
    offsets: Array
    accelerating: bool
    turning: bool
    dof: float
    converged: bool

    def speeds(self) -> tuple[Array, Array]:
        """Speed (F,) at every frame and its standard deviation (F,), the systematic part, where known, included."""
        t = self.trajectory.times.mean(1)
        g = np.zeros((len(t), len(self.theta)))
        g[:, 1], g[:, 2] = 1.0, t
        total = self.covariance + np.nan_to_num(self.systematic)
        return g @ self.theta, np.sqrt(np.einsum("fi,ij,fj->f", g, total, g))

    def mean_speed(self) -> tuple[float, float, float]:
        """Distance over time, and its random and systematic standard deviations."""
        t = self.trajectory.times.mean(1)
        g = np.zeros(len(self.theta))
        g[1], g[2] = 1.0, 0.5 * (t[0] + t[-1])
        return float(g @ self.theta), float(np.sqrt(g @ self.covariance @ g)), float(np.sqrt(g @ self.systematic @ g))


def refine(trajectory: Trajectory, glimpses: list[Glimpse], speed: float, on_path: bool) -> Refined:
    """The motion that all ``glimpses`` agree on.

    ``trajectory`` carries the operator's outline along the path, ``speed`` (m/s) is the filter's mean. Constant speed,
    unless the evidence speaks for constant acceleration; without a path straight, unless it speaks for a turn. Raises
    numpy.linalg.LinAlgError where the images determine nothing.
    """
    fit = _Fit(trajectory, glimpses, prior(trajectory, speed, on_path, accelerating=False), None)
    accelerating = turning = False
    if len(glimpses) >= 5:
        for name in ("acceleration",) if on_path else ("curvature", "acceleration"):
            wider = dict(accelerating=accelerating, turning=turning)
            wider["accelerating" if name == "acceleration" else "turning"] = True
            other = _Fit(trajectory, glimpses, prior(trajectory, speed, on_path, **wider), fit)
            if other.log_evidence(name, fit.prior) > STRONG:
                fit, accelerating, turning = other, wider["accelerating"], wider["turning"]
    covariance = np.zeros((len(STEPS),) * 2)
    covariance[np.ix_(fit.prior.free, fit.prior.free)] = fit.covariance
    return Refined(
        trajectory,
        fit.theta,
        covariance,
        fit.systematic(trajectory.rig.uncertainty),
        fit.residual,
        fit.contrast,
        fit.offsets(),
        accelerating,
        turning,
        fit.dof,
        fit.converged,
    )


class _Fit:
    """One model fitted to the images, coarse to fine."""

    def __init__(self, trajectory: Trajectory, glimpses: list[Glimpse], prior: Prior, start: _Fit | None) -> None:
        self.trajectory, self.glimpses, self.prior = trajectory, glimpses, prior
        self.theta: Array = self._from_filter() if start is None else start.theta.copy()
        self.relief: Array = np.zeros(0) if start is None else start.relief.copy()
        for smoothing, fine in LEVELS if start is None else LEVELS[-1:]:
            self.bands = bands_of(glimpses, trajectory.quads(self.theta), smoothing, fine)
            if len(self.relief) != self.bands[0].patches:
                self.relief = np.zeros(self.bands[0].patches)
            for _ in range(10):
                A, score, *cells = self._assemble()
                change = -np.linalg.solve(A, score)
                P = len(prior.free)
                self.theta[prior.free] += change[:P]
                self.relief += change[P:]
                step = float(np.abs(change[:P] / np.sqrt(np.diag(np.linalg.inv(A))[:P])).max())
                if step < (STEP if fine else COARSE_STEP):
                    break
        self.converged = step < 1.0
        self.A = A
        self._summarise(*cells)

    def _from_filter(self) -> Array:
        """Parameters that fit the filter's regions best, robustly."""
        seen = np.array([g.quads for g in self.glimpses])
        p = self.prior
        root = np.linalg.cholesky(p.information).T
        theta = p.mean.copy()

        def residuals(x: Array) -> Array:
            theta[p.free] = x
            return np.concatenate([(self.trajectory.quads(theta) - seen).ravel(), root @ (x - p.mean[p.free])])

        scale = 1.0 / np.sqrt(np.diag(p.information))
        found = least_squares(residuals, p.mean[p.free], x_scale=scale, loss="soft_l1", max_nfev=40)
        theta[p.free] = found.x
        return theta

    def _derivatives(self, index: NDArray[np.int64]) -> Array:
        """∂H/∂θ (views, 3, 3, len(index)) by central differences."""
        columns = []
        for i in index:
            e = np.zeros(len(STEPS))
            e[i] = STEPS[i]
            ahead, behind = (self.trajectory.homographies(self.theta + sign * e)[0] for sign in (1, -1))
            columns.append((ahead - behind).reshape(-1, 3, 3) / (2 * STEPS[i]))
        return np.stack(columns, axis=-1)

    def _assemble(self) -> tuple[Array, Array, Array, Array]:
        """The normal matrix and score over free parameters and relief, prior included, and what each view's patches
        give to them: (views, patches, P + 1, P + 1) and (views, patches, P + 1), the patch's own relief last."""
        p, K = self.prior, len(self.relief)
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        dH = self._derivatives(p.free)
        n = len(p.free) + 1
        cells_A, cells = np.zeros((len(H), K, n, n)), np.zeros((len(H), K, n))
        for band in self.bands:
            a, s = band.normal_equations(H, H_d, self.relief, dH)
            cells_A[band.views] += a
            cells[band.views] += s
        A, score = self._prior_information(), np.zeros(n - 1 + K)
        score[: n - 1] = p.information @ (self.theta - p.mean)[p.free]
        score[n - 1 :] = self.relief / RELIEF**2
        return A + _spread(cells_A), score + _spread_scores(cells), cells_A, cells

    def _prior_information(self) -> Array:
        """Information of the prior over free parameters and relief."""
        P, K = len(self.prior.free), len(self.relief)
        information = np.zeros((P + K, P + K))
        information[:P, :P] = self.prior.information
        information[range(P, P + K), range(P, P + K)] = 1.0 / RELIEF**2
        return information

    def _summarise(self, cells_A: Array, cells: Array) -> None:
        """Covariance from how the scores of frames and of patches really scatter, not from the pixels' noise.

        Errors that a patch repeats in every frame and that a frame makes in every patch do not average out over
        pixels: the scores are summed within each before they are squared. That is a sandwich estimate, clustered both
        ways and freed of its small-sample bias (Bell and McCaffrey 2002, "CR2"), of which the wider one is taken.
        """
        P, K = len(self.prior.free), len(self.relief)
        inverse = np.linalg.inv(self.A)
        frames = [np.s_[2 * f : 2 * f + 2] for f in range(len(self.glimpses))]
        by_frame = [(_spread(cells_A[f]), _spread_scores(cells[f])) for f in frames]
        only = np.eye(K)[:, :, None, None]
        by_patch = [
            (_spread(cells_A * only[k]), _spread_scores(cells * only[k, :, 0])) for k in range(K)
        ]
        speed = list(self.prior.free).index(INDEX["speed"])
        candidates = []
        for clusters in (by_frame, by_patch):
            meat = sum((np.outer(s, s) for s in _unbiased(self.A, clusters)), self._prior_information())
            candidates.append((inverse @ meat @ inverse)[:P, :P])
        widest = max(candidates, key=lambda C: float(C[speed, speed]))
        self.covariance = CALIBRATION[self.trajectory.path.shape] ** 2 * widest
        self.dof = float(min(len(frames), K) - 1)
        base = self.bands[0]
        self.residual = float(np.sqrt(np.median(base.variance)))
        assert base.texture is not None
        self.contrast = float(np.sqrt((base.texture**2).mean()))

    def offsets(self) -> Array:
        """Pixels (F, 2, 2) by which each view's picture lies off the fitted motion; NaN where it was not used."""
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        off = np.full((len(H), 2), np.nan)
        off[self.bands[0].views] = self.bands[0].offsets(H, H_d, self.relief)
        return off.reshape(-1, 2, 2)

    def log_evidence(self, name: str, narrower: Prior) -> float:
        """Log Bayes factor of this model against one in which ``name`` is held to ``narrower`` (Savage–Dickey)."""
        i = list(self.prior.free).index(INDEX[name])
        wide = 1.0 / np.sqrt(self.prior.information[i, i])
        spread = float(np.sqrt(self.covariance[i, i]))
        value = float(self.theta[INDEX[name]])
        held = INDEX[name] in narrower.free
        j = list(narrower.free).index(INDEX[name]) if held else 0
        rest = 1.0 / np.sqrt(narrower.information[j, j]) if held else 0.0
        s_wide, s_held = np.hypot(spread, wide), np.hypot(spread, rest)
        return float(0.5 * (value / s_held) ** 2 - 0.5 * (value / s_wide) ** 2 - np.log(s_wide / s_held))

    def systematic(self, uncertainty: RigUncertainty | None) -> Array:
        """Covariance (12, 12) that the rig's stated uncertainty causes: the refit's response to every calibration
        parameter, the images held fixed. NaN where none is stated."""
        n = len(STEPS)
        if uncertainty is None:
            return np.full((n, n), np.nan)
        rig = self.trajectory.rig
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        changes = []
        for moved in perturbed(rig, uncertainty):
            t = self.trajectory
            other = Trajectory(moved, t.quad, t.plane, t.path, t.times)
            changes.append(other.homographies(self.theta)[0].reshape(-1, 3, 3) - H)
        p = self.prior
        P, K, Q = len(p.free), len(self.relief), len(changes)
        dH = np.concatenate([self._derivatives(p.free), np.stack(changes, axis=-1)], axis=-1)
        coupling = np.zeros((P + K, Q))
        for band in self.bands:
            a, _ = band.normal_equations(H, H_d, self.relief, dH)
            coupling[:P] += a[..., :P, P : P + Q].sum((0, 1))
            coupling[P:] += a[..., P + Q, P : P + Q].sum(0)
        response = np.zeros((n, Q))
        response[p.free] = -np.linalg.solve(self.A, coupling)[:P]
        return np.asarray(response @ response.T)


def _spread(cells_A: Array) -> Array:
    """Normal matrices (views, K, P + 1, P + 1), each patch's own relief last, as one (P + K, P + K)."""
    by_patch = cells_A.sum(0)
    K, P = len(by_patch), by_patch.shape[-1] - 1
    A = np.zeros((P + K, P + K))
    A[:P, :P] = by_patch[:, :P, :P].sum(0)
    A[P:, :P] = by_patch[:, P, :P]
    A[:P, P:] = by_patch[:, P, :P].T
    A[range(P, P + K), range(P, P + K)] = by_patch[:, P, P]
    return A


def _spread_scores(cells: Array) -> Array:
    """Scores (views, K, P + 1), each patch's own relief last, as one (P + K,)."""
    by_patch = cells.sum(0)
    return np.concatenate([by_patch[:, :-1].sum(0), by_patch[:, -1]])


def _unbiased(A: Array, clusters: list[tuple[Array, Array]]) -> list[Array]:
    """Cluster scores, each enlarged for having drawn the fit to itself: A^½ (I − B)^−½ A^−½ s with B = A^−½ Aᵢ A^−½."""
    values, vectors = np.linalg.eigh(A)
    root = vectors * np.sqrt(values) @ vectors.T
    back = vectors / np.sqrt(values) @ vectors.T
    scores = []
    for A_i, s in clusters:
        share, axes = np.linalg.eigh(back @ A_i @ back)
        enlarged = axes / np.sqrt(np.maximum(1.0 - share, LEAST_REST)) @ axes.T
        scores.append(root @ enlarged @ back @ s)
    return scores


LEAST_REST = 0.05  # share of the information that a single cluster leaves to the others, at least
STRONG = 3.0  # log Bayes factor, 20 to 1, that speaks for a richer model


def perturbed(rig: StereoRig, uncertainty: RigUncertainty) -> list[StereoRig]:
    """Rigs that each differ from ``rig`` by one standard uncertainty of one calibration parameter."""
    rigs = []
    for view in (0, 1):
        for at, size in (
            ((0, 0), uncertainty.focal_length_px),
            ((1, 1), uncertainty.focal_length_px),
            ((0, 2), uncertainty.principal_point_px),
            ((1, 2), uncertainty.principal_point_px),
        ):
            K = rig.cameras[view].K.copy()
            K[at] += size
            camera = Camera(rig.cameras[view].image_size, K)
            rigs.append(StereoRig(*((camera, rig.right) if view == 0 else (rig.left, camera)), rig.R, rig.t))
    for axis in range(3):
        turn = cv2.Rodrigues(np.eye(3)[axis] * uncertainty.rotation_rad[axis])[0]
        rigs.append(StereoRig(rig.left, rig.right, turn @ rig.R, turn @ rig.t))
        shift = np.eye(3)[axis] * uncertainty.translation_m[axis]
        rigs.append(StereoRig(rig.left, rig.right, rig.R, rig.t + shift))
    return rigs
