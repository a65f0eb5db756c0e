"""The slope of a line through points of which some are far off."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array


def theil_sen_slope(t: Array, s: Array) -> float:
    """The median of the slopes of all pairs (Theil 1950, Sen 1968); NaN where there is none."""
    i, j = np.triu_indices(len(t), 1)
    return float(np.median((s[j] - s[i]) / (t[j] - t[i]))) if len(i) else float("nan")
