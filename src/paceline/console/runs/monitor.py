"""What a run under way has told of its vehicles: values over time, and the last frame with all that is drawn on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from paceline.console.runs.results import Series
from paceline.units import COVERAGE_95

MOST = 600  # values of one vehicle that are kept; of more, every second one goes
LATEST = 6  # live frames whose pictures are kept: a page asks for them a moment after it has heard of them


@dataclass
class Values:
    """Values of one vehicle: seconds, value and standard deviation, of which every ``stride``-th is kept."""

    rows: list[tuple[float, float, float]] = field(default_factory=list)
    stride: int = 1
    count: int = 0

    def add(self, time: float, value: float, std: float) -> None:
        if self.count % self.stride == 0:
            self.rows.append((time, value, std))
            if len(self.rows) > MOST:
                self.rows, self.stride = self.rows[::2], 2 * self.stride
        self.count += 1


@dataclass
class Watch:
    """What has been told of one run. Memory does not grow with the recording."""

    values: dict[str, Values] = field(default_factory=dict)
    scene: dict[str, Any] = field(default_factory=dict)  # frame, time_s, and the vehicles in it; live, the size
    pictures: dict[int, list[bytes]] = field(default_factory=dict)  # of the latest live frames, one JPEG per view
    _coming: dict[str, Any] = field(default_factory=dict)

    def add(self, told: dict[str, Any]) -> None:
        """Note one estimate, as `progress.parse_estimate` gives it."""
        if told["value"] is not None:
            values = self.values.setdefault(told["vehicle"], Values())
            values.add(told["time_s"], told["value"], told["std"] or 0.0)
        if self._coming.get("frame") != told["frame"]:
            self._coming = {"frame": told["frame"], "time_s": told["time_s"], "vehicles": []}
        self._coming["vehicles"].append(told)

    def turn(self) -> None:
        """The frame is through: its vehicles have been told. Live, only frames whose pictures are told are shown."""
        if self._coming and not self.pictures:
            self.scene = self._coming
        self._coming = {}

    def show(self, told: dict[str, Any]) -> None:
        """Note the pictures of a live frame, as `progress.parse_pictures` gives them; its vehicles have been told."""
        vehicles = self._coming["vehicles"] if self._coming.get("frame") == told["frame"] else []
        self.scene = {key: told[key] for key in ("frame", "time_s", "size")} | {"vehicles": vehicles}
        self.pictures[told["frame"]] = told["pictures"]
        if len(self.pictures) > LATEST:
            del self.pictures[next(iter(self.pictures))]
        self._coming = {}

    def series(self) -> list[Series]:
        """The values so far, for a chart."""
        return [_series(name, values.rows) for name, values in self.values.items()]


def _series(name: str, rows: list[tuple[float, float, float]]) -> Series:
    return Series(name, [t for t, _, _ in rows], [x for _, x, _ in rows], [COVERAGE_95 * s for *_, s in rows], False)
