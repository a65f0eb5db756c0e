"""A place of the target carried from image to image by what it looked like in the first one, whatever its edges say."""

from __future__ import annotations

from math import exp

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.follow.features import Projection
from paceline.follow.search import DETAIL

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

GROWN = 1.1  # times the target's size that the picture shows,
# and of its width at least so much in height, as vehicles are, of what is added so much above
UPRIGHT, ABOVE = 0.7, 0.67
BLUR = 0.8  # px, of noise
STEP = 0.025  # relative change of scale that is tried,
FARTHEST = 5  # and so many of them at most


class Carried:
    """A ``place`` (3,), ideal pixels and scale, first that in the ``image`` (H, W) given, then by `step` that in each
    next one, up to ``reach`` (2,) px from the one before: where the picture of the first correlates best. It shows what
    is above and below the model as well, where that is lower than ``upright`` times its width."""

    def __init__(
        self, image: Bytes, projection: Projection, place: Array, reach: Array, upright: float = 0.0
    ) -> None:
        self._projection, self.place = projection, place
        self.likeness = 1.0  # correlation at the place
        self._size = projection.target.size * projection.magnification  # px at scale 1
        width, height = GROWN * self._size
        upright *= GROWN * projection.target.size[0] * projection.magnification[1]
        taller = max(upright - height, 0.0)
        self._side = max(1, int(min(width, height + taller) / GROWN * place[2] / DETAIL))
        self._reach = np.ceil(reach / self._side).astype(int)
        self.first = float(place[2])  # its scale
        self._up = (ABOVE - 0.5) * taller / self._side  # from the place to the picture's middle, at scale 1
        shown = projection.shown(place).location
        shows = np.array([width, height + taller]) * place[2] / self._side
        self._picture = _cut(self._made_ready(image), self._smaller(shown), shows)

    def step(self, image: Bytes) -> Array:
        """The place (3,) in the next ``image``; its scale to a fraction of `STEP`."""
        seen, shown = self._made_ready(image), self._projection.shown(self.place).location
        center = self._smaller(shown)
        found = [self._best(seen, center, shown[2] * exp(STEP * k)) for k in (-1, 0, 1)]
        first = -1  # of three steps, of which the middle one is to be the best
        while first > -FARTHEST and found[0][0] > max(found[1][0], found[2][0]):
            first -= 1
            found = [self._best(seen, center, shown[2] * exp(STEP * first)), *found[:2]]
        while first < FARTHEST - 2 and found[2][0] > max(found[0][0], found[1][0]):
            first += 1
            found = [*found[1:], self._best(seen, center, shown[2] * exp(STEP * (first + 2)))]
        scores = np.array([score for score, _ in found])
        scale = shown[2] * exp(STEP * (first + 1 + _top(scores)[0]))
        best = int(scores.argmax())
        self.likeness = float(scores[best])
        center = (found[best][1] + np.array([0.0, self._up * scale]) + 0.5) * self._side - 0.5
        self.place = self._projection.ideal(np.array([*center, scale]))
        return self.place

    def _best(self, seen: Bytes, center: Array, scale: float) -> tuple[float, Array]:
        """How well the picture at a ``scale`` correlates where it does so best, and the centre (2,) there."""
        grown = scale / self.first
        how = cv2.INTER_AREA if grown < 1.0 else cv2.INTER_LINEAR
        picture = cv2.resize(self._picture, None, fx=grown, fy=grown, interpolation=how)
        part = _cut(seen, center, np.array(picture.shape[::-1]) + 2 * self._reach)
        scores = np.asarray(cv2.matchTemplate(part, picture, cv2.TM_CCOEFF_NORMED), np.float32)
        _, score, _, (column, row) = cv2.minMaxLoc(scores)
        (right, by_column), (down, by_row) = _top(_three(scores[row], column)), _top(_three(scores[:, column], row))
        return by_column + by_row - score, center + np.array([column + right, row + down]) - self._reach

    def _smaller(self, shown: Array) -> Array:
        """The picture's middle (2,) at a place in the smaller image that is searched."""
        return np.asarray((shown[:2] + 0.5) / self._side - 0.5 - np.array([0.0, self._up * shown[2]]))

    def _made_ready(self, image: Bytes) -> Bytes:
        smaller = (image.shape[1] // self._side, image.shape[0] // self._side)
        small = image if self._side == 1 else cv2.resize(image, smaller, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.GaussianBlur(small, (0, 0), BLUR), np.uint8)


def _cut(image: Bytes, center: Array, size: Array) -> Bytes:
    """The part of ``image`` of ``size`` (width, height) about ``center`` (2,), px; its border goes on."""
    width, height = np.maximum(np.rint(size), 4).astype(int).tolist()
    return np.asarray(cv2.getRectSubPix(image, (width, height), (float(center[0]), float(center[1]))), np.uint8)


def _three(line: Floats, k: int) -> Array:
    """What is at ``k`` and on either side of it; the ends of the ``line`` (n,) go on."""
    return line[[max(k - 1, 0), k, min(k + 1, len(line) - 1)]].astype(float)


def _top(scores: Array) -> tuple[float, float]:
    """Where the parabola through three ``scores``, one step apart, has its top, from the middle one and within a step;
    and how high it is there."""
    low, middle, high = scores.tolist()
    bend = min(low - 2.0 * middle + high, -1e-9)
    at = min(max(0.5 * (low - high) / bend, -1.0), 1.0)
    return at, middle + 0.5 * at * (high - low) + 0.5 * at * at * bend
