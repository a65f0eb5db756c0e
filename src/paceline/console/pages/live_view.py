"""The view of an active run: the last frame with outlines and particles, a chart and, if live, a table of results."""

from __future__ import annotations

import json
from typing import Any

from nicegui import ui
from nicegui.run import io_bound

from paceline.console.confinement import NotFound
from paceline.console.frames.frame_cache import file_stamps
from paceline.console.library import Library
from paceline.console.pages.charts import SERIES_COLORS, distance_chart, speed_chart
from paceline.console.pages.layout import BACKGROUND_ACTIVITY, PREPARING_ACTIVITIES
from paceline.console.pages.results import ROWS_PER_PAGE, show_recent_vehicles, show_vehicle_table
from paceline.console.runs.kinds import FOLLOW_RUN, LIVE_RUN
from paceline.console.runs.results import Series, read_series, read_summary
from paceline.console.runs.run_queue import STATE_WAITING, Run
from paceline.errors import UnusableInput
from paceline.number_format import format_number
from paceline.reports.common.formatting import format_speed_number

FILTER_TEXT = (
    "Filter estimates, frame by frame (preliminary). The final speeds are fitted to the whole track at the end, and "
    "then shown here."
)
FOLLOW_TEXT = "Distance of the vehicle ahead, frame by frame."
WAITING_TEXT = "This run waits for the previous one."
DETECTING_TEXT = "Detecting vehicles in the whole recording first; then they are measured and shown here."
STARTING_TEXT = "Starting: the first frame follows in a moment."
BACKGROUND_TEXT = "Estimating the background: no speeds yet. The road should be empty most of this time."
LIVE_RUN_TEXT = (
    "Measuring. A box marks what moves along a lane now, with its approximate speed. Every vehicle is measured once it "
    "has passed, appears below, and is saved in the tables. Stop ends the run; the vehicles seen so far are still "
    "measured."
)
RESULT_POLL_INTERVAL_S = 0.5  # time between updates of the results of a live run


