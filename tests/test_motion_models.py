"""Particles' motion against the motion of points in space: intersect, move, project."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.initialization import curvature_ahead, draw_yaw_rate
from paceline.speed.filter.motion_models import (
    CoordinatedTurn,
    FreeMotion,
    PathMotion,
    State,
    apply_rigid_motion,
    cross_homographies,
    diagonal_crossings,
    ensemble_kalman_update,
    plane_centres,
)
from paceline.speed.geometry.paths import Path, resampled

SEEDS = st.integers(0, 2**32 - 1)
SILENT = {
    **dict.fromkeys(("distance_noise", "lateral_noise", "vertical_noise", "heading_noise"), 0.0),
    "speed_noise": 1e-13,
}
RECTANGLE = np.array([[-0.9, -0.35], [0.9, -0.35], [0.9, 0.35], [-0.9, 0.35]])


def planes_at(rig, places, normals, **fields):
    """Particles whose regions outline rectangles about ``places`` (N, 3) — a larger part of the plane on the right."""
    N = len(places)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    across = np.cross([0.0, 1.0, 0.0], normals)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(normals, across)], axis=1)  # (N, 2, 3)
    corners = places[:, None] + RECTANGLE @ axes
    wide = places[:, None] + (1.1 * RECTANGLE + [0.1, -0.05]) @ axes
    still = {
        "speed": np.zeros(N),
        "s": np.zeros(N),
        "heading": np.zeros((N, 2)),
        "velocity": np.zeros((N, 3)),
        "turning": np.zeros((N, 3)),
    }
    distance = (normals * places).sum(1)
    return State(rig.project(corners)[0], rig.project(wide)[1], normals, distance, **still | fields)


def random_state(rig, seed, N=6, **fields):
    rng = np.random.default_rng(seed)
    places = rng.uniform([-3, -1, 12], [3, 2, 80], (N, 3))
    normals = np.column_stack([rng.uniform(-0.7, 0.7, N), rng.uniform(-0.3, 0.3, N), np.ones(N)])
    return planes_at(rig, places, normals, **fields)


def random_motions(seed, N=6):
    rng = np.random.default_rng([seed, 1])
    dR = Rotation.from_rotvec(rng.normal(0, 0.05, (N, 3))).as_matrix()
    return dR, rng.uniform([-1, -0.3, -3], [1, 0.3, 3], (N, 3))


def corners_in_space(rig, state):
    """World corners (N, 4, 3) of both regions: each view's rays with the plane, one particle at a time."""
    found = []
    for view in (0, 1):
        camera = rig.cameras[view]
        R, t = (np.eye(3), np.zeros(3)) if view == 0 else (rig.R, rig.t)
        centre = -R.T @ t
        world = np.empty((len(state), 4, 3))
        for i, quad in enumerate((state.left, state.right)[view]):
            for j, (x, y) in enumerate(quad):
                ray = R.T @ np.linalg.solve(camera.K, [x, y, 1.0])
                share = (state.distance[i] - state.normal[i] @ centre) / (state.normal[i] @ ray)
                world[i, j] = centre + share * ray
        found.append(world)
    return found


def assert_same_plane_and_regions(a, b, atol):
    for name in ("left", "right", "normal", "distance"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-11, atol=atol, err_msg=name)


# --- rigid motions and homographies --------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(SEEDS)
def test_regions_move_as_the_corners_in_space_do(rig, seed):
    state = random_state(rig, seed)
    dR, dt = random_motions(seed)
    after = apply_rigid_motion(state, rig, dt, dR)
    for view, corners in enumerate(corners_in_space(rig, state)):
        there = np.einsum("nij,nkj->nki", dR, corners) + dt[:, None]
        expected = rig.project(there)[view]
        np.testing.assert_allclose((after.left, after.right)[view], expected, rtol=1e-11, atol=1e-9)


@settings(deadline=None, max_examples=40)
@given(SEEDS)
def test_regions_of_planes_that_move_between_the_exposures_move_as_the_corners_do(rig, seed):
    """The right region is seen when the plane is displaced; the rigid motion holds there, too."""
    displacement = np.random.default_rng(seed).uniform([-1, -0.2, -1], [1, 0.2, 1])
    (dR, dt), state = random_motions(seed), random_state(rig, seed)
    at_right = replace(state, distance=state.distance + state.normal @ displacement)
    after = apply_rigid_motion(state, rig, dt, dR, displacement)
    for view, planes in enumerate((state, at_right)):
        there = np.einsum("nij,nkj->nki", dR, corners_in_space(rig, planes)[view]) + dt[:, None]
        expected = rig.project(there)[view]
        np.testing.assert_allclose((after.left, after.right)[view], expected, rtol=1e-11, atol=1e-9)


