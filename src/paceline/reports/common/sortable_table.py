"""Tables of a page that its reader can sort, without a script: by the ranks of their rows, which CSS puts in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from paceline.number_format import NO_VALUE

Key = float | str | None  # what a column is sorted by; None, where there is nothing, comes last


@dataclass(frozen=True)
class Cell:
    """The text of a cell, and a ``link`` or a picture (JPEG) where there is one."""

    text: str
    link: str = ""
    picture: bytes | None = None


@dataclass(frozen=True)
class Column:
    """A column of a table; ``name`` is a word of its own, ``keys`` are those that it is sorted by, if any."""

    name: str
    title: str
    cells: Sequence[Cell]
    keys: Sequence[Key] | None = None


@dataclass(frozen=True)
class SortableTable:
    """Columns of equal length, in the order of the page; ``notes``, one for each row, are shown below it, or are
    empty."""

    columns: Sequence[Column]
    notes: Sequence[str]

    @property
    def sortable(self) -> list[Column]:
        return [column for column in self.columns if column.keys is not None]

    @property
    def rows(self) -> list[tuple[str, tuple[Cell, ...], str]]:
        """The cells and the note of each row, after its ranks as custom properties of CSS."""
        ranks = {}
        for column in self.sortable:
            ranks[f"up-{column.name}"] = rank(column.keys or [])
            ranks[f"down-{column.name}"] = rank(column.keys or [], downwards=True)
        cells = list(zip(*(column.cells for column in self.columns), strict=True))
        styles = [";".join(f"--{name}:{places[row]}" for name, places in ranks.items()) for row in range(len(cells))]
        return list(zip(styles, cells, self.notes, strict=True))


def text_column(name: str, title: str, texts: Sequence[str], keys: Sequence[Key] | None = None) -> Column:
    """A column of plain ``texts``, sorted by themselves unless ``keys`` are given."""
    own = [None if text == NO_VALUE else text for text in texts]
    return Column(name, title, [Cell(text) for text in texts], own if keys is None else keys)


def rank(keys: Sequence[Key], downwards: bool = False) -> list[int]:
    """The place of each of ``keys`` among them all, from 1 on; equal ones keep their order, and where there is nothing
    comes last in either direction."""
    known = [row for row, key in enumerate(keys) if key is not None and key == key]  # NaN does not equal itself
    order = sorted(known, key=lambda row: _order(keys[row]), reverse=downwards)
    order += sorted({*range(len(keys))} - {*known})
    ranks = [0] * len(keys)
    for place, row in enumerate(order, start=1):
        ranks[row] = place
    return ranks


def _order(key: Key) -> tuple[float, str]:
    """What puts the known keys of one column, numbers or texts, in order."""
    return (0.0, key) if isinstance(key, str) else (key or 0.0, "")
