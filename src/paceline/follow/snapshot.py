"""The target as one image has shown it: where its lines are lost in noise or shadows, that picture still tells where it
is. It is never learned anew little by little, so that it goes nowhere else, as a lock may that slides along edges."""

from __future__ import annotations

from math import exp, log

import numpy as np

from paceline.arrays import Array, Bytes
from paceline.follow.carrying import Carried

FIRST, RATE = 0.5, 0.2  # likeness that is usual before any is known; of learning it
STRIKING = 0.75  # likeness at which it gainsays features that do not show well from the first image on
LIKE, LEAST = 0.7, 0.46  # share of the usual likeness, and likeness, at which the target is believed to be there,
LATE = 0.6  # and the latter where it was not seen for as long as GONE: among many places some look alike
CLEAR = 5  # sure sights after which it is known to show well: what then makes it look otherwise stands before it,
LESS, GONE = 0.06, 3.0  # and it may be less alike than usual by that, and seen so many cycles ago at most
ALONE = 0.2  # likeness by which the model's own part may be less alike than usual
WITHIN = 0.95  # times the model's size that its inner part shows: what is behind its outline comes nearer by itself
BEHIND = 0.05  # likeness by which that may be more alike where the lock is than where the snapshot tells
AGES = 1.3  # times as large or small as it was: then its picture is another
MOST = 3.0  # times as large or small nothing is told by it: from 5 to 15 m, as in the paper
EVERY, LATER = 7, 300  # sure sights of which one is compared with it, at first and after TWICE as many: it takes time
TWICE = 2
APART = np.array([0.1, 0.1, 0.07])  # sizes, and relative scale, by which they may disagree
CLOSELY = 0.2  # share of that within which they confirm each other, so that another may be taken there
OFF = 0.03  # the same by which it may be set right
RIGHT = np.array([0.02, 0.02, 0.02])  # standard deviations of what it tells in an image, in sizes and of the scale,
HAND = np.array([0.02, 0.02, 0.03])  # and of the hand that has put it there, which errs by as much in every one


