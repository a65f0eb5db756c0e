"""Photo-consistency of images resampled on the same plane, cell by cell: local normalised cross-correlation (NCC)."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array, Image

NCC_RAMP = (0.6, 1.0)  # NCC of the two views at which photo-consistency is 0 and 1
MIN_CHANGE = 0.3  # 1 − NCC with the background from which on a cell has changed
MIN_STD_PRODUCT = 1e-3  # product of two standard deviations, squared grey levels, up to which the NCC is taken as 0


def local_mean(image: Image, window: int) -> Image:
    """The mean (H, W) over ``window`` × ``window`` px about each pixel."""
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REFLECT), np.float32)


class LocalStatistics:
    """An image (H, W) with its local mean and standard deviation over ``window`` px."""

    def __init__(self, image: Image, window: int) -> None:
        self.image, self.window = image, window
        self.mean = local_mean(image, window)
        self.std = np.sqrt(np.maximum(local_mean(image * image, window) - self.mean**2, 0.0))


def local_ncc(a: LocalStatistics, b: LocalStatistics) -> Image:
    """Local NCC (H, W) of two images, −1 to 1; 0 where either has no contrast."""
    covariance = local_mean(a.image * b.image, a.window) - a.mean * b.mean
    contrast = a.std * b.std
    return np.asarray(
        np.where(contrast > MIN_STD_PRODUCT, covariance / np.maximum(contrast, MIN_STD_PRODUCT), 0.0), np.float32
    )


def photo_consistency(a: LocalStatistics, b: LocalStatistics) -> Image:
    """Photo-consistency (H, W) of two images, 0 to 1."""
    return np.asarray(np.clip((local_ncc(a, b) - NCC_RAMP[0]) / (NCC_RAMP[1] - NCC_RAMP[0]), 0.0, 1.0), np.float32)


def upright_ratio(consistency: Image, road_ncc: Image, contrast: Image) -> Array:
    """Evidence that what is seen stands upright (…): the mismatch 1 − NCC of the two views if it lies on the road over
    that if it stands in the plane (…, H, W). Below 1 for a shadow and for light on the road.

    ``road_ncc`` is the NCC if it lies on the road. Cells are weighted by ``consistency`` and ``contrast``, because the
    wide glow about a lamp matches at any distance.
    """
    weight = contrast * consistency
    as_upright = (NCC_RAMP[1] - NCC_RAMP[0]) * ((1.0 - consistency) * weight).sum((-2, -1), dtype=float)
    return np.asarray(((1.0 - road_ncc) * weight).sum((-2, -1), dtype=float) / np.maximum(as_upright, 1e-9))
