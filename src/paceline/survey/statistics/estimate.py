"""Percentiles, shares, pace and mean of the vehicles that passed, each with its random and its common errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from paceline.arrays import Array, Indices, Mask
from paceline.survey.statistics.capture import influence, score_influence
from paceline.survey.statistics.common_error import (
    PERCENTILE_BAND,
    CommonError,
    band_weights,
    combination,
    response,
    total_std,
)
from paceline.survey.statistics.distribution import Distribution, distribution, share_over, weighted_mean
from paceline.survey.statistics.interval import (
    Interval,
    joined,
    mean_interval,
    percentile_interval,
    share_interval,
)
from paceline.survey.statistics.measurement_error import measurement_shift, share_shift
from paceline.survey.statistics.pace import Band

MIN_SHIFT_SHARE = 0.05  # of the half-width, above which a shift by measurement error is applied
SHARE_LIMITS = 0.0, 1.0  # of all vehicles

Blocks = Mapping[str, tuple[Array, Array]]  # c (N, K) and S (K, K) by the name of the block


@dataclass(frozen=True, eq=False)
class Passages:
    """The passages of a group, aligned arrays (N,) in canonical order.

    ``v`` and ``random_std`` m/s, used where ``measured``; ``capture_weight`` and ``bins`` as `capture.capture_weights`
    gives them; ``clusters`` and ``lag`` as `clusters.clusters` does; ``flow``, of mean 1, weights of another mixture
    (`comparison.matching_weights`). Intervals need ``least`` measured vehicles. Raises ValueError where lengths differ.
    """

    v: Array
    random_std: Array
    measured: Mask
    capture_weight: Array
    bins: Indices
    clusters: Indices
    lag: int
    flow: Array
    least: int = 100

    def __post_init__(self) -> None:
        for name in ("random_std", "measured", "capture_weight", "bins", "clusters", "flow"):
            if len(getattr(self, name)) != len(self.v):
                raise ValueError(f"{name}: expected {len(self.v)} values, found {len(getattr(self, name))}")

    @cached_property
    def w(self) -> Array:
        return self.capture_weight * self.flow

    @cached_property
    def speeds(self) -> Distribution:
        return distribution(self.v, self.w)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A quantity with the interval of its ``random`` errors, its ``shift`` by measurement error (to be added; NaN where
    errors are too large for it), its ``common`` errors by the name of their block, and the ``limits`` of its values."""

    random: Interval
    shift: float = 0.0
    common: Mapping[str, CommonError] = field(default_factory=dict)
    limits: tuple[float, float] = (-math.inf, math.inf)

    @property
    def systematic_std(self) -> float:
        return total_std(self.common.values())

    def is_shifted(self) -> bool:
        """Whether the shift is applied: where it exceeds `MIN_SHIFT_SHARE` of the half-width without it."""
        without = joined(self.random.value, self.random, self.systematic_std)
        return abs(self.shift) > MIN_SHIFT_SHARE * (without.hi - without.lo) / 2

    def interval(self) -> Interval:
        """The value and the interval of all errors; without bounds where the shift is not known."""
        if math.isnan(self.shift):
            return Interval(self.random.value, math.nan, math.nan)
        shift = self.shift if self.is_shifted() else 0.0
        found = joined(self.random.value + shift, self.random, self.systematic_std)
        value, lo, hi = (float(np.clip(x, *self.limits)) for x in (found.value, found.lo, found.hi))
        return Interval(value, lo, hi)


def common_errors(passages: Passages, blocks: Blocks, band: tuple[float, float]) -> dict[str, CommonError]:
    """The common errors of a speed, m/s, that are those of the vehicles in ``band``, m/s."""
    weights = band_weights(passages.v, passages.w, band)
    return {name: CommonError(response(c, weights), S) for name, (c, S) in blocks.items()}


def percentile_estimate(passages: Passages, p: float, blocks: Blocks) -> Estimate:
    """V_p in m/s."""
    q = passages.speeds.percentile(p)
    psi = influence(passages.v, passages.capture_weight, passages.measured, passages.bins, q, p, passages.flow)
    random = percentile_interval(
        passages.v, passages.w, psi, passages.clusters, p, passages.lag, passages.least, passages.speeds
    )
    shift = measurement_shift(passages.v, passages.w, passages.random_std, p, passages.speeds)
    return Estimate(random, shift, common_errors(passages, blocks, passages.speeds.around(p, PERCENTILE_BAND)))


def mean_estimate(passages: Passages, blocks: Blocks) -> Estimate:
    """The mean speed in m/s; measurement errors of mean 0 do not shift it."""
    mean = weighted_mean(passages.v, passages.w)
    random = mean_interval(
        mean, passages.w, _influence(passages, passages.v - mean), passages.clusters, passages.lag, passages.least
    )
    return Estimate(random, 0.0, common_errors(passages, blocks, (-math.inf, math.inf)))


def share_over_estimate(passages: Passages, limit: float, blocks: Blocks) -> Estimate:
    """The share of vehicles faster than ``limit`` m/s."""
    share = share_over(passages.v, passages.w, limit)
    shift = -share_shift(passages.v, passages.w, passages.random_std, limit, passages.speeds)
    random = _share_interval(passages, share, passages.v > limit)
    return Estimate(random, shift, _share_errors(passages, blocks, limit), SHARE_LIMITS)


def pace_estimate(passages: Passages, band: Band, blocks: Blocks) -> Estimate:
    """The share of vehicles in ``band``, the pace: as where it lies is chosen by that share, where it lies does not add
    to its error in first order."""
    v, speeds = passages.v, passages.speeds
    below, up_to = (share_shift(v, passages.w, passages.random_std, edge, speeds) for edge in (band.lo, band.hi))
    inside = (v >= band.lo) & (v <= band.hi)
    errors = [_share_errors(passages, blocks, edge) for edge in (band.lo, band.hi)]
    random = _share_interval(passages, band.share, inside)
    return Estimate(random, up_to - below, combination([(1.0, errors[0]), (-1.0, errors[1])]), SHARE_LIMITS)


def _influence(passages: Passages, u: Array) -> Array:
    return score_influence(passages.flow * u, passages.capture_weight, passages.measured, passages.bins)


def _share_interval(passages: Passages, share: float, inside: Mask) -> Interval:
    psi = _influence(passages, inside.astype(float) - share)
    return share_interval(share, passages.w, psi, passages.clusters, passages.lag, passages.least)


def _share_errors(passages: Passages, blocks: Blocks, q: float) -> dict[str, CommonError]:
    """The common errors of the share of speeds above ``q`` m/s: those of speeds near it times their density."""
    speeds = passages.speeds
    band = speeds.around(speeds.share_up_to(q), PERCENTILE_BAND)
    share, width = speeds.share_up_to(band[1]) - speeds.share_up_to(band[0]), band[1] - band[0]
    return combination([(share / width if width > 0 else 0.0, common_errors(passages, blocks, band))])