@settings(deadline=None, max_examples=40)
@given(SEEDS)
def test_the_plane_moves_as_three_of_its_points_do(rig, seed):
    state = random_state(rig, seed)
    dR, dt = random_motions(seed)
    after = apply_rigid_motion(state, rig, dt, dR)
    there = np.einsum("nij,nkj->nki", dR, corners_in_space(rig, state)[0]) + dt[:, None]
    for i, (a, b, c, _) in enumerate(there):
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal) * np.sign(normal[2])
        np.testing.assert_allclose(after.normal[i], normal, atol=1e-9)
        assert after.distance[i] == pytest.approx(normal @ a, abs=1e-9)


@settings(deadline=None, max_examples=25)
@given(SEEDS)
def test_two_moves_are_one(rig, seed):
    state = random_state(rig, seed)
    (dR, dt), (dR2, dt2) = random_motions(seed), random_motions(seed + 1)
    twice = apply_rigid_motion(apply_rigid_motion(state, rig, dt, dR), rig, dt2, dR2)
    assert_same_plane_and_regions(
        twice, apply_rigid_motion(state, rig, np.einsum("nij,nj->ni", dR2, dt) + dt2, dR2 @ dR), 1e-8
    )
    back = np.swapaxes(dR, 1, 2)
    there = apply_rigid_motion(state, rig, dt, dR)
    assert_same_plane_and_regions(apply_rigid_motion(there, rig, -np.einsum("nij,nj->ni", back, dt), back), state, 1e-8)


@settings(deadline=None, max_examples=25)
@given(SEEDS)
def test_cross_homographies_carry_left_pixels_of_the_plane_to_the_right(rig, seed):
    state = random_state(rig, seed)
    H = cross_homographies(rig, state)
    _, right = rig.project(corners_in_space(rig, state)[0])
    p = np.concatenate([state.left, np.ones((*state.left.shape[:2], 1))], axis=-1)
    q = np.einsum("nij,nkj->nki", H, p)
    np.testing.assert_allclose(q[..., :2] / q[..., 2:], right, rtol=1e-11, atol=1e-9)


@settings(deadline=None, max_examples=40)
@given(SEEDS)
def test_diagonals_cross_at_the_projected_centre(rig, seed):
    rng = np.random.default_rng(seed)
    places = rng.uniform([-3, -1, 12], [3, 2, 80], (5, 3))
    state = planes_at(rig, places, np.column_stack([rng.uniform(-0.7, 0.7, (5, 2)), np.ones(5)]))
    np.testing.assert_allclose(diagonal_crossings(state.left), rig.project(places)[0], atol=1e-8)
    np.testing.assert_allclose(plane_centres(rig, state), places, rtol=1e-9, atol=1e-9)
    a, b, c, d = np.concatenate([state.left, np.ones((5, 4, 1))], axis=-1).swapaxes(0, 1)
    meet = np.cross(np.cross(a, c), np.cross(b, d))
    np.testing.assert_allclose(diagonal_crossings(state.left), meet[:, :2] / meet[:, 2:], atol=1e-6)


# --- along a path --------------------------------------------------------------------------------------------------


def straight(direction, start=(-1.0, 1.2, 90.0), length=80.0):
    k = np.array(direction) / np.linalg.norm(direction)
    s = np.linspace(0, length, 128)
    return Path("line", "line", s, np.array(start) + s[:, None] * k, np.zeros((0, 128, 3))), k


def circle(radius, side, tilt=0.0, length=60.0):
    """An arc that begins 70 m ahead and comes closer, turning right (``side`` 1) or left; the ground tilted."""
    s = np.linspace(0, length, 128)
    a = s / radius
    flat = np.column_stack([-side * radius * (1 - np.cos(a)), np.full_like(s, 1.2), 70 - radius * np.sin(a)])
    ground = Rotation.from_euler("xz", [tilt, 0.6 * tilt]).as_matrix()
    return Path("arc", "curve", s, flat @ ground.T, np.zeros((0, 128, 3))), ground


