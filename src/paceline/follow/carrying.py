"""A place of the target carried from image to image by what it looked like in the first one, whatever its edges say."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.follow.features import Projection
from paceline.follow.search import DETAIL
from paceline.peaks import vertex

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
        self._projection, self.place, self._reach = projection, place, reach
        self.likeness = 1.0  # correlation at the place
        self.first = float(place[2])  # its scale
        width, height = GROWN * projection.target.size * projection.magnification  # px at scale 1
        taller = max(upright * GROWN * projection.target.size[0] * projection.magnification[1] - height, 0.0)
        self._up = np.array([0.0, (ABOVE - 0.5) * taller])  # from the picture's middle to the place
        self._shows = np.array([width, height + taller])
        self._side = max(1.0, float(min(self._shows)) / GROWN * self.first / DETAIL)
        middle = self._middle(projection.shown(place).location)
        seen = _seen(image, middle, self._shows * self.first, self._side)
        self._picture = _sampled(seen, middle, self._side, self._shows * self.first / self._side)

    def step(self, image: Bytes) -> Array:
        """The place (3,) in the next ``image``; its scale to a fraction of `STEP`."""
        shown = self._projection.shown(self.place).location
        middle, seen = self._middle(shown), self._about(image, shown)
        found = [self._best(seen, middle, shown[2] * exp(STEP * k)) for k in (-1, 0, 1)]
        first = -1  # of three steps, of which the middle one is to be the best
        while first > -FARTHEST and found[0][0] > max(found[1][0], found[2][0]):
            first -= 1
            found = [self._best(seen, middle, shown[2] * exp(STEP * first)), *found[:2]]
        while first < FARTHEST - 2 and found[2][0] > max(found[0][0], found[1][0]):
            first += 1
            found = [*found[1:], self._best(seen, middle, shown[2] * exp(STEP * (first + 2)))]
        scores = np.array([score for score, _ in found])
        scale = shown[2] * exp(STEP * (first + 1 + _top(scores)[0]))
        best = int(scores.argmax())
        self.likeness = float(scores[best])
        self.place = self._projection.ideal(np.array([*(found[best][1] + self._up * scale), scale]))
        return self.place

    def likeness_at(self, image: Bytes, place: Array) -> float:
        """How well the picture correlates in ``image`` about a ``place`` (3,), of its scale; nothing is carried on."""
        shown = self._projection.shown(place).location
        return self._best(self._about(image, shown), self._middle(shown), float(shown[2]))[0]

    def _about(self, image: Bytes, shown: Array) -> _Seen:
        """All that a step from a place ``shown`` (3,) there may look at."""
        largest = self._shows * shown[2] * exp(STEP * FARTHEST) + 2.0 * self._reach
        return _seen(image, self._middle(shown), largest, self._side * max(shown[2] / self.first, 1.0))

    def _best(self, seen: _Seen, middle: Array, scale: float) -> tuple[float, Array]:
        """How well the picture at a ``scale`` correlates where it does so best, and its middle (2,) there."""
        grown = scale / self.first
        side = self._side * max(grown, 1.0)  # the larger one of picture and image is made smaller
        picture = self._picture if grown >= 1.0 else _shrunk(self._picture, grown)
        reach = np.ceil(self._reach / side)
        part = _sampled(seen, middle, side, np.array(picture.shape[::-1]) + 2 * reach)
        scores = np.asarray(cv2.matchTemplate(part, picture, cv2.TM_CCOEFF_NORMED), np.float32)
        _, score, _, (column, row) = cv2.minMaxLoc(scores)
        (right, by_column), (down, by_row) = _top(_three(scores[row], column)), _top(_three(scores[:, column], row))
        return by_column + by_row - score, middle + side * (np.array([column + right, row + down]) - reach)

    def _middle(self, shown: Array) -> Array:
        """The picture's middle (2,), recorded pixels, where the target is ``shown`` (3,)."""
        return np.asarray(shown[:2] - self._up * shown[2])


@dataclass(frozen=True, eq=False)
class _Seen:
    """A part of an image, blurred, of whose pixels each is ``pool`` × ``pool`` of the image; ``origin`` (2,) px is
    where in the image its first one lies."""

    pixels: Bytes
    origin: Array
    pool: int


def _seen(image: Bytes, middle: Array, size: Array, side: float) -> _Seen:
    """What there is of an image (H, W) of ``size`` (2,) px about ``middle`` (2,), to be sampled every ``side`` px."""
    pool = max(1, min(int(side), *image.shape))
    border = 3.0 * side
    low = np.floor((middle - 0.5 * size - border) / pool).astype(int)
    high = np.ceil((middle + 0.5 * size + border) / pool).astype(int)
    most = np.array(image.shape[::-1]) // pool
    low = np.clip(low, 0, most - 1)
    high = np.clip(high, low + 1, most)
    (x0, y0), (x1, y1) = low * pool, high * pool
    part = image[y0:y1, x0:x1]
    if pool > 1:
        part = np.asarray(cv2.resize(part, (high - low).tolist(), interpolation=cv2.INTER_AREA), np.uint8)
    blurred = np.asarray(cv2.GaussianBlur(part, (0, 0), BLUR * side / pool), np.uint8)
    return _Seen(blurred, low * pool + 0.5 * (pool - 1), pool)


def _sampled(seen: _Seen, middle: Array, side: float, count: Array) -> Bytes:
    """About ``count`` (2,) pixels about ``middle`` (2,) px, ``side`` px of the image apart; the border goes on."""
    count = np.maximum(np.rint(count), 4)
    step = side / seen.pool
    start = (middle - seen.origin) / seen.pool - 0.5 * step * (count - 1)
    grid = np.array([[step, 0.0, start[0]], [0.0, step, start[1]]])
    how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size = count.astype(int).tolist()
    return np.asarray(cv2.warpAffine(seen.pixels, grid, size, flags=how, borderMode=cv2.BORDER_REPLICATE))


def _shrunk(picture: Bytes, grown: float) -> Bytes:
    """A ``picture`` ``grown`` to a size below its own, its middle in its middle, and as blurred as it was."""
    size = np.array(picture.shape[::-1])
    smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR * sqrt(max(grown**-2 - 1.0, 1e-9))), np.uint8)
    whole = _Seen(smooth, np.zeros(2), 1)
    return _sampled(whole, 0.5 * (size - 1.0), 1.0 / grown, grown * size)


def _three(line: Floats, k: int) -> Array:
    """What is at ``k`` and on either side of it; the ends of the ``line`` (n,) go on."""
    return line[[max(k - 1, 0), k, min(k + 1, len(line) - 1)]].astype(float)


def _top(scores: Array) -> tuple[float, float]:
    """Where the parabola through three ``scores``, one step apart, has its top, from the middle one and within a step;
    and how high it is there."""
    low, middle, high = scores.tolist()
    at = vertex(low, middle, high, reach=1.0)
    return at, middle + 0.5 * at * (high - low) + 0.5 * at * at * (low - 2.0 * middle + high)
