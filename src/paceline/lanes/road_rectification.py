"""The road unrolled: what each view shows along and across the course, and where paint stands out in it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Mask
from paceline.cameras import StereoRig
from paceline.lanes.inverse_perspective import chart, pixel_size
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_surface import Surface
from paceline.recordings.background import Background

REACH = 16.0  # m to either side of the course
CELL = 0.02  # m across
LEAST_STEP = 0.25  # m along
PIXELS = 1.5  # a step along covers at least
FINER = 4  # samples along each step, averaged
FARTHEST = 110.0  # m
MOST_TURNED = np.radians(120.0)  # of the arc, to either side of its middle
WIDTHS = (0.12, 0.24)  # m of paint looked for
GAP, BESIDE = 0.08, 0.16  # m between paint and the asphalt it is compared with, and of that asphalt
LEAST_CONTRAST = 0.1  # of paint to the brighter side of the asphalt, in logarithms
ABOVE_TEXTURE = 2.5  # times the contrasts usual around it
AROUND = (3.0, 4.0)  # m along and across that are around


@dataclass(frozen=True, eq=False)
class Strip:
    """One view of the road unrolled: at ``s`` (N,) and ``d`` (M,), with ``step`` (N,) m between the s, where paint
    ``stands_out`` (N, M) on its middle line, and where the road is ``seen`` (N, M). ``brighter`` (N, M) is how much
    each place exceeds what lies beside it, in logarithms."""

    s: Array
    step: Array
    d: Array
    brighter: Image
    stands_out: Mask
    seen: Mask

    def places(self, row: NDArray[np.int64], column: NDArray[np.int64]) -> Array:
        """d (K,) of the paint's middle to a fraction of a cell, by a parabola through the contrasts about it."""
        inside = np.clip(column, 1, len(self.d) - 2)
        low, top, high = (self.brighter[row, inside + k].astype(float) for k in (-1, 0, 1))
        bend = np.minimum(low - 2 * top + high, -1e-6)
        return np.asarray(self.d[inside] + CELL * np.clip(0.5 * (low - high) / bend, -0.5, 0.5))


def unroll(rig: StereoRig, background: Background, surface: Surface, course: Alignment) -> tuple[Strip, Strip]:
    """Both views of the road along ``course``."""
    s, step = stations(rig, surface, course)
    d = np.arange(-REACH, REACH, CELL)
    fine = (s[:, None] + step[:, None] * ((np.arange(FINER) + 0.5) / FINER - 0.5)).ravel()
    ground = course.to_ground(fine[:, None], d)
    strips = []
    for side in (0, 1):
        view = chart(rig, background, side, surface, ground)
        light = np.asarray(view.light.reshape(len(s), FINER, len(d)).mean(1), np.float32)
        seen = np.asarray(view.seen.reshape(len(s), FINER, len(d)).all(1))
        brighter, least = _contrasts(light)
        stands_out = _stands_out(brighter, least, seen, float(np.median(step)))
        strips.append(Strip(s, step, d, brighter, stands_out, seen))
    return strips[0], strips[1]


def stations(rig: StereoRig, surface: Surface, course: Alignment) -> tuple[Array, Array]:
    """s (N,) and the steps (N,) between them along what the left view may show of the road."""
    s = np.arange(-FARTHEST, FARTHEST, LEAST_STEP)
    if abs(course.curvature) * FARTHEST > MOST_TURNED:
        s = s[np.abs(s * course.curvature) < MOST_TURNED]
    depth = surface.points(course.to_ground(s, 0.0))[:, 2]
    s, depth = s[(depth > 1.0) & (depth < FARTHEST)], depth[(depth > 1.0) & (depth < FARTHEST)]
    wanted = np.maximum(LEAST_STEP, PIXELS * pixel_size(rig, surface, course, s, 0.0)[:, 0])
    chosen, steps, end = [], [], -np.inf
    for at, step in zip(s.tolist(), wanted.tolist(), strict=True):
        if at >= end:
            chosen.append(at + step / 2)
            steps.append(step)
            end = at + step - 1e-9
    return np.array(chosen), np.array(steps)


def _contrasts(light: Image) -> tuple[Image, Image]:
    """How much the paint-wide middle at each place exceeds the mean of what lies beside it, and the brighter side of
    it; of the paint widths, the one that exceeds most."""
    best: tuple[Image, Image] = (np.full(light.shape, -np.inf, np.float32), np.full(light.shape, -np.inf, np.float32))
    for width in WIDTHS:
        middle = cv2.blur(light, (2 * round(width / CELL / 2) + 1, 1))
        beside = cv2.blur(light, (2 * round(BESIDE / CELL / 2) + 1, 1))
        away = round((width / 2 + GAP + BESIDE / 2) / CELL)
        left, right = np.roll(beside, away, axis=1), np.roll(beside, -away, axis=1)
        least = middle - np.maximum(left, right)
        better = least > best[1]
        mean = middle - (left + right) / 2
        best = np.where(better, mean, best[0]).astype(np.float32), np.where(better, least, best[1]).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(best[0], (5, 1), 1.0), np.float32), best[1]


def _stands_out(brighter: Image, least: Image, seen: Mask, step: float) -> Mask:
    window = 2 * round(AROUND[1] / CELL / 2) + 1, 2 * max(1, round(AROUND[0] / step / 2)) + 1
    known = cv2.blur(seen.astype(np.float32), window)
    usual = cv2.blur(np.abs(brighter) * seen, window) / np.maximum(known, 1e-3)
    top = brighter >= cv2.dilate(brighter, np.ones((1, 2 * round(0.15 / CELL) + 1), np.uint8))
    whole = cv2.erode(seen.astype(np.uint8), np.ones((1, 2 * round(0.4 / CELL) + 1), np.uint8)) > 0
    return np.asarray(top & whole & (least > LEAST_CONTRAST) & (least > ABOVE_TEXTURE * usual))
