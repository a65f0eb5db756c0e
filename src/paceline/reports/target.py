"""Writes a learned target: target.yaml, and an image with its lines."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from paceline.arrays import Image
from paceline.errors import UnusableInput
from paceline.reports.common.drawing import (
    DARK_BGR,
    WHITE_BGR,
    Color,
    Picture,
    draw_dots,
    draw_line,
    draw_text,
    scale_points,
    text_width,
)
from paceline.reports.common.output_folder import write_all_or_none
from paceline.targets.learning import LearnedTarget, corner_names

PICTURE_SIZE_PX = 900  # of the larger side
IMAGE_MARGIN_SHARE = 0.15  # of the target's size, shown around it
TARGET_HEADER_HEIGHT_PX = 40
HORIZONTAL_COLOR: Color = (250, 200, 90)
VERTICAL_COLOR: Color = (80, 190, 250)


def write_target(learned: LearnedTarget, image: Image, file: Path) -> Path:
    """Writes target.yaml to ``file`` and the image beside it, both or neither; returns the image's path.

    ``image`` (H, W), 0–255, is the one learned from. Raises UnusableInput where they cannot be written.
    """
    if file.suffix not in (".yaml", ".yml"):
        raise UnusableInput(f"{file}: expected the name of a YAML file to write, for instance target.yaml")
    image_file = file.with_suffix(".png")
    encoded, png = cv2.imencode(".png", draw_target(learned, image))
    assert encoded
    write_all_or_none({file: target_yaml(learned).encode(), image_file: bytes(png)})
    return image_file


def target_yaml(learned: LearnedTarget) -> str:
    """The model as target.yaml."""
    target = learned.target
    names = corner_names(len(target.corners))
    corners = [f"  {name}: [{x:.4f}, {y:.4f}]" for name, (x, y) in zip(names, target.corners, strict=True)]
    segments = [f"  - [{names[a]}, {names[b]}]" for a, b in target.segments]
    quoted_name = target.name.replace("'", "''")
    head = [
        f"name: '{quoted_name}'",
        f"nominal_range: {target.nominal_range:.4f}",
        f"tolerance: {target.tolerance:.4f}",
        *(["width_assumed: true"] if target.width_assumed else []),
    ]
    return "\n".join([*head, "corners:", *corners, "segments:", *segments]) + "\n"


def start_entry(learned: LearnedTarget) -> str:
    """The ``start`` entry for follow.yaml, if the image learned from is the recording's first frame."""
    x, y = learned.center
    return f"start: {{frame: 0, center: [{x:.2f}, {y:.2f}], scale: 1.0}}"


def draw_target(learned: LearnedTarget, image: Image) -> Picture:
    """A magnified crop around the target with the model's lines and the corners' names."""
    corners, target = learned.corners, learned.target
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = IMAGE_MARGIN_SHARE * (high - low) + 3
    x0, y0 = np.maximum(np.floor(low - margin), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high + margin) + 1, image.shape[::-1]).astype(int)
    scale = PICTURE_SIZE_PX / max(x1 - x0, y1 - y0)
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    crop = cv2.convertScaleAbs(np.ascontiguousarray(image[y0:y1, x0:x1]))
    grey = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=method)
    picture = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    points = scale_points(corners - (x0, y0), scale)
    for a, b in target.segments:
        upright = abs(corners[a, 0] - corners[b, 0]) < abs(corners[a, 1] - corners[b, 1])
        draw_line(picture, points[a], points[b], DARK_BGR, 4)
        draw_line(picture, points[a], points[b], VERTICAL_COLOR if upright else HORIZONTAL_COLOR, 2)
    draw_dots(picture, points, WHITE_BGR, 3.5)
    for name, (x, y) in zip(corner_names(len(points)), points, strict=True):
        draw_text(picture, name, (round(x) + 5, round(y) - 5), 15, WHITE_BGR, 500)
    strip = np.empty((TARGET_HEADER_HEIGHT_PX, picture.shape[1], 3), np.uint8)
    strip[:] = DARK_BGR
    text = f"{target.name}: {len(target.segments)} lines, {target.nominal_range:.2f} m away at scale 1"
    size = 17 if text_width(text, 17) < picture.shape[1] - 28 else 11
    draw_text(strip, text, (14, 27), size, WHITE_BGR)
    return np.concatenate([strip, picture])
