"""The progress of a command as lines of text: written to standard error by the command, read by the console.

A program that starts a command requests the lines with ``PACELINE_PROGRESS=lines`` in its environment.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from paceline.arrays import Array

Item = TypeVar("Item")
Progress = Callable[[int, int | None], None]  # called with what is done and the total, None where it is unknown
# From the next activity of ACTIVITY_LABELS to a context that yields its progress callback.
Stage = Callable[[str], AbstractContextManager[Progress | None]]

PROGRESS_VARIABLE = "PACELINE_PROGRESS"  # environment variable; "lines" requests the lines
ESTIMATE_PREFIX, PICTURES_PREFIX = "estimate: ", "pictures: "
MAX_PARTICLES = 40  # particles written per view
MAX_LINE_LENGTH = 1 << 19  # characters
# What people read for an activity; the first field of its progress lines is the key, which other programs rely on.
COMPILING_ACTIVITY = "compiling"  # its progress lines count functions
ACTIVITY_LABELS = {
    COMPILING_ACTIVITY: "compiling, once after an upgrade",
    "estimating": "estimating the cameras",
    "looking": "detecting vehicles",
    "averaging": "estimating background",
    "learning": "estimating background",
    "measuring": "tracking vehicles",
    "refining": "refining the speeds",
    "following": "following the vehicle",
    "drawing": "drawing the pictures",
    "writing": "writing the report",
}
# what is counted; frames in others
ACTIVITY_UNITS = {COMPILING_ACTIVITY: "functions", "refining": "vehicles", "writing": "parts", "learning": "s"}
FRAME_ACTIVITIES = ("looking", "measuring", "following")  # that go through the frames for a result


def no_stage(activity: str) -> AbstractContextManager[Progress | None]:
    """Stages of which nobody is told."""
    return nullcontext()


def frame_stage(progress: Progress | None) -> Stage:
    """Stages of which those in FRAME_ACTIVITIES call ``progress``, with frames done and frames in all."""
    return lambda activity: nullcontext(progress if activity in FRAME_ACTIVITIES else None)


def with_progress(items: Iterable[Item], total: int, progress: Progress | None) -> Iterator[Item]:
    """The ``items``, ``total`` in number, while ``progress`` is called with how many are done."""
    for count, item in enumerate(items):
        if progress is not None:
            progress(count, total)
        yield item
    if progress is not None:
        progress(total, total)


def describe_progress(activity: str, done: int, total: int | None) -> str:
    """The progress of an ``activity`` in words, for example ``tracking vehicles: 12 of 50 frames``."""
    label, unit = ACTIVITY_LABELS.get(activity, activity), ACTIVITY_UNITS.get(activity, "frames")
    if total is None and not done:
        return label
    return f"{label}: {done} {unit}" if total is None else f"{label}: {done} of {total} {unit}"


def format_progress(activity: str, done: int, total: int | None) -> str:
    """The progress line for an activity with ``done`` of ``total`` frames processed, or of its ACTIVITY_UNITS."""
    return f"progress: {activity} {done} {total or '?'}"


def parse_progress(line: str) -> tuple[str, int, int | None] | None:
    """The activity, what is done and the total (None if unknown) of a progress line; None for any other line."""
    match = re.fullmatch(r"progress: (\S+) (\d+) (\d+|\?)\n?", line)
    return None if match is None else (match[1], int(match[2]), None if match[3] == "?" else int(match[3]))


def format_estimate(
    vehicle: str, frame: int, time: float, value: float, std: float, status: str, outlines: Sequence[Array],
    particles: Sequence[Array] = (),
) -> str:  # fmt: skip
    """The estimate line of a ``vehicle`` at one frame, before any refinement.

    ``value`` and its standard deviation are the speed (m/s) or, of a vehicle ahead, its distance (m); NaN if unknown.
    ``outlines`` hold per view either a polygon (4, 2) or line segments (S, 2, 2), ``particles`` positions (N, 2) per
    view, of which at most MAX_PARTICLES are written; all in pixels of the images as recorded.
    """
    subset = [points[:: -(-len(points) // MAX_PARTICLES) or 1] for points in particles]
    content = {
        "vehicle": vehicle,
        "frame": frame,
        "time_s": round(time, 4),
        "value": _finite_or_none(value),
        "std": _finite_or_none(std),
        "status": status,
        "outlines": [_rounded_pixels(outline) for outline in outlines],
        "particles": [_rounded_pixels(points, 2) for points in subset],
    }
    return ESTIMATE_PREFIX + json.dumps(content, separators=(",", ":"))


def parse_estimate(line: str) -> dict[str, Any] | None:
    """The content of an estimate line as `format_estimate` writes it; None for any other line."""
    if not line.startswith(ESTIMATE_PREFIX):
        return None
    try:
        content = json.loads(line.removeprefix(ESTIMATE_PREFIX))
    except ValueError:
        return None
    return (
        content
        if isinstance(content, dict) and {"vehicle", "frame", "time_s", "value", "std"} <= content.keys()
        else None
    )


def format_pictures(frame: int, time: float, size: tuple[int, int], pictures: Sequence[bytes]) -> str:
    """The pictures line of a live source at one frame: one JPEG per view; ``size`` (width, height) is that of the
    images as recorded. The estimate lines of the same frame are written before it."""
    data = [base64.b64encode(picture).decode() for picture in pictures]
    content = {"frame": frame, "time_s": round(time, 4), "size": size, "pictures": data}
    return PICTURES_PREFIX + json.dumps(content, separators=(",", ":"))


def parse_pictures(line: str) -> dict[str, Any] | None:
    """The content of a pictures line as `format_pictures` writes it, JPEGs as bytes; None for any other line."""
    if not line.startswith(PICTURES_PREFIX):
        return None
    try:
        content = json.loads(line.removeprefix(PICTURES_PREFIX))
        pictures = [base64.b64decode(data, validate=True) for data in content["pictures"]]
        width, height = map(int, content["size"])
        return {"frame": int(content["frame"]), "time_s": float(content["time_s"]), "size": [width, height],
                "pictures": pictures}  # fmt: skip
    except (ValueError, KeyError, TypeError):
        return None


def _finite_or_none(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None


def _rounded_pixels(points: Array, decimals: int = 1) -> list[Any]:
    """``points`` as rounded numbers, clipped to ± 10⁵ px so that the line stays short."""
    rounded: list[Any] = points.clip(-1e5, 1e5).round(decimals).tolist()
    return rounded
