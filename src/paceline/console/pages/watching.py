"""A run under way: its last frame with outlines and particles, and a plot that grows; live, a table that grows."""

from __future__ import annotations

import json
from typing import Any

from nicegui import ui

from paceline.console.kinds import AHEAD, LIVE
from paceline.console.library import Library
from paceline.console.pages.charts import COLORS, distance_chart, speed_chart
from paceline.console.pages.measured import vehicle_table
from paceline.console.results import Series, read_series, read_summary
from paceline.console.runs import WAITING, Run
from paceline.errors import UnusableInput
from paceline.reports.wording import number, shown_speed

FILTERED = (
    "What the filter believes, frame by frame. These are first values: the speeds that count are fitted to the whole "
    "track at the end, and stand here then."
)
FOLLOWED = "Where the tracker believes the vehicle ahead to be, frame by frame."
WAITS = "This run waits for the one before it."
LOOKS = "Vehicles are looked for first, in the whole recording; then they are measured, and shown here."
STARTS = "The first frame comes in a moment."


class Watching:
    """What one tab shows of a run under way, in the present element."""

    def __init__(self, library: Library, run: Run, unit: str, pictures: bool) -> None:
        self.library, self.run, self.unit, self.pictures = library, run, unit, pictures
        self.read: object = None
        ui.label(f"Run {run.number}").classes("pl-subtitle")
        self.words = ui.label().classes("pl-fact")
        self.place = ui.element("div").classes("pl-watched")
        self.element: ui.element | None = None
        self.chart: ui.echart | None = None

    def look(self, run: Run) -> None:
        """Shows how far the run is now."""
        if run.kind == LIVE:
            return self._look_live(run)
        series, scene = self.library.runs.watch(run)
        text = FOLLOWED if run.kind == AHEAD else FILTERED
        begins = LOOKS if run.doing in ("looking", "averaging") else STARTS
        self.words.text = WAITS if run.state == WAITING else text if scene else begins
        now = scene.get("frame"), sum(len(s.time) for s in series)
        if not scene or now == self.read:
            return
        self.read = now
        options = self._chart(series)
        if self.chart is None:
            with self.place:
                if self.pictures:
                    self.element = ui.element("pl-watch")
                    self.element.props["clip"], self.element.props["cameras"] = run.clip, 1 if run.kind == AHEAD else 2
                ui.label(self._axis()).classes("pl-fact")
                self.chart = ui.echart(options).classes("pl-chart")
        if self.element is not None:
            self.element.props["scene"] = json.dumps(self._scene(scene, series))
            self.element.update()
        self.chart.options.clear()
        self.chart.options.update(options)
        self.chart.update()

    def _look_live(self, run: Run) -> None:
        try:
            out = self.library.runs.out(run)
            vehicles = read_summary(out)["vehicles"]
            series = read_series(out, growing=True)
        except UnusableInput:  # there is none before the empty road is known
            waits = "The empty road is being learned: no speeds yet."
            self.words.text = WAITS if run.state == WAITING else waits
            return
        self.words.text = (
            "Measuring: every vehicle appears here once it has gone by, and is kept in the tables from then on. "
            "Stop ends the run as the end of the recording would."
        )
        if self.read == len(vehicles):
            return
        self.read = len(vehicles)
        self.place.clear()
        with self.place:
            vehicle_table(vehicles, self.unit)
            if series:
                ui.label(self._axis()).classes("pl-fact")
                ui.echart(speed_chart(series, None, self.unit)).classes("pl-chart")

    def _axis(self) -> str:
        if self.run.kind == AHEAD:
            return "Distance over time, m"
        return f"Speed over time, {self.unit}"

    def _chart(self, series: list[Series]) -> dict[str, Any]:
        return distance_chart(series, None) if self.run.kind == AHEAD else speed_chart(series, None, self.unit)

    def _scene(self, scene: dict[str, Any], series: list[Series]) -> dict[str, Any]:
        """A frame as the page draws it: each vehicle in the colour of its line, with its value in words."""
        names = [s.vehicle for s in series]
        shown = []
        for vehicle in scene["vehicles"]:
            name, value = vehicle["vehicle"], vehicle["value"]
            known = "" if value is None else self._value(value)
            color = COLORS[names.index(name) % len(COLORS)] if name in names else "#888888"
            drawn = {key: vehicle[key] for key in ("outlines", "particles")}
            shown.append({"name": name, "label": f"{name}  {known}".strip(), "color": color, **drawn})
        return {"frame": scene["frame"], "time": scene["time_s"], "vehicles": shown}

    def _value(self, value: float) -> str:
        return f"{number(value, 1)} m" if self.run.kind == AHEAD else f"{shown_speed(value, self.unit)} {self.unit}"
