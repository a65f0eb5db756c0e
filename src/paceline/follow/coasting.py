"""Where a target is that is not seen: it goes on at its last velocity, in metres.

The scale of a vehicle that comes nearer grows faster and faster, so its motion in the image tells nothing for long; its
range falls at a speed that changes by braking only.
"""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array
from paceline.follow.pace import theil_sen

LEARNED_S = 1.0  # of sights from which the velocity is taken
MIN_SIGHTS = 4
MIN_RANGE_M = 0.5
BRAKING_STD_MPS2 = 4.5  # of either vehicle's acceleration: full braking, 9 m/s², is two standard deviations


class Coasting:
    """Remembers where the target was measured of late: (time, position), positions (3,) in the camera's axes, m.

    ``travelled`` is how far the chase vehicle has come by its poses, m, so that its own braking is known.
    """

    def __init__(self) -> None:
        self._times: list[float] = []
        self._positions: list[Array] = []

    def learn(self, time: float, position: Array, travelled: float) -> None:
        """The target is measured at ``position`` (3,) at ``time``, s."""
        kept = [k for k, t in enumerate(self._times) if time - LEARNED_S <= t < time]
        self._times = [*(self._times[k] for k in kept), time]
        self._positions = [*(self._positions[k] for k in kept), position + np.array([0.0, 0.0, travelled])]

    def position(self, time: float, travelled: float) -> tuple[Array, float] | None:
        """The expected position (3,) at ``time``, s, and the standard deviation of its range, m, by the velocity; None
        where too little was seen. It stays before the camera."""
        if len(self._times) < MIN_SIGHTS:
            return None
        times, positions = np.array(self._times), np.array(self._positions)
        last = times[-1]
        places, velocity = np.array([theil_sen(times, p, last) for p in positions.T]).T
        residual = positions[:, 2] - places[2] - velocity[2] * (times - last)
        scatter = 1.4826 * float(np.median(np.abs(residual)))
        ahead, lever = time - last, (time - times.mean()) / times.std()
        std = np.hypot(scatter * np.sqrt((1.0 + lever**2) / len(times)), 0.5 * BRAKING_STD_MPS2 * ahead**2)
        expected = places + velocity * ahead - np.array([0.0, 0.0, travelled])
        expected[2] = max(expected[2], MIN_RANGE_M)
        return expected, float(std)
