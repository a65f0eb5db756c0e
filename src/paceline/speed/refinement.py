"""Joint estimation of a vehicle's motion from its whole track, both views, all frames.

One texture of the plane is shared by every frame of both views; depth, speed, the path's direction and the plane's
normal are found so that all of them agree, by Gauss–Newton on intensities. The texture is eliminated exactly
(variable projection), each patch of each view has its own gain and offset, patches may stand a little before or
behind the plane, and a patch that does not fit — glare, a pole — loses its say.

A vehicle that comes near shows finer detail than it did far away. So the images are compared in bands: the first holds
what even the farthest view resolves, each further one the finer detail of the views that resolve it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from paceline.cameras import Camera, RigUncertainty, StereoRig
from paceline.speed.trajectory import INDEX, STEPS, Prior, Trajectory, prior

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

LEVELS = ((2.5, False), (1.2, False), (0.7, True))  # smoothing at the farthest view, px; whether the finer bands join
OPTICS = 0.8  # px, the blur of lens and pixel that most images have; what is left is fitted
BAND = 1.5  # ratio of resolutions between bands
DENSITY = 1.3  # samples per pixel of the coarsest view in a band
PATCHES = 15
INSET = 1.5  # px of a band's coarsest view: the rim shows what is behind
RELIEF = 0.04  # m, how far a patch may stand from the plane
REJECT = 4.0  # times the expected variance at which a patch loses half its say
GAIN = (0.2, 5.0)
STEP = 0.1  # standard deviations: converged
CORRELATED = 12.0  # samples that share their noise, by blur and by sampling more densely than the pixels
SLOPE = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]], np.float32) / 12


@dataclass(frozen=True, eq=False)
class Glimpse:
    """What the refinement keeps of one frame: both images about the vehicle, and the filter's regions there."""

    frame: int
    times: tuple[float, float]  # s, each view's exposure
    crops: tuple[Floats, Floats]
    corners: Array  # (2, 2) first pixel of each crop
    quads: Array  # (2, 4, 2) px, of the filter


@dataclass(frozen=True, eq=False)
class Refined:
    """The refined motion: parameters ``theta`` (12,), their random ``covariance`` and the systematic one (12, 12).

    ``systematic`` is NaN where the rig states no uncertainty. ``residual`` is the median rms of a patch in grey
    levels, ``contrast`` that of the texture; ``share`` of the patches kept their say; ``offsets`` (F, 2, 2) are the
    pixels by which each view's picture lies off the motion (NaN where it was not used).
    """

    trajectory: Trajectory
    theta: Array
    covariance: Array
    systematic: Array
    residual: float
    contrast: float
    share: float
    offsets: Array
    accelerating: bool
    turning: bool
    dof: float
    converged: bool

    def speeds(self) -> tuple[Array, Array]:
        """Speed (F,) at every frame and its random standard deviation (F,)."""
        t = self.trajectory.times.mean(1)
        g = np.zeros((len(t), len(self.theta)))
        g[:, 1], g[:, 2] = 1.0, t
        return g @ self.theta, np.sqrt(np.einsum("fi,ij,fj->f", g, self.covariance, g))

    def mean_speed(self) -> tuple[float, float, float]:
        """Distance over time, and its random and systematic standard deviations."""
        t = self.trajectory.times.mean(1)
        g = np.zeros(len(self.theta))
        g[1], g[2] = 1.0, 0.5 * (t[0] + t[-1])
        return float(g @ self.theta), float(np.sqrt(g @ self.covariance @ g)), float(np.sqrt(g @ self.systematic @ g))


