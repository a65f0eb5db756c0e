"""Intervals, measurement errors, common errors, and estimates with all of them; differences of two."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, norm, t, ttest_ind

from paceline.survey.statistics.capture import capture_weights, influence
from paceline.survey.statistics.common_error import CommonError, band_weights, combination, common_std, response
from paceline.survey.statistics.comparison import difference, matching_weights
from paceline.survey.statistics.distribution import percentile, weighted_mean
from paceline.survey.statistics.estimate import (
    Estimate,
    Passages,
    mean_estimate,
    pace_estimate,
    percentile_estimate,
    share_over_estimate,
)
from paceline.survey.statistics.interval import (
    Interval,
    joined,
    mean_interval,
    percentile_interval,
    share_interval,
    t_factor,
)
from paceline.survey.statistics.measurement_error import measurement_shift, share_shift
from paceline.survey.statistics.pace import pace

P = 0.85


def survey(seed: int = 0, N: int = 2000, days: int = 7, noise: float = 0.1) -> Passages:
    """Passages of several days at 17 ± 2 m/s, all measured."""
    rng = np.random.default_rng(seed)
    day = rng.integers(0, days, N)
    v = rng.normal(17, 2, N) + 0.3 * rng.normal(size=days)[day] + noise * rng.normal(size=N)
    measured = np.ones(N, bool)
    w, bins = capture_weights(v, measured, np.zeros(N, np.int64))
    return Passages(v, np.full(N, noise), measured, w, bins, day, 0, np.ones(N))


# --- random errors -------------------------------------------------------------------------------------------------


def test_with_vehicles_as_clusters_the_interval_is_near_that_of_order_statistics() -> None:
    group = survey(N=4000)
    own = replace(group, clusters=np.arange(4000))
    found = percentile_estimate(own, P, {}).random
    v = np.sort(group.v)
    lo, hi = (v[int(binom.ppf(q, 4000, P))] for q in (0.025, 0.975))
    assert (found.lo, found.hi) == (pytest.approx(lo, abs=0.02), pytest.approx(hi, abs=0.02))
    assert found.value == percentile(group.v, np.ones(4000), P)


def test_with_vehicles_as_clusters_the_mean_has_students_interval() -> None:
    x = np.random.default_rng(5).normal(20, 3, 150)
    found = mean_interval(x.mean(), np.ones(150), x - x.mean(), np.arange(150), 0)
    lo, hi = t.interval(0.95, 149, x.mean(), x.std(ddof=1) / math.sqrt(150))
    assert (found.lo, found.hi, found.dof) == (pytest.approx(lo), pytest.approx(hi), pytest.approx(149))


@pytest.mark.parametrize(
    ("clusters", "lag", "measured", "has_bounds"),
    [
        (3, 0, 100, True),
        (2, 0, 100, False),
        (1, 0, 100, False),
        (3, 0, 99, False),
        (12, 1, 100, True),
        (11, 1, 500, False),
    ],
)
def test_too_few_vehicles_or_clusters_have_a_value_without_an_interval(
    clusters: int, lag: int, measured: int, has_bounds: bool
) -> None:
    v = np.random.default_rng(0).normal(17, 2, measured)
    w, number = np.ones(measured), np.arange(measured) % clusters
    for found in (
        percentile_interval(v, w, (v <= percentile(v, w, P)) - P, number, P, lag),
        mean_interval(v.mean(), w, v - v.mean(), number, lag),
        share_interval(0.5, w, (v > np.median(v)) - 0.5, number, lag),
    ):
        assert math.isfinite(found.value)
        assert not math.isnan(found.lo) == has_bounds == (not math.isnan(found.hi))


def test_least_is_what_the_caller_says() -> None:
    v, w = np.random.default_rng(0).normal(17, 2, 40), np.ones(40)
    psi, number = (v <= percentile(v, w, P)) - P, np.arange(40) % 4
    assert math.isnan(percentile_interval(v, w, psi, number, P, 0).lo)
    assert math.isfinite(percentile_interval(v, w, psi, number, P, 0, least=30).lo)


def test_equal_speeds_have_an_interval_of_no_width() -> None:
    group = replace(survey(N=300), v=np.full(300, 15.0), random_std=np.zeros(300))
    found = percentile_estimate(group, P, {}).interval()
    assert (found.value, found.lo, found.hi) == (pytest.approx(15.0),) * 3
    assert share_over_estimate(group, 15.0, {}).interval().value == 0.0
    band = pace(group.v, group.w, 4.0)
    assert (band.hi, band.share) == (15.0, 1.0)


def test_nobody_measured_gives_no_number_and_no_failure() -> None:
    nothing = np.full(200, np.nan)
    w, bins = capture_weights(np.linspace(10, 20, 200), np.zeros(200, bool), np.zeros(200, np.int64))
    group = Passages(nothing, nothing, np.zeros(200, bool), w, bins, np.arange(200) % 7, 0, np.ones(200))
    blocks = {"rig": (np.zeros((200, 2)), np.eye(2))}
    for estimate in (
        percentile_estimate(group, P, blocks),
        mean_estimate(group, blocks),
        share_over_estimate(group, 15.0, blocks),
        pace_estimate(group, pace(group.v, group.w, 4.0), blocks),
    ):
        found = estimate.interval()
        assert all(map(math.isnan, (found.value, found.lo, found.hi)))


def test_a_share_that_nobody_has_is_bounded_by_the_number_of_vehicles() -> None:
    w, number = np.ones(200), np.arange(200) % 5
    none, every = (share_interval(share, w, np.zeros(200), number, 0) for share in (0.0, 1.0))
    assert none.lo == 0.0 and binom.pmf(0, 200, none.hi) == pytest.approx(0.025)
    assert every.hi == 1.0 and every.lo == pytest.approx(1 - none.hi)


@given(st.integers(0, 10**6), st.floats(0.02, 0.98), st.integers(1, 3))
def test_an_interval_holds_its_value(seed: int, p: float, decimals: int) -> None:
    rng = np.random.default_rng(seed)
    v, w, number = np.round(rng.gamma(9, 2, 150), decimals), rng.choice([1.0, 1.1, 2.0], 150), rng.integers(0, 6, 150)
    q = percentile(v, w, p)
    psi = influence(v, w, np.ones(150, bool), np.zeros(150, np.int64), q, p)
    found = percentile_interval(v, w, psi, number, p, 0)
    assert v.min() <= found.lo <= found.value == q <= found.hi <= v.max()


def test_a_percentile_of_all_or_none_is_refused() -> None:
    for p in (0.0, 1.0):
        with pytest.raises(ValueError, match="p: expected a share above 0 and below 1"):
            percentile_interval(np.ones(5), np.ones(5), np.zeros(5), np.arange(5), p, 0)
        with pytest.raises(ValueError, match="p: expected a share above 0 and below 1"):
            measurement_shift(np.ones(5), np.ones(5), np.ones(5), p)


def test_arrays_of_other_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="clusters: expected 2000 values, found 1999"):
        replace(survey(), clusters=np.arange(1999))


# --- measurement errors --------------------------------------------------------------------------------------------


def test_the_shift_is_that_of_a_normal_distribution() -> None:
    """Of normal speeds with normal errors all percentiles are known: √(σ² + λ τ²) z in place of σ z."""
    N, sigma, tau = 200_001, 2.0, 0.6
    true = norm.ppf((np.arange(N) + 0.5) / N) * sigma + 17
    v = (true - 17) * math.sqrt(1 + tau**2 / sigma**2) + 17
    exact = norm.ppf(P) * (sigma - math.sqrt(sigma**2 + tau**2))
    assert measurement_shift(v, np.ones(N), np.full(N, tau), P) == pytest.approx(exact, rel=0.05)
    over = norm.sf(19, 17, sigma) - norm.sf(19, 17, math.sqrt(sigma**2 + tau**2))
    assert -share_shift(v, np.ones(N), np.full(N, tau), 19.0) == pytest.approx(over, rel=0.05)


def test_the_shift_takes_off_what_unequal_errors_add() -> None:
    rng = np.random.default_rng(12)
    true = rng.gamma(60, 0.28, 100_000)
    tau = 0.5 * np.exp(0.4 * rng.normal(size=len(true)))
    v, w = true + tau * rng.normal(size=len(true)), rng.choice([1.0, 1.2], len(true))
    added = percentile(v, w, P) - percentile(true, w, P)
    assert added > 0.05
    assert -measurement_shift(v, w, tau, P) == pytest.approx(added, abs=0.02)


def test_exact_speeds_are_not_shifted() -> None:
    v = np.random.default_rng(2).normal(17, 2, 1000)
    assert measurement_shift(v, np.ones(1000), np.zeros(1000), P) == pytest.approx(0.0, abs=1e-6)
    assert share_shift(v, np.ones(1000), np.zeros(1000), 18.0) == pytest.approx(0.0, abs=1e-9)


def test_errors_as_large_as_the_scatter_leave_a_percentile_without_bounds() -> None:
    group = replace(survey(), random_std=np.full(2000, 1.2))
    estimate = percentile_estimate(group, P, {})
    assert math.isnan(estimate.shift) and math.isnan(estimate.interval().lo)
    assert math.isnan(share_over_estimate(group, 18.0, {}).interval().hi)
    assert math.isfinite(mean_estimate(group, {}).interval().lo)


def test_a_shift_is_applied_where_it_matters() -> None:
    estimate = Estimate(Interval(20.0, 19.0, 21.5, 6.0), -0.06)
    assert not estimate.is_shifted() and estimate.interval() == Interval(20.0, 19.0, 21.5)
    shifted = replace(estimate, shift=-0.1)
    assert shifted.is_shifted() and shifted.interval() == joined(19.9, estimate.random, 0.0)
    assert shifted.interval().lo == pytest.approx(19.9 - math.hypot(1.0, 0.04))
    assert shifted.interval().hi == pytest.approx(19.9 + math.hypot(1.5, 0.04))


# --- common errors -------------------------------------------------------------------------------------------------


def test_a_common_error_is_that_of_drawn_calibrations() -> None:
    """Speeds move with the parameters; V85 of the moved speeds scatters by what `common_std` states."""
    group, rng = survey(N=3000), np.random.default_rng(7)
    A = rng.normal(size=(3, 3))
    S = A @ A.T
    g = np.column_stack([group.v * 0.002, 0.02 * (group.v - 17), 0.03 * np.arange(3000) / 3000])
    weights = band_weights(group.v, group.w, group.speeds.around(P, 0.05))
    stated = common_std([g @ S], [S], weights)
    drawn = [percentile(group.v + g @ rng.multivariate_normal(np.zeros(3), S), group.w, P) for _ in range(1500)]
    assert stated == pytest.approx(np.std(drawn), rel=0.08)


def test_blocks_add_up_and_the_units_of_parameters_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    A, g, weights = rng.normal(size=(4, 4)), rng.normal(size=(20, 4)), rng.uniform(size=20)
    S = A @ A.T
    h = weighted_mean(g[:, 0], weights), *(weighted_mean(g[:, k], weights) for k in (1, 2, 3))
    exact = math.sqrt(np.array(h) @ S @ np.array(h))
    assert common_std([g @ S], [S], weights) == pytest.approx(exact)
    units = np.diag([1e-7, 1.0, 1e4, 1.0])
    assert common_std([g @ S @ units], [units @ S @ units], weights) == pytest.approx(exact)
    assert common_std([g @ S, g @ S], [S, S], weights) == pytest.approx(math.sqrt(2) * exact)
    assert common_std([], [], weights) == 0.0
    assert common_std([g @ S], [S], np.zeros(20)) == 0.0
    known = np.zeros((4, 4))  # a block whose parameters are exact
    assert common_std([g @ known], [known], weights) == 0.0


def test_a_singular_covariance_has_a_pseudo_inverse() -> None:
    u = np.array([[1.0], [2.0], [0.0]])
    S = u @ u.T
    g = np.array([[0.5, -0.1, 9.0]])
    assert common_std([g @ S], [S], np.ones(1)) == pytest.approx(abs((g @ u).item()))


def test_vehicles_of_other_blocks_count_0() -> None:
    c = np.array([[2.0], [2.0], [0.0], [0.0]])
    assert response(c, np.array([1.0, 1.0, 1.0, 1.0])) == pytest.approx([1.0])
    assert common_std([c, c[::-1]], [np.eye(1), np.eye(1)], np.ones(4)) == pytest.approx(math.sqrt(2))


def test_a_common_error_moves_a_share_by_the_density() -> None:
    """A scale of 1 % of standard deviation: shares over a limit, and of the pace, of speeds that are scaled."""
    group = survey(N=20_000)
    blocks = {"rig": (0.01 * group.v[:, None], np.eye(1))}
    over, mean = share_over_estimate(group, 18.5, blocks), mean_estimate(group, blocks)
    moved = [(group.v * s > 18.5).mean() for s in (0.98, 1.02)]
    assert over.systematic_std == pytest.approx((moved[1] - moved[0]) / 4, rel=0.05)
    assert mean.systematic_std == pytest.approx(0.01 * group.v.mean())
    band = pace(group.v, group.w, 4.0)
    shares = [((group.v * s >= band.lo) & (group.v * s <= band.hi)).mean() for s in (0.99, 1.0, 1.01)]
    assert pace_estimate(group, band, blocks).systematic_std == pytest.approx(abs(shares[2] - shares[0]) / 2, abs=0.003)


def test_shares_keep_to_their_limits() -> None:
    group = survey(N=1000)
    blocks = {"rig": (0.2 * group.v[:, None], np.eye(1))}
    found = share_over_estimate(group, 22.0, blocks).interval()
    assert found.lo == 0.0 < found.value < found.hi <= 1.0


# --- joined --------------------------------------------------------------------------------------------------------


def test_joined_half_widths_are_the_root_of_the_sum_of_squares() -> None:
    found = joined(20.5, Interval(20.0, 19.0, 22.0, 6.0), 1.0)
    others = 1.959964**2 + 0.2**2
    assert found.value == 20.5
    assert found.lo == pytest.approx(20.5 - math.sqrt(1 + others), abs=1e-5)
    assert found.hi == pytest.approx(20.5 + math.sqrt(4 + others), abs=1e-5)


@given(st.floats(5, 50), st.floats(0, 3), st.floats(0, 3), st.floats(0, 2), st.floats(-1, 1))
def test_more_errors_never_narrow_an_interval(value: float, below: float, above: float, s: float, shift: float) -> None:
    random = Interval(value, value - below, value + above)
    found = joined(value + shift, random, s)
    assert found.lo - shift <= random.lo + 1e-9 and found.hi - shift >= random.hi - 1e-9
    assert found.lo <= found.value <= found.hi


# --- comparison ----------------------------------------------------------------------------------------------------


def test_the_difference_of_means_has_welchs_interval() -> None:
    rng = np.random.default_rng(6)
    x, y = rng.normal(17, 2, 12), rng.normal(16, 5, 25)
    a, b = (
        Estimate(mean_interval(z.mean(), np.ones(len(z)), z - z.mean(), np.arange(len(z)), 0, least=3)) for z in (x, y)
    )
    exact = ttest_ind(y, x, equal_var=False)
    found = difference(a, b)
    lo, hi = exact.confidence_interval(0.95)
    assert found.random.dof == pytest.approx(exact.df)
    assert (found.interval().lo, found.interval().hi) == (pytest.approx(lo), pytest.approx(hi))


def test_one_rig_cancels_and_two_add_up() -> None:
    random = Interval(20.0, 20.0, 20.0)
    S = np.diag([1.0, 4.0])
    a = Estimate(random, common={"rig": CommonError(np.array([0.3, 0.8]), S)})
    b = Estimate(replace(random, value=18.0, lo=18.0, hi=18.0), common={"rig": CommonError(np.array([0.27, 0.8]), S)})
    assert difference(a, b).systematic_std == pytest.approx(0.03)
    other = replace(b, common={"another": b.common["rig"]})
    assert difference(a, other).systematic_std == pytest.approx(math.hypot(0.3, 0.4, 0.27, 0.4))
    assert difference(a, b).interval().value == -2.0


def test_half_widths_of_a_difference_are_scaled_to_the_pooled_degrees_of_freedom() -> None:
    a, b = Interval(20.0, 19.0, 21.5, 2.0), Interval(18.0, 17.5, 18.25, 6.0)
    found = difference(Estimate(a), Estimate(b, shift=0.1)).random
    s_a, s_b = 2.5 / 2 / t.ppf(0.975, 2), 0.75 / 2 / t.ppf(0.975, 6)
    dof = (s_a**2 + s_b**2) ** 2 / (s_a**4 / 2 + s_b**4 / 6)
    scale_a, scale_b = t.ppf(0.975, dof) / t.ppf(0.975, 2), t.ppf(0.975, dof) / t.ppf(0.975, 6)
    assert found.dof == pytest.approx(dof)
    assert found.lo == pytest.approx(-2 - math.hypot(0.5 * scale_b, 1.5 * scale_a))
    assert found.hi == pytest.approx(-2 + math.hypot(0.25 * scale_b, 1.0 * scale_a))
    assert difference(Estimate(a, 0.3), Estimate(b, 0.1)).shift == pytest.approx(-0.2)


def test_a_side_without_an_interval_leaves_the_difference_without_one() -> None:
    found = difference(
        Estimate(Interval(20.0, math.nan, math.nan)), Estimate(Interval(18.0, 17.0, 19.0, 5.0))
    ).interval()
    assert found.value == -2.0 and math.isnan(found.lo) and math.isnan(found.hi)


def test_a_controls_change_is_subtracted() -> None:
    site = difference(Estimate(Interval(20.0, 19.0, 21.0)), Estimate(Interval(18.0, 17.0, 19.0)))
    control = difference(Estimate(Interval(15.0, 14.0, 16.0)), Estimate(Interval(14.5, 13.5, 15.5)))
    found = difference(control, site).interval()
    assert (found.value, found.hi) == (pytest.approx(-1.5), pytest.approx(0.5))


def test_t_is_normal_without_end() -> None:
    assert t_factor(math.inf) == pytest.approx(1.959964, abs=1e-6)
    assert t_factor(6.0) == pytest.approx(t.ppf(0.975, 6))


cell_numbers = st.lists(st.integers(0, 6), min_size=1, max_size=60)


@given(cell_numbers, cell_numbers)
def test_matched_flows_are_those_before(before: list[int], after: list[int]) -> None:
    weights = matching_weights(np.array(before), np.array(after))
    common = set(before) & set(after)
    if not common:
        assert not weights[0].any() and not weights[1].any()
        return
    sums = [
        {k: w[np.array(c) == k].sum() / len(c) for k in range(7)} for w, c in zip(weights, (before, after), strict=True)
    ]
    kept = [k for k in before if k in common]
    for k in range(7):
        share = kept.count(k) / len(kept)
        assert sums[0][k] == pytest.approx(share) and sums[1][k] == pytest.approx(share)


def test_matching_takes_off_a_change_of_the_mixture() -> None:
    """Nobody drives faster, but there is more traffic on the fast lane: weighted, V85 stays."""
    rng = np.random.default_rng(9)
    lanes = np.arange(4000) % 2, (np.arange(4000) % 5 > 0).astype(np.int64)
    v = [rng.normal(15 + 4 * lane, 1.0) for lane in lanes]
    found = []
    for speeds, lane, flow in zip(v, lanes, matching_weights(*lanes), strict=True):
        w, bins = capture_weights(speeds, np.ones(4000, bool), lane)
        group = Passages(speeds, np.zeros(4000), np.ones(4000, bool), w, bins, np.arange(4000) // 500, 0, flow)
        found.append(mean_estimate(group, {}))
    unmatched = v[1].mean() - v[0].mean()
    change = difference(*found).interval()
    assert unmatched > 1.0
    assert change.lo < 0 < change.hi and change.hi - change.lo < 0.3


def test_combinations_keep_blocks_apart() -> None:
    one, two = ({name: CommonError(np.array([h]), np.eye(1))} for name, h in (("a", 1.0), ("b", 2.0)))
    found = combination([(2.0, one), (1.0, two), (-1.0, one)])
    assert {name: error.h.item() for name, error in found.items()} == {"a": 1.0, "b": 2.0}
