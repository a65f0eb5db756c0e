"""Sub-pixel registration of the tracked plane in both views at once.

The picture of the plane is kept as one texture on a grid over the region. Registration finds the translation in space
of the plane that makes both views show it, by Gauss–Newton on intensities. Each view has its
own gain and each part its own offset; a part that does not fit is weighted down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.speed.filter import registration_cpu
from paceline.speed.filter.likelihood import PartGrid
from paceline.speed.geometry.initial_plane import InitialPlane
from paceline.speed.geometry.quadrilaterals_cpu import unit_square_to

Number = TypeVar("Number", bound=np.generic)

MAX_ITERATIONS = 8
COARSE_LEVELS = (6.0, 2.5)  # grid steps of smoothing, for searches that begin farther away
CONVERGED_STEP_CHI2 = 0.1  # squared standard deviations of a step: the next one, quadratically smaller, would not show
GAIN_RANGE = (0.2, 5.0)
MAX_DEPTH_SHIFT_SIGMA = 5.0  # standard deviations of the hand
CORRELATED_SAMPLES = 4.0  # a sample's noise is shared with about this many neighbours
QUANTISATION_VARIANCE = 1.0 / 12.0  # grey levels², of 8-bit images
MAX_SMOOTHING_PX = 60.0  # px: a region smoothed by more is nowhere that pictures show
RIM_PX = 2.0  # px of the first region: its rim shows what is behind the vehicle, and at another depth


@dataclass(frozen=True, eq=False)
class Registration:
    """The plane's ``shift`` (3,) in metres from where it was expected, its ``covariance`` (3, 3), how well the views
    fit the texture (``similarity``, −1 … 1), and the ``texture`` (2, parts, samples) that each view shows there."""

    shift: Array
    covariance: Array
    similarity: float
    texture: Array


class PlaneGrid:
    """Sample places (u, v) of the unit square, in ``parts`` rows of ``samples`` each: arrays (parts, samples).

    ``region`` (4, 2) px is the outline, of which a rim is left out.
    """

    def __init__(self, grid: PartGrid, region: Array) -> None:
        x, y = 4 * grid.samples[0], 4 * grid.samples[1]
        self.shape = (grid.down, y, grid.across, x)
        rim = np.clip(RIM_PX / np.ptp(region, axis=0), 0.03, 0.2)
        u = rim[0] + (1 - 2 * rim[0]) * (np.arange(grid.across * x) + 0.5) / (grid.across * x)
        v = rim[1] + (1 - 2 * rim[1]) * (np.arange(grid.down * y) + 0.5) / (grid.down * y)
        U, V = np.meshgrid(u, v)
        self.places = np.stack([self.by_part(U), self.by_part(V), np.ones((grid.parts, x * y))])
        self.step = (u[1] - u[0], v[1] - v[0])
        sample = self.as_grid(np.arange(U.size).reshape(grid.parts, -1))
        around = np.pad(sample, 1, mode="edge")  # at the rim a sample is its own neighbour
        beside = around[1:-1, :-2], around[1:-1, 2:], around[:-2, 1:-1], around[2:, 1:-1]
        self.neighbours = np.stack([self.by_part(places) for places in beside]).reshape(4, -1)

    def by_part(self, values: NDArray[Number]) -> NDArray[Number]:
        """(rows, columns) of the whole grid as (parts, samples)."""
        a = values.reshape(self.shape).swapaxes(1, 2)
        return a.reshape(self.shape[0] * self.shape[2], -1)

    def as_grid(self, values: NDArray[Number]) -> NDArray[Number]:
        """(parts, samples) as (rows, columns) of the whole grid."""
        d, y, a, x = self.shape
        return values.reshape(d, a, y, x).swapaxes(1, 2).reshape(d * y, a * x)

    def image_gradient(self, texture: Array, pixels: Array) -> Array:
        """∂I/∂x and ∂I/∂y (2, parts, samples) of a ``texture`` (parts, samples) that is seen at ``pixels``
        (2, parts, samples)."""
        slopes = np.empty(pixels.shape)
        sampled, into = pixels.reshape(2, -1), slopes.reshape(2, -1)
        registration_cpu.image_gradient(texture.reshape(-1), sampled, self.neighbours, into)
        return slopes

    def smoothed(self, values: Array, coarseness: float) -> Array:
        """``values`` (parts, samples) smoothed as a picture is that was smoothed ``coarseness`` times as much."""
        sigma = 0.7 * np.sqrt(coarseness**2 - 1.0)
        whole = cv2.GaussianBlur(self.as_grid(values), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        return self.by_part(np.asarray(whole))


def register(
    rig: StereoRig,
    images: tuple[Image, Image],
    points: Array,
    texture: Array,
    grid: PlaneGrid,
    directions: Array,
    views: tuple[int, ...] = (0, 1),
    coarseness: float = 1.0,
) -> Registration:
    """Register the plane's sample ``points`` (parts, samples, 3), where expected, to the ``images`` of ``views``.

    ``texture`` (parts, samples) is what they should show; ``directions`` (3, k) spans the shifts looked for. With a
    ``coarseness`` above 1, texture and images are smoothed by that many grid steps, to be found from farther away.
    Raises numpy.linalg.LinAlgError where the texture determines nothing.
    """
    if coarseness > 1.0:
        texture = grid.smoothed(texture, coarseness)
    T = texture - texture.mean(-1, keepdims=True)
    seeing = []
    for v in views:
        P, K, R = _to_camera(rig, v, points), rig.cameras[v].K.copy(), np.eye(3) if v == 0 else rig.R
        pixels = _project(K, P)
        picture, corner = _smoothed_crop(images[v], pixels, grid, coarseness)
        K[:2, 2] -= corner
        seeing.append((picture, K, R, P, R @ directions, grid.image_gradient(texture, pixels)))
    V, (parts, samples), k = len(views), T.shape, directions.shape[1]
    TT = (T * T).sum(-1)
    shift, w = np.zeros(3), np.ones((V, parts))
    sampled, JJ, JT, JI = np.empty((V, parts, samples)), np.empty((V, parts, k, k)), *np.empty((2, V, parts, k))
    TI, II = np.empty((2, V, parts))
    normal, scores = np.empty((k, k)), np.empty((V, parts, k))
    for _ in range(MAX_ITERATIONS):
        for v, (picture, K, R, P, turned, slopes) in enumerate(seeing):
            registration_cpu.part_products(
                picture, K, P, R @ shift, turned, T, slopes, sampled[v], JJ[v], JT[v], JI[v], TI[v], II[v]
            )
        registration_cpu.normal_equations(
            JJ, JT, JI, TT, TI, II, samples, GAIN_RANGE, QUANTISATION_VARIANCE, w, normal, scores
        )
        inverse = np.linalg.inv(normal)
        step = -inverse @ scores.sum((0, 1))
        shift = shift + directions @ step
        if step @ normal @ step < CONVERGED_STEP_CHI2:
            break
    flat = scores.reshape(-1, k)
    spread = inverse @ (flat.T @ flat + CORRELATED_SAMPLES * normal) @ inverse
    similarity = TI.sum(1) / np.sqrt((II.sum(1) + 1e-9) * (TT.sum() + 1e-9))
    return Registration(shift, directions @ spread @ directions.T, float(similarity.mean()), sampled)


def _to_camera(rig: StereoRig, view: int, points: Array) -> Array:
    """World ``points`` (parts, samples, 3) in the frame of the camera of ``view``, coordinate by coordinate:
    (3, parts, samples)."""
    P = np.ascontiguousarray(np.moveaxis(points, -1, 0))
    if view == 0:
        return P
    return np.asarray((rig.R @ P.reshape(3, -1) + rig.t[:, None]).reshape(P.shape))


def _project(K: Array, P: Array) -> Array:
    """Pixels (2, parts, samples) of points ``P`` (3, parts, samples) in the camera's frame ([Zhu] (4))."""
    p = K @ P.reshape(3, -1)
    return np.asarray((p[:2] / p[2]).reshape(2, *P.shape[1:]))


