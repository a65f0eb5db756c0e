"""A run under way: its last frame with outlines and particles, and a plot that grows; live, a table that grows."""

from __future__ import annotations

import json
from typing import Any

from nicegui import ui
from nicegui.run import io_bound

from paceline.console.confinement import NotHere
from paceline.console.frames.frame_cache import stamps_of
from paceline.console.library import Library
from paceline.console.pages.charts import COLORS, distance_chart, speed_chart
from paceline.console.pages.layout import LEARNING
from paceline.console.pages.results import PAGE, passed, vehicle_table
from paceline.console.runs.kinds import AHEAD, LIVE
from paceline.console.runs.results import Series, read_series, read_summary
from paceline.console.runs.run_list import WAITING, Run
from paceline.errors import UnusableInput
from paceline.reports.common.formatting import format_number, format_speed_number

FILTERED = (
    "What the filter believes, frame by frame. These are first values: the speeds that count are fitted to the whole "
    "track at the end, and stand here then."
)
FOLLOWED = "Where the tracker believes the vehicle ahead to be, frame by frame."
WAITS = "This run waits for the one before it."
LOOKS = "Vehicles are looked for first, in the whole recording; then they are measured, and shown here."
STARTS = "The first frame comes in a moment."
LEARNS = "The empty road is being learned: no speeds yet. It should be empty most of this time."
MEASURES = (
    "Measuring. A box is what moves along a lane just now, with roughly its speed; every vehicle appears below, "
    "measured, once it has gone by, and is kept in the tables from then on. Stop ends the run as the end of the "
    "recording would."
)
AGAIN = 0.5  # s between looks at what a live run has measured


class Watching:
    """What one tab shows of a run under way, in the present element."""

    def __init__(self, library: Library, run: Run, unit: str, pictures: bool) -> None:
        self.library, self.run, self.unit, self.pictures = library, run, unit, pictures
        self.read: object = None
        self.seen: int | None = None  # the live frame that is shown
        ui.label(f"Run {run.number}").classes("pl-subtitle")
        self.words = ui.label().classes("pl-fact")
        self.top = ui.element("div").classes("pl-watched")
        self.place = ui.element("div").classes("pl-watched")
        self.element: ui.element | None = None
        self.chart: ui.echart | None = None
        if run.kind == LIVE:
            ui.timer(AGAIN, self._look_for_passed)

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
                    self._look_at(run, live=False)
                ui.label(self._axis()).classes("pl-fact")
                self.chart = ui.echart(options).classes("pl-chart")
        if self.element is None and "size" in scene:
            with self.top:
                self._look_at(run, live=True)
        if self.element is not None:
            self._paint(scene, series)
        self.chart.options.clear()
        self.chart.options.update(options)
        self.chart.update()

    def _look_live(self, run: Run) -> None:
        if run.state == WAITING:
            self.words.text = WAITS
            return
        series, scene = self.library.runs.watch(run)
        self.words.text = STARTS if not scene else LEARNS if run.doing == LEARNING else MEASURES
        if scene and scene["frame"] != self.seen:
            self.seen = scene["frame"]
            if self.element is None:
                with self.top:
                    self._look_at(run, live=True)
            self._paint(scene, series)

    async def _look_for_passed(self) -> None:
        """Shows the vehicles that a live run has measured so far, once there are more of them."""
        try:
            found = await io_bound(self._read_passed)
        except (UnusableInput, NotHere):  # there is none before the empty road is known
            return
        if found is None or self.place.is_deleted:
            return
        summary, series = found
        vehicles = summary["vehicles"]
        self.place.clear()
        with self.place:
            passed(self.run, summary, self.unit)
            if not vehicles:
                if not summary["unmeasured"]:
                    ui.label("No vehicle has gone by yet.").classes("pl-fact")
                return
            vehicle_table(vehicles, self.unit, PAGE)
            if series:
                ui.label(self._axis()).classes("pl-fact")
                ui.echart(speed_chart(series, None, self.unit)).classes("pl-chart")

    def _read_passed(self) -> tuple[dict[str, Any], list[Series]] | None:
        """The summary of a live run and the courses of its latest vehicles, or None while they are those shown."""
        out = self.library.runs.out(self.run)
        stamps = stamps_of([out / "summary.json"])
        if stamps == self.read:
            return None
        found = read_summary(out), read_series(out, growing=True)
        self.read = stamps
        return found

    def _look_at(self, run: Run, live: bool) -> None:
        """Shows the pictures of a recording, or those that a live run tells."""
        self.element = ui.element("pl-watch")
        self.element.props["clip"], self.element.props["cameras"] = run.clip, 1 if run.kind == AHEAD else 2
        if live:
            self.element.props["live"] = run.number

    def _paint(self, scene: dict[str, Any], series: list[Series]) -> None:
        assert self.element is not None, "there is something to paint on"
        self.element.props["scene"] = json.dumps(self._scene(scene, series))
        self.element.update()

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
        size = {"size": scene["size"]} if "size" in scene else {}
        return {"frame": scene["frame"], "time": scene["time_s"], "vehicles": shown, **size}

    def _value(self, value: float) -> str:
        return (
            f"{format_number(value, 1)} m"
            if self.run.kind == AHEAD
            else f"{format_speed_number(value, self.unit)} {self.unit}"
        )
