"""How a command tells the program that started it how far it is and what it sees: lines on standard error, if asked."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from paceline.arrays import Array

Progress = Callable[[int, int | None], None]  # called with frames done and frames in all, None where nobody knows

TOLD = "PACELINE_PROGRESS"  # environment variable; "lines" asks for lines
ESTIMATE, PICTURES = "estimate: ", "pictures: "
PARTICLES = 40  # of each view that are told
LONGEST = 1 << 19  # characters of a line


def telling(doing: str, done: int, total: int | None) -> str:
    """The line that says that ``done`` frames of ``total`` are through."""
    return f"progress: {doing} {done} {total or '?'}"


def told(line: str) -> tuple[str, int, int | None] | None:
    """What a command does, frames done and frames in all, if ``line`` says how far it is."""
    found = re.fullmatch(r"progress: (\S+) (\d+) (\d+|\?)\n?", line)
    return None if found is None else (found[1], int(found[2]), None if found[3] == "?" else int(found[3]))


def telling_estimate(
    vehicle: str, frame: int, time: float, value: float, std: float, status: str, outlines: Sequence[Array],
    particles: Sequence[Array] = (),
) -> str:  # fmt: skip
    """The line that says what is known of a ``vehicle`` at a frame, before anything is refined.

    ``value`` and its standard deviation are the speed (m/s) or, of a vehicle ahead, its distance (m); NaN where not
    known. ``outlines`` hold per view either a polygon (4, 2) or line segments (S, 2, 2), ``particles`` places (N, 2)
    per view, of which PARTICLES are told; all in pixels of the images as recorded.
    """
    thinned = [places[:: -(-len(places) // PARTICLES) or 1] for places in particles]
    content = {
        "vehicle": vehicle, "frame": frame, "time_s": round(time, 4), "value": _known(value), "std": _known(std),
        "status": status, "outlines": [_pixels(o) for o in outlines], "particles": [_pixels(p, 2) for p in thinned],
    }  # fmt: skip
    return ESTIMATE + json.dumps(content, separators=(",", ":"))


def told_estimate(line: str) -> dict[str, Any] | None:
    """What `telling_estimate` was told, if ``line`` says it."""
    if not line.startswith(ESTIMATE):
        return None
    try:
        found = json.loads(line.removeprefix(ESTIMATE))
    except ValueError:
        return None
    return found if isinstance(found, dict) and {"vehicle", "frame", "time_s", "value", "std"} <= found.keys() else None


def telling_pictures(frame: int, time: float, size: tuple[int, int], pictures: Sequence[bytes]) -> str:
    """The line with what a live source shows in a frame: one JPEG per view, of pictures that are ``size`` (width,
    height) as recorded. The estimates of this frame have been told before."""
    data = [base64.b64encode(picture).decode() for picture in pictures]
    content = {"frame": frame, "time_s": round(time, 4), "size": size, "pictures": data}
    return PICTURES + json.dumps(content, separators=(",", ":"))


def told_pictures(line: str) -> dict[str, Any] | None:
    """What `telling_pictures` was told, the JPEGs as bytes, if ``line`` says it."""
    if not line.startswith(PICTURES):
        return None
    try:
        found = json.loads(line.removeprefix(PICTURES))
        pictures = [base64.b64decode(data, validate=True) for data in found["pictures"]]
        width, height = map(int, found["size"])
        return {"frame": int(found["frame"]), "time_s": float(found["time_s"]), "size": [width, height],
                "pictures": pictures}  # fmt: skip
    except (ValueError, KeyError, TypeError):
        return None


def _known(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None


def _pixels(places: Array, decimals: int = 1) -> list[Any]:
    """Rounded pixels; those that no camera can show, as a number would not, are left where the picture is not."""
    found: list[Any] = places.clip(-1e5, 1e5).round(decimals).tolist()
    return found
