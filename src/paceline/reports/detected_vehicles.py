"""Draws detected vehicles: the outline of each in both views, side by side."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.detection.finder import DetectedVehicle
from paceline.reports.common.drawing import (
    DISPLAY_GAMMA,
    WHITE_BGR,
    Color,
    Picture,
    draw_label,
    draw_outline,
    scale_points,
)

OUTLINE_COLOR: Color = (110, 220, 90)
VIEW_PICTURE_HEIGHT_PX = 420


def draw_detected_vehicle(detected: DetectedVehicle, height: int = VIEW_PICTURE_HEIGHT_PX) -> Picture:
    """Both views about a vehicle in the frame in which it is outlined, ``height`` px high. It has to have an
    outline."""
    assert detected.vehicle is not None, "there is an outline to draw"
    views = []
    for side, (crop, corner, quad) in enumerate(
        zip(detected.crops, detected.crop_origins, (detected.vehicle.left, detected.vehicle.right), strict=True)
    ):
        scale = height / crop.shape[0]
        picture = _brightened(crop, scale, height)
        draw_outline(picture, scale_points(quad - corner, scale), OUTLINE_COLOR, 1)
        label = (f"{detected.vehicle.id}, frame {detected.vehicle.frame}, left", "right")[side]
        draw_label(picture, label, (0, 0), WHITE_BGR)
        views.append(picture)
    return np.hstack(views)


def _brightened(crop: NDArray[np.float32], scale: float, height: int) -> Picture:
    light = np.clip(np.maximum(crop, 0) / max(float(np.percentile(crop, 99)), 1.0), 0, 1) ** DISPLAY_GAMMA
    size = max(1, round(crop.shape[1] * scale)), height
    grey = cv2.resize((255 * light).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
