"""Whether the target is seen, coasted over or lost, and why."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Bytes
from paceline.follow.configuration import FollowConfiguration

EVERY = 8  # only every eighth row of an image is looked at to tell whether it shows anything
DARK, BRIGHT, FLAT = 4, 251, 3  # grey levels: a black and a white image, and one without contrast
CONFIRM = 3  # frames in a row that must show a target that was lost before it is believed
TWICE, BRIEF = 2, 0.25  # and one that was only hidden, for so many s


class Picture:
    """Tells whether an image shows anything new."""

    def __init__(self) -> None:
        self._last: Bytes | None = None

    def fault(self, image: Bytes | None) -> str:
        """Why ``image`` cannot be used; empty for one that can."""
        if image is None:
            return "the frame could not be read"
        rows = image[::EVERY]
        last, self._last = self._last, rows.copy()
        low, high = int(rows.min()), int(rows.max())
        if high <= DARK:
            return "the picture is black"
        if low >= BRIGHT:
            return "the picture is white"
        if high - low <= FLAT:
            return "the picture has no contrast"
        if last is not None and np.array_equal(rows, last):
            return "the picture is frozen: the same as the one before"
        return ""


class Belief:
    """The state machine tracking → coasting → lost → tracking again, by what each frame shows.

    A target that is not seen is coasted over for ``coast_limit`` seconds; after that it is lost, and believed again
    only when it was seen in several frames in a row.
    """

    def __init__(self, configuration: FollowConfiguration) -> None:
        self._limit = configuration.coast_limit
        self._confirm = CONFIRM if configuration.appearance else 1
        self._unseen_since: float | None = None
        self._streak = 0
        self._seen = False
        self.status = "tracking"

    @property
    def lost(self) -> bool:
        return self.status == "lost" or (self._streak > 0 and not self._seen)

    def step(self, time: float, complaint: str, steady: bool = True, sure: bool = False) -> tuple[str, str]:
        """The status and its reason at ``time``, s, with the target seen, or not seen because of ``complaint``;
        ``steady``: where the frame before has shown it; ``sure``: as well as ever."""
        if complaint:
            self._streak = 0
            if self._unseen_since is None:
                self._unseen_since = time
            gone = time - self._unseen_since
            self.status = "lost" if gone > self._limit or self.status == "lost" else "coasting"
            return self.status, complaint
        if self.status == "tracking":
            self._seen = True
            return "tracking", ""
        gone = 0.0 if self._unseen_since is None else time - self._unseen_since
        self._streak = self._streak + 1 if steady else 1
        if self._streak < self._needed(0.0 if sure else gone):
            return self.status, "something like the target is seen again; waiting to be sure"
        self._seen = True
        was, self.status, self._streak, self._unseen_since = self.status, "tracking", 0, None
        return "tracking", f"reacquired after {gone:.1f} s {'lost' if was == 'lost' else 'of coasting'}"

    def rest(self, last: float, time: float) -> None:
        """The clock goes back from ``last`` to ``time``, s."""
        if self._unseen_since is not None:
            self._unseen_since += time - last

    def _needed(self, gone: float) -> int:
        """How many frames in a row must show a target that was not seen for ``gone`` s."""
        if self.status == "lost" or not self._seen:
            return self._confirm
        return min(TWICE, self._confirm) if gone > BRIEF else 1
