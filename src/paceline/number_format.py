"""Formats numbers as text: those with an uncertainty have as many digits as it allows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

NO_VALUE = "–"
SIGNIFICANT_DIGITS = 2  # of a ±


@dataclass(frozen=True)
class IntervalText:
    """A value with its 95 % interval as text: ``±``, half of the interval, has two significant digits, and all numbers
    have as many decimals as it has. NO_VALUE where a number is not known."""

    value: str
    plus_minus: str
    lo: str
    hi: str
    decimals: int

    @property
    def known(self) -> bool:
        return self.value != NO_VALUE

    @property
    def ends(self) -> str:
        """For example ``44.90 to 45.07``."""
        return NO_VALUE if self.lo == NO_VALUE else f"{self.lo} to {self.hi}"

    def __str__(self) -> str:
        """For example ``44.98 ± 0.09``."""
        return f"{self.value} ± {self.plus_minus}" if self.known else NO_VALUE


def format_number(value: float, decimals: int) -> str:
    """``value`` with a fixed number of ``decimals``; NO_VALUE where it is not finite."""
    return f"{value:z.{decimals}f}".replace("-", "−") if math.isfinite(value) else NO_VALUE


def significant_decimals(half_width: float) -> int:
    """The decimals that give ``half_width`` SIGNIFICANT_DIGITS, or 1 where it is not known."""
    if not math.isfinite(half_width) or half_width == 0:
        return 1
    exponent = int(f"{half_width:.{SIGNIFICANT_DIGITS - 1}e}".partition("e")[2])
    return max(SIGNIFICANT_DIGITS - 1 - exponent, 0)


def format_interval(value: float, lo: float, hi: float) -> IntervalText:
    """``value`` with the interval from ``lo`` to ``hi``. The ends are what value and ± as shown add up to, unless the
    value is not in the middle."""
    half = (hi - lo) / 2
    decimals = significant_decimals(half)
    if abs(lo + hi - 2 * value) < 10.0**-decimals:
        value, half = round(value, decimals), round(half, decimals)
        lo, hi = value - half, value + half
    middle, plus_minus, low, high = (format_number(number, decimals) for number in (value, half, lo, hi))
    return IntervalText(middle, plus_minus, low, high, decimals)


def format_uncertain(value: float, half_width: float) -> str:
    """``value`` ± ``half_width`` as text."""
    return str(format_interval(value, value - half_width, value + half_width))


def format_half_width(half_width: float) -> str:
    """A ± that stands alone, with SIGNIFICANT_DIGITS."""
    return format_number(half_width, significant_decimals(half_width))


def align_decimals(texts: Sequence[str], pad: str = " ", pad_point: str = " ") -> list[str]:
    """``texts`` of numbers and words between spaces, padded so that the decimal points of each place are in one column;
    ``pad`` is as wide as a digit and ``pad_point`` as a point."""
    rows = [text.split(" ") for text in texts]
    for i in range(max(map(len, rows), default=0)):
        parts = [row[i].partition(".") if i < len(row) else ("", "", "") for row in rows]
        before, after = (max(len(part[side]) for part in parts) for side in (0, 2))
        for row, (integer, point, fraction) in zip(rows, parts, strict=True):
            if i < len(row):
                missing_point = pad_point if after and not point else ""
                missing = pad * (after - len(fraction))
                row[i] = f"{pad * (before - len(integer))}{integer}{point}{missing_point}{fraction}{missing}"
    return [" ".join(row) for row in rows]
