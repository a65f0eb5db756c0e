"""A place of the target carried from image to image by what it looked like in the first one, whatever its edges say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, exp, floor, log, sqrt

import cv2
import numpy as np

from paceline.arrays import Array, Bytes, Floats
from paceline.follow import carrying_cpu
from paceline.follow.features import Projection
from paceline.follow.search import DETAIL
from paceline.subpixel import parabola_peak

GROWN = 1.1  # times the target's size that the picture shows,
# and of its width at least so much in height, as vehicles are, of what is added so much above
UPRIGHT, ABOVE = 0.7, 0.67
BLUR = 0.8  # px, of noise
ABOUT = 0.2  # of the lesser side of what is shown: standard deviation of what is about a point, where that is evened,
DIM = 4.0  # grey levels below which brightness counts as it is, and above which by its logarithm
TONES = np.asarray(255.0 * np.log1p(np.arange(256.0) / DIM) / np.log1p(255.0 / DIM), np.float32)
AS_IT_IS = np.arange(256, dtype=np.float32)
FLAT = 4.0  # of these, the contrast there below which a point hardly counts
MARGIN = 3.0  # standard deviations about it that count
STEP = 0.025  # relative change of scale that is tried,
FARTHEST = 5  # and so many of them at most
LEAST = 4  # samples along a side
MANY = 400  # places: transforms are quicker from there on
BESIDE = 2  # samples on either side of where one size was found within which the next one is


class Carried:
    """A ``place`` (3,), ideal pixels and scale, first that in the ``image`` (H, W) given, then by `step` that in each
    next one, up to ``reach`` (2,) px from the one before: where the picture of the first correlates best. It shows what
    is above and below the model as well, where that is lower than ``upright`` times its width; all of it is ``grown``
    times as large. ``evened``: each point is compared with what is about it, in units of the contrast there, or a
    shadow that passes over the target, with the strongest edges of all, takes the place along."""

    def __init__(
        self,
        image: Bytes,
        projection: Projection,
        place: Array,
        reach: Array,
        upright: float = 0.0,
        evened: bool = False,
        grown: float = GROWN,
    ) -> None:
        self._projection, self.place, self._reach = projection, place, reach
        self.likeness = 1.0  # correlation at the place
        self.first = float(place[2])  # its scale
        width, height = grown * projection.target.size * projection.magnification  # px at scale 1
        taller = max(upright * grown * projection.target.size[0] * projection.magnification[1] - height, 0.0)
        self._up = np.array([0.0, (ABOVE - 0.5) * taller])  # from the picture's middle to the place
        self._shows = np.array([width, height + taller])
        self._side = max(1.0, float(min(self._shows)) / grown * self.first / DETAIL)
        self._evened = evened
        shown = projection.shown(place).location
        size = self._shows * self.first
        seen = self._seen(image, shown, size, self._side)
        self._picture = _sampled(seen, self._middle(shown), self._side, np.maximum(np.rint(size / self._side), LEAST))
        self._pictures: dict[int, Floats] = {}

    def step(self, image: Bytes) -> Array:
        """The place (3,) in the next ``image``; its scale to a fraction of `STEP`."""
        shown = self._projection.shown(self.place).location
        middle, seen, rung = self._middle(shown), self._about(image, shown), self._rung(shown[2])
        at = self._best(seen, middle, rung)
        found = [self._best(seen, middle, rung - 1, at[1]), at, self._best(seen, middle, rung + 1, at[1])]
        first = -1  # of three steps, of which the middle one is to be the best
        while first > -FARTHEST and found[0][0] > max(found[1][0], found[2][0]):
            first -= 1
            found = [self._best(seen, middle, rung + first, found[0][1]), *found[:2]]
        while first < FARTHEST - 2 and found[2][0] > max(found[0][0], found[1][0]):
            first += 1
            found = [*found[1:], self._best(seen, middle, rung + first + 2, found[2][1])]
        scores = np.array([score for score, _ in found])
        scale = self.first * exp(STEP * (rung + first + 1 + _top(scores)[0]))
        best = int(scores.argmax())
        self.likeness = float(scores[best])
        self.place = self._projection.ideal(np.array([*(found[best][1] + self._up * scale), scale]))
        return self.place

    def likeness_at(self, image: Bytes, place: Array) -> float:
        """How well the picture correlates in ``image`` about a ``place`` (3,), of its scale to half a `STEP`; nothing
        is carried on."""
        shown = self._projection.shown(place).location
        return self._best(self._about(image, shown), self._middle(shown), self._rung(shown[2]))[0]

    def _about(self, image: Bytes, shown: Array) -> _Seen:
        """All that a step from a place ``shown`` (3,) there may look at."""
        side = self._side * max(shown[2] / self.first, 1.0)
        return self._seen(image, shown, self._shows * shown[2] * exp(STEP * FARTHEST) + 2.0 * self._reach, side)

    def _seen(self, image: Bytes, shown: Array, size: Array, side: float) -> _Seen:
        """What there is of an image (H, W) of ``size`` (2,) px about the picture's middle, where the target is
        ``shown`` (3,), to be sampled every ``side`` px; evened where that is asked for."""
        if not self._evened:
            return _seen(image, self._middle(shown), size, side)
        about = ABOUT * float(min(self._shows) * shown[2])
        seen = _seen(image, self._middle(shown), size + 2.0 * MARGIN * about, side, TONES)
        return replace(seen, pixels=_evened(seen.pixels, about / seen.pool))

    def _best(self, seen: _Seen, middle: Array, rung: int, about: Array | None = None) -> tuple[float, Array]:
        """How well the picture, by ``rung`` steps larger, correlates where it does so best within reach of the
        ``middle`` (2,), and its own middle (2,) there. It is looked for next to a place ``about`` which (2,) it is, if
        that is known."""
        side = self._side * max(exp(STEP * rung), 1.0)  # the larger one of picture and image is made smaller
        picture, samples = self._picture_at(rung), np.ceil(self._reach / side)
        if about is not None:
            beside = np.minimum(samples, BESIDE)
            farthest = side * (samples - beside)
            middle, samples = middle + np.clip(about - middle, -farthest, farthest), beside
        part = _sampled(seen, middle, side, picture.shape[::-1] + 2 * samples)
        scores = correlated(picture, part)
        row, column = divmod(int(scores.argmax()), scores.shape[1])
        (right, by_column), (down, by_row) = _top(_three(scores[row], column)), _top(_three(scores[:, column], row))
        likeness = by_column + by_row - float(scores[row, column])
        return likeness, middle + side * (np.array([column + right, row + down]) - samples)

    def _picture_at(self, rung: int) -> Floats:
        """The picture by ``-rung`` steps smaller than it is, or as it is; with a mean of 0 and a norm of 1."""
        rung = min(rung, 0)
        if rung not in self._pictures:
            self._pictures[rung] = _normal(_shrunk(self._picture, exp(STEP * rung)) if rung else self._picture)
        return self._pictures[rung]

    def _rung(self, scale: float) -> int:
        """The number of steps from the first scale to about this one."""
        return round(log(scale / self.first) / STEP)

    def _middle(self, shown: Array) -> Array:
        """The picture's middle (2,), recorded pixels, where the target is ``shown`` (3,)."""
        return np.asarray(shown[:2] - self._up * shown[2])


