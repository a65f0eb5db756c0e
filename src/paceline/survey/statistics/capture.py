"""Vehicles that passed without a speed: weights for the others, influence of each passage, and worst-case bounds."""

from __future__ import annotations

import math

import numpy as np

from paceline.arrays import Array, Indices, Mask
from paceline.survey.statistics.distribution import SHARE_ROUNDING, percentile

MIN_BIN_MEASURED = 10  # measured vehicles, for a measured share that is known to a third
MAX_BINS = 40  # of rough speed in a stratum; more follow the distribution no better where rough speeds are uncertain
ROUGH_SPEED_SIGMA = 3.0  # standard deviations of a rough speed within which the speed surely is


def capture_weights(rough: Array, measured: Mask, stratum: Indices, least: int = 30) -> tuple[Array, Indices]:
    """Weights (N,), 0 unless measured, and the bin (N,) of rough speed of each passage.

    ``rough`` (N,) m/s are rough speeds, NaN where there is none; ``measured`` (N,); ``stratum`` (N,), the lane. Each
    stratum is parted into bins of equal numbers of passages by their rough speed, of at least ``least`` passages and
    `MIN_BIN_MEASURED` measured ones; equal rough speeds share a bin. The weight is 1/π, π the measured share of the
    bin (Robins, Rotnitzky & Zhao 1994, with π by strata): right where, at the same rough speed, being measured does
    not depend on the true speed. Passages without a rough speed are a stratum of their own. A stratum with too few
    passages joins the one after it, the last the one before, there with its median where it has no rough speeds. Raises
    ValueError where ``least`` is not positive.
    """
    if least < 1:
        raise ValueError(f"least: expected a positive number of passages, found {least}")
    bins = np.zeros(len(rough), np.int64)
    count = 0
    for members in _joined_strata(rough, measured, stratum, least):
        speeds = rough[members]
        has_speed = ~np.isnan(speeds)
        speeds = np.where(has_speed, speeds, np.median(speeds[has_speed]) if has_speed.any() else 0.0)
        found = _equal_bins(speeds, measured[members], least)
        bins[members] = count + found
        count += int(found.max()) + 1
    passages, captured = np.bincount(bins), np.bincount(bins, measured)
    weights = np.divide(passages, captured, out=np.zeros(len(passages)), where=captured > 0)
    return np.where(measured, weights[bins], 0.0), bins


def _joined_strata(rough: Array, measured: Mask, stratum: Indices, least: int) -> list[Indices]:
    """The passages of each stratum, of those with too few joined."""
    _, key = np.unique(2 * stratum + np.isnan(rough), return_inverse=True)
    groups: list[Indices] = []
    rest = np.zeros(0, np.int64)
    for k in range(int(key.max(initial=-1)) + 1):
        rest = np.concatenate([rest, np.flatnonzero(key == k)])
        if _suffices(len(rest), int(measured[rest].sum()), least):
            groups.append(rest)
            rest = np.zeros(0, np.int64)
    if len(rest):
        groups[-1:] = [np.concatenate([*groups[-1:], rest])]
    return groups


def _suffices(passages: int, captured: int, least: int) -> bool:
    return passages >= least and captured >= MIN_BIN_MEASURED


def _equal_bins(rough: Array, measured: Mask, least: int) -> Indices:
    """The bin (N,) of each rough speed (N,), from 0 without gaps."""
    count = min(max(len(rough) // least, 1), MAX_BINS)
    ranks = np.arange(1, count) * len(rough) // count
    edges = np.unique(np.partition(rough, ranks)[ranks]) if count > 1 else np.zeros(0)
    bins = np.searchsorted(edges, rough, side="right")
    passages = np.bincount(bins, minlength=len(edges) + 1).tolist()
    captured = np.bincount(bins[measured], minlength=len(edges) + 1).tolist()
    numbers = np.zeros(len(passages), np.int64)
    number = first = 0  # of the bin that is being filled, and the first of those that are merged into it
    for k in range(len(passages)):
        if _suffices(sum(passages[first:k]), sum(captured[first:k]), least):
            number, first = number + 1, k
        numbers[k] = number
    if not _suffices(sum(passages[first:]), sum(captured[first:]), least):
        numbers[first:] = max(number - 1, 0)
    return np.asarray(numbers[bins])


def influence(
    v: Array, w: Array, measured: Mask, bins: Indices, q: float, p: float, flow: Array | float = 1.0
) -> Array:
    """ψ (N,): what each passage contributes to the share of speeds ``v`` (N,) up to ``q`` (m/s), less ``p``.

    As `score_influence` of flow (y − p), y = 1 where v ≤ q, with weights ``flow`` (N,) of mean 1 beside those of
    capture. Its sum is N (F(q) − p): 0 but for the step of F at q.
    """
    below = (v <= q).astype(float)
    return score_influence(flow * (below - p), w, measured, bins)


def score_influence(u: Array, w: Array, measured: Mask, bins: Indices) -> Array:
    """ψ (N,) of the weighted sum of scores ``u`` (N,) whose capture weights ``w`` (N,) are estimated in ``bins`` (N,).

    ψ = ū_b + 1{measured} w (u − ū_b), ū_b the mean score of the measured of the bin: the influence function of Robins,
    Rotnitzky & Zhao 1994. All N passages count, ``u`` only where ``measured`` (N,); it may be NaN elsewhere. Where no
    vehicle of a bin is measured, its ψ is NaN.
    """
    captured = np.bincount(bins, measured)
    sums = np.bincount(bins[measured], u[measured], minlength=len(captured))
    mean = np.divide(sums, captured, out=np.full(len(captured), np.nan), where=captured > 0)[bins]
    return np.asarray(mean + np.where(measured, w * (np.where(measured, u, 0.0) - mean), 0.0))


def capture_bounds(v: Array, rough: Array, rough_std: Array, measured: Mask, p: float) -> tuple[float, float]:
    """The least and the greatest V_p, m/s, whatever the speeds of the vehicles without one (Manski 1989, 2003).

    ``v`` (N,) m/s counts where ``measured`` (N,); each of the others is at ``rough`` (N,) − and +
    `ROUGH_SPEED_SIGMA` ``rough_std`` (N,) m/s, or where that is NaN, at 0 and at infinity. With NaN for all the bounds
    are the measured speeds' percentiles at (p − u)/(1 − u) and p/(1 − u), u the unmeasured share: 0 where u ≥ p,
    infinite where u ≥ 1 − p. NaN where there are no passages.
    """
    if not len(v):
        return math.nan, math.nan
    margin = ROUGH_SPEED_SIGMA * rough_std
    is_open = ~measured & (np.isnan(rough) | np.isnan(rough_std))
    slowest = np.where(measured, v, np.where(is_open, 0.0, np.maximum(rough - margin, 0.0)))
    fastest = np.where(measured, v, np.where(is_open, np.inf, rough + margin))
    each = np.ones(len(v))
    # where the open ones are exactly 1 − p of all, no speed is surely above V_p
    is_unbounded = is_open.mean() >= 1 - p - SHARE_ROUNDING
    return percentile(slowest, each, p), math.inf if is_unbounded else percentile(fastest, each, p)
