"""Draws proposed lanes: each view with its lines, their uncertainty, and the lanes between them."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.lanes.lane_proposals import Lane, RoadLine
from paceline.number_format import format_uncertain
from paceline.recordings.background import Background
from paceline.reports.common.drawing import (
    DISPLAY_GAMMA,
    SUBPIXEL_BITS,
    WHITE_BGR,
    Box,
    Color,
    Picture,
    draw_label,
    draw_line,
    fixed_points,
)
from paceline.units import COVERAGE_95

LINE_COLOR: Color = (60, 200, 255)
CENTRE_COLOR: Color = (110, 220, 90)
UNUSED_COLOR: Color = (90, 90, 230)


def draw_lanes(
    rig: StereoRig, background: Background, side: int, lines: list[RoadLine], lanes: dict[str, Lane]
) -> Picture:
    """The left (0) or right (1) view in ideal pixels: lines in yellow with their 95 % band, in red those that bound no
    lane, centre lines of lanes in green."""
    image = background.images[side]
    light = np.clip(np.maximum(image, 0) / max(float(np.percentile(image, 99)), 1.0), 0, 1) ** DISPLAY_GAMMA
    picture: Picture = np.asarray(cv2.cvtColor((255 * light).astype(np.uint8), cv2.COLOR_GRAY2BGR), np.uint8)
    used_lines = {name for lane in lanes.values() for name in lane.between}
    label_boxes: list[Box] = []
    for line in lines:
        color = LINE_COLOR if line.id in used_lines else UNUSED_COLOR
        _draw_band(picture, rig, side, line, color)
        pixels = rig.project(line.points)[side]
        for a, b in zip(pixels, pixels[1:], strict=False):
            draw_line(picture, a, b, color, 1)
        label_boxes.append(
            draw_label(picture, f"{line.id} {line.kind}", _label_position(picture, pixels, 0.7), color, label_boxes)
        )
    for name, lane in lanes.items():
        recorded = (lane.left, lane.right)[side]
        pixels = rig.cameras[side].undistort_points(recorded)
        for a, b in zip(pixels, pixels[1:], strict=False):
            draw_line(picture, a, b, CENTRE_COLOR, 2)
        text = f"{name}  {format_uncertain(lane.width, COVERAGE_95 * lane.width_std)} m"
        label_boxes.append(draw_label(picture, text, _label_position(picture, pixels, 0.5), CENTRE_COLOR, label_boxes))
    draw_label(picture, "yellow: lines with their 95 % band, green: middle of a lane", (0, 0), WHITE_BGR, label_boxes)
    return picture


def _label_position(picture: Picture, pixels: Array, share: float) -> tuple[float, float]:
    """The position of a label: among the ``pixels`` (N, 2) inside the picture, at a ``share`` of their height."""
    height, width = picture.shape[:2]
    inside = pixels[((pixels >= 0) & (pixels < [width, height])).all(1)]
    if not len(inside):
        return 0.0, 0.0
    order = inside[np.argsort(inside[:, 1])]
    x, y = order[int(share * (len(order) - 1))]
    return float(x), float(y)


def _draw_band(picture: Picture, rig: StereoRig, side: int, line: RoadLine, color: Color) -> None:
    along = np.gradient(line.points, axis=0)
    across = np.stack([along[:, 2], np.zeros(len(along)), -along[:, 0]], axis=1)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    shift = COVERAGE_95 * line.lateral_std[:, None] * across
    edges = [rig.project(line.points + sign * shift)[side] for sign in (-1, 1)]
    polygon = fixed_points(np.concatenate([edges[0], edges[1][::-1]]))
    shade = picture.copy()
    cv2.fillPoly(shade, [polygon], color, cv2.LINE_AA, SUBPIXEL_BITS)
    cv2.addWeighted(shade, 0.35, picture, 0.65, 0, picture)


def encode_png(picture: Picture) -> bytes:
    """``picture`` as PNG."""
    return bytes(cv2.imencode(".png", picture)[1])
