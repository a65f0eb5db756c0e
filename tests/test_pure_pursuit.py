"""Pure pursuit of the path that the vehicle ahead has driven."""

import numpy as np
import pytest

from paceline.follow.configuration import FollowConfiguration
from paceline.path_following.pure_pursuit import (
    FITTED_POINTS,
    MAX_PATH_POINTS,
    MAX_UNRELIABLE_POINTS,
    PATH_SPACING_M,
    UNRELIABLE_END_POINTS,
    UNRELIABLE_MARGIN_POINTS,
    Steering,
    extrapolated_path,
    goal_point,
    pure_pursuit,
    to_camera,
    to_world,
)
from paceline.recordings.odometry import Pose

C = FollowConfiguration().steering_settings()


def test_world_and_camera_are_inverse_to_each_other():
    pose = Pose(3.0, -2.0, 0.7)
    x, y = to_world(pose, 8.0, 1.5)
    np.testing.assert_allclose(to_camera(pose, np.array([[x, y]])), [[8.0, 1.5]], atol=1e-12)
    assert to_world(Pose(0.0, 0.0, 0.0), 5.0, 2.0) == pytest.approx((5.0, -2.0))  # right is −y
    assert to_world(Pose(0.0, 0.0, np.pi / 2), 5.0, 2.0) == pytest.approx((2.0, 5.0))


def test_the_angle_is_that_of_the_circle_through_the_point():
    radius, wheelbase, turned = 15.0, 2.8, 0.5
    ahead, right = radius * np.sin(turned), radius * (1 - np.cos(turned))
    assert pure_pursuit(ahead, right, wheelbase) == pytest.approx(np.arctan(wheelbase / radius))
    assert pure_pursuit(ahead, -right, wheelbase) == pytest.approx(-np.arctan(wheelbase / radius))


def test_the_goal_lies_on_the_path_at_the_lookahead():
    path = np.column_stack([np.arange(-5.0, 30.0, 0.5), 0.02 * np.arange(-5.0, 30.0, 0.5) ** 2])
    goal = np.array(goal_point(path, 6.0))
    assert np.hypot(*goal) == pytest.approx(6.0, abs=0.02)
    assert goal[0] > 0 and goal[1] == pytest.approx(0.02 * goal[0] ** 2, abs=0.01)
    assert goal_point(path[:15], 20.0) == (path[14, 0], path[14, 1])  # the end of a short one


def test_without_odometry_the_vehicle_itself_is_pursued():
    angle = Steering(C).angle(0.0, 10.0, 1.0, True, None)
    assert angle == pytest.approx(pure_pursuit(10.0 + C.camera_ahead, 1.0, C.wheelbase))
    assert Steering(C).angle(0.0, 0.2, 5.0, True, None) == C.steering_limit


def test_what_is_steered_for_is_the_callers_choice():
    """A lead that has turned off to the right: the path is still straight at the lookahead."""
    turned = {}
    for goal in ("path", "lead", "none", None):
        steering = Steering(C, goal)
        assert np.isnan(steering.angle(0.0, 12.0, 0.0, True, None)) == (goal in ("path", "none"))
        for k in range(30):  # the lead turns after 24 m
            steering.angle(k / 15, 12.0, max(0.0, k - 24.0), True, Pose(0.5 * k, 0.0, 0.0))
        turned[goal] = steering.angle(2.0, 12.0, 5.0, True, Pose(15.0, 0.0, 0.0))
    assert turned["lead"] == pytest.approx(pure_pursuit(12.0 + C.camera_ahead, 5.0, C.wheelbase))
    assert turned["path"] == turned[None] and abs(turned["path"]) < 0.2 * turned["lead"]
    assert np.isnan(turned["none"])


def drive(path, gap, seconds=60.0, odometry=True):
    """A bicycle model behind a vehicle that is ``gap`` m ahead on ``path`` (s → x, y); the offsets from the path."""
    steering, dt, speed = Steering(C), 1 / 15, 6.0
    x, y, heading, s = 0.0, 0.0, 0.0, gap
    off = []
    samples = path(np.arange(-20.0, 600.0, 0.1))
    for k in range(int(seconds / dt)):
        pose = Pose(x, y, heading)
        ahead, right = to_camera(pose, path(np.array([s])))[0]
        angle = steering.angle(k * dt, ahead, right, True, pose if odometry else None)
        heading -= speed * np.tan(angle) / C.wheelbase * dt
        # the pose is the camera's, ahead of the rear axle that the bicycle model moves
        x += speed * dt * np.cos(heading)
        y += speed * dt * np.sin(heading)
        s += speed * dt
        off.append(np.hypot(*(samples - (x, y)).T).min())
    return np.array(off)


