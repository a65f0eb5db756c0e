"""How a command tells the program that started it how far it is: lines on standard error, if these are asked for."""

from __future__ import annotations

import re

TOLD = "PACELINE_PROGRESS"  # environment variable; "lines" asks for lines


def telling(doing: str, done: int, total: int | None) -> str:
    """The line that says that ``done`` frames of ``total`` are through."""
    return f"progress: {doing} {done} {total or '?'}"


def told(line: str) -> tuple[str, int, int | None] | None:
    """What a command does, frames done and frames in all, if ``line`` says how far it is."""
    found = re.fullmatch(r"progress: (\S+) (\d+) (\d+|\?)\n?", line)
    return None if found is None else (found[1], int(found[2]), None if found[3] == "?" else int(found[3]))
