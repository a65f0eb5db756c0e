"""Found vehicles drawn for approval: each one's outline in both views, side by side."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.detection.finder import Found
from paceline.reports.common.drawing import WHITE, Color, Picture, draw_label, draw_outline, scaled

OUTLINE: Color = (110, 220, 90)
HEIGHT = 420  # px
BRIGHTNESS = 0.6  # exponent by which dark recordings are shown brighter


def vehicle_picture(found: Found, height: int = HEIGHT) -> Picture:
    """Both views about a vehicle in the frame in which it is outlined, ``height`` px high. It has to have an
    outline."""
    assert found.vehicle is not None, "there is an outline to draw"
    views = []
    for side, (crop, corner, quad) in enumerate(
        zip(found.crops, found.corners, (found.vehicle.left, found.vehicle.right), strict=True)
    ):
        scale = height / crop.shape[0]
        picture = _light(crop, scale, height)
        draw_outline(picture, scaled(quad - corner, scale), OUTLINE, 1)
        what = (f"{found.vehicle.id}, frame {found.vehicle.frame}, left", "right")[side]
        draw_label(picture, what, (0, 0), WHITE)
        views.append(picture)
    return np.hstack(views)


def _light(crop: NDArray[np.float32], scale: float, height: int) -> Picture:
    light = np.clip(np.maximum(crop, 0) / max(float(np.percentile(crop, 99)), 1.0), 0, 1) ** BRIGHTNESS
    size = max(1, round(crop.shape[1] * scale)), height
    grey = cv2.resize((255 * light).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
