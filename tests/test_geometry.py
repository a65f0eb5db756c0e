from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from paceline.cameras import Camera, StereoRig
from paceline.geometry import correct_matches, epipolar_distance, triangulate


def make_rig(rotation=(0.004, -0.02, 0.006), t=(-0.5, 0.02, -0.03)) -> StereoRig:
    left = Camera((1024, 768), np.array([[2200.0, 0, 511.5], [0, 2210, 383.5], [0, 0, 1]]))
    right = Camera((1024, 768), np.array([[2150.0, 0, 505.0], [0, 2145, 390.0], [0, 0, 1]]))
    R = cv2.Rodrigues(np.array(rotation))[0]
    return StereoRig(left, right, R, np.array(t))


POINT = st.tuples(st.floats(-8, 8), st.floats(-5, 5), st.floats(5, 120)).map(np.array)


@settings(deadline=None)
@given(POINT, st.tuples(*[st.floats(-0.3, 0.3)] * 3), st.tuples(st.floats(-2, -0.2), *[st.floats(-1, 1)] * 2))
def test_triangulation_undoes_projection(X, rotation, t):
    rig = make_rig(rotation, t)
    np.testing.assert_allclose(triangulate(rig, *rig.project(X)), X, rtol=1e-6, atol=1e-6)


def test_triangulation_works_for_any_leading_axes_and_a_vertical_rig():
    rig = make_rig(t=(0.0, -0.4, 0.0))
    X = np.random.default_rng(1).uniform([-3, -2, 10], [3, 2, 60], (4, 5, 3))
    np.testing.assert_allclose(triangulate(rig, *rig.project(X)), X, rtol=1e-7)


@settings(deadline=None, max_examples=15)
@given(POINT, st.tuples(*[st.floats(-2, 2)] * 4))
def test_triangulation_minimises_the_distance_to_both_pixels(X, noise):
    rig = make_rig()
    left, right = rig.project(X)
    left, right = left + noise[:2], right + noise[2:]

    def misses(X):
        a, b = rig.project(X)
        return np.sum((a - left) ** 2) + np.sum((b - right) ** 2)

    ours = correct_matches(rig, left, right)
    np.testing.assert_allclose(epipolar_distance(rig, *ours), 0, atol=1e-6)
    found = np.sum((ours[0] - left) ** 2) + np.sum((ours[1] - right) ** 2)
    Y = triangulate(rig, left, right)
    if 1 < Y[2] < 1e4:  # where noise has not pushed the rays apart
        assert misses(Y) == pytest.approx(found, abs=1e-6)
        best = minimize(lambda q: misses(q * Y), np.ones(3), method="Nelder-Mead", options={"xatol": 1e-9})
        assert found <= best.fun + 1e-6


def test_a_point_behind_the_cameras_has_a_negative_depth():
    rig = make_rig()
    assert triangulate(rig, *rig.project(np.array([0.3, 0.2, -20.0])))[2] == pytest.approx(-20)


def test_parallel_rays_meet_at_infinity():
    K = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
    rig = StereoRig(Camera((1000, 800), K), Camera((1000, 800), K), np.eye(3), np.array([-0.5, 0, 0]))
    assert not np.isfinite(triangulate(rig, np.array([300.0, 200]), np.array([300.0, 200]))[2])


def test_epipolar_distance_is_that_of_a_point_to_the_line_through_two_projections():
    rig = make_rig()
    left = np.array([400.0, 300.0])
    ray = rig.left.rays(left)
    a, b = (rig.right.project(rig.to_right(ray * z)) for z in (10.0, 90.0))
    right = np.array([350.0, 320.0])
    along = (b - a) / np.linalg.norm(b - a)
    expected = abs(along[0] * (right - a)[1] - along[1] * (right - a)[0])
    assert abs(epipolar_distance(rig, left, right)) == pytest.approx(expected)
