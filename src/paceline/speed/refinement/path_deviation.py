"""How a vehicle departs from the drawn path: what its reconstruction leaves open, and how drivers drive."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from scipy.interpolate import CubicSpline

from paceline.arrays import Array
from paceline.speed.geometry.initial_plane import InitialPlane
from paceline.speed.geometry.paths import LANE_KEEPING_STD, Path

# How a driver departs from the path of the lane, one sigma of each term of a polynomial in the distance: heading in
# rad, curvature (lane keeping) in 1/m, and so on
DRIVER = {"yaw": (LANE_KEEPING_STD[0], 3e-4, 1e-5, 1e-7), "pitch": (LANE_KEEPING_STD[1], 1e-4, 1e-6)}
# Without a path the direction is what the filter found, no better than this; a turn is another model
UNGUIDED = {"yaw": (np.radians(15.0), 3e-4), "pitch": (np.radians(5.0), 1e-4)}
FARTHER, LEAST_WAY = 1.1, 5.0  # times as far as at the speed given, and m: the way whose bends are asked for
LEAST_BEND = 1e-4  # rad, rms: a bend below moves nothing by a pixel's hundredth
SWERVING = 0.1, 8.0  # rad, m: the heading of a vehicle that changes lane, and over what distance it changes
WEAVING = 0.01, 10.0  # the same of a driver who keeps his lane round a bend
LEAST_SHARE = 0.01  # of the heading's standard deviation: a mode with less is left out


@dataclass(frozen=True, eq=False)
class Bends:
    """How a vehicle's own path may turn away from the drawn one: independent modes of one standard deviation each.

    ``u`` (N,) are distances from where the vehicle was first seen, ``modes`` (K, 2, N) the changes of yaw, to the
    right, and of pitch, downwards, in radians. The last ``swerves`` of them are those of a vehicle that leaves its
    lane.
    """

    u: Array
    modes: Array
    swerves: int

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.u, np.moveaxis(self.modes, -1, 0))

    def turns(self, amplitudes: Array, u: Array) -> Array:
        """Yaw and pitch (2, …, M), by ``amplitudes`` (…, K), at distances ``u`` (M,); beyond what was foreseen they
        stay as they are there."""
        at = self._spline(np.clip(u, self.u[0], self.u[-1]))
        return np.asarray(np.moveaxis(np.tensordot(amplitudes, at, (-1, 1)), -1, 0))


def way_of(path: Path, plane: InitialPlane, times: Array, speed: float, on_path: bool) -> Bends:
    """The bends of the way that a ``plane`` goes along ``path`` at about ``speed``, m/s, in ``times`` (F, 2), s."""
    length = FARTHER * speed * float(np.ptp(times))
    return bends(path, path.nearest(plane.centre), max(length, LEAST_WAY), on_path)


def bends(path: Path, start: float, length: float, on_path: bool) -> Bends:
    """The bends of a vehicle that drives ``length`` metres along ``path`` from arc length ``start``.

    They are the principal components of what the path's reconstruction leaves open and of how drivers keep to a lane.
    No polynomial does: the reconstruction errs in many ways, and what a bend of the model cannot follow is taken for
    a change of depth, so of speed.
    """
    u = np.linspace(-1.0, length + 1.0, 81)
    orders = (4, 3) if path.shape == "curve" else (2, 2)
    driver = DRIVER if on_path else UNGUIDED
    modes = [
        sigma * np.outer(axis, u**k / factorial(k))
        for axis, order, sigmas in zip(np.eye(2), orders, driver.values(), strict=True)
        for k, sigma in enumerate(sigmas[:order])
    ]
    if on_path:
        modes += list(np.stack(path.heading_modes(start + u), axis=1))
    if path.shape == "curve":
        modes += list(_wandering(u, *WEAVING))
    _, size, shapes = np.linalg.svd(np.reshape(modes, (len(modes), -1)), full_matrices=False)
    keep = size > LEAST_BEND * np.sqrt(len(u))
    kept = (size[keep, None] * shapes[keep]).reshape(-1, 2, len(u))
    swerves = _wandering(u, *SWERVING)
    return Bends(u, np.concatenate([kept, swerves]), len(swerves))


def _wandering(u: Array, sigma: float, length: float) -> Array:
    """Modes (S, 2, N) of a yaw that changes smoothly over the distance ``u`` (N,): of ``sigma`` rad, over ``length``
    m."""
    yaw = smooth(u, sigma, length)
    return np.stack([yaw, np.zeros_like(yaw)], axis=1)


def smooth(x: Array, sigma: float, scale: float) -> Array:
    """Modes (S, N), of one standard deviation each, of a Gaussian process over ``x`` (N,) of ``sigma``, smooth over
    ``scale``."""
    kernel = sigma**2 * np.exp(-0.5 * ((x[:, None] - x) / scale) ** 2)
    variance, shapes = np.linalg.eigh(kernel)
    keep = variance > (LEAST_SHARE * sigma) ** 2 * len(x)
    return np.asarray((np.sqrt(variance[keep]) * shapes[:, keep]).T)