@dataclass(frozen=True, eq=False)
class _Seen:
    """A part of an image, blurred, of whose pixels each is ``pool`` × ``pool`` of the image; ``origin`` (2,) px is
    where in the image its first one lies."""

    pixels: Floats
    origin: Array
    pool: int


def _seen(image: Bytes, middle: Array, size: Array, side: float, tones: Floats = AS_IT_IS) -> _Seen:
    """What there is of an image (H, W) of ``size`` (2,) px about ``middle`` (2,), to be sampled every ``side`` px, in
    ``tones`` (256,)."""
    pool = max(1, min(int(side), *image.shape))
    columns, rows = (
        _stretch(float(middle[k]), 0.5 * float(size[k]) + 3.0 * side, pool, image.shape[1 - k]) for k in (0, 1)
    )
    part = image[rows.start * pool : rows.stop * pool, columns.start * pool : columns.stop * pool]
    if pool > 1:
        part = np.asarray(cv2.resize(part, (len(columns), len(rows)), interpolation=cv2.INTER_AREA), np.uint8)
    blurred = np.asarray(cv2.GaussianBlur(tones[part], (0, 0), BLUR * side / pool), np.float32)
    return _Seen(blurred, np.array([columns.start, rows.start]) * pool + 0.5 * (pool - 1), pool)


