"""Units of speed for people: mph, km/h or m/s. Files are always in m/s."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import overload

from paceline.arrays import Array

MPS_PER_MPH, MPS_PER_KMH = 0.44704, 1 / 3.6  # exact by definition
COVERAGE_95 = 1.96  # standard deviations on each side of the 95 % interval of a normal distribution


class SpeedUnit(StrEnum):
    MPH = "mph"
    KMH = "km/h"
    MPS = "m/s"

    @property
    def mps(self) -> float:
        """One of this unit in m/s, exact by definition."""
        return {SpeedUnit.MPH: MPS_PER_MPH, SpeedUnit.KMH: MPS_PER_KMH, SpeedUnit.MPS: 1.0}[self]


def parse_unit(text: str) -> SpeedUnit:
    """The unit called ``text``; raises ValueError naming the valid ones."""
    try:
        return SpeedUnit(text.strip().lower())
    except ValueError:
        raise ValueError(f"unknown unit {text!r}; expected {', '.join(SpeedUnit)}") from None


@overload
def convert(speed_mps: float, unit: str) -> float: ...
@overload
def convert(speed_mps: Array, unit: str) -> Array: ...
def convert(speed_mps: float | Array, unit: str) -> float | Array:
    """``speed_mps`` in ``unit``, a SpeedUnit or its name; raises ValueError for an unknown one."""
    return speed_mps / parse_unit(unit).mps


def format_speed(speed_mps: float, plus_minus_mps: float, unit: str) -> str:
    """For example ``44.9 ± 0.1 mph``: rounded to the first digit of the uncertainty; ``± ?`` where that is unknown."""
    speed, plus_minus = convert(speed_mps, unit), convert(plus_minus_mps, unit)
    name = parse_unit(unit)
    if not 0 < plus_minus < math.inf:
        return f"{speed:.1f} ± ? {name}"
    plus_minus = float(f"{plus_minus:.0e}")
    decimals = max(0, -math.floor(math.log10(plus_minus)))
    return f"{speed:.{decimals}f} ± {plus_minus:.{decimals}f} {name}"
