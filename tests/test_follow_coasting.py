"""A target that is not seen goes on at its last velocity, in metres."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from paceline.follow.coasting import BRAKING_STD_MPS2, MIN_RANGE_M, Coasting
from paceline.follow.following import follow_recording

DATA = Path(__file__).parents[2] / "shared" / "data" / "kitti_parked"


@given(st.floats(5, 60), st.floats(-15, 15), st.floats(-2, 2), st.floats(0, 20), st.floats(0.0, 1.5))
def test_a_steady_motion_goes_on(start: float, speed: float, sideways: float, driven: float, unseen: float) -> None:
    """Also relative to a chase vehicle that has driven on, by its poses."""
    coasting = Coasting()
    place, velocity = np.array([1.0, 0.4, start]), np.array([sideways, 0.0, speed])
    for k in range(12):
        coasting.learn(0.1 * k, place + 0.1 * k * (velocity - [0, 0, driven]), 0.1 * k * driven)
    time = 1.1 + unseen
    found = coasting.position(time, 1.1 * driven)  # it stands since
    assert found is not None
    expected = place + time * velocity - [0, 0, 1.1 * driven]
    np.testing.assert_allclose(found[0], [*expected[:2], max(expected[2], MIN_RANGE_M)], atol=1e-9)
    assert found[1] == pytest.approx(0.5 * BRAKING_STD_MPS2 * unseen**2, abs=1e-9)


def test_a_noisy_speed_widens_the_range() -> None:
    """By the standard deviation of the ranges that are extrapolated from noisy ones."""
    rng, errors, stds = np.random.default_rng(4), [], []
    for _ in range(400):
        coasting = Coasting()
        for k in range(12):
            coasting.learn(0.1 * k, np.array([0.0, 0.0, 30.0 - k + rng.normal(0, 0.2)]), 0.0)
        position, std = coasting.position(1.4, 0.0) or (np.zeros(3), 0.0)
        errors.append(position[2] - 16.0)
        stds.append(np.sqrt(std**2 - (0.5 * BRAKING_STD_MPS2 * 0.3**2) ** 2))
    assert np.sqrt(np.mean(np.square(stds))) == pytest.approx(np.std(errors), rel=0.2)


def test_too_few_sights_tell_no_speed() -> None:
    coasting = Coasting()
    for k in range(3):
        coasting.learn(0.1 * k, np.array([0.0, 0.0, 20.0]), 0.0)
    assert coasting.position(0.5, 0.0) is None


def test_a_car_that_comes_near_is_not_taken_to_stop() -> None:
    """Its rear is no longer found from 9 m on, where its side comes into view."""
    if not DATA.exists():
        pytest.skip("the recording kitti_parked is not at ../shared/data")
    with (DATA / "truth.csv").open(newline="") as file:
        truth = {int(row["frame"]): row["c4_range_m"] for row in csv.DictReader(file)}
    result = follow_recording(DATA / "follow.yaml")
    coasted = [k for k, status in enumerate(result.status) if status == "coasting"]
    assert len(coasted) > 4
    for k in coasted:
        error = result.position[k, 2] - float(truth[int(result.frame[k])])
        assert abs(error) < min(1.96 * result.position_std[k, 2], 0.5)
