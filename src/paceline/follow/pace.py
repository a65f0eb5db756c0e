"""Whether what is found again drives as the target can have driven since it was seen: no vehicle falls back by metres
within a second or two and is as fast as before at the end of it."""

from __future__ import annotations

from math import copysign, hypot, sqrt
from typing import NamedTuple

import numpy as np

from paceline.arrays import Array
from paceline.recordings.odometry import Pose
from paceline.robust_line import theil_sen_slope

PAUSE = 0.5  # s for which a target was not seen, after which it is asked
LATELY, OFTEN = 1.0, 6  # s before, from which its speed is known, if it was seen for half of them and so often
WATCHED, LEAST = 0.5, 3  # s, and sights, that tell the speed of what is found,
LONGER = 1.0  # s, and so long more are taken: the first ones may be wrong
BROKEN, AFTER = 0.3, 3.0  # s without a sight, after which the next may be of something else, and is,
FASTEST = 40.0  # m/s, and beyond
STEADY = 2.0  # m/s², if what was found has not gone on by then at about its speed
EASILY, HARD = 1.5, 3.0  # m/s² that need no look at the speed, and that no vehicle changes its speed by, and back
RELATIVE = 2.0  # times as much where the chase vehicle's motion is not known: it brakes as well
GAINED = 2.0  # m/s that it gets back of its speed, or loses, where it is to be what is found
OFF, FASTER = 0.06, 1.0  # relative error of a distance, and error of a speed, m/s
DRIVES = "what is found drives as the target cannot have driven since"


class Sight(NamedTuple):
    """At ``time``, s, something was at a ``place``, m along the way."""

    time: float
    place: float


def needed(ahead: float, faster: float, lasting: float) -> tuple[float, float]:
    """The least acceleration, m/s², with which a vehicle is ``ahead`` m of where its speed would have taken it in
    ``lasting`` s, and in the end ``faster``, m/s: kept all the way, it changes its sign once. And by how much its speed
    has changed the other way by then, m/s."""
    q = 2.0 * ahead - lasting * faster
    acceleration = (abs(q) + hypot(q, lasting * faster)) / lasting**2
    if acceleration == 0.0:
        return 0.0, 0.0
    back = 0.5 * (lasting - faster * copysign(1.0, q or faster) / acceleration)
    return acceleration, acceleration * min(max(back, 0.0), lasting)


class Pace:
    """How far along its way the target was seen, and what may be the target since: places are m along the chase
    vehicle's way, where that is known by its poses."""

    def __init__(self) -> None:
        self.travelled = 0.0
        self._pose: Pose | None = None
        self._seen: list[Sight] = []  # believed, of late
        self._found: list[Sight] = []  # since, of one thing: the first sights of it,
        self._latest: list[Sight] = []  # and the latest

    def move(self, pose: Pose | None) -> None:
        """The chase vehicle is at a ``pose`` now."""
        if pose is None:
            return
        if self._pose is not None:
            self.travelled += hypot(pose.x - self._pose.x, pose.y - self._pose.y)
        self._pose = pose

    def learn(self, time: float, distance: float) -> None:
        """At ``time``, s, the target is seen ``distance`` m ahead."""
        self._seen = [seen for seen in self._seen if time - LATELY <= seen.time < time]
        self._seen.append(Sight(time, self.travelled + distance))
        self._found, self._latest = [], []

    def complains(self, time: float, distance: float) -> bool:
        """Whether what is found at ``time``, s, and ``distance`` m ahead is not, or not yet, to be believed."""
        off, harder = OFF * distance, RELATIVE if self._pose is None else 1.0
        here = Sight(time, self.travelled + distance)
        if not self._goes_on(here, off, harder * STEADY):
            self._found, self._latest = [], []
        first = self._found[0] if self._found else here
        if time - first.time <= LONGER or len(self._found) < LEAST:
            self._found.append(here)
        self._latest = [*(sight for sight in self._latest if time - sight.time <= WATCHED), here]
        if len(self._seen) < OFTEN or self._seen[-1].time - self._seen[0].time < 0.5 * LATELY:
            return False
        last = self._seen[-1].time
        if first.time - last < PAUSE:
            return False
        place, speed = _motion(self._seen, last)
        begins, found_speed = _motion(self._found, first.time) if len(self._found) >= LEAST else (first.place, speed)
        lasting = first.time - last
        ahead, off = begins - place - speed * lasting, sqrt(2.0) * off  # it was seen before, too
        if 2.0 * max(abs(ahead) - off, 0.0) / lasting**2 < harder * EASILY:
            return False
        if time - first.time < WATCHED or len(self._found) < LEAST:
            return True
        faster = found_speed - speed
        ways = [needed(ahead - a, faster + f, lasting) for a in (-off, 0.0, off) for f in (-FASTER, 0.0, FASTER)]
        return all(acceleration > harder * HARD and gained > GAINED for acceleration, gained in ways)

    def _goes_on(self, here: Sight, off: float, steady: float) -> bool:
        """Whether what was found is what is found ``here``."""
        if not self._latest:
            return False
        gap = here.time - self._latest[-1].time
        if 0.0 < gap <= BROKEN:
            return abs(here.place - self._latest[-1].place) < 2.0 * off + FASTEST * gap
        if len(self._latest) < LEAST or not 0.0 < gap <= AFTER:
            return False
        place, _ = _motion(self._latest, here.time)
        return abs(here.place - place) < off + FASTER * gap + 0.5 * steady * gap**2


def _motion(seen: list[Sight], time: float) -> tuple[float, float]:
    """The place at a ``time`` and the speed, by the medians of Theil and Sen: what hides the target, or has just hidden
    it, makes single sights metres wrong."""
    times, places = np.array(seen).T
    return theil_sen(times, places, time)


def theil_sen(times: Array, places: Array, time: float) -> tuple[float, float]:
    """The place at a ``time`` and the speed by ``places`` (N,) at ``times`` (N,): medians (Theil 1950, Sen 1968)."""
    speed = theil_sen_slope(times, places)
    return float(np.median(places - speed * (times - time))), speed
