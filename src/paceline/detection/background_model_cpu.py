"""One update of a running median, compiled by Numba."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Image
from paceline.numba_cache import cached_njit


@cached_njit(nogil=True)
def step_towards(image: Image, target: Image, step: float) -> None:
    """Move every pixel of ``image`` (H, W), in place, towards ``target``, by ``step`` grey levels at most."""
    max_step = np.float32(step)
    for y in range(len(image)):
        for x in range(image.shape[1]):
            image[y, x] += min(max(target[y, x] - image[y, x], -max_step), max_step)
