"""Sub-pixel registration of the tracked plane in both views at once.

The picture of the plane is kept as one texture on a grid over the region. Registration finds the translation in space
of the plane that makes both views show it, by Gauss–Newton on intensities, each part freed of its own gain and offset
and weighted down where it does not fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.cameras import StereoRig
from paceline.speed.likelihood import Grid

Array = NDArray[np.float64]
Image = NDArray[np.float32]

ITERATIONS = 4
CORRELATED = 4.0  # a sample's noise is shared with about this many neighbours
QUANTISED = 1.0 / 12.0  # grey levels², of 8-bit images
INSET = 0.04  # of the region: its rim shows what is behind the vehicle


@dataclass(frozen=True, eq=False)
class Registration:
    """The plane's ``shift`` (3,) in metres from where it was expected, its ``covariance`` (3, 3), how well the views
    fit the texture (``likeness``, −1 … 1), and the ``texture`` (2, parts, samples) that each view shows there."""

    shift: Array
    covariance: Array
    likeness: float
    texture: Array


class PlaneGrid:
    """Sample places (u, v) of the unit square, in ``parts`` rows of ``samples`` each: arrays (parts, samples)."""

    def __init__(self, grid: Grid) -> None:
        x, y = 4 * grid.samples[0], 4 * grid.samples[1]
        self.shape = (grid.down, y, grid.across, x)
        u = INSET + (1 - 2 * INSET) * (np.arange(grid.across * x) + 0.5) / (grid.across * x)
        v = INSET + (1 - 2 * INSET) * (np.arange(grid.down * y) + 0.5) / (grid.down * y)
        U, V = np.meshgrid(u, v)
        self.places = np.stack([self.by_part(U), self.by_part(V), np.ones((grid.parts, x * y))])
        self.step = (u[1] - u[0], v[1] - v[0])

    def by_part(self, values: Array) -> Array:
        """(rows, columns) of the whole grid as (parts, samples)."""
        a = values.reshape(self.shape).swapaxes(1, 2)
        return a.reshape(self.shape[0] * self.shape[2], -1)

    def whole(self, values: Array) -> Array:
        """(…, parts, samples) as (…, rows, columns)."""
        d, y, a, x = self.shape
        return np.moveaxis(values.reshape(*values.shape[:-2], d, a, y, x), -3, -2).reshape(
            *values.shape[:-2], d * y, a * x
        )

    def slopes(self, values: Array) -> Array:
        """∂/∂u and ∂/∂v (2, …, parts, samples) of ``values`` (…, parts, samples)."""
        whole = self.whole(values)
        down, across = np.gradient(whole, self.step[1], self.step[0], axis=(-2, -1))
        return np.stack([self._parts(across), self._parts(down)])

    def _parts(self, whole: Array) -> Array:
        d, y, a, x = self.shape
        b = np.moveaxis(whole.reshape(*whole.shape[:-2], d, y, a, x), -3, -2)
        return np.asarray(b.reshape(*whole.shape[:-2], d * a, y * x))


def register(
    rig: StereoRig,
    images: tuple[Image, Image],
    points: Array,
    texture: Array,
    grid: PlaneGrid,
    directions: Array,
    views: tuple[int, ...] = (0, 1),
) -> Registration:
    """Register the plane's sample ``points`` (parts, samples, 3), where expected, to the ``images`` of ``views``.

    ``texture`` (parts, samples) is what they should show; ``directions`` (3, k) spans the shifts looked for. Raises
    numpy.linalg.LinAlgError where the texture determines nothing.
    """
    x = rig.project(points)
    smooth, corners = [], []
    for image, pixels in zip(images, x, strict=True):
        crop, corner = _smoothed(image, pixels, grid)
        smooth.append(crop)
        corners.append(corner)
    slopes = grid.slopes(texture)
    T = texture - texture.mean(-1, keepdims=True)
    TT = (T * T).sum(-1) + 1e-9
    shift = np.zeros(3)
    for _ in range(ITERATIONS):
        moved = points + shift
        A = np.zeros((directions.shape[1],) * 2)
        scores, seen, likeness = [], [], []
        for k in views:
            camera = rig.cameras[k]
            P = moved if k == 0 else rig.to_right(moved)
            pixels = camera.project(P)
            I = _sampled(smooth[k], pixels - corners[k])
            seen.append(I)
            I = I - I.mean(-1, keepdims=True)
            gain = np.clip((I * T).sum(-1) / TT, 0.2, 5.0)[:, None]
            r = I / gain - T
            turn = directions if k == 0 else rig.R @ directions
            J = _sensitivity(camera.K, P, pixels, slopes, turn, grid)
            J -= J.mean(-2, keepdims=True)
            J -= (J * T[..., None]).sum(-2, keepdims=True) / TT[:, None, None] * T[..., None]
            variance = (r * r).mean(-1, keepdims=True)
            w = 1.0 / (variance + 0.5 * np.median(variance) + QUANTISED)
            Jw = J * w[..., None]
            A += np.tensordot(Jw, J, ((0, 1), (0, 1)))
            scores.append(np.einsum("psk,ps->pk", Jw, r))
            likeness.append((I * T).sum() / np.sqrt(((I * I).sum() + 1e-9) * TT.sum()))
        score = np.concatenate(scores)
        inverse = np.linalg.inv(A)
        step = -inverse @ score.sum(0)
        shift = shift + directions @ step
        if step @ A @ step < 0.01:
            break
    spread = inverse @ (score.T @ score + CORRELATED * A) @ inverse
    return Registration(shift, directions @ spread @ directions.T, float(np.mean(likeness)), np.stack(seen))


def _sensitivity(K: Array, P: Array, pixels: Array, slopes: Array, turn: Array, grid: PlaneGrid) -> Array:
    """∂I/∂shift (parts, samples, k), from the slopes of the texture carried over to the image."""
    z = P[..., 2]
    g = grid.slopes(np.moveaxis(pixels, -1, 0))  # (2 of uv, 2 of xy, parts, samples)
    det = g[0, 0] * g[1, 1] - g[1, 0] * g[0, 1]
    gx = (slopes[0] * g[1, 1] - slopes[1] * g[0, 1]) / det
    gy = (slopes[1] * g[0, 0] - slopes[0] * g[1, 0]) / det
    fx, fy = K[0, 0] / z, K[1, 1] / z
    along = np.stack([gx * fx, gy * fy, -(gx * fx * P[..., 0] + gy * fy * P[..., 1]) / z], axis=-1)
    return np.asarray(along @ turn)


def _smoothed(image: Image, pixels: Array, grid: PlaneGrid) -> tuple[Image, Array]:
    """The part of ``image`` about ``pixels`` (…, 2), smoothed to the grid's spacing there, and its first pixel."""
    flat = pixels.reshape(-1, 2)
    low, high = flat.min(0), flat.max(0)
    size = (high - low) * np.array(grid.step)
    sigma = max(0.6, 0.7 * float(size.max()))
    corner = np.maximum(np.floor(low - 8 - 3 * sigma), 0).astype(int)
    end = np.ceil(high + 9 + 3 * sigma).astype(int)
    corner = np.minimum(corner, np.array(image.shape[1::-1]) - 1)
    end = np.maximum(end, corner + 1)
    crop = image[corner[1] : end[1], corner[0] : end[0]]
    return np.asarray(cv2.GaussianBlur(crop, (0, 0), sigma), np.float32), corner.astype(float)


def _sampled(image: Image, pixels: Array) -> Array:
    x, y = np.asarray(pixels[..., 0], np.float32), np.asarray(pixels[..., 1], np.float32)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), float)


def sample(rig: StereoRig, images: tuple[Image, Image], points: Array, grid: PlaneGrid) -> Array:
    """What both views show at ``points`` (parts, samples, 3), smoothed to the grid's spacing: (2, parts, samples)."""
    seen = []
    for image, pixels in zip(images, rig.project(points), strict=True):
        crop, corner = _smoothed(image, pixels, grid)
        seen.append(_sampled(crop, pixels - corner))
    return np.stack(seen)
