"""Plots in one quiet style, and montages of pictures with outlines and particles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from paceline.reports.common.drawing import (
    DARK_BGR,
    WHITE_BGR,
    Color,
    draw_dots,
    draw_line,
    draw_outline,
    draw_text,
    scale_points,
    text_width,
)
from paceline.reports.common.plots import PLOT_STYLE

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

QUALITY = 72  # of WebP
OURS, REFINED, TRUTH, OTHER = "#2b83c6", "#c2500a", "#1f2933", "#9aa6b2"
COLORS = {
    "truth": TRUTH,
    "as printed": OURS,
    "refined": REFINED,
    "unconstrained": "#129b72",
    "drifting": "#129b72",
    "sift": "#c99700",
    "kalman": "#8a6fc2",
    "multimodal": "#c66aa3",
    "lucas-kanade": "#5f6b76",
}
GREEN: Color = (80, 220, 120)
BLUE: Color = (250, 200, 90)
RED: Color = (90, 120, 255)


def plot(path: Path, size: tuple[float, float], draw: Callable[[Figure], None]) -> None:
    """An SVG of ``size`` (inches; 100 px each) in the style of the reports."""
    with matplotlib.rc_context(PLOT_STYLE | {"font.size": 10, "legend.fontsize": 9}):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        figure.savefig(path, format="svg", facecolor="white", metadata={"Date": None, "Creator": None})


def limits(values: Sequence[Any], centre: float, reach: float) -> tuple[float, float]:
    """Limits of an axis that show all ``values``, but none farther than ``reach`` from ``centre``."""
    known = np.concatenate([np.ravel(np.array(v, float)) for v in values])
    known = known[np.isfinite(known)]
    known = known[np.abs(known - centre) <= reach]
    low, high = min(known.min(), centre), max(known.max(), centre)
    margin = 0.08 * (high - low) + 0.02
    return float(low - margin), float(high + margin)


def crop(image: Picture, middle: Array, width: float, shape: tuple[int, int]) -> tuple[Picture, float, Array]:
    """A view of ``shape`` (width, height) pixels of ``image`` about ``middle``, ``width`` px of it wide; with the
    magnification and the shift (2,) that take its pixels there."""
    scale = shape[0] / width
    shift = np.array(shape) / 2 - scale_points(np.asarray(middle, float), scale)
    to_view = np.column_stack([np.eye(2) * scale, shift + 0.5 * scale - 0.5])
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    view = cv2.warpAffine(image, to_view, shape, flags=method, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.cvtColor(view, cv2.COLOR_GRAY2BGR) if view.ndim == 2 else view), scale, shift


def outlined(view: Picture, scale: float, shift: Array, quad: Any, color: Color, thickness: int = 2) -> None:
    corners = np.array(quad, float)
    if np.isfinite(corners).all():
        draw_outline(view, scale_points(corners, scale) + shift, color, thickness)


def dotted(view: Picture, scale: float, shift: Array, points: Any, color: Color = BLUE, radius: float = 1.3) -> None:
    draw_dots(view, scale_points(np.array(points, float).reshape(-1, 2), scale) + shift, color, radius)


def divided(view: Picture, scale: float, shift: Array, quad: Any, grid: tuple[int, int]) -> None:
    """The borders of ``grid`` (across, down) parts of a quadrilateral, straight as in its plane."""
    corners = np.array(quad, np.float32)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    to_image = cv2.getPerspectiveTransform(unit, corners)
    ends = [[[i / grid[0], 0], [i / grid[0], 1]] for i in range(1, grid[0])]
    ends += [[[0, j / grid[1]], [1, j / grid[1]]] for j in range(1, grid[1])]
    for a, b in cv2.perspectiveTransform(np.array(ends, np.float32).reshape(-1, 1, 2), to_image).reshape(-1, 2, 2):
        draw_line(view, scale_points(a, scale) + shift, scale_points(b, scale) + shift, GREEN)


def captioned(view: Picture, text: str) -> Picture:
    """``view`` with a caption in its upper left corner."""
    cv2.rectangle(view, (0, 0), (text_width(text, 14) + 14, 22), DARK_BGR, cv2.FILLED)
    draw_text(view, text, (7, 16), 14, WHITE_BGR)
    return view


def montage(rows: Sequence[Sequence[Picture]], gap: int = 4) -> Picture:
    """Pictures of one size in rows, with white between."""
    height, width = rows[0][0].shape[:2]
    across = max(len(r) for r in rows)
    sheet = np.full((len(rows) * (height + gap) - gap, across * (width + gap) - gap, 3), 255, np.uint8)
    for i, line in enumerate(rows):
        for j, view in enumerate(line):
            y, x = i * (height + gap), j * (width + gap)
            sheet[y : y + height, x : x + width] = view
    return sheet


def save(path: Path, sheet: Picture) -> None:
    assert cv2.imwrite(str(path), sheet, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]), path
