"""Time stamps of a recording: which frames are in order where some repeat or go back."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from paceline.arrays import Array, Indices, Mask

MIN_GAP_RATIO = 1.5  # ratio to the usual interval above which frames are reported as missing
REGULARITY_DIGITS = 3  # decimal places of an interval, in usual ones, to which clocks are exact


def longest_increasing_subsequence(times: Sequence[float] | Array) -> Mask:
    """The most frames (N,) whose ``times`` (N,) strictly increase: a wrong time, be it too early or too late, so costs
    one frame.

    Where several choices keep as many, the one is made after which intervals are whole multiples of the usual one, and
    else the first one.
    """
    stamps = np.asarray(times)
    before, after = _lengths(stamps), _lengths(-stamps[::-1])[::-1]
    selection = np.zeros(len(stamps), bool)
    if not len(stamps):
        return selection
    total = int(before.max())
    levels: list[list[int]] = [[] for _ in range(total)]
    for k in np.flatnonzero(before + after - 1 == total).tolist():
        levels[before[k] - 1].append(k)
    steps = np.diff(stamps)
    usual_step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0

    def irregularity(frame: int, previous: int | None) -> float:
        step = 0.0 if previous is None else float(stamps[frame] - stamps[previous]) / usual_step
        return round(abs(step - round(step)), REGULARITY_DIGITS)

    previous: int | None = None
    for frames in levels:
        later = [k for k in frames if previous is None or (k > previous and stamps[k] > stamps[previous])]
        previous = min(later, key=lambda k: (irregularity(k, previous), k))
        selection[previous] = True
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
