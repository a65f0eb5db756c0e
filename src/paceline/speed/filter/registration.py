"""Sub-pixel registration of the tracked plane in both views at once.

The appearance of the plane is kept as one texture on a grid over the region. Registration finds the translation of the
plane in space for which both views show that texture, by Gauss–Newton on intensities. Each view has its own gain and
each part its own offset; a part that does not fit is given a small weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.recordings.stereo import StereoFrame
from paceline.speed.filter import motion_models, registration_cpu
from paceline.speed.filter.estimate import MIN_REFERENCE_SIMILARITY
from paceline.speed.filter.likelihood import PartGrid
from paceline.speed.filter.motion_models import CoordinatedTurn
from paceline.speed.filter.particle_set import Particles
from paceline.speed.geometry.initial_plane import InitialPlane
from paceline.speed.geometry.quadrilaterals_cpu import unit_square_to

Number = TypeVar("Number", bound=np.generic)

MAX_REGISTRATION_ITERATIONS = 8
COARSE_LEVELS = (6.0, 2.5)  # smoothing in grid steps, for searches that start farther away
CONVERGED_STEP_CHI2 = 0.1  # squared standard deviations of the last step; the next one is quadratically smaller
UNEXPECTED_YAW_STD_RAD = 0.1  # prior standard deviation of how far the plane has turned beyond what is expected
VIEW_GAIN_RANGE = (0.2, 5.0)
MAX_DEPTH_SHIFT_SIGMA = 5.0  # greatest shift in standard deviations of the outline's depth
NOISE_CORRELATED_SAMPLES = 4.0  # number of neighbouring samples that share their noise
QUANTISATION_VARIANCE = 1.0 / 12.0  # grey levels², of 8-bit images
MAX_SMOOTHING_PX = 60.0  # smoothing that a region which fills more than the image would need
REGION_RIM_PX = 2.0  # rim of the first region that is left out: it may show the background, at another depth
MIN_SIMILARITY_OUTSIDE_GATE = 0.9  # similarity at which a registration outside the gate is accepted
GATE_CHI2 = 50.0  # squared Mahalanobis distance, three degrees of freedom, above which it may be another object


@dataclass(frozen=True, eq=False)
class Registration:
    """The plane's ``shift`` (3,) in metres from where it was expected, its ``covariance`` (3, 3), the correlation of
    the views with the texture (``similarity``, −1 … 1), and the ``texture`` (2, parts, samples) of each view there."""

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
        rim = np.clip(REGION_RIM_PX / np.ptp(region, axis=0), 0.03, 0.2)
        u = rim[0] + (1 - 2 * rim[0]) * (np.arange(grid.across * x) + 0.5) / (grid.across * x)
        v = rim[1] + (1 - 2 * rim[1]) * (np.arange(grid.down * y) + 0.5) / (grid.down * y)
        U, V = np.meshgrid(u, v)
        self.places = np.stack([self.by_part(U), self.by_part(V), np.ones((grid.parts, x * y))])
        self.step = (u[1] - u[0], v[1] - v[0])
        sample = self.as_grid(np.arange(U.size).reshape(grid.parts, -1))
        around = np.pad(sample, 1, mode="edge")  # at the rim a sample is its own neighbour
        neighbours = around[1:-1, :-2], around[1:-1, 2:], around[:-2, 1:-1], around[2:, 1:-1]
        self.neighbours = np.stack([self.by_part(places) for places in neighbours]).reshape(4, -1)

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
        """``values`` (parts, samples) smoothed as an image that is smoothed ``coarseness`` times as much."""
        sigma = 0.7 * np.sqrt(coarseness**2 - 1.0)
        grid = cv2.GaussianBlur(self.as_grid(values), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        return self.by_part(np.asarray(grid))


def register(
    rig: StereoRig,
    images: tuple[Image, Image],
    points: Array,
    texture: Array,
    grid: PlaneGrid,
    directions: Array,
    views: tuple[int, ...] = (0, 1),
    coarseness: float = 1.0,
    with_yaw: bool = False,
) -> Registration:
    """Registers the plane's sample ``points`` (parts, samples, 3), as expected, to the ``images`` of ``views``.

    ``texture`` (parts, samples) is their expected appearance; ``directions`` (3, k) spans the estimated shifts, and
    ``with_yaw`` the plane may turn about its centre and the left camera's y axis. With a ``coarseness`` above 1,
    texture and images are smoothed by that many grid steps, to be found from farther away.
    Raises numpy.linalg.LinAlgError where the texture determines nothing.
    """
    if coarseness > 1.0:
        texture = grid.smoothed(texture, coarseness)
    T = texture - texture.mean(-1, keepdims=True)
    centre = points.reshape(-1, 3).mean(0)
    seeing = []
    for v in views:
        P, K, R = _to_camera(rig, v, points), rig.cameras[v].K.copy(), np.eye(3) if v == 0 else rig.R
        pixels = _project(K, P)
        picture, corner = _smoothed_crop(images[v], pixels, grid, coarseness)
        K[:2, 2] -= corner
        pivot = centre if v == 0 else R @ centre + rig.t
        seeing.append((picture, K, R, P, pivot, grid.image_gradient(texture, pixels)))
    V, (parts, samples), shifts = len(views), T.shape, directions.shape[1]
    k = shifts + with_yaw
    TT = (T * T).sum(-1)
    shift, x, w = np.zeros(3), np.zeros(k), np.ones((V, parts))  # x: shifts along the directions, and the yaw
    prior = np.zeros((k, k))
    if with_yaw:
        prior[-1, -1] = NOISE_CORRELATED_SAMPLES / UNEXPECTED_YAW_STD_RAD**2
    sampled, JJ, JT, JI = np.empty((V, parts, samples)), np.empty((V, parts, k, k)), *np.empty((2, V, parts, k))
    TI, II = np.empty((2, V, parts))
    normal, scores = np.empty((k, k)), np.empty((V, parts, k))
    for _ in range(MAX_REGISTRATION_ITERATIONS):
        for v, (picture, K, R, P, pivot, slopes) in enumerate(seeing):
            registration_cpu.part_products(
                picture,
                K,
                _turned_about(pivot, R, x[-1], P) if with_yaw else P,
                R @ shift,
                R @ directions,
                np.ascontiguousarray(R[:, 1]),
                pivot,
                T,
                slopes,
                sampled[v],
                JJ[v],
                JT[v],
                JI[v],
                TI[v],
                II[v],
            )
        registration_cpu.normal_equations(
            JJ, JT, JI, TT, TI, II, samples, VIEW_GAIN_RANGE, QUANTISATION_VARIANCE, w, normal, scores
        )
        information = normal + prior
        inverse = np.linalg.inv(information)
        step = -inverse @ (scores.sum((0, 1)) + prior @ x)
        x, shift = x + step, shift + directions @ step[:shifts]
        if step @ information @ step < CONVERGED_STEP_CHI2:
            break
    flat = scores.reshape(-1, k)
    scatter = flat.T @ flat
    spread = inverse @ (scatter + NOISE_CORRELATED_SAMPLES * information) @ inverse
    similarity = TI.sum(1) / np.sqrt((II.sum(1) + 1e-9) * (TT.sum() + 1e-9))
    covariance = directions @ spread[:shifts, :shifts] @ directions.T
    return Registration(shift, covariance, float(similarity.mean()), sampled)


def _turned_about(pivot: Array, R: Array, yaw: float, P: Array) -> Array:
    """Points ``P`` (3, parts, samples) turned about ``pivot`` (3,) by ``yaw`` rad about the left camera's y axis.

    All are in the frame of the camera that is turned by ``R`` from the left one.
    """
    about = P.reshape(3, -1) - pivot[:, None]
    return np.asarray((R @ rotation_about_y(yaw) @ R.T @ about + pivot[:, None]).reshape(P.shape))


def rotation_about_y(yaw: float) -> Array:
    """The rotation (3, 3) about the y axis, from z towards x."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


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
        raise np.linalg.LinAlgError("the region fills more than the image")
    corner = np.maximum(np.floor(low - 8 - 3 * sigma), 0).astype(int)
    end = np.ceil(high + 9 + 3 * sigma).astype(int)
    corner = np.minimum(corner, np.array(image.shape[1::-1]) - 2)  # two by two pixels at least, to interpolate between
    end = np.maximum(end, corner + 2)
    crop = image[corner[1] : end[1], corner[0] : end[0]]
    return np.asarray(cv2.GaussianBlur(crop, (0, 0), sigma), np.float32), corner.astype(float)


