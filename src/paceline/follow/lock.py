"""One account of where the target is: how it moves, and what it looks like there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from paceline.arrays import Array, Bytes
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.continuity import Continuity
from paceline.follow.motion import CYCLE, SURPRISE, MotionModels
from paceline.follow.recognition import Look, Recogniser

HAND = 0.015  # share of the target's size by which an operator's start may be off
FLOOR = 0.3  # px: no prediction is taken to be better than that
SCALE_FLOOR = 0.003  # nor of the scale, relative


class Lock:
    """Follows the target from ``location`` (3,), ideal pixels and scale, which is known as well as a hand sets it.

    ``expected`` (3,) is where it is predicted in the image looked at last, to within ``doubt`` (3,), ``tau`` cycles
    after it was seen.
    """

    def __init__(self, location: Array, recogniser: Recogniser, configuration: FollowConfiguration) -> None:
        self._c = configuration
        self.seen_at: float | None = None
        self.motion = MotionModels(location, HAND * recogniser.projection.sizes(location[2]), configuration)
        self.recogniser = recogniser
        self.expected, self.doubt = self.motion.predict(0.0)
        self.tau = 0.0
        self.continuity = Continuity(recogniser.projection, location)

    def afresh(self, location: Array) -> Lock:
        """Another one, at ``location`` (3,), that has not learned anything."""
        return Lock(location, self.recogniser.afresh(), self._c)

    def predict(self, time: float) -> None:
        """Stage 6: where the target is expected at ``time``, s."""
        self.tau = self._cycles(time)
        self.expected, self.doubt = self.motion.predict(self.tau)

    @property
    def foregone(self) -> Array:
        """(3,): how far its motion would have taken it beyond where it is expected, had it been trusted to go on."""
        return self.motion.foregone(self.tau)

    def look(self, image: Bytes, lost: bool) -> Look:
        """Stages 7 and 1 to 4 where the target is expected; ``lost``: it may be anywhere."""
        look = self.recogniser.look(image, self.expected, self.doubt, self.tau, lost)
        if look.fit is None or look.slid:
            return look
        self.continuity.sight(look.fit.location)
        if look.complaint or self.seen_at is None or not self._c.continuity:
            return look
        complaint = self.continuity.complaint(look.fit.location, self.expected, self.tau * CYCLE)
        return replace(look, complaint=complaint) if complaint else look

    def look_here(self, image: Bytes) -> Look:
        """Stages 1 to 4 where the target is expected and nowhere else: a search would find what lies beside it."""
        return self.recogniser.look_at(image, self.expected, self.doubt)

    def learn(self, look: Look, time: float) -> None:
        """Stage 5 with what a look at ``time``, s, has measured, and what the target looks like."""
        assert look.fit is not None
        x, weights = look.fit.location, look.fit.weights
        if self._c.adaptive_decay:
            # (17) says how well the features agree, the covariance also how well they determine each parameter
            weights = 1.0 / np.sqrt(look.fit.covariance.diagonal())
            surprise = float((x[2] - self.expected[2]) / self.doubt[2])
            weights[2] *= min(1.0, SURPRISE / max(abs(surprise), 1e-9))
            self.motion.compare_scale(surprise)
        if look.slid or self.tau * CYCLE > self._c.jump_limit:
            self.motion.restart(x, weights)
        self.motion.observe(x, weights, self.tau, np.array([FLOOR, FLOOR, SCALE_FLOOR * x[2]]))
        self.seen_at = time
        self.continuity.learn(x)
        self.recogniser.learn(look)

    def rest(self, last: float, time: float) -> None:
        """The time jumps from ``last`` to ``time``, s: nothing is known of the motion since."""
        expected, _ = self.motion.predict(self._cycles(last))
        self.motion.restart(expected, np.ones(3))
        if self.seen_at is not None:
            self.seen_at = time - CYCLE

    def _cycles(self, time: float) -> float:
        return 0.0 if self.seen_at is None else (time - self.seen_at) / CYCLE
