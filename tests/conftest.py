from __future__ import annotations

import cv2
import numpy as np
import pytest

from paceline.cameras import Camera, StereoRig


@pytest.fixture(scope="session")
def rig() -> StereoRig:
    """Half a metre of baseline and 2200 px of focal length, out of true in every respect."""
    left = Camera((1024, 768), np.array([[2200.0, 0, 511.5], [0, 2210, 383.5], [0, 0, 1]]))
    right = Camera((1024, 768), np.array([[2150.0, 0, 505.0], [0, 2145, 390.0], [0, 0, 1]]))
    return StereoRig(left, right, cv2.Rodrigues(np.array([0.004, -0.02, 0.006]))[0], np.array([-0.5, 0.02, -0.03]))
