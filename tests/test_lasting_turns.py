"""Drifts and knocks of cameras that sway, and the sway that is neither."""

from __future__ import annotations

import numpy as np
import pytest

from paceline.arrays import Array
from paceline.imaging.lasting_turns import LastingTurn, lasting_turn

SEEDS, NOISE_PX = range(40), 0.02


def swaying(seed: int, count: int, rate: float, rms: float) -> tuple[Array, Array]:
    """Times (N,) s and displacements (N, 2) px of a mast that sways at 1 to 5 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) / rate
    frequency, phase = rng.uniform(1, 5, 4), rng.uniform(0, 2 * np.pi, (4, 2))
    amplitude = rng.normal(size=(4, 2)) / frequency[:, None]
    sway = (amplitude * np.sin(2 * np.pi * frequency[:, None] * t[:, None, None] + phase)).sum(1)
    return t, rms * sway / np.sqrt((sway**2).sum(1).mean()) + rng.normal(0, NOISE_PX, (count, 2))


@pytest.mark.parametrize("rms", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(("count", "rate"), [(10, 5.0), (40, 10.0), (100, 25.0)])
def test_sway_is_hardly_ever_taken_for_what_lasts(count: int, rate: float, rms: float) -> None:
    found = [lasting_turn(*swaying(seed, count, rate, rms)) for seed in SEEDS]
    assert sum(turn != LastingTurn() for turn in found) <= 2


@pytest.mark.parametrize(("count", "rate"), [(12, 5.0), (40, 10.0), (100, 25.0)])
def test_a_knock_is_found_where_it_happened(count: int, rate: float) -> None:
    found = 0
    for seed in SEEDS:
        t, displacement = swaying(seed, count, rate, 0.3)
        displacement[count // 3 :] += 2.0 * np.array([0.6, -0.8])
        turn = lasting_turn(t, displacement)
        if turn.knock_px:
            found += 1
            assert abs(turn.knocked - (count // 3 - 1)) <= 1 and turn.drift_px_per_min == 0.0
            assert turn.knock_px == pytest.approx(2.0, abs=0.4)
    assert found >= 0.9 * len(SEEDS)


def test_a_drift_is_told_from_a_knock() -> None:
    for seed in SEEDS:
        t, displacement = swaying(seed, 40, 10.0, 0.3)
        turn = lasting_turn(t, displacement + 3.0 * t[:, None] * np.array([0.8, 0.6]))
        assert turn.knock_px == 0.0 and turn.drift_px_per_min == pytest.approx(180.0, rel=0.2)


def test_a_few_frames_tell_nothing() -> None:
    assert lasting_turn(np.arange(5.0), np.outer(np.arange(5.0), [1.0, 2.0])) == LastingTurn()
    assert lasting_turn(np.zeros(0), np.zeros((0, 2))) == LastingTurn()
