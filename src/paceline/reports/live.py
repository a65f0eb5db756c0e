"""The tables of a live survey, which grow with every vehicle: estimates.csv and summary.json."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

from paceline.errors import UnusableInput
from paceline.reports.output import write_together
from paceline.reports.tables import COLUMNS, estimate_rows, json_text, summary_of
from paceline.speed.results import Measurement


@dataclass(eq=False)
class LiveTables:
    """The tables in the folder ``out``, from `begin` on; ``about`` is what summary.json says besides of the vehicles.

    A vehicle is in both from the moment that it is measured; what ends the program later takes nothing away. Raises
    UnusableInput where ``out`` holds such tables already, or cannot be written.
    """

    out: Path
    about: dict[str, object]
    vehicles: list[dict[str, object]] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in ("estimates.csv", "summary.json"):
            if (self.out / name).exists():
                raise UnusableInput(f"{self.out / name}: is there already; expected a new folder for a live survey")

    def begin(self) -> None:
        """Write the tables without a vehicle."""
        write_together({self.out / "estimates.csv": (",".join(COLUMNS) + "\n").encode(), **self._summary([])})

    def add(self, measurement: Measurement, path: str, seen: tuple[float, float]) -> None:
        """Note a vehicle on ``path``, in view from and to the times ``seen`` (2,) s."""
        file = self.out / "estimates.csv"
        try:
            with file.open("a", newline="", encoding="utf-8") as stream:
                csv.writer(stream, lineterminator="\n").writerows(estimate_rows(measurement.track))
        except OSError as error:
            raise UnusableInput(f"{file}: cannot be written ({error.strerror})") from error
        self.vehicles.append({**summary_of(measurement), "path": path, "seen_from_s": seen[0], "seen_to_s": seen[1]})
        self.write([])

    def write(self, notices: list[str]) -> None:
        write_together(self._summary(notices))

    def _summary(self, notices: list[str]) -> dict[Path, bytes]:
        text = json_text({**self.about, "vehicles": self.vehicles, "notices": notices})
        return {self.out / "summary.json": text.encode()}