def bend(s):
    s = np.asarray(s, float)
    turned = np.clip(s - 40.0, 0.0, 30.0) / 20.0  # straight, then 86 degrees with a radius of 20 m, then straight
    x = np.where(s < 40, s, 40 + 20 * np.sin(turned)) + np.where(s > 70, (s - 70) * np.cos(1.5), 0.0)
    y = np.where(s < 40, 0, 20 * (1 - np.cos(turned))) + np.where(s > 70, (s - 70) * np.sin(1.5), 0.0)
    return np.column_stack([x, y])


def test_with_odometry_a_bend_is_driven_where_the_other_drove_it():
    followed, cut = drive(bend, 12.0, 25.0), drive(bend, 12.0, 25.0, odometry=False)
    assert followed.max() < 0.8
    assert cut.max() > 1.5 * followed.max()  # who aims at the vehicle itself cuts the corner


def test_the_path_is_bounded():
    steering = Steering(C)
    for k in range(5000):
        steering.angle(k / 15, 10.0, 0.0, True, Pose(0.5 * k, 0.0, 0.0))
    assert len(steering.path) <= MAX_PATH_POINTS
    assert steering.path[-1, 0] == pytest.approx(0.5 * 4999 + 10.0, abs=0.6)


@pytest.mark.parametrize("unseen", [1.0, 1.7, 1.9, 60.0])
def test_a_straight_path_with_an_untracked_part_is_driven_straight(unseen):
    """Also where the vehicle has passed the point at which it was seen last, for good or for a while."""
    steering, away, times = Steering(C), 0.1, np.arange(240) / 15
    angles = [steering.angle(t, 12.0, away, not 4.0 <= t < 4.0 + unseen, Pose(10.0 * t, 0.0, 0.0)) for t in times]
    assert np.abs(angles).max() < 1.1 * pure_pursuit(C.lookahead_min, away, C.wheelbase)
    assert (np.diff(steering.path[:, 0]) < 0.51).all()


def test_a_long_untracked_distance_replaces_the_path():
    steering = Steering(C)
    for k, x in enumerate((0.0, 1.0, 5000.0)):
        steering.angle(k / 15, 10.0, 0.0, True, Pose(x, 0.0, 0.0))
    assert len(steering.path) <= MAX_PATH_POINTS
    assert steering.path[-1, 0] == pytest.approx(5010.0, abs=0.5) and steering.path[0, 0] > 4700.0


def test_untracked_positions_do_not_enter_the_path():
    steering = Steering(C)
    for k in range(20):
        steering.angle(k / 15, 10.0, 0.0, k < 10, Pose(float(k), 0.0, 0.0))
    assert steering.path[-1, 0] == pytest.approx(19.0)


def test_the_lookahead_grows_with_the_speed():
    angles = []
    for speed in (4.0, 16.0):
        steering = Steering(C)
        for k in range(60):  # a path 1 m to the right of the vehicle
            angles.append(steering.angle(k / 15, 25.0, 1.0, True, Pose(speed * k / 15, 0.0, 0.0)))
        assert steering.speed == pytest.approx(speed, rel=0.01)
    assert 0 < angles[119] < angles[59]


def circle(radius, count):
    """Points (count, 2) every `PATH_SPACING_M` on a circle to the left, the last at the origin and there along x."""
    turned = PATH_SPACING_M / radius * np.arange(1 - count, 1)
    return radius * np.column_stack([np.sin(turned), 1 - np.cos(turned)])


