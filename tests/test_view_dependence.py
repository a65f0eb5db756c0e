"""What a face shows drifts with the direction it is seen from: by how much is told, and views are weighed by that."""

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


def seen_from(frames: int) -> Array:
    """Unit vectors (V, 3) to both cameras of a pair from a face that comes nearer."""
    away = np.linspace(80.0, 25.0, frames)
    cameras = [np.stack([x + 0.0 * away, 0.0 * away - 1.2, away], axis=1) for x in (4.0, 4.5)]
    v = np.stack(cameras, axis=1).reshape(-1, 3)
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def between(directions: Array) -> Array:
    """How far apart (V, V) they are."""
    return np.asarray(np.linalg.norm(directions[:, None] - directions, axis=-1))


def contrasts_of(pace: float, say: Array, directions: Array) -> tuple[Array, Array]:
    """All contrasts (V − 1, V) of the views of one patch, of ``say`` (V, 1), and their covariance over the noise's."""
    contrasts = null_space(np.ones((1, len(say)))).T
    drift = -pace * unit(say, directions) * between(directions)
    return contrasts, contrasts @ (np.diag(1.0 / say[:, 0]) + drift) @ contrasts.T


def unit(say: Array, directions: Array) -> Array:
    """The drift (K,), per radian, whose variance is that of noise in the mean over the weighted views."""
    size = np.trace(centering(say) @ -between(directions) @ centering(say).swapaxes(1, 2), axis1=1, axis2=2)
    return np.asarray(len(say) / size)


def drifting(pace: float, say: Array, directions: Array, m: int, seed: int) -> Array:
    """Residuals (V, K, m) with noise of variance 1 / say and a drift of so many times that."""
    rng, apart = np.random.default_rng(seed), between(directions)
    root = np.linalg.cholesky(2.0 * apart.max() - apart)
    V, K = say.shape
    drift = np.einsum("vu,ukm->vkm", root, rng.standard_normal((V, K, m)))
    noise = rng.standard_normal((V, K, m)) / np.sqrt(say)[..., None]
    return np.asarray(noise + np.sqrt(pace * unit(say, directions))[:, None] * drift)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), frames=st.integers(3, 12))
def test_what_all_views_have_in_common_tells_nothing(seed: int, frames: int) -> None:
    rng, directions = np.random.default_rng(seed), seen_from(frames)
    say = rng.uniform(0.1, 2.0, (2 * frames, 3))
    r = rng.standard_normal((2 * frames, 3, 40)) / np.sqrt(say)[..., None]
    for weighing in (centering(say), whitening(r, say, directions)):
        np.testing.assert_allclose(weighing @ np.ones(2 * frames), 0.0, atol=1e-9)
    weighted = np.einsum("kvu,ukm->vkm", centering(say), r)
    mean = (say[..., None] * r).sum(0) / say.sum(0)[:, None]
    np.testing.assert_allclose(weighted, np.sqrt(say)[..., None] * (r - mean), atol=1e-9)


@pytest.mark.parametrize("pace", [0.0, 0.3, 3.0, 30.0])
def test_views_are_weighed_as_the_likeliest_drift_asks_for(pace: float) -> None:
    """By the density of all contrasts between the views, for each pace, and by the inverse of the covariance; their
    noise is as much less than what is left over as the drift explains of that."""
    directions, rng = seen_from(8), np.random.default_rng(5)
    say = rng.uniform(0.2, 2.0, (16, 2))
    r = drifting(pace, say, directions, 50, 11)
    found = whitening(r, say, directions)
    for k in range(2):
        likely, noises, precisions = [], [], []
        for p in VARIANCE_RATIOS:
            contrasts, C = contrasts_of(p, say[:, k : k + 1], directions)
            seen = contrasts @ r[:, k]
            noise = np.trace(np.linalg.solve(C, seen @ seen.T)) / seen.size
            likely.append(multivariate_normal(cov=noise * C).logpdf(seen.T).sum())
            noises.append(noise)
            precisions.append(contrasts.T @ np.linalg.inv(noise * C) @ contrasts)
        best = noises[0] * precisions[int(np.argmax(likely))]
        np.testing.assert_allclose(found[k].T @ found[k], best, atol=1e-8 * np.abs(best).max())


def test_a_pace_is_told_by_what_is_left_over() -> None:
    """Within a factor of 1.6 in nine of ten patches; where nothing drifts, nearly all that views tell is kept, also
    where some of them show nothing."""
    directions, say = seen_from(12), np.ones((24, 200))
    grows = np.linspace(-1.0, 1.0, 24)  # what a change of size does to an intensity

    def kept(pace: float, of: Array = say) -> Array:
        r = drifting(pace, say, directions, 60, 3)
        noise = np.square(centering(of) @ r.swapaxes(0, 1)).sum((1, 2)) / (60.0 * ((of > 0.0).sum(0) - 1.0))
        W = whitening(r, of, directions)
        return np.asarray(np.square(W @ grows).sum(-1) / np.square(centering(of) @ grows).sum(-1) / noise)

    def known(pace: float) -> float:
        contrasts, C = contrasts_of(pace, say[:, :1], directions)
        seen = contrasts @ grows
        return float(seen @ np.linalg.solve(C, seen) / np.square(seen).sum())

    some = np.where(np.arange(24)[:, None] % 3, say, 0.0)
    assert np.median(kept(0.0)) > 0.95 and np.median(kept(0.0, some)) > 0.95
    for pace in (1.0, 10.0):
        within = (kept(pace) > known(1.6 * pace)) & (kept(pace) < known(pace / 1.6))
        assert within.mean() > 0.9


def test_views_that_say_nothing_and_one_direction_are_no_obstacle() -> None:
    directions, rng = seen_from(4), np.random.default_rng(0)
    say = np.ones((8, 2))
    say[3] = 0.0
    say[:, 1] = 0.0
    for looked in (directions, np.tile(directions[:1], (8, 1))):
        W = whitening(rng.standard_normal((8, 2, 30)), say, looked)
        assert np.isfinite(W).all()
        np.testing.assert_allclose(W[0][:, 3], 0.0, atol=1e-12)
        np.testing.assert_allclose(W[1], 0.0, atol=1e-12)
