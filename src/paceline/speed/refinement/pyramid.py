"""Image pyramid for the photometric fit: one resolution per level, in patches on a grid of the plane's region.

An approaching vehicle shows more detail than it did far away. The first level holds the resolution of the farthest
view; each further one is a band-pass of the finer detail, for the views that resolve it. A lens blurs light, not grey
values, so near views are blurred in linear light to match the far ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Floats
from paceline.speed.refinement import pyramid_cpu, view_dependence
from paceline.speed.refinement.keyframes import Keyframe

OPTICAL_BLUR_PX = 0.8  # typical blur of lens and pixel; the difference is fitted
GAMMA_STEP = 0.02  # step of γ for the derivative
LEVEL_RATIO = 1.5  # ratio of the resolutions of two levels
SAMPLES_PER_PIXEL = 1.3  # samples per pixel of a level's coarsest view
LEVEL_RIM_PX = 1.5  # rim in pixels of a level's coarsest view that is left out, as it may show the background
GEMAN_MCCLURE_SCALE = 4.0  # scale of the squared residual, in expected variances
MAX_VARIANCE_RATIO = 9.0  # ratio to the expected variance above which a patch of a view is assumed to be occluded
PATCH_GAIN_RANGE = (0.2, 5.0)
ROWS_PER_PATCH = 3  # rows with a depth offset each, as edges of bumpers and windows run through patches
BLUR_CORRELATED_SAMPLES = 12.0  # number of samples that share their noise, by blur and dense sampling
MIN_LEVEL_VIEWS = 4
SLOPE_KERNEL = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]], np.float32) / 12


@dataclass(frozen=True)
class PatchGrid:
    """About ``patches`` patches over the central ``share`` of an outline's width and height."""

    patches: int = 15
    share: tuple[float, float] = (1.0, 1.0)


WHOLE_OUTLINE = PatchGrid()


