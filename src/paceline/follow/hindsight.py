"""What the first frames of a recording showed, if the operator's start is in doubt there: once later ones have told
where the target is, they are looked at again. A live camera's estimates cannot wait for that."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from paceline.follow.results import FollowEstimate
from paceline.follow.start import BESIDE, DOUBTED, distance
from paceline.follow.tracker import FollowTracker
from paceline.recordings.monocular import CameraFrame
from paceline.recordings.odometry import Pose

Told = tuple[CameraFrame, FollowEstimate]

MOST = 150  # frames that are kept, for `DOUBTED` s at most
AGAIN = "the start was in doubt here: looked at again when it was settled"


def at_once(tracker: FollowTracker, frames: Iterable[tuple[CameraFrame, Pose | None]]) -> Iterator[Told]:
    """The ``frames`` with the estimates of a ``tracker``, each as soon as it is made."""
    return ((frame, tracker.update(frame.image, frame.time, frame.index, pose)) for frame, pose in frames)


def in_hindsight(tracker: FollowTracker, frames: Iterable[tuple[CameraFrame, Pose | None]]) -> Iterator[Told]:
    """The ``frames`` with the estimates of a ``tracker`` that has seen none yet; the first ones are kept back while the
    start is in doubt, unless that takes too long. What is raised on the way is raised after what was kept."""
    told = at_once(tracker, frames)
    yield from _first_ones(tracker, told)
    yield from told


def _first_ones(tracker: FollowTracker, told: Iterator[Told]) -> Iterator[Told]:
    """What is ``told`` up to the frame that ends the doubt."""
    kept: list[Told] = []
    try:
        for each in told:
            kept.append(each)
            if not _is_in_doubt(tracker, kept):
                break
    except Exception:
        yield from kept
        raise
    yield from _settled(tracker, kept)


def _is_in_doubt(tracker: FollowTracker, kept: list[Told]) -> bool:
    """Whether the start is, and not for too long: pictures that show nothing tell nothing of it."""
    elapsed = kept[-1][0].time - kept[0][0].time
    return tracker.probation.pending and 0.0 <= elapsed <= DOUBTED and len(kept) < MOST


def _settled(tracker: FollowTracker, seen: list[Told]) -> list[Told]:
    """What was ``seen`` up to the frame that settled the start, now followed from where that has proved to be in the
    first one; believed if this leads to where the ``tracker`` is. The steering stays: nothing was known then of where
    the target is."""
    if len(seen) < 2 or tracker.probation.first is None:
        return seen
    anew = tracker.beginning_at(tracker.probation.first)
    again = [anew.update(frame.image, frame.time, frame.index) for frame, _ in seen]
    if not _is_same(again[-1], seen[-1][1], tracker):
        return seen
    return [
        (frame, replace(e, reason=AGAIN, steering=old.steering))
        if old.status != "tracking" and e.status == "tracking"
        else (frame, old)
        for (frame, old), e in zip(seen, again, strict=True)
    ]


def _is_same(estimate: FollowEstimate, other: FollowEstimate, tracker: FollowTracker) -> bool:
    """Whether both track the target, at the same place."""
    if estimate.status != "tracking" or other.status != "tracking":
        return False
    return distance(_place(estimate), _place(other), tracker.lock.recogniser) < BESIDE


def _place(estimate: FollowEstimate) -> NDArray[np.float64]:
    return np.array([*estimate.center, estimate.scale])
