"""Errors that the speeds of a calibration or of a recording have in common.

A block of them has K parameters with a covariance S (K, K); the covariance of a vehicle's error with that of each
parameter is c (K,), m/s times the parameter's unit, 0 for vehicles of other blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array

PERCENTILE_BAND = 0.05  # share of vehicles on each side of a percentile whose common error is the percentile's
PSEUDO_INVERSE_CUT = 1e-12  # of the largest eigenvalue, below which a combination of parameters has no variance


@dataclass(frozen=True, eq=False)
class CommonError:
    """The covariance ``h`` (K,) of an estimate's error with that of each parameter of a block, and ``S`` (K, K)."""

    h: Array
    S: Array

    @property
    def variance(self) -> float:
        """hᵀ S⁺ h, of the estimate, with the parameters in units of their standard deviations: in these, what counts as
        no variance does not depend on their units."""
        std = np.sqrt(np.diag(self.S))
        scale = np.divide(1.0, std, out=np.zeros(len(std)), where=std > 0)
        h = self.h * scale
        inverse = np.linalg.pinv(self.S * np.outer(scale, scale), rcond=PSEUDO_INVERSE_CUT, hermitian=True)
        return max(float(h @ inverse @ h), 0.0)


def band_weights(v: Array, w: Array, band: tuple[float, float]) -> Array:
    """The weights ``w`` (N,) of the vehicles whose speed ``v`` (N,) is in ``band`` (all m/s), 0 for the others."""
    return np.where((v >= band[0]) & (v <= band[1]), w, 0.0)


def response(c: Array, weights: Array) -> Array:
    """h (K,): the mean of ``c`` (N, K) with ``weights`` (N,), over vehicles of weight above 0; 0 without any."""
    weighted = weights > 0
    if not weighted.any():
        return np.zeros(c.shape[1])
    return np.asarray((weights[weighted, None] * c[weighted]).sum(0) / weights[weighted].sum())


def common_std(c: Sequence[Array], S: Sequence[Array], weights: Array) -> float:
    """√(Σ_b h_bᵀ S_b⁺ h_b), m/s: the standard deviation that errors in common give a mean with ``weights`` (N,).

    ``c`` holds (N, K_b) and ``S`` (K_b, K_b) for each block b, h_b is the `response`. For V_p the weights are
    `band_weights` between V_{p − 0.05} and V_{p + 0.05} (`PERCENTILE_BAND`): its error is that of the vehicles there.
    """
    return total_std(CommonError(response(c_b, weights), S_b) for c_b, S_b in zip(c, S, strict=True))


def total_std(errors: Iterable[CommonError]) -> float:
    """The standard deviation of the sum of independent ``errors``, in their unit."""
    return math.sqrt(math.fsum(error.variance for error in errors))


def combination(terms: Iterable[tuple[float, Mapping[str, CommonError]]]) -> dict[str, CommonError]:
    """Σ factor × error for ``terms`` of a factor and the errors by the name of their block: the same block's add up
    before they are squared."""
    found: dict[str, CommonError] = {}
    for factor, errors in terms:
        for name, error in errors.items():
            before = found[name].h if name in found else 0.0
            found[name] = CommonError(np.asarray(before + factor * error.h), error.S)
    return found