class PyramidLevel:
    """One level: its views, their filtered crops with derivatives, and the shared texture.

    ``size`` (2,) px is the outline's size in the coarsest of the ``views``; ``origins`` (V, 2) are the crops' first
    pixels.
    """

    def __init__(
        self,
        views: NDArray[np.int64],
        images: list[tuple[Floats, Floats]],
        gamma: float,
        origins: Array,
        size: Array,
        grid: PatchGrid = WHOLE_OUTLINE,
    ) -> None:
        self.size = size
        w, h = size * grid.share
        down = max(1, round(np.sqrt(grid.patches * h / w)))
        across = max(1, round(grid.patches / down))
        x = max(int(np.ceil(w * SAMPLES_PER_PIXEL / across)), 4)
        y = max(int(np.ceil(h * SAMPLES_PER_PIXEL / down)), 4)
        within = (1 - 2 * np.clip(LEVEL_RIM_PX / size, 0.03, 0.2)) * grid.share
        u = 0.5 + within[0] * ((np.arange(across * x) + 0.5) / (across * x) - 0.5)
        v = 0.5 + within[1] * ((np.arange(down * y) + 0.5) / (down * y) - 0.5)
        samples = np.stack([*np.meshgrid(u, v), np.ones((down * y, across * x))])
        patches = samples.reshape(3, down, y, across, x).swapaxes(2, 3)
        self.patches, self.samples, self.columns = down * across, y * x, across
        self.points = patches.reshape(3, -1)
        self.ramps = self.points[:2].reshape(2, self.patches, self.samples)
        rows = (2 * np.arange(y) + 1) * ROWS_PER_PATCH // (2 * y)
        self.rows = np.repeat(rows == np.arange(ROWS_PER_PATCH)[:, None], x, axis=1).astype(np.float32)
        self.views = views
        self.images = images
        self.gamma = gamma
        self.origins = origins
        self.sample_weights = np.ones((self.patches, self.samples))
        self.robust_weights = np.ones((len(views), self.patches))
        self.gain = np.ones((len(views), self.patches))
        self.texture: Array | None = None
        self.variance = np.ones((len(views), self.patches))
        self.expected_variance = np.ones((len(views), self.patches))
        self.image_variance = np.ones((len(views), self.patches))  # weighted, gain and offset removed
        self.residual_variance = np.ones((len(views), self.patches))  # the part of it that the motion does not explain

    def on_grid(self, grid: PatchGrid) -> PyramidLevel:
        """The same images on another patch ``grid``."""
        return PyramidLevel(self.views, self.images, self.gamma, self.origins, self.size, grid)

    def normal_equations(
        self, H: Array, H_d: Array, depth_offsets: Array, gamma: float, dH: Array, directions: Array | None = None
    ) -> tuple[Array, Array]:
        """Normal matrices (views, patches, n, n) and scores (views, patches, n) of the linearised problem.

        ``H``, ``H_d`` (all views, 3, 3) are homographies and their derivative by the plane's distance;
        ``depth_offsets`` (patches, ROWS_PER_PATCH) m; ``gamma`` the camera's; ``dH`` (all views, 3, 3, P) the
        derivatives by the parameters; ``directions`` (all views, 3) to the cameras, for view-dependent appearance. The
        n = P + 1 + ROWS_PER_PATCH columns end with γ and the patch's own depth offsets.
        """
        M, r = self._linearise(H, H_d, depth_offsets, gamma)
        (V, K), P = r.shape[:2], dH.shape[-1]
        by_H = np.ascontiguousarray(dH[self.views].reshape(V, 9, P).swapaxes(1, 2), np.float32)
        weights = self._patch_weights
        if directions is None:
            whitening = view_dependence.centering(weights)
        else:
            visible = self.variance < MAX_VARIANCE_RATIO * self.expected_variance
            whitening = view_dependence.whitening(r, np.where(visible, weights, 0.0), directions[self.views])
        score = np.empty((V, K, P + 1 + ROWS_PER_PATCH))
        A = np.empty((*score.shape, score.shape[-1]))
        by_patch = np.ascontiguousarray(r.swapaxes(0, 1))
        pyramid_cpu.normal_equations(M, by_H, np.ascontiguousarray(whitening, np.float32), by_patch, A, score)
        return A, score

    def residual_offsets(self, H: Array, H_d: Array, depth_offsets: Array, gamma: float) -> tuple[Array, Array]:
        """Each view's image offset (views, 2) px from where the motion puts it, and the share (views,) of its weighted
        variance that the motion explains."""
        M, r = self._linearise(H, H_d, depth_offsets, gamma)
        V, K, m = r.shape
        shifts = np.zeros((V, 3, 3, 2))
        shifts[:, 0, :, 0] = shifts[:, 1, :, 1] = H[self.views][:, 2]
        J = np.swapaxes(shifts.reshape(V, 9, 2), 1, 2)[:, None].astype(np.float32) @ M[:, :, :9]
        Jw = J * self._patch_weights.astype(np.float32)[:, :, None, None]
        A = (Jw @ J.swapaxes(2, 3)).sum(1)
        score = (Jw @ r[..., None]).sum(1)
        offsets = -np.linalg.solve(A.astype(float) + 1e-6 * np.eye(2), score.astype(float))[..., 0]
        unexplained = self.residual_variance.sum(1) / np.maximum(self.image_variance.sum(1), 1e-9)
        return np.asarray(offsets), np.asarray(1.0 - unexplained)

    def patch_variances(self) -> tuple[Array, Array]:
        """The variance of the images (rows, columns) in the patches, and the part of it that the motion does not
        explain (rows, columns), both in the median view."""
        image, residual = (np.median(v, axis=0) for v in (self.image_variance, self.residual_variance))
        return image.reshape(-1, self.columns), residual.reshape(-1, self.columns)

    @property
    def _patch_weights(self) -> Array:
        """Weight (V, K) of each patch of each view in the fit to the texture."""
        return np.asarray(self.robust_weights * self.gain**2)

    def _linearise(self, H: Array, H_d: Array, depth_offsets: Array, gamma: float) -> tuple[Floats, Floats]:
        """Jacobian (views, patches, 9 + ROWS_PER_PATCH + 1, samples) and residuals (views, patches, samples), weighted.

        The Jacobian's rows are ∂I/∂H, those by the depth offsets and, last, ∂I/∂γ; gain and offset are projected out.
        """
        V, K, m = len(self.views), self.patches, self.samples
        H, H_d = H[self.views], H_d[self.views]
        X = H @ self.points + (H_d @ self.points) * (depth_offsets @ self.rows).ravel()
        z = X[:, 2]
        x = X[:, :2] / z[:, None]
        B = (H[:, :2, :2, None] - x[:, :, None] * H[:, 2, :2][:, None, :, None]) / z[:, None, None]
        I, slope, laplacian, by_gamma = self._sample(x, B)
        root = np.sqrt(self.sample_weights)
        constant = root / np.linalg.norm(root, axis=-1, keepdims=True)
        I = root * (I + (gamma - self.gamma) * by_gamma)
        I -= (I * constant).sum(-1, keepdims=True) * constant
        self.image_variance = (I * I).mean(-1)
        T = self._estimate_texture(I, root)
        # the slope of the texture, averaged over the views, as noise in a single view's slope would bias the step
        w = self.robust_weights * self.gain
        mean_slope = np.einsum("vk,vckm->ckm", w, slope.reshape(V, 2, K, m), optimize=True)
        g = (root * mean_slope / np.maximum((w * self.gain).sum(0), 1e-12)[:, None]).reshape(2, -1)
        along = _orthogonalised(T, [constant])
        r = (I / self.gain[..., None] - T).astype(np.float32)
        # a view's own blur, proportional to the texture's Laplacian, would pass for a change of scale
        blur = _orthogonalised(root * np.einsum("vk,vkm->km", w, laplacian), [constant, along])
        r -= (r * blur).sum(-1, keepdims=True) * blur
        nuisance, known = [constant, along, blur], [constant, along, blur]
        # so would an illumination ramp over a patch; only the part that noise does not explain is removed, to keep
        # information
        noise = BLUR_CORRELATED_SAMPLES * np.median((r * r).mean(-1), axis=0)
        for ramp in self.ramps:
            ramp = _orthogonalised(root * ramp, known)
            known.append(ramp)
            share = (r * ramp).sum(-1)
            removed = 1.0 - np.sqrt(np.minimum(noise / np.maximum((share**2).mean(0), 1e-9), 1.0))
            r -= (removed * share)[..., None] * ramp
            nuisance.append(np.sqrt(removed)[:, None] * ramp)
        M = np.empty((V, K, 9 + ROWS_PER_PATCH + 1, m), np.float32)
        M[:, :, -1] = root * by_gamma / self.gain[..., None]
        fields = np.stack(nuisance).astype(np.float32)
        pyramid_cpu.linearise(x, z, B, self.points, g, H_d.reshape(V, 9), self.rows, fields, M)
        self.residual_variance = (r * r).mean(-1) * self.gain**2
        self._update_weights(np.square(r / root))
        return M, r

    def _sample(self, x: Array, B: Array) -> tuple[Array, Array, Array, Array]:
        """Grey values (V, K, m) at ``x`` (V, 2, N), slopes (V, 2, N) over the unit square, Laplacians, ∂/∂γ."""
        I, laplacian, by_gamma = np.empty((3, len(x), x.shape[2]))
        slope = np.empty((len(x), 2, x.shape[2]))
        for v, (image, change) in enumerate(self.images):
            pixel_maps = (x[v] - self.origins[v][:, None]).astype(np.float32).reshape(2, self.patches, -1)
            sampled = cv2.remap(image, pixel_maps[0], pixel_maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            values = sampled.reshape(-1, 4).T
            I[v] = values[0]
            slope[v] = values[1] * B[v, 0] + values[2] * B[v, 1]
            laplacian[v] = values[3]
            by_gamma[v] = cv2.remap(
                change, pixel_maps[0], pixel_maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            ).ravel()
        shape = len(x), self.patches, self.samples
        return I.reshape(shape), slope, laplacian.reshape(shape), by_gamma.reshape(shape)

    def _estimate_texture(self, I: Array, root: Array) -> Array:
        """The texture (K, m) of all views, times ``root`` (K, m), and each view's gain (V, K), by alternation."""
        T = I.mean(0) if self.texture is None else root * self.texture
        for _ in range(3):
            texture_power = np.maximum((T * T).sum(-1), 1e-9)
            self.gain = np.clip(np.einsum("vkm,km->vk", I, T) / texture_power, *PATCH_GAIN_RANGE)
            w = self.robust_weights * self.gain
            T = np.einsum("vk,vkm->km", w, I) / np.maximum((w * self.gain).sum(0), 1e-12)[:, None]
        # gains and texture are determined up to a factor: set the mean gain to 1
        mean_gain = np.sqrt((self.robust_weights * self.gain**2).sum(0) / np.maximum(self.robust_weights.sum(0), 1e-12))
        self.gain = self.gain / mean_gain
        self.texture = mean_gain[:, None] * T / root
        return np.asarray(mean_gain[:, None] * T)

    def _update_weights(self, squares: Array) -> None:
        """Update the weights from the squared residuals ``squares`` (V, K, m).

        Patches of views get Geman–McClure weights, relative to the usual residual of the view and of the patch. Samples
        are down-weighted where the views differ more than elsewhere, as reflections on the vehicle do; they still
        count in their patch's variance, as such errors are correlated between views and do not average out.
        """
        variance = squares.mean(-1) * self.gain**2
        overall = np.median(variance) + 1e-3
        self.expected_variance = (
            np.maximum(np.median(variance, axis=1)[:, None], 0.05 * overall)
            * np.maximum(np.median(variance, axis=0), 0.05 * overall)
            / overall
            + 0.02
        )
        weights = self._patch_weights
        by_sample = np.einsum("vk,vkm->km", weights, squares, optimize=True)
        by_sample = by_sample / np.maximum(weights.sum(0), 1e-12)[:, None]
        self.sample_weights = 1.0 / (1.0 + by_sample / (np.median(by_sample) + 1e-3))
        self.variance = variance
        damping = (1.0 + variance / (GEMAN_MCCLURE_SCALE * self.expected_variance)) ** 2
        self.robust_weights = 1.0 / (BLUR_CORRELATED_SAMPLES * self.expected_variance) / damping


def build_levels(
    keyframes: list[Keyframe], quads: Array, gamma: float, smoothing: float, fine: bool
) -> list[PyramidLevel]:
    """The pyramid levels of ``keyframes`` with regions ``quads`` (F, 2, 4, 2) px; only the first unless ``fine``.

    Light is grey values to the power ``gamma``; ``smoothing`` (px) is at the coarsest view. Raises
    numpy.linalg.LinAlgError where too few views hold the whole region.
    """
    quads = quads.reshape(-1, 4, 2)
    scale = np.sqrt(areas(quads))
    crops = [c for k in keyframes for c in k.crops]
    origins = np.concatenate([k.origins for k in keyframes])
    usable = np.array([keyframes[v // 2].holds(v % 2, quad).all() for v, quad in enumerate(quads)])
    if usable.sum() < MIN_LEVEL_VIEWS:
        raise np.linalg.LinAlgError(f"fewer than {MIN_LEVEL_VIEWS} views hold the whole region")
    smallest = scale[usable].min()
    size = _sides(quads[usable][np.argmin(scale[usable])])
    count = 1 + (int(np.log(scale[usable].max() / smallest) / np.log(LEVEL_RATIO) + 1e-6) if fine else 0)
    levels = []
    for b in range(count):
        resolution = smallest * LEVEL_RATIO**b
        views = np.flatnonzero(usable & (scale >= 0.999 * resolution))
        if len(views) < MIN_LEVEL_VIEWS:
            break
        images = []
        for v in views:
            ratio = scale[v] / resolution
            blurs = [_blur_sigma(smoothing, r) for r in ((ratio, LEVEL_RATIO * ratio) if b > 0 else (ratio,))]
            image, ahead = (band_pass(crops[v], blurs, gamma + step) for step in (0.0, GAMMA_STEP))
            images.append((_derivatives(image), (ahead - image) / GAMMA_STEP))
        levels.append(PyramidLevel(views, images, gamma, origins[views], size * LEVEL_RATIO**b))
    return levels


def _orthogonalised(field: Array, known: list[Array]) -> Array:
    """The part of ``field`` (patches, samples) orthogonal to the ``known`` unit fields, normalised to length 1."""
    residual = np.array(field)
    for other in known:
        residual -= (residual * other).sum(-1, keepdims=True) * other
    return np.asarray(residual / np.sqrt(np.maximum((residual * residual).sum(-1, keepdims=True), 1e-12)))


def band_pass(image: Floats, blurs: list[float], gamma: float) -> Floats:
    """``image`` blurred by the first of the ``blurs`` (px), less that blurred by the second one where there is one.

    The blur is in linear light, grey values to the power ``gamma``.
    """
    values = np.maximum(image, 0.0)  # cubic interpolation while undistorting may undershoot
    light = cv2.pow(values, gamma)
    blurred = (cv2.pow(cv2.GaussianBlur(light, (0, 0), sigma), 1.0 / gamma) for sigma in blurs)
    return np.asarray(reduce(np.subtract, blurred), np.float32)


def _blur_sigma(smoothing: float, ratio: float) -> float:
    """σ (px) that reduces a view of ``ratio`` times the resolution to a level, with ``smoothing`` px there."""
    return float(np.sqrt(max((OPTICAL_BLUR_PX**2 + smoothing**2) * ratio**2 - OPTICAL_BLUR_PX**2, 0.3**2)))


def _derivatives(image: Floats) -> Floats:
    """``image``, its slopes along x and y, and its Laplacian (H, W, 4)."""
    along = [
        cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in (SLOPE_KERNEL, SLOPE_KERNEL.T)
    ]
    laplacian = cv2.Laplacian(image, cv2.CV_32F, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.merge([image, *along, laplacian]), np.float32)


def areas(quads: Array) -> Array:
    """Areas (…) of quadrilaterals (…, 4, 2)."""
    x, y = quads[..., 0], quads[..., 1]
    return np.asarray(np.abs(0.5 * (x * np.roll(y, -1, -1) - y * np.roll(x, -1, -1)).sum(-1)))


def _sides(quad: Array) -> Array:
    """Mean width and height (2,) of a quadrilateral (4, 2)."""
    d = np.linalg.norm(np.roll(quad, -1, 0) - quad, axis=1)
    return np.array([d[0] + d[2], d[1] + d[3]]) / 2
