"""The commands, one module each; `paceline.cli` gathers them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from paceline.errors import UnusableInput


def print_columns(rows: Sequence[Sequence[str]]) -> None:
    """Prints ``rows`` with their columns aligned, the last one as it is."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    for *cells, last in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)), last]).rstrip())


def file_named(path: Path, default_name: str) -> Path:
    """``path``, or the file ``default_name`` in it where it is a folder. Raises UnusableInput."""
    try:
        return path / default_name if path.is_dir() else path
    except OSError as error:  # a name that is too long
        raise UnusableInput(f"{path}: cannot be read ({error.strerror})") from error


def refuse_read_only(file: Path, otherwise: str = "") -> None:
    """Raises UnusableInput where ``file`` is read-only; ``otherwise`` names the alternative."""
    if not os.access(file, os.W_OK) or not file.stat().st_mode & 0o200:
        raise UnusableInput(f"{file}: cannot be written (it is read-only); expected one to add to{otherwise}")
