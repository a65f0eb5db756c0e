"""Draws lines, points and text on images with sub-pixel precision."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array

Picture = NDArray[np.uint8]  # (H, W, 3), BGR
Color = tuple[int, int, int]  # BGR
Box = tuple[int, int, int, int]  # left, top, right, bottom

SANS_FONT = cv2.FontFace("sans")
DARK_BGR: Color = (36, 28, 22)
WHITE_BGR: Color = (255, 255, 255)
LABEL_SIZE, LABEL_WEIGHT = 16, 500
DISPLAY_GAMMA = 0.6  # exponent that brightens dark recordings
SUBPIXEL_BITS = 4  # fractional bits of the coordinates given to OpenCV


def draw_text(
    picture: Picture, text: str, position: tuple[int, int], size: int, color: Color, weight: int = 400
) -> None:
    """Draws ``text``, ``size`` pixels high, with its base line starting at ``position``."""
    cv2.putText(picture, text, position, color, SANS_FONT, size, weight)


def text_width(text: str, size: int, weight: int = 400) -> int:
    """The width of ``text`` in pixels."""
    return int(cv2.getTextSize((0, 0), text, (0, 0), SANS_FONT, size, weight)[2])


def draw_label(
    picture: Picture, text: str, position: tuple[float, float], color: Color, occupied: Sequence[Box] = ()
) -> Box:
    """Draws ``text`` centred above ``position``, inside the picture, off the ``occupied`` boxes; returns its box."""
    height, width = picture.shape[:2]
    w, h = text_width(text, LABEL_SIZE, LABEL_WEIGHT) + 18, LABEL_SIZE + 10
    x = int(np.clip(position[0] - w / 2, 2, max(2, width - w - 2)))
    y = int(np.clip(position[1] - h - 10, 2, max(2, height - h - 2)))
    while any(x < r and left < x + w and y < b and top < y + h for left, top, r, b in occupied) and y > h:
        y -= h + 4
    cv2.rectangle(picture, (x, y), (x + w, y + h), DARK_BGR, cv2.FILLED)
    cv2.rectangle(picture, (x, y), (x + 4, y + h), color, cv2.FILLED)
    draw_text(picture, text, (x + 11, y + h - 8), LABEL_SIZE, WHITE_BGR, LABEL_WEIGHT)
    return x, y, x + w, y + h


def draw_outline(picture: Picture, corners: Array, color: Color, thickness: int) -> None:
    """Draws a closed polygon (N, 2) of finite points, with a dark edge."""
    outline = [fixed_points(corners)]
    cv2.polylines(picture, outline, True, DARK_BGR, thickness + 2, cv2.LINE_AA, SUBPIXEL_BITS)
    cv2.polylines(picture, outline, True, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def draw_line(picture: Picture, start: Array, stop: Array, color: Color, thickness: int = 1) -> None:
    """Draws a line between two points (2,) of the picture; nothing where one is not finite."""
    if np.isfinite([start, stop]).all():
        a, b = fixed_points(np.stack([start, stop])).tolist()
        cv2.line(picture, a, b, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def draw_dots(picture: Picture, points: Array, color: Color, radius: float) -> None:
    """Draws filled circles at ``points`` (M, 2), except those that are not finite."""
    size = round(radius * (1 << SUBPIXEL_BITS))
    for centre in fixed_points(points[np.isfinite(points).all(axis=1)]).tolist():
        cv2.circle(picture, centre, size, color, cv2.FILLED, cv2.LINE_AA, SUBPIXEL_BITS)


def scale_points(points: Array, scale: float) -> Array:
    """``points`` in a picture magnified by ``scale``; pixel edges, not centres, scale about zero."""
    return (points + 0.5) * scale - 0.5


def fixed_points(points: Array) -> NDArray[np.int32]:
    """Finite ``points`` (N, 2) in OpenCV's fixed-point coordinates, SUBPIXEL_BITS fractional bits."""
    return np.rint(np.clip(points, -1e5, 1e5) * (1 << SUBPIXEL_BITS)).astype(np.int32)
