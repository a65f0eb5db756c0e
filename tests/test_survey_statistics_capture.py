"""Vehicles without a speed: weights by rough speed, influences, worst cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from paceline.survey.statistics.capture import (
    MIN_BIN_MEASURED,
    capture_bounds,
    capture_weights,
    influence,
    score_influence,
)
from paceline.survey.statistics.distribution import percentile, share_over, weighted_mean


def drawn(seed: int, N: int, lanes: int = 2) -> tuple[np.ndarray, ...]:
    """Speeds, rough speeds, which are measured, and lanes: the fast ones are measured less often."""
    rng = np.random.default_rng(seed)
    v = rng.normal(17, 2, N)
    measured = rng.uniform(size=N) < np.where(v > 18, 0.6, 0.95)
    return v, v * (1 + 0.02 * rng.normal(size=N)), measured, rng.integers(0, lanes, N)


@given(st.integers(0, 10**6), st.integers(1, 400), st.integers(1, 4))
def test_the_weights_of_a_bin_are_those_of_all_its_passages(seed: int, N: int, lanes: int) -> None:
    _, rough, measured, lane = drawn(seed, N, lanes)
    w, bins = capture_weights(rough, measured, lane)
    passages, captured = np.bincount(bins), np.bincount(bins, measured)
    sums = np.bincount(bins, w)
    assert np.array_equal(np.unique(bins), np.arange(len(passages)))
    assert (w[~measured] == 0).all()
    np.testing.assert_allclose(sums[captured > 0], passages[captured > 0])
    if len(passages) > 1:
        assert passages.min() >= 30 and captured.min() >= MIN_BIN_MEASURED
        assert w.sum() == pytest.approx(N)


@given(st.integers(0, 10**6), st.integers(1, 300), st.booleans())
def test_the_weights_do_not_depend_on_the_order(seed: int, N: int, has_ties: bool) -> None:
    _, rough, measured, lane = drawn(seed, N)
    rough = np.round(rough) if has_ties else rough
    order = np.random.default_rng(seed).permutation(N)
    w, bins = capture_weights(rough, measured, lane)
    other_w, other_bins = capture_weights(rough[order], measured[order], lane[order])
    assert np.array_equal(other_w, w[order]) and np.array_equal(other_bins, bins[order])


def test_equal_rough_speeds_share_a_bin() -> None:
    rough = np.repeat([10.0, 11.0, 12.0], [100, 7, 100])
    _, bins = capture_weights(rough, np.ones(207, bool), np.zeros(207, int))
    assert all(len(np.unique(bins[rough == speed])) == 1 for speed in (10.0, 11.0, 12.0))
    assert len(np.unique(bins)) > 1


def test_bins_keep_to_a_stratum_and_small_strata_are_joined() -> None:
    lane = np.repeat([0, 1, 2], [200, 12, 200])
    rough = np.tile(np.linspace(10, 20, 103), 4)
    _, bins = capture_weights(rough, np.ones(412, bool), lane)
    assert not set(bins[lane == 0]) & set(bins[lane != 0])
    assert set(bins[lane == 1]) <= set(bins[lane == 2])


def test_passages_without_a_rough_speed_are_a_stratum_of_their_own() -> None:
    rough = np.concatenate([np.linspace(10, 20, 300), np.full(60, np.nan)])
    measured = np.ones(360, bool)
    measured[300:330] = False
    w, bins = capture_weights(rough, measured, np.zeros(360, int))
    assert len(np.unique(bins[300:])) == 1 and bins[300] not in bins[:300]
    assert (w[330:] == 2.0).all() and (w[:300] == 1.0).all()
    rough[310:] = 12.0
    _, bins = capture_weights(rough, measured, np.zeros(360, int))
    assert bins[300] == bins[np.argmin(np.abs(rough[:300] - np.median(rough[:300])))]


def test_nobody_measured_gives_no_weight() -> None:
    w, bins = capture_weights(np.linspace(10, 20, 50), np.zeros(50, bool), np.zeros(50, int))
    assert (w == 0).all() and (bins == 0).all()
    assert math.isnan(percentile(np.full(50, np.nan), w, 0.85))
    psi = influence(np.full(50, np.nan), w, np.zeros(50, bool), bins, 15.0, 0.85)
    assert np.isnan(psi).all()
    w, bins = capture_weights(np.zeros(0), np.zeros(0, bool), np.zeros(0, int))
    assert len(w) == len(bins) == 0
    with pytest.raises(ValueError, match="least: expected a positive number"):
        capture_weights(np.ones(3), np.ones(3, bool), np.zeros(3, int), least=0)


def test_weights_take_off_what_selection_adds() -> None:
    """V85 of measured vehicles is too low by 0.5 m/s where the fast ones are often not measured."""
    v, rough, measured, lane = drawn(3, 40_000)
    w, _ = capture_weights(rough, measured, lane)
    truth = percentile(v, np.ones(len(v)), 0.85)
    assert percentile(v, measured.astype(float), 0.85) < truth - 0.25
    assert percentile(v, w, 0.85) == pytest.approx(truth, abs=0.06)


@given(st.integers(0, 10**6), st.integers(40, 400), st.floats(0.05, 0.95))
def test_influences_sum_to_the_share_they_are_of(seed: int, N: int, p: float) -> None:
    v, rough, measured, lane = drawn(seed, N)
    measured[:30] = True
    w, bins = capture_weights(rough, measured, lane)
    q = percentile(v, w, p)
    psi = influence(np.where(measured, v, np.nan), w, measured, bins, q, p)
    share = 1 - share_over(np.where(measured, v, -np.inf), w, q)
    assert psi.sum() == pytest.approx(N * (share - p), abs=1e-6)
    assert -1e-9 <= psi.sum() <= w[v == q].sum() + 1e-6


def test_with_all_measured_an_influence_is_the_score() -> None:
    u = np.random.default_rng(0).normal(size=100)
    psi = score_influence(u, np.ones(100), np.ones(100, bool), np.arange(100) % 4)
    np.testing.assert_allclose(psi, u)


def test_an_influence_is_the_derivative_by_a_passages_weight() -> None:
    """By central differences: each passage counts 1 ± ε times, in the measured shares of the bins as in the mean."""
    v, rough, measured, lane = drawn(8, 300)
    w, bins = capture_weights(rough, measured, lane)
    flow = np.random.default_rng(2).uniform(0.5, 1.5, 300)

    def mean(counts: np.ndarray) -> float:
        share = np.bincount(bins, counts * measured) / np.bincount(bins, counts)
        return weighted_mean(v, measured * flow * counts / share[bins])

    value, step = mean(np.ones(300)), 1e-5
    psi = score_influence(flow * (v - value), w, measured, bins)
    scale = (w * flow).sum()  # of the sum that the mean is divided by
    for i in range(0, 300, 7):
        moved = step * (np.arange(300) == i)
        derivative = (mean(1 + moved) - mean(1 - moved)) / (2 * step)
        assert derivative == pytest.approx(psi[i] / scale, abs=1e-8)


@given(st.integers(0, 10**6), st.integers(2, 200), st.floats(0.1, 0.9))
def test_bounds_hold_whatever_the_unmeasured_drive(seed: int, N: int, p: float) -> None:
    v, rough, measured, _ = drawn(seed, N)
    std = np.full(N, 0.4)
    lo, hi = capture_bounds(np.where(measured, v, np.nan), rough, std, measured, p)
    nothing = np.full(N, np.nan)
    widest_lo, widest_hi = capture_bounds(np.where(measured, v, np.nan), nothing, nothing, measured, p)
    rng = np.random.default_rng(seed)
    each = np.ones(N)
    for _ in range(3):
        near = percentile(np.where(measured, v, rough + rng.uniform(-1.2, 1.2, N)), each, p)
        any_speed = percentile(np.where(measured, v, rng.uniform(0, 100, N)), each, p)
        assert lo <= near <= hi
        assert widest_lo <= any_speed <= widest_hi
    assert widest_lo <= lo and hi <= widest_hi


@pytest.mark.parametrize(("unmeasured", "is_finite"), [(0, True), (14, True), (15, False), (40, False), (90, False)])
def test_worst_cases_are_percentiles_of_the_measured(unmeasured: int, is_finite: bool) -> None:
    """At (p − u)/(1 − u) and p/(1 − u), infinite from u = 1 − p on, 0 from u = p on."""
    v = np.concatenate([np.arange(1.0, 101.0 - unmeasured), np.full(unmeasured, np.nan)])
    measured, nothing = ~np.isnan(v), np.full(100, np.nan)
    u, each = unmeasured / 100, measured.astype(float)
    lo, hi = capture_bounds(v, nothing, nothing, measured, 0.85)
    assert lo == (percentile(v, each, (0.85 - u) / (1 - u)) if u < 0.85 else 0.0)
    assert hi == (percentile(v, each, 0.85 / (1 - u)) if is_finite else math.inf)


def test_no_passages_have_no_bounds() -> None:
    nothing = np.zeros(0)
    assert all(map(math.isnan, capture_bounds(nothing, nothing, nothing, nothing.astype(bool), 0.85)))
