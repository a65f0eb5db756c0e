"""Where the target may be, by its picture, in a wide part of an image: it was not seen for a while.

A grid of places there is too coarse for edges, which show only where a model lies on them to the pixel. A picture that
is made small is compared everywhere at once.
"""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array, Bytes, Floats

SMALL, LEAST = 12, 8  # px: the smaller side of the picture that is compared, and the same in a large view
STEP = 0.07  # relative change from one size that is tried to the next
WORK = 200_000  # pixels of the small view, times sizes tried, that are compared at most
APART = 0.25  # sizes of the picture that two places are from each other


def sweep(
    view: Bytes, picture: Floats, box: Array, magnification: Array, place: Array, share: float, count: int
) -> Array:
    """Up to ``count`` places (N, 3) in ``view`` (H, W), px and scale, where a ``picture`` (h, w) correlates best.

    The picture shows ``box`` (4,) m about the target's centre; ``magnification`` (2,) is in px per metre at scale 1.
    The scales tried are up to a ``share`` greater than that of ``place`` (3,), and by as large a factor smaller. In a
    view that is too large for `WORK` only the part about that place is looked through.
    """
    extent = (box[2:] - box[:2]) * magnification * place[2]
    steps = int(np.ceil(np.log1p(share) / np.log1p(STEP)))
    work = view.size * (2 * steps + 1) / WORK
    shrunk = max(float(extent.min()) / SMALL, min(float(extent.min()) / LEAST, work**0.5), 1.0)
    first, view = _about(view, place[:2], min(shrunk / work**0.5, 1.0))
    height, width = view.shape
    shape = np.maximum(np.rint(np.array([width, height]) / shrunk), 1).astype(int)
    small = cv2.resize(view, shape.tolist(), interpolation=cv2.INTER_AREA)
    unit = np.array([width, height]) / shape  # px of the view in one of the small one
    found = []
    for grown in (1.0 + STEP) ** np.arange(-steps, steps + 1):
        size = np.rint(extent * grown / unit).astype(int)
        if size.min() < 4 or (size > shape).any():
            continue
        template = cv2.resize(picture, size.tolist(), interpolation=cv2.INTER_AREA)
        scores = cv2.matchTemplate(small.astype(np.float32), template, cv2.TM_CCOEFF_NORMED)
        near = np.maximum(APART * size, 1).astype(int)
        for _ in range(count):
            _, score, _, (column, row) = cv2.minMaxLoc(scores)
            center = first + np.array([column, row]) * unit - 0.5 - box[:2] * magnification * place[2] * grown
            found.append((score, *center, place[2] * grown))
            scores[max(row - near[1], 0) : row + near[1] + 1, max(column - near[0], 0) : column + near[0] + 1] = -1.0
    return _apart(np.array(found).reshape(-1, 4), APART * extent, count)


def _about(view: Bytes, center: Array, share: float) -> tuple[Array, Bytes]:
    """The part of a ``view`` (H, W) about ``center`` (2,) that has a ``share`` of its width and height, and the pixel
    (2,) at which it begins."""
    size = np.maximum(np.ceil(share * np.array(view.shape[::-1])), 1).astype(int)
    x, y = np.clip(np.rint(center - 0.5 * size), 0, np.array(view.shape[::-1]) - size).astype(int).tolist()
    return np.array([x, y], float), view[y : y + size[1], x : x + size[0]]


def _apart(found: Array, near: Array, count: int) -> Array:
    """The best ``count`` of what was ``found``, rows (N, 4) of score and place, no two of them ``near`` (2,)."""
    chosen: list[Array] = []
    for place in found[np.argsort(-found[:, 0], kind="stable"), 1:]:
        if len(chosen) < count and all((np.abs(place[:2] - other[:2]) > near).any() for other in chosen):
            chosen.append(place)
    return np.array(chosen).reshape(-1, 3)
