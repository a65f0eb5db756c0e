"""Rendered motions: exact speeds, no sideslip, both axles on the road."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from selection import slow_after

from paceline.errors import UnusableInput
from paceline.simulation.raytraced.motion import DrivingPlan, VehicleMotion
from paceline.simulation.road import Road, RoadShape

LENGTH = 200.0
WHEELBASE = 2.7

ROADS = [
    RoadShape(),
    RoadShape(grade=-0.05, bank=0.05),
    RoadShape("circle", 70.0),
    RoadShape("circle", -90.0, grade=0.04, bank=-0.06),
    RoadShape("clothoid", 60.0, bank=0.03),
    RoadShape("winding", 110.0, crest_radius=900.0),
    RoadShape("winding", -80.0, grade=0.03, bank=0.04, crest_radius=-700.0),
]


@st.composite
def drives(draw: st.DrawFn) -> DrivingPlan:
    """Drives that stay on the road for two seconds from time 0."""
    oncoming = draw(st.booleans())
    speed = draw(st.floats(8, 40))
    drive = DrivingPlan(
        150.0 if oncoming else 50.0,
        speed,
        draw(st.sampled_from([-1.8, 1.8])),
        draw(st.floats(-3.0, 3.0)),
        draw(st.floats(0.0, 1.0)),
        draw(st.floats(0.5, 5.0)),
        oncoming=oncoming,
    )
    if not draw(st.booleans()):
        return drive
    shift = draw(st.floats(1.5, 4.0)) * draw(st.sampled_from([-1, 1]))
    start, duration = draw(st.floats(-1.0, 1.0)), draw(st.floats(3.0, 6.0))
    # what brakes nearly to a stand cannot change its lane meanwhile, and is refused
    slowest = drive.speed + min(drive.acceleration, 0.0) * drive.acceleration_duration
    assume(slowest > 2 * 2.0 * abs(shift) / duration)
    return drive.with_lane_change(start, duration, shift)


@pytest.mark.parametrize("shape", slow_after(2, ROADS))
@given(drives(), st.floats(0.05, 1.95))
@settings(max_examples=12, deadline=None)
def test_the_body_drives_as_stated(shape: RoadShape, drive: DrivingPlan, t: float) -> None:
    road = Road(shape, LENGTH, 9)
    motion, h = VehicleMotion(road, drive, WHEELBASE), 1e-3
    before, after = motion.pose(t - h)[1], motion.pose(t + h)[1]
    velocity = (after - before) / (2 * h)
    assert np.linalg.norm(velocity) == pytest.approx(motion.speed(t), abs=2e-4 + 3.0 * h)
    R, origin = motion.pose(t)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)
    direction = velocity / np.linalg.norm(velocity)
    assert R[:, 1] @ direction == pytest.approx(0, abs=2e-4)  # no sideslip of the rear axle
    # A chord of the wheelbase leaves the tangent by half the wheelbase times the curvature of the surface.
    bent = 0.0 if shape.crest_radius is None else abs(1 / shape.crest_radius)
    bent += abs(np.sin(shape.bank) / shape.radius) if shape.radius else 0.0
    assert abs(R[:, 2] @ direction) < WHEELBASE / 2 * 2.5 * bent + 2e-4
    for axle in (0.0, WHEELBASE):
        at = origin + axle * R[:, 0]
        s, lateral = motion.position(t)
        s, lateral = road.locate(at, s + (axle if not drive.oncoming else -axle), lateral)
        np.testing.assert_allclose(road.frame(s, lateral)[0], at, atol=2e-5)


def test_on_a_plane_the_axis_is_the_velocity() -> None:
    motion = VehicleMotion(Road(RoadShape("circle", 60.0), LENGTH, 1), DrivingPlan(20.0, 15.0, 1.8), WHEELBASE)
    centre = np.array([0.0, -60.0, 0.0])
    for t in np.linspace(0, 4, 9):
        R, origin = motion.pose(float(t))
        assert np.linalg.norm(origin - centre) == pytest.approx(58.2, abs=1e-6)
        np.testing.assert_allclose(R[:, 0] @ (origin - centre), 0, atol=1e-6)
        np.testing.assert_allclose(R[:, 2], [0, 0, 1], atol=1e-9)


@pytest.mark.parametrize("lateral", [-1.8, 1.8])
@pytest.mark.parametrize("oncoming", [False, True])
def test_constant_speed_is_that_along_the_vehicles_own_path(lateral: float, oncoming: bool) -> None:
    """On a circle the arc driven per second is the speed at the vehicle's own radius, not at the axis's."""
    drive = DrivingPlan(100.0, 20.0, lateral, oncoming=oncoming)
    motion = VehicleMotion(Road(RoadShape("circle", 80.0), LENGTH, 1), drive, WHEELBASE)
    angle = [np.arctan2(p[0], p[1] + 80) for p in (motion.pose(t)[1] for t in (0.0, 1.0, 3.0))]
    own = 80 - lateral
    turned = np.diff(np.unwrap(angle))
    np.testing.assert_allclose(np.abs(turned) * own, [20.0, 40.0], atol=1e-6)
    assert (turned > 0).all() != oncoming
    assert motion.pose(0.0)[0][0, 0] * (-1 if oncoming else 1) * np.cos(100 / 80) > 0


@given(drives(), st.floats(-2, 2.5), st.floats(-2, 2.5))
@settings(max_examples=60, deadline=None)
def test_the_distance_is_the_integral_of_the_speed(drive: DrivingPlan, a: float, b: float) -> None:
    breaks = [drive.acceleration_start, drive.acceleration_start + drive.acceleration_duration]
    driven, _ = quad(drive.speed_at, a, b, points=[p for p in breaks if min(a, b) < p < max(a, b)] or None)
    assert drive.distance_at(b) - drive.distance_at(a) == pytest.approx(driven, abs=1e-6)


def test_a_lane_change_ends_in_the_other_lane() -> None:
    road = Road(RoadShape("winding", 200.0), LENGTH, 1)
    motion = VehicleMotion(road, DrivingPlan(10.0, 20.0, -1.8).with_lane_change(1.0, 4.0, 3.6), WHEELBASE)
    laterals = np.array([motion.position(t)[1] for t in np.linspace(0, 6, 601)])
    assert laterals[:100].tolist() == pytest.approx([-1.8] * 100, abs=1e-5)
    assert laterals[-95:].tolist() == pytest.approx([1.8] * 95, abs=1e-5)
    rate = np.diff(laterals) / 0.01
    assert rate.max() == pytest.approx(15 / 8 * 3.6 / 4, rel=1e-3)  # of a quintic
    assert np.abs(np.diff(rate)).max() / 0.01 < 6 * 3.6 / 4**2  # smooth


@pytest.mark.parametrize("oncoming", [False, True])
def test_a_lane_change_takes_its_time_whatever_the_speed(oncoming: bool) -> None:
    """Also while the vehicle brakes: begun and ended at the stated times, to the right of growing arc length."""
    drive = DrivingPlan(150.0 if oncoming else 10.0, 20.0, -1.8, acceleration=-3.0, oncoming=oncoming)
    motion = VehicleMotion(Road(RoadShape(), LENGTH, 1), drive.with_lane_change(1.0, 4.0, 3.6), WHEELBASE)
    laterals = [motion.position(t)[1] for t in (0.0, 1.0, 1.2, 4.8, 5.0, 6.0)]
    assert laterals[:2] == [-1.8, -1.8] and laterals[4:] == pytest.approx([1.8, 1.8], abs=1e-12)
    assert -1.8 < laterals[2] < -1.7 and 1.7 < laterals[3] < 1.8


def test_a_standing_vehicle_has_a_pose() -> None:
    motion = VehicleMotion(Road(RoadShape(), LENGTH, 1), DrivingPlan(50.0, 0.0, 1.8), WHEELBASE)
    assert motion.span == (-5.0, 7200.0)
    R, origin = motion.pose(100.0)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(origin, [50.0, -1.8, 0.0], atol=1e-6)


def test_a_braking_vehicle_stops() -> None:
    drive = DrivingPlan(40.0, 10.0, 1.8, acceleration=-4.0, acceleration_start=1.0)
    motion = VehicleMotion(Road(RoadShape("circle", 90.0), LENGTH, 1), drive, WHEELBASE)
    assert motion.speed(3.4) == pytest.approx(0.4) and motion.speed(5.0) == 0
    assert motion.distance(60.0) == pytest.approx(10 + 100 / 8)
    standing, later = motion.pose(4.0), motion.pose(60.0)
    for a, b in zip(standing, later, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    moving = motion.pose(3.49)[0]
    np.testing.assert_allclose(standing[0], moving, atol=1e-3)  # it does not turn as it stops


def test_outside_the_road_there_is_no_pose() -> None:
    motion = VehicleMotion(Road(RoadShape(), LENGTH, 1), DrivingPlan(100.0, 30.0, 1.8), WHEELBASE)
    first, last = motion.span
    assert first == -5.0 and 100 + 30 * last > LENGTH + 50
    motion.pose(first), motion.pose(last)
    with pytest.raises(ValueError, match="the vehicle is on the road from"):
        motion.pose(last + 0.1)


DRIVE = DrivingPlan(50.0, 20.0, 1.8)


@pytest.mark.parametrize(
    ("drive", "message"),
    [
        (replace(DRIVE, start=-3.0), "start -3 m: expected a place on the road"),
        (replace(DRIVE, speed=-1.0), "towards turns the vehicle round"),
        (DRIVE.with_lane_change(0.0, 0.0, 3.6), "lane change of 0 m"),
        (replace(DRIVE, speed=2.0).with_lane_change(0.0, 2.0, 3.6), "faster sideways than half"),
        (replace(DRIVE, acceleration=-20.0).with_lane_change(0.5, 3.0, 3.6), "faster sideways than half"),
    ],
)
def test_impossible_drives_are_refused(drive: DrivingPlan, message: str) -> None:
    with pytest.raises(UnusableInput, match=message):
        VehicleMotion(Road(RoadShape(), LENGTH, 1), drive, WHEELBASE)
