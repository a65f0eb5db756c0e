"""Pinhole cameras with OpenCV's lens distortion, and the stereo rig made of two of them.

Axes as in OpenCV: x right, y down, z forward; the centre of the top-left pixel is (0, 0). The world frame of a rig is
its left camera, and ``X_right = R X_left + t``. Everything that uses this module works in *ideal* pixels: images and
drawn points are undistorted once, with the intrinsics K kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array

ALL_ROWS = slice(None)
VIEW_NAMES = ("left", "right")
_TO_CONVERGENCE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)  # the default stops 0.2 px short


# What `cubic_sampling_places` adds to the whole part of a coordinate, by its fraction; OpenCV rounds places to 1/32 px
_FRACTIONS = 4096
_FROM_MIDDLE = (np.arange(_FRACTIONS) + 0.5) / _FRACTIONS - 0.5
_CUBIC_SAMPLING_FRACTIONS = (0.5 + np.sinh(np.arcsinh(4 * _FROM_MIDDLE) / 3)).astype(np.float32)


def cubic_sampling_places(pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """The coordinates at which OpenCV's bicubic interpolation has the grey values of ``pixels`` of a smooth picture.

    Its kernel (Keys 1981 with a = −0.75, for which only a = −0.5 is exact) takes a grey-value ramp at the coordinate s
    between two pixels, 0 ≤ s ≤ 1, from s + s (1 − s) (1 − 2 s) / 2, up to 0.05 px beside it; this is the inverse.
    """
    floor = np.floor(pixels)
    fraction = ((pixels - floor) * np.float32(_FRACTIONS)).astype(np.int16)
    return np.asarray(floor + _CUBIC_SAMPLING_FRACTIONS.take(fraction, mode="clip"), np.float32)


@dataclass(frozen=True)
class Quantity:
    """A quantity of the cameras: ``value``, standard deviation (0 where it is exact) and where both come from."""

    value: float
    std: float = 0.0
    source: Literal["stated", "estimated", "assumed"] = "stated"


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    ``image_size`` is (width, height) in pixels, ``K`` the (3, 3) intrinsics in pixels, ``distortion`` OpenCV's
    coefficients k1, k2, p1, p2[, k3[, k4, k5, k6[, …]]] (empty for none). ``readout`` is the time from the first row's
    exposure to the last one's, s, negative from the bottom up; None where it is not known.
    """

    image_size: tuple[int, int]
    K: Array
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    readout: Quantity | None = None

    @cached_property
    def has_distortion(self) -> bool:
        return bool(np.any(self.distortion))

    @cached_property
    def K_inv(self) -> Array:
        return np.asarray(np.linalg.inv(self.K), float)

    def project(self, points: Array) -> Array:
        """Ideal pixels (…, 2) of ``points`` (…, 3), given in this camera's frame in metres ([Zhu] (4))."""
        p = np.asarray(points, float) @ self.K.T
        return p[..., :2] / p[..., 2:3]

    def rays(self, pixels: Array) -> Array:
        """Directions (…, 3) with z = 1 through ideal ``pixels`` (…, 2)."""
        p = np.asarray(pixels, float)
        return np.concatenate([p, np.ones(p.shape[:-1] + (1,))], axis=-1) @ self.K_inv.T

    def undistort_points(self, pixels: Array) -> Array:
        """Ideal pixels (…, 2) of ``pixels`` (…, 2) of the distorted image."""
        p = np.asarray(pixels, float)
        if not self.has_distortion:
            return p
        ideal = cv2.undistortPoints(p.reshape(-1, 1, 2), self.K, self.distortion, P=self.K, criteria=_TO_CONVERGENCE)
        return np.asarray(ideal, float).reshape(p.shape)

    def distort_points(self, pixels: Array) -> Array:
        """Pixels (…, 2) of the distorted image, of ideal ``pixels`` (…, 2)."""
        p = np.asarray(pixels, float)
        if not self.has_distortion:
            return p
        rays = self.rays(p).reshape(-1, 1, 3)
        distorted = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.K, self.distortion)[0]
        return np.asarray(distorted, float).reshape(p.shape)

    def turned(self, pixels: Array, rotation: Array) -> Array:
        """Where ideal ``pixels`` (…, 2) are in the image once the camera has turned by ``rotation`` (…, 3), a rotation
        vector in rad, so that a point at X in its axes comes to R X."""
        rays, angle = self.rays(pixels), np.linalg.norm(rotation, axis=-1, keepdims=True)
        axis = rotation / np.maximum(angle, 1e-300)
        along = axis * (axis * rays).sum(-1, keepdims=True)
        turned = along + np.cos(angle) * (rays - along) + np.sin(angle) * np.cross(axis, rays)
        return self.project(turned)

    @cached_property
    def _undistortion_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return self._maps(np.eye(3))

    def _maps(self, turned_back: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The maps of `undistort_image` for `cv2.remap`, of a camera that is turned by ``turned_back`` (3, 3)."""
        size = self.image_size
        x, y = cv2.initUndistortRectifyMap(self.K, self.distortion, turned_back, self.K, size, cv2.CV_32FC1)
        return cubic_sampling_places(np.asarray(x, np.float32)), cubic_sampling_places(np.asarray(y, np.float32))

    def undistort_image(
        self, image: NDArray[np.float32], rows: slice = ALL_ROWS, rotation: Array | None = None
    ) -> NDArray[np.float32]:
        """The undistorted image (H, W), black outside of ``rows``; the same array where there is no distortion.

        Of a camera that has turned by ``rotation`` (a rotation vector, rad) the image is turned back.
        """
        if rotation is not None:
            a, b = self._maps(np.asarray(cv2.Rodrigues(-np.asarray(rotation, float))[0], float))
            return np.asarray(cv2.remap(image, a, b, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
        if not self.has_distortion:
            return image
        a, b = self._undistortion_maps
        ideal = np.zeros(image.shape, np.float32)
        cv2.remap(image, a[rows], b[rows], cv2.INTER_CUBIC, dst=ideal[rows])
        return ideal


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """A camera and its pose: ``X_camera = R X_world + t``."""

    camera: Camera
    R: Array
    t: Array

    def to_camera(self, points: Array) -> Array:
        """World ``points`` (…, 3) in camera axes."""
        return np.asarray(np.asarray(points) @ self.R.T + self.t)

    def project(self, points: Array) -> Array:
        """Ideal pixels (…, 2) of world ``points`` (…, 3)."""
        return self.camera.project(self.to_camera(points))

    def depth(self, points: Array) -> Array:
        """Metres (…) of world ``points`` (…, 3) ahead of the camera."""
        return np.asarray(points @ self.R[2] + self.t[2])

    @property
    def centre(self) -> Array:
        return np.asarray(-self.R.T @ self.t)


@dataclass(frozen=True)
class RigUncertainty:
    """Standard uncertainties of a calibration (one sigma), as stated under ``uncertainty`` in rig.yaml.

    ``focal_length_px`` and ``principal_point_px`` hold for each axis of each camera independently;
    ``rotation_rad`` and ``translation_m`` are about and along the right camera's x, y, z. ``covariance`` (14, 14),
    where there is one, counts in their place: of the left fx, fy, cx, cy, the right ones, rotation, translation.
    ``is_assumed``: rig.yaml states none, and that of an ordinary, careful calibration is assumed.
    """

    focal_length_px: float = 0.0
    principal_point_px: float = 0.0
    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    covariance: Array | None = field(default=None, compare=False)
    is_assumed: bool = False

    @property
    def covariance_root(self) -> Array:
        """U (M, 14) with UᵀU the covariance: each row is an independent change by one standard uncertainty."""
        if self.covariance is None:
            pinhole = [self.focal_length_px] * 2 + [self.principal_point_px] * 2
            return np.diag([*pinhole, *pinhole, *self.rotation_rad, *self.translation_m])
        size = np.sqrt(
            np.maximum(np.diag(self.covariance), 1e-300)
        )  # the units differ: eigenvectors of the correlations
        share, axes = np.linalg.eigh(self.covariance / np.outer(size, size))
        # what is left of a direction that is determined exactly is the error of its number
        share = np.where(share > 1e-12 * share.max(), share, 0.0)
        return np.asarray((axes * np.sqrt(share)).T * size)


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two cameras, rotation ``R`` (3, 3) and translation ``t`` (3,) in metres: ``X_right = R X_left + t``.

    Without ``uncertainty`` the calibration is exact. ``scene_points`` is the number of points of a scene by which the
    rotation was corrected since, 0 where it was not.
    """

    left: Camera
    right: Camera
    R: Array
    t: Array
    uncertainty: RigUncertainty | None = None
    scene_points: int = 0

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        return self.left, self.right

    @property
    def baseline(self) -> float:
        """Distance between the two centres of projection, metres."""
        return float(np.linalg.norm(self.t))

    @property
    def centres(self) -> Array:
        """World points (2, 3) of the two centres of projection."""
        return np.stack([np.zeros(3), -self.R.T @ self.t])

    def displaced(self, displacement: Array) -> StereoRig:
        """The rig to which all that moves by ``displacement`` (3,) m from the left exposure to the right one looks as
        it does to this one: its views are exposed at once."""
        return replace(self, t=self.t + self.R @ displacement)

    def to_right(self, points: Array) -> Array:
        """World points (…, 3) in the right camera's frame ([Zhu] (7))."""
        return np.asarray(points, float) @ self.R.T + self.t

    def project(self, points: Array) -> tuple[Array, Array]:
        """Ideal pixels (…, 2) of world ``points`` (…, 3) in the left and the right view ([Zhu] (4))."""
        return self.left.project(points), self.right.project(self.to_right(points))

    @cached_property
    def fundamental(self) -> Array:
        """F (3, 3) with ``x_rightᵀ F x_left = 0``."""
        tx = np.array([[0, -self.t[2], self.t[1]], [self.t[2], 0, -self.t[0]], [-self.t[1], self.t[0], 0]])
        return np.asarray(self.right.K_inv.T @ tx @ self.R @ self.left.K_inv)


def perturbed_rig(rig: StereoRig, move: Array) -> StereoRig:
    """``rig`` with its parameters changed by ``move`` (14,), in the order and about the axes of
    :class:`RigUncertainty`. Its cameras have no distortion, as pixels are ideal ones here."""
    left, right = (
        replace(camera, K=camera.K + [[m[0], 0, m[2]], [0, m[1], m[3]], [0, 0, 0]], distortion=np.zeros(0))
        for camera, m in zip(rig.cameras, (move[:4], move[4:8]), strict=True)
    )
    turn = np.asarray(cv2.Rodrigues(move[8:11])[0])
    return StereoRig(left, right, turn @ rig.R, turn @ rig.t + move[11:])


def perturbed_rigs(rig: StereoRig, uncertainty: RigUncertainty) -> list[StereoRig]:
    """Rigs that each differ from ``rig`` by one of its calibration's independent standard uncertainties."""
    return [perturbed_rig(rig, move) for move in uncertainty.covariance_root]


def line_displacement(camera: Camera, lines: Array, vertical: NDArray[np.bool_]) -> tuple[Array, Array]:
    """How far distortion moves ``lines`` (S, 2, 2), ideal pixels, across themselves (S,) and along themselves (S,).

    The mean along a bent line is taken: edge points all along it have this mean as well.
    """
    n = len(lines)
    if not camera.has_distortion:
        return np.zeros(n), np.zeros(n)
    shares = np.array([0.1, 0.3, 0.5, 0.7, 0.9])[:, None, None]
    points = lines[None, :, 0] + shares * (lines[None, :, 1] - lines[None, :, 0])
    displacement = (camera.distort_points(points) - points).mean(0)
    return np.where(vertical, displacement[:, 0], displacement[:, 1]), np.where(
        vertical, displacement[:, 1], displacement[:, 0]
    )


def direction_name(direction: Array) -> str:
    """How the cameras see a vehicle drive along ``direction`` (3,): ``approaching``, ``receding``, ``to the left`` or
    ``to the right``."""
    x, _, z = direction
    if abs(z) >= abs(x):
        return "approaching" if z < 0 else "receding"
    return "to the left" if x < 0 else "to the right"
