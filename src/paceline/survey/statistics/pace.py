"""The pace: the band of speeds that most vehicles keep to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.survey.statistics.distribution import SHARE_ROUNDING, Distribution, distribution


@dataclass(frozen=True)
class Band:
    """Speeds from ``lo`` to ``hi`` m/s, both included, and the ``share`` of vehicles that have them."""

    lo: float
    hi: float
    share: float


def pace(v: Array, w: Array, width: float, speeds: Distribution | None = None) -> Band:
    """The band of ``width`` m/s that holds the largest share of the weights ``w`` (N,) of speeds ``v`` (N,) m/s.

    The lowest of such bands: it ends at one of the speeds. ``speeds`` is `distribution` (v, w) where it is known. NaN
    where no vehicle has a weight; raises ValueError where ``width`` is not positive.
    """
    if not width > 0:
        raise ValueError(f"width: expected a positive speed in m/s, found {width}")
    speeds = speeds or distribution(v, w)
    if not len(speeds.v):
        return Band(math.nan, math.nan, math.nan)
    last = np.searchsorted(speeds.v, speeds.v, side="right") - 1
    below = np.searchsorted(speeds.v, speeds.v - width, side="left")
    shares = speeds.share[last] - np.where(below > 0, speeds.share[below - 1], 0.0)
    best = int(np.argmax(shares >= shares.max() - SHARE_ROUNDING))
    hi = float(speeds.v[best])
    return Band(hi - width, hi, float(shares[best]))
