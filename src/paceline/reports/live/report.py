"""Writes a live survey: tables and images that are extended with every vehicle, and a report at the end."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

import cv2

from paceline.detection.finder import DetectedVehicle
from paceline.errors import UnusableInput
from paceline.reports.common.output_folder import write_all_or_none
from paceline.reports.common.tables import json_text
from paceline.reports.detected_vehicles import draw_detected_vehicle
from paceline.reports.live.page import render_live_page
from paceline.reports.live.plots import speeds_plot
from paceline.reports.speed.tables import (
    ESTIMATE_COLUMNS,
    PICTURES_FOLDER,
    VEHICLE_COLUMNS,
    estimate_rows,
    vehicle_rows,
    vehicle_summary,
)
from paceline.speed.configuration import DEFAULTS
from paceline.speed.results import Measurement
from paceline.verdicts import Message

LIVE_VEHICLE_COLUMNS = [*VEHICLE_COLUMNS, "seen_at"]
LIVE_PICTURE_HEIGHT_PX, PICTURE_JPEG_QUALITY = 240, 80  # px, and of the JPEG
MAX_WRITE_TIME_SHARE = 0.01  # of the time, for writing summary.json, which grows and is always written whole


@dataclass(eq=False)
class LiveResults:
    """The tables and pictures in the folder ``out``, from `begin` on, and the report when the context ends; ``about``
    holds the entries of summary.json besides the vehicles; ``unit`` is that of the report.

    A vehicle is in estimates.csv and vehicles.csv from the moment that it is measured, and in summary.json soon after;
    what ends the program later takes nothing away, and unless it is killed there is a report. Raises UnusableInput
    where ``out`` holds such tables already, or cannot be written.
    """

    out: Path
    about: dict[str, object]
    unit: str
    kept_pictures: int = DEFAULTS.live.kept_pictures  # the latest ones, of some 15 kB each
    vehicles: list[dict[str, object]] = field(default_factory=list)
    unmeasured: list[dict[str, object]] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    _begun: bool = False
    _changed: bool = False  # since summary.json was written
    _due: float = 0.0  # s, by the monotonic clock, from when on it may be written again

    def __post_init__(self) -> None:
        for name in ("estimates.csv", "vehicles.csv", "summary.json"):
            if (self.out / name).exists():
                raise UnusableInput(f"{self.out / name}: is there already; expected a new folder for a live survey")

    def __enter__(self) -> LiveResults:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._begun:
            write_all_or_none(self._summary())  # first: a disk may be too full for the report
            plot = speeds_plot(self.vehicles, self.unit)
            page = render_live_page(self.document(), self.out / PICTURES_FOLDER, self.kept_pictures, plot, self.unit)
            write_all_or_none({self.out / "report.html": page.encode(), self.out / "speeds.png": plot.png})

    def begin(self) -> None:
        """Writes the tables without a vehicle."""
        headers = {"estimates.csv": ESTIMATE_COLUMNS, "vehicles.csv": LIVE_VEHICLE_COLUMNS}
        tables = {self.out / name: (",".join(columns) + "\n").encode() for name, columns in headers.items()}
        write_all_or_none({**tables, **self._summary()})
        self._begun = True

    def add(self, measurement: Measurement, detected: DetectedVehicle, seen_at: str) -> None:
        """Adds a vehicle that has been measured, and was first detected at the time of day ``seen_at``."""
        picture = f"{PICTURES_FOLDER}/{measurement.vehicle}.jpg"
        vehicle = {**vehicle_summary(measurement, picture), **_passage_data(detected, seen_at)}
        self._append("estimates.csv", estimate_rows(measurement.track))
        self._append("vehicles.csv", vehicle_rows([vehicle], LIVE_VEHICLE_COLUMNS))
        self.vehicles.append(vehicle)
        self._changed = True
        self._keep_picture(measurement.vehicle, detected)
        self.save()

    def add_unmeasured(self, detected: DetectedVehicle, seen_at: str, reason: Message) -> None:
        """Adds a vehicle that could not be measured for a ``reason``."""
        self.unmeasured.append({**_passage_data(detected, seen_at), "reason": reason, "reason_code": reason.code})
        self._changed = True
        self.save()

    def _append(self, name: str, rows: Iterable[list[str]]) -> None:
        """Adds ``rows`` to the table ``name``."""
        file = self.out / name
        try:
            with file.open("a", newline="", encoding="utf-8") as stream:
                csv.writer(stream, lineterminator="\n").writerows(rows)
        except OSError as error:
            raise UnusableInput(f"{file}: cannot be written ({error.strerror})") from error

    def save(self) -> None:
        """Updates summary.json, unless its share of the time is used up."""
        start_time = time.monotonic()
        if self._changed and start_time >= self._due:
            write_all_or_none(self._summary())
            self._changed = False
            self._due = start_time + (time.monotonic() - start_time) / MAX_WRITE_TIME_SHARE

    def document(self) -> dict[str, object]:
        """The contents of summary.json."""
        content = {"vehicles": self.vehicles, "unmeasured": self.unmeasured, "notices": self.notices}
        return {**self.about, **content}

    def _summary(self) -> dict[Path, bytes]:
        return {self.out / "summary.json": json_text(self.document()).encode()}

    def _keep_picture(self, name: str, detected: DetectedVehicle) -> None:
        """Writes the picture of a vehicle, and removes the oldest one beyond the limit."""
        picture = draw_detected_vehicle(detected, LIVE_PICTURE_HEIGHT_PX)
        jpeg = bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, PICTURE_JPEG_QUALITY])[1])
        write_all_or_none({self.out / PICTURES_FOLDER / f"{name}.jpg": jpeg})
        if len(self.vehicles) > self.kept_pictures:
            with suppress(OSError):
                (self.out / PICTURES_FOLDER / f"{self.vehicles[-self.kept_pictures - 1]['vehicle']}.jpg").unlink()


def _passage_data(detected: DetectedVehicle, seen_at: str) -> dict[str, object]:
    """The path of a vehicle, its period in view, and its first position."""
    x, _, z = (round(float(value), 2) for value in detected.position)
    assert math.isfinite(x + z), "it was seen on its way"
    times = {"seen_from_s": detected.times[0], "seen_to_s": detected.times[1], "seen_at": seen_at}
    return {"path": detected.path, **times, "first_seen_m": [x, z]}
