"""Deviation of a vehicle's own path from the drawn one: reconstruction errors and drivers' lane keeping."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from scipy.interpolate import CubicSpline

from paceline.arrays import Array
from paceline.speed.configuration import DEFAULTS, DriverSettings
from paceline.speed.geometry.fitted_arc import CURVATURE_STD_PER_M
from paceline.speed.geometry.initial_plane import TRAVEL_YAW_STD_RAD, InitialPlane
from paceline.speed.geometry.paths import Path

# Standard deviations of a polynomial in the distance: curvature (1/m) and its derivatives, on a path
CURVATURE_PRIOR = {"yaw": (3e-4, 1e-5, 1e-7), "pitch": (1e-4, 1e-6)}
FILTER_YAW_STD_RAD, FILTER_PITCH_STD_RAD = np.radians(15.0), np.radians(5.0)  # of a direction that the filter gives
# That direction and curvature (1/m) without a path, where a turn is a motion term
FREE_DIRECTION_PRIOR = {
    "yaw": (FILTER_YAW_STD_RAD, CURVATURE_PRIOR["yaw"][0]),
    "pitch": (FILTER_PITCH_STD_RAD, CURVATURE_PRIOR["pitch"][0]),
}
TURN_PRIOR = {  # that direction and curvature of a turn before it is known
    "yaw": (FILTER_YAW_STD_RAD, CURVATURE_STD_PER_M),
    "pitch": (FILTER_PITCH_STD_RAD,),
}
ARC_MISFIT_STD_RAD = 0.01  # rad, of a path's direction at a place from that of the arc nearest to it
LENGTH_FACTOR = 1.1  # length of the modelled path over the distance at the given speed
MIN_PATH_LENGTH_M = 5.0  # least length of the modelled path
MIN_MODE_RAD = 1e-4  # RMS below which a mode moves the image by less than 0.01 px
LANE_KEEPING_GP = 0.01, 10.0  # heading on a bend: standard deviation in rad, correlation length in m
MIN_MODE_SHARE = 0.01  # share of a process's standard deviation below which a mode is left out


@dataclass(frozen=True, eq=False)
class PathDeviation:
    """Independent modes by which a vehicle's path may deviate from the drawn one, of standard deviation 1 each.

    ``u`` (N,) m are distances from where the vehicle was first seen, ``modes`` (K, 2, N) rad the changes of yaw, to the
    right, and of pitch, downwards; ``mean`` (K,) are their prior means. The last ``lane_change_modes``
    of them belong to lane changes.
    """

    u: Array
    modes: Array
    lane_change_modes: int
    mean: Array

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.u, np.moveaxis(self.modes, -1, 0))

    def angles(self, amplitudes: Array, u: Array) -> Array:
        """Yaw and pitch (2, …, M) rad by ``amplitudes`` (…, K) at distances ``u`` (M,); constant outside ``self.u``."""
        modes = self._spline(np.clip(u, self.u[0], self.u[-1]))
        return np.asarray(np.moveaxis(np.tensordot(amplitudes, modes, (-1, 1)), -1, 0))


def deviation_of(
    path: Path,
    plane: InitialPlane,
    times: Array,
    speed: float,
    on_path: bool,
    driver: DriverSettings = DEFAULTS.driver,
    drawn: Path | None = None,
) -> PathDeviation:
    """The `PathDeviation` of a ``plane`` that moves along ``path`` at about ``speed`` (m/s) for ``times`` (F, 2) s.

    A ``drawn`` curve is given where ``path`` is an arc that was fitted to the vehicle's places.
    """
    length = max(LENGTH_FACTOR * speed * float(np.ptp(times)), MIN_PATH_LENGTH_M)
    start = path.nearest(plane.centre)
    if drawn is not None:
        return deviation_from_arc(path, start, length, drawn, driver)
    return deviation_modes(path, start, length, on_path, driver)


def deviation_modes(
    path: Path, start: float, length: float, on_path: bool, driver: DriverSettings = DEFAULTS.driver
) -> PathDeviation:
    """The `PathDeviation` over ``length`` metres of ``path`` from arc length ``start``.

    The modes are the principal components of the path's reconstruction error and of lane keeping. A polynomial of the
    heading is not enough: what it cannot follow biases the depth, so the speed.
    """
    u = _distances(length)
    return _deviation(u, _principal_components(path, start, u, on_path, driver), driver)


def deviation_from_arc(
    arc: Path, start: float, length: float, path: Path, driver: DriverSettings = DEFAULTS.driver
) -> PathDeviation:
    """The `PathDeviation` from an ``arc`` over ``length`` metres from its arc length ``start``, by the drawn ``path``.

    A vehicle on a bend turns smoothly: the modes are a change of the arc's direction, its curvature and its surface.
    How well the drawing determines these, by generalised least squares, is their prior. The modes of the path's
    reconstruction themselves would leave the vehicle free to swerve where the drawing is uncertain; whether it does is
    for the motion term ``lane_change`` to tell.
    """
    u = _distances(length)
    F = arc.frames(start + u)
    s = path.nearest(arc.at(np.array(start))) + u
    drawn = (path.s[0] <= s) & (s <= path.s[-1])  # beyond its ends the path is not known
    tangent = np.einsum("uij,ui->uj", F[drawn], path.frames(s[drawn])[:, :, 0])
    angles = (tangent[:, 1:] / tangent[:, :1]).T  # yaw and pitch of the path, seen from the arc
    components = _principal_components(path, s[0] - u[0], u, True, driver)[..., drawn]
    reconstruction = components.reshape(len(components), angles.size)
    covariance = reconstruction.T @ reconstruction + ARC_MISFIT_STD_RAD**2 * np.eye(angles.size)
    gradients = np.stack(arc.heading_modes(start + u), axis=1)
    B = np.concatenate([_polynomial_modes(u, TURN_PRIOR), gradients])
    observed = B[..., drawn].reshape(len(B), angles.size)
    weighted = np.linalg.solve(covariance, observed.T)
    information, axes = np.linalg.eigh(observed @ weighted + np.eye(len(B)))
    root = axes / np.sqrt(information)  # of the covariance of the coefficients of B
    mean = root.T @ (weighted.T @ angles.ravel())
    return _deviation(u, np.tensordot(root.T, B, 1), driver, mean)


def heading_innovation(arc: Path, place: Array, path: Path, driver: DriverSettings = DEFAULTS.driver) -> float:
    """The yaw of a drawn ``path`` from the ``arc`` on which a vehicle drives, at a ``place`` (3,), in its standard
    deviations: of the path's reconstruction, of lane keeping and of the direction of travel."""
    tangent = arc.frames(np.array(arc.nearest(place))).T @ path.direction_near(place)
    by_mode, _ = path.heading_modes(np.array([path.nearest(place)]))
    std = np.sqrt(np.square(by_mode).sum() + driver.heading**2 + TRAVEL_YAW_STD_RAD**2)
    return abs(float(np.arctan2(tangent[1], tangent[0]))) / float(std)


