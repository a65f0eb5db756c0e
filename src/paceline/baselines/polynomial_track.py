"""A polynomial track fitted to a vehicle's positions, and the speed along it with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array

MAX_DEGREE = 4
SPEED_SAMPLES = 257  # instants along a track at which its speed is sampled for the mean
MODEL_NAMES = {1: "constant velocity", 2: "constant acceleration"}


@dataclass(frozen=True, eq=False)
class PolynomialTrack:
    """A polynomial in time fitted to positions, relative to the first one.

    ``coefficients`` (degree, 3) of the powers 1 … degree of ``(t − times[0]) / length``; ``covariance`` (3·degree,
    3·degree) from the scatter of the positions about it, known from ``dof`` degrees of freedom.
    """

    times: Array
    coefficients: Array
    covariance: Array
    dof: float

    @property
    def degree(self) -> int:
        return len(self.coefficients)

    @property
    def model(self) -> str:
        return MODEL_NAMES.get(self.degree, f"polynomial of degree {self.degree}")

    def velocities(self, times: Array) -> Array:
        """(N, 3) m/s at ``times`` (N,)."""
        return self._slopes(times) @ self.coefficients

    def speeds(self, times: Array) -> tuple[Array, Array]:
        """Speeds (N,) and their standard uncertainties (N,), m/s."""
        speeds, rows = self._speeds_and_rows(times)
        return speeds, np.sqrt(np.einsum("na,ab,nb->n", rows, self.covariance, rows))

    def mean_speed(self) -> tuple[float, float]:
        """Length of the track divided by its duration, and the standard uncertainty, m/s."""
        t = np.linspace(self.times[0], self.times[-1], SPEED_SAMPLES)
        speeds, rows = self._speeds_and_rows(t)
        duration = t[-1] - t[0]
        row = np.trapezoid(rows, t, axis=0) / duration
        return float(np.trapezoid(speeds, t) / duration), float(np.sqrt(row @ self.covariance @ row))

    def _slopes(self, times: Array) -> Array:
        length = self.times[-1] - self.times[0]
        u = (times - self.times[0]) / length
        return np.stack([m * u ** (m - 1) / length for m in range(1, self.degree + 1)], axis=1)

    def _speeds_and_rows(self, times: Array) -> tuple[Array, Array]:
        slopes = self._slopes(times)
        v = slopes @ self.coefficients
        speeds = np.linalg.norm(v, axis=1)
        ahead = v / np.maximum(speeds, 1e-12)[:, None]
        return speeds, np.einsum("nm,nc->nmc", slopes, ahead).reshape(len(times), -1)


def fit_polynomial(times: Array, places: Array, covariance: Array, degree: int | None = None) -> PolynomialTrack:
    """The track fitted to positions ``places`` (K, 3) at ``times`` (K,), by generalised least squares.

    ``covariance`` (3(K−1), 3(K−1)) is that of the places relative to the first, up to a factor, which their scatter
    gives. Without a ``degree``, it is that of the least Bayesian information criterion. Raises
    numpy.linalg.LinAlgError where there are too few places.
    """
    K = len(times)
    if K < 3:
        raise np.linalg.LinAlgError("too few places")
    u = (times[1:] - times[0]) / (times[-1] - times[0])
    whitener = np.linalg.inv(np.linalg.cholesky(covariance))
    y = whitener @ (places[1:] - places[0]).ravel()
    n, best = len(y), None
    degrees = range(1, min(MAX_DEGREE, K - 2) + 1) if degree is None else [degree]
    for d in degrees:
        powers = np.stack([u**m for m in range(1, d + 1)], axis=1)
        rows = whitener @ np.kron(powers, np.eye(3))
        solution = np.linalg.lstsq(rows, y)[0]
        misfit, unknowns = float(((y - rows @ solution) ** 2).sum()), 3 * d
        criterion = n * np.log(max(misfit, 1e-12) / n) + unknowns * np.log(n)
        if best is None or criterion < best[0]:
            scatter = misfit / (n - unknowns)
            best = criterion, solution.reshape(d, 3), scatter * np.linalg.inv(rows.T @ rows), n - unknowns
    assert best is not None
    _, coefficients, spread, dof = best
    return PolynomialTrack(times, coefficients, spread, float(dof))
