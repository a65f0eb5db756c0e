"""The shift of percentiles and shares by the measurement errors of single speeds."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from paceline.arrays import Array
from paceline.survey.statistics.common_error import PERCENTILE_BAND, band_weights
from paceline.survey.statistics.distribution import Distribution, distribution, weighted_mean, weighted_std

ADDED_VARIANCES = np.array([0.5, 1.0, 1.5, 2.0])  # λ of the simulation extrapolation, in variances of the errors
MAX_ERROR_SHARE = 0.5  # standard deviation of errors as a share of the speeds', above which neither can be told apart
LEAST_ERROR_MPS = 1e-9  # instead of 0, where a speed is exact
ROOT_TOLERANCE_MPS = 1e-7
NORMAL_REACH = 6.5  # standard deviations, beyond which a normal distribution leaves 10⁻¹⁰
# First distance from the percentile within which its root is sought, of the speeds' standard deviation
BRACKET_STEP_SHARE = 0.1


def measurement_shift(v: Array, w: Array, random_std: Array, p: float, speeds: Distribution | None = None) -> float:
    """δ, m/s, to be added to V_p of measured speeds for that of true ones; NaN where errors are too large.

    Simulation extrapolation (Cook & Stefanski 1994; of distribution functions with unequal errors Wang, Fan & Wang
    2010) with the convolution done exactly: V_p of F_λ(t) = Σ w Φ((t − v)/(√λ τ))/Σ w at λ = ½, 1, 1½, 2, a quadratic
    in λ through them, δ its value at λ = −1 less that at 0. ``v`` (N,) m/s, ``w`` (N,) weights, ``random_std`` (N,) m/s
    the standard deviation τ of each error; ``speeds`` is `distribution` (v, w) where it is known. NaN where no vehicle
    has a weight, and where τ (root mean square, between V_{p − 0.05} and V_{p + 0.05}) is above `MAX_ERROR_SHARE` of
    the speeds' standard deviation. Raises ValueError where ``p`` is not above 0 and below 1.
    """
    if not 0 < p < 1:
        raise ValueError(f"p: expected a share above 0 and below 1, found {p}")
    speeds = speeds or distribution(v, w)
    weighted = w > 0
    v, w, tau = v[weighted], w[weighted], np.maximum(random_std[weighted], LEAST_ERROR_MPS)
    if not len(v) or _are_too_large(v, w, tau, speeds.around(p, PERCENTILE_BAND)):
        return math.nan
    start, step = speeds.percentile(p), max(BRACKET_STEP_SHARE * weighted_std(v, w), LEAST_ERROR_MPS)
    return _extrapolated(
        np.array([_smoothed_percentile(v, w, math.sqrt(k) * tau, p, start, step) for k in ADDED_VARIANCES])
    )


def share_shift(v: Array, w: Array, random_std: Array, q: float, speeds: Distribution | None = None) -> float:
    """The shift to be added to the share of measured speeds up to ``q`` m/s for that of true ones.

    As `measurement_shift`, with F_λ(q) in place of a percentile, and NaN in the same cases.
    """
    speeds = speeds or distribution(v, w)
    weighted = w > 0
    v, w, tau = v[weighted], w[weighted], np.maximum(random_std[weighted], LEAST_ERROR_MPS)
    if not len(v) or _are_too_large(v, w, tau, speeds.around(speeds.share_up_to(q), PERCENTILE_BAND)):
        return math.nan
    return _extrapolated(np.array([_smoothed_share(q, v, w, math.sqrt(k) * tau) / w.sum() for k in ADDED_VARIANCES]))


def _are_too_large(v: Array, w: Array, tau: Array, band: tuple[float, float]) -> bool:
    mean_square = weighted_mean(tau**2, band_weights(v, w, band))
    std = weighted_std(v, w)
    return std > 0 and math.sqrt(mean_square) > MAX_ERROR_SHARE * std


def _smoothed_share(t: float, v: Array, w: Array, std: Array) -> float:
    """The weight up to ``t`` of speeds (N,) each of which is spread by ``std`` (N,)."""
    return float((w * ndtr((t - v) / std)).sum())


def _smoothed_percentile(v: Array, w: Array, std: Array, p: float, start: float, step: float) -> float:
    """The speed up to which the `_smoothed_share` is ``p`` of all weights, sought within ``step`` of ``start``, or
    twice that, and so on."""
    near = np.abs(v - start) < step + NORMAL_REACH * std
    weight = float(p * w.sum() - w[~near & (v <= start)].sum())
    v_near, w_near, std_near = v[near], w[near], std[near]

    def excess(t: float) -> float:
        return _smoothed_share(t, v_near, w_near, std_near) - weight

    lo, hi = start - step, start + step
    if excess(lo) <= 0 <= excess(hi):
        return float(brentq(excess, lo, hi, xtol=ROOT_TOLERANCE_MPS))
    return _smoothed_percentile(v, w, std, p, start, 2 * step)


def _extrapolated(values: Array) -> float:
    """The quadratic through ``values`` at `ADDED_VARIANCES`, at −1 less at 0."""
    quadratic, linear, _ = np.polyfit(ADDED_VARIANCES, values, 2)
    return float(quadratic - linear)
