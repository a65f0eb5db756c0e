"""Reconstructed paths against the lines and circles that were projected to draw them."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from selection import slow_after

from paceline.cameras import Camera, StereoRig
from paceline.errors import UnusableInput
from paceline.simulation.random_scenes.drawn import random_bend
from paceline.simulation.stereo.clip import World
from paceline.speed.geometry import path_reconstruction
from paceline.speed.geometry.path_reconstruction import reconstruct, reconstruct_curve
from paceline.speed.geometry.paths import (
    Path,
    UndeterminedPath,
    distance_beside,
    from_points,
    level_frames,
    plucker_line,
    reconstruct_line,
)

LINE_POINTS = 20
CURVE_POINTS = 22


def inside(rig, points):
    views = zip(rig.project(points), rig.cameras, strict=True)
    return np.all([(p > 0).all(1) & (p < np.array(c.image_size) - 1).all(1) for p, c in views], axis=0)


def spread_over(points, n, start=0.0):
    """``n`` of ``points`` (N, …), evenly."""
    return points[np.round((np.arange(n) + start) / (n - 1 + 2 * start) * (len(points) - 1)).astype(int)]


# --- straight paths ------------------------------------------------------------------------------------------------


def line_points(offset, height, heading, slope, near, far):
    """Points along a line through (offset, height) where it is half-way, and its direction (3,)."""
    k = np.array([np.sin(heading), slope, np.cos(heading)])
    k /= np.linalg.norm(k)
    z = np.linspace(near, far, 400) - (near + far) / 2
    return np.array([offset, height, (near + far) / 2]) + (z / k[2])[:, None] * k, k


def drawn_line(rig, points, rng=None, sigma=0.0):
    """The line as drawn in both views: points that do not correspond."""
    left = spread_over(rig.project(points)[0], LINE_POINTS)
    right = spread_over(rig.project(points)[1], LINE_POINTS - 3, start=0.4)[::-1]
    if rng is not None:
        left, right = (p + rng.normal(0, sigma, p.shape) for p in (left, right))
    return left, right


GEOMETRIES = [
    (-2.0, 1.8, 0.0, 0.0, 25.0, 75.0),
    (1.5, 3.0, 0.06, 0.02, 20.0, 60.0),
    (-4.0, 1.5, 0.1, -0.01, 18.0, 50.0),
    (0.5, 6.0, -0.04, 0.0, 30.0, 80.0),
]


@settings(deadline=None, max_examples=20)
@given(
    st.floats(-4, 4),
    st.floats(1.2, 6),
    st.floats(-0.12, 0.12),
    st.floats(-0.04, 0.04),
    st.floats(15, 30),
    st.floats(20, 50),
)
def test_an_exact_drawing_gives_the_exact_line(rig, offset, height, heading, slope, near, length):
    points, k = line_points(offset, height, heading, slope, near, near + length)
    planes = [np.cross(points[0] - centre, k) for centre in (np.zeros(3), -rig.R.T @ rig.t)]
    across = np.linalg.norm(np.cross(*(n / np.linalg.norm(n) for n in planes)))
    assume(across > 0.05)  # a line that both cameras see in nearly the same plane is refused, and rightly
    path = reconstruct_line("a", rig, *drawn_line(rig, points))
    T = path.frames(path.s)[:, :, 0]
    np.testing.assert_allclose(T, np.tile(k, (len(T), 1)), atol=1e-6)
    away = points - path.at(np.array([path.nearest(p) for p in points]))
    assert np.abs(away).max() < 1e-4
    # the path covers what was drawn on the left
    np.testing.assert_allclose(path.points[[0, -1]], points[[0, -1]], atol=1e-3)
    np.testing.assert_allclose(path.s[-1], np.linalg.norm(points[-1] - points[0]), rtol=1e-5)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_two_planes_meet_in_the_plucker_line(seed):
    rng = np.random.default_rng(seed)
    Ql, Qr = rng.normal(0, 1, (2, 4)) * [1, 1, 1, 10]
    direct = np.cross(Ql[:3], Qr[:3])
    if np.linalg.norm(direct) < 0.05 or abs(direct[2]) < 1e-3:
        return
    k, foot = plucker_line(Ql, Qr)
    np.testing.assert_allclose(k, direct / np.linalg.norm(direct) * np.sign(direct[2]), atol=1e-9)
    nearest = np.linalg.lstsq(np.stack([Ql[:3], Qr[:3]]), -np.array([Ql[3], Qr[3]]), rcond=None)[0]  # least norm
    np.testing.assert_allclose(foot, nearest, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("sigma", slow_after(1, [0.4, 0.5]))
def test_the_lines_covariance_is_calibrated(rig, geometry, sigma):
    """Over 200 drawings the errors of the direction, and of both ends, are what the modes say."""
    points, k = line_points(*geometry)
    across = level_frames(k)[:, 1:]
    rng = np.random.default_rng(5)
    direction, ends = [], []
    for _ in range(200):
        path = reconstruct_line("a", rig, *drawn_line(rig, points, rng, sigma))
        T = path.points[-1] - path.points[0]
        turn = (path.modes[:, -1] - path.modes[:, 0]) @ across / path.s[-1]
        error = (T / np.linalg.norm(T) - k) @ across
        direction.append(error @ np.linalg.solve(turn.T @ turn, error))
        shift, error = [], []
        for end in (points[0], points[-1]):
            s = np.array(path.nearest(end))
            j = np.clip(np.searchsorted(path.s, s), 0, len(path.s) - 1)
            shift.append(path.modes[:, j] @ across)
            error.append((path.at(s) - end) @ across)
        shift, error = np.concatenate(shift, axis=1), np.concatenate(error)
        ends.append(error @ np.linalg.solve(shift.T @ shift, error))
    for squares, dof in ((direction, 2), (ends, 4)):
        # the scatter is itself estimated from few points, and its prior takes half a pixel for granted
        assert 0.6 * dof < np.mean(squares) < 1.5 * dof
        assert 0.86 < np.mean(np.array(squares) < chi2.ppf(0.95, dof)) <= 0.995


@pytest.mark.parametrize("shape", ["line", "curve"])
def test_a_drawing_is_as_precise_as_it_is_said_to_be(rig, shape):
    """Few exact points do not show how precisely they were drawn."""
    points, _ = line_points(*GEOMETRIES[0])
    drawn = drawn_line(rig, points)
    paths = [reconstruct("a", shape, rig, *drawn, sigma) for sigma in (0.1, 0.8)]
    fine, coarse = (np.median(np.linalg.norm(path.heading_modes(path.s)[0], axis=0)) for path in paths)
    assert coarse > 1.3 * fine


@pytest.mark.parametrize("heading", [np.pi / 2, np.pi / 2 - 0.002])
def test_lines_along_the_epipolar_lines_are_refused(rig, heading):
    level = StereoRig(rig.left, rig.left, np.eye(3), np.array([-0.5, 0.0, 0.0]))
    points = np.array([0.0, 1.5, 30.0]) + np.linspace(-5, 5, 400)[:, None] * [np.sin(heading), 0.0, np.cos(heading)]
    for seed in range(20):
        with pytest.raises(UnusableInput, match=r"path lane0: .* parallel to the epipolar lines"):
            reconstruct("lane0", "line", level, *drawn_line(level, points, np.random.default_rng(seed), 0.4))


@pytest.mark.parametrize("shape", ["line", "curve"])
def test_drawings_that_meet_behind_the_cameras_are_refused(rig, shape):
    level = StereoRig(rig.left, rig.left, np.eye(3), np.array([-0.5, 0.0, 0.0]))
    points, _ = line_points(*GEOMETRIES[0])
    left, right = drawn_line(level, points)
    cause = {"line": "reconstructs behind the cameras", "curve": "no road surface before the cameras"}[shape]
    with pytest.raises(UnusableInput, match=f"path a: {cause}"):
        reconstruct("a", shape, level, right, left)


# --- curved paths --------------------------------------------------------------------------------------------------


def arc(radius, side, tilt=0.0, length=45.0, near=18.0, offset=-1.5, height=4.0):
    """An arc on the ground below the camera, symmetric about the view where it is half-way, from near to far; its
    ground tilted about the near end. ``side`` 1 turns right."""
    a = np.linspace(-length / 2, length / 2, 1200) / radius
    x, z = side * radius * (1 - np.cos(a)), radius * np.sin(a)
    points = np.column_stack([x - x[0], 0 * x, z - z[0]]) @ Rotation.from_euler("x", tilt).as_matrix().T
    return points + [offset, height, near]


@pytest.fixture(scope="module")
def high_rig():
    """A rig that looks down on a road: f = 1600 px, a metre of baseline, 5 m above the ground, tilted by 6°."""
    camera = Camera((1280, 960), np.array([[1600.0, 0, 639.5], [0, 1600, 479.5], [0, 0, 1]]))
    R = Rotation.from_euler("xyz", [0.004, -0.015, 0.006]).as_matrix()
    return StereoRig(camera, camera, R, np.array([-0.8, 0.02, -0.01]))


def drawn_curve(rig, points, rng=None, sigma=0.0, opposite=False):
    """The stretch that both views see, drawn in each: far to near, on the right also ``opposite``; and that stretch."""
    seen = points[inside(rig, points)]
    left, right = rig.project(seen)
    n = np.linspace(0, 1, CURVE_POINTS) ** 1.5
    left = left[::-1][np.round((1 - n[::-1]) * (len(seen) - 1)).astype(int)]
    right = spread_over(right, CURVE_POINTS - 3, start=0.4)
    right = right if opposite else right[::-1]
    if rng is not None:
        left, right = (p + rng.normal(0, sigma, p.shape) for p in (left, right))
    return left, right, seen


def misses_of(path, points):
    """Errors (N, 2) across the path of true ``points`` (N, 3), and the standard deviations (N, 2) that it states."""
    errors, stds = [], []
    for p in points:
        s = np.array(path.nearest(p))
        across = path.frames(s)[:, 1:]
        modes = np.stack([[np.interp(s, path.s, m[:, c]) for c in range(3)] for m in path.modes])
        errors.append((path.at(s) - p) @ across)
        stds.append(np.sqrt(((modes @ across) ** 2).sum(0)))
    return np.array(errors), np.array(stds)


@pytest.mark.parametrize(
    ("radius", "side", "tilt"),
    slow_after(
        1,
        [
            (30.0, -1, 0.03),
            (300.0, 1, 0.0),
            (30.0, 1, 0.0),
            (80.0, 1, 0.03),
            (80.0, -1, 0.0),
            (300.0, -1, 0.03),
        ],
    ),  # fmt: skip
)
def test_an_arc_is_found_from_drawings_in_either_order(high_rig, radius, side, tilt):
    points = arc(radius, side, tilt, length=25.0 if radius < 50 else 45.0)
    paths = [
        reconstruct("a", "curve", high_rig, *drawn_curve(high_rig, points, opposite=opposite)[:2])
        for opposite in (False, True)
    ]
    seen = drawn_curve(high_rig, points)[2]
    for path in paths:
        errors, stds = misses_of(path, spread_over(seen, 9))
        # Neighbouring strengths of the prior are about as evident here; which is taken hangs on the last digits.
        assert np.abs(errors).max() < 0.1
        assert (np.abs(errors) < 0.3 * stds).all()  # the drawing's own noise is still allowed for
        np.testing.assert_allclose(np.diff(path.s), np.linalg.norm(np.diff(path.points, axis=0), axis=1), rtol=2e-3)
    np.testing.assert_allclose(
        paths[0].at(np.array([paths[0].nearest(p) for p in seen[::100]])),
        paths[1].at(np.array([paths[1].nearest(p) for p in seen[::100]])),
        atol=0.1,
    )


@pytest.mark.parametrize(("radius", "side"), slow_after(0, [(120.0, -1), (300.0, 1)]))
def test_the_curves_covariance_covers_its_errors(high_rig, radius, side):
    points = arc(radius, side)
    rng = np.random.default_rng(9)
    z, yaw = [], []
    for k in range(8):
        left, right, seen = drawn_curve(high_rig, points, rng, 0.5, opposite=bool(k % 2))
        path = reconstruct_curve("a", high_rig, left, right)
        errors, stds = misses_of(path, spread_over(seen, 5))
        assert np.abs(errors).max() < 1.5
        z.append(errors / stds)
        middle = np.array([len(seen) // 4, len(seen) // 2, 3 * len(seen) // 4])
        s = np.array([path.nearest(p) for p in seen[middle]])
        T, exact = path.frames(s)[:, :, 0], seen[middle + 1] - seen[middle - 1]
        exact /= np.linalg.norm(exact, axis=1, keepdims=True)
        turn = np.cross(exact, T)[:, 1] * np.sign((T * exact).sum(1))
        yaw.append(turn / np.sqrt((path.heading_modes(s)[0] ** 2).sum(0)))
    for values in (np.array(z), np.array(yaw)):
        assert np.mean(np.abs(values) < 1.96) > 0.8
        assert 0.4 < np.sqrt(np.mean(values**2)) < 1.6


def crossing_bend(rng):
    """A bend of 30 to 80 m radius that comes towards a low camera and crosses its view: somewhere it runs along the
    epipolar lines. Points from far to near, and its radius."""
    radius, side = rng.uniform(30, 80), rng.choice([-1, 1])
    a = np.linspace(20 / radius, -35 / radius, 1200)  # from the place where it points at the camera
    x = side * (rng.uniform(1, 4) - radius * (1 - np.cos(a)))
    return np.column_stack([x, 1.7 + 0.02 * x, rng.uniform(42, 50) + radius * np.sin(a)])


@pytest.mark.parametrize("seed", slow_after(0, [1, 2, 3]))
def test_a_bend_that_crosses_the_view_is_determined_with_its_covariance(rig, seed):
    rng = np.random.default_rng(seed)
    z = []
    for _ in range(6):
        left, right, seen = drawn_curve(rig, crossing_bend(rng), rng, 0.5)
        with suppress(UndeterminedPath):  # 7 of 100 such bends are known to worse than 6°
            errors, stds = misses_of(reconstruct_curve("a", rig, left, right), spread_over(seen, 5))
            z.append(errors / stds)
    assert len(z) >= 4
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.6
    assert np.mean(np.abs(z) < 1.96) > 0.8


@pytest.mark.parametrize("seed", slow_after(0, [9501, 9500]))
def test_a_long_bend_is_found_as_well_as_its_covariance_says(monkeypatch, seed):
    """From a first curve that fits badly the road was found 20 degrees off, and slid along itself by up to 137 m."""
    monkeypatch.setattr(path_reconstruction, "MAX_DIRECTION_STD_RAD", np.inf)  # as it is, however uncertain
    world = World(random_bend(seed))
    (drawn,) = world.clip["paths"].values()
    path = reconstruct_curve("a", world.rig, np.array(drawn["left"]), np.array(drawn["right"]))
    z, along = [], []
    places = np.array([row["position"] for row in world.truth if row["inside"]])
    for before, place, after in zip(places, places[1:], places[2:], strict=False):
        s = np.array([path.nearest(place)])
        forwards, rightwards, _ = path.frames(s)[0].T
        turn = np.arctan((after - before) @ rightwards / ((after - before) @ forwards))
        z.append(turn / np.sqrt((path.heading_modes(s)[0] ** 2).sum() + 0.01**2))
        modes = [[np.interp(s[0], path.s, m[:, c]) for c in range(3)] for m in path.modes]
        along.append(np.linalg.norm(modes @ forwards))
    assert np.sqrt(np.mean(np.square(z))) < 1.6
    assert max(along) < 10.0


def test_curves_along_the_epipolar_lines_are_refused(rig):
    level = StereoRig(rig.left, rig.left, np.eye(3), np.array([-0.5, 0.0, 0.0]))
    a = np.linspace(-0.1, 0.1, 400)
    points = np.column_stack([50 * np.sin(a), np.full_like(a, 0.01), 80 - 50 * np.cos(a)])  # at the cameras' height
    for seed in range(3):
        rng = np.random.default_rng(seed)
        with pytest.raises(UnusableInput, match="path a: .*(parallel to the epipolar lines|no road surface)"):
            reconstruct("a", "curve", level, *drawn_curve(level, points, rng, 0.4)[:2])


def test_curves_of_two_lines_are_refused(high_rig):
    left, right, _ = drawn_curve(high_rig, arc(100.0, 1))
    with pytest.raises(
        UnusableInput, match="path a: no road surface before the cameras carries one drawn curve onto the other"
    ):
        reconstruct("a", "curve", high_rig, left, right - [0, 600])


# --- what a path can do --------------------------------------------------------------------------------------------


def circle(radius, side, length=80.0, modes=0):
    s = np.linspace(0, length, 128)
    a = s / radius
    points = np.column_stack([side * radius * (1 - np.cos(a)), np.full_like(s, 1.5), 15 + radius * np.sin(a)])
    displacement = np.random.default_rng(1).normal(0, 0.1, (modes, 1, 3)) * np.cos(s / 20)[:, None]
    return Path("c", "curve", s, points, displacement)


@pytest.mark.parametrize("offset", [-1.85, 1.85])
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("radius", [30.0, 200.0])
def test_an_offset_changes_a_circles_radius(radius, side, offset):
    path = circle(radius, side).shifted(offset)
    centre = np.array([side * radius, 1.5, 15.0])
    expected = radius - side * offset  # to the right of travel: inwards where the path turns right
    np.testing.assert_allclose(np.linalg.norm(path.points - centre, axis=1), expected, atol=1e-3)
    assert path.s[-1] == pytest.approx(80.0 * expected / radius, rel=1e-3)


def test_reversed_travel_has_its_right_on_the_other_side():
    path = circle(60.0, 1)
    there, back = path.shifted(1.85), path.reversed().shifted(-1.85)
    np.testing.assert_allclose(back.points[::-1], there.points, atol=1e-3)


def test_reversing_twice_gives_the_path_back():
    path = circle(60.0, -1, modes=3)
    back = path.reversed()
    np.testing.assert_allclose(back.points, path.points[::-1])
    np.testing.assert_allclose(back.at(np.array([10.0])), path.at(np.array([70.0])), atol=1e-9)
    np.testing.assert_allclose(back.frames(np.array(10.0))[:, 0], -path.frames(np.array(70.0))[:, 0], atol=1e-6)
    twice = back.reversed()
    for name in ("s", "points", "modes"):
        np.testing.assert_allclose(getattr(twice, name), getattr(path, name), atol=1e-12)


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3).map(np.array), min_size=1, max_size=5))
def test_level_frames_are_orthonormal_and_level(directions):
    d = np.array([v for v in directions if np.linalg.norm(v) > 1e-2] or [[0.0, 1.0, 0.0]])
    F = level_frames(d)
    # straight down, x stands in for the horizontal to a millionth
    np.testing.assert_allclose(np.swapaxes(F, 1, 2) @ F, np.tile(np.eye(3), (len(d), 1, 1)), atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(F), 1)
    np.testing.assert_allclose(F[:, :, 0], d / np.linalg.norm(d, axis=1, keepdims=True), atol=1e-12)
    upright = np.hypot(d[:, 0], d[:, 2]) > 1e-3
    np.testing.assert_allclose(F[upright, 1, 1], 0, atol=1e-9)  # P is horizontal
    assert (F[upright, 1, 2] > 0).all()  # B points down


@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize("side", [1, -1])
def test_a_paths_frames_are_orthonormal_and_do_not_roll(side, tilt):
    """On a circle the frames turn about the circle's axis by the arc, wherever the axis points."""
    ground = Rotation.from_euler("xz", [tilt, -0.7 * tilt]).as_matrix()
    flat = circle(50.0, side)
    path = Path("c", "curve", flat.s, flat.points @ ground.T, flat.modes)
    s = np.linspace(0, 80, 31)
    F = path.frames(s)
    np.testing.assert_allclose(np.swapaxes(F, 1, 2) @ F, np.tile(np.eye(3), (31, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(F), 1)
    exact = ground @ np.column_stack([side * np.sin(s / 50), 0 * s, np.cos(s / 50)])[..., None]
    np.testing.assert_allclose(F[:, :, 0], exact[..., 0], atol=1e-5)
    assert F[0, 1, 1] == pytest.approx(0, abs=1e-6) and (F[:, 1, 2] > 0.98).all()
    turn = Rotation.from_rotvec((side * s / 50)[:, None] * ground[:, 1]).as_matrix()
    np.testing.assert_allclose(F @ F[0].T, turn, atol=2e-5)


def test_right_is_right_of_travel():
    np.testing.assert_allclose(level_frames(np.array([0.0, 0.0, 1.0])), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(level_frames(np.array([0.0, 0.0, -1.0]))[:, 1], [-1, 0, 0], atol=1e-12)


@settings(deadline=None)
@given(st.floats(0, 80), st.floats(-3, 3), st.floats(-1, 1), st.sampled_from([40.0, 500.0]))
def test_nearest_undoes_a_step_across_the_path(s, right, down, radius):
    path = circle(radius, 1)
    point = path.at(np.array(s)) + path.frames(np.array(s))[:, 1:] @ [right, down]
    assert path.nearest(point) == pytest.approx(s, abs=1e-6)


def test_beyond_its_ends_a_path_runs_on_straight():
    path = circle(60.0, 1)
    s = np.array([-12.0, 92.0])
    T = path.frames(s)[:, :, 0]
    ends = path.points[[0, -1]]
    np.testing.assert_allclose(path.at(s), ends + np.array([-12.0, 12.0])[:, None] * T, atol=1e-4)
    for far in s:
        assert path.nearest(path.at(np.array(far))) == pytest.approx(far, abs=1e-6)


def test_heading_modes_are_the_turn_that_a_displacement_causes():
    path = circle(90.0, -1, modes=4)
    s = np.array([5.0, 33.0, 61.0])
    yaw, pitch = path.heading_modes(s)
    F = path.frames(s)
    for j, mode in enumerate(path.modes):
        h = 1e-3
        ahead, behind = (Path("c", "curve", path.s, path.points + e * mode, path.modes).frames(s) for e in (h, -h))
        turn = (ahead[:, :, 0] - behind[:, :, 0]) / (2 * h)
        # as far as the displacement runs along the path itself it turns nothing
        along = np.einsum("mc,mc->m", mode, path.frames(path.s)[:, :, 0])
        slide = np.interp(s, path.s, along) / 90.0
        np.testing.assert_allclose(yaw[j], np.einsum("nc,nc->n", turn, F[:, :, 1]) + slide, atol=2e-4)
        np.testing.assert_allclose(pitch[j], np.einsum("nc,nc->n", turn, F[:, :, 2]), atol=2e-4)


# --- surveyed paths ------------------------------------------------------------------------------------------------


def test_a_surveyed_line_goes_through_its_points():
    k = np.array([0.05, 0.01, 1.0]) / np.linalg.norm([0.05, 0.01, 1.0])
    points = np.array([-2.0, 1.6, 20.0]) + np.array([0.0, 12.0, 30.0])[:, None] * k
    path = from_points("a", "line", points).shifted(1.0)
    assert path.shape == "line"
    np.testing.assert_allclose(path.frames(path.s)[:, :, 0], np.tile(k, (128, 1)), atol=1e-9)
    np.testing.assert_allclose(path.points[0], points[0] + level_frames(k)[:, 1], atol=1e-9)
    assert path.s[-1] == pytest.approx(30.0)
    slope = np.sqrt((path.heading_modes(np.array([15.0]))[0] ** 2).sum())
    spread = np.sqrt(((np.array([0.0, 12.0, 30.0]) - 14.0) ** 2).sum())
    assert slope == pytest.approx(0.02 / spread, rel=1e-3)  # 2 cm a point


@pytest.mark.parametrize("side", [1, -1])
def test_a_surveyed_curve_goes_through_its_points(side):
    exact = circle(80.0, side)
    path = from_points("a", "curve", exact.points[::12])
    assert path.shape == "curve"
    for p in exact.points[:121]:
        assert np.linalg.norm(path.at(np.array(path.nearest(p))) - p) < 5e-3


def test_beside_a_bend_the_distance_is_known_and_beyond_its_end_it_is_not():
    angle = np.linspace(0.0, 0.5 * np.pi, 60)
    bend = from_points("lane0", "curve", 40.0 * np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)]))
    paths = [bend, bend.reversed()]
    middle = np.array([np.sin(0.8), 0.0, np.cos(0.8)])
    for radius in (38.0, 40.0, 61.0):
        distance, known = distance_beside(paths, radius * middle)
        assert known and distance == pytest.approx(abs(radius - 40.0), abs=0.01)
    distance, known = distance_beside(paths, np.array([22.0, 0.0, -30.0]))  # 30 m on the path has left its bend
    assert not known and distance == pytest.approx(18.0, abs=0.1)
    line = from_points("lane0", "line", np.array([[0.0, 0.0, 10.0], [0.0, 0.0, 50.0]]))
    assert distance_beside([line], np.array([20.0, 0.0, 90.0])) == (pytest.approx(20.0), True)
