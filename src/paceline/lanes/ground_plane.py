"""The initial road surface from dense stereo: a plane by RANSAC, then its curvature by robust least squares."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.lanes.road_surface import RoadSurface, plane_surface
from paceline.recordings.background import Background

MATCHING_WIDTH_PX = 640  # width to which images are reduced
SGBM_BLOCK_PX = 7
MIN_PLANE_DEPTH_M, MAX_PLANE_DEPTH_M = 4.0, 90.0  # of the points that are used
MIN_NORMAL_COSINE = np.cos(np.radians(40.0))  # between the ground's normal and the image's downward axis
MIN_CAMERA_HEIGHT_M, MAX_CAMERA_HEIGHT_M = 0.7, 25.0  # height of the cameras above the road
RANSAC_TRIALS = 400  # triples of points; an inlier share of one in fifty suffices
DISPARITY_STD_PX = 0.5
HEIGHT_PRIOR_STD_M = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.75])  # at 30 m: sloping verges must not bend the road
PLANE_IRLS_ITERATIONS = 12
MAX_POINTS = 6000
MIN_INLIER_SHARE = 0.04  # least share of the matched points that are inliers
MATCHING_GAMMA = 0.5  # exponent by which dark scenes are brightened before they are matched


def initial_surface(rig: StereoRig, background: Background) -> RoadSurface | None:
    """The ground plane near the road, accurate to some decimetres of height; None where no plane is found."""
    points, deviation = _scene_points(rig, background)
    if len(points) < 200:
        return None
    rng = np.random.default_rng(0)
    keep = rng.choice(len(points), min(MAX_POINTS, len(points)), replace=False)
    points, deviation = points[keep], deviation[keep]
    best: tuple[int, Array, float] | None = None
    for triple in points[rng.integers(0, len(points), (RANSAC_TRIALS, 3))]:
        normal = np.cross(triple[1] - triple[0], triple[2] - triple[0])
        length = np.linalg.norm(normal)
        if length < 1e-6:
            continue
        normal *= np.sign(normal[1] or 1.0) / length
        distance = float(normal @ triple[0])
        if normal[1] < MIN_NORMAL_COSINE or not MIN_CAMERA_HEIGHT_M < distance < MAX_CAMERA_HEIGHT_M:
            continue
        count = int((np.abs(points @ normal - distance) < 2 * deviation * distance).sum())
        if best is None or count > best[0]:
            best = (count, normal, distance)
    if best is None or best[0] < MIN_INLIER_SHARE * len(points):
        return None
    surface = plane_surface(best[1], best[2], float(np.median(points[:, 2])))
    return _fit_bend(surface, points, deviation * best[2])


def _fit_bend(surface: RoadSurface, points: Array, deviation: Array) -> RoadSurface:
    """``surface`` through the ``points`` (N, 3) near it, whose heights deviate by ``deviation`` (N,) m; those above,
    such as trees, get little weight (Tukey's)."""
    local = (points - surface.origin) @ surface.axes
    basis = surface.basis(local[:, [0, 2]]) / deviation[:, None]
    observed = local[:, 1] / deviation
    c = surface.heights
    for k in range(PLANE_IRLS_ITERATIONS):
        reach = 4.0 + 6.0 * 0.7**k  # larger at first, for a bent surface
        weight = np.maximum(1 - ((observed - basis @ c) / reach) ** 2, 0.0) ** 2
        information = (basis * weight[:, None]).T @ basis + np.diag(HEIGHT_PRIOR_STD_M**-2)
        c = np.linalg.solve(information, (basis * weight[:, None]).T @ observed)
    return surface.with_heights(c)


def _scene_points(rig: StereoRig, background: Background) -> tuple[Array, Array]:
    """World points (N, 3) of the scene, and (N,) the deviation of the ground's height there per metre of the camera's
    height."""
    pair = stereo_rectification(rig, MATCHING_WIDTH_PX)
    disparity = pair.disparities(background.images)
    row, column = np.nonzero((disparity > pair.fb / MAX_PLANE_DEPTH_M) & (disparity < pair.fb / MIN_PLANE_DEPTH_M))
    d = disparity[row, column]
    rays = np.column_stack([column + pair.low[0], row + pair.low[1], np.full(len(row), pair.focal)]) @ pair.rotation
    return rays * (rig.baseline / d)[:, None], DISPARITY_STD_PX / d


@dataclass(frozen=True, eq=False)
class StereoRectification:
    """Both views turned until their rows run along the baseline: ``rotation`` (3, 3) from the world's axes, ``focal``
    px; pictures of ``size`` (width, height) begin at pixel ``low`` (2,) from the principal point."""

    rig: StereoRig
    rotation: Array
    focal: float
    low: Array
    size: tuple[int, int]

    @property
    def fb(self) -> float:
        """Disparity times depth, px m."""
        return self.focal * self.rig.baseline

    def rectified(self, image: Image, side: int) -> NDArray[np.uint8]:
        turn = self.rotation if side == 0 else self.rotation @ self.rig.R.T
        K = np.array([[self.focal, 0, -self.low[0]], [0, self.focal, -self.low[1]], [0, 0, 1.0]])
        matrix = K @ turn @ self.rig.cameras[side].K_inv
        light = np.clip(
            255 * (np.maximum(image, 0) / max(float(np.percentile(image, 98)), 1.0)) ** MATCHING_GAMMA, 0, 255
        )
        return np.asarray(cv2.warpPerspective(light.astype(np.uint8), matrix, self.size, flags=cv2.INTER_AREA))

    def disparities(self, images: tuple[Image, Image]) -> Array:
        """Disparities (H, W) px, negative where the views do not match."""
        count = 16 * int(np.ceil(self.fb / MIN_PLANE_DEPTH_M / 16))
        matcher = cv2.StereoSGBM.create(
            numDisparities=count,
            blockSize=SGBM_BLOCK_PX,
            P1=8 * SGBM_BLOCK_PX**2,
            P2=32 * SGBM_BLOCK_PX**2,
            disp12MaxDiff=1,
            uniquenessRatio=5,
            speckleWindowSize=60,
            speckleRange=2,
        )
        padded = [
            cv2.copyMakeBorder(self.rectified(image, side), 0, 0, count, 0, cv2.BORDER_REPLICATE)
            for side, image in enumerate(images)
        ]
        return np.asarray(matcher.compute(*padded), float)[:, count:] / 16.0


def stereo_rectification(rig: StereoRig, width: int) -> StereoRectification:
    """Of any rig, its pictures reduced to about ``width`` px."""
    x = rig.centres[1] / rig.baseline
    y = np.cross(np.array([0.0, 0.0, 1.0]) + rig.R[2], x)
    y /= np.linalg.norm(y)
    rotation = np.stack([x, y, np.cross(x, y)])
    w, h = rig.left.image_size
    focal = float(rig.left.K[0, 0]) * min(1.0, width / w)
    border = rig.left.rays(np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1.0]])) @ rotation.T
    pixels = focal * border[:, :2] / np.maximum(border[:, 2:], 0.2)
    low = np.floor(pixels.min(0))
    size = np.minimum(np.ceil(pixels.max(0)) - low + 1, 2.0 * max(w, h)).astype(int)
    return StereoRectification(rig, rotation, focal, low, (int(size[0]), int(size[1])))
