"""The rectified road: each view resampled along and across the road, and the paint detected in it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Mask
from paceline.cameras import StereoRig
from paceline.lanes.inverse_perspective import map_to_ground, pixel_size
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_surface import RoadSurface
from paceline.recordings.background import Background

HALF_WIDTH_M = 16.0  # half width of the rectified road
LATERAL_CELL_M = 0.02  # cell size across the road
MIN_STEP_M, MIN_STEP_PX = 0.25, 1.5  # along the road
SAMPLES_PER_STEP = 4  # samples that are averaged along the road
MAX_ROAD_DEPTH_M = 110.0
MAX_TURN_RAD = np.radians(120.0)  # of the arc, to either side of its middle
PAINT_WIDTHS_M = (0.12, 0.24)
ASPHALT_GAP_M, ASPHALT_WIDTH_M = 0.08, 0.16  # between paint and the asphalt that it is compared with, and of that
# asphalt
MIN_LOG_CONTRAST = 0.1  # least contrast of paint to the brighter side of the asphalt, difference of logarithms
MIN_TEXTURE_RATIO = 2.5  # least ratio to the mean contrast in the neighbourhood
PAINT_NEIGHBOURHOOD_M = (3.0, 4.0)  # size of that neighbourhood along and across the road


@dataclass(frozen=True, eq=False)
class RectifiedRoad:
    """One view of the road in road coordinates ``s`` (N,) and ``d`` (M,), with ``step`` (N,) m between the s:
    the ``contrast`` (N, M) of each cell to both sides, as difference of logarithms, where it ``is_paint`` (N, M) on the
    middle of a line, and where the road is ``visible`` (N, M)."""

    s: Array
    step: Array
    d: Array
    contrast: Image
    is_paint: Mask
    visible: Mask

    def paint_offsets(self, row: NDArray[np.int64], column: NDArray[np.int64]) -> Array:
        """d (K,) of the paint's middle to a fraction of a cell, by a parabola through the contrasts about it."""
        inside = np.clip(column, 1, len(self.d) - 2)
        low, top, high = (self.contrast[row, inside + k].astype(float) for k in (-1, 0, 1))
        bend = np.minimum(low - 2 * top + high, -1e-6)
        return np.asarray(self.d[inside] + LATERAL_CELL_M * np.clip(0.5 * (low - high) / bend, -0.5, 0.5))


def rectify(
    rig: StereoRig, background: Background, surface: RoadSurface, alignment: Alignment
) -> tuple[RectifiedRoad, RectifiedRoad]:
    """Both views of the road along ``alignment``."""
    s, step = sample_positions(rig, surface, alignment)
    d = np.arange(-HALF_WIDTH_M, HALF_WIDTH_M, LATERAL_CELL_M)
    fine = (s[:, None] + step[:, None] * ((np.arange(SAMPLES_PER_STEP) + 0.5) / SAMPLES_PER_STEP - 0.5)).ravel()
    ground = alignment.to_ground(fine[:, None], d)
    roads = []
    for side in (0, 1):
        view = map_to_ground(rig, background, side, surface, ground)
        light = np.asarray(view.log_intensity.reshape(len(s), SAMPLES_PER_STEP, len(d)).mean(1), np.float32)
        visible = np.asarray(view.visible.reshape(len(s), SAMPLES_PER_STEP, len(d)).all(1))
        contrast, weaker_contrast = _contrasts(light)
        is_paint = _paint_mask(contrast, weaker_contrast, visible, float(np.median(step)))
        roads.append(RectifiedRoad(s, step, d, contrast, is_paint, visible))
    return roads[0], roads[1]


def sample_positions(rig: StereoRig, surface: RoadSurface, alignment: Alignment) -> tuple[Array, Array]:
    """s (N,) and the steps (N,) between them along the part of the road that the left view may show."""
    s = np.arange(-MAX_ROAD_DEPTH_M, MAX_ROAD_DEPTH_M, MIN_STEP_M)
    if abs(alignment.curvature) * MAX_ROAD_DEPTH_M > MAX_TURN_RAD:
        s = s[np.abs(s * alignment.curvature) < MAX_TURN_RAD]
    depth = surface.points(alignment.to_ground(s, 0.0))[:, 2]
    s, depth = s[(depth > 1.0) & (depth < MAX_ROAD_DEPTH_M)], depth[(depth > 1.0) & (depth < MAX_ROAD_DEPTH_M)]
    min_steps = np.maximum(MIN_STEP_M, MIN_STEP_PX * pixel_size(rig, surface, alignment, s, 0.0)[:, 0])
    chosen, steps, end = [], [], -np.inf
    for position, step in zip(s.tolist(), min_steps.tolist(), strict=True):
        if position >= end:
            chosen.append(position + step / 2)
            steps.append(step)
            end = position + step - 1e-9
    return np.array(chosen), np.array(steps)


def _contrasts(light: Image) -> tuple[Image, Image]:
    """The contrast of a strip as wide as paint about each cell to the mean of both sides, and to the brighter side; of
    the paint widths, the one with the largest contrast."""
    best: tuple[Image, Image] = (np.full(light.shape, -np.inf, np.float32), np.full(light.shape, -np.inf, np.float32))
    for width in PAINT_WIDTHS_M:
        middle = cv2.blur(light, (2 * round(width / LATERAL_CELL_M / 2) + 1, 1))
        asphalt = cv2.blur(light, (2 * round(ASPHALT_WIDTH_M / LATERAL_CELL_M / 2) + 1, 1))
        distance_cells = round((width / 2 + ASPHALT_GAP_M + ASPHALT_WIDTH_M / 2) / LATERAL_CELL_M)
        left, right = np.roll(asphalt, distance_cells, axis=1), np.roll(asphalt, -distance_cells, axis=1)
        weaker = middle - np.maximum(left, right)
        higher = weaker > best[1]
        mean = middle - (left + right) / 2
        best = np.where(higher, mean, best[0]).astype(np.float32), np.where(higher, weaker, best[1]).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(best[0], (5, 1), 1.0), np.float32), best[1]


def _paint_mask(contrast: Image, weaker_contrast: Image, visible: Mask, step: float) -> Mask:
    window = (
        2 * round(PAINT_NEIGHBOURHOOD_M[1] / LATERAL_CELL_M / 2) + 1,
        2 * max(1, round(PAINT_NEIGHBOURHOOD_M[0] / step / 2)) + 1,
    )
    known = cv2.blur(visible.astype(np.float32), window)
    mean_contrast = cv2.blur(np.abs(contrast) * visible, window) / np.maximum(known, 1e-3)
    top = contrast >= cv2.dilate(contrast, np.ones((1, 2 * round(0.15 / LATERAL_CELL_M) + 1), np.uint8))
    interior = cv2.erode(visible.astype(np.uint8), np.ones((1, 2 * round(0.4 / LATERAL_CELL_M) + 1), np.uint8)) > 0
    return np.asarray(
        top & interior & (weaker_contrast > MIN_LOG_CONTRAST) & (weaker_contrast > MIN_TEXTURE_RATIO * mean_contrast)
    )
