"""Metres from pixels (36), and their uncertainty."""

import numpy as np
import pytest

from paceline.cameras import Camera
from paceline.follow.ranging import YAW, place_of

K = np.array([[500.0, 0.0, 320.0], [0.0, 505.0, 240.0], [0.0, 0.0, 1.0]])
CAMERA = Camera((640, 480), K)


def test_a_target_seen_at_a_place_is_measured_there():
    point = np.array([1.3, -0.4, 12.5])
    location = np.array([*CAMERA.project(point), 10.0 / 12.5])
    place = place_of(location, np.zeros((3, 3)), CAMERA, 10.0, 0.0, 2.0)
    np.testing.assert_allclose(place.position, point, atol=1e-9)
    assert place.bearing == pytest.approx(np.arctan2(1.3, 12.5))


def test_the_uncertainty_is_that_of_drawn_locations():
    rng = np.random.default_rng(0)
    location = np.array([400.0, 200.0, 0.7])
    L = np.array([[0.4, 0, 0], [0.1, 0.3, 0], [0.002, -0.001, 0.005]])
    place = place_of(location, L @ L.T, CAMERA, 10.0, 0.0, 2.0)
    drawn = location + rng.normal(size=(20000, 3)) @ L.T
    positions = np.array([place_of(x, np.zeros((3, 3)), CAMERA, 10.0, 0.0, 2.0).position for x in drawn])
    yaw = YAW * (0.5 * 2.0) ** 2 / place.position[2]
    np.testing.assert_allclose(place.std, np.hypot(positions.std(0), [yaw, 0, 0]), rtol=0.03)


def test_a_model_is_no_truer_than_its_tolerance():
    place = place_of(np.array([320.0, 240.0, 0.5]), np.zeros((3, 3)), CAMERA, 10.0, 0.01, 2.0)
    np.testing.assert_allclose(place.std, [np.hypot(0.01, YAW / 20), 0.01, 0.1])
