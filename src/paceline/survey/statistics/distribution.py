"""The weighted distribution of speeds: percentiles, shares, mean and standard deviation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array

# Share of all weights: more than what rounding makes of sums of 10⁷, less than one vehicle of them
SHARE_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Distribution:
    """Speeds ``v`` (N,) m/s in ascending order and ``share`` (N,), the weighted share of vehicles up to each of them.

    Vehicles of equal speed are in order of their weights, so that rounding does not depend on the order given.
    """

    v: Array
    share: Array

    def percentile(self, p: float) -> float:
        """The smallest speed, m/s, up to which the share is at least ``p``; NaN where there are no vehicles.

        Raises ValueError where ``p`` is not above 0 and up to 1.
        """
        if not 0 < p <= 1:
            raise ValueError(f"p: expected a share above 0 and up to 1, found {p}")
        if not len(self.v):
            return math.nan
        return float(self.v[np.searchsorted(self.share, p - SHARE_ROUNDING)])

    def share_up_to(self, q: float) -> float:
        """The weighted share of vehicles with a speed of at most ``q`` m/s; NaN where there are no vehicles."""
        if not len(self.v):
            return math.nan
        count = int(np.searchsorted(self.v, q, side="right"))
        return float(self.share[count - 1]) if count else 0.0

    def around(self, p: float, margin: float) -> tuple[float, float]:
        """The percentiles ``margin`` below and above ``p``, m/s, or the slowest and the fastest vehicle's speed.

        NaN where there are no vehicles.
        """
        if not len(self.v):
            return math.nan, math.nan
        return self.percentile(max(p - margin, SHARE_ROUNDING)), self.percentile(min(p + margin, 1.0))


def distribution(v: Array, w: Array) -> Distribution:
    """The distribution of speeds ``v`` (N,) m/s with weights ``w`` (N,); those of weight 0 are left out, and may be
    NaN."""
    weighted = w > 0
    v, w = v[weighted], w[weighted]
    order = np.argsort(v)
    if (np.ptp(w) if len(w) else 0.0) > 0 and (v[order][1:] == v[order][:-1]).any():
        order = np.lexsort((w, v))  # four times slower than by one key
    total = np.cumsum(w[order], dtype=float)
    return Distribution(np.asarray(v[order], float), total / total[-1] if len(total) else total)


def percentile(v: Array, w: Array, p: float) -> float:
    """V_p: the smallest of the speeds ``v`` (N,) m/s up to which the share of the weights ``w`` (N,) is at least ``p``.

    The inverse of the distribution function (Hyndman & Fan 1996, definition 1, with weights), of single speeds. NaN
    where no vehicle has a weight; raises ValueError where ``p`` is not above 0 and up to 1.
    """
    return distribution(v, w).percentile(p)


def share_over(v: Array, w: Array, limit: float) -> float:
    """The share of the weights ``w`` (N,) of vehicles whose speed ``v`` (N,) is above ``limit`` (all m/s); NaN where no
    vehicle has a weight."""
    return weighted_mean(np.asarray(v > limit, float), w)


def weighted_mean(x: Array, w: Array) -> float:
    """The mean of ``x`` (N,) with weights ``w`` (N,), over those of weight above 0; NaN where there are none."""
    weighted = w > 0
    if not weighted.any():
        return math.nan
    return float((w[weighted] * x[weighted]).sum() / w[weighted].sum())


def weighted_std(x: Array, w: Array) -> float:
    """The standard deviation of ``x`` (N,) with weights ``w`` (N,), over those of weight above 0; NaN without any."""
    return math.sqrt(weighted_mean((x - weighted_mean(x, w)) ** 2, w))
