"""The target's height over its width in the image. A target keeps it, a rolling shutter does not: rows that are read
while a vibrating camera nods stretch or squeeze the height of what they show, in each image anew."""

from __future__ import annotations

from math import inf, isfinite, log
from typing import NamedTuple

from paceline.follow.fitting import FRESH

HEIGHT_RATIO_DRIFT = 0.002  # per cycle: of the ratio, as the lead turns and lines that stand off its rear come nearer
MAX_INNOVATION_SIGMA = 2.0  # standard deviations beyond which a ratio counts less: some lines may be others


class Aspect(NamedTuple):
    """The logarithm of the target's height over its width, over its model's, and its ``variance``, infinite before
    anything is known: the state of a Kalman filter with one unknown that hardly moves."""

    log_ratio: float = 0.0
    variance: float = inf

    def aged(self, tau: float) -> Aspect:
        """``tau`` cycles later."""
        return self._replace(variance=self.variance + tau * HEIGHT_RATIO_DRIFT**2)

    def learned(self, ratio: float, variance: float, deviation: float) -> tuple[float, Aspect]:
        """By how much, relative, its readout has stretched an image in which the target's height over its width is
        ``ratio`` times the model's, with the ``variance`` of its lines; and the aspect that takes the ratio in.
        ``deviation`` is that of the stretch, see `readout.stretch_deviation`."""
        if not isfinite(variance):
            return 0.0, self
        innovation = log(ratio) - self.log_ratio
        noise = deviation**2 + FRESH * variance
        noise *= max(1.0, innovation**2 / (MAX_INNOVATION_SIGMA**2 * (self.variance + noise)))
        gain = 1.0 - noise / (self.variance + noise)
        stretch = deviation**2 / (self.variance + noise) * innovation
        return stretch, Aspect(self.log_ratio + gain * innovation, gain * noise)
