"""The commands, one module each; `paceline.cli` gathers them."""

from __future__ import annotations

from collections.abc import Sequence

DONE, NOTHING_MEASURED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130  # exit statuses


def print_columns(rows: Sequence[Sequence[str]]) -> None:
    """Prints ``rows`` with their columns aligned, the last one as it is."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    for *cells, last in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)), last]).rstrip())
