"""Where what is found again has come from, image by image back to those in which the target was seen last: what was
beside it then is what has hidden it since, however alike it looks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np

from paceline.arrays import Array, Bytes
from paceline.follow.carrying import UPRIGHT, Carried
from paceline.follow.continuity import may_move, veers
from paceline.follow.features import Projection
from paceline.follow.motion import CYCLE
from paceline.follow.search import VERTICAL

SIGHTS, SURE = 6, 3  # images in a row that are kept in which the target was seen, and so many there must be,
MOST, LARGE = 128, 2**26  # and those since: more, or more bytes, are too many to go back
APART = 0.9  # cycles between two of those, at least
ALIKE = 0.75  # correlation from one image to the next at which something is the same,
ANEW = 3  # images after which its picture is taken again
REACH = 0.2  # sizes of the target by which it moves sideways between two images
ASIDE = 0.45  # sizes that it has to be aside, and share of the distance that it has to be nearer: a picture that is
NEARER, FARTHER = 0.15, 0.5  # carried slides along edges; where it is so much farther off it has slid away
CAME = "what is found has come from beside the target"


@dataclass(frozen=True, eq=False)
class Past:
    """An ``image`` (H, W) in which the target was at a ``place`` (3,), or expected there ``tau`` cycles after it was
    seen; infinitely many if nobody knows."""

    image: Bytes
    place: Array
    tau: float = 0.0


class Origin:
    """The images since the target was seen, and the last ones in which it was."""

    def __init__(self, projection: Projection) -> None:
        self._projection = projection
        width, height = projection.camera.image_size
        self._most = min(LARGE // (width * height), MOST)
        self._run: list[Past] = []  # of late, if it was seen then
        self._seen: list[Past] = []  # when it was seen for sure
        self._since: list[Past] = []
        self._last = -inf  # s, time of the last one of these

    def see(self, image: Bytes, place: Array) -> None:
        """In the next ``image`` (H, W) the target is seen at a ``place`` (3,)."""
        self._run = [*self._run[-SIGHTS + 1 :], Past(image.copy(), place)]
        if len(self._run) >= SURE:
            self._seen, self._since = self._run, []

    def miss(self, image: Bytes, time: float, place: Array, tau: float) -> None:
        """In the next ``image`` (H, W), at ``time``, s, it is not seen, but expected at a ``place`` (3,) ``tau`` cycles
        after it was."""
        run, self._run = self._run, []
        if not self._seen:
            return
        if 0 < len(run) < SURE:  # who was seen then, and is expected now, nobody knows
            self._since += [replace(sight, tau=inf) for sight in run]
        if not self._since or time - self._last >= APART * CYCLE:
            unsure = bool(self._since) and self._since[-1].tau == inf
            self._since.append(Past(image.copy(), place, inf if unsure else tau))
            self._last = time
        if len(self._since) > self._most:
            self._seen, self._since = [], []  # who may come from anywhere by now is not asked

    def complains(self, image: Bytes, place: Array) -> bool:
        """Whether what is found in ``image`` (H, W) at a ``place`` (3,) was where the target cannot have been."""
        carried = self._carried(image, place)
        for steps, past in enumerate(reversed([*self._seen, *self._since]), 1):
            place = carried.step(past.image)
            if carried.likeness < ALIKE or self._has_slid(place, past):
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
        if aside > ASIDE * p.size(scale) and veers(p, aside, scale, past.tau):
            return True
        return p.distance(scale) - p.distance(place[2]) > NEARER * p.distance(scale) + may_move(past.tau * CYCLE)

    def _has_slid(self, place: Array, past: Past) -> bool:
        """Whether nothing that hid the target can have been at a ``place`` (3,) then, which is farther off."""
        distance = self._projection.distance(past.place[2])
        return self._projection.distance(place[2]) - distance > FARTHER * distance + may_move(past.tau * CYCLE)
