"""The scale by edges and picture together: against simulated series of known noise, and the batch solution."""

import numpy as np
import pytest

from paceline.follow import gauge as module
from paceline.follow.gauge import Gauge, Series

RATIO = 0.03  # logarithm of the scale by the edges over that by the picture


def series(n, noise, seed, drift=0.0):
    """Logarithms of a scale that grows steadily, and the same with ``noise``."""
    rng = np.random.default_rng(seed)
    true = 0.01 * np.arange(n) + np.cumsum(rng.normal(0, drift, n))
    return true, true + rng.normal(0, noise, n)


def gauged(edges, picture, tau=1.0):
    """The logarithms of the scales that come out, and the gauge at the end."""
    gauge, out = Gauge(), []
    for e, p in zip(edges, picture, strict=True):
        scale, gauge = gauge.set(float(np.exp(e)), float(np.exp(p)), tau)
        out.append(np.log(scale))
    return np.array(out), gauge


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_the_jitter_about_a_steady_motion_is_learned(noise):
    learned = []
    for seed in range(20):
        s = Series()
        for value in series(150, noise, seed)[1]:
            s = s.add(value, 1.0)
        learned.append(s.variance)
    # a mean of about 20 values that are cut at nine times their mean, over 20 series
    assert np.mean(learned) == pytest.approx(noise**2, rel=0.25)


def test_after_a_gap_no_jitter_is_told():
    s = Series()
    for k, value in enumerate((0.0, 0.0, 0.5, 0.5)):
        s = s.add(value, 5.0 if k == 2 else 1.0)
    assert s.variance == Series().variance


@pytest.mark.parametrize(("by_edges", "by_picture"), [(0.01, 0.001), (0.001, 0.01)])
def test_the_one_that_jitters_less_has_the_greater_say(by_edges, by_picture):
    errors = []
    for seed in range(20):
        true, edges = series(200, by_edges, seed)
        out, _ = gauged(edges, series(200, by_picture, 100 + seed)[1] - RATIO)
        errors.append((out - true)[100:])
    jitter = np.std(np.diff(errors)) / np.sqrt(2)
    assert jitter < 2.0 * min(by_edges, by_picture)
    # what the picture's own scale is worth is known as well as the edges tell it, less what it wanders
    level = np.sqrt(np.mean(np.mean(errors, axis=1) ** 2))
    assert level < 3.0 * by_edges / np.sqrt(100) + 3.0 * module.DRIFT


def test_without_drift_the_ratio_is_the_mean_of_all(monkeypatch):
    """With noise of constant variance the filter equals the batch solution."""
    monkeypatch.setattr(module, "DRIFT", 0.0)
    monkeypatch.setattr(module, "RECENT", 0.0)
    monkeypatch.setattr(module, "SURPRISE", 1e9)
    (_, edges), (_, picture) = series(50, 0.01, 1), series(50, 0.01, 2)
    _, gauge = gauged(edges, picture - RATIO)
    noise, before = 2 * module.JITTER**2, module.UNKNOWN**2
    batch = np.sum(edges - picture + RATIO) / noise / (50 / noise + 1 / before)
    assert gauge.log_ratio == pytest.approx(batch, rel=1e-9)
    assert gauge.variance == pytest.approx(1 / (50 / noise + 1 / before), rel=1e-9)


def test_edges_that_slide_for_a_moment_hardly_move_the_scale():
    true, edges = series(100, 0.003, 5)
    edges[60:63] += 0.04  # the inner outline taken for the outer one
    out, _ = gauged(edges, series(100, 0.001, 6)[1] - RATIO)
    assert np.abs(out - true)[60:63].max() < 0.01
    assert np.abs(out - true)[70:].max() < 0.006


def test_a_picture_learned_anew_takes_over_part_of_the_ratio():
    gauge = Gauge(log_ratio=0.02, variance=1e-6)
    assert gauge.learned(0.25).log_ratio == pytest.approx(0.015)


def test_the_picture_alone_tells_the_scale_once_it_is_known_what_it_is_worth():
    _, gauge = gauged(series(200, 0.002, 8)[1], series(200, 0.001, 9)[1] - RATIO)
    assert gauge.scale(0.8) == pytest.approx(0.8 * np.exp(RATIO), rel=4 * 0.002 / np.sqrt(100) + module.DRIFT * 3)
    assert Gauge().scale(0.8) == pytest.approx(0.8)
