"""The parameters of a calibration: two lenses, the pose of the right camera, the pose of the board in every view.

The 24 parameters of a rig, in this order: fx, fy, cx, cy, k1, k2, p1, p2, k3 of the left camera, the same of the right
one, a rotation (rad) about the right camera's x, y, z axes and a translation (m) along them. Both are steps from a
:class:`RigState`'s present pose: ``X_right = exp(rotation) (R X_left + t) + translation``; likewise for boards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from paceline.arrays import Array, Indices
from paceline.cameras import Camera, StereoRig

LENS_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
RIG_PARAMETER_NAMES = (
    *(f"{side} {name}" for side in ("left", "right") for name in LENS_PARAMETERS),
    *(f"{what} {axis}" for what in ("rotation", "translation") for axis in "xyz"),
)
N_LENS, N_RIG = len(LENS_PARAMETERS), len(RIG_PARAMETER_NAMES)
POSE_SLICE = np.s_[2 * N_LENS : N_RIG]  # of the right camera

# Lens models from plain to rich: which of k1, k2, p1, p2, k3 are free.
LENS_MODELS: dict[str, tuple[int, ...]] = {
    "none": (),
    "k1": (0,),
    "k1, k2": (0, 1),
    "k1, k2, p1, p2": (0, 1, 2, 3),
    "k1, k2, p1, p2, k3": (0, 1, 2, 3, 4),
}


def free_parameters(distortion: str) -> Indices:
    """Indices into the 24 parameters of those that a calibration with that lens model estimates."""
    lens = [0, 1, 2, 3, *(4 + k for k in LENS_MODELS[distortion])]
    return np.array([*lens, *(N_LENS + k for k in lens), *range(2 * N_LENS, N_RIG)])


@dataclass(frozen=True, eq=False)
class RigState:
    """Two lenses (2, 9), in the order of ``LENS_PARAMETERS``, and ``X_right = R X_left + t``."""

    lenses: Array
    R: Array
    t: Array

    def updated(self, step: Array) -> RigState:
        """The rig after a ``step`` (24,) of its parameters."""
        turn = rotation_matrix(step[POSE_SLICE][:3])
        return RigState(
            self.lenses + step[: 2 * N_LENS].reshape(2, N_LENS), turn @ self.R, turn @ self.t + step[POSE_SLICE][3:]
        )

    def stereo(self, sizes: Sequence[tuple[int, int]]) -> StereoRig:
        """As a :class:`StereoRig` with cameras of the image ``sizes``, (width, height)."""
        left, right = (lens_camera(lens, size) for lens, size in zip(self.lenses, sizes, strict=True))
        return StereoRig(left, right, self.R, self.t)


def rig_parameters(stereo: StereoRig) -> RigState:
    """The state of a rig whose lenses have at most k1, k2, p1, p2, k3."""
    lenses = np.zeros((2, N_LENS))
    for lens, camera in zip(lenses, stereo.cameras, strict=True):
        lens[:4] = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
        lens[4 : 4 + len(camera.distortion)] = camera.distortion
    return RigState(lenses, stereo.R, stereo.t)


def lens_camera(lens: Array, size: tuple[int, int]) -> Camera:
    fx, fy, cx, cy = lens[:4]
    return Camera(size, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), lens[4:] if lens[4:].any() else np.zeros(0))


@dataclass(frozen=True, eq=False)
class Poses:
    """The pose of the board in each of V views: ``X_left = R[v] X_board + t[v]``, (V, 3, 3) and (V, 3)."""

    R: Array
    t: Array

    def updated(self, step: Array) -> Poses:
        """The poses after steps (V, 6): turns about and shifts along the left camera's axes."""
        turn = np.array([rotation_matrix(s) for s in step[:, :3]]).reshape(-1, 3, 3)
        return Poses(turn @ self.R, np.einsum("vij,vj->vi", turn, self.t) + step[:, 3:])

    def select(self, views: Indices) -> Poses:
        return Poses(self.R[views], self.t[views])


@dataclass(frozen=True, eq=False)
class Observations:
    """M corners: ``view`` and ``side`` (M,), 0 left, 1 right; ``points`` (M, 3) on the board, ``pixels`` (M, 2)."""

    view: Indices
    side: Indices
    points: Array
    pixels: Array

    def select(self, chosen: NDArray[np.bool_]) -> Observations:
        return Observations(self.view[chosen], self.side[chosen], self.points[chosen], self.pixels[chosen])


def parameter_step(rig: RigState, other: RigState) -> Array:
    """The step (24,) that takes ``other`` to ``rig``."""
    turn = rig.R @ other.R.T
    vector = Rotation.from_matrix(turn).as_rotvec()  # OpenCV's is zero below 1e-5
    return np.concatenate([(rig.lenses - other.lenses).ravel(), vector, rig.t - turn @ other.t])


def rotation_matrix(vector: Array) -> Array:
    """exp of a rotation ``vector`` (3,), shape (3, 3)."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector, float))[0])