class LiveView:
    """Shows an active run in the current element of one tab."""

    def __init__(self, library: Library, run: Run, unit: str, pictures: bool) -> None:
        self.library, self.run, self.unit, self.pictures = library, run, unit, pictures
        self.shown_state: object = None
        self.shown_frame: int | None = None  # of a live run
        ui.label(f"Run {run.number}").classes("pl-subtitle")
        self.status = ui.label().classes("pl-fact")
        self.picture_area = ui.element("div").classes("pl-live")
        self.result_area = ui.element("div").classes("pl-live")
        self.picture_element: ui.element | None = None
        self.chart: ui.echart | None = None
        if run.kind == LIVE_RUN:
            ui.timer(RESULT_POLL_INTERVAL_S, self._update_measured)

    def update(self, run: Run) -> None:
        """Updates the view from the present state of the run."""
        if run.kind == LIVE_RUN:
            return self._update_live(run)
        series, scene = self.library.runs.live_data(run)
        text = FOLLOW_TEXT if run.kind == FOLLOW_RUN else FILTER_TEXT
        preparing = DETECTING_TEXT if run.doing in PREPARING_ACTIVITIES else STARTING_TEXT
        self.status.text = WAITING_TEXT if run.state == STATE_WAITING else text if scene else preparing
        state = scene.get("frame"), sum(len(s.time) for s in series)
        if not scene or state == self.shown_state:
            return
        self.shown_state = state
        options = self._chart(series)
        if self.chart is None:
            with self.result_area:
                if self.pictures:
                    self._add_picture_element(run, live=False)
                ui.label(self._axis_label()).classes("pl-fact")
                self.chart = ui.echart(options).classes("pl-chart")
        if self.picture_element is None and "size" in scene:
            with self.picture_area:
                self._add_picture_element(run, live=True)
        if self.picture_element is not None:
            self._draw(scene, series)
        self.chart.options.clear()
        self.chart.options.update(options)
        self.chart.update()

    def _update_live(self, run: Run) -> None:
        if run.state == STATE_WAITING:
            self.status.text = WAITING_TEXT
            return
        series, scene = self.library.runs.live_data(run)
        self.status.text = (
            STARTING_TEXT if not scene else BACKGROUND_TEXT if run.doing == BACKGROUND_ACTIVITY else LIVE_RUN_TEXT
        )
        if scene and scene["frame"] != self.shown_frame:
            self.shown_frame = scene["frame"]
            if self.picture_element is None:
                with self.picture_area:
                    self._add_picture_element(run, live=True)
            self._draw(scene, series)

    async def _update_measured(self) -> None:
        """Shows the vehicles that a live run has measured so far, when there are new ones."""
        try:
            measured = await io_bound(self._read_measured)
        except (UnusableInput, NotFound):  # there are none before the background is estimated
            return
        if measured is None or self.result_area.is_deleted:
            return
        summary, series = measured
        vehicles = summary["vehicles"]
        self.result_area.clear()
        with self.result_area:
            show_recent_vehicles(self.run, summary, self.unit)
            if not vehicles:
                if not summary["unmeasured"]:
                    ui.label("No vehicle has passed yet.").classes("pl-fact")
                return
            show_vehicle_table(self.run, vehicles, self.unit, ROWS_PER_PAGE)
            if series:
                ui.label(self._axis_label()).classes("pl-fact")
                ui.echart(speed_chart(series, None, self.unit)).classes("pl-chart")

    def _read_measured(self) -> tuple[dict[str, Any], list[Series]] | None:
        """The summary of a live run and the series of its latest vehicles; None if they are already shown."""
        out = self.library.runs.output_folder(self.run)
        stamps = file_stamps([out / "summary.json"])
        if stamps == self.shown_state:
            return None
        results = read_summary(out), read_series(out, growing=True)
        self.shown_state = stamps
        return results

    def _add_picture_element(self, run: Run, live: bool) -> None:
        """Adds the element for the frames of a recording, or for the pictures of a live run."""
        self.picture_element = ui.element("pl-live-view")
        self.picture_element.props["clip"], self.picture_element.props["cameras"] = (
            run.clip,
            1 if run.kind == FOLLOW_RUN else 2,
        )
        if live:
            self.picture_element.props["live"] = run.number

    def _draw(self, scene: dict[str, Any], series: list[Series]) -> None:
        assert self.picture_element is not None, "the element is there"
        self.picture_element.props["scene"] = json.dumps(self._scene(scene, series))
        self.picture_element.update()

    def _axis_label(self) -> str:
        if self.run.kind == FOLLOW_RUN:
            return "Distance over time, m"
        return f"Speed over time, {self.unit}"

    def _chart(self, series: list[Series]) -> dict[str, Any]:
        return distance_chart(series, None) if self.run.kind == FOLLOW_RUN else speed_chart(series, None, self.unit)

    def _scene(self, scene: dict[str, Any], series: list[Series]) -> dict[str, Any]:
        """The data of a frame to draw: each vehicle in the colour of its series, labelled with its value."""
        names = [s.vehicle for s in series]
        outlines = []
        for vehicle in scene["vehicles"]:
            name, value = vehicle["vehicle"], vehicle["value"]
            known = "" if value is None else self._format_value(value)
            color = SERIES_COLORS[names.index(name) % len(SERIES_COLORS)] if name in names else "#888888"
            drawn = {key: vehicle[key] for key in ("outlines", "particles")}
            outlines.append({"name": name, "label": f"{name}  {known}".strip(), "color": color, **drawn})
        size = {"size": scene["size"]} if "size" in scene else {}
        return {"frame": scene["frame"], "time": scene["time_s"], "vehicles": outlines, **size}

    def _format_value(self, value: float) -> str:
        return (
            f"{format_number(value, 1)} m"
            if self.run.kind == FOLLOW_RUN
            else f"{format_speed_number(value, self.unit)} {self.unit}"
        )
