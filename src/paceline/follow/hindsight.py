"""What the first frames of a recording showed, if the operator's start is in doubt there: once later ones have told
where the target is, they are looked at again. A live camera's estimates cannot wait for that."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from paceline.errors import UnusableInput
from paceline.follow.results import FollowEstimate
from paceline.follow.start import PLACED, distance
from paceline.follow.steering import Pose
from paceline.follow.tracker import FollowTracker
from paceline.monocular import CameraFrame

Seen = tuple[CameraFrame, Pose | None, FollowEstimate]

AGAIN = "the start was in doubt here: looked at again when it was settled"


def in_hindsight(
    tracker: FollowTracker, frames: Iterable[tuple[CameraFrame, Pose | None]]
) -> Iterator[tuple[CameraFrame, FollowEstimate]]:
    """The ``frames`` with the estimates of a ``tracker`` that has seen none yet; those of a start in doubt are kept
    until it is settled, or given up. Raises UnusableInput as the tracker does, after what was kept."""
    kept: list[Seen] = []
    try:
        for frame, pose in frames:
            kept.append((frame, pose, tracker.update(frame.image, frame.time, frame.index, pose)))
            if not tracker.probation.undecided:
                yield from _settled(tracker, kept)
                kept = []
    except UnusableInput:
        yield from _as_seen(kept)
        raise
    yield from _as_seen(kept)


def _as_seen(seen: list[Seen]) -> Iterator[tuple[CameraFrame, FollowEstimate]]:
    return ((frame, estimate) for frame, _, estimate in seen)


def _settled(tracker: FollowTracker, seen: list[Seen]) -> Iterator[tuple[CameraFrame, FollowEstimate]]:
    """What was ``seen`` up to the frame that settled the start. From where it has proved to be in the first frame the
    others are followed anew, and that is believed if it leads to where the ``tracker`` is."""
    *doubtful, (last, pose, settled) = seen
    if doubtful and tracker.probation.first is not None:
        anew = tracker.beginning_at(tracker.probation.first)
        again = [(f, p, anew.update(f.image, f.time, f.index, p)) for f, p, _ in doubtful]
        there = anew.update(last.image, last.time, last.index, pose)
        apart = distance(_place(there), _place(settled), tracker.lock.recogniser)
        if there.status == settled.status == "tracking" and apart < PLACED:
            doubtful = [(f, p, replace(e, reason=e.reason or AGAIN)) for f, p, e in again]
    yield from _as_seen([*doubtful, (last, pose, settled)])


def _place(estimate: FollowEstimate) -> NDArray[np.float64]:
    return np.array([*estimate.center, estimate.scale])