def _smoothed_crop(image: Image, pixels: Array, grid: PlaneGrid, coarseness: float = 1.0) -> tuple[Image, Array]:
    """The part of ``image`` about ``pixels`` (2, …), smoothed to the grid's spacing there or ``coarseness`` times as
    much, and its first pixel."""
    low, high = (np.array([extreme(axis) for axis in pixels]) for extreme in (np.min, np.max))
    size = (high - low) * np.array(grid.step)
    sigma = max(0.6, 0.7 * float(size.max())) * coarseness
    if not sigma < MAX_SMOOTHING_PX:
        raise np.linalg.LinAlgError("the region fills more than the picture")
    corner = np.maximum(np.floor(low - 8 - 3 * sigma), 0).astype(int)
    end = np.ceil(high + 9 + 3 * sigma).astype(int)
    corner = np.minimum(corner, np.array(image.shape[1::-1]) - 2)  # two by two pixels at least, to interpolate between
    end = np.maximum(end, corner + 2)
    crop = image[corner[1] : end[1], corner[0] : end[0]]
    return np.asarray(cv2.GaussianBlur(crop, (0, 0), sigma), np.float32), corner.astype(float)


def sample(rig: StereoRig, images: tuple[Image, Image], points: Array, grid: PlaneGrid) -> Array:
    """What both views show at ``points`` (parts, samples, 3), smoothed to the grid's spacing: (2, parts, samples)."""
    sampled = []
    for v, image in enumerate(images):
        pixels = _project(rig.cameras[v].K, _to_camera(rig, v, points))
        crop, corner = _smoothed_crop(image, pixels, grid)
        x, y = (pixels - corner[:, None, None]).astype(np.float32)
        sampled.append(cv2.remap(crop, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return np.array(sampled, float)


class ReferenceTexture:
    """What the tracked plane looks like: one texture for both views, learned from every frame that shows it."""

    def __init__(self, rig: StereoRig, grid: PartGrid, region: Array, memory: float) -> None:
        self.rig = rig
        self.memory = memory  # ε of [Zhu] (14)
        self.grid = PlaneGrid(grid, region)
        self.texture = np.zeros((0, 0))

    def initialize(self, images: tuple[Image, Image], left: Array, plane: InitialPlane) -> InitialPlane:
        """Learn the left view's picture of the region (4, 2), and lay the plane where the right view agrees with it.

        A depth that the operator's hand can hardly have missed so far — a pole before the vehicle has another one —
        is not believed: then the plane stays where it was outlined.
        """
        normal = plane.normal
        self.texture = sample(self.rig, images, self.plane_points(left, normal, plane.distance), self.grid)[0]
        scale = 1.0
        for _ in range(MAX_ITERATIONS):
            # what is behind the outline grows with its distance: the plane is laid anew after every step
            points = self.plane_points(left, normal, plane.distance * scale)
            centre = points.reshape(-1, 3).mean(0)
            length = float(np.linalg.norm(centre))
            ray = centre / length
            found = register(self.rig, images, points, self.texture, self.grid, ray[:, None], (1,))
            step, std = float(found.shift @ ray) / length, float(np.sqrt(np.trace(found.covariance))) / length
            scale *= 1.0 + step
            if not abs(1.0 / max(scale, 0.1) - 1.0) < MAX_DEPTH_SHIFT_SIGMA * plane.inverse_depth_std:
                return plane
            if abs(step) < 0.1 * std:
                break
        return replace(plane, centre=plane.centre * scale, distance=plane.distance * scale, inverse_depth_std=std)

    def register(
        self, images: tuple[Image, Image], left: Array, normal: Array, distance: float, doubt: float
    ) -> Registration:
        """Where the plane is that was expected behind the left region (4, 2) at n·P = d.

        ``doubt`` is how far off that may be, in pixels: a picture is found from no farther away than its finest
        detail is wide, so the search begins as coarse as need be.
        """
        points = self.plane_points(left, normal, distance)
        start = np.zeros(3)
        step = float((np.ptp(left, axis=0) * self.grid.step).max())
        for coarseness in [c for c in COARSE_LEVELS if 0.7 * c * step < doubt]:
            start = (
                start
                + register(
                    self.rig, images, points + start, self.texture, self.grid, np.eye(3), coarseness=coarseness
                ).shift
            )
        found = register(self.rig, images, points + start, self.texture, self.grid, np.eye(3))
        return replace(found, shift=start + found.shift)

    def update(self, found: Registration) -> None:
        """Update the texture by (14), as the features are: from the left view alone.

        A mean of both views would repeat their present disparity, right or wrong, and keep it from being corrected.
        """
        self.texture = self.memory * self.texture + (1 - self.memory) * found.texture[0]

    def plane_points(self, left: Array, normal: Array, distance: float) -> Array:
        """Sample points (parts, samples, 3) on the plane behind the left region (4, 2)."""
        to_rays = self.rig.left.K_inv @ unit_square_to(left[None])[0]
        rays = to_rays @ self.grid.places.reshape(3, -1)
        surface = (rays * (distance / (normal @ rays))).reshape(self.grid.places.shape)
        return np.asarray(np.moveaxis(surface, 0, -1))
