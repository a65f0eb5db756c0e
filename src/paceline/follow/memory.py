"""What is remembered of how the target has looked in an image in which it was believed, and where a hand has put it."""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

from paceline.arrays import Array, Bytes
from paceline.follow import fitting
from paceline.follow.carrying import UPRIGHT, Carried
from paceline.follow.features import Projection
from paceline.follow.fitting import Fit
from paceline.follow.judgement import Foreseen
from paceline.follow.snapshot import RIGHT, WITHIN, Snapshot

NEAR = 0.01  # sizes within which a snapshot's parts are where the whole is


class Told(NamedTuple):
    """Where a snapshot has the target: at ``place`` (3,), ideal pixels and scale, to within ``doubt`` (3,), another
    error in each image, and ``lasting`` (3,), the same in all; ``apart``: the lock has it elsewhere, or nowhere."""

    place: Array
    doubt: Array
    lasting: Array
    apart: bool


class Memory:
    """The last snapshot of a target, and the last that the lock took which a hand has begun, whatever locks came then.
    The target is looked for up to ``reach`` (2,) px from where it is expected."""

    def __init__(self, projection: Projection, reach: Array) -> None:
        self._projection, self._reach = projection, reach
        self._last: Snapshot | None = None
        self._by_hand: Snapshot | None = None

    def afresh(self) -> Memory:
        """Another one, of nothing but where a hand has put the target."""
        other = copy(self)
        other._last = None
        return other

    def told(self, image: Bytes, fit: Fit | None, foreseen: Foreseen, sure: bool) -> Told | None:
        """Where the last snapshot has the target in ``image`` (H, W), in which the lock has seen it by its ``fit``, for
        ``sure`` or not, or has not, None; None where it has no say. To be asked once for each image, as it learns."""
        if self._last is None:
            return None
        if fit is None:
            place = self._last.find(image, foreseen.location, foreseen.tau)
        else:
            place = self._last.compare(image, fit.location, foreseen.location, foreseen.tau, sure)
        if place is None:
            return None
        sizes = self._projection.sizes(place[2])
        apart = fit is None or self._last.is_apart(fit.location, place)
        return Told(place, RIGHT * sizes, self._last.lasting * sizes, apart)

    def remember(self, image: Bytes, fit: Fit, foreseen: Foreseen, clear: bool, proven: bool) -> None:
        """Take a snapshot of what features have shown in ``image`` (H, W) by their ``fit``, the first one at the mean
        of that and of where it was foreseen; another one where the target is of another size by now, and its features
        have ``proven`` to show it and do so in a ``clear`` way, or the last snapshot has confirmed them."""
        place, last = fit.location, self._last
        if last is None:  # where it was put, by a hand mostly
            place = fitting.combined(fit, foreseen.location, foreseen.doubt).location
        elif not (proven and last.is_old(place[2]) and (clear or last.confirmed)):
            return
        self._last = self._snapshot(image, place, last)
        if self._by_hand in (None, last):  # the lock is the one that a hand has begun
            self._by_hand = self._last

    def anchor(self, image: Bytes, place: Array) -> None:
        """A hand has put the target at ``place`` (3,) in ``image`` (H, W)."""
        self._last = self._by_hand = self._snapshot(image, place)

    def as_put(self, image: Bytes, near: Array) -> Array | None:
        """Where (3,) in ``image`` (H, W) a hand would have put the target, by what it looked like in the lock that one
        has begun; None where that is not seen about ``near`` (3,)."""
        return None if self._by_hand is None else self._by_hand.as_put(image, near)

    def _snapshot(self, image: Bytes, place: Array, last: Snapshot | None = None) -> Snapshot:
        near = NEAR * self._projection.sizes(place[2])[:2]
        whole = Carried(image, self._projection, place, self._reach, UPRIGHT, evened=True)
        own = Carried(image, self._projection, place, near, evened=True)
        inner = Carried(image, self._projection, place, near, grown=WITHIN)
        return Snapshot(whole, own, inner, self._projection.size(1.0), last)
