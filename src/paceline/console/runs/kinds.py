"""The kinds of runs: the command line of each, and where it may write."""

from __future__ import annotations

from pathlib import Path

from paceline.console.document_references import CLIP_FILE, FOLLOW_FILE

SPEED_RUN, LIVE_RUN, FOLLOW_RUN, LANES_RUN, VEHICLES_RUN = "speed", "live", "follow", "lanes", "vehicles"
RUN_KINDS = (SPEED_RUN, LIVE_RUN, FOLLOW_RUN, LANES_RUN, VEHICLES_RUN)
MEASURING_KINDS = (
    SPEED_RUN,
    LIVE_RUN,
    FOLLOW_RUN,
)  # whose results are shown; the others propose paths or vehicles to the editor


def document_of(kind: str) -> str:
    """The name of the document that a run of this ``kind`` reads."""
    return FOLLOW_FILE if kind == FOLLOW_RUN else CLIP_FILE


def keeps_vehicles(kind: str) -> bool:
    """Whether a run of this ``kind`` uses the outlined vehicles; the others detect vehicles."""
    return kind not in (LIVE_RUN, VEHICLES_RUN)


def command_arguments(kind: str, file: str, folder: Path) -> list[str]:
    """Arguments of the command for ``file``, the run's copy of the document; it writes only below ``folder``."""
    if kind == LANES_RUN:
        return ["lanes", file, "-o", str(folder / "site.yaml")]
    if kind == VEHICLES_RUN:  # adds vehicles to the clip.yaml itself
        return ["vehicles", file, "--in-place"]
    live = ["--live"] if kind == LIVE_RUN else []
    return [FOLLOW_RUN if kind == FOLLOW_RUN else SPEED_RUN, file, "-o", str(folder / "out"), *live]
