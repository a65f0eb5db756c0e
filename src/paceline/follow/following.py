"""From a chase-camera recording to estimates: the operator's start, the tracker, the odometry beside it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from paceline.blas import on_one_blas_thread
from paceline.documents.loading import FollowClip, load_follow
from paceline.errors import UnusableInput
from paceline.follow.configuration import VEHICLE_KEYS, FollowConfiguration
from paceline.follow.hindsight import at_once, in_hindsight
from paceline.follow.history import History
from paceline.follow.results import FollowEstimate, FollowResult, ModelWidth
from paceline.follow.tracker import FollowTracker, warm_up
from paceline.progress import Progress
from paceline.recordings.monocular import CameraFrame, CameraRecording, open_camera
from paceline.recordings.odometry import Odometry, Pose, read_odometry
from paceline.targets.line_model import target_of
from paceline.version import versions


def tracker_for(clip: FollowClip, configuration: FollowConfiguration | None = None) -> FollowTracker:
    """A tracker that begins as ``clip`` says: its camera, its target, the operator's start, the vehicle steered."""
    start = (*clip.center.tolist(), clip.scale)
    return FollowTracker(clip.camera, target_of(clip.target), start, resolved(clip, configuration))


def resolved(clip: FollowClip, configuration: FollowConfiguration | None = None) -> FollowConfiguration:
    """The configuration with what ``clip`` itself says put in. Raises UnusableInput for a path without odometry."""
    c = configuration or FollowConfiguration()
    stated = {name: value for name, key in VEHICLE_KEYS.items() if (value := getattr(clip, key)) is not None}
    goal = c.steering or ("lead" if clip.odometry is None else "path")
    if goal == "path" and clip.odometry is None:
        raise UnusableInput(f"{clip.path}: odometry: missing; expected one, as the lead's path is to be steered along")
    return c.model_copy(update={**stated, "steering": goal})


def follow(
    clip: FollowClip, recording: CameraRecording, configuration: FollowConfiguration | None = None
) -> Iterator[tuple[CameraFrame, FollowEstimate]]:
    """Every frame of ``recording`` from the operator's start on, with its estimate; in a recording that is not live a
    start in doubt is settled first (`hindsight`). Raises UnusableInput."""
    if recording.total is not None and clip.frame >= recording.total:
        raise UnusableInput(
            f"{clip.path}: start.frame: frame {clip.frame} is not in the recording; expected one of its frames "
            f"0 to {recording.total - 1}"
        )
    odometry = None if clip.odometry is None else read_odometry(clip.odometry)
    warm_up()
    tracker = tracker_for(clip, configuration)
    yield from (at_once if recording.live else in_hindsight)(tracker, _posed(clip, recording, odometry))


def estimates(
    clip: FollowClip | Path | str, configuration: FollowConfiguration | None = None
) -> Iterator[FollowEstimate]:
    """Where the target of ``clip``, a follow.yaml or what `load_follow` made of it, is at every frame, one by one::

        for estimate in paceline.follow("follow.yaml"):
            print(estimate.time, estimate.position, estimate.status)

    Raises UnusableInput.
    """
    loaded = clip if isinstance(clip, FollowClip) else load_follow(clip)
    for _, estimate in follow(loaded, open_camera(loaded), configuration):
        yield estimate


def _posed(
    clip: FollowClip, recording: CameraRecording, odometry: Odometry | None
) -> Iterator[tuple[CameraFrame, Pose | None]]:
    """The frames from the operator's start on, which has to be readable, each with the ``odometry``."""
    begun = False
    for frame in recording.frames(clip.frame):
        if not begun and frame.image is None:
            raise UnusableInput(
                f"{clip.path}: start.frame: frame {frame.index} cannot be decoded; expected one that shows the target"
            )
        begun = True
        pose = None
        if odometry is not None:
            where = odometry.at(frame.index)
            if where is None:
                raise UnusableInput(f"{clip.odometry}: has no row for frame {frame.index}; expected one for each frame")
            pose = Pose(*map(float, where))
        yield frame, pose
    if not begun:
        raise UnusableInput(f"{clip.path}: start.frame: {recording.name} ended before frame {clip.frame}")


@on_one_blas_thread
def follow_recording(
    clip: FollowClip | Path | str, configuration: FollowConfiguration | None = None, progress: Progress | None = None
) -> FollowResult:
    """Follow the target of ``clip``, a follow.yaml or what `load_follow` made of it, to the end of its recording.

    ``progress`` is called with frames done and frames in all (None where that is not known). Raises UnusableInput.
    """
    loaded = clip if isinstance(clip, FollowClip) else load_follow(clip)
    recording = open_camera(loaded)
    history = History(keep=None)
    begun = time.perf_counter()
    for _, estimate in follow(loaded, recording, configuration):
        history.add(estimate)
        if progress is not None:
            progress(estimate.frame + 1, recording.total)
    return result_of(loaded, recording, configuration, history, time.perf_counter() - begun)


def result_of(
    clip: FollowClip,
    recording: CameraRecording,
    configuration: FollowConfiguration | None,
    history: History,
    seconds: float,
) -> FollowResult:
    """What ``history`` kept of a run, with what it came from."""
    c = resolved(clip, configuration)
    return history.result(
        clip=str(clip.path),
        target=clip.target.name,
        width=ModelWidth(
            float(np.ptp(clip.target.ends[:, 0])),
            max(c.model_tolerance, clip.target.tolerance),
            clip.target.width_assumed,
        ),
        steering_goal=c.steering or "lead",
        assumed=c.assumed(),
        configuration=c.model_dump(),
        versions=versions(),
        notices=list(recording.notices),
        seconds=seconds,
    )
