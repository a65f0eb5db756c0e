"""Intervals of 95 %: from the scatter of clusters, and joined with the errors that all speeds have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit, stdtrit

from paceline.arrays import Array, Indices
from paceline.survey.statistics.clusters import MIN_DAYS, MIN_QUARTER_HOURS, share_std
from paceline.survey.statistics.distribution import SHARE_ROUNDING, Distribution, distribution
from paceline.units import COVERAGE_95

UPPER_TAIL = 0.975  # probability below the upper end of a two-sided 95 % interval
# Half-width of the 95 % interval of a measurement-error shift, as a share of it: stated stds are good to 20 %, and it
# goes with their squares
SHIFT_HALF_WIDTH_SHARE = 0.4


@dataclass(frozen=True)
class Interval:
    """A ``value`` with its 95 % interval from ``lo`` to ``hi``, all in the unit of the quantity.

    ``lo`` and ``hi`` are NaN where there are too few vehicles or clusters for an interval. Half-widths are Student's t
    of ``dof`` degrees of freedom times a standard error; infinite for a normal distribution.
    """

    value: float
    lo: float
    hi: float
    dof: float = math.inf


def t_factor(dof: float) -> float:
    """The half-width of a 95 % interval in standard errors, by Student's t of ``dof`` degrees of freedom."""
    return COVERAGE_95 if math.isinf(dof) else float(stdtrit(dof, UPPER_TAIL))


def suffices(w: Array, clusters: Indices, lag: int, least: int) -> bool:
    """Whether there are ``least`` vehicles of weight ``w`` (N,) above 0, and `MIN_DAYS` clusters (N,), or where
    neighbours may be alike (``lag`` above 0) `MIN_QUARTER_HOURS`."""
    least_clusters = MIN_QUARTER_HOURS if lag else MIN_DAYS
    return int((w > 0).sum()) >= least and len(np.unique(clusters)) >= least_clusters


def percentile_interval(
    v: Array,
    w: Array,
    psi: Array,
    clusters: Indices,
    p: float,
    lag: int,
    least: int = 100,
    speeds: Distribution | None = None,
) -> Interval:
    """V_p of speeds ``v`` (N,) m/s with weights ``w`` (N,), and the interval of its scatter over ``clusters`` (N,).

    Woodruff 1952, on the logit scale (Korn & Graubard): from V at expit(logit p − t se/(p (1 − p))) to V at the same
    with +, where se and the degrees of freedom of Student's t are `share_std`'s of the influences ``psi`` (N,) and
    ``lag``. ``speeds`` is `distribution` (v, w) where it is known. Without bounds where not `suffices`; NaN where no
    vehicle has a weight. Raises ValueError where ``p`` is not above 0 and below 1.
    """
    if not 0 < p < 1:
        raise ValueError(f"p: expected a share above 0 and below 1, found {p}")
    speeds = speeds or distribution(v, w)
    value = speeds.percentile(p)
    if not suffices(w, clusters, lag, least):
        return Interval(value, math.nan, math.nan)
    std, dof = share_std(psi, clusters, lag)
    lo, hi = _logit_bounds(p, t_factor(dof) * std)
    return Interval(value, speeds.percentile(max(lo, SHARE_ROUNDING)), speeds.percentile(hi), dof)


def share_interval(share: float, w: Array, psi: Array, clusters: Indices, lag: int, least: int = 100) -> Interval:
    """A ``share`` of the weights ``w`` (N,) and the interval of its scatter over ``clusters`` (N,), on the logit scale.

    ``psi`` (N,) are its influences, as `capture.score_influence` gives them. A share of 0 or 1 shows no scatter: its
    interval is that of independent vehicles (Clopper & Pearson 1934). Without bounds where not `suffices`.
    """
    if not suffices(w, clusters, lag, least):
        return Interval(share, math.nan, math.nan)
    std, dof = share_std(psi, clusters, lag)
    if 0 < share < 1:
        return Interval(share, *_logit_bounds(share, t_factor(dof) * std), dof=dof)
    farthest = 1.0 - (1 - UPPER_TAIL) ** (1 / int((w > 0).sum()))
    lo, hi = (0.0, farthest) if share <= 0 else (1 - farthest, 1.0)
    return Interval(share, lo, hi, dof)


def mean_interval(mean: float, w: Array, psi: Array, clusters: Indices, lag: int, least: int = 100) -> Interval:
    """A ``mean`` with weights ``w`` (N,), ± Student's t times its standard error over ``clusters`` (N,).

    ``psi`` (N,) are its influences, in its unit. Without bounds where not `suffices`.
    """
    if not suffices(w, clusters, lag, least):
        return Interval(mean, math.nan, math.nan)
    std, dof = share_std(psi, clusters, lag)
    half = t_factor(dof) * std
    return Interval(mean, mean - half, mean + half, dof)


def joined(value: float, interval: Interval, systematic_std: float) -> Interval:
    """``value``, which is the ``interval``'s shifted by δ for measurement error, with an interval of all its errors.

    MOVER (Zou & Donner 2008): lo = value − √((q̂ − q_lo)² + (1.96 s)² + (0.4 δ)²) and hi likewise, with q̂, q_lo and q_hi
    the ``interval``'s and s the ``systematic_std`` of the common errors, all in one unit. Its ``dof`` is infinite, as
    its half-widths are no longer those of one Student's t.
    """
    shift = value - interval.value
    others = (COVERAGE_95 * systematic_std, SHIFT_HALF_WIDTH_SHARE * shift)
    below = math.hypot(interval.value - interval.lo, *others)
    above = math.hypot(interval.hi - interval.value, *others)
    return Interval(value, value - below, value + above)


def _logit_bounds(p: float, half: float) -> tuple[float, float]:
    """The ends of p ± ``half``, 0 < p < 1, on the logit scale."""
    scaled = half / (p * (1 - p))
    return float(expit(logit(p) - scaled)), float(expit(logit(p) + scaled))