def _distances(length: float) -> Array:
    """Distances (N,) at which the modes over ``length`` metres are given, a metre more at either end."""
    return np.linspace(-1.0, length + 1.0, 81)


def _principal_components(path: Path, start: float, u: Array, on_path: bool, driver: DriverSettings) -> Array:
    """Independent modes (K, 2, N) of the path's reconstruction error and of lane keeping at ``start + u`` (N,) m."""
    stds = direction_prior(driver) if on_path else FREE_DIRECTION_PRIOR
    orders = (4, 3) if path.shape == "curve" else (2, 2)
    stds = {axis: sigmas[:order] for (axis, sigmas), order in zip(stds.items(), orders, strict=True)}
    modes = [*_polynomial_modes(u, stds), *np.stack(path.heading_modes(start + u), axis=1)]
    if on_path and path.shape == "curve":
        modes += list(_yaw_process_modes(u, *LANE_KEEPING_GP))
    _, size, shapes = np.linalg.svd(np.reshape(modes, (len(modes), -1)), full_matrices=False)
    keep = size > MIN_MODE_RAD * np.sqrt(len(u))
    return np.asarray((size[keep, None] * shapes[keep]).reshape(-1, 2, len(u)))


def _polynomial_modes(u: Array, stds: Mapping[str, tuple[float, ...]]) -> list[Array]:
    """Modes (2, N) of polynomials of yaw and pitch in ``u`` (N,); ``stds`` are those of their derivatives at 0."""
    return [
        sigma * np.outer(axis, u**k / factorial(k))
        for axis, sigmas in zip(np.eye(2), stds.values(), strict=True)
        for k, sigma in enumerate(sigmas)
    ]


def _deviation(u: Array, modes: Array, driver: DriverSettings, mean: Array | None = None) -> PathDeviation:
    """The `PathDeviation` of ``modes`` (K, 2, N), with those of lane changes."""
    lane_change = _yaw_process_modes(u, driver.lane_change, driver.lane_change_length)
    means = np.zeros(len(modes) + len(lane_change))
    if mean is not None:
        means[: len(mean)] = mean
    return PathDeviation(u, np.concatenate([modes, lane_change]), len(lane_change), means)


def direction_prior(driver: DriverSettings) -> dict[str, tuple[float, ...]]:
    """Standard deviations along a path of a polynomial in the distance: direction (rad), curvature (1/m), and its
    derivatives."""
    return {
        "yaw": (driver.heading, *CURVATURE_PRIOR["yaw"]),
        "pitch": (driver.pitch, *CURVATURE_PRIOR["pitch"]),
    }


def _yaw_process_modes(u: Array, sigma: float, length: float) -> Array:
    """Modes (S, 2, N) of a smooth random yaw over the distance ``u`` (N,): ``sigma`` rad, correlated over ``length``
    m."""
    yaw = gaussian_process_modes(u, sigma, length)
    return np.stack([yaw, np.zeros_like(yaw)], axis=1)


def gaussian_process_modes(x: Array, sigma: float, scale: float) -> Array:
    """Modes (S, N) of a Gaussian process over ``x`` (N,) with a squared-exponential kernel, of standard deviation 1
    each."""
    kernel = sigma**2 * np.exp(-0.5 * ((x[:, None] - x) / scale) ** 2)
    variance, shapes = np.linalg.eigh(kernel)
    keep = variance > (MIN_MODE_SHARE * sigma) ** 2 * len(x)
    return np.asarray((np.sqrt(variance[keep]) * shapes[:, keep]).T)
