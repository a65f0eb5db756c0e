"""The target's scale by its edges and by its picture. From one image to the next a picture often tells by how much the
scale has changed more finely than a handful of edges do; what scale the picture itself has, the edges tell over many
images. Which of the two jitters less has the greater say."""

from __future__ import annotations

from math import exp, log
from typing import NamedTuple

DRIFT = 0.001  # per cycle: relative standard deviation by which the picture's own scale wanders, as it is learned anew
SURPRISE = 2.0  # standard deviations beyond which the edges count less: some may have slid to others
UNKNOWN = 0.1  # relative standard deviation of the picture's scale before anything is known
JITTER = 0.01  # relative standard deviation from image to image that is supposed at first,
FINEST = 0.0005  # and at least
RECENT = 0.1  # rate at which it is learned
STEADY = 1.5  # cycles: after a longer gap nothing is told of it


class Series(NamedTuple):
    """The logarithms of the scale by one of the two, in the last two images, and the ``variance`` of its jitter."""

    last: float = 0.0
    before: float = 0.0
    images: int = 0
    variance: float = JITTER**2

    def add(self, value: float, tau: float) -> Series:
        """With the ``value`` of an image ``tau`` cycles later. What a steady motion leaves, the second difference, has
        six times the variance of a single value."""
        if tau > STEADY:
            return Series(value, value, 1, self.variance)
        variance = self.variance
        if self.images >= 2:
            bend = value - 2.0 * self.last + self.before
            bend2 = min(bend * bend / 6.0, 9.0 * variance)
            variance = max(variance + RECENT * (bend2 - variance), FINEST**2)
        return Series(value, self.last, self.images + 1, variance)


class Gauge(NamedTuple):
    """The logarithm of the target's scale by its edges over that by its picture, and its ``variance``: the state of a
    Kalman filter with one unknown that hardly moves."""

    log_ratio: float = 0.0
    variance: float = UNKNOWN**2
    edges: Series = Series()
    picture: Series = Series()

    def set(self, edges: float, picture: float, tau: float) -> tuple[float, Gauge]:
        """The scale where it is ``edges`` by the edges and ``picture`` by the picture of one image, ``tau`` cycles
        after the last one; and the gauge that takes both in."""
        by_edges, by_picture = self.edges.add(log(edges), tau), self.picture.add(log(picture), tau)
        before = self.variance + tau * DRIFT**2
        surprise = by_edges.last - by_picture.last - self.log_ratio
        noise = by_edges.variance + by_picture.variance
        noise *= max(1.0, surprise**2 / (SURPRISE**2 * (before + noise)))
        gain = before / (before + noise)
        share = by_edges.variance / (by_edges.variance + by_picture.variance + before)
        scale = exp(by_edges.last - share * surprise)
        return scale, Gauge(self.log_ratio + gain * surprise, (1.0 - gain) * before, by_edges, by_picture)

    def scale(self, picture: float) -> float:
        """The target's scale where only its ``picture`` tells one."""
        return picture * exp(self.log_ratio)

    def learned(self, rate: float) -> Gauge:
        """An image later. Where the picture was learned anew, at this ``rate``, it was with the size that the gauge
        gave the target; where it was not, the picture's own scale, which a hand has set, is trusted a little more."""
        return self._replace(log_ratio=(1.0 - rate) * self.log_ratio)
