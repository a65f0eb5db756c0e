"""Units of speed for people: mph, km/h or m/s. Files are always in m/s."""

from __future__ import annotations

import re
from enum import StrEnum
from typing import overload

from paceline.arrays import Array

MPS_PER_MPH, MPS_PER_KMH = 0.44704, 1 / 3.6  # exact by definition
MAX_STATED_SPEED_MPS = 150.0
SPEED_WITH_UNIT = re.compile(r"(\d+(?:\.\d+)?)\s*([a-z/]+)", re.IGNORECASE)
COVERAGE_95 = 1.959963984540054  # standard deviations on each side of the 95 % interval of a normal distribution


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


def parse_speed(text: str) -> float:
    """The speed in m/s that ``text`` states with its unit, such as ``30 mph``; raises ValueError for anything else."""
    found = SPEED_WITH_UNIT.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"expected a speed with its unit, such as 30 mph, found {text!r}")
    speed = float(found[1]) * parse_unit(found[2]).mps
    if not 0 < speed <= MAX_STATED_SPEED_MPS:
        raise ValueError(f"expected a speed above 0 and up to {MAX_STATED_SPEED_MPS:g} m/s, found {text!r}")
    return speed


@overload
def convert(speed_mps: float, unit: str) -> float: ...
@overload
def convert(speed_mps: Array, unit: str) -> Array: ...
def convert(speed_mps: float | Array, unit: str) -> float | Array:
    """``speed_mps`` in ``unit``, a SpeedUnit or its name; raises ValueError for an unknown one."""
    return speed_mps / parse_unit(unit).mps
