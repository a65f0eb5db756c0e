"""Depth around a vehicle by semi-global block matching, on images rectified for any rig.

Both views are rotated until their rows are parallel to the baseline; only the crop in which the vehicle is expected is
computed, whatever the directions of the cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from paceline.arrays import Array, Image, to_8_bit
from paceline.cameras import StereoRig

BLOCK_PX = 5
SMOOTHNESS_PENALTIES = (8 * BLOCK_PX**2, 32 * BLOCK_PX**2)  # disparity changes of 1 px, and of more
DISPARITY_RANGE = (0.6, 1.6)  # search range relative to the expected disparity
DISPARITY_MARGIN_PX = 6  # margin added to that range
MIN_MATCHED_DEPTH_M = 1.0


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A rectified crop of the left view: ``grey`` (H, W), its first pixel ``low`` (2,), and depths ``Z`` (H, W) along
    the rectified axis in metres, NaN where the views do not match."""

    low: Array
    grey: Image
    Z: Array


@dataclass(frozen=True, eq=False)
class Rectification:
    """The ideal cameras with one viewing direction and rows along the baseline ``b``, focal length ``f`` px."""

    rig: StereoRig

    @cached_property
    def rotation(self) -> Array:
        """(3, 3) from the left camera's axes to the rectified ones: x along the baseline, z near the view axis."""
        x = -self.rig.R.T @ self.rig.t / self.rig.baseline
        ahead = np.array([0.0, 0.0, 1.0]) + self.rig.R[2]
        y = np.cross(ahead, x)
        y /= np.linalg.norm(y)
        return np.stack([x, y, np.cross(x, y)])

    @property
    def f(self) -> float:
        return float(self.rig.left.K[0, 0])

    @property
    def fb(self) -> float:
        """Disparity times depth, px m."""
        return self.f * self.rig.baseline

    def project(self, points: Array) -> Array:
        """Pixels (…, 2) of world ``points`` (…, 3) in the rectified left view, whose principal point is (0, 0)."""
        p = points @ self.rotation.T
        return np.asarray(self.f * p[..., :2] / p[..., 2:])

    def rays(self, pixels: Array) -> Array:
        """World directions (…, 3), of rectified depth 1, through ``pixels`` (…, 2) of the rectified left view."""
        homogeneous = np.ones((*pixels.shape[:-1], 1))
        return np.concatenate([pixels / self.f, homogeneous], axis=-1) @ self.rotation

    def crop(self, image: Image, view: int, low: Array, size: tuple[int, int]) -> Image:
        """``size`` (width, height) pixels of the rectified ``view`` (0 left, 1 right) from ``low`` (2,) on."""
        turn = self.rotation if view == 0 else self.rotation @ self.rig.R.T
        K = np.array([[self.f, 0.0, -low[0]], [0.0, self.f, -low[1]], [0.0, 0.0, 1.0]])
        matrix = K @ turn @ self.rig.cameras[view].K_inv
        return np.asarray(cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_LINEAR), np.float32)

    def depths(self, images: tuple[Image, Image], region: Array, depth: float) -> DepthMap:
        """Depths inside the rectified box about ``region`` (n, 2) px, where about ``depth`` metres are expected."""
        expected = self.fb / max(depth, MIN_MATCHED_DEPTH_M)
        min_disparity = int(np.floor(DISPARITY_RANGE[0] * expected)) - DISPARITY_MARGIN_PX
        count = 16 * int(np.ceil((DISPARITY_RANGE[1] * expected + DISPARITY_MARGIN_PX - min_disparity) / 16))
        low, high = np.floor(region.min(0)), np.ceil(region.max(0)) + 1
        size = int(high[0] - low[0]) + count, int(high[1] - low[1])
        start = low - [count, 0]
        left = self.crop(images[0], 0, start, size)
        right = self.crop(images[1], 1, start - [min_disparity, 0], size)
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=count,
            blockSize=BLOCK_PX,
            P1=SMOOTHNESS_PENALTIES[0],
            P2=SMOOTHNESS_PENALTIES[1],
            disp12MaxDiff=1,
            uniquenessRatio=5,
            speckleWindowSize=40,
            speckleRange=2,
        )
        a, b = (to_8_bit(i) for i in (left, right))
        disparity = np.asarray(matcher.compute(a, b), float)[:, count:] / 16.0
        Z = np.where(disparity >= 0, self.fb / np.maximum(disparity + min_disparity, 1e-6), np.nan)
        return DepthMap(low, left[:, count:], Z)
