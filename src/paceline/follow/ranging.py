"""Stage 8 of [NIST]: metres in the camera's axes from a location in pixels, with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2

import numpy as np

from paceline.arrays import Array
from paceline.cameras import Camera
from paceline.numba_cache import cached_njit

YAW = 0.1  # rad, standard deviation of the target's yaw against the camera


@dataclass(frozen=True, eq=False)
class Place:
    """Where the centre of the target's rear plane is: ``position`` (3,) m in the camera's axes with its standard
    deviations ``std`` (3,), and its ``bearing``, rad, positive to the right."""

    position: Array
    std: Array
    bearing: float


def place_of(
    location: Array, covariance: Array, camera: Camera, nominal_range: float, tolerance: float, width: float
) -> Place:
    """(36) for a ``location`` (3,) c_x, c_y, scale in ideal pixels with its ``covariance`` (3, 3).

    The range is the nominal one over the scale; the covariance is carried through the derivatives of (36). To this
    comes what no fit can show: a model whose lines are true to within ``tolerance`` m has its centre and, over its
    ``width`` m, its size no truer than that; and of a target that is yawed a little the nearer side looks the longer.
    """
    position, std, across = _placed(location, covariance, camera.K_inv, nominal_range, tolerance, width)
    return Place(position, std, atan2(across, 1.0))


@cached_njit(nogil=True, error_model="numpy")
def _placed(
    location: Array, covariance: Array, K_inv: Array, nominal_range: float, tolerance: float, width: float
) -> tuple[Array, Array, float]:
    ray = K_inv[:, 0] * location[0] + K_inv[:, 1] * location[1] + K_inv[:, 2]
    z = nominal_range / location[2]
    position = z * ray
    to_metres = np.empty((3, 3))
    for i in range(3):  # by element: the check of an array's shape takes seconds to compile
        to_metres[i, 0], to_metres[i, 1] = z * K_inv[i, 0], z * K_inv[i, 1]
        to_metres[i, 2] = -position[i] / location[2]
    model = np.array([np.hypot(tolerance, YAW * (0.5 * width) ** 2 / z), tolerance, tolerance * z / width])
    by_location, variance = to_metres @ covariance, np.zeros(3)
    for i in range(3):
        for j in range(3):
            variance[i] += by_location[i, j] * to_metres[i, j]
    return position, np.sqrt(np.maximum(variance, 0.0) + model**2), ray[0]