@settings(deadline=None, max_examples=30)
@given(SEEDS, st.floats(1, 60), st.sampled_from([1 / 30, 0.1, 0.2, 0.4]))
def test_a_straight_path_moves_pixels_by_equations_22_to_24(rig, seed, speed, dt):
    path, k = straight([0.1, 0.015, -1.0])
    state = random_state(rig, seed, speed=np.full(6, speed), s=np.full(6, 12.0))
    after = PathMotion(rig, path, SpeedConfiguration(**SILENT)).propagate(state, dt, np.random.default_rng(seed))
    v = speed * dt
    corners = corners_in_space(rig, state)
    for view, (before, now) in enumerate(((state.left, after.left), (state.right, after.right))):
        K = rig.cameras[view].K
        direction = k if view == 0 else rig.R @ k
        Z = corners[0][..., 2] if view == 0 else rig.to_right(corners[1])[..., 2]
        x, y = before[..., 0], before[..., 1]
        step = np.stack(
            [
                K[0, 0] * direction[0] + (K[0, 2] - x) * direction[2],
                K[1, 1] * direction[1] + (K[1, 2] - y) * direction[2],
            ],
            axis=-1,
        )
        expected = before + (v / (Z + v * direction[2]))[..., None] * step
        if (Z + v * direction[2]).min() > 1:  # still before the camera
            np.testing.assert_allclose(now, expected, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(after.distance, state.distance + v * state.normal @ k, rtol=1e-9)
    np.testing.assert_allclose(after.normal, state.normal, atol=1e-12)
    np.testing.assert_allclose(after.s, 12.0 + v, rtol=1e-12)
    np.testing.assert_allclose(after.speed, speed, atol=1e-9)


@pytest.mark.parametrize("tilt", [0.0, 0.06])
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("radius", [30.0, 80.0, 300.0])
def test_on_a_circle_the_step_is_a_chord_and_the_turn_is_its_arc(rig, radius, side, tilt):
    path, ground = circle(radius, side, tilt)
    s = np.array([0.5, 7.0, 21.0, 40.0])
    speed, dt = np.array([3.0, 12.0, 25.0, 33.0]), 0.2
    # the plane need not stand on the path: what turns is rigid
    state = planes_at(rig, path.at(s) + [0.3, -0.6, 0.0], path.frames(s)[:, :, 0] * [-1, -1, -1], speed=speed, s=s)
    after = PathMotion(rig, path, SpeedConfiguration(**SILENT)).propagate(state, dt, np.random.default_rng(0))
    chord = np.linalg.norm(path.at(after.s) - path.at(s), axis=1)
    np.testing.assert_allclose(chord, speed * dt, rtol=1e-6)
    arc = 2 * radius * np.arcsin(speed * dt / (2 * radius))
    np.testing.assert_allclose(after.s - s, arc, rtol=1e-5)
    turn = Rotation.from_rotvec((side * arc / radius)[:, None] * ground[:, 1]).as_matrix()
    np.testing.assert_allclose(after.normal, np.einsum("nij,nj->ni", turn, state.normal), atol=1e-5)
    centre = ground @ np.array([-side * radius, 1.2, 70.0])
    expected = centre + np.einsum("nij,nj->ni", turn, plane_centres(rig, state) - centre)
    np.testing.assert_allclose(plane_centres(rig, after), expected, atol=1e-4)
    if tilt == 0:
        assert (np.sign(np.cross(state.normal, after.normal)[:, 1]) == side).all()


def test_backwards_along_a_path_undoes_forwards(rig):
    path, _ = circle(60.0, 1)
    state = random_state(rig, 4, speed=np.full(6, 20.0), s=np.linspace(10, 40, 6))
    model = PathMotion(rig, path, SpeedConfiguration(**SILENT))
    there = model.propagate(state, 0.2, np.random.default_rng(0))
    back = model.propagate(replace(there, speed=-there.speed), 0.2, np.random.default_rng(0))
    np.testing.assert_allclose(back.s, state.s, atol=1e-5)
    assert_same_plane_and_regions(back, state, 1e-3)


def test_a_particles_own_heading_turns_its_step(rig):
    """Yaw and pitch of +10 mrad carry a straight step of 4 m by 4 cm to the right of travel and 4 cm down."""
    path, k = straight([0.0, 0.0, -1.0])
    heading = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]])
    state = planes_at(
        rig, np.tile([0.5, 0.4, 60.0], (3, 1)), np.tile(-k, (3, 1)), speed=np.full(3, 20.0), heading=heading
    )
    after = PathMotion(rig, path, SpeedConfiguration(**SILENT)).propagate(state, 0.2, np.random.default_rng(0))
    step = plane_centres(rig, after) - [0.5, 0.4, 60.0]
    # travel is towards the camera, so its right is the camera's left
    np.testing.assert_allclose(step, [[0, 0, -4], [-0.04, 0, -4], [0, 0.04, -4]], atol=1e-9)


