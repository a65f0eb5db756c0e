"""Intervals in the printed tables of the commands, all by one rule."""

from __future__ import annotations

import re

INTERVAL = re.compile(r"(−?\d[\d.]*) *(±) *(\d[\d.]*)(?! %)")


def decimals(number: str) -> int:
    return len(number.partition(".")[2])


def rows_with_intervals(printed: str) -> list[str]:
    """The rows of printed tables that hold a value with its ±. That has two significant digits, and value and ± have
    as many decimals; below each other, the decimal points and the ± are aligned."""
    rows, columns = [], set()
    for row in printed.splitlines():
        for found in INTERVAL.finditer(row):
            value, _, half = found.groups()
            if row not in rows:
                rows.append(row)
            assert decimals(value) == decimals(half), row
            digits = half.replace(".", "").lstrip("0")
            assert len(digits) == 2 or ("." not in half and len(digits) > 2), row
            points = (found.start(group) + len(found[group].partition(".")[0]) for group in (1, 3))
            columns.add((found.start(2), *points))
    assert len(columns) == len({sign for sign, *_ in columns}), printed
    return rows
