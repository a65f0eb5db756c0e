"""The lines that compete for each feature of a model: where its edge points crowd, or where its mean profile steps."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Bytes, Floats, Indices, Mask
from paceline.numba_cache import cached_njit

CANDIDATES = 3  # lines that may compete for one feature
BIN = 0.5  # px, of the histogram in which they are found
BINS = 256
FAINT = 2.0  # times the threshold of one edge point, over √points, that a line's mean step must reach to be told
FAINT_PLACE = 0.4  # px: how well such a line is placed
WITHIN = 0.15  # of a feature's length at either end, where others meet it


@cached_njit(nogil=True, error_model="numpy")
def candidate_lines(
    points: Floats,
    owners: Indices,
    upright: bool,
    expected: Array,
    gates: Array,
    breadth: float,
    vertical: Mask,
    lines: Array,
) -> None:
    """The lines that compete for each feature: rows (place, points, variance) of ``lines`` (S, CANDIDATES, 3).

    They are the places where the feature's points crowd: peaks of a histogram across the feature about ``expected``
    (S,) px, within ``gates`` (S,) px of it; points within ``breadth`` px of a peak belong to it.
    """
    across = 0 if upright else 1
    members, begins = _grouped(points, owners, across, len(expected))
    histogram = np.zeros(BINS, np.float32)
    middle = BINS // 2
    size = BIN
    for j in range(len(expected)):
        size = max(size, 2.2 * gates[j] / BINS)
    reach = max(1, int(breadth / size))
    for j in range(len(expected)):
        if vertical[j] != upright:
            continue
        lines[j] = 0.0
        mine = members[begins[j] : begins[j + 1]]
        low, high = BINS, -1
        for p in mine:
            k = int(np.floor((p - expected[j]) / size + 0.5)) + middle
            if 0 <= k < BINS:
                histogram[k] += 1.0
                low, high = min(low, k), max(high, k)
        low, high = max(low - 1, 1), min(high + 2, BINS - 1)
        for c in range(CANDIDATES):
            top, most = 0, np.float32(0.0)
            for k in range(low, high):
                h = histogram[k - 1] + histogram[k] + histogram[k + 1]
                if h > most or (h == most and most > 0 and abs(k - middle) < abs(top - middle)):
                    top, most = k, h
            if most < 2.0:
                break
            place = expected[j] + (top - middle) * size
            n, total, squares = 0.0, 0.0, 0.0
            for sweep in range(2):
                n, total, squares = 0.0, 0.0, 0.0
                for p in mine:
                    d = p - place
                    if abs(d) <= breadth:
                        n += 1.0
                        total += d
                        squares += d * d
                if n == 0.0:
                    break
                if sweep == 0:
                    place += total / n
            if n > 0.0:
                lines[j, c, 0] = place + total / n
                lines[j, c, 1] = n
                lines[j, c, 2] = max(squares / n - (total / n) ** 2, 0.0)
            for k in range(max(top - reach - 1, 0), min(top + reach + 2, BINS)):
                histogram[k] = 0.0
        histogram[low - 1 : high + 1] = 0.0


@cached_njit(nogil=True, error_model="numpy")
def _grouped(points: Floats, owners: Indices, across: int, features: int) -> tuple[Array, Indices]:
    """Where the points of each feature lie across it, one feature's after the other's, and where each one's begin."""
    begins = np.zeros(features + 1, np.int64)
    for i in range(len(points)):
        if owners[i] >= 0:
            begins[owners[i] + 1] += 1
    begins = np.cumsum(begins)
    members, filled = np.empty(begins[-1]), begins[:-1].copy()
    for i in range(len(points)):
        j = owners[i]
        if j >= 0:
            members[filled[j]] = points[i, across]
            filled[j] += 1
    return members, begins


@cached_njit(nogil=True, error_model="numpy")
def add_shares(
    points: Floats, owners: Indices, upright: bool, places: Array, lengths: Array, breadth: float, shares: Array
) -> None:
    """Add to ``shares`` (S,) the share of each feature's length along which it has edge points of its own, those within
    ``breadth`` px of its measured place in ``places`` (S,) px; NaN there is a feature that was not found."""
    across = 0 if upright else 1
    for i in range(len(points)):
        j = owners[i]
        if j >= 0 and abs(points[i, across] - places[j]) <= breadth:
            shares[j] += 1.0 / lengths[j]


@cached_njit(nogil=True, error_model="numpy")
def faint_lines(
    image: Bytes,
    features: Array,
    spans: Array,
    reach: float,
    vertical: Mask,
    brighter: Indices,
    minimum_share: float,
    threshold: float,
    lines: Array,
) -> None:
    """A line for each feature whose edge points are too few for one in ``lines`` (S, CANDIDATES, 3).

    The brightness of ``image`` (H, W) is averaged along the feature, from ``spans`` (S, 2) px, and the greatest step
    across it taken within ``reach`` px of its place in ``features`` (S,) px: the mean of many pixels shows what none of
    them shows alone. ``threshold`` is that of one edge point; the step must have the sign ``brighter`` (S,).
    """
    steps = int(np.ceil(reach))
    profile = np.empty(2 * steps + 5)
    for j in range(len(features)):
        length = spans[j, 1] - spans[j, 0]
        known = False
        for c in range(lines.shape[1]):
            known = known or lines[j, c, 1] >= max(minimum_share * length, 2.0)
        first = int(np.floor(spans[j, 0] + WITHIN * length + 0.5))
        last = int(np.floor(spans[j, 1] - WITHIN * length + 0.5))
        begin = int(np.floor(features[j] + 0.5)) - steps - 2
        width, height = (image.shape[1], image.shape[0]) if vertical[j] else (image.shape[0], image.shape[1])
        if known or last < first or first < 0 or last >= height or begin < 0 or begin + len(profile) > width:
            continue
        n = last - first + 1
        profile[:] = 0.0
        if vertical[j]:
            for q in range(first, last + 1):
                for k in range(len(profile)):
                    profile[k] += image[q, begin + k]
        else:
            for k in range(len(profile)):
                for q in range(first, last + 1):
                    profile[k] += image[begin + k, q]
        top, most = -1, FAINT * threshold / np.sqrt(n)
        for k in range(2, len(profile) - 2):
            step = (profile[k + 1] - profile[k - 1]) / n
            rise = abs(step) if brighter[j] == 0 else brighter[j] * step
            if rise > most:
                top, most = k, rise
        if top < 0:
            continue
        sign = 1.0 if profile[top + 1] > profile[top - 1] else -1.0
        before = sign * (profile[top] - profile[top - 2]) / n
        after = sign * (profile[top + 2] - profile[top]) / n
        bend = before - 2.0 * most + after
        if bend >= 0.0 or before > most or after > most:
            continue  # the step goes on beyond its reach
        lines[j] = 0.0
        lines[j, 0, 0] = begin + top + 0.5 * (before - after) / bend
        lines[j, 0, 1] = length
        lines[j, 0, 2] = FAINT_PLACE * FAINT_PLACE * length
