"""The pictures that the refinement compares: one band of resolution each, in patches, on the plane's own grid.

A vehicle that comes near shows finer detail than it did far away. The first band holds what even the farthest view
resolves; each further one the finer detail of the views that resolve it. The far view was blurred by its lens, which
blurs light; so the near ones are blurred as light to match it, not as the values of their pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Floats
from paceline.speed.refinement import pyramid_cpu, view_dependence
from paceline.speed.refinement.keyframes import Glimpse

OPTICS = 0.8  # px, the blur of lens and pixel that most images have; what is left is fitted
GAMMA_STEP = 0.02
BAND = 1.5  # ratio of resolutions between bands
DENSITY = 1.3  # samples per pixel of the coarsest view in a band
INSET = 1.5  # px of a band's coarsest view: the rim shows what is behind
REJECT = 4.0  # times the expected variance at which a patch loses half its say
HIDDEN = 9.0  # the same, at which it has a tenth of the usual say: it shows something else
GAIN = (0.2, 5.0)
STRIPS = 3  # of a patch, one above the other: a bumper's edge or a window's runs through many a patch
CORRELATED = 12.0  # samples that share their noise, by blur and by sampling more densely than the pixels
LEAST_VIEWS = 4
SLOPE = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]], np.float32) / 12


@dataclass(frozen=True)
class Layout:
    """Into about how many ``patches`` the middle of an outline is divided, and which ``share`` of its width and height
    that is."""

    patches: int = 15
    share: tuple[float, float] = (1.0, 1.0)


WHOLE = Layout()


class Band:
    """One band of resolution: the views that resolve it, their filtered crops and slopes, and its texture.

    ``size`` (2,) px is that of the outline in the coarsest of the ``views``.
    """

    def __init__(
        self,
        views: NDArray[np.int64],
        pictures: list[tuple[Floats, Floats]],
        gamma: float,
        corners: Array,
        size: Array,
        layout: Layout = WHOLE,
    ) -> None:
        self.size = size
        w, h = size * layout.share
        down = max(1, round(np.sqrt(layout.patches * h / w)))
        across = max(1, round(layout.patches / down))
        x = max(int(np.ceil(w * DENSITY / across)), 4)
        y = max(int(np.ceil(h * DENSITY / down)), 4)
        within = (1 - 2 * np.clip(INSET / size, 0.03, 0.2)) * layout.share
        u = 0.5 + within[0] * ((np.arange(across * x) + 0.5) / (across * x) - 0.5)
        v = 0.5 + within[1] * ((np.arange(down * y) + 0.5) / (down * y) - 0.5)
        grid = np.stack([*np.meshgrid(u, v), np.ones((down * y, across * x))])
        patches = grid.reshape(3, down, y, across, x).swapaxes(2, 3)
        self.patches, self.samples = down * across, y * x
        self.places = patches.reshape(3, -1)
        self.ramps = self.places[:2].reshape(2, self.patches, self.samples)
        rows = (2 * np.arange(y) + 1) * STRIPS // (2 * y)
        self.strips = np.repeat(rows == np.arange(STRIPS)[:, None], x, axis=1).astype(np.float32)
        self.views = views
        self.pictures = pictures
        self.gamma = gamma
        self.corners = corners
        self.trust = np.ones((self.patches, self.samples))
        self.weights = np.ones((len(views), self.patches))
        self.gain = np.ones((len(views), self.patches))
        self.texture: Array | None = None
        self.variance = np.ones((len(views), self.patches))
        self.expected = np.ones((len(views), self.patches))
        self.power = np.ones((len(views), self.patches))  # of what is seen, as much as it is trusted
        self.unexplained = np.ones((len(views), self.patches))  # what of that no motion explains

    def laid_out(self, layout: Layout) -> Band:
        """The same pictures in patches of another ``layout``."""
        return Band(self.views, self.pictures, self.gamma, self.corners, self.size, layout)

    def normal_equations(
        self, H: Array, H_d: Array, relief: Array, gamma: float, dH: Array, directions: Array | None = None
    ) -> tuple[Array, Array]:
        """Normal matrices (views, patches, n, n) and scores (views, patches, n) of the linearised problem, n = P + 1 +
        STRIPS.

        ``H``, ``H_d`` (all views, 3, 3); ``relief`` (patches, STRIPS) metres; ``gamma`` of the camera; ``dH`` (all
        views, 3, 3, P) the derivatives; ``directions`` (all views, 3) from which they are seen, where what the face
        shows may drift with these. The last columns are γ and each patch's own relief.
        """
        M, r = self._linearised(H, H_d, relief, gamma)
        (V, K), P = r.shape[:2], dH.shape[-1]
        by_H = np.ascontiguousarray(dH[self.views].reshape(V, 9, P).swapaxes(1, 2), np.float32)
        say = self._say
        if directions is None:
            white = view_dependence.centred(say)
        else:
            shown = self.variance < HIDDEN * self.expected
            white = view_dependence.whitened(r, np.where(shown, say, 0.0), directions[self.views])
        score = np.empty((V, K, P + 1 + STRIPS))
        A = np.empty((*score.shape, score.shape[-1]))
        by_patch = np.ascontiguousarray(r.swapaxes(0, 1))
        pyramid_cpu.normal_equations(M, by_H, np.ascontiguousarray(white, np.float32), by_patch, A, score)
        return A, score

    def agreement(self, H: Array, H_d: Array, relief: Array, gamma: float) -> tuple[Array, Array]:
        """By how many pixels (views, 2) each view's picture lies off where the motion puts it, and what share (views,)
        of its contrast, squared, the motion explains, as far as each place is trusted."""
        M, r = self._linearised(H, H_d, relief, gamma)
        V, K, m = r.shape
        shifts = np.zeros((V, 3, 3, 2))
        shifts[:, 0, :, 0] = shifts[:, 1, :, 1] = H[self.views][:, 2]
        J = np.swapaxes(shifts.reshape(V, 9, 2), 1, 2)[:, None].astype(np.float32) @ M[:, :, :9]
        Jw = J * self._say.astype(np.float32)[:, :, None, None]
        A = (Jw @ J.swapaxes(2, 3)).sum(1)
        score = (Jw @ r[..., None]).sum(1)
        off = -np.linalg.solve(A.astype(float) + 1e-6 * np.eye(2), score.astype(float))[..., 0]
        return np.asarray(off), np.asarray(1.0 - self.unexplained.sum(1) / np.maximum(self.power.sum(1), 1e-9))

    @property
    def _say(self) -> Array:
        """What each patch of each view (V, K) counts for in the fit to the texture."""
        return np.asarray(self.weights * self.gain**2)

    def _linearised(self, H: Array, H_d: Array, relief: Array, gamma: float) -> tuple[Floats, Floats]:
        """∂I/∂H, over each strip's relief and, last, ∂I/∂γ (views, patches, 9 + STRIPS + 1, samples) free of gain and
        offset, and the residuals (views, patches, samples); both as much as each sample is trusted."""
        V, K, m = len(self.views), self.patches, self.samples
        H, H_d = H[self.views], H_d[self.views]
        X = H @ self.places + (H_d @ self.places) * (relief @ self.strips).ravel()
        z = X[:, 2]
        x = X[:, :2] / z[:, None]
        B = (H[:, :2, :2, None] - x[:, :, None] * H[:, 2, :2][:, None, :, None]) / z[:, None, None]
        I, slope, laplacian, by_gamma = self._sampled(x, B)
        trust = np.sqrt(self.trust)
        even = trust / np.linalg.norm(trust, axis=-1, keepdims=True)
        I = trust * (I + (gamma - self.gamma) * by_gamma)
        I -= (I * even).sum(-1, keepdims=True) * even
        self.power = (I * I).mean(-1)
        T = self._share_texture(I, trust)
        # the texture's own slope, averaged over the views: the noise of a single view's slope would bias the step
        w = self.weights * self.gain
        mean_slope = np.einsum("vk,vckm->ckm", w, slope.reshape(V, 2, K, m), optimize=True)
        g = (trust * mean_slope / np.maximum((w * self.gain).sum(0), 1e-12)[:, None]).reshape(2, -1)
        along = _apart(T, [even])
        r = (I / self.gain[..., None] - T).astype(np.float32)
        # a view's own blur, which no model of the optics gets right, shows as a share of the texture's Laplacian;
        # left in, it passes for a change of scale
        blur = _apart(trust * np.einsum("vk,vkm->km", w, laplacian), [even, along])
        r -= (r * blur).sum(-1, keepdims=True) * blur
        free_of, known = [even, along, blur], [even, along, blur]
        # light that changes from view to view as a ramp over a patch passes for one too; how much of it is taken out
        # is what noise does not explain, for a patch freed of all ramps has less to go by
        noise = CORRELATED * np.median((r * r).mean(-1), axis=0)
        for ramp in self.ramps:
            ramp = _apart(trust * ramp, known)
            known.append(ramp)
            share = (r * ramp).sum(-1)
            taken = 1.0 - np.sqrt(np.minimum(noise / np.maximum((share**2).mean(0), 1e-9), 1.0))
            r -= (taken * share)[..., None] * ramp
            free_of.append(np.sqrt(taken)[:, None] * ramp)
        M = np.empty((V, K, 9 + STRIPS + 1, m), np.float32)
        M[:, :, -1] = trust * by_gamma / self.gain[..., None]
        gone = np.stack(free_of).astype(np.float32)
        pyramid_cpu.linearise(x, z, B, self.places, g, H_d.reshape(V, 9), self.strips, gone, M)
        self.unexplained = (r * r).mean(-1) * self.gain**2
        self._reweigh(np.square(r / trust))
        return M, r

    def _sampled(self, x: Array, B: Array) -> tuple[Array, Array, Array, Array]:
        """Intensities (V, K, m) at ``x`` (V, 2, N), their slopes (V, 2, N) over the unit square, their Laplacians and
        their derivatives by γ."""
        I, laplacian, by_gamma = np.empty((3, len(x), x.shape[2]))
        slope = np.empty((len(x), 2, x.shape[2]))
        for v, (pictures, change) in enumerate(self.pictures):
            at = (x[v] - self.corners[v][:, None]).astype(np.float32).reshape(2, self.patches, -1)
            sampled = cv2.remap(pictures, at[0], at[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            values = sampled.reshape(-1, 4).T
            I[v] = values[0]
            slope[v] = values[1] * B[v, 0] + values[2] * B[v, 1]
            laplacian[v] = values[3]
            by_gamma[v] = cv2.remap(change, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
        shape = len(x), self.patches, self.samples
        return I.reshape(shape), slope, laplacian.reshape(shape), by_gamma.reshape(shape)

    def _share_texture(self, I: Array, trust: Array) -> Array:
        """The texture (K, m) that all views share, as much as it is trusted; it and each view's gain (V, K) by
        alternation from the last ones."""
        T = I.mean(0) if self.texture is None else trust * self.texture
        for _ in range(3):
            own = np.maximum((T * T).sum(-1), 1e-9)
            self.gain = np.clip(np.einsum("vkm,km->vk", I, T) / own, *GAIN)
            w = self.weights * self.gain
            T = np.einsum("vk,vkm->km", w, I) / np.maximum((w * self.gain).sum(0), 1e-12)[:, None]
        # gains and texture are known but for a factor: as bright as the views show it
        usual = np.sqrt((self.weights * self.gain**2).sum(0) / np.maximum(self.weights.sum(0), 1e-12))
        self.gain = self.gain / usual
        self.texture = usual[:, None] * T / trust
        return np.asarray(usual[:, None] * T)

    def _reweigh(self, squares: Array) -> None:
        """Weights of views' patches, and how far each place on the face is trusted, by the ``squares`` (V, K, m) of
        what is left over.

        A patch of a view has Geman–McClure weights, against what each view and each patch usually leaves over. What a
        glossy face mirrors moves over it as it comes nearer, and passes for a motion: a place where the views differ
        more than elsewhere is trusted less. It counts for its patch as well, for such errors are alike in many views
        and do not average out as their variance alone would tell.
        """
        variance = squares.mean(-1) * self.gain**2
        overall = np.median(variance) + 1e-3
        self.expected = (
            np.maximum(np.median(variance, axis=1)[:, None], 0.05 * overall)
            * np.maximum(np.median(variance, axis=0), 0.05 * overall)
            / overall
            + 0.02
        )
        say = self._say
        by_place = np.einsum("vk,vkm->km", say, squares, optimize=True) / np.maximum(say.sum(0), 1e-12)[:, None]
        self.trust = 1.0 / (1.0 + by_place / (np.median(by_place) + 1e-3))
        self.variance = variance
        self.weights = 1.0 / (CORRELATED * self.expected) / (1.0 + variance / (REJECT * self.expected)) ** 2


def bands_of(glimpses: list[Glimpse], quads: Array, gamma: float, smoothing: float, fine: bool) -> list[Band]:
    """The bands that ``glimpses`` allow, their regions at ``quads`` (F, 2, 4, 2): only the first unless ``fine``.

    Light goes as their values to the power ``gamma``; ``smoothing`` (px) holds at the coarsest view. Raises
    numpy.linalg.LinAlgError where too little is in view.
    """
    quads = quads.reshape(-1, 4, 2)
    scale = np.sqrt(areas(quads))
    crops = [c for g in glimpses for c in g.crops]
    corners = np.concatenate([g.corners for g in glimpses])
    usable = np.array([_covers(c, o, q) for c, o, q in zip(crops, corners, quads, strict=True)])
    if usable.sum() < LEAST_VIEWS:
        raise np.linalg.LinAlgError(f"fewer than {LEAST_VIEWS} views hold the whole region")
    smallest = scale[usable].min()
    size = _sides(quads[usable][np.argmin(scale[usable])])
    count = 1 + (int(np.log(scale[usable].max() / smallest) / np.log(BAND) + 1e-6) if fine else 0)
    bands = []
    for b in range(count):
        resolution = smallest * BAND**b
        views = np.flatnonzero(usable & (scale >= 0.999 * resolution))
        if len(views) < LEAST_VIEWS:
            break
        pictures = []
        for v in views:
            ratio = scale[v] / resolution
            blurs = [_blur(smoothing, r) for r in ((ratio, BAND * ratio) if b > 0 else (ratio,))]
            picture, ahead = (_band(crops[v], blurs, gamma + step) for step in (0.0, GAMMA_STEP))
            pictures.append((_derivatives(picture), (ahead - picture) / GAMMA_STEP))
        bands.append(Band(views, pictures, gamma, corners[views], size * BAND**b))
    return bands


def _apart(field: Array, known: list[Array]) -> Array:
    """What of ``field`` (patches, samples) the ``known`` ones, of length 1, do not hold; of length 1 as well."""
    rest = np.array(field)
    for other in known:
        rest -= (rest * other).sum(-1, keepdims=True) * other
    return np.asarray(rest / np.sqrt(np.maximum((rest * rest).sum(-1, keepdims=True), 1e-12)))


def _band(picture: Floats, blurs: list[float], gamma: float) -> Floats:
    """What of a ``picture`` the first of the ``blurs`` (px) leaves and the second, where there is one, does not; each
    blurs as a lens does: light, which goes as the picture's values to the power ``gamma``."""
    values = np.maximum(picture, 0.0)  # where its distortion was taken out, cubics reach below black beside an edge
    light = cv2.pow(values, gamma)
    blurred = (cv2.pow(cv2.GaussianBlur(light, (0, 0), sigma), 1.0 / gamma) for sigma in blurs)
    return np.asarray(reduce(np.subtract, blurred), np.float32)