class Snapshot:
    """What is ``carried`` is put where the target is expected in an image, and its ``own`` part, without what is above
    and below the model, and its ``inner`` one, without what is behind its outline, where that is found; ``size`` is the
    target's, px at scale 1. What is known of the ``last`` snapshot of the same target holds for this one."""

    def __init__(
        self, carried: Carried, own: Carried, inner: Carried, size: float, last: Snapshot | None = None
    ) -> None:
        self._carried, self._own, self._inner, self._size = carried, own, inner, size
        self._first = float(carried.place[2])
        self._off = np.zeros(3)  # what is to be added to what it tells, where the lock was sure
        self._usual: float = last._usual if last else FIRST
        self._usual_own: float = last._usual_own if last else FIRST
        self.agreed: int = last.agreed if last else 0  # images in which the lock agreed with it,
        self._surely = self._compared = 0  # in which it was sure, and in which both were so
        self._turn = 0
        self.confirmed = False  # closely, in the image compared last
        self._own_likeness = 1.0  # of its own part there

    def is_old(self, scale: float) -> bool:
        """Whether a target of this ``scale`` looks otherwise."""
        return not 1 / AGES < scale / self._first < AGES

    @property
    def lasting(self) -> Array:
        """(3,): by what it may be off in all images, in sizes and in scale: that of the hand, as far as sure fits have
        not told it."""
        return HAND / (1 + self._compared)

    @property
    def _shows_well(self) -> bool:
        return self._surely >= CLEAR

    @property
    def _is_due(self) -> bool:
        return self._surely % (EVERY if self._surely <= TWICE * EVERY + 1 else LATER) == 1

    def find(self, image: Bytes, expected: Array, tau: float) -> Array | None:
        """The target's place (3,) in ``image``, about where it is ``expected`` (3,), ``tau`` cycles after it was seen;
        None where it is not seen."""
        self.confirmed = False
        return self._seen(image, expected, tau)

    def as_put(self, image: Bytes, near: Array) -> Array | None:
        """As `find`, without what a lock has told of how far off the snapshot was put, and without a say in what is
        confirmed."""
        return None if self._seen(image, near, 0.0) is None else self._carried.place

    def _seen(self, image: Bytes, expected: Array, tau: float) -> Array | None:
        if not 1 / MOST < expected[2] / self._first < MOST or (self._shows_well and tau >= GONE):
            return None
        place = self._place(image, expected)
        return place if self._is_alike(tau) else None

    def compare(self, image: Bytes, place: Array, expected: Array, tau: float, sure: bool) -> Array | None:
        """As `find`, for a target that its features show at ``place`` (3,). Where that is ``sure`` nothing is told but
        learned, and in some images only. A target that does not show well and is strikingly alike, or as alike as
        usual, is believed elsewhere, too: edges in dim light are anybody's."""
        self._surely += sure
        self._turn += 1
        self.confirmed = False
        asked = self._is_due or not sure
        if not asked and not (self.is_old(place[2]) and self._turn % EVERY == 0):
            return None
        found = self._seen(image, expected, tau)
        if found is None:
            return None
        known = self.agreed >= CLEAR or (self._shows_well and self.agreed > 0)
        as_usual = known and self._is_as_usual
        off = self._off_it(place, found)
        close = bool((np.abs(off) < CLOSELY * APART).all())
        if self.is_apart(place, found):
            believed = not (sure or self._shows_well) and (as_usual or self._carried.likeness >= STRIKING)
            return found if believed and not self._is_rather(image, place) else None
        self.confirmed = as_usual and close
        if not asked or not (sure or close) and self._is_rather(image, place):
            return None
        self.agreed += 1
        rate = max(RATE, 1 / self.agreed)
        self._usual += rate * (self._carried.likeness - self._usual)
        self._usual_own += rate * (self._own_likeness - self._usual_own)
        if sure:
            self._compared += 1
            self._off = np.clip(self._off + off / (1 + self._compared), -OFF, OFF)
        return None if sure else found

    def is_apart(self, place: Array, found: Array) -> bool:
        """Whether two places (3,) cannot both be the target's."""
        return bool((np.abs(self._off_it(place, found)) >= APART).any())

    def _off_it(self, place: Array, found: Array) -> Array:
        """(3,): by how many sizes, and which logarithm of the scale, the one is off the other."""
        return np.array([*(place[:2] - found[:2]) / (self._size * place[2]), log(place[2] / found[2])])

    def _place(self, image: Bytes, expected: Array) -> Array:
        self._carried.place = expected
        told = self._carried.step(image)
        self._own_likeness = self._own.likeness_at(image, told)
        scale = told[2] * exp(self._off[2])
        return np.array([*(told[:2] + self._off[:2] * self._size * scale), scale])

    def _is_rather(self, image: Bytes, place: Array) -> bool:
        """Whether the target's inner part says that it is at a ``place`` (3,) of the lock: it is more alike there than
        where the snapshot was found, and than the whole snapshot is there. Where little of it shows, it is not."""
        off = self._off * np.array([self._size * place[2], self._size * place[2], 1.0])
        locked = self._inner.likeness_at(image, np.array([*(place[:2] - off[:2]), place[2] * exp(-off[2])]))
        found = self._inner.likeness_at(image, self._carried.place)
        return locked > max(found + BEHIND, self._carried.likeness)

    @property
    def _is_as_usual(self) -> bool:
        return self._carried.likeness >= self._usual - LESS

    def _is_alike(self, tau: float) -> bool:
        if self._own_likeness < self._usual_own - ALONE:
            return False  # what is about it is there, and it is not
        usually = self._is_as_usual if self._shows_well else self._carried.likeness >= LIKE * self._usual
        return usually and self._carried.likeness >= (LATE if tau >= GONE else LEAST)
