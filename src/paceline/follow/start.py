"""Whether the operator's start is right. Hands err by a few hundredths of the target's size; edges, where the target is
as dark as the road, by all of it. So another place has to fit far better, in image after image.

The places are compared by their *match*, see :mod:`paceline.follow.measuring`, and carried on by their pictures: what
was chosen in the first image as the best of many is measured in the next ones where it went, not searched again.
"""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Bytes
from paceline.follow.carrying import Carried
from paceline.follow.lock import Lock
from paceline.follow.recognition import Look, Recogniser

REACH = 0.55  # sizes of the target by which a start may be off
PLACES, FOLLOWED = 48, 5  # that are measured in the first image, and the best of them that are followed
BESIDE = 0.08  # of the size, in place and scale, within which two places are one
PLACED = 0.04  # the same of a place and of what is measured there,
GROWN = 0.1  # and more by the logarithm of its growth: a rear is not flat, so that its picture grows otherwise
CLEAR = 0.1  # match by which another place must exceed the operator's to put it in doubt
LEAST = 0.35  # match at which a start is believed at once,
FAINT, MOST = 0.2, 0.7  # and one in dim light: so many lines agree, and nothing else matches as well
FLOOR = 0.16  # mean match with which it is believed at all
CONVINCING, FAR = 0.35, 0.3  # mean match of another place that is believed instead, and more by its distance,
MUCH, FARTHER = 0.05, 1.0  # by how much it is more, and more by its distance, as hands hardly err that far;
STRIKING = 0.6  # but where it is as much as hardly ever by chance, by CLEAR at most;
ALIKE = 0.04  # by so little more than a third one's it is not
AMISS = 0.3  # match by which the operator's is not believed either where another one is more
EARLY, SEVERAL = 3, 7  # images after the first that tell where there is no doubt, and where there was
DOUBTED = 2.0  # s for which a start may be in doubt: then the target is elsewhere, and what is there may be another
OFF = 0.06  # sizes from the start, or relative scale, at which the operator is told

DOUBT = "the start is in doubt: the model fits in more than one place"
NOWHERE = "the start is in doubt: the model fits nowhere near it"
UNTOLD = "the start was in doubt for too long: place the model again"
CORRECTED = "the start was off: the model fits better here"


