"""Inverse perspective mapping: both views of the road resampled on the ground, as seen from above."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from paceline.arrays import Array, Image, Mask
from paceline.cameras import StereoRig
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_surface import RoadSurface
from paceline.recordings.background import Background

LOG_OFFSET_GREY = 2.0  # added before the logarithm: below it images contain little but noise


@dataclass(frozen=True, eq=False)
class GroundImage:
    """A view resampled on the ground: the logarithm of its grey levels (H, W), in which paint has the same contrast in
    sun and shade, and where the ground is ``visible`` (H, W)."""

    log_intensity: Image
    visible: Mask


def map_to_ground(
    rig: StereoRig, background: Background, side: int, surface: RoadSurface, ground: Array
) -> GroundImage:
    """The left (0) or right (1) view at the points ``ground`` (H, W, 2) of a ``surface``."""
    points = surface.points(ground)
    if side == 1:
        points = rig.to_right(points)
    camera = rig.cameras[side]
    ahead = points[..., 2] > 1.0
    pixels = camera.project(np.where(ahead[..., None], points, [0.0, 0.0, 1.0]))
    width, height = camera.image_size
    x, y = np.moveaxis(pixels, -1, 0)
    visible = ahead & (x >= 1) & (y >= 1) & (x <= width - 2) & (y <= height - 2)
    pixel_maps = [np.where(visible, c, -10).astype(np.float32) for c in (x, y)]
    log = np.log(np.maximum(background.images[side], 0) + np.float32(LOG_OFFSET_GREY)).astype(np.float32)
    log_intensity = cv2.remap(log, pixel_maps[0], pixel_maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    stable = cv2.remap(
        background.stable[side].astype(np.uint8), pixel_maps[0], pixel_maps[1], cv2.INTER_NEAREST, borderValue=0
    )
    return GroundImage(np.asarray(log_intensity, np.float32), visible & (np.asarray(stable) > 0))


def pixel_size(rig: StereoRig, surface: RoadSurface, alignment: Alignment, s: Array, d: float) -> Array:
    """Metres (N, 2) along and across the road that one pixel of the left view covers at road coordinates (s, d), which
    grows with the obliquity of the view."""
    step = 0.05
    base = rig.left.project(surface.points(alignment.to_ground(s, d)))
    along = rig.left.project(surface.points(alignment.to_ground(s + step, d))) - base
    across = rig.left.project(surface.points(alignment.to_ground(s, d + step))) - base
    area = np.abs(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]) / step**2
    lengths = np.stack([np.linalg.norm(v, axis=1) / step for v in (along, across)], axis=1)
    # a line along the road is displaced across itself: one pixel of that is |along| / area metres, and vice versa
    return np.asarray(lengths[:, ::-1] / np.maximum(area, 1e-9)[:, None])