def test_without_noise_the_generator_does_not_matter(rig):
    for path in (straight([0.1, 0.0, -1.0])[0], circle(80.0, -1)[0]):
        model = PathMotion(rig, path, SpeedConfiguration(**SILENT))
        state = random_state(rig, 2, speed=np.full(6, 15.0), s=np.full(6, 5.0))
        a, b = (model.propagate(state, 0.2, np.random.default_rng(seed)) for seed in (1, 2))
        assert_same_plane_and_regions(a, b, 1e-8)


def test_the_noises_have_the_stated_size_and_grow_with_the_root_of_time(rig):
    N = 20000
    c = SpeedConfiguration(
        speed_noise=0.2, distance_noise=0.05, lateral_noise=0.1, vertical_noise=0.03, heading_noise=0.02
    )
    path, _ = circle(5000.0, 1)
    T, P, B = path.frames(np.array(20.0)).T
    one = planes_at(rig, path.at(np.array([20.0])), -T[None])
    for dt in (0.2, 0.05):
        state = replace(one[np.zeros(N, int)], speed=np.full(N, 20.0), s=np.full(N, 20.0))
        after = PathMotion(rig, path, c).propagate(state, dt, np.random.default_rng(8))
        scale = np.sqrt(dt / 0.2)
        shift = plane_centres(rig, after) - plane_centres(rig, one)
        along = np.hypot(0.2 * scale * dt, 0.05 * scale)
        np.testing.assert_allclose((after.speed - 20.0).std(), 0.2 * scale, rtol=0.03)
        np.testing.assert_allclose((shift @ T).std(), along, rtol=0.03)
        np.testing.assert_allclose(after.heading.std(axis=0), [0.02 * scale, 0.006 * scale], rtol=0.03)
        aside = 20.0 * dt * after.heading.std(axis=0)
        np.testing.assert_allclose((shift @ P).std(), np.hypot(0.1 * scale, aside[0]), rtol=0.03)
        np.testing.assert_allclose((shift @ B).std(), np.hypot(0.03 * scale, aside[1]), rtol=0.03)
        np.testing.assert_allclose((shift @ T).mean(), 20.0 * dt, atol=5 * along / np.sqrt(N) + 1e-4)


# --- free motion ---------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=25)
@given(SEEDS, st.sampled_from([1 / 30, 0.2]))
def test_free_motion_carries_the_centre_and_turns_about_it(rig, seed, dt):
    rng = np.random.default_rng(seed)
    velocity, turning = rng.normal(0, 5, (6, 3)), rng.normal(0, 0.3, (6, 3))
    state = random_state(rig, seed, velocity=velocity, turning=turning)
    model = FreeMotion(rig, SpeedConfiguration(rotation_noise=0.0, translation_noise=0.0))
    after = model.propagate(state, dt, np.random.default_rng(0))
    np.testing.assert_allclose(
        plane_centres(rig, after), plane_centres(rig, state) + velocity * dt, rtol=1e-9, atol=1e-8
    )
    np.testing.assert_allclose(after.speed, np.sqrt((velocity**2).sum(1)))
    for i, (a, b, c) in enumerate(turning * dt):
        Rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        Ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        Rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
        np.testing.assert_allclose(after.normal[i], Rz @ Ry @ Rx @ state.normal[i], atol=1e-12)


def test_free_motion_at_constant_velocity_is_a_straight_line(rig):
    model = FreeMotion(rig, SpeedConfiguration(rotation_noise=0.0, translation_noise=0.0))
    state = random_state(rig, 5, velocity=np.tile([0.5, 0.0, -8.0], (6, 1)))
    after, start = state, plane_centres(rig, state)
    for dt in (0.2, 0.1, 0.2, 0.4):
        after = model.propagate(after, dt, np.random.default_rng(0))
    np.testing.assert_allclose(plane_centres(rig, after), start + 0.9 * np.array([0.5, 0.0, -8.0]), atol=1e-7)
    np.testing.assert_array_equal(after.normal, state.normal)


