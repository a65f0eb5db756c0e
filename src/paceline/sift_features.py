"""SIFT features of an image, and their matches between two images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Indices, to_8_bit

Descriptors = NDArray[np.float32]


def detect_features(
    detector: cv2.SIFT, image: Image, mask: NDArray[np.uint8] | None = None
) -> tuple[Array, Descriptors]:
    """Places (n, 2) px of features of ``image`` (H, W), 0–255, where the ``mask`` is set, and descriptors (n, 128)."""
    keypoints, descriptors = detector.detectAndCompute(to_8_bit(image), mask)
    if not keypoints:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    return np.array([f.pt for f in keypoints]), np.asarray(descriptors, np.float32)


def match_descriptors(a: Descriptors, b: Descriptors, ratio: float) -> tuple[Indices, Indices]:
    """Rows of the descriptors ``a`` (n, 128) and ``b`` (m, 128) that are each other's best, nearer than ``ratio`` of
    the distance to the second best (Lowe 2004)."""
    if len(a) < 2 or len(b) < 2:
        no_match = np.empty(0, np.int64)
        return no_match, no_match
    distance, best = _nearest(a, b, 2)
    _, back = _nearest(b, a, 1)
    mutual = back[best[:, 0], 0] == np.arange(len(a))
    rows = np.flatnonzero(mutual & (distance[:, 0] < ratio * distance[:, 1]))
    return rows, best[rows, 0]


def _nearest(a: Descriptors, b: Descriptors, count: int) -> tuple[Array, Indices]:
    """Distances (n, count) of ``a`` to the nearest of ``b``, and their rows there."""
    distance, rows = cv2.batchDistance(a, b, cv2.CV_32F, normType=cv2.NORM_L2, K=count)
    return np.asarray(distance, float), np.asarray(rows, np.int64)
