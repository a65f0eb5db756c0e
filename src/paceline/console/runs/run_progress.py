"""The progress of an active run: its vehicles' estimates over time, and its last frame with outlines and particles."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from paceline.console.runs.results import Series
from paceline.units import COVERAGE_95

MAX_SERIES_VALUES = 600  # values that are kept of one vehicle; beyond, every second one is dropped
MAX_KEPT_FRAMES = 6  # live frames whose pictures are kept, because pages request them a little later


@dataclass
class DecimatedValues:
    """Values of one vehicle, every ``stride``-th kept: rows of time in s, value and standard deviation."""

    rows: list[tuple[float, float, float]] = field(default_factory=list)
    stride: int = 1
    count: int = 0

    def add(self, time: float, value: float, std: float) -> None:
        if self.count % self.stride == 0:
            self.rows.append((time, value, std))
            if len(self.rows) > MAX_SERIES_VALUES:
                self.rows, self.stride = self.rows[::2], 2 * self.stride
        self.count += 1


@dataclass
class RunProgress:
    """The progress of one run: estimates over time, and its last frame. Memory does not grow with the recording."""

    values: dict[str, DecimatedValues] = field(default_factory=dict)
    last_frame: dict[str, Any] = field(default_factory=dict)  # its number, time_s, vehicles and, of a live run, size
    pictures: dict[int, list[bytes]] = field(default_factory=dict)  # JPEGs of each view, by live frame
    _next_frame: dict[str, Any] = field(default_factory=dict)

    def add_estimate(self, estimate: dict[str, Any]) -> None:
        """Adds one estimate, as `progress.parse_estimate` returns it."""
        if estimate["value"] is not None:
            values = self.values.setdefault(estimate["vehicle"], DecimatedValues())
            values.add(estimate["time_s"], estimate["value"], estimate["std"] or 0.0)
        if self._next_frame.get("frame") != estimate["frame"]:
            self._next_frame = {"frame": estimate["frame"], "time_s": estimate["time_s"], "vehicles": []}
        self._next_frame["vehicles"].append(estimate)

    def finish_frame(self) -> None:
        """Ends a frame whose estimates are all added. Of a live run only a frame with pictures becomes the last."""
        if self._next_frame and not self.pictures:
            self.last_frame = self._next_frame
        self._next_frame = {}

    def add_pictures(self, content: dict[str, Any]) -> None:
        """Adds the pictures of a live frame, as `progress.parse_pictures` returns them, after its estimates."""
        vehicles = self._next_frame["vehicles"] if self._next_frame.get("frame") == content["frame"] else []
        self.last_frame = {key: content[key] for key in ("frame", "time_s", "size")} | {"vehicles": vehicles}
        self.pictures[content["frame"]] = content["pictures"]
        if len(self.pictures) > MAX_KEPT_FRAMES:
            del self.pictures[next(iter(self.pictures))]
        self._next_frame = {}

    def series(self) -> list[Series]:
        """The values so far, one series per vehicle."""
        return [_to_series(name, values.rows) for name, values in self.values.items()]


def _to_series(name: str, rows: list[tuple[float, float, float]]) -> Series:
    half_widths = [COVERAGE_95 * std for *_, std in rows]
    return Series(name, [t for t, _, _ in rows], [x for _, x, _ in rows], half_widths, refined=False)