def test_free_motions_noises_have_the_stated_size(rig):
    N = 20000
    state = random_state(rig, 3, N=1)[np.zeros(N, int)]
    c = SpeedConfiguration(rotation_noise=0.02, translation_noise=0.3)
    for dt in (0.2, 0.05):
        after = FreeMotion(rig, c).propagate(state, dt, np.random.default_rng(1))
        np.testing.assert_allclose(after.turning.std(0), 0.02 * np.sqrt(dt / 0.2), rtol=0.03)
        np.testing.assert_allclose(after.velocity.std(0), 0.3 * np.sqrt(dt / 0.2), rtol=0.03)


@settings(deadline=None, max_examples=25)
@given(SEEDS, st.sampled_from([1 / 30, 0.2, 1.0]))
def test_a_coordinated_turn_is_the_integral_of_a_turning_velocity(rig, seed, dt):
    """dp/dt = v, dv/dt = ω y × v, integrated numerically; the plane's normal turns as the velocity does."""
    rng = np.random.default_rng(seed)
    velocity, yaw_rate = rng.normal(0, 5, (6, 3)), rng.normal(0, 0.3, 6)
    yaw_rate[0] = 0.0
    state = random_state(rig, seed, velocity=velocity, turning=np.outer(yaw_rate, [0.0, 1.0, 0.0]))
    model = CoordinatedTurn(rig, SpeedConfiguration(rotation_noise=0.0, translation_noise=0.0))
    after = model.propagate(state, dt, np.random.default_rng(0))
    moved = plane_centres(rig, after) - plane_centres(rig, state)
    for i in range(6):

        def derivative(_, x, omega=yaw_rate[i]):
            turning = np.array([0.0, omega, 0.0])
            return np.concatenate([x[3:6], np.cross(turning, x[3:6]), np.cross(turning, x[6:])])

        start = np.concatenate([np.zeros(3), velocity[i], state.normal[i]])
        end = solve_ivp(derivative, (0.0, dt), start, rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(moved[i], end[:3], atol=1e-7)
        np.testing.assert_allclose(after.velocity[i], end[3:6], atol=1e-7)
        np.testing.assert_allclose(after.normal[i], end[6:], atol=1e-7)
    np.testing.assert_allclose(after.speed, np.sqrt((velocity**2).sum(1)))


@pytest.mark.parametrize(
    ("speed", "std", "curvature"), [(15.0, 2.0 / 15.0, 0.0), (1.0, 1.0 / 6.4, 0.0), (15.0, 2.0 / 15.0, -1 / 40)]
)
def test_the_first_yaw_rate_is_that_of_a_usual_lateral_acceleration(rig, speed, std, curvature):
    """2 m/s² at usual speeds, the smallest turning circle at low ones, about the road's turn; whatever is drawn, the
    turn leads to the same place."""
    N, dt = 20000, 0.2
    velocity = speed * np.array([0.6, 0.05, -0.8]) / np.linalg.norm([0.6, 0.05, -0.8])
    state = random_state(rig, 4, N=1, velocity=velocity[None], speed=np.array([speed]))[np.zeros(N, int)]
    drawn = draw_yaw_rate(state, dt, curvature, np.random.default_rng(2))
    np.testing.assert_allclose(drawn.turning[:, 1].std(), std, rtol=0.03)
    assert abs(drawn.turning[:, 1].mean() - curvature * speed) < 4 * std / np.sqrt(N)
    np.testing.assert_array_equal(drawn.turning[:, [0, 2]], 0.0)
    model = CoordinatedTurn(rig, SpeedConfiguration(rotation_noise=0.0, translation_noise=0.0))
    after = model.propagate(drawn, dt, np.random.default_rng(0))
    moved = plane_centres(rig, after) - plane_centres(rig, state)
    np.testing.assert_allclose(moved[:, [0, 2]], np.tile(velocity[[0, 2]] * dt, (N, 1)), atol=1e-8)


def test_the_curvature_ahead_is_that_of_the_path_in_the_direction_of_travel():
    turn = np.linspace(0.0, 0.8, 60)
    points = np.column_stack([50.0 * (1 - np.cos(turn)), np.full(60, 1.5), 10 + 50.0 * np.sin(turn)])
    path = resampled("lane", "curve", points, np.zeros((0, 60, 3)))
    place, ahead = points[20], points[21] - points[20]
    for velocity, curvature in ((ahead, 1 / 50), (-ahead, -1 / 50)):
        for paths in ([path, path.reversed()], [path.reversed(), path]):
            assert curvature_ahead(paths, place, velocity) == pytest.approx(curvature, rel=0.01)
    assert curvature_ahead([], place, ahead) == 0.0


# --- the Kalman step -----------------------------------------------------------------------------------------------


def kalman(mean, covariance, measured, noise):
    """Exact update of a Gaussian whose first components are measured."""
    H = np.eye(len(measured), len(mean))
    gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + noise)
    rest = np.eye(len(mean)) - gain @ H
    return mean + gain @ (measured - H @ mean), rest @ covariance


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("free", [False, True])
def test_the_ensemble_step_is_the_kalman_update_of_a_gaussian_cloud(rig, free, weighted):
    rng, N = np.random.default_rng(12), 40000
    root = rng.normal(0, 1, (6, 6))  # place; then velocity, or speed and heading
    scales = np.array([0.05, 0.05, 0.4, *([0.5, 0.1, 1.5] if free else [1.5, 0.01, 0.01])])
    correlation = root @ root.T
    correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    covariance = correlation * np.outer(scales, scales)
    mean = np.array([0.4, 0.8, 50.0, *([0.2, 0.0, -20.0] if free else [20.0, 0.0, 0.0])])
    x = rng.multivariate_normal(mean, covariance, N)
    W = np.full(N, 1 / N)
    if weighted:  # drawn twice as wide, weighed back
        x = rng.multivariate_normal(mean, 2 * covariance, N)
        square = np.einsum("ni,ij,nj->n", x - mean, np.linalg.inv(covariance), x - mean)
        W = np.exp(-square / 4)
        W /= W.sum()
    path, k = straight([0.1, 0.015, -1.0])
    fields = {"velocity": x[:, 3:]} if free else {"speed": x[:, 3], "heading": x[:, 4:]}
    state = planes_at(rig, x[:, :3], np.tile(-k, (N, 1)), s=np.full(N, 40.0), **fields)
    model = FreeMotion(rig, SpeedConfiguration()) if free else PathMotion(rig, path, SpeedConfiguration())
    noise = np.array([[4e-4, 1e-4, 0], [1e-4, 4e-4, 1e-3], [0, 1e-3, 0.04]])
    measured = np.array([0.46, 0.75, 49.5])
    seen = measured + rng.multivariate_normal(np.zeros(3), noise, N)
    places = plane_centres(rig, state)
    after = ensemble_kalman_update(rig, state, W, seen, noise, model)
    moved_fields = after.velocity if free else np.column_stack([after.speed, after.heading])
    if free:
        np.testing.assert_allclose(after.speed, np.sqrt((after.velocity**2).sum(1)))
    else:
        np.testing.assert_allclose(after.s - 40.0, (plane_centres(rig, after) - places) @ k, atol=1e-6)
    np.testing.assert_allclose(after.normal, state.normal, atol=1e-12)
    y = np.column_stack([plane_centres(rig, after), moved_fields])
    exact_mean, exact_covariance = kalman(mean, covariance, measured, noise)
    std = np.sqrt(np.diag(exact_covariance))
    size = 1 / (W**2).sum()
    np.testing.assert_array_less(np.abs(W @ y - exact_mean), 6 * scales / np.sqrt(size))
    found = (W[:, None] * (y - W @ y)).T @ (y - W @ y)
    np.testing.assert_allclose(found / np.outer(std, std), exact_covariance / np.outer(std, std), atol=0.06)


def test_a_state_is_indexed_particle_by_particle(rig):
    state = random_state(rig, 1, speed=np.arange(6.0))
    some = state[np.array([4, 4, 0])]
    assert len(some) == 3 and some.speed.tolist() == [4.0, 4.0, 0.0]
    np.testing.assert_array_equal(some.left[0], state.left[4])
    np.testing.assert_array_equal(some.heading.shape, (3, 2))
