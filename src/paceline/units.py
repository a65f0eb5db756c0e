"""Units of speed for people: mph, km/h or m/s. Files are always in m/s."""

from __future__ import annotations

from enum import StrEnum
from typing import overload

from paceline.arrays import Array

MPS_PER_MPH, MPS_PER_KMH = 0.44704, 1 / 3.6  # exact by definition
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


@overload
def convert(speed_mps: float, unit: str) -> float: ...
@overload
def convert(speed_mps: Array, unit: str) -> Array: ...
def convert(speed_mps: float | Array, unit: str) -> float | Array:
    """``speed_mps`` in ``unit``, a SpeedUnit or its name; raises ValueError for an unknown one."""
    return speed_mps / parse_unit(unit).mps
