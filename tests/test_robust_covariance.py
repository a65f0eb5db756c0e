"""The mean of estimates from the same images, and its variance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import stdtrit

from paceline.speed.refinement.robust_covariance import (
    MIN_INFORMATION_LEFT,
    MIN_VARIANCE_SHARE,
    RobustCovariance,
    assemble,
    assemble_scores,
    covariance,
    effective_dof,
    mean_of_estimates,
    scatter_of_shifts,
)

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


@pytest.mark.parametrize("scale", [1.0, 30.0])  # of one frame's scores: the clusters by frame win, or those by patch
@pytest.mark.parametrize("seed", [1, 2])
def test_the_covariance_is_the_sandwich_of_corrected_scores(seed: int, scale: float) -> None:
    """Against the formula as it is written, with all parameters of all clusters and symmetric square roots."""
    rng = np.random.default_rng(seed)
    views, K, P, S = 8, 5, 3, 2
    J = rng.normal(size=(views, K, 6, P + S))
    cells_A, cells = np.einsum("vkmi,vkmj->vkij", J, J), rng.normal(size=(views, K, P + S))
    cells[:2] *= scale
    prior = 0.5 * np.eye(P + K * S)
    A, gradient = assemble(cells_A, P) + prior, rng.normal(size=P)

    def sandwich(clusters: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        values, axes = np.linalg.eigh(A)
        root, back = axes * np.sqrt(values) @ axes.T, axes / np.sqrt(values) @ axes.T
        middle = prior.copy()
        for A_i, score in clusters:
            share, vectors = np.linalg.eigh(back @ A_i @ back)
            enlarged = vectors / np.sqrt(np.maximum(1.0 - share, MIN_INFORMATION_LEFT)) @ vectors.T
            corrected = root @ enlarged @ back @ score
            middle += np.outer(corrected, corrected)
        return (np.linalg.inv(A) @ middle @ np.linalg.inv(A))[:P, :P]

    def cluster(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return assemble(cells_A * chosen[..., None, None], P), assemble_scores(cells * chosen[..., None], P)

    v, k = np.indices((views, K))
    by_frame = sandwich([cluster(v // 2 == n) for n in range(views // 2)])
    by_patch = sandwich([cluster(k == n) for n in range(K)])
    wider = max(by_frame, by_patch, key=lambda C: gradient @ C @ gradient)
    np.testing.assert_allclose(covariance(A, prior, cells_A, cells, gradient).total, wider, rtol=1e-9, atol=1e-12)
    both = by_frame + by_patch - sandwich([])
    crossed = covariance(A, prior, cells_A, cells, gradient, is_crossed=True)
    np.testing.assert_allclose(crossed.total, both, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("known", [0.0, 0.3, 3.0])
def test_intervals_by_effective_degrees_of_freedom_cover_95_percent(known: float) -> None:
    """Of a sum of errors of which one has a known variance and two have variances that are estimated."""
    rng = np.random.default_rng(5)
    true, dofs = np.array([1.0, 0.4, known]), np.array([9.0, 5.0, np.inf])
    errors = rng.normal(size=(20000, 3)) @ np.sqrt(true)
    estimated = np.column_stack([rng.chisquare(9, 20000) / 9, 0.4 * rng.chisquare(5, 20000) / 5, np.full(20000, known)])
    halves = [stdtrit(effective_dof(v, dofs), 0.975) * np.sqrt(v.sum()) for v in estimated]
    assert 0.944 < np.mean(np.abs(errors) < halves) < 0.96


def test_what_is_known_by_the_prior_has_no_limited_degrees_of_freedom() -> None:
    scatter, prior = np.diag([4.0, 1.0]), np.diag([0.0, 1.0])
    C = RobustCovariance(prior, scatter)
    np.testing.assert_array_equal(C.total, scatter + prior)
    assert C.dof(np.array([1.0, 0.0]), 10) == pytest.approx(9.0)
    assert C.dof(np.array([0.0, 1.0]), 10) == pytest.approx(36.0)


@pytest.mark.parametrize("textureless", [False, True])
def test_the_scatter_of_shifts_is_that_of_a_fit_to_each_patch(textureless: bool) -> None:
    """Least squares over the shifts and the patch's own parameters; a patch without texture does not count."""
    rng = np.random.default_rng(4)
    J, r = rng.normal(size=(6, 40, 7)), rng.normal(size=(6, 40))
    J *= np.arange(1, 7)[:, None, None]
    if textureless:
        J[0] = 0.0
    prior = np.diag([0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 2.0])
    normal = np.swapaxes(J, 1, 2) @ J + prior
    shifts, left = [1, 2], []
    for rows, residuals in zip(J[textureless:], r[textureless:], strict=True):
        stacked = np.concatenate([rows[:, 1:3], rows[:, 4:]], axis=1)
        stacked = np.concatenate([stacked, np.sqrt(2.0) * np.eye(5)[2:]])
        left.append(-np.linalg.lstsq(stacked, np.append(residuals, np.zeros(3)), rcond=None)[0][:2])
    weights = []
    for A in normal[textureless:]:
        covariance = np.linalg.inv(A[np.ix_([1, 2, 4, 5, 6], [1, 2, 4, 5, 6])])[:2, :2]
        weights.append(np.diag(np.linalg.inv(covariance)))
    expected = [np.sqrt(np.cov(np.array(left)[:, i], aweights=np.array(weights)[:, i], ddof=0)) for i in range(2)]
    found = scatter_of_shifts(normal, np.einsum("kij,ki->kj", J, r), shifts, 3)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
