"""How far a command is, and what it sees on its way."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from paceline.progress import TOLD, Progress, telling, telling_estimate, telling_pictures

if TYPE_CHECKING:
    from paceline.cameras import StereoRig
    from paceline.detection.tracks import Track
    from paceline.follow.results import FollowEstimate
    from paceline.recordings.live_stereo import RawPair
    from paceline.recordings.monocular import CameraFrame, Grey
    from paceline.speed.filter.estimate import Estimate

EVERY = 0.5  # s between the pictures of a live source that are told
AREA = 480 * 360  # px of each; as JPEG, two of them stay below the longest line even where they are noise
QUALITY = 70


def is_told() -> bool:
    """Whether a program that started the command asks for lines."""
    return os.environ.get(TOLD) == "lines"


def speed_teller(rig: StereoRig) -> Callable[[str, Estimate], None] | None:
    """What tells each estimate of a vehicle's speed while it is measured, where that is asked for."""
    if not is_told():
        return None

    def tell(vehicle: str, e: Estimate) -> None:
        views = zip(rig.cameras, (e.left, e.right), (e.particles_left, e.particles_right), strict=True)
        outlines, particles = zip(*((c.distort_points(o), c.distort_points(p)) for c, o, p in views), strict=True)
        line = telling_estimate(vehicle, e.frame, e.time, e.speed, e.speed_std, e.status, outlines, particles)
        _say(line)

    return tell


def range_teller(target: str, live: bool) -> Callable[[CameraFrame, FollowEstimate], None] | None:
    """What tells each estimate of the distance of the vehicle ahead while it is followed, and of a ``live`` camera now
    and then what it shows, where that is asked for."""
    if not is_told():
        return None
    due = 0.0

    def tell(frame: CameraFrame, e: FollowEstimate) -> None:
        nonlocal due
        outlines, points = ([], []) if e.status == "lost" else ([e.lines], [e.points])
        distance, std = float(e.position[2]), float(e.position_std[2])
        _say(telling_estimate(target, e.frame, e.time, distance, std, e.status, outlines, points))
        if live and frame.image is not None and (now := time.monotonic()) >= due:
            due = now + EVERY
            height, width = frame.image.shape
            _say(telling_pictures(frame.index, frame.time, (width, height), small_pictures(frame.image)))

    return tell


def live_teller(rig: StereoRig) -> Callable[[RawPair, list[Track]], bool] | None:
    """What tells, now and then, what the cameras of a live survey show, with what moves along the ways and about how
    fast it is, where that is asked for. It returns whether it has told it now."""
    if not is_told():
        return None
    from paceline.survey.live import last_seen

    due = 0.0

    def tell(pair: RawPair, tracks: list[Track]) -> bool:
        nonlocal due
        if (now := time.monotonic()) < due:
            return False
        due = now + EVERY
        seen: Counter[str] = Counter()
        for track in tracks:
            way = track.first.way.name
            seen[way] += 1
            name = way if seen[way] == 1 else f"{way} ({seen[way]})"
            outlines = [c.distort_points(o) for c, o in zip(rig.cameras, last_seen(track), strict=True)]
            speed = abs(track.speed)
            _say(telling_estimate(name, pair.index, pair.time, speed, float("nan"), "seen", outlines))
        pictures = small_pictures(pair.left, pair.right)
        _say(telling_pictures(pair.index, pair.time, rig.left.image_size, pictures))
        return True

    return tell


def small_pictures(*views: Grey) -> list[bytes]:
    """The ``views`` (H, W) as small JPEGs."""
    import cv2

    found = []
    for view in views:
        scale = min((AREA / view.size) ** 0.5, 1.0)
        size = max(1, round(view.shape[1] * scale)), max(1, round(view.shape[0] * scale))
        small = cv2.resize(view, size, interpolation=cv2.INTER_AREA) if scale < 1 else view
        found.append(bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]))
    return found


def tell_progress(doing: str, done: int, total: int | None) -> None:
    """Tells how far a command is."""
    _say(telling(doing, done, total))


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


@contextmanager
def progress_bar(doing: str, show: bool) -> Iterator[Progress | None]:
    """A progress bar on standard error, moved on by calls with (frames done, frames in all if that is known).

    A program that started the command may ask for lines instead; once it reads them no more, the command ends.
    """
    if is_told():
        yield lambda done, total: tell_progress(doing, done, total)
        return
    if not show:
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.1f} frames/s" if task.speed else "")

    columns = [TextColumn(doing), BarColumn(), MofNCompleteColumn(), TextColumn("frames"), Rate()]
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
