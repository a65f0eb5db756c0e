"""Measuring a clip, and reading what came of it."""

from __future__ import annotations

from typing import Any

from nicegui import run, ui

from paceline.console.api import UNITS, results_address, speed_options
from paceline.console.library import Entry, Library
from paceline.console.pages.charts import speed_chart
from paceline.console.pages.layout import PATIENCE, badge, duration, moment, not_here, page, progress, runs_address
from paceline.console.results import differences, read_series, read_summary, vehicle_rows
from paceline.console.runs import MEASURED, NOTHING, Run
from paceline.console.safety import NotHere
from paceline.errors import UnusableInput

VERDICT = """
<q-td :props="props">
  <span :class="['pl-badge', props.value === 'measured' ? 'pl-good' : 'pl-bad']">{{ props.value }}</span>
</q-td>
"""
AGAIN = 0.5  # s between looks at the runs
COLUMNS = [
    {"name": name, "label": label, "field": name, "align": "left"}
    for name, label in (
        ("vehicle", "vehicle"), ("speed", "speed, {unit}"), ("interval", "95 % interval"), ("frames", "frames"),
        ("verdict", "verdict"), ("reason", "reason"),
    )
]  # fmt: skip
FILES = (
    ("estimates.csv", "Every frame (CSV)"),
    ("summary.json", "Summary (JSON)"),
    ("overlay.mp4", "Video with the outlines"),
)


def add(library: Library) -> None:
    @ui.page("/runs", response_timeout=PATIENCE)
    async def runs(clip: str = ".", number: int | None = None, unit: str = "mph") -> None:
        try:
            entry = await run.io_bound(library.entry, clip)
        except NotHere:
            return not_here()
        assert entry is not None, "is None only while the server ends"
        if unit not in UNITS:
            unit = "mph"
        with page(f"Measure {clip}", clip, "Measure and read"):
            _Page(library, clip, number, unit, _before(entry))