def _stretch(middle: float, half: float, pool: int, length: int) -> range:
    """The pixels of ``pool`` px each, along a side of ``length`` px, that lie up to ``half`` px from the ``middle``:
    one at least."""
    most = length // pool
    low = min(max(floor((middle - half) / pool), 0), most - 1)
    return range(low, min(max(ceil((middle + half) / pool), low + 1), most))


def _sampled(seen: _Seen, middle: Array, side: float, count: Array) -> Floats:
    """About ``count`` (2,) pixels about ``middle`` (2,) px, ``side`` px of the image apart; the border goes on."""
    columns, rows = np.maximum(np.rint(count), LEAST).astype(int).tolist()
    step = side / seen.pool
    x, y = ((middle - seen.origin) / seen.pool).tolist()
    out = np.empty((rows, columns), np.float32)
    carrying_cpu.sampled(seen.pixels, x - 0.5 * step * (columns - 1), y - 0.5 * step * (rows - 1), step, out)
    return out


def _evened(part: Floats, about: float) -> Floats:
    """By how much each point of ``part`` (H, W) is brighter than what lies ``about`` so many samples about it, in units
    of the contrast there."""
    brighter = part - cv2.GaussianBlur(part, (0, 0), about)
    contrast = np.sqrt(cv2.GaussianBlur(brighter * brighter, (0, 0), about))
    return np.asarray(brighter / (contrast + FLAT), np.float32)


def _shrunk(picture: Floats, grown: float) -> Floats:
    """A ``picture`` ``grown`` to a size below its own, its middle in its middle, and as blurred as it was."""
    size = np.array(picture.shape[::-1])
    smooth = cv2.GaussianBlur(picture, (0, 0), BLUR * sqrt(max(grown**-2 - 1.0, 1e-9)))
    whole = _Seen(np.asarray(smooth, np.float32), np.zeros(2), 1)
    return _sampled(whole, 0.5 * (size - 1.0), 1.0 / grown, grown * size)


def _normal(picture: Floats) -> Floats:
    """The same with a mean of 0 and a norm of 1; nothing but zeros where nothing shows."""
    about = picture - picture.mean(dtype=float)
    norm = float(np.linalg.norm(about))
    if norm <= carrying_cpu.FAINT * sqrt(picture.size):
        return np.zeros_like(picture)
    return np.asarray(about / norm, np.float32)


def correlated(picture: Floats, part: Floats) -> Floats:
    """(H − h + 1, W − w + 1): how ``part`` (H, W) correlates with a ``picture`` (h, w), of mean 0 and norm 1, at every
    whole sample at which that lies in it; 0 where nothing shows."""
    h, w = picture.shape
    if (part.shape[0] - h + 1) * (part.shape[1] - w + 1) < MANY:
        scores = carrying_cpu.products(picture, part)
    else:  # it goes by way of Fourier transforms
        scores = np.asarray(cv2.matchTemplate(part, picture, cv2.TM_CCORR), np.float32)
    carrying_cpu.normalise(scores, part, h, w)
    return scores


def _three(line: Floats, k: int) -> Array:
    """What is at ``k`` and on either side of it; the ends of the ``line`` (n,) go on."""
    return line[[max(k - 1, 0), k, min(k + 1, len(line) - 1)]].astype(float)


def _top(scores: Array) -> tuple[float, float]:
    """Where the parabola through three ``scores``, one step apart, has its top, from the middle one and within a step;
    and how high it is there."""
    low, middle, high = scores.tolist()
    at = parabola_peak(low, middle, high, reach=1.0)
    return at, middle + 0.5 * at * (high - low) + 0.5 * at * at * (low - 2.0 * middle + high)
