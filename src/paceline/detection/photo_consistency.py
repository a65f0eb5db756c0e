"""How much pictures laid out on the same card agree, place by place."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array, Image

AGREE = (0.6, 1.0)  # correlation of the views at which a place begins to count, and counts wholly
CHANGED = 0.3  # one minus the correlation with the empty scene, from which on something else is there
FLAT = 1e-3  # product of two pictures' contrasts up to which there is nothing to compare, squared grey levels


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
    return np.asarray(np.where(contrast > FLAT, covariance / np.maximum(contrast, FLAT), 0.0), np.float32)


def agreement(a: Texture, b: Texture) -> Image:
    """How much two pictures agree at each place (H, W), 0 to 1."""
    return np.asarray(np.clip((correlation(a, b) - AGREE[0]) / (AGREE[1] - AGREE[0]), 0.0, 1.0), np.float32)


def stands(counts: Image, lying: Image, contrast: Image) -> Array:
    """How many times worse the views agree on what ``counts`` on cards (…, H, W) if it lies on the road, where their
    correlation is ``lying``, than if it stands (…): less than once for a shadow, and for light on the road. Places
    weigh by their ``contrast``: the wide light about a lamp agrees anywhere."""
    weight = contrast * counts
    as_standing = (AGREE[1] - AGREE[0]) * ((1.0 - counts) * weight).sum((-2, -1), dtype=float)
    return np.asarray(((1.0 - lying) * weight).sum((-2, -1), dtype=float) / np.maximum(as_standing, 1e-9))
