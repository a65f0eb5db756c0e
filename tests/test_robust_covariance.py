"""The mean of estimates from the same images, and its variance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from paceline.speed.refinement.robust_covariance import MIN_VARIANCE_SHARE, mean_of_estimates

sizes = st.integers(1, 9)
values = sizes.flatmap(lambda n: arrays(float, n, elements=st.floats(-50, 50)))


@given(values, st.floats(-50, 50))
def test_the_error_of_the_mean_is_the_mean_error_less_the_spread(x: np.ndarray, truth: float) -> None:
    """With variances that are the squared errors themselves, what is left is the squared error of the mean."""
    variances = np.maximum((x - truth) ** 2, 1e-3)
    weights, left = mean_of_estimates(x, variances)
    mean = weights @ x
    exact = weights @ (x - truth) ** 2 - weights @ (x - mean) ** 2
    assert exact == pytest.approx((mean - truth) ** 2, abs=1e-6)
    assert left == pytest.approx(max((mean - truth) ** 2, MIN_VARIANCE_SHARE * (weights @ variances)), abs=2e-3)


def test_estimates_are_weighted_by_their_variances() -> None:
    weights, left = mean_of_estimates(np.array([1.0, 3.0]), np.array([1.0, 4.0]))
    np.testing.assert_allclose(weights, [0.65, 0.35])
    assert left == pytest.approx(0.65 * 1.0 + 0.35 * 4.0 - 0.65 * 0.35 * 2.0**2)


def test_equal_estimates_have_the_variance_of_one() -> None:
    weights, left = mean_of_estimates(np.full(5, 20.0), np.full(5, 0.3))
    np.testing.assert_allclose(weights, 0.2)
    assert left == pytest.approx(0.3)


def test_a_minimum_share_of_the_variance_remains() -> None:
    _, left = mean_of_estimates(np.array([10.0, 20.0, 30.0]), np.ones(3))
    assert left == MIN_VARIANCE_SHARE


@pytest.mark.parametrize("shared", [0.3, 0.7, 0.95])
def test_the_variance_is_that_of_the_mean_of_correlated_estimates(shared: float) -> None:
    """Drawn with a share of their variance in common; the stated variance is the mean's, on the average over draws."""
    rng = np.random.default_rng(8)
    n, draws = 7, 4000
    errors = np.sqrt(shared) * rng.normal(size=(draws, 1)) + np.sqrt(1.0 - shared) * rng.normal(size=(draws, n))
    stated = np.mean([mean_of_estimates(e, np.ones(n))[1] for e in errors])
    actual = np.var(errors.mean(1))
    assert stated == pytest.approx(actual, rel=0.1) if shared > 0.5 else stated > actual
