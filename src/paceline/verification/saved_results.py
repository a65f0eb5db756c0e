"""Reads what `paceline speed` has written, by whichever method: speeds of vehicles, and of each of them by frame."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from paceline.arrays import Array
from paceline.documents.models import checked_content
from paceline.errors import UnusableInput, refuse_pipe_or_device

SPEED_COLUMNS = ("time_s", "speed_mps", "refined_speed_mps")
EXPECTED_OUTPUT = "expected what paceline speed has written"


class SavedVehicle(BaseModel):
    """The entry of a vehicle in summary.json, as far as it is compared."""

    model_config = ConfigDict(allow_inf_nan=False)

    vehicle: str
    verdict: str
    speed_mps: float | None
    speed_lo_mps: float | None
    speed_hi_mps: float | None


class SavedSummary(BaseModel):
    """A summary.json, as far as it is compared."""

    vehicles: list[SavedVehicle]
    configuration: dict[str, Any] = {}


@dataclass(frozen=True, eq=False)
class FrameSpeeds:
    """A vehicle's speeds in the frames in which it was tracked (N,): m/s, NaN where there is none."""

    frame: NDArray[np.int64]
    time: Array  # s
    speed: Array  # as estimated frame by frame
    refined: Array  # of the fit of the whole track

    @property
    def best(self) -> Array:
        """The refined speeds where there are such, else those by frame."""
        return self.refined if np.isfinite(self.refined).any() else self.speed


@dataclass(frozen=True, eq=False)
class SavedResult:
    """What is in one output folder; ``frames`` by vehicle."""

    name: str
    method: str
    vehicles: list[SavedVehicle]
    frames: dict[str, FrameSpeeds]


def read_result(out: Path) -> SavedResult:
    """The result in the folder ``out``. Raises UnusableInput, naming file and key."""
    summary = checked_content(SavedSummary, read_json(out / "summary.json", EXPECTED_OUTPUT), out / "summary.json")
    method = str(summary.configuration.get("method", "paceline"))
    return SavedResult(str(out), method, summary.vehicles, _read_frames(out / "estimates.csv"))


def read_json(file: Path, expected: str) -> Any:
    """The contents of a JSON ``file``. Raises UnusableInput."""
    refuse_pipe_or_device(file)
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UnusableInput(f"{file}: no such file; {expected}") from None
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be read ({error.strerror})") from error
    except json.JSONDecodeError as error:
        raise UnusableInput(f"{file}: line {error.lineno}: is not JSON ({error.msg})") from error
    except (UnicodeDecodeError, RecursionError) as error:
        raise UnusableInput(f"{file}: is not JSON") from error


def _read_frames(file: Path) -> dict[str, FrameSpeeds]:
    """The speeds of every vehicle in an estimates.csv."""
    rows: dict[str, list[tuple[int, list[float]]]] = {}
    for vehicle, frame, numbers in _tracked_rows(file):
        rows.setdefault(vehicle, []).append((frame, numbers))
    return {
        vehicle: FrameSpeeds(np.array([frame for frame, _ in known]), *np.array([numbers for _, numbers in known]).T)
        for vehicle, known in rows.items()
    }


def _tracked_rows(file: Path) -> Iterator[tuple[str, int, list[float]]]:
    """The vehicle, frame and SPEED_COLUMNS of each row in which a vehicle is tracked."""
    refuse_pipe_or_device(file)
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            for column in ("vehicle", "frame", "status", *SPEED_COLUMNS):
                if column not in (reader.fieldnames or []):
                    raise UnusableInput(f"{file}: {column}: there is no such column; {EXPECTED_OUTPUT}")
            for row in reader:
                if row["status"] == "tracking":
                    numbers = [_number(file, reader.line_num, row, column) for column in ("frame", *SPEED_COLUMNS)]
                    yield row["vehicle"], int(numbers[0]), numbers[1:]
    except FileNotFoundError:
        raise UnusableInput(f"{file}: no such file; {EXPECTED_OUTPUT}") from None
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UnusableInput(f"{file}: is no table; {EXPECTED_OUTPUT}") from error


def _number(file: Path, line: int, row: dict[str, str], column: str) -> float:
    """The number in a cell; NaN where it is empty and may be."""
    text = row[column] or ""
    if not text and column in ("speed_mps", "refined_speed_mps"):
        return float("nan")
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not np.isfinite(number) or (column == "frame" and number != int(number)):
        raise UnusableInput(f"{file}: line {line}: {column}: expected a number, found {text!r}")
    return number
