"""Headways, clusters, and the standard error over them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from paceline.survey.statistics.clusters import clusters, recorded_days, share_std
from paceline.survey.statistics.headway import free_flow, headways

events = st.lists(st.tuples(st.integers(0, 60), st.integers(0, 2), st.sampled_from([0, 30])), min_size=1, max_size=40)


def passages(rows: list[tuple[int, int, int]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instants, lanes and beginnings of stretches; those before the second stretch begins are in the first."""
    at, lane, stretch = np.array(rows).T
    return at.astype(float) + stretch, lane, stretch.astype(float)


@given(events)
def test_a_headway_is_to_the_last_that_passed_earlier_in_the_lane(rows: list[tuple[int, int, int]]) -> None:
    at, lane, stretch = passages(rows)
    found = headways(at, lane, stretch)
    for i in range(len(rows)):
        ahead = at[(lane == lane[i]) & (stretch == stretch[i]) & (at < at[i])]
        assert found[i] == at[i] - ahead.max() if len(ahead) else math.isnan(found[i])


def test_free_flow_is_unknown_when_a_stretch_begins() -> None:
    at = np.array([3.0, 5.0, 10.0, 13.5, 17.5, 104.0])
    stretch = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 100.0])
    lane = np.zeros(6, int)
    lane[1] = 1
    headway = headways(at, lane, stretch)
    np.testing.assert_array_equal(free_flow(at, headway, stretch), [np.nan, 1.0, 1.0, 0.0, 1.0, 1.0])
    np.testing.assert_array_equal(free_flow(at, headway, stretch, 5.0), [np.nan, 1.0, 1.0, 0.0, 0.0, np.nan])
    assert len(headways(at[:0], lane[:0], stretch[:0])) == 0


def test_days_are_clusters_from_three_recorded_ones_on() -> None:
    day = np.repeat([5, 6, 9], [50, 60, 55])
    at, nothing = np.arange(165.0) * 30, np.zeros(165)
    found, lag = clusters(at, day, np.zeros(165, int), nothing)
    assert np.array_equal(found, day) and lag == 0
    assert recorded_days(np.repeat([5, 6, 9], [50, 60, 24])) == 2
    assert recorded_days(day[:0]) == 0
    assert clusters(at, np.minimum(day, 6), np.zeros(165, int), nothing)[1] == 1
    assert clusters(at, np.minimum(day, 6), np.zeros(165, int), nothing, "days")[1] == 0
    assert clusters(at, day, np.zeros(165, int), nothing, "recorded")[1] == 1


def test_a_platoon_is_in_its_leaders_quarter_hour() -> None:
    at = np.array([890.0, 897.0, 899.0, 902.0, 905.9, 909.9, 901.0])
    lane = np.array([0, 0, 0, 0, 0, 0, 1])
    found, _ = clusters(at, np.zeros(7, int), lane, np.zeros(7), "recorded")
    assert found.tolist() == [0, 0, 0, 0, 0, 1, 1]
    parted = clusters(at, np.zeros(7, int), lane, np.where(at < 900, 0.0, 900.0), "recorded")[0]
    assert parted.tolist() == [0, 0, 0, 1, 1, 1, 1]


def test_a_queue_is_not_one_cluster() -> None:
    """Vehicles 3 s apart for two hours: none is more than a quarter-hour before its own."""
    at = np.arange(0.0, 7200.0, 3.0)
    found, _ = clusters(at, np.zeros(2400, int), np.zeros(2400, int), np.zeros(2400), "recorded")
    own = at // 900
    assert ((found == own) | (found == own - 1)).all()
    assert len(np.unique(found)) == 7


@given(events, st.randoms())
def test_clusters_do_not_depend_on_the_order(rows: list[tuple[int, int, int]], random: object) -> None:
    order = list(range(len(rows)))
    random.shuffle(order)  # type: ignore[attr-defined]
    at, lane, stretch = passages(rows)
    day = np.zeros(len(rows), int)
    found, _ = clusters(at * 29, day, lane, stretch, "recorded")
    other, _ = clusters((at * 29)[order], day, lane[order], stretch[order], "recorded")
    assert np.array_equal(found[order], other)


def test_vehicles_that_are_their_own_clusters_have_the_standard_error_of_a_mean() -> None:
    psi = np.random.default_rng(1).normal(3, 2, 50)
    std, dof = share_std(psi, np.arange(50) * 5)
    assert std == pytest.approx(psi.std(ddof=1) / math.sqrt(50))
    assert dof == pytest.approx(49)


@given(st.lists(st.tuples(st.floats(-1, 1), st.integers(0, 12)), min_size=2, max_size=60), st.integers(0, 3))
def test_the_standard_error_is_that_of_the_formula(rows: list[tuple[float, int]], lag: int) -> None:
    psi, number = np.array(rows).T
    groups = sorted(set(number))
    std, dof = share_std(psi, number.astype(int), lag)
    if len(groups) < 2:
        assert std == math.inf and dof == 1
        return
    z = {g: (psi[number == g] - psi.mean()).sum() for g in groups}
    total = sum((1 - abs(g - h) / (lag + 1)) * z[g] * z[h] for g in groups for h in groups if abs(g - h) <= lag)
    G, sizes = len(groups), np.array([(number == g).sum() for g in groups])
    assert std == pytest.approx(math.sqrt(max(G / (G - 1) * total, 0)) / len(psi), abs=1e-7)
    factor = 1.5 / (1 + lag) if lag else 1
    assert dof == pytest.approx(max(factor * G / (1 + sizes.var() / sizes.mean() ** 2) - 1, 1))


def test_a_standard_error_holds_what_neighbours_share() -> None:
    """Moving averages of two: the variance of their mean is that of a lag-1 process."""
    rng = np.random.default_rng(4)
    stds, means = [], []
    for _ in range(300):
        x = rng.normal(size=201)
        group = (x[1:] + x[:-1]) / math.sqrt(2)
        psi = np.repeat(group, 5)
        means.append(psi.mean())
        stds.append([share_std(psi, np.repeat(np.arange(200), 5), lag)[0] for lag in (0, 1, 5)])
    true = np.std(means)
    without, one, five = np.sqrt(np.mean(np.square(stds), 0))
    assert without == pytest.approx(true / math.sqrt(2), rel=0.1)
    assert one == pytest.approx(true * math.sqrt(0.75), rel=0.1)
    assert five == pytest.approx(true * math.sqrt(11 / 12), rel=0.1)
    with pytest.raises(ValueError, match="lag: expected 0 or more"):
        share_std(np.ones(3), np.arange(3), -1)