class _Page:
    """One tab's view of a clip's runs; what it shows is read anew from the runs whenever they change."""

    def __init__(self, library: Library, clip: str, number: int | None, unit: str, before: str) -> None:
        self.library, self.clip, self.unit, self.before = library, clip, unit, before
        self.chosen = number
        self.other: int | None = None
        self.listed: object = None  # what the list and the result show now, to leave them alone until it changes
        self.read: object = None
        self.going: dict[int, tuple[ui.linear_progress, ui.label]] = {}
        with ui.element("div").classes("pl-columns"):
            with ui.element("aside").classes("pl-side"):
                self._ask()
                ui.label("Runs").classes("pl-subtitle")
                self.list = ui.element("div").classes("pl-runs")
            self.result = ui.element("section").classes("pl-result")
        self.look()
        ui.timer(AGAIN, self.look)

    def _ask(self) -> None:
        with ui.element("div").classes("pl-panel"):
            ui.label("Measure the speeds").classes("pl-subtitle")
            ui.button("Start", on_click=self.start, color=None).props("unelevated no-caps").classes("pl-start")
            if self.before:
                ui.label(self.before).classes("pl-fact")
            with ui.expansion("Settings").classes("pl-settings").props("dense"):
                self.particles = ui.number("Particles", min=1, max=100_000, precision=0).props("dense clearable")
                self.particles.tooltip("More are slower and steadier; empty takes the usual number.")
                self.seed = ui.number("Seed", min=0, precision=0).props("dense clearable")
                self.seed.tooltip("The same seed gives the same result.")
                self.motion = ui.select(
                    {"auto": "along their paths", "free": "freely", "line": "straight", "curve": "on a curve"},
                    value="auto",
                    label="Vehicles move",
                ).props("dense")
            ui.select(list(UNITS), value=self.unit, label="Speeds in", on_change=self.change_unit).props("dense")

    async def start(self) -> None:
        asked: dict[str, Any] = {"motion": self.motion.value, "units": self.unit}
        for name, field in (("particles", self.particles), ("seed", self.seed)):
            if field.value is not None:
                asked[name] = int(field.value)
        try:
            started = await run.io_bound(self.library.runs.start, self.clip, "speed", speed_options(asked))
        except UnusableInput as error:
            ui.notify(self.library.shown(error), type="negative", multi_line=True, timeout=10_000)
            return
        if started is not None:
            self.choose(started.number)

    def change_unit(self, event: Any) -> None:
        self.unit = event.value
        self.read = None
        self.look()

    def choose(self, number: int) -> None:
        self.chosen, self.other, self.read = number, None, None
        ui.run_javascript(f"history.replaceState(null, '', {runs_address(self.clip, number)!r})")
        self.look()

    def look(self) -> None:
        """Shows the runs as they are now, and the chosen one's result once it has one."""
        try:
            runs = [r for r in self.library.runs.of(self.clip) if r.kind == "speed"]
        except NotHere:
            return
        if self.chosen is None and runs:
            self.chosen = runs[0].number
        listed = self.chosen, [(r.number, r.state) for r in runs]
        if listed != self.listed:
            self.listed = listed
            self._show_list(runs)
        for r in runs:
            if r.number in self.going:
                bar, words = self.going[r.number]
                bar.value = r.done / r.total if r.total else 0.0
                words.text = progress(r)
        chosen = next((r for r in runs if r.number == self.chosen), None)
        read = (chosen and (chosen.number, chosen.state)), self.unit, self.other, len(runs)
        if read != self.read:
            self.read = read
            self._show_result(chosen, runs)

    def _show_list(self, runs: list[Run]) -> None:
        self.list.clear()
        self.going.clear()
        with self.list:
            if not runs:
                ui.label("None yet.").classes("pl-fact")
            for r in runs:
                with ui.element("div").classes("pl-run" + (" pl-here" if r.number == self.chosen else "")):
                    with ui.element("div").classes("pl-row"):
                        name = ui.button(f"Run {r.number}", on_click=lambda _, n=r.number: self.choose(n), color=None)
                        name.props("flat dense no-caps").classes("pl-run-name")
                        badge(r.state)
                    if r.active:
                        bar = ui.linear_progress(0.0, show_value=False).props(f'aria-label="Run {r.number}"')
                        with ui.element("div").classes("pl-row"):
                            words = ui.label(progress(r)).classes("pl-fact")
                            self.going[r.number] = bar, words
                            cancel = ui.button("Cancel", on_click=lambda _, n=r.number: self.cancel(n), color=None)
                            cancel.props("flat dense no-caps")
                    else:
                        took = duration(r.ended - r.started) if r.ended and r.started else ""
                        ui.label(", ".join(filter(None, [moment(r), took]))).classes("pl-fact")

    def cancel(self, number: int) -> None:
        self.library.runs.cancel(self.clip, number)
        self.look()

    def _show_result(self, chosen: Run | None, runs: list[Run]) -> None:
        self.result.clear()
        with self.result:
            if chosen is None:
                ui.label("Nothing measured yet. Start a run on the left.").classes("pl-empty")
            elif chosen.active:
                ui.label("The speeds stand here when the run is done.").classes("pl-empty")
            elif chosen.state not in (MEASURED, NOTHING):
                ui.label(f"Run {chosen.number} {_ended(chosen)}").classes("pl-subtitle")
                ui.label(chosen.reason).classes("pl-reason")
            else:
                try:
                    self._show_measured(chosen, runs)
                except (UnusableInput, NotHere) as error:
                    ui.label(str(error)).classes("pl-reason")

    def _show_measured(self, chosen: Run, runs: list[Run]) -> None:
        out = self.library.runs.out(chosen)
        summary, series = read_summary(out), read_series(out)
        with ui.element("div").classes("pl-row pl-wrap"):
            ui.label(f"Run {chosen.number}").classes("pl-subtitle")
            ui.link("Open the report", results_address(self.clip, chosen.number, "report.html"), new_tab=True)
            for name, label in FILES:
                ui.link(label, results_address(self.clip, chosen.number, name) + "?save=true")
        columns = [{**column, "label": column["label"].format(unit=self.unit)} for column in COLUMNS]
        table = ui.table(columns=columns, rows=vehicle_rows(summary["vehicles"], self.unit), row_key="vehicle")
        table.props("flat dense wrap-cells").classes("pl-table").add_slot("body-cell-verdict", VERDICT)
        if not summary["vehicles"]:
            ui.label("No vehicle was found.").classes("pl-reason")
        for notice in summary["notices"]:
            ui.label(f"Note: {notice}").classes("pl-fact")
        others = {r.number: f"Run {r.number}, {moment(r)}" for r in runs if r.state == MEASURED and r != chosen}
        compared = None
        if others:
            ui.select({None: "no other run", **others}, value=self.other, label="Compare with", on_change=self.compare)
        if self.other in others:
            second = self.library.runs.out(next(r for r in runs if r.number == self.other))
            compared = read_series(second)
            rows = differences(summary["vehicles"], read_summary(second)["vehicles"], self.unit)
            headings = {"vehicle": "vehicle", "first": f"run {chosen.number}", "second": f"run {self.other}",
                        "change": f"difference, {self.unit}"}  # fmt: skip
            ui.table(
                columns=[{"name": k, "label": v, "field": k, "align": "left"} for k, v in headings.items()],
                rows=rows, row_key="vehicle",
            ).props("flat dense").classes("pl-table")  # fmt: skip
        if series:
            ui.label(f"Speed over time, {self.unit}, with the 95 % interval").classes("pl-fact")
            ui.echart(speed_chart(series, compared, self.unit)).classes("pl-chart")

    def compare(self, event: Any) -> None:
        self.other = event.value
        self.look()


def _before(entry: Entry) -> str:
    """What a person should know before they start a run."""
    if entry.state in ("unreadable", "no rig"):
        return f"This clip cannot be measured yet: {entry.reason}"
    if entry.vehicles:
        return ""
    return f"No vehicle is outlined: {'vehicles' if entry.paths else 'lanes and vehicles'} are looked for."


def _ended(run: Run) -> str:
    return {"failed": "could not be measured", "cancelled": "was cancelled"}.get(run.state, "was interrupted")
