"""View-dependent appearance: its variance ratio is estimated, and views are weighted by the covariance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from paceline.speed.refinement.view_dependence import VARIANCE_RATIOS, centering, whitening

Array = NDArray[np.float64]


def directions_of(frames: int) -> Array:
    """Unit vectors (V, 3) from an approaching vehicle to both cameras."""
    away = np.linspace(80.0, 25.0, frames)
    cameras = [np.stack([x + 0.0 * away, 0.0 * away - 1.2, away], axis=1) for x in (4.0, 4.5)]
    v = np.stack(cameras, axis=1).reshape(-1, 3)
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def distances(directions: Array) -> Array:
    """Distances (V, V) between unit vectors."""
    return np.asarray(np.linalg.norm(directions[:, None] - directions, axis=-1))


def contrasts_of(ratio: float, weights: Array, directions: Array) -> tuple[Array, Array]:
    """All contrasts (V − 1, V) of a patch's views, of ``weights`` (V, 1), and their covariance over the noise's."""
    contrasts = null_space(np.ones((1, len(weights)))).T
    changing = -ratio * unit(weights, directions) * distances(directions)
    return contrasts, contrasts @ (np.diag(1.0 / weights[:, 0]) + changing) @ contrasts.T


def unit(weights: Array, directions: Array) -> Array:
    """Variance per radian (K,) that equals the noise variance, averaged over the weighted views."""
    size = np.trace(centering(weights) @ -distances(directions) @ centering(weights).swapaxes(1, 2), axis1=1, axis2=2)
    return np.asarray(len(weights) / size)


def view_dependent(ratio: float, weights: Array, directions: Array, m: int, seed: int) -> Array:
    """Residuals (V, K, m) with noise of variance 1 / weights and a view-dependent part of ``ratio`` times that."""
    rng, apart = np.random.default_rng(seed), distances(directions)
    root = np.linalg.cholesky(2.0 * apart.max() - apart)
    V, K = weights.shape
    changing = np.einsum("vu,ukm->vkm", root, rng.standard_normal((V, K, m)))
    noise = rng.standard_normal((V, K, m)) / np.sqrt(weights)[..., None]
    return np.asarray(noise + np.sqrt(ratio * unit(weights, directions))[:, None] * changing)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), frames=st.integers(3, 12))
def test_the_common_part_of_all_views_is_removed(seed: int, frames: int) -> None:
    rng, directions = np.random.default_rng(seed), directions_of(frames)
    weights = rng.uniform(0.1, 2.0, (2 * frames, 3))
    r = rng.standard_normal((2 * frames, 3, 40)) / np.sqrt(weights)[..., None]
    for matrix in (centering(weights), whitening(r, weights, directions)):
        np.testing.assert_allclose(matrix @ np.ones(2 * frames), 0.0, atol=1e-9)
    weighted = np.einsum("kvu,ukm->vkm", centering(weights), r)
    mean = (weights[..., None] * r).sum(0) / weights.sum(0)[:, None]
    np.testing.assert_allclose(weighted, np.sqrt(weights)[..., None] * (r - mean), atol=1e-9)


@pytest.mark.parametrize("ratio", [0.0, 0.3, 3.0, 30.0])
def test_views_are_weighted_by_the_likeliest_covariance(ratio: float) -> None:
    """Against the density of all contrasts between the views for each ratio; the noise is the residual less the
    view-dependent part."""
    directions, rng = directions_of(8), np.random.default_rng(5)
    weights = rng.uniform(0.2, 2.0, (16, 2))
    r = view_dependent(ratio, weights, directions, 50, 11)
    found = whitening(r, weights, directions)
    for k in range(2):
        likely, noises, precisions = [], [], []
        for p in VARIANCE_RATIOS:
            contrasts, C = contrasts_of(p, weights[:, k : k + 1], directions)
            seen = contrasts @ r[:, k]
            noise = np.trace(np.linalg.solve(C, seen @ seen.T)) / seen.size
            likely.append(multivariate_normal(cov=noise * C).logpdf(seen.T).sum())
            noises.append(noise)
            precisions.append(contrasts.T @ np.linalg.inv(noise * C) @ contrasts)
        best = noises[0] * precisions[int(np.argmax(likely))]
        np.testing.assert_allclose(found[k].T @ found[k], best, atol=1e-8 * np.abs(best).max())


def test_a_ratio_is_estimated_from_the_residuals() -> None:
    """Within a factor of 1.6 in nine of ten patches; without a view-dependent part nearly all information is kept, also
    where some views have weight zero."""
    directions, weights = directions_of(12), np.ones((24, 200))
    grows = np.linspace(-1.0, 1.0, 24)  # what a change of size does to an intensity

    def kept(ratio: float, of: Array = weights) -> Array:
        r = view_dependent(ratio, weights, directions, 60, 3)
        noise = np.square(centering(of) @ r.swapaxes(0, 1)).sum((1, 2)) / (60.0 * ((of > 0.0).sum(0) - 1.0))
        W = whitening(r, of, directions)
        return np.asarray(np.square(W @ grows).sum(-1) / np.square(centering(of) @ grows).sum(-1) / noise)

    def known(ratio: float) -> float:
        contrasts, C = contrasts_of(ratio, weights[:, :1], directions)
        seen = contrasts @ grows
        return float(seen @ np.linalg.solve(C, seen) / np.square(seen).sum())

    some = np.where(np.arange(24)[:, None] % 3, weights, 0.0)
    assert np.median(kept(0.0)) > 0.95 and np.median(kept(0.0, some)) > 0.95
    for ratio in (1.0, 10.0):
        within = (kept(ratio) > known(1.6 * ratio)) & (kept(ratio) < known(ratio / 1.6))
        assert within.mean() > 0.9


def test_views_of_weight_zero_and_equal_directions_are_no_obstacle() -> None:
    directions, rng = directions_of(4), np.random.default_rng(0)
    weights = np.ones((8, 2))
    weights[3] = 0.0
    weights[:, 1] = 0.0
    for looked in (directions, np.tile(directions[:1], (8, 1))):
        W = whitening(rng.standard_normal((8, 2, 30)), weights, looked)
        assert np.isfinite(W).all()
        np.testing.assert_allclose(W[0][:, 3], 0.0, atol=1e-12)
        np.testing.assert_allclose(W[1], 0.0, atol=1e-12)
