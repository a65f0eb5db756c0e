"""Whether a lock is a line off. Many models have lines side by side, as a frame inside an outline. Where one is taken
for the other on one side of the target, and above or below it as well, all the rest may fit, at a size that is wrong by
some per cent. But more of the model shows where it is right: a little in each image, and in image after image.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from paceline.arrays import Array, Bytes
from paceline.follow.recognition import Recogniser
from paceline.follow.start import distance
from paceline.targets.line_model import Target

NEAREST, FARTHEST = 0.02, 0.08  # shares of the model's width by which two upright lines side by side are apart
ONE = 1.25  # times as far apart, two others are so by about as much
SLIGHT = 0.01  # difference of two matches that tells nothing, however long it lasts
ABSENT = -0.05  # what an image counts in which the model does not fit at the other place, and at least: a lock that was
# right for long may slip later on
WHOLE = 0.7  # share of what the lock usually matches below which a part of the target is hidden: that tells nothing
FADES = 0.9995  # factor of that for an image in which there is less
FORGOTTEN = 0.005  # share of what is known of the other places that an image makes forgotten
PROVEN, ENOUGH = 3.0, 0.1  # where another place is right: what the sum of gains is in units of chance, and in all
REFUTED = -3.0  # the former where it is not, so that it is asked no more until some of that is forgotten
HANDICAP = 0.5  # mean gain that a place needs by how much farther it is from where a hand has put the target: where
# some of a dark target's lines never show, a wrong place matches better for good, and that steadily


class Nested:
    """Asks the places at which ``target`` lies where a lock is a line off: in each image one, by turns, and the one
    that has done best. Where the one is right and where it is not there is a little more of the model in each image, or
    less; what tells is how steadily."""

    def __init__(self, target: Target) -> None:
        self._moves = moves_of(target)
        self._sums = np.zeros(len(self._moves))  # of what there was more of the model
        self._squares = np.zeros(len(self._moves))
        self._images = np.zeros(len(self._moves))  # in which each was asked; forgotten as the sums are
        self._turn = 0
        self._usual = 0.0  # match of the lock

    def better(self, image: Bytes, here: Array, recogniser: Recogniser) -> Array | None:
        """The place (3,) at which the target has proved to be in ``image`` rather than ``here`` (3,); None while there
        is none."""
        if not len(self._moves):
            return None
        steady = self._steadiness()
        left = np.flatnonzero(steady > REFUTED)
        self._sums *= 1.0 - FORGOTTEN
        self._squares *= 1.0 - FORGOTTEN
        self._images *= 1.0 - FORGOTTEN
        if not len(left):
            return None
        measured = recogniser.measured_at(image, here)
        now = 0.0 if measured is None else measured[1]
        self._usual = max(now, FADES * self._usual)
        if now < WHOLE * self._usual:
            return None
        self._turn += 1
        asked = {int(left[steady[left].argmax()]), int(left[self._turn % len(left)])}
        right = {k: there for k in asked if (there := self._asked(k, image, here, now, recogniser)) is not None}
        if not right:
            return None
        best = max(right, key=lambda k: float(self._sums[k]))
        self.forget()
        return right[best]

    def forget(self) -> None:
        """The lock is another one from now on: nothing is known of the places about it."""
        self._sums[:], self._squares[:], self._images[:] = 0.0, 0.0, 0.0
        self._usual = 0.0

    def _steadiness(self) -> Array:
        """Each sum in units of what it would be by chance."""
        return self._sums / np.sqrt(np.maximum(self._squares, 1e-12))

    def _asked(self, k: int, image: Bytes, here: Array, now: float, recogniser: Recogniser) -> Array | None:
        """The place (3,) by move ``k`` if it has proved to be right; there is ``now`` so much of the model ``here``."""
        right, down, factor = self._moves[k]
        size = recogniser.projection.size(here[2])
        there: Array = here * (1.0, 1.0, factor) + (right * size, down * size, 0.0)
        then = recogniser.measured_at(image, there)
        gain = ABSENT
        if then is not None and distance(then[0], there, recogniser) <= distance(then[0], here, recogniser):
            gain = max(then[1] - now - SLIGHT, ABSENT)
        self._sums[k] += gain
        self._squares[k] += gain * gain
        self._images[k] += 1.0
        proven = gain > 0.0 and self._sums[k] >= ENOUGH and self._steadiness()[k] >= PROVEN
        if proven and self._sums[k] >= handicap(image, here, there, recogniser) * self._images[k]:
            return there
        return None


def handicap(image: Bytes, here: Array, there: Array, recogniser: Recogniser) -> float:
    """By how much more than ``here`` (3,) the model has to match ``there``, which is farther from where a hand has put
    the target; nothing where that is not seen in ``image``."""
    hand = recogniser.put_by_hand(image, here)
    if hand is None:
        return 0.0
    return HANDICAP * (distance(there, hand, recogniser) - distance(here, hand, recogniser))


def moves_of(target: Target) -> Array:
    """From where a lock is to where it may have to be (N, 3): right and down in sizes of the target, and the factor of
    its scale. With lines a gap g apart in a width w one side off makes it 1 ± g/w, and both sides 1 ± 2 g/w."""
    width, size = float(target.size[0]), float(max(target.size))
    upright = np.unique(target.places[target.vertical])
    gaps: list[float] = []
    for k, x in enumerate(upright):
        for gap in upright[k + 1 :] - x:
            beside = NEAREST < gap / width < FARTHEST
            if beside and not any(1 / ONE < gap / other < ONE for other in gaps):
                gaps.append(float(gap))
    moves = []
    for gap, sign in product(gaps, (1.0, -1.0)):
        aside, factor = 0.5 * gap / size, sign * gap / width
        moves += [(x, y, 1.0 + factor) for x, y in product((-aside, aside), repeat=2)]
        moves.append((0.0, 0.0, 1.0 + 2.0 * factor))
    return np.array(moves).reshape(-1, 3)