class _Band:
    """One band of resolution: the views that resolve it, their filtered crops and slopes, and its texture."""

    def __init__(self, views: NDArray[np.int64], pictures: list[tuple[Floats, ...]], corners: Array, size: Array) -> None:
        down = max(1, round(np.sqrt(PATCHES * size[1] / size[0])))
        across = max(1, round(PATCHES / down))
        x = max(int(np.ceil(size[0] * DENSITY / across)), 4)
        y = max(int(np.ceil(size[1] * DENSITY / down)), 4)
        rim = np.clip(INSET / size, 0.03, 0.2)
        u = rim[0] + (1 - 2 * rim[0]) * (np.arange(across * x) + 0.5) / (across * x)
        v = rim[1] + (1 - 2 * rim[1]) * (np.arange(down * y) + 0.5) / (down * y)
        grid = np.stack([*np.meshgrid(u, v), np.ones((down * y, across * x))])
        patches = grid.reshape(3, down, y, across, x).swapaxes(2, 3)
        self.patches, self.samples = down * across, y * x
        self.places = patches.reshape(3, -1)
        self.views = views
        self.pictures = pictures
        self.corners = corners
        self.weights = np.ones((len(views), self.patches))
        self.gain = np.ones((len(views), self.patches))
        self.texture: Array | None = None
        self.variance = np.ones((len(views), self.patches))
        self.expected = np.ones((len(views), self.patches))

    def normal_equations(self, H: Array, H_d: Array, relief: Array, dH: Array) -> tuple[Array, Array]:
        """Normal matrices (patches, P + 1, P + 1) and scores (views, patches, P + 1) of the linearised problem.

        ``H``, ``H_d`` (all views, 3, 3); ``relief`` (patches,) metres; ``dH`` (all views, 3, 3, P) the derivatives.
        The last column is each patch's own relief.
        """
        M, r = self._linearised(H, H_d, relief)
        V, K, m = r.shape
        columns = np.concatenate([dH[self.views], H_d[self.views][..., None]], axis=-1).reshape(V, 9, -1)
        J = (M.reshape(V, K * m, 9) @ columns.astype(np.float32)).reshape(V, K, m, -1)
        w = (self.weights * self.gain**2).astype(np.float32)
        # the shared texture moves along with the parameters: what all views have in common tells nothing
        J -= np.einsum("vk,vkmp->kmp", w, J, optimize=True) / np.maximum(w.sum(0), 1e-12)[:, None, None]
        Jw = J * w[:, :, None, None]
        by_patch = [np.moveaxis(a, 1, 0).reshape(K, V * m, -1) for a in (Jw, J)]
        A = by_patch[0].swapaxes(1, 2) @ by_patch[1]
        return A.astype(float), (Jw.swapaxes(2, 3) @ r[..., None])[..., 0].astype(float)

    def offsets(self, H: Array, H_d: Array, relief: Array) -> Array:
        """By how many pixels (views, 2) each view's picture lies off where the motion puts it."""
        M, r = self._linearised(H, H_d, relief)
        V, K, m = r.shape
        shifts = np.zeros((V, 3, 3, 2))
        shifts[:, 0, :, 0] = shifts[:, 1, :, 1] = H[self.views][:, 2]
        J = (M.reshape(V, K * m, 9) @ shifts.reshape(V, 9, 2).astype(np.float32)).reshape(V, K, m, 2)
        Jw = (J * (self.weights * self.gain**2).astype(np.float32)[:, :, None, None]).reshape(V, K * m, 2)
        A = Jw.swapaxes(1, 2) @ J.reshape(V, K * m, 2)
        score = Jw.swapaxes(1, 2) @ r.reshape(V, K * m, 1)
        return np.asarray(-np.linalg.solve(A.astype(float) + 1e-6 * np.eye(2), score.astype(float))[..., 0])

    def _linearised(self, H: Array, H_d: Array, relief: Array) -> tuple[Floats, Floats]:
        """∂I/∂H (views, patches, samples, 9) free of gain and offset, and the residuals (views, patches, samples)."""
        V, K, m = len(self.views), self.patches, self.samples
        H, H_d = H[self.views], H_d[self.views]
        X = H @ self.places + (H_d @ self.places) * np.repeat(relief, m)
        z = X[:, 2]
        x = X[:, :2] / z[:, None]
        B = (H[:, :2, :2, None] - x[:, :, None] * H[:, 2, :2][:, None, :, None]) / z[:, None, None]
        I, slope, laplacian = self._sampled(x, B)
        I -= I.mean(-1, keepdims=True)
        T = self._share_texture(I)
        # the texture's own slope, averaged over the views: the noise of a single view's slope would bias the step
        w = self.weights * self.gain
        mean_slope = np.einsum("vk,vckm->ckm", w, slope.reshape(V, 2, K, m), optimize=True)
        g = (mean_slope / np.maximum((w * self.gain).sum(0), 1e-12)[:, None]).reshape(2, -1)
        det = (B[:, 0, 0] * B[:, 1, 1] - B[:, 0, 1] * B[:, 1, 0]) * z
        ax = (g[0] * B[:, 1, 1] - g[1] * B[:, 1, 0]) / det
        ay = (g[1] * B[:, 0, 0] - g[0] * B[:, 0, 1]) / det
        c = np.stack([ax, ay, -(ax * x[:, 0] + ay * x[:, 1])], axis=1)
        M = (c[:, :, None] * self.places).reshape(V, 9, K, m)
        M = np.ascontiguousarray(np.moveaxis(M, 1, -1), np.float32)
        M -= M.mean(2, keepdims=True)
        along = (T / np.maximum((T * T).sum(-1, keepdims=True), 1e-9)).astype(np.float32)
        M -= (along[None, :, None] @ M) * T.astype(np.float32)[None, :, :, None]
        r = (I / self.gain[..., None] - T).astype(np.float32)
        # a view's own blur, which no model of the optics gets right, shows as a share of the texture's Laplacian;
        # left in, it passes for a change of scale
        blur = np.einsum("vk,vkm->km", w, laplacian)
        blur -= blur.mean(-1, keepdims=True)
        blur -= (blur * along).sum(-1, keepdims=True) * T
        blur = (blur / np.sqrt(np.maximum((blur * blur).sum(-1, keepdims=True), 1e-12))).astype(np.float32)
        r -= (r * blur).sum(-1, keepdims=True) * blur
        M -= (blur[None, :, None] @ M) * blur[None, :, :, None]
        self._reweigh((r * r).mean(-1) * self.gain**2)
        return M, r

    def _sampled(self, x: Array, B: Array) -> tuple[Array, Array, Array]:
        """Intensities (V, K, m) at ``x`` (V, 2, N), their slopes (V, 2, N) over the unit square, their Laplacians."""
        I, laplacian = np.empty((2, len(x), x.shape[2]))
        slope = np.empty((len(x), 2, x.shape[2]))
        for v, pictures in enumerate(self.pictures):
            at = (x[v] - self.corners[v][:, None]).astype(np.float32).reshape(2, self.patches, -1)
            values = [
                cv2.remap(p, at[0], at[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).ravel()
                for p in pictures
            ]
            I[v] = values[0]
            slope[v] = values[1] * B[v, 0] + values[2] * B[v, 1]
            laplacian[v] = values[3]
        shape = len(x), self.patches, self.samples
        return I.reshape(shape), slope, laplacian.reshape(shape)

    def _share_texture(self, I: Array) -> Array:
        """The texture (K, m) that all views share; it and each view's gain (V, K) by alternation from the last ones."""
        T = I.mean(0) if self.texture is None else self.texture
        for _ in range(3):
            own = np.maximum((T * T).sum(-1), 1e-9)
            self.gain = np.clip(np.einsum("vkm,km->vk", I, T) / own, *GAIN)
            w = self.weights * self.gain
            T = np.einsum("vk,vkm->km", w, I) / np.maximum((w * self.gain).sum(0), 1e-12)[:, None]
        self.texture = T
        return T

    def _reweigh(self, variance: Array) -> None:
        """Geman–McClure weights of views' patches, against what each view and each patch usually leaves over."""
        overall = np.median(variance) + 1e-3
        self.expected = np.maximum(np.median(variance, axis=1)[:, None], 0.05 * overall) * np.maximum(
            np.median(variance, axis=0), 0.05 * overall
        ) / overall + 0.02
        self.variance = variance
        self.weights = 1.0 / (CORRELATED * self.expected) / (1.0 + variance / (REJECT * self.expected)) ** 2


def refine(
    rig: StereoRig, trajectory: Trajectory, glimpses: list[Glimpse], speed: float, on_path: bool
) -> Refined:
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
        fit.systematic(rig.uncertainty),
        fit.residual,
        fit.contrast,
        fit.share,
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
        self.theta = self._from_filter() if start is None else start.theta.copy()
        self.relief = np.zeros(0) if start is None else start.relief.copy()
        for smoothing, fine in LEVELS if start is None else LEVELS[-1:]:
            self.bands = self._bands(smoothing, fine)
            if len(self.relief) != self.bands[0].patches:
                self.relief = np.zeros(self.bands[0].patches)
            for _ in range(10):
                A, score, per_view = self._assemble()
                change = -np.linalg.solve(A, score)
                P = len(prior.free)
                self.theta[prior.free] += change[:P]
                self.relief += change[P:]
                step = float(np.abs(change[:P] / np.sqrt(np.diag(np.linalg.inv(A))[:P])).max())
                if step < STEP:
                    break
        self.converged = step < 1.0
        self.A = A
        self._summarise(per_view)

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

    def _bands(self, smoothing: float, fine: bool) -> list[_Band]:
        quads = self.trajectory.quads(self.theta).reshape(-1, 4, 2)
        scale = np.sqrt(_areas(quads))
        crops = [c for g in self.glimpses for c in g.crops]
        corners = np.concatenate([g.corners for g in self.glimpses])
        usable = np.array([_covers(c, o, q) for c, o, q in zip(crops, corners, quads, strict=True)])
        if usable.sum() < 4:
            raise np.linalg.LinAlgError("fewer than four views hold the whole region")
        smallest = scale[usable].min()
        size = _sides(quads[usable][np.argmin(scale[usable])])
        count = 1 + (int(np.log(scale[usable].max() / smallest) / np.log(BAND) + 1e-6) if fine else 0)
        bands = []
        for b in range(count):
            resolution = smallest * BAND**b
            views = np.flatnonzero(usable & (scale >= 0.999 * resolution))
            if len(views) < 4:
                break
            pictures = []
            for v in views:
                picture = cv2.GaussianBlur(crops[v], (0, 0), _blur(smoothing, scale[v] / resolution))
                if b > 0:
                    picture = picture - cv2.GaussianBlur(crops[v], (0, 0), _blur(smoothing, scale[v] / resolution * BAND))
                pictures.append(_derivatives(np.asarray(picture, np.float32)))
            bands.append(_Band(views, pictures, corners[views], size * BAND**b))
        return bands

    def _derivatives(self, trajectory: Trajectory, index: NDArray[np.int64]) -> Array:
        """∂H/∂θ (views, 3, 3, len(index)) by central differences."""
        columns = []
        for i in index:
            e = np.zeros(len(STEPS))
            e[i] = STEPS[i]
            difference = trajectory.homographies(self.theta + e)[0] - trajectory.homographies(self.theta - e)[0]
            columns.append(difference.reshape(-1, 3, 3) / (2 * STEPS[i]))
        return np.stack(columns, axis=-1)

    def _assemble(self) -> tuple[Array, Array, Array]:
        """The normal matrix and score over free parameters and relief, and every view's and patch's own score."""
        p = self.prior
        P, K = len(p.free), len(self.relief)
        n = P + K
        A, score = np.zeros((n, n)), np.zeros(n)
        A[:P, :P] = p.information
        score[:P] = p.information @ (self.theta - p.mean)[p.free]
        patch = np.arange(P, n)
        A[patch, patch] = 1.0 / RELIEF**2
        score[P:] = self.relief / RELIEF**2
        H, H_d = (h.reshape(-1, 3, 3) for h in self.trajectory.homographies(self.theta))
        dH = self._derivatives(self.trajectory, p.free)
        per_view = np.zeros((len(H), K, n))
        for band in self.bands:
            a, s = band.normal_equations(H, H_d, self.relief, dH)
            A[:P, :P] += a[:, :P, :P].sum(0)
            A[P:, :P] += a[:, P, :P]
            A[:P, P:] += a[:, P, :P].T
            A[patch, patch] += a[:, P, P]
            score[:P] += s[..., :P].sum((0, 1))
            score[P:] += s[..., P].sum(0)
            per_view[band.views, :, :P] += s[..., :P]
            per_view[band.views[:, None], np.arange(K), patch] += s[..., P]
        return A, score, per_view

    def _summarise(self, per_view: Array) -> None:
        """Covariance from how the scores of frames and of patches really scatter, not from the pixels' noise.

        Errors that a patch repeats in every frame and that a frame makes in every patch do not average out over
        pixels: the scores are summed within each before they are squared (a sandwich estimate, clustered both ways).
        """
        P, K = len(self.prior.free), len(self.relief)
        inverse = np.linalg.inv(self.A)
        by_frame = per_view.reshape(-1, 2 * K, per_view.shape[-1]).sum(1)
        by_patch = per_view.sum(0)
        cells = per_view.reshape(-1, per_view.shape[-1])
        F = len(by_frame)
        scatter = [
            by_frame.T @ by_frame * F / max(F - 1, 1),
            by_patch.T @ by_patch * K / max(K - 1, 1),
            cells.T @ cells,
        ]
        prior_part = np.zeros_like(self.A)
        prior_part[:P, :P] = self.prior.information
        prior_part[range(P, P + K), range(P, P + K)] = 1.0 / RELIEF**2
        candidates = [(inverse @ (B + prior_part) @ inverse)[:P, :P] for B in scatter]
        speed = list(self.prior.free).index(INDEX["speed"])
        self.covariance = max(candidates, key=lambda C: float(C[speed, speed]))
        self.dof = float(min(F, K) - 1)
        base = self.bands[0]
        self.residual = float(np.sqrt(np.median(base.variance)))
        self.share = float((base.variance < REJECT * base.expected).mean())
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
        spread = float(np.sqrt(self.covariance[i, i])) * SAFETY
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
        dH = np.concatenate([self._derivatives(self.trajectory, p.free), np.stack(changes, axis=-1)], axis=-1)
        coupling = np.zeros((P + K, Q))
        for band in self.bands:
            a, _ = band.normal_equations(H, H_d, self.relief, dH)
            coupling[:P] += a[:, :P, P : P + Q].sum(0)
            coupling[P:] += a[:, P + Q, P : P + Q]
        response = np.zeros((n, Q))
        response[p.free] = -np.linalg.solve(self.A, coupling)[:P]
        return np.asarray(response @ response.T)


SAFETY = 1.5  # a richer model must explain more than the covariance's own error
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


def _blur(smoothing: float, ratio: float) -> float:
    """σ in px that brings a view of ``ratio`` times the resolution down to it, ``smoothing`` px there included."""
    return float(np.sqrt(max((OPTICS**2 + smoothing**2) * ratio**2 - OPTICS**2, 0.3**2)))


def _derivatives(picture: Floats) -> tuple[Floats, ...]:
    """``picture``, its slopes along x and y, and its Laplacian."""
    along = [cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in (SLOPE, SLOPE.T)]
    laplacian = cv2.Laplacian(picture, cv2.CV_32F, borderType=cv2.BORDER_REPLICATE)
    return picture, *(np.asarray(a, np.float32) for a in (*along, laplacian))


def _areas(quads: Array) -> Array:
    x, y = quads[..., 0], quads[..., 1]
    return np.abs(0.5 * (x * np.roll(y, -1, -1) - y * np.roll(x, -1, -1)).sum(-1))


def _sides(quad: Array) -> Array:
    """Mean width and height (2,) of a quadrilateral (4, 2)."""
    d = np.linalg.norm(np.roll(quad, -1, 0) - quad, axis=1)
    return np.array([d[0] + d[2], d[1] + d[3]]) / 2


def _covers(crop: Floats, corner: Array, quad: Array) -> bool:
    """Whether ``crop`` holds all of ``quad`` (4, 2)."""
    inner = quad - corner
    return bool((inner >= 0).all() and (inner <= np.array(crop.shape[::-1]) - 1).all())
