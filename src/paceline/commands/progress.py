"""How far a command is, and what it sees on its way."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from paceline.console.telling import TOLD, telling, telling_estimate

if TYPE_CHECKING:
    from paceline.cameras import StereoRig
    from paceline.follow.results import FollowEstimate
    from paceline.speed.tracker import Estimate


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
        print(line, file=sys.stderr, flush=True)

    return tell


def range_teller(target: str) -> Callable[[FollowEstimate], None] | None:
    """What tells each estimate of the distance of the vehicle ahead while it is followed, where that is asked for."""
    if not is_told():
        return None

    def tell(e: FollowEstimate) -> None:
        outlines, points = ([], []) if e.status == "lost" else ([e.lines], [e.points])
        distance, std = float(e.position[2]), float(e.position_std[2])
        line = telling_estimate(target, e.frame, e.time, distance, std, e.status, outlines, points)
        print(line, file=sys.stderr, flush=True)

    return tell


@contextmanager
def progress_bar(doing: str, show: bool) -> Iterator[Callable[[int, int | None], None] | None]:
    """A progress bar on standard error, moved on by calls with (frames done, frames in all if that is known).

    A program that started the command may ask for lines instead; once it reads them no more, the command ends.
    """
    if is_told():
        yield lambda done, total: print(telling(doing, done, total), file=sys.stderr, flush=True)
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
