"""Whether what is found can be the target that was seen before: a vehicle on a road neither leaps nor flies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from paceline.follow.features import Projection

Array = NDArray[np.float64]

UNSTEADY = 0.06  # relative error of a scale that was measured, at most
HASTE, BRAKING = 1.5, 3.0  # m/s, m/s²: by how much the distance may change otherwise than was foreseen
NODDING = 0.06  # rad by which a bump and the road's grade may turn the camera up or down
RISE = 0.3  # m by which what is measured of a target may lie higher or lower than usual
LASTING, GRADE = 0.4, 0.025  # m and rad by which it may for longer, by the road's grade, say
RATE, LATELY, LONG = 0.3, 0.2, 0.007  # of learning its height, per image: that of now, of half a second, of ten
SAME = 0.3  # sizes of the target, or relative scale, between two sights of the same

LEAPT = "what is found is farther off or nearer than the target can be by now"
ALOFT = "what is found is higher or lower than the target can be"


class Continuity:
    """Where the target was believed to be, at first at ``location`` (3,), ideal pixels and scale."""

    def __init__(self, projection: Projection, location: Array) -> None:
        self._projection = projection
        self._scale = float(location[2])
        self._drop = self._lately = self._level = projection.drop(location)
        self._sighted = location
        self.steady = True  # the last two sights were of one place, whether believed or not

    def complaint(self, location: Array, expected: Array, unseen: float) -> str:
        """Why nothing that was seen ``unseen`` s ago and is ``expected`` (3,) somewhere can be at ``location`` (3,) in
        the image at hand; to be asked once for each."""
        distance = self._projection.distance(location[2])
        before, foreseen = (self._projection.distance(s) for s in (self._scale, expected[2]))
        moved = min(abs(distance - before), abs(distance - foreseen))
        if moved > UNSTEADY * max(distance, before) + (HASTE + BRAKING * unseen) * unseen:
            return LEAPT
        drop = self._projection.drop(location)
        if abs(drop - self._drop) > RISE + NODDING * distance:
            return ALOFT
        self._lately += LATELY * (drop - self._lately)  # also of what is refused, or every other image were believed
        return ALOFT if abs(self._lately - self._level) > LASTING + GRADE * distance else ""

    def sight(self, location: Array) -> None:
        """Something like the target is seen at ``location`` (3,)."""
        size = self._projection.size(location[2])
        moved = np.abs(location - self._sighted) / (size, size, location[2])
        self.steady, self._sighted = bool(moved.max() < SAME), location

    def learn(self, location: Array) -> None:
        """The target is believed to be at ``location`` (3,)."""
        self._scale = float(location[2])
        drop = self._projection.drop(location)
        self._drop += RATE * (drop - self._drop)
        self._level += LONG * (drop - self._level)
