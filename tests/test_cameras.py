from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.cameras import Camera, StereoRig, cubic_sampling_places, line_displacement

K = np.array([[800.0, 0, 511.5], [0, 805, 383.5], [0, 0, 1]])
DISTORTION = np.array([-0.28, 0.09, 0.0008, -0.0006, -0.01])
VGA = Camera((640, 480), np.array([[500.0, 0.0, 320.0], [0.0, 505.0, 240.0], [0.0, 0.0, 1.0]]))
LENS = Camera(VGA.image_size, VGA.K, np.array([-0.25, 0.08, 0.001, -0.0005]))


def distorted(camera: Camera, ideal):
    """Where OpenCV sees what an undistorted camera would see at ``ideal``."""
    rays = camera.rays(ideal).reshape(-1, 1, 3)
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.distortion)[0].reshape(ideal.shape)


@settings(deadline=None)
@given(st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.5, 200)).map(np.array))
def test_projection_and_rays_are_inverse(X):
    camera = Camera((1024, 768), K)
    np.testing.assert_allclose(camera.rays(camera.project(X)) * X[2], X, rtol=1e-9, atol=1e-9)
    expected = cv2.projectPoints(X.reshape(1, 1, 3), np.zeros(3), np.zeros(3), K, None)[0].ravel()
    np.testing.assert_allclose(camera.project(X), expected, rtol=1e-9, atol=1e-7)


@settings(deadline=None)
@given(st.tuples(st.floats(0, 1023), st.floats(0, 767)).map(np.array))
def test_undistorted_points_distort_back(pixel):
    camera = Camera((1024, 768), K, DISTORTION)
    np.testing.assert_allclose(distorted(camera, camera.undistort_points(pixel)), pixel, atol=1e-6)


def test_an_undistorted_image_shows_each_spot_where_its_undistorted_point_lies():
    camera = Camera((1024, 768), K, DISTORTION)
    y, x = np.mgrid[:768, :1024].astype(np.float32)
    for spot in ([200.0, 150.0], [900.0, 600.0], [520.0, 380.0]):
        image = 255 * np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / 18).astype(np.float32)
        ideal = camera.undistort_image(image)
        centre = np.array([(x * ideal).sum(), (y * ideal).sum()]) / ideal.sum()
        np.testing.assert_allclose(centre, camera.undistort_points(np.array(spot)), atol=0.1)


@pytest.mark.parametrize("moved_px", [0.1, 0.25, 0.4, 0.6, 0.75, 0.9])
def test_a_picture_that_is_turned_back_shows_everything_in_its_place(moved_px):
    # OpenCV's bicubic kernel alone moves everything by up to 0.05 px
    x = np.arange(640.0)
    rotation = np.array([0.0, moved_px / VGA.K[0, 0], 0.0])
    recorded = np.tile(128 + 100 * np.sin(x / 3), (480, 1)).astype(np.float32)
    shown = VGA.undistort_image(recorded, rotation=rotation)[240, 310:330]
    ideal = np.column_stack([x[310:330], np.full(20, 240.0)])
    seen_at = VGA.turned(ideal, rotation)[:, 0]
    expected, slope = 128 + 100 * np.sin(seen_at / 3), 100 / 3 * np.cos(seen_at / 3)
    displacement = slope @ (shown - expected) / (slope @ slope)
    assert abs(displacement) < 0.02  # of which 1/64 px is OpenCV's own rounding


def test_without_distortion_nothing_is_touched():
    camera = Camera((64, 48), K, np.zeros(5))
    image = np.random.default_rng(0).random((48, 64)).astype(np.float32)
    assert camera.undistort_image(image) is image
    np.testing.assert_array_equal(camera.undistort_points(np.array([[1.5, 2.5]])), [[1.5, 2.5]])


def test_a_rig_projects_as_opencv_does_and_fulfils_its_epipolar_constraint():
    left = Camera((1024, 768), K)
    right = Camera((1024, 768), K + np.diag([20.0, 10.0, 0.0]))
    rotation, t = np.array([0.01, -0.03, 0.02]), np.array([-0.6, 0.05, 0.02])
    rig = StereoRig(left, right, cv2.Rodrigues(rotation)[0], t)
    X = np.random.default_rng(3).uniform([-5, -3, 8], [5, 3, 80], (20, 3))
    a, b = rig.project(X)
    expected = cv2.projectPoints(X.reshape(-1, 1, 3), rotation, t, right.K, None)[0].reshape(-1, 2)
    np.testing.assert_allclose(b, expected, atol=1e-8)
    ones = np.ones((20, 1))
    constraint = (np.hstack([b, ones]) @ rig.fundamental * np.hstack([a, ones])).sum(1)
    np.testing.assert_allclose(constraint, 0, atol=1e-10)
    assert rig.baseline == pytest.approx(np.linalg.norm(t))


def test_distorted_pixels_are_those_that_undistortion_takes_back():
    pixels = np.random.default_rng(1).uniform([20, 20], [620, 460], (50, 2))
    np.testing.assert_allclose(LENS.undistort_points(LENS.distort_points(pixels)), pixels, atol=1e-4)
    assert np.abs(LENS.distort_points(pixels) - pixels).max() > 2
    assert VGA.distort_points(pixels) is pixels


def test_the_lens_moves_lines_by_the_mean_of_their_points():
    lines = np.array([[[500.0, 100.0], [500.0, 180.0]], [[420.0, 100.0], [500.0, 100.0]]])
    across, along = line_displacement(LENS, lines, np.array([True, False]))
    shares = np.linspace(0, 1, 201)[:, None]
    for j, axis in enumerate((0, 1)):
        points = lines[j, 0] + shares * (lines[j, 1] - lines[j, 0])
        moved = (LENS.distort_points(points) - points).mean(0)
        assert across[j] == pytest.approx(moved[axis], abs=0.02)
        assert along[j] == pytest.approx(moved[1 - axis], abs=0.02)


def test_cubic_sampling_places_undo_the_error_of_the_kernel():
    places = np.r_[np.random.default_rng(1).uniform(-50, 1050, 10_000), -1e-9, 0.0, 1023.0].astype(np.float32)
    sampled = cubic_sampling_places(places)
    whole = np.floor(places)
    s = np.asarray(sampled - whole, float)
    np.testing.assert_allclose(whole + s + s * (1 - s) * (1 - 2 * s) / 2, places, atol=1e-3)
