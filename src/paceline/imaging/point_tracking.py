"""Points tracked from one picture into another, forth and back, by Lucas–Kanade."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Mask

WINDOW_PX = (15, 15)
MAX_ITERATIONS = 30


def track_forth_and_back(
    image: NDArray[np.uint8],
    other: NDArray[np.uint8],
    points: Array,
    expected: Array,
    levels: int,
    precision: float,
    max_return: float,
) -> tuple[Array, Mask]:
    """Where ``points`` (N, 2) px of ``image`` (H, W) are in ``other``, and which of them (N,) are tracked back to where
    they came from, by at most ``max_return`` px.

    Tracking begins at the ``expected`` places (N, 2), in pictures that are reduced ``levels`` times by half, and ends
    with steps below ``precision`` px.
    """
    if not len(points):
        return expected, np.zeros(0, bool)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, MAX_ITERATIONS, precision)
    options = (None, None, WINDOW_PX, levels, criteria, cv2.OPTFLOW_USE_INITIAL_FLOW)
    start, guess = points.astype(np.float32), expected.astype(np.float32)
    tracked, found, _ = map(np.asarray, cv2.calcOpticalFlowPyrLK(image, other, start, guess.copy(), *options))
    back_from = tracked - guess + start
    back, returned, _ = map(np.asarray, cv2.calcOpticalFlowPyrLK(other, image, tracked, back_from, *options))
    near = np.linalg.norm(back - start, axis=1) < max_return
    return np.asarray(tracked, float), near & (found.ravel() == 1) & (returned.ravel() == 1)
