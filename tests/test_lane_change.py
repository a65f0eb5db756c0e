"""Changes of lane: one smooth profile for all simulators."""

from __future__ import annotations

import numpy as np
import pytest

from paceline.simulation.lane_change import LaneChange, smoothstep

CHANGE = LaneChange(start=12.0, length=40.0, shift=-3.6)


def test_it_leads_from_one_lane_to_the_other() -> None:
    assert CHANGE.shift_at([-100.0, 0.0, 12.0]).tolist() == [0.0, 0.0, 0.0]
    assert CHANGE.shift_at(32.0) == pytest.approx(-1.8)
    assert CHANGE.shift_at([52.0, 900.0]).tolist() == pytest.approx([-3.6, -3.6])


def test_the_slope_is_the_derivative_of_the_shift() -> None:
    distance, h = np.linspace(5.0, 60.0, 400), 1e-4
    slope = (CHANGE.shift_at(distance + h) - CHANGE.shift_at(distance - h)) / (2 * h)
    np.testing.assert_allclose(CHANGE.slope_at(distance), slope, atol=1e-9)
    assert CHANGE.max_slope == pytest.approx(np.abs(slope).max(), rel=1e-4)
    assert CHANGE.slope_at(32.0) == pytest.approx(-CHANGE.max_slope)


def test_the_profile_is_the_quintic_without_rate_and_acceleration_at_its_ends() -> None:
    powers = np.eye(6)
    conditions = [[np.polyval(np.polyder(p, n), end) for p in powers] for end in (0.0, 1.0) for n in range(3)]
    quintic = np.linalg.solve(conditions, [0, 0, 0, 1, 0, 0])
    part = np.linspace(0, 1, 101)
    np.testing.assert_allclose(smoothstep(part), np.polyval(quintic, part), atol=1e-12)
