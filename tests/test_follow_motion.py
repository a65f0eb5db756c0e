"""The square root information filter against the batch problem that it stands for."""

import numpy as np
import pytest

from paceline.follow.configuration import FollowConfiguration
from paceline.follow.motion import MotionModels, aged, at_rest, extrapolated, solved, triangularise, updated


def test_triangularise_is_an_orthogonal_transformation():
    A = np.random.default_rng(3).normal(size=(9, 4))
    R = A.copy()
    triangularise(R)
    np.testing.assert_allclose(R.T @ R, A.T @ A, atol=1e-12)
    assert np.all(R[np.tril_indices(9, -1, 4)] == 0.0)


@pytest.mark.parametrize("decay", [0.5, 0.8, 0.97])
@pytest.mark.parametrize("steady", [True, False])
def test_the_recursion_equals_the_weighted_batch_solution(decay, steady):
    rng = np.random.default_rng(7)
    pair = at_rest(3.0, np.full(3, 0.7))
    # (18)-(20) written out: every row [1, t, t² | c], t counted back from now, weighed by w·λ^(age/2)
    times, values, w = [], [], []
    now = 0.0
    for _ in range(60):
        tau = 1.0 if steady else rng.uniform(0.3, 1.9)
        now += tau
        value, weight = rng.normal(5.0, 2.0), rng.uniform(0.1, 3.0)
        pair = updated(aged(pair, tau, decay), value, weight)
        times.append(now)
        values.append(value)
        w.append(weight)
        t = np.array(times) - now
        scaled = np.array(w) * decay ** (-t / 2)
        # the start: a0, a1, a2 at time 0 are 3, 0, 0; in terms of the coefficients now, by the shift of a polynomial
        shift = np.array([[1.0, -now, now * now], [0.0, 1.0, -2 * now], [0.0, 0.0, 1.0]])
        A = np.vstack([0.7 * decay ** (now / 2) * shift, scaled[:, None] * np.stack([t**0, t, t * t], axis=1)])
        b = np.concatenate([0.7 * decay ** (now / 2) * np.array([3.0, 0, 0]), scaled * values])
        np.testing.assert_allclose(solved(pair), np.linalg.lstsq(A, b, rcond=None)[0], rtol=1e-9, atol=1e-9)


def test_a_parabola_is_predicted_exactly():
    def parabola(t):
        return 2.0 + 0.3 * t - 0.02 * t * t

    pair = at_rest(2.0, np.full(3, 1e-6))
    for t in range(1, 30):
        pair = updated(aged(pair, 1.0, 0.8), parabola(t), 2.0)
    assert extrapolated(pair, 1.0) == pytest.approx(parabola(30), abs=1e-6)


def test_while_nothing_is_seen_a_motion_does_not_run_away():
    pair = at_rest(0.0, np.full(3, 1e-3))
    for t in range(1, 20):
        pair = updated(aged(pair, 1.0, 0.8), 0.5 * t * t, 1.0)
    near, far = extrapolated(pair, 10.0), extrapolated(pair, 100.0)
    assert near == pytest.approx(far)


def test_what_a_motion_foregoes_is_how_much_farther_its_speed_would_lead():
    models = MotionModels(np.array([50.0, 60.0, 1.0]), np.array([1.0, 1.0, 0.02]), FollowConfiguration())
    speed = np.array([2.0, 0.0, -0.004])
    for t in range(1, 40):
        models.observe(np.array([50.0, 60.0, 1.0]) + t * speed, np.array([3.0, 3.0, 300.0]), 1.0, np.full(3, 1e-3))
    assert (models.foregone(3.0) == 0.0).all()
    there = np.array([50.0, 60.0, 1.0]) + (39 + 20) * speed
    np.testing.assert_allclose(models.predict(20.0)[0] + models.foregone(20.0), there, rtol=0.02)


def test_predictions_cover_what_is_measured():
    """The stated deviation of a prediction is the size of the errors that it makes."""
    rng = np.random.default_rng(1)
    models = MotionModels(np.array([100.0, 80.0, 1.0]), np.array([2.0, 2.0, 0.02]), FollowConfiguration())
    off, stated = [], []
    for k in range(400):
        x = np.array([100 + 8 * np.sin(k / 20), 80 + rng.normal(0, 4), 1 + 0.1 * np.sin(k / 40)])
        x += rng.normal(0, [0.2, 0.2, 0.004])
        expected, std = models.predict(1.0)
        if k > 50:
            off.append(x - expected)
            stated.append(std)
        models.observe(x, np.array([5.0, 5.0, 250.0]), 1.0, np.array([0.3, 0.3, 0.003]))
    ratio = np.sqrt((np.array(off) ** 2).mean(0)) / np.sqrt((np.array(stated) ** 2).mean(0))
    assert np.all(ratio < 1.4) and np.all(ratio > 0.5)


def test_adaptive_decay_predicts_a_bouncing_camera_better_than_one_decay():
    rng = np.random.default_rng(2)
    ys = 80 + rng.normal(0, 5, 300)
    errors = {}
    for adaptive in (True, False):
        models = MotionModels(
            np.array([100.0, 80.0, 1.0]), np.array([2.0, 2.0, 0.02]), FollowConfiguration(adaptive_decay=adaptive)
        )
        off = []
        for y in ys:
            off.append(models.predict(1.0)[0][1] - y)
            models.observe(np.array([100.0, y, 1.0]), np.ones(3), 1.0, np.array([0.3, 0.3, 0.003]))
        errors[adaptive] = np.std(off[20:])
    assert errors[True] < 0.95 * errors[False]


def test_restart_forgets():
    models = MotionModels(np.array([100.0, 80.0, 1.0]), np.array([2.0, 2.0, 0.02]), FollowConfiguration())
    for k in range(20):
        models.observe(np.array([100.0 + 3 * k, 80.0, 1.0]), np.ones(3), 1.0, np.full(3, 0.01))
    models.restart(np.array([50.0, 60.0, 2.0]), np.ones(3))
    np.testing.assert_allclose(models.predict(1.0)[0], [50.0, 60.0, 2.0])
