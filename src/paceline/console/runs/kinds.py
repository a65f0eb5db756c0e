"""The kinds of runs: what each asks of the command line, and where it may write."""

from __future__ import annotations

from pathlib import Path

from paceline.console.document_names import CLIP, FOLLOW

SPEED, LIVE, AHEAD, LANES, VEHICLES = "speed", "live", "follow", "lanes", "vehicles"
KINDS = (SPEED, LIVE, AHEAD, LANES, VEHICLES)
MEASURING = (SPEED, LIVE, AHEAD)  # those that a person reads; the others propose what to draw


def document_of(kind: str) -> str:
    """The name of the document that a run of this ``kind`` goes out from."""
    return FOLLOW if kind == AHEAD else CLIP


def keeps_vehicles(kind: str) -> bool:
    """Whether a run of this ``kind`` wants to know the vehicles that are outlined; the others look for them."""
    return kind not in (LIVE, VEHICLES)


def arguments(kind: str, file: str, where: Path) -> list[str]:
    """The command for ``file``, the run's own copy of the document, such that all it writes is below ``where``."""
    if kind == LANES:
        return ["lanes", file, "-o", str(where / "site.yaml")]
    if kind == VEHICLES:  # adds to the clip.yaml that it is given
        return ["vehicles", file, "--write"]
    live = ["--live"] if kind == LIVE else []
    return [AHEAD if kind == AHEAD else SPEED, file, "-o", str(where / "out"), *live]
