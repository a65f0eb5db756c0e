"""The kinds of runs: what each asks of the command line, and where it may write."""

from __future__ import annotations

from pathlib import Path

from paceline.console.clip_file import without_vehicles
from paceline.console.naming import CLIP, FOLLOW

SPEED, LIVE, AHEAD, LANES, VEHICLES = "speed", "live", "follow", "lanes", "vehicles"
KINDS = (SPEED, LIVE, AHEAD, LANES, VEHICLES)
MEASURING = (SPEED, LIVE, AHEAD)  # those that a person reads; the others propose what to draw


def document_of(kind: str) -> str:
    """The name of the document that a run of this ``kind`` goes out from."""
    return FOLLOW if kind == AHEAD else CLIP


def arguments(kind: str, file: Path, where: Path) -> list[str]:
    """The command for the document ``file``, such that all it writes is below ``where``. Raises UnusableInput."""
    out = str(where / "out")
    if kind in (LIVE, VEHICLES):  # neither wants outlined vehicles, and one adds to the clip.yaml that it is given
        copy = where / CLIP
        copy.write_text(without_vehicles(file, where), encoding="utf-8")
        return ["speed", str(copy), "-o", out, "--live"] if kind == LIVE else ["vehicles", str(copy), "--write"]
    return [kind, str(file), "-o", out if kind in MEASURING else str(where / "site.yaml")]
