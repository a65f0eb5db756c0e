"""Headways at the count line, and which vehicles drive freely."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Indices, Mask

# s: field evaluation for FHWA (TRID 269322) found platoons dissolved above this headway
FREE_HEADWAY_S = 4.0


def headways(line_at: Array, lane: Indices, stretch: Array) -> Array:
    """Headways (N,) s to the vehicle ahead in the same lane; NaN for the first of a lane in an observed stretch.

    ``line_at`` (N,) s are the instants at the count line, of all vehicles, measured or not; ``stretch`` (N,) s is the
    instant at which the observed stretch of each begins. The vehicle ahead is the last that passed earlier.
    """
    order, first = in_lane_order(line_at, lane, stretch)
    t = line_at[order]
    position = np.arange(len(t))
    later = first.copy()
    later[1:] |= t[1:] > t[:-1]
    run = np.maximum.accumulate(np.where(later, position, 0))  # first of those that pass at the same instant
    ahead = np.where(first[run], np.nan, t[run - 1])
    result = np.empty(len(t))
    result[order] = t - ahead
    return result


def free_flow(line_at: Array, headway: Array, stretch: Array, least_s: float = FREE_HEADWAY_S) -> Array:
    """1 for vehicles (N,) that follow none within ``least_s`` s, 0 for the others, NaN where it is not known.

    ``line_at`` and ``stretch`` (N,) s are as for `headways`, of which ``headway`` (N,) s comes. The first of a lane is
    free unless it passed within ``least_s`` after its observed stretch began: then it is not known.
    """
    gap = np.where(np.isnan(headway), line_at - stretch, headway)
    return np.where(gap >= least_s, 1.0, np.where(np.isnan(headway), np.nan, 0.0))


def in_lane_order(line_at: Array, lane: Indices, stretch: Array) -> tuple[Indices, Mask]:
    """The order (N,) of passages by lane, observed stretch and instant, and in it (N,) which are the first of their
    lane in a stretch."""
    order = np.lexsort((line_at, stretch, lane))
    first = np.ones(len(order), bool)
    first[1:] = (lane[order][1:] != lane[order][:-1]) | (stretch[order][1:] != stretch[order][:-1])
    return np.asarray(order, np.int64), first
