"""Reads the results of a run for display: verdicts in one unit, and speeds or distances over time."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from paceline.console.confinement import NotFound, file_below
from paceline.errors import UnusableInput
from paceline.number_format import NO_VALUE, IntervalText, format_number
from paceline.reports.common.formatting import (
    INTERVAL_LIMITATIONS,
    align_for_page,
    format_compliance,
    format_seen,
    format_speed,
    rejected_advice,
)
from paceline.reports.speed.tables import OUTLINES_FOLDER, PICTURES_FOLDER
from paceline.units import COVERAGE_95, convert

RESULT_FILES = {  # of a run, with the text of their links
    "report.html": "Open the report",
    "vehicles.csv": "Every vehicle (CSV)",
    "estimates.csv": "Every frame (CSV)",
    "track.csv": "Every frame (CSV)",
    "summary.json": "Summary (JSON)",
    "overlay.mp4": "Video with the outlines",
}
PICTURE_FOLDERS = (PICTURES_FOLDER, OUTLINES_FOLDER)
MAX_CHART_VALUES = 1500  # values of one series; longer ones are subsampled evenly
TAIL_BYTES = 256 << 10  # bytes that are read from the end of a growing table
MAX_LIVE_SERIES = 12  # number of latest vehicles of a growing table that are shown


@dataclass(frozen=True)
class Series:
    """One vehicle over time: seconds, its speed (m/s) or distance (m), and the half-width of the 95 % interval;
    ``refined`` or the filter's estimates."""

    vehicle: str
    time: list[float]
    value: list[float]
    half: list[float]
    refined: bool


def read_summary(out: Path) -> dict[str, Any]:
    """The vehicles and notices in the summary.json of a run; ``unmeasured`` are the reasons of vehicles that a live run
    saw and could not measure. Raises UnusableInput."""
    file = out / "summary.json"
    try:
        summary = json.loads(file_below(out, file.name).read_text(encoding="utf-8"))
        return {
            "vehicles": list(summary["vehicles"]),
            "notices": list(map(str, summary["notices"])),
            "unmeasured": [str(passage["reason"]) for passage in summary.get("unmeasured", [])],
        }
    except (OSError, NotFound, ValueError, KeyError, TypeError) as error:
        raise UnusableInput(f"{file}: is no summary of a measurement") from error


def nothing_measured_reason(out: Path) -> str:
    """Why a run measured nothing: the first reason or notice in its summary.json."""
    try:
        summary = json.loads(file_below(out, "summary.json").read_text(encoding="utf-8"))
        reasons = [f"{v['vehicle']}: {v['reason']}" for v in summary.get("vehicles", []) if v.get("reason")]
        reasons += [f"not measured: {passage['reason']}" for passage in summary.get("unmeasured", [])]
        reasons += [*summary.get("reasons", {}), *summary.get("notices", [])]
    except (OSError, NotFound, ValueError, KeyError, TypeError, AttributeError):
        return ""
    return str(reasons[0]) if reasons else "no vehicle passed that could be measured"


def picture_name(stem: str, folder: str = PICTURES_FOLDER) -> str:
    """A vehicle's picture in a ``folder`` of PICTURE_FOLDERS, relative to the output folder; in a live run ``stem`` is
    the vehicle's id."""
    return f"{folder}/{stem}.jpg"


def has_outlines(out: Path, stem: str) -> bool:
    """Whether a run has written the outlines of the vehicle with this ``stem``."""
    try:
        file_below(out, picture_name(stem, OUTLINES_FOLDER))
    except NotFound:
        return False
    return True


def picture_stem(vehicle: dict[str, Any]) -> str | None:
    """That of the picture that a summary names for a ``vehicle``; None where there is none."""
    name = str(vehicle.get("picture") or "")
    stem = name.removeprefix(f"{PICTURES_FOLDER}/").removesuffix(".jpg")
    return stem if stem and "/" not in stem and picture_name(stem) == name else None


def result_files(out: Path) -> dict[str, str]:
    """The existing files of a run, with the text of their links."""
    files = {}
    for name, text in RESULT_FILES.items():
        with suppress(NotFound):
            file_below(out, name)
            files[name] = text
    return files


def read_series(out: Path, growing: bool = False) -> list[Series]:
    """Speeds over time from estimates.csv, in order of the vehicles; of a ``growing`` table those of the latest ones.
    Raises UnusableInput."""
    file = out / "estimates.csv"
    rows: dict[str, list[dict[str, str]]] = {}
    try:
        for row in _read_rows(file_below(out, file.name), TAIL_BYTES if growing else None):
            rows.setdefault(row["vehicle"], []).append(row)
        return [
            _speed_series(vehicle, vehicle_rows)
            for vehicle, vehicle_rows in list(rows.items())[-MAX_LIVE_SERIES if growing else 0 :]
        ]
    except (OSError, NotFound, ValueError, KeyError, TypeError) as error:
        raise UnusableInput(f"{file}: is no table of estimates") from error


def read_range_series(out: Path, target: str) -> list[Series]:
    """The distance ahead over time from track.csv, where the ``target`` was tracked. Raises UnusableInput."""
    file = out / "track.csv"
    try:
        rows = [row for row in _read_rows(file_below(out, file.name)) if row["status"] == "tracking" and row["z_m"]]
        return [_series_of_columns(target, rows, "z_m", "z_std_m", True)]
    except (OSError, NotFound, ValueError, KeyError, TypeError) as error:
        raise UnusableInput(f"{file}: is no table of a vehicle ahead") from error


