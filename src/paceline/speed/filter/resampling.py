"""Weights in log space and the resampling schemes of particle filtering, on the CPU.

On a GPU the weights are computed by the kernels in `speed/filter/cuda/weights.py`, and particles are resampled by those
in `speed/filter/cuda/kernels.py`, by the systematic scheme only.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from paceline.arrays import Array, Indices

JITTER_SCALE = 0.1  # standard deviation of the jitter as a share of the static parameter's
SHRINKAGE = float(np.sqrt(1 - JITTER_SCALE**2))  # towards the mean, before the jitter [Liu and West 2001]
ESS_REL_TOLERANCE = 1e-9  # relative rounding error
Scheme = Callable[[Array, np.random.Generator], Indices]  # weights (N,) to indices (N,)

RESAMPLING_SCHEMES: dict[str, Scheme] = {}  # by name, in the order of registration


def resampling_scheme(scheme: Scheme) -> Scheme:
    """Register ``scheme`` under its function's name, as a decorator. Raises ValueError where that is taken."""
    if RESAMPLING_SCHEMES.setdefault(scheme.__name__, scheme) is not scheme:
        raise ValueError(f"resampling scheme {scheme.__name__!r} is registered twice")
    return scheme


class Weights:
    """Normalised weights of N particles, kept as logarithms: ``lw`` (N,), ``W`` (N,) and their effective size ``ESS``.

    Raises FloatingPointError where every particle has weight zero.
    """

    def __init__(self, lw: Array) -> None:
        with np.errstate(invalid="ignore"):  # −∞ + −∞ where every weight vanishes: raised below
            total = np.logaddexp.reduce(lw)
        if not np.isfinite(total):
            raise FloatingPointError("all particle weights vanish")
        self.lw = lw - total

    @classmethod
    def equal(cls, n: int) -> Weights:
        return cls(np.zeros(n))

    @cached_property
    def W(self) -> Array:
        return np.asarray(np.exp(self.lw))

    @cached_property
    def ESS(self) -> float:
        """1 / Σ W², between 1 and N."""
        return float(1.0 / np.sum(self.W**2))

    def updated(self, log_likelihood: Array) -> Weights:
        """The weights after an observation ([Zhu] (2))."""
        return Weights(self.lw + log_likelihood)

    def mean(self, values: Array) -> Array:
        """Posterior mean (…) of ``values`` (N, …) ([Zhu] (3))."""
        return np.asarray(self.W @ values.reshape(len(values), -1)).reshape(values.shape[1:])

    def covariance(self, values: Array) -> Array:
        """Posterior covariance (k, k) of ``values`` (N, k)."""
        deviation = values - self.mean(values)
        return np.asarray((self.W[:, None] * deviation).T @ deviation)

    def std(self, values: Array) -> Array:
        """Posterior standard deviation (…) of ``values`` (N, …)."""
        return np.sqrt(self.mean((values - self.mean(values)) ** 2))


def _inverse_cdf(points: Array, W: Array) -> Indices:
    cumulative = np.cumsum(W)
    cumulative[-1] = 1.0
    return np.searchsorted(cumulative, points, side="left").astype(np.int64)


@resampling_scheme
def systematic(W: Array, rng: np.random.Generator) -> Indices:
    """One uniform offset for all strata."""
    n = len(W)
    return _inverse_cdf((np.arange(n) + rng.random()) / n, W)


@resampling_scheme
def stratified(W: Array, rng: np.random.Generator) -> Indices:
    """One uniform draw in every stratum."""
    n = len(W)
    return _inverse_cdf((np.arange(n) + rng.random(n)) / n, W)


@resampling_scheme
def residual(W: Array, rng: np.random.Generator) -> Indices:
    """⌊N·W⌋ copies of each, the rest drawn by the residual weights."""
    n = len(W)
    copies = np.floor(n * W + 1e-9).astype(np.int64)
    copied = np.repeat(np.arange(n), copies)
    left = np.maximum(n * W - copies, 0.0)
    if len(copied) == n:
        return copied
    drawn = _inverse_cdf(np.sort(rng.random(n - len(copied))), left / left.sum())
    return np.concatenate([copied, drawn])


@resampling_scheme
def multinomial(W: Array, rng: np.random.Generator) -> Indices:
    """Independent draws."""
    return _inverse_cdf(np.sort(rng.random(len(W))), W)


def ess_sufficient(ess: float, n: int, below: float) -> bool:
    """Whether ``n`` particles with the effective sample size ``ess`` need no resampling: ``ess`` ≥ ``below`` · n."""
    return ess >= below * n * (1 - ESS_REL_TOLERANCE)


def resample(scheme: str, W: Array, rng: np.random.Generator) -> Indices:
    """Indices (N,) of the surviving particles, each expected N·W times."""
    return RESAMPLING_SCHEMES[scheme](W, rng)