def _blur(smoothing: float, ratio: float) -> float:
    """σ in px that brings a view of ``ratio`` times the resolution down to it, ``smoothing`` px there included."""
    return float(np.sqrt(max((OPTICS**2 + smoothing**2) * ratio**2 - OPTICS**2, 0.3**2)))


def _derivatives(picture: Floats) -> Floats:
    """``picture``, its slopes along x and y, and its Laplacian (H, W, 4)."""
    along = [cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in (SLOPE, SLOPE.T)]
    laplacian = cv2.Laplacian(picture, cv2.CV_32F, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.merge([picture, *along, laplacian]), np.float32)


def areas(quads: Array) -> Array:
    """Areas (…) of quadrilaterals (…, 4, 2)."""
    x, y = quads[..., 0], quads[..., 1]
    return np.asarray(np.abs(0.5 * (x * np.roll(y, -1, -1) - y * np.roll(x, -1, -1)).sum(-1)))


def _sides(quad: Array) -> Array:
    """Mean width and height (2,) of a quadrilateral (4, 2)."""
    d = np.linalg.norm(np.roll(quad, -1, 0) - quad, axis=1)
    return np.array([d[0] + d[2], d[1] + d[3]]) / 2


def _covers(crop: Floats, corner: Array, quad: Array) -> bool:
    """Whether ``crop`` holds all of ``quad`` (4, 2)."""
    inner = quad - corner
    return bool((inner >= 0).all() and (inner <= np.array(crop.shape[::-1]) - 1).all())