def _read_rows(file: Path, tail: int | None = None) -> Iterator[dict[str, str]]:
    """The complete rows of a table; with ``tail``, those in its last ``tail`` bytes."""
    with file.open("rb") as stream:
        head = stream.readline()
        if tail is not None and (size := file.stat().st_size) > len(head) + tail:
            stream.seek(size - tail)
            stream.readline()
        rows = stream.read()
    text = (head + rows[: rows.rfind(b"\n") + 1]).decode("utf-8", "replace")
    yield from csv.DictReader(io.StringIO(text, newline=""))


def _speed_series(vehicle: str, rows: list[dict[str, str]]) -> Series:
    refined = any(row["refined_speed_mps"] for row in rows)
    columns = ("refined_speed_mps", "refined_std_mps") if refined else ("speed_mps", "speed_std_mps")
    return _series_of_columns(vehicle, rows, *columns, refined)


def _series_of_columns(vehicle: str, rows: list[dict[str, str]], value: str, std: str, refined: bool) -> Series:
    known = [row for row in rows if row[value]]
    known = known[:: -(-len(known) // MAX_CHART_VALUES) or 1]
    return Series(
        vehicle,
        [float(row["time_s"]) for row in known],
        [float(row[value]) for row in known],
        [COVERAGE_95 * float(row[std]) if row[std] else 0.0 for row in known],
        refined,
    )


def read_follow_summary(out: Path) -> dict[str, Any]:
    """The displayed parts of the summary.json of a run that followed a vehicle. Raises UnusableInput."""
    file = out / "summary.json"
    try:
        summary = json.loads(file_below(out, file.name).read_text(encoding="utf-8"))
        distance = summary["range_m"]
        return {
            "target": str(summary["target"]),
            "frames": int(summary["frames"]),
            "share": float(summary["tracked_share"]),
            "status": {name: int(summary["status"][name]) for name in ("tracking", "coasting", "lost")},
            "range": [_number_or_nan(distance[key]) for key in ("min", "mean", "max")],
            "reasons": {str(reason): int(count) for reason, count in summary["reasons"].items()},
            "notices": list(map(str, summary["notices"])),
        }
    except (OSError, NotFound, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UnusableInput(f"{file}: is no summary of a vehicle ahead") from error


def vehicle_rows(vehicles: list[dict[str, Any]], unit: str) -> list[dict[str, str]]:
    """A row of text per vehicle of a summary: speed, interval, limit, lane, direction, time, verdict and more."""
    texts = [_speed_text(vehicle, unit) for vehicle in vehicles]
    speeds, intervals = align_for_page([str(text) for text in texts]), align_for_page([text.ends for text in texts])
    compliance = [format_compliance(v.get("compliance"), _number_or_none(v.get("limit_mps")), unit) for v in vehicles]
    return [_vehicle_row(*row) for row in zip(vehicles, speeds, intervals, compliance, strict=True)]


def _speed_text(vehicle: dict[str, Any], unit: str) -> IntervalText:
    speed, lo, hi = (_number_or_nan(vehicle.get(key)) for key in ("speed_mps", "speed_lo_mps", "speed_hi_mps"))
    return format_speed(speed, lo, hi, unit)


def _vehicle_row(vehicle: dict[str, Any], speed: str, interval: str, limit: str) -> dict[str, str]:
    return {
        "vehicle": str(vehicle.get("vehicle")),
        "speed": speed,
        "interval": interval,
        "limit": limit,
        "lane": str(vehicle.get("path") or NO_VALUE),
        "travel": str(vehicle.get("travel") or NO_VALUE),
        "seen": _format_seen(vehicle),
        "verdict": str(vehicle.get("verdict")),
        "reason": str(vehicle.get("reason") or INTERVAL_LIMITATIONS.get(str(vehicle.get("interval_from")), "")),
        "advice": rejected_advice(str(vehicle.get("reason_code"))) if vehicle.get("verdict") == "rejected" else "",
    }


def _format_seen(vehicle: dict[str, Any]) -> str:
    times = [time for key in ("seen_from_s", "seen_to_s") if (time := _number_or_none(vehicle.get(key))) is not None]
    return format_seen(times if len(times) == 2 else None)


def compare_summaries(first: list[dict[str, Any]], second: list[dict[str, Any]], unit: str) -> list[dict[str, str]]:
    """A row per vehicle that both summaries have: both speeds, and the second minus the first, to the decimals that
    both speeds have."""
    others = {str(vehicle.get("vehicle")): vehicle for vehicle in second}
    rows = []
    for vehicle in first:
        other = others.get(str(vehicle.get("vehicle")))
        if other is not None:
            a, b = _number_or_nan(vehicle.get("speed_mps")), _number_or_nan(other.get("speed_mps"))
            texts = _speed_text(vehicle, unit), _speed_text(other, unit)
            decimals = min(text.decimals for text in texts)
            change = round(convert(b - a, unit), decimals) + 0.0  # no negative zero
            sign = "+" if change > 0 else ""
            rows.append(
                {
                    "vehicle": str(vehicle.get("vehicle")),
                    "first": str(texts[0]),
                    "second": str(texts[1]),
                    "change": sign + format_number(change, decimals),
                }
            )
    return rows


def _number_or_nan(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _number_or_none(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
