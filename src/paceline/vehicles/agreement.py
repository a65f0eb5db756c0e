"""How much pictures laid out on the same card agree, place by place."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


def local_mean(image: Image, window: int) -> Image:
    """The mean (H, W) over ``window`` × ``window`` px about each pixel."""
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REFLECT), np.float32)


class Texture:
    """A picture (H, W) with its local mean and standard deviation over ``window`` px."""

    def __init__(self, image: Image, window: int) -> None:
        self.image, self.window = image, window
        self.mean = local_mean(image, window)
        self.std = np.sqrt(np.maximum(local_mean(image * image, window) - self.mean**2, 0.0))


def correlation(a: Texture, b: Texture) -> Image:
    """Local normalised correlation (H, W) of two pictures, −1 to 1; 0 where either has no contrast."""
    covariance = local_mean(a.image * b.image, a.window) - a.mean * b.mean
    contrast = a.std * b.std
    return np.asarray(np.where(contrast > 1e-3, covariance / np.maximum(contrast, 1e-3), 0.0), np.float32)