@pytest.mark.parametrize("radius", [60.0, -90.0, 1e6])
@pytest.mark.parametrize("seed", range(3))
def test_a_path_leads_on_as_it_bends(radius, seed):
    """15 m on, in noise of 2 cm; the end of it, at which what came between drew the lead aside, has no say."""
    path = circle(radius, 60) + np.random.default_rng(seed).normal(0, 0.02, (60, 2))
    path[-UNRELIABLE_END_POINTS:, 1] += 0.5 * np.arange(1, UNRELIABLE_END_POINTS + 1) / UNRELIABLE_END_POINTS
    on = extrapolated_path(path, 15.0, 10.0)[60 - UNRELIABLE_END_POINTS :]
    center = np.array([0.0, radius])
    off = np.abs(np.hypot(*(on - center).T) - abs(radius))
    assert np.hypot(*(on[-1] - path[-UNRELIABLE_END_POINTS - 1])) > 14.0
    assert off.max() < 0.7  # straight on it would be 1.9 m in the sharpest
    np.testing.assert_allclose(np.hypot(*np.diff(on, axis=0).T), PATH_SPACING_M, rtol=1e-6)
    assert np.hypot(*(on[0] - path[-UNRELIABLE_END_POINTS - 1])) < 2 * PATH_SPACING_M


@pytest.mark.parametrize("unsure", [UNRELIABLE_END_POINTS, MAX_UNRELIABLE_POINTS])
def test_uncertain_positions_before_an_occlusion_do_not_affect_the_path(unsure):
    """The points since the lead was seen for sure, and two before, are drawn aside; where it was hardly ever sure they
    are as good as any."""
    path = circle(60.0, 60)
    drawn = path.copy()
    drawn[-unsure - UNRELIABLE_MARGIN_POINTS :, 1] -= np.linspace(0.05, 0.5, unsure + UNRELIABLE_MARGIN_POINTS)
    np.testing.assert_allclose(
        extrapolated_path(drawn, 15.0, 10.0, unsure), extrapolated_path(path, 15.0, 10.0, unsure)
    )
    np.testing.assert_allclose(
        extrapolated_path(drawn, 15.0, 10.0, MAX_UNRELIABLE_POINTS + 1), extrapolated_path(drawn, 15.0, 10.0)
    )
    assert np.abs(extrapolated_path(drawn, 15.0, 10.0)[-1] - extrapolated_path(path, 15.0, 10.0)[-1]).max() > 0.1


def test_a_lead_that_is_drawn_aside_while_it_is_being_hidden_is_followed_where_it_went():
    """Straight on, by the angle; it would be an offset of 0.4 m and more were the last sights believed."""
    for sure, straight in ((False, True), (True, False)):
        steering, angles = Steering(C), []
        for k in range(90):
            hidden = max(k - 60, 0)
            aside = 0.1 * min(hidden, 8)
            pose = Pose(10.0 * k / 15, 0.0, 0.0)
            angles.append(steering.angle(k / 15, 12.0, aside, hidden <= 8, pose, sure or not hidden))
        assert (np.abs(angles[70:]).max() < 0.002) == straight


def test_fast_vehicles_hardly_turn():
    """The same points tell less of a bend the faster they were passed."""
    path, turns, told = circle(60.0, 60), [], PATH_SPACING_M * (FITTED_POINTS - 1)
    for speed in (5.0, 30.0):
        first, *_, last = np.diff(extrapolated_path(path, 20.0, speed)[-40:], axis=0)
        turns.append(np.arctan2(last[1], last[0]) - np.arctan2(first[1], first[0]))
    assert turns[0] == pytest.approx(told / 60.0, rel=0.2) and 0.0 < turns[1] < 0.5 * turns[0]


def test_no_path_leads_round_for_ever():
    """A corner that was seen in part goes on for as long as it was seen to bend, and then straight."""
    on = np.diff(extrapolated_path(circle(10.0, 60), 200.0, 3.0), axis=0)
    turned = np.unwrap(np.arctan2(on[:, 1], on[:, 0]))
    told = PATH_SPACING_M * FITTED_POINTS / 10.0
    assert 0.7 * told < turned[-1] - turned[60 - UNRELIABLE_END_POINTS] < told
    assert np.ptp(turned[-300:]) < 1e-9


@pytest.mark.parametrize("count", [1, 2, 3, UNRELIABLE_END_POINTS + 1, 10])
def test_a_short_path_leads_straight_on(count):
    path = np.column_stack([PATH_SPACING_M * np.arange(count), np.zeros(count)])
    on = extrapolated_path(path, 5.0, 10.0)
    np.testing.assert_allclose(on[:, 1], 0.0, atol=1e-9)
    assert on[-1, 0] >= 5.0 if count > 1 else len(on) == 1
