"""The result as data: estimates.csv and summary.json, in SI units."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from paceline.arrays import Array
from paceline.reports.common.tables import format_cell, write_json
from paceline.speed.results import SUMMARY_COLUMNS, ClipResult, Measurement, Track

ESTIMATE_COLUMNS = [
    "vehicle", "frame", "time_s", "speed_mps", "speed_std_mps", "x_m", "y_m", "z_m", "yaw_rate_radps",
    *(f"{view}_{axis}{corner}" for view in ("left", "right") for corner in (1, 2, 3, 4) for axis in "xy"),
    "ess", "status", "refined_speed_mps", "refined_std_mps",
]  # fmt: skip


PICTURES_FOLDER = "pictures"  # of the output folder, with a picture of each vehicle
OUTLINES_FOLDER = "outlines"  # with its outline in the first, the middle and the last frame, in both views
VEHICLE_COLUMNS = [*SUMMARY_COLUMNS, "picture"]


def write_estimates(result: ClipResult, file: Path) -> None:
    """Writes estimates.csv: one row per vehicle and frame, an empty cell where there is no number."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(ESTIMATE_COLUMNS)
        for measurement in result.measurements:
            writer.writerows(estimate_rows(measurement.track))


def estimate_rows(track: Track) -> Iterator[list[str]]:
    """The rows of estimates.csv for one vehicle."""
    for i in range(len(track.frame)):
        numbers = [track.time[i], track.speed[i], track.speed_std[i], *track.position[i], track.yaw_rate[i]]
        corners = [*track.left[i].ravel(), *track.right[i].ravel()]
        refined = [track.refined_speed[i], track.refined_std[i]]
        yield [
            track.vehicle, str(track.frame[i]), *map(format_cell, numbers), *map(format_cell, corners),
            format_cell(track.ess[i]), track.status[i], *map(format_cell, refined),
        ]  # fmt: skip


def write_summary(result: ClipResult, vehicles: Sequence[Mapping[str, object]], file: Path) -> None:
    """Writes summary.json: an entry for each of the ``vehicles``, the resolved configuration and the versions."""
    summary = {
        "clip": result.clip,
        "vehicles": vehicles,
        "notices": result.notices,
        "cameras": result.cameras,
        "configuration": result.configuration,
        "versions": result.versions,
        "seconds": result.seconds,
    }
    write_json(summary, file)


def vehicle_summary(measurement: Measurement, picture: str | None) -> dict[str, object]:
    """The entry of one vehicle in summary.json; ``picture`` is the name of its picture in the output folder."""
    return {**measurement.summary(), "picture": picture}


def vehicle_rows(vehicles: Sequence[Mapping[str, object]], columns: Sequence[str]) -> list[list[str]]:
    """The rows of vehicles.csv for entries of summary.json: the values of ``columns``."""
    return [[_cell(vehicle[column]) for column in columns] for vehicle in vehicles]


def write_vehicles(vehicles: Sequence[Mapping[str, object]], file: Path) -> None:
    """Writes vehicles.csv: one row per vehicle, an empty cell where there is nothing."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, lineterminator="\n").writerows([VEHICLE_COLUMNS, *vehicle_rows(vehicles, VEHICLE_COLUMNS)])


def _cell(value: object) -> str:
    if isinstance(value, float):
        return format_cell(value)
    return "" if value is None else str(value)


def summary_column(vehicles: Sequence[Mapping[str, object]], key: str) -> Array:
    """The values (V,) of one ``key`` of `vehicle_summary`, for all ``vehicles``."""
    return np.array([vehicle[key] for vehicle in vehicles], float)
