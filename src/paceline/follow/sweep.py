"""Where the target may be, by its picture, in a wide part of an image: it was not seen for a while.

A grid of places there is too coarse for edges, which show only where a model lies on them to the pixel. A picture that
is made small is compared everywhere at once.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

SMALL = 12  # px: the smaller side of the picture that is compared
STEP = 0.07  # relative change from one size that is tried to the next
APART = 0.25  # sizes of the picture that two places are from each other


def sweep(
    view: Bytes, picture: Floats, box: Array, magnification: Array, scale: float, share: float, count: int
) -> Array:
    """Up to ``count`` places (N, 3) in ``view`` (H, W), px and scale, where a ``picture`` (h, w) correlates best.

    The picture shows ``box`` (4,) m about the target's centre; ``magnification`` (2,) is in px per metre at scale 1.
    The scales tried are up to a ``share`` smaller and greater than ``scale``.
    """
    extent = (box[2:] - box[:2]) * magnification * scale
    shrunk = max(float(extent.min()) / SMALL, 1.0)
    height, width = view.shape
    small = cv2.resize(view, (round(width / shrunk), round(height / shrunk)), interpolation=cv2.INTER_AREA)
    unit = np.array([width / small.shape[1], height / small.shape[0]])  # px of the view in one of the small one
    steps = int(np.ceil(share / STEP))
    found = []
    for grown in (1.0 + STEP) ** np.arange(-steps, steps + 1):
        size = np.rint(extent * grown / unit).astype(int)
        if size.min() < 4 or (size > small.shape[::-1]).any():
            continue
        template = cv2.resize(picture, size.tolist(), interpolation=cv2.INTER_AREA)
        scores = cv2.matchTemplate(small.astype(np.float32), template, cv2.TM_CCOEFF_NORMED)
        near = np.maximum(APART * size, 1).astype(int)
        for _ in range(count):
            _, score, _, (column, row) = cv2.minMaxLoc(scores)
            center = np.array([column, row]) * unit - 0.5 - box[:2] * magnification * scale * grown
            found.append((score, *center, scale * grown))
            scores[max(row - near[1], 0) : row + near[1] + 1, max(column - near[0], 0) : column + near[0] + 1] = -1.0
    return _apart(np.array(found).reshape(-1, 4), APART * extent, count)


def _apart(found: Array, near: Array, count: int) -> Array:
    """The best ``count`` of what was ``found``, rows (N, 4) of score and place, no two of them ``near`` (2,)."""
    chosen: list[Array] = []
    for place in found[np.argsort(-found[:, 0], kind="stable"), 1:]:
        if len(chosen) < count and all((np.abs(place[:2] - other[:2]) > near).any() for other in chosen):
            chosen.append(place)
    return np.array(chosen).reshape(-1, 3)
