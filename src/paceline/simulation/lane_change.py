"""Lane changes: smooth moves to the side over a stretch of the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from paceline.arrays import Array


@dataclass(frozen=True)
class LaneChange:
    """A smooth move of ``shift`` metres to the right of travel, begun after ``start`` metres and ``length`` m long.

    It is a function of the distance driven, so that the path is the same curve at any speed.
    """

    start: float
    length: float
    shift: float

    def shift_at(self, distance: ArrayLike) -> Array:
        """The part of the shift (…), m, that is done after ``distance`` (…) m."""
        return self.shift * smoothstep((np.asarray(distance) - self.start) / self.length)

    def slope_at(self, distance: ArrayLike) -> Array:
        """Metres to the right per metre driven, (…), after ``distance`` (…) m."""
        u = np.clip((np.asarray(distance) - self.start) / self.length, 0.0, 1.0)
        return np.asarray(self.shift / self.length * 30 * u**2 * (1 - u) ** 2)

    @property
    def max_slope(self) -> float:
        """The greatest size of the slope, half-way."""
        return abs(self.shift / self.length) * 15 / 8


def smoothstep(part: ArrayLike) -> Array:
    """From 0 to 1 while ``part`` (…) does so, a quintic whose first two derivatives are zero at both ends."""
    u = np.clip(part, 0.0, 1.0)
    return np.asarray(u**3 * (10 - 15 * u + 6 * u**2))
