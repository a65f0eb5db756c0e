"""The first plane against exact corners, and its uncertainty against repeated clicks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.documents.loading import VehicleDocument
from paceline.speed.geometry.initial_plane import (
    TILT_STD_RAD,
    YAW_STD_RAD,
    likeliest_face,
    normal_from_corners,
    plane_from_outlines,
)
from paceline.speed.geometry.paths import Path
from paceline.speed.refinement.trajectory import rotate_normal


def rectangle(centre, yaw, tilt, width=1.8, height=0.7):
    """Corners (4, 3) of a rectangle whose normal is turned by ``yaw`` right and ``tilt`` down; that normal."""
    normal = np.array([np.tan(yaw), np.tan(tilt), 1.0])
    normal /= np.linalg.norm(normal)
    across = np.cross([0.0, 1.0, 0.0], normal)
    across /= np.linalg.norm(across)
    down = np.cross(normal, across)
    x, y = width / 2, height / 2
    return np.asarray(centre) + np.array([[-x, -y], [x, -y], [x, y], [-x, y]]) @ [across, down], normal


def document(left, right, plane="free", path=None):
    return VehicleDocument("v0", path, 0, left, right, plane, None)


def angles(normal):
    return np.array([np.arctan2(normal[0], normal[2]), np.arctan2(normal[1], normal[2])])


@settings(deadline=None)
@given(st.floats(-0.6, 0.6), st.floats(-0.2, 0.2), st.floats(-4, 4), st.floats(-1, 2), st.floats(8, 60))
def test_exact_corners_give_the_exact_plane(rig, yaw, tilt, x, y, z):
    corners, normal = rectangle([x, y, z], yaw, tilt)
    found, std = normal_from_corners(rig, *rig.project(corners), click_sigma=1e-5)
    np.testing.assert_allclose(found, normal, atol=1e-4)
    assert (std > 0).all() and (std < 1e-2).all()
    plane = plane_from_outlines(rig, document(*rig.project(corners)), None, 1e-5)
    assert plane.normal @ plane.centre > 0
    assert plane.distance == pytest.approx(plane.normal @ plane.centre)
    # the mean of the corners' pixels is the centre's but for perspective
    assert np.linalg.norm(plane.centre - [x, y, z]) < 0.02 * z


def test_a_distant_plane_takes_the_prior_and_a_near_one_its_corners(rig):
    rng = np.random.default_rng(4)
    yaw, tilt = 0.35, 0.02
    for distance, trusts_corners in ((6.0, True), (150.0, False)):
        corners, normal = rectangle([0.0, 0.5, distance], yaw, tilt, width=3.0, height=1.5)
        left, right = rig.project(corners)
        found, stds = [], []
        for _ in range(200):
            clicked = [p + rng.normal(0, 0.5, p.shape) for p in (left, right)]
            n, std = normal_from_corners(rig, *clicked, 0.5)
            found.append(angles(n))
            stds.append(std)
        mean, std = np.mean(found, axis=0), np.mean(stds, axis=0)
        if trusts_corners:
            np.testing.assert_allclose(mean, angles(normal), atol=0.02)
            assert (std < [0.1 * YAW_STD_RAD, 0.8 * TILT_STD_RAD]).all()
        else:
            assert abs(mean[0]) < 0.15 * yaw and abs(mean[1]) < 0.02  # facing the cameras, upright
            np.testing.assert_allclose(std, np.tan([YAW_STD_RAD, TILT_STD_RAD]), rtol=0.15)


@pytest.mark.parametrize("distance", [10.0, 25.0, 60.0])
def test_the_normals_uncertainty_is_that_of_planes_drawn_from_the_prior(rig, distance):
    rng = np.random.default_rng(6)
    z = []
    for _ in range(400):
        slopes = rng.normal(0, np.tan([YAW_STD_RAD, TILT_STD_RAD]))
        yaw, tilt = np.arctan(slopes)
        if abs(yaw) > 0.8:
            continue
        corners, normal = rectangle([rng.normal(), 0.5, distance], yaw, tilt)
        left, right = (p + rng.normal(0, 0.5, p.shape) for p in rig.project(corners))
        found, std = normal_from_corners(rig, left, right, 0.5)
        z.append((found[:2] / found[2] - normal[:2] / normal[2]) / std)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(z), axis=0)), 1, atol=0.15)


def straight_path(direction, through):
    k = np.array(direction) / np.linalg.norm(direction)
    s = np.linspace(0, 60, 128)
    return Path("lane0", "line", s, np.array(through) + (s - 30)[:, None] * k, np.zeros((0, 128, 3))), k


@pytest.mark.parametrize("direction", [[0.1, 0.01, 1.0], [0.1, 0.01, -1.0], [1.0, 0.0, 0.05]])
def test_fronts_are_perpendicular_to_their_path_and_sides_parallel(rig, direction):
    path, k = straight_path(direction, [-1.0, 1.4, 35.0])
    corners, _ = rectangle([0.3, 0.8, 36.0], 0.0, 0.0)
    right = np.cross([0.0, 1.0, 0.0], k)
    for plane, expected in (("front", k), ("side", right / np.linalg.norm(right))):
        found = plane_from_outlines(rig, document(*rig.project(corners), plane, "lane0"), path, 0.5)
        expected = expected * np.sign(expected @ found.centre)
        np.testing.assert_allclose(found.normal, expected, atol=1e-9)
        assert found.distance > 0
        assert found.distance == pytest.approx(expected @ found.centre)
        assert (np.abs(found.centre - [0.3, 0.8, 36.0]) < [0.02, 0.02, 0.05]).all()
        assert (found.normal_std <= np.radians(10)).all()


@pytest.mark.parametrize("direction", [[0.0, 0.0, 1.0], [0.05, 0.0, -1.0]])
def test_fronts_and_rears_lean_back(rig, direction):
    """Their upper rim is most likely farther from the cameras than the lower one, whichever way they drive."""
    path, _ = straight_path(direction, [-1.0, 1.4, 35.0])
    corners, _ = rectangle([0.3, 0.8, 36.0], 0.0, 0.0)
    found = plane_from_outlines(rig, document(*rig.project(corners), "front", "lane0"), path, 0.5)
    F = path.frames(path.s[:1])[0]
    normal = F @ rotate_normal(F.T @ found.normal, 0.0, found.mean_tilt)
    over, under = np.array([0.0, -0.4, 0.0]), np.array([0.0, 0.4, 0.0])
    # behind the centre by so much along the line of sight, on the plane n·P = d
    back = [-(normal @ rim) / normal[2] for rim in (over, under)]
    assert back[0] - back[1] == pytest.approx(0.8 * np.tan(np.radians(8.0)), rel=0.05)


def test_a_free_plane_does_not_depend_on_its_path(rig):
    path, _ = straight_path([0.0, 0.0, 1.0], [-1.0, 1.4, 35.0])
    corners, normal = rectangle([0.3, 0.8, 12.0], 0.5, 0.05)
    found = plane_from_outlines(rig, document(*rig.project(corners), "free", "lane0"), path, 1e-5)
    np.testing.assert_allclose(found.normal, normal, atol=1e-4)


@pytest.mark.parametrize("distance", [20.0, 60.0])
def test_the_depths_uncertainty_is_that_of_repeated_clicks(rig, distance):
    rng = np.random.default_rng(8)
    path, _ = straight_path([0.0, 0.0, 1.0], [-1.0, 1.4, distance])
    corners, _ = rectangle([0.3, 0.8, distance], 0.0, 0.0)
    left, right = rig.project(corners)
    inverse, stated = [], []
    for _ in range(400):
        clicked = (p + rng.normal(0, 0.5, p.shape) for p in (left, right))
        found = plane_from_outlines(rig, document(*clicked, "front", "lane0"), path, 0.5)
        inverse.append(distance / found.centre[2])
        stated.append(found.inverse_depth_std)
    assert np.std(inverse) == pytest.approx(np.mean(stated), rel=0.12)
    # the mean of the corners is not quite the centre
    assert np.mean(inverse) == pytest.approx(1, abs=4 * np.std(inverse) / 20 + 1e-3)


@pytest.mark.parametrize(("width", "face"), [(1.8, "front"), (4.0, "side"), (9.0, "side")])
def test_the_likelier_face_has_a_usual_width(rig, width, face):
    """At 45° the corners of a distant plane tell a front from a side less than its width does."""
    travel = np.array([1.0, 0.0, 1.0])
    yaw = np.pi / 4 if face == "front" else -np.pi / 4
    left, right = (q for q in rig.project(rectangle([0.5, 0.8, 45.0], yaw, 0.0, width=width)[0]))
    plane = plane_from_outlines(rig, document(left, right), None, 0.5)
    assert likeliest_face(rig, document(left, right), plane, travel) == face
    assert likeliest_face(rig, document(left, right, plane="side"), plane, travel) == "side"