def sample(rig: StereoRig, images: tuple[Image, Image], points: Array, grid: PlaneGrid) -> Array:
    """Both images sampled at ``points`` (parts, samples, 3), smoothed to the grid's spacing: (2, parts, samples)."""
    sampled = []
    for v, image in enumerate(images):
        pixels = _project(rig.cameras[v].K, _to_camera(rig, v, points))
        crop, corner = _smoothed_crop(image, pixels, grid)
        x, y = (pixels - corner[:, None, None]).astype(np.float32)
        sampled.append(cv2.remap(crop, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return np.array(sampled, float)


class ReferenceTexture:
    """The reference texture of the tracked plane, one for both views, updated at every frame that shows it."""

    def __init__(self, rig: StereoRig, grid: PartGrid, region: Array, memory: float) -> None:
        self.rig = rig
        self.memory = memory  # ε of [Zhu] (14)
        self.grid = PlaneGrid(grid, region)
        self.texture = np.zeros((0, 0))

    def initialize(self, images: tuple[Image, Image], left: Array, plane: InitialPlane) -> InitialPlane:
        """Take the texture from the left view's region (4, 2); return ``plane`` at the depth where the right view
        shows it.

        A depth that differs from the outlined one by more than the drawing noise explains is rejected, as it may be
        that of a pole in front of the vehicle: then ``plane`` is returned unchanged. Raises numpy.linalg.LinAlgError
        where the texture determines nothing.
        """
        normal = plane.normal
        self.texture = sample(self.rig, images, self.plane_points(left, normal, plane.distance), self.grid)[0]
        scale = 1.0
        for _ in range(MAX_REGISTRATION_ITERATIONS):
            # the part of the plane behind the outline grows with its distance: recomputed after every step
            points = self.plane_points(left, normal, plane.distance * scale)
            centre = points.reshape(-1, 3).mean(0)
            length = float(np.linalg.norm(centre))
            ray = centre / length
            registration = register(self.rig, images, points, self.texture, self.grid, ray[:, None], (1,))
            step, std = (
                float(registration.shift @ ray) / length,
                float(np.sqrt(np.trace(registration.covariance))) / length,
            )
            scale *= 1.0 + step
            if not abs(1.0 / max(scale, 0.1) - 1.0) < MAX_DEPTH_SHIFT_SIGMA * plane.inverse_depth_std:
                return plane
            if abs(step) < 0.1 * std:
                break
        return replace(plane, centre=plane.centre * scale, distance=plane.distance * scale, inverse_depth_std=std)

    def register(
        self,
        images: tuple[Image, Image],
        left: Array,
        normal: Array,
        distance: float,
        spread: float,
        with_yaw: bool = False,
    ) -> Registration:
        """Register the plane that is expected behind the left region (4, 2) at n·P = d, ``with_yaw`` turned, too.

        ``spread`` is the standard deviation of its position in the image, in pixels: registration converges only from
        within the width of the finest detail, so the search starts as coarsely as that requires.
        """
        points = self.plane_points(left, normal, distance)
        start = np.zeros(3)
        step = float((np.ptp(left, axis=0) * self.grid.step).max())
        for coarseness in [c for c in COARSE_LEVELS if 0.7 * c * step < spread]:
            coarse = register(
                self.rig, images, points + start, self.texture, self.grid, np.eye(3), coarseness=coarseness
            )
            start = start + coarse.shift
        registration = register(self.rig, images, points + start, self.texture, self.grid, np.eye(3), with_yaw=with_yaw)
        return replace(registration, shift=start + registration.shift)

    def update(self, registration: Registration) -> None:
        """Update the texture by (14) from the left view alone.

        A mean of both views would contain their present disparity, right or wrong, and prevent its correction.
        """
        self.texture = self.memory * self.texture + (1 - self.memory) * registration.texture[0]

    def plane_points(self, left: Array, normal: Array, distance: float) -> Array:
        """Sample points (parts, samples, 3) on the plane behind the left region (4, 2)."""
        to_rays = self.rig.left.K_inv @ unit_square_to(left[None])[0]
        rays = to_rays @ self.grid.places.reshape(3, -1)
        surface = (rays * (distance / (normal @ rays))).reshape(self.grid.places.shape)
        return np.asarray(np.moveaxis(surface, 0, -1))


# --- registration of the particles' plane --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PlaneObservation:
    """Where registration found the plane: the ``place`` (3,) of its centre, m, the ``registration``, and whether that
    is ``inside_gate``, which is wider the more similar the texture is."""

    place: Array
    registration: Registration
    inside_gate: bool


def register_plane(texture: ReferenceTexture, particle_set: Particles, frame: StereoFrame) -> PlaneObservation | None:
    """Register the mean plane of the particles to both images of ``frame``; None where its texture determines nothing.

    In a coordinated turn its yaw is a nuisance parameter, as its foreshortening looks like a distance. The particles
    are not updated by it: on a vehicle that is not flat, foreshortening and depth cannot be told apart. The gate is on
    the squared Mahalanobis distance between the registered and the predicted centre.
    """
    mean, spread = particle_set.mean(), particle_set.image_spread_px()
    images, turns = (frame.left, frame.right), isinstance(particle_set.motion, CoordinatedTurn)
    try:
        registration = texture.register(images, mean.left[0], mean.normal[0], float(mean.distance[0]), spread, turns)
    except np.linalg.LinAlgError:
        return None
    # while the speed is hardly known, the mean region is not the projection of the mean plane
    expected = motion_models.plane_centres(texture.rig, mean)[0]
    place = expected + registration.shift
    centre, covariance = particle_set.centre()
    innovation = place - centre
    chi2 = float(innovation @ np.linalg.solve(covariance + registration.covariance, innovation))
    threshold = MIN_REFERENCE_SIMILARITY if chi2 < GATE_CHI2 else MIN_SIMILARITY_OUTSIDE_GATE
    return PlaneObservation(place, registration, registration.similarity >= threshold)


def update_by_registration(
    texture: ReferenceTexture, particle_set: Particles, observation: PlaneObservation, rng: np.random.Generator
) -> None:
    """The ensemble Kalman update by the registered place, and the update of the texture."""
    particle_set.ensemble_kalman_update(observation.place, observation.registration.covariance, rng)
    texture.update(observation.registration)
