"""The throttle of [NIST]'s trials: a human driver who keeps a distance to the vehicle ahead, with a delay."""

from __future__ import annotations

from collections import deque

import numpy as np

from paceline.simulation.chase.motion import SmoothNoise
from paceline.simulation.closed_loop.gap_control import GapPolicy

REACTION_DELAY_S = 0.5  # s from what is seen to the foot
GAP_GAIN, CLOSING_GAIN = 0.35, 1.6  # m/s² per metre of gap, and per m/s of closing speed
MAX_BRAKING_MPS2 = 5.0  # m/s²
MIN_HEADWAY_S = 0.5  # s: the shortest that is kept


class HumanThrottle:
    """Keeps a gap that varies smoothly within ``gaps`` (m), from the true gap and speeds `REACTION_DELAY_S` before."""

    def __init__(self, policy: GapPolicy, gaps: tuple[float, float], rng: np.random.Generator) -> None:
        self._policy, self._gaps, self._gap_variation = policy, gaps, SmoothNoise(rng, 12.0, 45.0)
        self._seen: deque[tuple[float, float, float]] = deque()  # time, gap, lead's speed

    def desired_gap(self, time: float, speed: float) -> float:
        """The gap, m, kept at ``time``, s: shorter at low speed."""
        low, high = self._gaps
        nearest = min(low + MIN_HEADWAY_S * speed, high)
        share = min(speed / self._policy.top_speed, 1.0) * 0.5 * (1 + self._gap_variation(time))
        return nearest + (high - nearest) * share

    def acceleration(self, time: float, speed: float, gap: float, lead_speed: float) -> float:
        """m/s², from the true ``gap`` (m), ``speed`` and ``lead_speed`` (m/s) at ``time``."""
        self._seen.append((time, gap, lead_speed))
        while len(self._seen) > 1 and self._seen[1][0] <= time - REACTION_DELAY_S:
            self._seen.popleft()
        _, gap, lead_speed = self._seen[0]
        command = GAP_GAIN * (gap - self.desired_gap(time, speed)) + CLOSING_GAIN * (lead_speed - speed)
        command = min(max(command, -MAX_BRAKING_MPS2), self._policy.throttle, self._policy.top_speed - speed)
        return min(command, -1.0) if speed < 0.15 and lead_speed < 0.3 else command
