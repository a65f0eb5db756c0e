"""Formats measurements as text: numbers with as many digits as their uncertainty allows, verdicts, and advice."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from paceline.arrays import Array
from paceline.number_format import NO_VALUE, IntervalText, align_decimals, format_interval, format_number
from paceline.speed.results import Measurement, Track
from paceline.units import COVERAGE_95, convert
from paceline.verdicts import advice_for

FIGURE_SPACE, PUNCTUATION_SPACE = "\u2007", "\u2008"  # as wide as a digit, as a point

# of an interval, by what it comes from; that of the fit of the whole track has none
INTERVAL_LIMITATIONS = {"scatter": "interval from scatter alone", "filter": "interval from the filter's spread alone"}
GENERAL_ADVICE = "Look at the overlay: the outline has to stay on the same part of the vehicle in both views."


def format_speed(speed: float, lo: float, hi: float, unit: str) -> IntervalText:
    """``speed`` with the interval from ``lo`` to ``hi`` (m/s), in ``unit``."""
    return format_interval(convert(speed, unit), convert(lo, unit), convert(hi, unit))


def format_speed_number(speed: float, unit: str) -> str:
    """``speed`` (m/s) without an uncertainty, as a number in ``unit``."""
    return format_number(convert(speed, unit), 1)


def format_measurement(measurement: Measurement, unit: str) -> IntervalText:
    """The measured speed in ``unit``."""
    return format_speed(measurement.speed, measurement.speed_lo, measurement.speed_hi, unit)


def format_parts(measurement: Measurement, unit: str) -> tuple[str, str]:
    """The random and the systematic part of the measured speed's ±, which add up to it in squares; of a part that there
    is not, as the systematic one where the calibration is exact, NO_VALUE."""
    coverage, decimals = coverage_factor(measurement), format_measurement(measurement, unit).decimals
    random, systematic = (
        format_number(convert(coverage * std, unit), decimals)
        for std in (measurement.random_std, measurement.systematic_std)
    )
    return random, systematic


def align_for_page(texts: Sequence[str]) -> list[str]:
    """As `align_decimals`, for a page whose digits are equally wide."""
    return align_decimals(texts, FIGURE_SPACE, PUNCTUATION_SPACE)


def format_verdict(measurement: Measurement) -> str:
    """The verdict, with its reason where there is one, or with what its interval does not hold."""
    if measurement.reason:
        return f"{measurement.verdict}: {measurement.reason}"
    limitation = INTERVAL_LIMITATIONS.get(measurement.interval_from or "", "")
    return f"{measurement.verdict}, {limitation}" if limitation else measurement.verdict


def interval_title(sources: Iterable[str | None]) -> str:
    """What intervals from these ``sources`` are called: 95 % is claimed only where one holds all known errors."""
    known = {source for source in sources if source is not None}
    return "95 % interval" if "fit" in known or not known else "interval"


def recording_title(clip: str) -> str:
    """What a recording is called: the folder of its clip.yaml, or the name of a file that is called otherwise."""
    path = Path(clip)
    return path.absolute().parent.name or path.stem if path.name == "clip.yaml" else path.stem


def format_seen(times: Sequence[float] | None) -> str:
    """When a vehicle was first and last seen, in seconds, for example ``0.0 to 2.6``."""
    return NO_VALUE if times is None else " to ".join(format_number(time, 1) for time in times)


def format_limit(limit: float, unit: str) -> str:
    """A posted ``limit`` (m/s) in ``unit``, for example ``30 mph``."""
    return f"{round(convert(limit, unit), 1):g} {unit}"


def format_compliance(compliance: str | None, limit: float | None, unit: str) -> str:
    """Whether a vehicle keeps the ``limit`` (m/s), for example ``over 30 mph``; NO_VALUE where that is not known."""
    if compliance is None or limit is None:
        return NO_VALUE
    preposition = " at" if compliance == "undecided" else ""
    return f"{compliance}{preposition} {format_limit(limit, unit)}"


def count_compliance(compliance: Iterable[str | None]) -> str:
    """How many vehicles keep the limit, in a sentence; empty where that is not known of any."""
    counts = Counter(compliance)
    if not counts["within"] + counts["over"] + counts["undecided"]:
        return ""
    text = f"{counts['within']} within the limit, {counts['over']} over it"
    if counts["undecided"]:
        text += f", {counts['undecided']} undecided, as the limit lies inside the 95 % interval"
    return f"{text}."


def coverage_factor(measurement: Measurement) -> float:
    """Half of the 95 % interval in standard uncertainties: more than 1.96 where these are known from few frames only.
    NaN without an interval."""
    total = float(np.sqrt(np.nansum([measurement.random_std**2, measurement.systematic_std**2])))
    return (measurement.speed_hi - measurement.speed_lo) / 2 / total if total > 0 else math.nan


def speed_at(measurement: Measurement, row: int) -> tuple[float, float]:
    """The best speed at one row and half of its 95 % interval, m/s: refined where there is one, else the filter's."""
    track = measurement.track
    if math.isfinite(track.refined_speed[row]):
        return float(track.refined_speed[row]), coverage_factor(measurement) * float(track.refined_std[row])
    return float(track.speed[row]), COVERAGE_95 * float(track.speed_std[row])


def distance_travelled(track: Track) -> float:
    """Metres along the tracked positions, NaN without two of them."""
    return path_length(track.position[track.tracked])


def path_length(points: Array) -> float:
    """Length in metres of the polyline ``points`` (M, 3), leaving out points that are not finite."""
    known = points[np.isfinite(points).all(axis=1)]
    return float(np.linalg.norm(np.diff(known, axis=0), axis=1).sum()) if len(known) > 1 else math.nan


def rejected_advice(code: str) -> str:
    """The advice for a speed that was rejected with the reason ``code``."""
    return advice_for(code) or GENERAL_ADVICE
