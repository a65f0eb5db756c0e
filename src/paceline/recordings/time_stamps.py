"""Time stamps of a recording: which frames are in order where some repeat or go back."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from paceline.arrays import Array, Indices, Mask

MIN_GAP_RATIO = 1.5  # ratio to the usual interval above which frames are reported as missing
IRREGULARITY_COST = 1e-6  # of an interval, beside that of frames that do not follow each other


def longest_increasing_subsequence(times: Sequence[float] | Array) -> Mask:
    """The most frames (N,) whose ``times`` (N,) strictly increase: a wrong time, be it too early or too late, so costs
    one frame.

    Of several choices that keep as many it is the one with the fewest interruptions, so that of recordings that were
    joined one counts; then the one whose intervals are nearest to whole multiples of the usual one; then the first one.
    """
    stamps = np.asarray(times, float)
    steps = np.diff(stamps)
    if (steps > 0).all():
        return np.ones(len(stamps), bool)
    before, after = _lengths(stamps), _lengths(-stamps[::-1])[::-1]
    candidates = np.flatnonzero(before + after - 1 == before.max())
    candidates = candidates[np.argsort(before[candidates], kind="stable")]
    levels = np.split(candidates, np.flatnonzero(np.diff(before[candidates])) + 1)
    usual_step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    cost, previous = np.zeros(len(stamps)), np.full(len(stamps), -1)
    for earlier, later in zip(levels, levels[1:], strict=False):
        for k in later:
            step = stamps[k] - stamps[earlier]
            irregularity = np.abs(step / usual_step - np.round(step / usual_step)).round(3)
            total = cost[earlier] + (earlier != k - 1) + IRREGULARITY_COST * irregularity
            best = int(np.argmin(np.where((earlier < k) & (step > 0), total, np.inf)))
            cost[k], previous[k] = total[best], earlier[best]
    selection = np.zeros(len(stamps), bool)
    frame = int(levels[-1][np.argmin(cost[levels[-1]])])
    while frame >= 0:
        selection[frame] = True
        frame = int(previous[frame])
    return selection


def _lengths(times: Array) -> Indices:
    """The length (N,) of the longest increasing sequence that ends with each of the ``times`` (N,) (Schensted 1961)."""
    lengths = np.zeros(len(times), np.int64)
    last: list[float] = []  # the least time with which a sequence of each length ends
    for k, time in enumerate(times.tolist()):
        place = bisect_left(last, time)
        lengths[k] = place + 1
        last[place : place + 1] = [time]
    return lengths