class Start:
    """The operator's start, where a ``lock`` begins, on trial. It is ``pending`` until it has proved right or was
    corrected; ``lock`` is then at the place to go by, and ``first`` (3,), if there was a doubt, where that was in the
    first image that was judged."""

    def __init__(self, lock: Lock) -> None:
        self._recogniser, self._hand = lock.recogniser, lock.expected
        self._began: float | None = None  # s, when it was looked at first
        self._image: Bytes | None = None  # that was
        self._places: list[Carried] = []  # the operator's first,
        self._at_first: list[Array] = []  # where they were in the first image,
        self._away = np.zeros(0)  # how far from that they are,
        self._matches: list[list[float]] = []  # and what they have matched in the images after the first
        self.lock, self.pending = lock, True
        self.first: Array | None = None

    def judge(self, image: Bytes, time: float, own: Look) -> tuple[Look, str]:
        """The look to go by at ``image``, which carries a complaint while the start is pending, and a note where it was
        corrected. ``own`` is what the lock sees in the first image."""
        if self._began is None:
            self._began = time
            return self._first(image, own)
        self._began = min(self._began, time)  # a clock may go back
        if time - self._began > DOUBTED:
            return Look(UNTOLD, own.window), ""
        locks = [self.lock.afresh(carried.step(image)) for carried in self._places]
        looks = [lock.look_here(image) for lock in locks]
        self._matches.append(self._matches_of(looks))
        k = told(np.array(self._matches), self._away)
        if k is not None and self._is_there(k, looks[k]):
            self.first = self._at_first[k]
            assert self._image is not None
            locks[k].recogniser.anchor(self._image, self.first)
            return self._settle(locks[k], looks[k], k > 0)
        self.lock = locks[0]
        return Look(DOUBT if len(locks) > 1 else NOWHERE, own.window), ""

    def _first(self, image: Bytes, own: Look) -> tuple[Look, str]:
        fits, matches = self._elsewhere(image)
        if self._is_good(own, fits, matches):
            assert own.fit is not None, "it fits"
            return self._settle(self.lock, own, self._off(own.fit.location) > OFF)
        places = [self._hand]
        for k in np.argsort([price(self._off(fit)) for fit in fits] - matches, kind="stable"):
            away = [self._distance(fits[k], place) for place in places]
            if away[0] > PLACED and min(away[1:], default=np.inf) > BESIDE:
                places.append(fits[k])
        self._image = image.copy()
        self._places = [self._recogniser.carry(image, place) for place in places[: 1 + FOLLOWED]]
        self._at_first = [carried.place for carried in self._places]
        self._away = np.array([self._off(place) for place in self._at_first])
        return Look(DOUBT if len(places) > 1 else NOWHERE, own.window), ""

    def _elsewhere(self, image: Bytes) -> tuple[list[Array], Array]:
        """Where the model fits about the start, and how it matches there."""
        places = self._recogniser.survey(image, self._hand, REACH, PLACES)
        looks = [self.lock.afresh(place).look_here(image) for place in places]
        found = [(look.fit.location, match_of(look)) for look in looks if look.fit is not None]
        return [place for place, _ in found], np.array([match for _, match in found])

    def _is_good(self, own: Look, fits: list[Array], matches: Array) -> bool:
        """Whether there is no doubt: the model fits where the operator put it, and nowhere clearly better. It may fit
        faintly."""
        if own.complaint or own.fit is None or self._off(own.fit.location) > BESIDE:
            return False
        apart = np.array([self._distance(own.fit.location, fit) for fit in fits])
        faint = (
            own.measurement is not None
            and own.measurement.agreeing.mean() >= MOST
            and self._off(own.fit.location) < PLACED
            and match_of(own) >= matches[apart > BESIDE].max(initial=0.0)
        )
        return bool(match_of(own) >= max(FAINT if faint else LEAST, matches[apart > PLACED].max(initial=0.0) - CLEAR))

    def _matches_of(self, looks: list[Look]) -> list[float]:
        """What the places have matched in an image; nothing where the fit went from one to another."""
        return [match_of(look) if self._is_of(k, look) else 0.0 for k, look in enumerate(looks)]

    def _is_of(self, k: int, look: Look) -> bool:
        """Whether a ``look`` tells of the place ``k``: its fit is nearest to that, or right there, as two places may
        have come to be one."""
        if look.fit is None:
            return False
        away = [self._distance(look.fit.location, carried.place) for carried in self._places]
        return away[k] < PLACED or away[k] == min(away)

    def _is_there(self, k: int, look: Look) -> bool:
        """Whether a ``look`` at the place ``k`` is to be believed, and is of it."""
        if look.fit is None or look.complaint:
            return False
        carried = self._places[k]
        near = PLACED + GROWN * abs(float(np.log(carried.place[2] / carried.first)))
        return self._distance(look.fit.location, carried.place) < near

    def _settle(self, lock: Lock, look: Look, corrected: bool) -> tuple[Look, str]:
        self.lock, self.pending = lock, False
        return look, CORRECTED if corrected else ""

    def _off(self, place: Array) -> float:
        return self._distance(place, self._hand)

    def _distance(self, a: Array, b: Array) -> float:
        return distance(a, b, self._recogniser)


def told(matches: Array, away: Array) -> int | None:
    """Which of several places is the target's, the operator's being the first, by their ``matches`` (images, places) in
    the images after the first, and how far ``away`` (places,) from the operator's they are; None while that cannot be
    told."""
    images, means = len(matches), matches.mean(0)
    cost = np.array([price(d) for d in away.tolist()])
    cost = np.where(means >= STRIKING, np.minimum(cost, CLEAR), cost)
    cost[0] = 0.0
    convincing = means >= CONVINCING + FAR * np.maximum(away - BESIDE, 0.0)
    worth = np.where(convincing | (cost == 0.0), means - cost, 0.0)
    best = int(worth.argmax())
    ahead = worth[best] - np.delete(worth, best).max(initial=0.0)
    if images < (EARLY if ahead > CLEAR else SEVERAL) or means[best] < FLOOR:
        return None
    if best == 0 and means.max() >= max(CONVINCING, means[0] + AMISS):
        return None
    return best if best == 0 or ahead > ALIKE else None


def price(away: float) -> float:
    """By how much more a place must match that is so far ``away`` from the operator's."""
    return MUCH + FARTHER * max(away - BESIDE, 0.0)


def match_of(look: Look) -> float:
    """How much of the model matches in a look; 0 where nothing was measured."""
    return 0.0 if look.measurement is None else look.measurement.match


def distance(a: Array, b: Array, recogniser: Recogniser) -> float:
    """By how many sizes of the target, or which relative difference in scale, ``a`` and ``b`` (3,) are apart."""
    size = recogniser.projection.size(b[2])
    return float(max(np.abs(a[:2] - b[:2]).max() / size, abs(np.log(a[2] / b[2]))))
