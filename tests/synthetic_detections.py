"""Detections of a synthetic face that moves along a road."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from tiny_road import scene

from paceline.detection.detector import Detection
from paceline.detection.lane_paths import LanePath, PlaneGrid
from paceline.detection.planar_face import AlignedDetection, PlanarFace
from paceline.simulation.stereo.clip import Vehicle, World
from paceline.speed.geometry.paths import from_points

Image = NDArray[np.float32]

PLANE_GRID = PlaneGrid(left=-1.2, top=1.6, bottom=0.0, cell=0.02)
X, BOTTOM, TOP = (-0.7, 0.7), 0.3, 1.2  # m, of the outline
SPEED, FRAMES = 2.0, 9  # m a frame


def face_with(texture: Image, seed: int, covered: tuple[Image, int] | None = None) -> PlanarFace:
    """A face that comes 2 m a frame, all of it as outlined, and on its plane nothing but the ``texture`` (H, W):
    another one, where it is ``covered``, in the first so many frames."""
    world, rng = World(scene(Vehicle("v0", 16.0, start_distance=60.0), frames=FRAMES)), np.random.default_rng(seed)
    lane = LanePath("lane0", world.rig, from_points("lane0", "line", world.road.point(np.array([80.0, 12.0]), 1.85)))
    aligned = []
    for k in range(FRAMES):
        s = 35.0 + SPEED * k
        pair = painted_on(lane, s, covered[0] if covered is not None and k < covered[1] else texture, rng)
        detection = Detection(k, 0.1 * k, lane, s, X, (BOTTOM, TOP), 1.5, 9.0, pair, flat(pair), np.zeros((2, 2)))
        aligned.append(AlignedDetection(detection, s, np.zeros(2), 1.0))
    return PlanarFace(X, (BOTTOM, TOP), aligned, 0.9)


def painted_on(lane: LanePath, s: float, texture: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Both views of nothing but a ``texture`` on the plane at ``s``."""
    views = []
    for H, camera in zip(lane.homographies(s), lane.rig.cameras, strict=True):
        view = cv2.warpPerspective(texture, H @ PLANE_GRID.to_metres, camera.image_size, borderValue=100.0)
        views.append(np.float32(cv2.GaussianBlur(view, (0, 0), 0.8) + rng.normal(0.0, 1.0, view.shape)))
    return views[0], views[1]


def flat(views: tuple[Image, Image]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both views of nothing at all, as large as these."""
    left, right = (np.full(view.shape, 100, np.uint8) for view in views)
    return left, right


def texture_up_to(height: float, seed: int) -> Image:
    """Blotches of a few centimetres from the road up to a ``height``, and flat grey above."""
    columns, rows = PLANE_GRID.size
    blotches = cv2.GaussianBlur(np.random.default_rng(seed).normal(0.0, 1.0, (rows, columns)), (0, 0), 2.0)
    plane = 100.0 + 30.0 * blotches / blotches.std()
    plane[PLANE_GRID.y > height] = 100.0
    return np.float32(plane)
