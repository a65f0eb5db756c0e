"""What a finished run left behind, read for people: verdicts in one unit, and speeds over time."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from paceline.console.safety import NotHere, file_below
from paceline.errors import UnusableInput
from paceline.reports.wording import COVERAGE, MISSING, number, shown_speed
from paceline.units import convert

DOWNLOADS = ("report.html", "overlay.mp4", "estimates.csv", "summary.json")


@dataclass(frozen=True)
class Series:
    """One vehicle's speed over time: seconds, and m/s with the half width of its 95 % interval; ``refined`` or the
    filter's."""

    vehicle: str
    time: list[float]
    speed: list[float]
    half: list[float]
    refined: bool


def read_summary(out: Path) -> dict[str, Any]:
    """summary.json of a run. Raises UnusableInput."""
    file = out / "summary.json"
    try:
        summary = json.loads(file_below(out, file.name).read_text(encoding="utf-8"))
        return {"vehicles": list(summary["vehicles"]), "notices": list(map(str, summary["notices"]))}
    except (OSError, NotHere, ValueError, KeyError, TypeError) as error:
        raise UnusableInput(f"{file}: is no summary of a measurement") from error


def read_series(out: Path) -> list[Series]:
    """Speeds over time from estimates.csv, in order of the vehicles. Raises UnusableInput."""
    file = out / "estimates.csv"
    rows: dict[str, list[dict[str, str]]] = {}
    try:
        with file_below(out, file.name).open(newline="", encoding="utf-8") as stream:
            for row in csv.DictReader(stream):
                rows.setdefault(row["vehicle"], []).append(row)
        return [_series(vehicle, found) for vehicle, found in rows.items()]
    except (OSError, NotHere, ValueError, KeyError, TypeError) as error:
        raise UnusableInput(f"{file}: is no table of estimates") from error


def _series(vehicle: str, rows: list[dict[str, str]]) -> Series:
    refined = any(row["refined_speed_mps"] for row in rows)
    speed, std = ("refined_speed_mps", "refined_std_mps") if refined else ("speed_mps", "speed_std_mps")
    known = [row for row in rows if row[speed]]
    return Series(
        vehicle,
        [float(row["time_s"]) for row in known],
        [float(row[speed]) for row in known],
        [COVERAGE * float(row[std]) if row[std] else 0.0 for row in known],
        refined,
    )


def vehicle_rows(vehicles: list[dict[str, Any]], unit: str) -> list[dict[str, str]]:
    """A row of text per vehicle of a summary: speed, interval, frames, verdict and reason."""
    return [_row(vehicle, unit) for vehicle in vehicles]


def _row(vehicle: dict[str, Any], unit: str) -> dict[str, str]:
    speed, lo, hi = (_number(vehicle.get(key)) for key in ("speed_mps", "speed_lo_mps", "speed_hi_mps"))
    half = (hi - lo) / 2
    shown = shown_speed(speed, unit, half)
    return {
        "vehicle": str(vehicle.get("vehicle")),
        "speed": shown if shown == MISSING else f"{shown} ± {shown_speed(half, unit, half)}",
        "interval": MISSING if math.isnan(half) else f"{shown_speed(lo, unit, half)} to {shown_speed(hi, unit, half)}",
        "frames": str(vehicle.get("frames")),
        "verdict": str(vehicle.get("verdict")),
        "reason": str(vehicle.get("reason") or ""),
    }


def differences(first: list[dict[str, Any]], second: list[dict[str, Any]], unit: str) -> list[dict[str, str]]:
    """A row per vehicle that both summaries have: both speeds, and the second less the first."""
    others = {str(vehicle.get("vehicle")): vehicle for vehicle in second}
    rows = []
    for vehicle in first:
        other = others.get(str(vehicle.get("vehicle")))
        if other is not None:
            a, b = _number(vehicle.get("speed_mps")), _number(other.get("speed_mps"))
            change = round(convert(b - a, unit), 2) + 0.0  # no negative zero
            sign = "+" if change > 0 else ""
            rows.append(
                {
                    "vehicle": str(vehicle.get("vehicle")),
                    "first": _row(vehicle, unit)["speed"],
                    "second": _row(other, unit)["speed"],
                    "change": sign + number(change, 2),
                }
            )
    return rows


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
