"""Groups of vehicles whose speeds are alike, and the standard error of a share over them."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from paceline.arrays import Array, Indices
from paceline.survey.statistics.headway import FREE_HEADWAY_S, headways, in_lane_order

Scope = Literal["auto", "days", "recorded"]

QUARTER_HOUR_S = 900.0
QUARTER_HOUR_LAG = 1  # quarter-hours up to which speeds may be alike
MIN_DAYS = 3  # recorded days from which on the interval is about days like these
MIN_QUARTER_HOURS = 12  # for an interval about the days recorded
MIN_DAY_SHARE = 0.5  # of the median day's passages, for a day to count as recorded


def clusters(line_at: Array, day: Indices, lane: Indices, stretch: Array, scope: Scope = "auto") -> tuple[Indices, int]:
    """The cluster (N,) of each passage, and up to which lag clusters with neighbouring numbers may be alike.

    ``days``: clusters are local days ``day`` (N,), lag 0. ``recorded``: quarter-hours, lag `QUARTER_HOUR_LAG`;
    ``line_at`` (N,) s counts from an instant at which one begins, ``lane`` and ``stretch`` (N,) are as for `headways`.
    A platoon, vehicles less than `FREE_HEADWAY_S` apart, is in its leader's quarter-hour, and no vehicle more than one
    quarter-hour before its own. ``auto``: ``days`` where `MIN_DAYS` days have at least `MIN_DAY_SHARE` of the median
    day's passages, else ``recorded``.
    """
    if scope == "days" or (scope == "auto" and recorded_days(day) >= MIN_DAYS):
        return day, 0
    order, _ = in_lane_order(line_at, lane, stretch)
    is_leader = ~(headways(line_at, lane, stretch)[order] < FREE_HEADWAY_S)
    leader = np.maximum.accumulate(np.where(is_leader, np.arange(len(order)), 0))
    leader_at = np.empty(len(order))
    leader_at[order] = line_at[order][leader]
    own, led = (np.floor(t / QUARTER_HOUR_S).astype(np.int64) for t in (line_at, leader_at))
    return np.maximum(led, own - 1), QUARTER_HOUR_LAG


def recorded_days(day: Indices) -> int:
    """The number of days with at least `MIN_DAY_SHARE` of the passages of the median one; ``day`` (N,) is the local
    day of each passage."""
    _, counts = np.unique(day, return_counts=True)
    return int((counts >= MIN_DAY_SHARE * np.median(counts)).sum()) if len(counts) else 0


def share_std(psi: Array, clusters: Indices, lag: int = 0) -> tuple[float, float]:
    """The standard error of a mean with influences ``psi`` (N,) over ``clusters`` (N,), and its degrees of freedom.

    z_g = Σ_{i∈g} (ψ_i − ψ̄); se = √(G/(G − 1) (Σ z_g² + Σ_k 2 (1 − k/(L + 1)) Σ z_g z_{g+k}))/N over lags k = 1 … L =
    ``lag``, with the weights of Bartlett (Newey & West 1987) between clusters whose numbers differ by k. Degrees of
    freedom are κ G/(1 + CV²) − 1, at least 1, CV the coefficient of variation of the clusters' sizes, and κ = 1, or
    1.5/(1 + L) where neighbours may be alike. Infinite with fewer than two clusters. Raises ValueError for a negative
    ``lag``.
    """
    if lag < 0:
        raise ValueError(f"lag: expected 0 or more clusters, found {lag}")
    numbers, member, sizes = np.unique(clusters, return_inverse=True, return_counts=True)
    G, N = len(numbers), len(psi)
    if G < 2:
        return math.inf, 1.0
    sums = np.bincount(member, psi)
    z = sums - sizes * (math.fsum(sums) / N)
    total = math.fsum(z**2)
    for k in range(1, lag + 1):
        following = np.minimum(np.searchsorted(numbers, numbers + k), G - 1)
        products = np.where(numbers[following] == numbers + k, z * z[following], 0.0)
        total += 2 * (1 - k / (lag + 1)) * math.fsum(products)
    std = math.sqrt(G / (G - 1) * max(total, 0.0)) / N
    effective = G / (1 + sizes.var() / sizes.mean() ** 2)
    return std, max((1.5 / (1 + lag) if lag else 1.0) * effective - 1, 1.0)
