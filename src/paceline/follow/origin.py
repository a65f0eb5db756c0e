"""Where what is found again has come from, image by image back to those in which the target was seen last: what was
beside it then is what has hidden it since, however alike it looks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from paceline.follow.carrying import UPRIGHT, Carried
from paceline.follow.continuity import leaps, moves
from paceline.follow.features import Projection
from paceline.follow.motion import CYCLE
from paceline.follow.search import VERTICAL

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

BEFORE = 6  # images that are kept in which the target was seen last,
MOST, LEAST, LARGE = 128, 12, 2**25  # and of all, at most and at least, if they are no more bytes
ALIKE = 0.75  # correlation from one image to the next at which something is the same,
ANEW = 3  # images after which its picture is taken again
REACH = 0.2  # sizes of the target by which it moves sideways between two images
BESIDE = 0.35  # sizes that it has to be aside, and share of the distance that it has to be nearer: a picture that is
NEARER = 0.15  # carried slides along edges
CAME = "what is found has come from beside the target"


class Past(NamedTuple):
    """In an ``image`` (H, W) the target was expected at a ``place`` (3,), ``tau`` cycles after it was seen; 0 where it
    was seen."""

    image: Bytes
    place: Array
    tau: float


class Origin:
    """The images of late, and where the target was in each, or was expected."""

    def __init__(self, projection: Projection) -> None:
        self._projection = projection
        width, height = projection.camera.image_size
        self._most = min(max(LARGE // (width * height), LEAST), MOST)
        self._past: list[Past] = []

    def keep(self, image: Bytes, place: Array, tau: float) -> None:
        """Remember the next image, see `Past`."""
        past = self._past
        if tau == 0.0:
            past = [] if past and past[-1].tau > 0.0 else past[-BEFORE + 1 :]
        elif len(past) >= self._most:
            past = past[::2]  # what hid it long ago came in the first ones
        self._past = [*past, Past(image.copy(), place, tau)]

    def complains(self, image: Bytes, place: Array) -> bool:
        """Whether what is found in ``image`` (H, W) at a ``place`` (3,) was where the target cannot have been."""
        carried, steps = self._carried(image, place), 0
        for past in reversed(self._past):
            place, steps = carried.step(past.image), steps + 1
            if carried.likeness < ALIKE:
                return False
            if self._is_elsewhere(place, past):
                return True
            if steps % ANEW == 0:
                carried = self._carried(past.image, place)
        return False

    def _carried(self, image: Bytes, place: Array) -> Carried:
        reach = np.array([REACH * self._projection.size(place[2]), VERTICAL * self._projection.camera.K[1, 1]])
        return Carried(image, self._projection, place, reach, UPRIGHT)

    def _is_elsewhere(self, place: Array, past: Past) -> bool:
        """Whether the target cannot have been at a ``place`` (3,) then: it is aside, or nearer, as what hides it is."""
        p, scale = self._projection, float(past.place[2])
        aside = float(abs(place[0] - past.place[0]))
        if aside > BESIDE * p.size(scale) and leaps(p, aside, scale, past.tau):
            return True
        nearer = p.distance(scale) - p.distance(place[2])
        return nearer > NEARER * p.distance(scale) + moves(past.tau * CYCLE)
