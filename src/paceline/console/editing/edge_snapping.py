"""Moves a point that the user drew to the corner, or else the edge, of the image that is strongest for its distance."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.subpixel import parabola_peak

MAX_REACH_PX = 12
MIN_GRADIENT_PER_PX = 6.0  # least gradient of an edge, grey levels per pixel
MIN_CORNER_GRADIENT_RATIO = 0.25  # least ratio of a corner's weaker gradient to the stronger


def snap_point(image: Image, point: Array, reach: float) -> Array:
    """``point`` (2,) moved by at most ``reach`` pixels to the corner, or else the edge, of the grey ``image`` (H, W)
    that is strongest for its distance; the point as it was where there is none."""
    reach = min(reach, MAX_REACH_PX)
    x, y = (int(round(float(v))) for v in point)
    margin = int(np.ceil(reach)) + 3
    height, width = image.shape
    if not (margin <= x < width - margin and margin <= y < height - margin):
        return np.asarray(point, float)
    window = cv2.GaussianBlur(image[y - margin : y + margin + 1, x - margin : x + margin + 1], (0, 0), 1.0)
    gx, gy = (np.asarray(cv2.Sobel(window, cv2.CV_32F, *d, scale=1 / 8), np.float32) for d in ((1, 0), (0, 1)))
    places = np.arange(-margin, margin + 1)
    far = np.hypot(places[None, :] + x - point[0], places[:, None] + y - point[1])
    weight = np.where(far <= reach, np.exp(-0.5 * (far / (0.5 * reach)) ** 2), 0.0)
    strength = np.hypot(gx, gy)
    if (strength * (weight > 0)).max() < MIN_GRADIENT_PER_PX:
        return np.asarray(point, float)
    sums = [cv2.GaussianBlur(a, (0, 0), 1.5) for a in (gx * gx, gx * gy, gy * gy)]
    half, spread = (sums[0] + sums[2]) / 2, np.hypot((sums[0] - sums[2]) / 2, sums[1])
    weaker = np.maximum(half - spread, 0.0)
    corner = np.unravel_index(int(np.argmax(weaker * weight)), weaker.shape)
    if (
        weaker[corner] > MIN_CORNER_GRADIENT_RATIO**2 * (half + spread)[corner]
        and np.sqrt(weaker[corner]) > MIN_GRADIENT_PER_PX / 2
    ):
        start = np.array([[[x + corner[1] - margin, y + corner[0] - margin]]], np.float32)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
        refined = cv2.cornerSubPix(image, start, (4, 4), (-1, -1), criteria).reshape(2).astype(float)
        if np.linalg.norm(refined - point) <= reach:
            return np.asarray(refined)
    edge = np.unravel_index(int(np.argmax(strength * weight)), strength.shape)
    return _edge_position(strength, gx, gy, edge) + [x - margin, y - margin]


def _edge_position(strength: Image, gx: Image, gy: Image, index: tuple[np.intp, ...]) -> Array:
    """The edge's position (2,) along its gradient, by a parabola through three samples; pixels of the window."""
    row, column = (int(v) for v in index)
    place = np.array([column, row], float)
    along = np.array([gx[row, column], gy[row, column]], float)
    along /= np.linalg.norm(along)
    samples = (place + np.outer([-1.0, 0.0, 1.0], along)).astype(np.float32).reshape(1, 3, 2)
    before, centre, behind = cv2.remap(strength, samples[..., 0], samples[..., 1], cv2.INTER_LINEAR)[0].tolist()
    return np.asarray(place + along * parabola_peak(before, centre, behind, reach=1.0))
