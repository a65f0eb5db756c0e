"""Formats measurements as text: numbers with as many digits as their uncertainty allows, verdicts, and advice."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.speed.results import Measurement, Track
from paceline.units import COVERAGE_95, convert
from paceline.verdicts import advice_for

NO_VALUE = "–"

GENERAL_ADVICE = "Look at the overlay: the outline has to stay on the same part of the vehicle in both views."


@dataclass(frozen=True)
class SpeedText:
    """A speed and its uncertainties as text in one unit; ``±`` is always half of a 95 % interval."""

    unit: str
    speed: str
    lo: str
    hi: str
    plus_minus: str
    random: str
    systematic: str  # NO_VALUE where there is no such part, as where the calibration is exact

    @property
    def known(self) -> bool:
        return self.speed != NO_VALUE


def format_number(value: float, decimals: int) -> str:
    """``value`` with a fixed number of ``decimals``; NO_VALUE where it is not finite."""
    return f"{value:.{decimals}f}".replace("-", "−") if math.isfinite(value) else NO_VALUE


def format_speed_number(speed: float, unit: str, half_width: float = math.nan) -> str:
    """``speed`` (m/s) as a number in ``unit``: one decimal, or two when its uncertainty is below a tenth."""
    return format_number(convert(speed, unit), _decimals(convert(half_width, unit)))


def format_interval(speed: float, half_width: float, unit: str) -> str:
    """``speed`` ± ``half_width`` (m/s) as numbers in ``unit``, for example ``44.9 ± 0.1``."""
    return " ± ".join(format_speed_number(value, unit, half_width) for value in (speed, half_width))


def format_speed(measurement: Measurement, unit: str) -> SpeedText:
    """The measured speed in ``unit``, with random and systematic parts that add up (in squares) to the interval."""
    half = (measurement.speed_hi - measurement.speed_lo) / 2
    coverage = coverage_factor(measurement)
    decimals = _decimals(convert(half, unit))

    def text(value: float) -> str:
        return format_number(convert(value, unit), decimals)

    def part(value: float) -> str:
        return format_number(convert(coverage * value, unit), 2)

    return SpeedText(
        unit=unit,
        speed=text(measurement.speed),
        lo=text(measurement.speed_lo),
        hi=text(measurement.speed_hi),
        plus_minus=text(half),
        random=part(measurement.random_std),
        systematic=part(measurement.systematic_std),
    )


def format_verdict(measurement: Measurement) -> str:
    """The verdict, with its reason where there is one."""
    return f"{measurement.verdict}: {measurement.reason}" if measurement.reason else measurement.verdict


def coverage_factor(measurement: Measurement) -> float:
    """Half of the 95 % interval in standard uncertainties: more than 1.96 where these are known from few frames only.
    NaN without an interval."""
    total = float(np.sqrt(np.nansum([measurement.random_std**2, measurement.systematic_std**2])))
    return (measurement.speed_hi - measurement.speed_lo) / 2 / total if total > 0 else math.nan


def _decimals(half_width: float) -> int:
    return 2 if half_width < 0.095 else 1  # 0.095 would show as 0.1


def speed_at(measurement: Measurement, row: int) -> tuple[float, float]:
    """The best speed at one row and half of its 95 % interval, m/s: refined where there is one, else the filter's."""
    track = measurement.track
    if math.isfinite(track.refined_speed[row]):
        return float(track.refined_speed[row]), coverage_factor(measurement) * float(track.refined_std[row])
    return float(track.speed[row]), COVERAGE_95 * float(track.speed_std[row])


def distance_travelled(track: Track) -> float:
    """Metres along the tracked positions, NaN without two of them."""
    return path_length(track.position[[status == "tracking" for status in track.status]])


def path_length(points: Array) -> float:
    """Length in metres of the polyline ``points`` (M, 3), leaving out points that are not finite."""
    known = points[np.isfinite(points).all(axis=1)]
    return float(np.linalg.norm(np.diff(known, axis=0), axis=1).sum()) if len(known) > 1 else math.nan


def rejected_advice(code: str) -> str:
    """The advice for a speed that was rejected with the reason ``code``."""
    return advice_for(code) or GENERAL_ADVICE
