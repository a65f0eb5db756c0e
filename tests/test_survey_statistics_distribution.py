"""Percentiles, shares and the pace of speeds, against definitions by brute force."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from paceline.survey.statistics.distribution import (
    distribution,
    percentile,
    share_over,
    weighted_mean,
    weighted_std,
)
from paceline.survey.statistics.pace import pace

speeds = st.lists(st.tuples(st.integers(0, 30), st.integers(1, 4)), min_size=1, max_size=25)
shares = st.fractions(Fraction(1, 100), 1, max_denominator=100)


def arrays(vehicles: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    v, w = np.array(vehicles, float).T
    return v, w


@given(speeds, shares)
def test_a_percentile_is_the_smallest_speed_with_that_share(vehicles: list[tuple[int, int]], p: Fraction) -> None:
    total = sum(w for _, w in vehicles)
    exact = min(q for q, _ in vehicles if sum(w for v, w in vehicles if v <= q) >= p * total)
    assert percentile(*arrays(vehicles), float(p)) == exact


@given(speeds, shares, st.randoms())
def test_a_percentile_does_not_depend_on_the_order(
    vehicles: list[tuple[int, int]], p: Fraction, random: object
) -> None:
    """Not even in its last bit, with weights that are no binary fractions."""
    v, w = arrays(vehicles)
    shuffled = vehicles[:]
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    other_v, other_w = arrays(shuffled)
    one, other = distribution(v, w / 0.97), distribution(other_v, other_w / 0.97)
    assert one.share.tobytes() == other.share.tobytes() and one.v.tobytes() == other.v.tobytes()
    assert v.min() <= one.percentile(float(p)) <= v.max()


@pytest.mark.parametrize("count", [20, 100, 1000, 9973])
@pytest.mark.parametrize("weight", [1.0, 1 / 0.97, 1 / 3])
def test_rounding_does_not_move_a_percentile(count: int, weight: float) -> None:
    v = np.arange(1.0, count + 1)
    for hundredths in (15, 50, 85, 95):
        expected = math.ceil(Fraction(hundredths, 100) * count)
        assert percentile(v, np.full(count, weight), hundredths / 100) == expected


def test_vehicles_of_no_weight_do_not_count() -> None:
    v, w = np.array([10.0, np.nan, 12.0, 14.0, np.nan]), np.array([1.0, 0.0, 1.0, 2.0, 0.0])
    assert percentile(v, w, 0.5) == 12.0
    assert share_over(v, w, 12.0) == 0.5
    assert weighted_mean(v, w) == 12.5
    assert weighted_std(v, w) == pytest.approx(np.std([10, 12, 14, 14]))
    assert pace(v, w, 2.0).share == 0.75


def test_without_vehicles_there_is_no_number() -> None:
    v, w = np.full(3, np.nan), np.zeros(3)
    band = pace(v, w, 4.0)
    values = [percentile(v, w, 0.85), share_over(v, w, 10.0), weighted_mean(v, w), weighted_std(v, w)]
    assert all(map(math.isnan, [*values, band.lo, band.hi, band.share, distribution(v, w).share_up_to(10.0)]))


def test_shares_that_are_none_are_refused() -> None:
    for p in (0.0, -0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="p: expected a share"):
            percentile(np.ones(3), np.ones(3), p)
    with pytest.raises(ValueError, match="width: expected a positive speed"):
        pace(np.ones(3), np.ones(3), 0.0)


def test_the_share_over_a_limit_excludes_the_limit() -> None:
    v = np.array([10.0, 13.4, 13.4, 15.0])
    assert share_over(v, np.ones(4), 13.4) == 0.25
    assert distribution(v, np.ones(4)).share_up_to(13.4) == 0.75
    assert distribution(v, np.ones(4)).share_up_to(9.0) == 0.0


def test_the_speeds_around_a_percentile_end_at_the_slowest_and_the_fastest() -> None:
    speeds = distribution(np.arange(1.0, 101.0), np.ones(100))
    assert speeds.around(0.85, 0.05) == (80.0, 90.0)
    assert speeds.around(0.03, 0.05) == (1.0, 8.0)
    assert speeds.around(0.98, 0.05) == (93.0, 100.0)


@given(speeds, st.integers(1, 12))
def test_the_pace_holds_more_than_any_other_band(vehicles: list[tuple[int, int]], width: int) -> None:
    """Among all bands whose edges are multiples of a half, and the lowest of those that hold as many."""
    total = sum(w for _, w in vehicles)
    held = {lo: sum(w for v, w in vehicles if lo <= v <= lo + width) for lo in np.arange(-width - 1, 32, 0.5).tolist()}
    most = max(held.values())
    band = pace(*arrays(vehicles), width)
    assert band.share == pytest.approx(most / total)
    assert band.lo == min(lo for lo, weight in held.items() if weight == most)
    assert band.hi == band.lo + width
