"""The chase vehicle: closed-form circles and lags, the order of its integration, limits, and when commands act."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.simulation.closed_loop.vehicle_dynamics import (
    Command,
    VehicleDynamics,
    VehicleParameters,
    VehicleState,
    integrate,
    point_ahead,
)

VEHICLE = VehicleParameters()
FIELDS = np.array(astuple(VEHICLE)[:14])


def rolling(speed: float, steering: float = 0.0) -> np.ndarray:
    return np.array(astuple(VehicleState(0.0, 0.0, 0.0, speed, 0.0, steering)))


@pytest.mark.parametrize(("speed", "steering"), [(3.0, 0.3), (10.0, 0.05), (25.0, -0.02)])
def test_a_constant_steering_angle_drives_the_geometric_circle(speed: float, steering: float) -> None:
    """Radius (L + K v²) / tan δ, to the right for a positive angle; the centre stays where it is."""
    radius = (VEHICLE.wheelbase + VEHICLE.understeer * speed**2) / np.tan(steering)
    seconds = 4.0
    s = integrate(rolling(speed, steering), steering, 0.0, FIELDS, 0.005, 800)
    turned = speed * seconds / radius
    np.testing.assert_allclose(s[:2], (radius * np.sin(turned), -radius * (1 - np.cos(turned))), atol=1e-6)
    assert s[2] == pytest.approx(-turned, abs=1e-9)


def test_the_integration_is_of_fourth_order() -> None:
    """Against a far smaller step, while neither limit is touched: halving the step divides the error by 16."""
    start = rolling(8.0)

    def after(steps: int) -> np.ndarray:
        return integrate(start, 0.04, -1.0, FIELDS, 1.6 / steps, steps)

    exact = after(4096)
    errors = np.array([np.linalg.norm(after(n)[:3] - exact[:3]) for n in (16, 32, 64)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert ((orders > 3.6) & (orders < 4.6)).all(), orders


def test_lags_are_exponential() -> None:
    s = integrate(rolling(10.0), 0.01, 1.0, FIELDS, 0.005, 60)
    assert s[5] == pytest.approx(0.01 * (1 - np.exp(-0.3 / VEHICLE.steering_lag)), rel=1e-6)
    assert s[4] == pytest.approx(1 - np.exp(-0.3 / VEHICLE.throttle_lag), rel=1e-6)


def test_limits_hold() -> None:
    plant = VehicleDynamics(VEHICLE, VehicleState(0.0, 0.0, 0.0, 20.0))
    plant.queue(Command(0.0, 2.0, -50.0))
    before = plant.state
    for k in range(1, 80):
        s = plant.advance(k / 20)
        assert abs(s.steering - before.steering) <= VEHICLE.steering_rate / 20 + 1e-9
        assert s.steering <= VEHICLE.steering_limit
        assert s.acceleration >= -VEHICLE.braking_limit - 1e-9
        assert s.speed >= 0.0
        assert abs(s.heading - before.heading) * s.speed * 20 <= VEHICLE.grip + 0.5
        before = s
    assert before.speed == 0.0
    still = plant.advance(10.0)
    assert (still.x, still.y, still.heading) == (before.x, before.y, before.heading)


def test_the_stopping_distance_is_that_of_a_lag_and_a_constant_deceleration() -> None:
    """A first-order lag τ before a deceleration a costs v τ, all but what it saves: s = v²/2a + v τ − a τ²/2 + …"""
    speed, braking, tau = 15.0, VEHICLE.braking_limit, VEHICLE.brake_lag
    plant = VehicleDynamics(VEHICLE, VehicleState(0.0, 0.0, 0.0, speed))
    plant.queue(Command(0.0, 0.0, -braking))
    assert plant.advance(10.0).x == pytest.approx(
        speed**2 / (2 * braking) + speed * tau - braking * tau**2 / 2, rel=2e-3
    )


def test_commands_act_when_they_are_due() -> None:
    plant = VehicleDynamics(VEHICLE, VehicleState(0.0, 0.0, 0.0, 10.0))
    plant.queue(Command(0.128, 0.1, 0.0))
    assert plant.advance(0.128).steering == 0.0
    assert plant.advance(0.15).steering == pytest.approx(0.022 * VEHICLE.steering_rate, rel=1e-6)  # as fast as it can
    with pytest.raises(ValueError, match="expected a time from 0.15 s on"):
        plant.queue(Command(0.1, 0.0, 0.0))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(0.001, 0.4), min_size=1, max_size=8), st.floats(-0.3, 0.3), st.floats(-3, 1.5))
def test_it_does_not_matter_when_one_looks(pauses: list[float], steering: float, acceleration: float) -> None:
    """Many looks on the way or none: the same end, to the accuracy of the integration."""
    ends = np.cumsum(pauses)
    a, b = (VehicleDynamics(VEHICLE, VehicleState(1.0, 2.0, 0.5, 9.0)) for _ in range(2))
    for plant in (a, b):
        plant.queue(Command(0.05, steering, acceleration))
    for end in ends:
        a.advance(float(end))
    b.advance(float(ends[-1]))
    np.testing.assert_allclose(astuple(a.state), astuple(b.state), atol=2e-4)


def test_the_body_nods_under_braking_and_leans_out_of_a_bend() -> None:
    braked = integrate(rolling(30.0), 0.0, -4.0, FIELDS, 0.005, 600)
    assert braked[6] == pytest.approx(4.0 * VEHICLE.nod, rel=0.02)  # nose down
    turning = integrate(rolling(10.0, 0.05), 0.05, 0.0, FIELDS, 0.005, 800)
    lateral = 100 * np.tan(0.05) / (VEHICLE.wheelbase + VEHICLE.understeer * 100)
    assert turning[8] == pytest.approx(-lateral * VEHICLE.lean, rel=0.02)  # to the left, out of a right turn


def test_points_ahead_lie_on_the_axis() -> None:
    assert point_ahead(VehicleState(1.0, 2.0, np.pi / 2, 0.0), 3.0) == pytest.approx((1.0, 5.0))
