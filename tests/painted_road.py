"""A road painted pixel by pixel before a pair of cameras, apart from every simulator: for what detects lanes."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.cameras import Camera, StereoRig

Array = NDArray[np.float64]

SIZE = (800, 600)
FOCAL, BASELINE, HEIGHT, TILT = 1100.0, 0.6, 3.5, 0.05
EDGES = (-5.2, -1.7, 1.9)  # m to the right of the cameras, of the road's painted lines: 3.5 and 3.6 m wide
WIDTHS = (3.5, 3.6)
HEADING = -0.12  # rad


def make_rig() -> StereoRig:
    K = np.array([[FOCAL, 0, 399.5], [0, FOCAL, 299.5], [0, 0, 1]])
    turn = np.asarray(cv2.Rodrigues(np.array([0.002, -0.003, 0.001]))[0])
    return StereoRig(Camera(SIZE, K), Camera(SIZE, K), turn, np.array([-BASELINE, 0.01, 0.0]))


DOWN = np.array([0.0, np.cos(TILT), np.sin(TILT)])
AHEAD = np.array([0.0, -np.sin(TILT), np.cos(TILT)])


def on_road(rig: StereoRig, side: int) -> tuple[Array, Array]:
    """Road coordinates (H, W), right and along, of what a view's pixels show of the plane; NaN above the horizon."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(rig.cameras[side].K).T
    centre = np.zeros(3) if side == 0 else -rig.R.T @ rig.t
    rays = rays if side == 0 else rays @ rig.R
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (HEIGHT - centre @ DOWN) / (rays @ DOWN)
    points = centre + np.where(depth > 0, depth, np.nan)[..., None] * rays
    a, b = points[..., 0], points @ AHEAD
    return a * np.cos(HEADING) - b * np.sin(HEADING), a * np.sin(HEADING) + b * np.cos(HEADING)


def painted(rig: StereoRig, side: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """A view of the road: gravelly asphalt, two solid edge lines, a dashed and worn middle line, a shadow across."""
    right, along = on_road(rig, side)
    stones = np.random.default_rng(7)
    light = np.full(right.shape, 70.0)
    for cell in (0.06, 0.25, 1.0):
        noise = stones.normal(0, 1, (512, 512)).astype(np.float32)
        u, v = (np.nan_to_num(c / cell % 511).astype(np.float32) for c in (right, along))
        light += 7 * cv2.remap(noise, u, v, cv2.INTER_LINEAR)
    worn = stones.random((4000, 40)) < 0.35
    row, column = (np.nan_to_num(c).astype(int) for c in (along / 0.05 % 4000, right / 0.03 % 40))
    for edge in EDGES:
        paint = (np.abs(right - edge) < 0.07) & ((edge != EDGES[1]) | (along % 9.0 < 3.0))
        light = np.where(paint & ~worn[row, column], 150.0, light)
    light = np.where((along > 22) & (along < 27), 0.4 * light, light)  # a shadow
    light = np.where(np.isnan(right) | (along > 150), 190.0, light)
    return np.asarray(cv2.GaussianBlur(light + rng.normal(0, 1.0, light.shape), (0, 0), 0.6), np.float32)
