"""Weights against direct sums, resampling against its known expectations and bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import resampling
from paceline.speed.filter.resampling import RESAMPLING_SCHEMES, Weights, ess_sufficient, resample, resampling_scheme

LOG_WEIGHTS = st.lists(st.floats(-30, 30), min_size=1, max_size=60).map(np.array)
SHARES = st.lists(st.floats(0, 1), min_size=2, max_size=60).filter(lambda v: sum(v) > 0.1).map(np.array)
SEEDS = st.integers(0, 2**32 - 1)

W_EXAMPLES = {
    "spread": np.array([0.05, 0.31, 0.02, 0.17, 0.0, 0.24, 0.21]),
    "one heavy": np.array([0.01, 0.01, 0.93, 0.02, 0.01, 0.02]),
    "multiples of 1/N": np.array([0.5, 0.25, 0.0, 0.25]),
    "long tail": np.exp(-np.arange(40) / 5.0) / np.exp(-np.arange(40) / 5.0).sum(),
}


def counts_of(scheme, W, seed):
    return np.bincount(resample(scheme, W, np.random.default_rng(seed)), minlength=len(W))


@given(LOG_WEIGHTS, st.floats(-1e6, 1e6))
def test_a_constant_in_the_log_weights_changes_nothing(lw, shift):
    direct = np.exp(lw) / np.exp(lw).sum()
    for weights in (Weights(lw), Weights(lw + shift)):
        np.testing.assert_allclose(weights.W, direct, rtol=1e-8, atol=1e-12)
        assert weights.W.sum() == pytest.approx(1, abs=1e-8)  # log-weights of a million are exact to 1e-10


@given(LOG_WEIGHTS)
def test_the_effective_size_lies_between_one_and_N(lw):
    weights = Weights(lw)
    assert 1 - 1e-9 <= weights.ESS <= len(lw) * (1 + 1e-9)
    np.testing.assert_allclose(weights.ESS, np.exp(lw).sum() ** 2 / np.exp(2 * lw).sum(), rtol=1e-6)
    np.testing.assert_allclose(Weights.equal(len(lw)).ESS, len(lw))


@given(LOG_WEIGHTS, SEEDS)
def test_updates_multiply_and_moments_are_those_of_numpy(lw, seed):
    rng = np.random.default_rng(seed)
    log_likelihood = rng.normal(0, 5, len(lw))
    weights = Weights(lw).updated(log_likelihood)
    product = np.exp(lw - lw.max()) * np.exp(log_likelihood)
    np.testing.assert_allclose(weights.W, product / product.sum(), rtol=1e-8, atol=1e-12)
    values = rng.normal(3, 2, (len(lw), 4, 2))
    mean = np.average(values, axis=0, weights=product)
    np.testing.assert_allclose(weights.mean(values), mean, rtol=1e-9, atol=1e-9)
    variance = np.average((values - mean) ** 2, axis=0, weights=product)
    np.testing.assert_allclose(weights.std(values), np.sqrt(variance), rtol=1e-6, atol=1e-6)


def test_tiny_likelihoods_keep_their_ratios():
    weights = Weights.equal(3).updated(np.array([-1e6, -1e6 + np.log(2), -1e6 - 50000]))
    np.testing.assert_allclose(weights.W, [1 / 3, 2 / 3, 0], rtol=1e-9)


@pytest.mark.parametrize("lw", [[-np.inf, -np.inf, -np.inf], [-np.inf], [0.0, np.nan, 0.0]])
def test_weights_that_all_vanish_are_an_error(lw):
    with pytest.raises(FloatingPointError, match="weights vanish"):
        Weights(np.array(lw))


def test_some_weights_may_vanish():
    weights = Weights(np.array([-np.inf, 0.0, -np.inf, 0.0]))
    np.testing.assert_allclose(weights.W, [0, 0.5, 0, 0.5])
    np.testing.assert_allclose(weights.ESS, 2)


@pytest.mark.parametrize("scheme", RESAMPLING_SCHEMES)
@pytest.mark.parametrize("W", W_EXAMPLES.values(), ids=W_EXAMPLES)
def test_every_scheme_draws_N_W_copies_on_average(scheme, W):
    rng, draws = np.random.default_rng(11), 4000
    counts = np.array([np.bincount(resample(scheme, W, rng), minlength=len(W)) for _ in range(draws)])
    assert (counts.sum(1) == len(W)).all()
    # no scheme varies more than independent draws
    bound = 5 * np.sqrt(len(W) * W * (1 - W) / draws)
    assert (np.abs(counts.mean(0) - len(W) * W) <= bound + 1e-12).all()
    assert (counts.var(0) <= 1.15 * len(W) * W * (1 - W) + 0.01).all()


@settings(deadline=None)
@given(SHARES, SEEDS)
def test_deviations_stay_within_their_bounds(shares, seed):
    W = shares / shares.sum()
    N, expected = len(W), len(W) * W
    assert (np.abs(counts_of("systematic", W, seed) - expected) < 1 + 1e-9).all()
    assert (np.abs(counts_of("stratified", W, seed) - expected) < 2 + 1e-9).all()
    assert (counts_of("residual", W, seed) >= np.floor(expected - 1e-9)).all()
    # of the first k particles together no strata scheme draws more than one too many or too few
    for scheme in ("systematic", "stratified"):
        cumulative = np.cumsum(counts_of(scheme, W, seed)) - np.cumsum(expected)
        assert (np.abs(cumulative) < 1 + 1e-9).all()
    for scheme in RESAMPLING_SCHEMES:
        index = resample(scheme, W, np.random.default_rng(seed))
        assert index.shape == (N,) and ((index >= 0) & (index < N)).all()


@pytest.mark.parametrize("scheme", ["systematic", "stratified", "residual"])
def test_equal_weights_keep_every_particle(scheme):
    for N in range(1, 200):
        index = resample(scheme, Weights.equal(N).W, np.random.default_rng(N))
        assert sorted(index.tolist()) == list(range(N)), N


@pytest.mark.parametrize("scheme", RESAMPLING_SCHEMES)
@pytest.mark.parametrize("heavy", [0, 3, 9])
def test_one_particle_with_all_the_weight_is_the_only_survivor(scheme, heavy):
    lw = np.full(10, -2000.0)
    lw[heavy] = 0.0
    weights = Weights(lw)
    np.testing.assert_allclose(weights.ESS, 1)
    assert (resample(scheme, weights.W, np.random.default_rng(0)) == heavy).all()


@pytest.mark.parametrize("scheme", RESAMPLING_SCHEMES)
def test_resampling_depends_on_nothing_but_its_generator(scheme):
    W = Weights(np.random.default_rng(3).normal(0, 2, 500)).W
    a, b = (resample(scheme, W, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert len(np.unique(a)) < 500


@given(st.integers(1, 5000), st.floats(-50, 50))
def test_equal_weights_need_no_resampling_whatever_the_rounding(n: int, lw: float) -> None:
    weights = Weights(np.full(n, lw))
    assert ess_sufficient(weights.ESS, n, 1.0)
    assert not ess_sufficient(0.999 * weights.ESS, n, 1.0)
    assert ess_sufficient(0.501 * n, n, 0.5) and not ess_sufficient(0.499 * n, n, 0.5)


def test_a_registered_scheme_is_a_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValidationError, match="'systematic', 'stratified', 'residual' or 'multinomial'"):
        SpeedConfiguration(resampling="last_particle")

    def last_particle(W, rng):
        return np.full(len(W), len(W) - 1)

    monkeypatch.setattr(resampling, "RESAMPLING_SCHEMES", dict(RESAMPLING_SCHEMES))
    resampling_scheme(last_particle)
    name = SpeedConfiguration(resampling="last_particle").resampling
    assert (resample(name, np.array([0.5, 0.3, 0.2]), np.random.default_rng(0)) == 2).all()
    with pytest.raises(ValueError, match="registered twice"):
        resampling_scheme(scheme_named("last_particle"))


def scheme_named(name):
    def scheme(W, rng):
        return np.arange(len(W))

    scheme.__name__ = name
    return scheme
