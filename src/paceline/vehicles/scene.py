"""The empty scene as it changes with the light and with what comes to stand in it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from paceline.cameras import EVERY
from paceline.recordings import StereoFrame

Image = NDArray[np.float32]

DRIFT = 2.0  # grey levels per second by which a scene follows what is seen


class EmptyScene:
    """Both views of the scene behind the traffic; each frame pulls every pixel a little towards what it shows.

    The pull does not grow with the difference, so that a vehicle that passes leaves no trace: what is followed is the
    running median.
    """

    def __init__(self, images: tuple[Image, Image]) -> None:
        self.images = (images[0].copy(), images[1].copy())
        self._time: float | None = None

    def follow(self, frame: StereoFrame, rows: slice = EVERY) -> None:
        """Draw the scene, or only its ``rows``, towards what ``frame`` shows."""
        if self._time is not None:
            step = DRIFT * (frame.time - self._time)
            for image, now in zip(self.images, (frame.left, frame.right), strict=True):
                draw(image[rows], now[rows], step)
        self._time = frame.time


@njit(cache=True, nogil=True)
def draw(image: Image, now: Image, step: float) -> None:
    """Move every pixel of ``image`` (H, W), in place, towards ``now``, by ``step`` grey levels at most."""
    most = np.float32(step)
    for y in range(len(image)):
        for x in range(image.shape[1]):
            image[y, x] += min(max(now[y, x] - image[y, x], -most), most)
