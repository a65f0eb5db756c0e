"""Whether a lock is on the target: first the operator's start is on trial, and later other places in which more of the
model shows are tried beside the lock.

One image often shows part of the model in several places: a window's outline where the whole rear's should be, another
vehicle beside it. But nowhere else does all of it fit, and what a place lacks it lacks in the next images as well.
"""

from __future__ import annotations

from paceline.arrays import Array, Bytes
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.lock import Lock
from paceline.follow.nested import Nested, handicap
from paceline.follow.recognition import Look
from paceline.follow.start import LEAST, REACH, Start, distance, match_of

EVERY = 6  # images of which one is patrolled
PATROLS = 12  # so many times: each size once; later what fits better is another vehicle, or the target is half hidden
NEARBY = 0.2  # sizes of the target and relative scale within which a lock may have slid: farther off is another
USUAL = 0.25  # rate at which the usual match of the lock is learned, then
BETTER = 0.1  # match by which a place must exceed that of the lock to be tried
SLIGHT = 0.06  # difference of two matches that tells nothing, however long it lasts
SURE = 0.25  # credit by which a rival is behind that is given up,
PROVEN = 0.5  # and at which it takes the lock's place
TRIAL = 15  # images in which it must have reached that
SAME = 0.02  # of the size, in place and scale, within which two places are one

SWITCHED = "the model fits better here than where it was tracked"


class Probation:
    """A ``lock`` and its rival. It is ``pending`` until the operator's start has proved right or was corrected."""

    def __init__(self, lock: Lock, configuration: FollowConfiguration) -> None:
        self._c = configuration
        self._start = Start(lock)
        self._rival: Lock | None = None
        self._turn = 0  # images since the start was settled
        self._usual = 0.0  # match of the lock
        self._left = 0  # images of a trial
        self._credit = 0.0  # of the rival
        self.lock = lock
        self._nested = Nested(lock.recogniser.projection.target)
        self.pending = configuration.probation

    @property
    def locks(self) -> list[Lock]:
        """All that are followed, the one that is believed first."""
        return [self.lock] if self._rival is None else [self.lock, self._rival]

    @property
    def first(self) -> Array | None:
        """Where (3,) the start has proved to be in the first image that it was judged by; None where it is pending, or
        was in no doubt."""
        return self._start.first

    def judge(self, image: Bytes, time: float, look: Look) -> tuple[Look, str]:
        """Of the ``look`` that the lock has had at ``image`` the one to go by, and a note where that is another's.

        While the start is pending the look carries a complaint. The rival learns.
        """
        if not self._c.probation:
            return look, ""
        if self.pending:
            look, note = self._start.judge(image, time, look)
            self.lock, self.pending = self._start.lock, self._start.pending
            self._usual = match_of(look)
            return look, note
        if look.slid:
            self._nested.forget()
        if self._rival is not None:
            return self._try(self._rival, image, time, look)
        if look.measurement is not None and not look.complaint:
            place = self._nested.better(image, look.measurement.fit.location, self.lock.recogniser)
            if place is not None:
                return self._moved(place, image, look)
        self._turn += 1
        if (
            self._turn % EVERY == 0
            and self._turn <= EVERY * PATROLS
            and look.measurement is not None
            and look.fit is not None
            and not look.complaint
        ):
            self._patrol(image, time, look.fit.location, look.measurement.match)
        return look, ""

    def resume(self) -> None:
        """The target was lost and found again: look once more whether it is elsewhere."""
        self._turn = 0
        self._nested.forget()

    def _patrol(self, image: Bytes, time: float, here: Array, match: float) -> None:
        """Look through the places of one size, and the next time of another: is there more of the model than what
        ``match`` there is ``here`` (3,)?"""
        recogniser = self.lock.recogniser
        self._usual += USUAL * (match - self._usual)
        found = recogniser.patrol(image, here, REACH, self._turn // EVERY)
        if found is None or distance(found[0], here, recogniser) > NEARBY:
            return
        if found[1] > max(self._usual + BETTER, LEAST):
            rival = self.lock.afresh(found[0])
            look = rival.look_here(image)
            if not look.complaint:
                rival.learn(look, time)
                self._rival, self._left, self._credit = rival, TRIAL, 0.0

    def _try(self, rival: Lock, image: Bytes, time: float, look: Look) -> tuple[Look, str]:
        """Add up by how much more of the model shows at the rival, less what it has to for being farther from where a
        hand has put the target; it must prove itself before it is believed."""
        seen = rival.look(image, False)
        # where the target is hidden for a moment that tells nothing of it
        usual = self._usual if look.measurement is None else look.measurement.match
        self._credit += match_of(seen) - usual - SLIGHT
        if seen.fit is not None:
            here = self.lock.expected if look.fit is None or look.complaint else look.fit.location
            self._credit -= max(handicap(image, here, seen.fit.location, self.lock.recogniser), 0.0)
        self._left -= 1
        if self._credit > PROVEN and not seen.complaint:
            self.lock, self._rival, self._usual = rival, None, match_of(seen)
            self._nested.forget()
            return seen, SWITCHED
        if self._credit < -SURE or not self._left or self._is_same(seen, look):
            self._rival = None
        elif not seen.complaint:
            rival.learn(seen, time)
        return look, ""

    def _moved(self, place: Array, image: Bytes, look: Look) -> tuple[Look, str]:
        """The lock goes to a ``place`` (3,) a line beside, unless the target is not there now."""
        lock = self.lock.afresh(place)
        seen = lock.look_here(image)
        if seen.complaint:
            return look, ""
        self.lock, self._usual = lock, match_of(seen)
        return seen, SWITCHED

    def _is_same(self, look: Look, other: Look) -> bool:
        if look.fit is None or other.fit is None:
            return False
        return distance(look.fit.location, other.fit.location, self.lock.recogniser) < SAME
