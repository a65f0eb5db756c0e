"""The commands, one module each; `paceline.cli` gathers them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from paceline.errors import UnusableInput

DONE, NOTHING_MEASURED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130  # exit statuses


def print_columns(rows: Sequence[Sequence[str]]) -> None:
    """Prints ``rows`` with their columns aligned, the last one as it is."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    for *cells, last in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)), last]).rstrip())


def file_named(given: Path, usual: str) -> Path:
    """The file that a person means by ``given``: itself, or the ``usual`` one in a folder. Raises UnusableInput."""
    try:
        return given / usual if given.is_dir() else given
    except OSError as error:  # a name that is too long
        raise UnusableInput(f"{given}: cannot be read ({error.strerror})") from error


def refuse_read_only(file: Path, otherwise: str = "") -> None:
    """Raises UnusableInput where a person's ``file`` is not to be added to; ``otherwise`` says what to do instead."""
    if not os.access(file, os.W_OK) or not file.stat().st_mode & 0o200:
        raise UnusableInput(f"{file}: cannot be written (it is read-only); expected one to add to{otherwise}")
