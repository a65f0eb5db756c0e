"""The progress of a command: a bar for people, or lines for a program that reads them."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from paceline.progress import (
    ACTIVITY_LABELS,
    ACTIVITY_UNITS,
    COMPILING_ACTIVITY,
    PROGRESS_VARIABLE,
    Progress,
    Stage,
    format_estimate,
    format_pictures,
    format_progress,
)

if TYPE_CHECKING:
    from paceline.cameras import StereoRig
    from paceline.detection.tracks import DetectionTrack
    from paceline.follow.results import FollowEstimate
    from paceline.recordings.live_stereo import RawPair
    from paceline.recordings.monocular import CameraFrame, Grey
    from paceline.speed.filter.estimate import Estimate

PICTURE_INTERVAL_S = 0.5  # time between the pictures lines of a live source
MAX_PICTURE_AREA_PX = 480 * 360  # two JPEGs of pure noise still fit into one line
LINE_JPEG_QUALITY = 70


def lines_requested() -> bool:
    """Whether the program that started this command requests progress lines."""
    return os.environ.get(PROGRESS_VARIABLE) == "lines"


def speed_line_writer(rig: StereoRig) -> Callable[[str, Estimate], None] | None:
    """The callback that writes an estimate line for each estimate of a vehicle's speed; None if no lines are
    requested."""
    if not lines_requested():
        return None

    def write(vehicle: str, e: Estimate) -> None:
        views = zip(rig.cameras, (e.left, e.right), (e.particles_left, e.particles_right), strict=True)
        outlines, particles = zip(*((c.distort_points(o), c.distort_points(p)) for c, o, p in views), strict=True)
        line = format_estimate(vehicle, e.frame, e.time, e.speed, e.speed_std, e.status, outlines, particles)
        _write_line(line)

    return write


def range_line_writer(target: str, live: bool) -> Callable[[CameraFrame, FollowEstimate], None] | None:
    """The callback that writes an estimate line for each estimate of the distance of the vehicle ahead and, for a
    ``live`` camera, a pictures line every PICTURE_INTERVAL_S; None if no lines are requested."""
    if not lines_requested():
        return None
    next_time = 0.0

    def write(frame: CameraFrame, e: FollowEstimate) -> None:
        nonlocal next_time
        outlines, points = ([], []) if e.status == "lost" else ([e.lines], [e.points])
        distance, std = float(e.position[2]), float(e.position_std[2])
        _write_line(format_estimate(target, e.frame, e.time, distance, std, e.status, outlines, points))
        if live and frame.image is not None and (time_s := time.monotonic()) >= next_time:
            next_time = time_s + PICTURE_INTERVAL_S
            height, width = frame.image.shape
            _write_line(format_pictures(frame.index, frame.time, (width, height), small_jpegs(frame.image)))

    return write


def live_line_writer(rig: StereoRig) -> Callable[[RawPair, list[DetectionTrack]], bool] | None:
    """The callback that writes, every PICTURE_INTERVAL_S, what the cameras of a live survey show: an estimate line for
    each vehicle in view, with its approximate speed, and a pictures line. It returns whether it has written them; None
    if no lines are requested."""
    if not lines_requested():
        return None
    from paceline.survey.live import last_outline

    next_time = 0.0

    def write(pair: RawPair, tracks: list[DetectionTrack]) -> bool:
        nonlocal next_time
        if (time_s := time.monotonic()) < next_time:
            return False
        next_time = time_s + PICTURE_INTERVAL_S
        lane_counts: Counter[str] = Counter()
        for track in tracks:
            lane = track.first.lane.name
            lane_counts[lane] += 1
            name = lane if lane_counts[lane] == 1 else f"{lane} ({lane_counts[lane]})"
            outlines = [c.distort_points(o) for c, o in zip(rig.cameras, last_outline(track), strict=True)]
            speed = abs(track.motion.speed)
            _write_line(format_estimate(name, pair.index, pair.time, speed, float("nan"), "seen", outlines))
        pictures = small_jpegs(pair.left, pair.right)
        _write_line(format_pictures(pair.index, pair.time, rig.left.image_size, pictures))
        return True

    return write


def small_jpegs(*views: Grey) -> list[bytes]:
    """The ``views`` (H, W), reduced to at most MAX_PICTURE_AREA_PX each, as JPEG."""
    import cv2

    jpegs = []
    for image in views:
        scale = min((MAX_PICTURE_AREA_PX / image.size) ** 0.5, 1.0)
        size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale < 1 else image
        jpegs.append(bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, LINE_JPEG_QUALITY])[1]))
    return jpegs


def write_progress(activity: str, done: int, total: int | None) -> None:
    """Writes a progress line; arguments as in `format_progress`."""
    _write_line(format_progress(activity, done, total))


def _write_line(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


@contextmanager
def progress_bar(activity: str, show: bool) -> Iterator[Progress | None]:
    """A progress bar on standard error; yields what advances it, called with what is done and the total if known.

    A program that requests lines gets progress lines instead; when it stops reading them, the command ends.
    """
    if lines_requested():
        yield lambda done, total: write_progress(activity, done, total)
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

    from paceline.numba_cache import compilations

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.1f} {unit}/s" if task.speed else "")

    label, unit = ACTIVITY_LABELS.get(activity, activity), ACTIVITY_UNITS.get(activity, "frames")
    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(unit), Rate()]
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None)

        def report(count: int) -> None:
            text = f"{COMPILING_ACTIVITY}, once: function {count + 1}"
            bar.update(task, description=text, refresh=True)

        with compilations(report):
            yield lambda done, total: bar.update(task, completed=done, total=total, description=label)


@contextmanager
def progress_stages(quiet: bool) -> Iterator[Stage]:
    """The stages of a command: with progress bars, which show what is compiled, too, where standard error is a terminal
    and the command is not ``quiet``; elsewhere with one notice of that."""
    show = sys.stderr.isatty() and not quiet
    with compilation_notice(not (quiet or show)):
        yield lambda activity: progress_bar(activity, show)


@contextmanager
def compilation_notice(show: bool) -> Iterator[None]:
    """Writes a line once something has to be compiled within the context, if to ``show``; a program that requests
    progress lines gets one for each function."""
    from paceline.numba_cache import compilations

    def report(count: int) -> None:
        if lines_requested():
            write_progress(COMPILING_ACTIVITY, count + 1, None)
        elif show and count == 0:
            _write_line(f"{ACTIVITY_LABELS[COMPILING_ACTIVITY]}; it takes up to a minute")

    with compilations(report):
        yield
