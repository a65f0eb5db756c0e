"""Whether a lock is on the target: other places in which the model may lie are followed beside it until one stands out.

One image often shows part of the model in several places: a window's outline where the whole rear's should be, another
vehicle beside it. But nowhere else does all of it fit, and what a place lacks it lacks in the next images as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from paceline.follow.configuration import FollowConfiguration
from paceline.follow.lock import Lock
from paceline.follow.measuring import Measurement
from paceline.follow.recognition import Look

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

REACH = 0.55  # sizes of the target by which its start may be off
PLACES, FOLLOWED = 48, 5  # that are measured in an image, and the best of them that are followed
SAME = 0.02  # of the size, in place and scale, within which two places are one
BESIDE = 0.08  # the same of two locks: the start is not in doubt by the one, and only the better one is kept
HAND_SET, CLOSE = 0.35, 0.1  # credit for being at the start, and in how many sizes from it most of that is gone
SMALL = 0.15  # power of a place's scale with which it counts
CLEAR = 0.1  # match by which another place must exceed the operator's to put it in doubt
SURE = 0.25  # credit by which a lock is behind that is given up,
SLIGHT = 0.06  # and so much more for every image: a small difference tells nothing, however long it lasts
DOUBTED = 2.0  # s for which a start may be in doubt: then the target is elsewhere, and what is there may be another
OFF = 0.06  # sizes from the start, or relative scale, at which the operator is told
LEAST = 0.35  # match of a target,
FAINT, PLACED, MOST = 0.2, 0.04, 0.7  # and of one in dim light: within so many sizes of the start so many lines agree,
# and nothing else matches as well
PATIENT = 0.5  # s after which faint lines will do where the operator put it, as nothing else has stood out
EVERY = 6  # images of which one is patrolled
PATROLS = 12  # so many times: each size once; later what fits better is another vehicle, or the target is half hidden
USUAL = 0.25  # rate at which the usual match of the lock is learned, then
BETTER = 0.1  # match by which a place must exceed that of the lock to be tried
PROVEN = 0.5  # credit at which it takes its place
TRIAL = 15  # images in which it must have reached that

DOUBT = "the start is in doubt: the model fits in more than one place"
NOWHERE = "the start is in doubt: the model fits nowhere near it"
UNTOLD = "the start was in doubt for too long: place the model again"
CORRECTED = "the start was off: the model fits better here"
SWITCHED = "the model fits better here than where it was tracked"


class Probation:
    """A ``lock`` and its rivals. It is ``pending`` until the operator's start has proved right or was corrected."""

    def __init__(self, lock: Lock, configuration: FollowConfiguration) -> None:
        self._c = configuration
        self._start = lock.expected
        self._rivals: list[Lock] = []
        self._turn = 0  # images since the start, or since it was settled
        self._usual = 0.0  # match of the lock
        self._left = 0  # images of a trial
        self._began: float | None = None  # s, when the start was looked at first
        self.lock = lock
        self.pending = configuration.probation

    @property
    def locks(self) -> list[Lock]:
        """All that are followed, the one that is believed first."""
        return [self.lock, *self._rivals]

    def judge(self, image: Bytes, time: float, look: Look) -> tuple[Look, str]:
        """Of the ``look`` that the lock has had at ``image`` the one to go by, and a note where that is another's.

        While the start is pending the look carries a complaint. All locks but the one to go by learn.
        """
        if not self._c.probation:
            return look, ""
        looks = [look, *(self._see(rival, image, time) for rival in self._rivals)]
        if self.pending:
            return self._try_start(image, time, looks)
        if self._rivals:
            return self._try_rival(time, *looks)
        self._turn += 1
        if (
            self._turn % EVERY == 0
            and self._turn <= EVERY * PATROLS
            and look.measurement is not None
            and not look.complaint
        ):
            self._patrol(image, time, look.measurement)
        return look, ""

    def resume(self) -> None:
        """The target was lost and found again: look once more whether it is elsewhere."""
        self._turn = 0

    # --- the start ---------------------------------------------------------------------------------------------------

    def _try_start(self, image: Bytes, time: float, looks: list[Look]) -> tuple[Look, str]:
        """Add up the evidence of the locks about the start; it is settled where the last one is left."""
        self._began = time if self._began is None else self._began
        if time - self._began > DOUBTED:
            self._rivals = []
            return Look(UNTOLD, looks[0].window), ""
        if not self._rivals:
            self.lock.credit, self._turn = self._near_start(looks[0], self.lock), 0
        pairs = list(zip(self.locks, looks, strict=True))
        pairs += self._newcomers(image, looks)
        if time == self._began:
            for lock, look in pairs:
                lock.by_hand = look.fit is not None and self._off(look.fit.location) < PLACED
        if self._is_good(looks[0], [look for _, look in pairs[1:]], time == self._began):
            self._turn += 1
            return self._settle(image, looks[0])
        for lock, look in pairs:
            lock.credit += self._worth(lock, look)
        leader, look = max(pairs, key=lambda pair: pair[0].credit)
        most = leader.credit
        slight = SLIGHT * self._turn
        if leader.by_hand:  # with what the hand gave it counted out
            slight = min(slight, HAND_SET)
        least = most - SURE - slight
        self._turn += 1
        rivals = [
            (lock, seen)
            for lock, seen in pairs
            if lock is not leader and lock.credit > least and self._apart(seen, look) > BESIDE
        ]
        # of those beside it the one to keep has not slid there and learned other places on its way
        there = [(lock, seen) for lock, seen in pairs if lock is leader or self._apart(seen, look) <= BESIDE]
        leader, look = max(there, key=lambda pair: (not pair[1].complaint, self._worth(*pair)))
        leader.credit, leader.by_hand = most, any(lock.by_hand for lock, _ in there)
        self.lock, self._rivals = leader, [lock for lock, _ in rivals]
        faint = leader.by_hand and time - self._began >= PATIENT
        if not rivals and not look.complaint and _match(look) >= (FAINT if faint else LEAST):
            return self._settle(image, look)
        for lock, seen in [(leader, look), *rivals]:
            if not seen.complaint:
                lock.learn(seen, time)
        return Look(DOUBT if rivals else NOWHERE, look.window), ""

    def _is_good(self, own: Look, others: list[Look], first: bool) -> bool:
        """Whether there is no doubt before any rival: the model fits where the operator put it, and nowhere clearly
        better. Hands err less than a match does among frames within frames. In the ``first`` image it may fit faintly.
        """
        if self._turn or own.complaint or own.fit is None or self._distance(own.fit.location, self._start) > BESIDE:
            return False
        elsewhere = [_match(other) for other in others if self._apart(own, other) > BESIDE]
        faint = (
            first
            and own.measurement is not None
            and own.measurement.agreeing.mean() >= MOST
            and self._distance(own.fit.location, self._start) < PLACED
            and _match(own) >= max(elsewhere, default=0.0)
        )
        return _match(own) >= max([FAINT if faint else LEAST, *(_match(other) - CLEAR for other in others)])

    def _newcomers(self, image: Bytes, looks: list[Look]) -> list[tuple[Lock, Look]]:
        """Locks on the best places about the start in the first image, and what they see; later on the best one alone,
        where it matches better than all that are followed."""
        places = self.lock.recogniser.survey(image, self._start, REACH, PLACES)
        room, least = FOLLOWED, 0.0
        if self._rivals:
            room, least, places = 1, max(map(_match, looks)) + BETTER, places[:1]
        credit = self.lock.credit  # of the one that leads
        found: list[tuple[Lock, Look]] = []
        for place in places:
            rival = self._lock_at(place)
            seen = rival.look_here(image)
            others = (*looks, *(look for _, look in found))
            if _match(seen) >= least and all(self._apart(seen, other) > SAME for other in others):
                rival.credit = credit if self._rivals else self._near_start(seen, rival)
                found.append((rival, seen))
            if len(found) == room:
                break
        return found

    def _settle(self, image: Bytes, look: Look) -> tuple[Look, str]:
        """The target is where the lock is; what that has learned on its way there may be of another place."""
        self.pending = False
        place = _place(look, self.lock)
        if self.lock.seen_at is not None:
            self.lock = self._lock_at(place)
            look = self.lock.look_here(image)
        self._usual = _match(look)
        return look, CORRECTED if self._off(place) > OFF else ""

    # --- later -------------------------------------------------------------------------------------------------------

    def _patrol(self, image: Bytes, time: float, measurement: Measurement) -> None:
        """Look through the places of one size, and the next time of another: is there more of the model?"""
        self._usual += USUAL * (measurement.match - self._usual)
        found = self.lock.recogniser.patrol(image, measurement.fit.location, REACH, self._turn // EVERY)
        if found is not None and found[1] > max(self._usual + BETTER, LEAST):
            rival = self._lock_at(found[0])
            look = rival.look_here(image)
            if not look.complaint:
                rival.learn(look, time)
                self._rivals, self._left = [rival], TRIAL

    def _try_rival(self, time: float, look: Look, seen: Look) -> tuple[Look, str]:
        """Add up by how much more of the model shows at the rival; it must prove itself before it is believed."""
        (rival,) = self._rivals
        # where the target is hidden for a moment that tells nothing of it
        usual = self._usual if look.measurement is None else look.measurement.match
        rival.credit += _match(seen) - usual - SLIGHT
        self._left -= 1
        if rival.credit > PROVEN and not seen.complaint:
            self.lock, self._rivals, self._usual = rival, [], _match(seen)
            return seen, SWITCHED
        if rival.credit < -SURE or not self._left or self._apart(seen, look) < SAME:
            self._rivals = []
        elif not seen.complaint:
            rival.learn(seen, time)
        return look, ""

    # --- both --------------------------------------------------------------------------------------------------------

    def _lock_at(self, place: Array) -> Lock:
        return Lock(place, self.lock.recogniser.afresh(), self._c)

    def _see(self, rival: Lock, image: Bytes, time: float) -> Look:
        rival.predict(time)
        return rival.look(image, False)

    def _apart(self, look: Look, other: Look) -> float:
        if look.fit is None or other.fit is None:
            return np.inf
        return self._distance(look.fit.location, other.fit.location)

    def _worth(self, lock: Lock, look: Look) -> float:
        """The match of a look, for a small place a little less: there are more of them, and more that fit by chance."""
        if look.fit is None:
            return 0.0
        # a place that is held by its picture alone shows what it did
        match = lock.recogniser.appearance.match if look.measurement is None else look.measurement.match
        return float(match * (look.fit.location[2] / self._start[2]) ** SMALL)

    def _near_start(self, look: Look, lock: Lock) -> float:
        return float(HAND_SET * np.exp(-0.5 * (self._off(_place(look, lock)) / CLOSE) ** 2))

    def _off(self, place: Array) -> float:
        return self._distance(place, self._start)

    def _distance(self, a: Array, b: Array) -> float:
        """By how many sizes of the target, or which relative difference in scale, ``a`` and ``b`` (3,) are apart."""
        size = self.lock.recogniser.projection.size(b[2])
        return float(max(np.abs(a[:2] - b[:2]).max() / size, abs(np.log(a[2] / b[2]))))


def _match(look: Look) -> float:
    return 0.0 if look.measurement is None else look.measurement.match


def _place(look: Look, lock: Lock) -> Array:
    return lock.expected if look.fit is None else look.fit.location
