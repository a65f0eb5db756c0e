"""The page of a clip's runs: starting one, viewing its progress, and its results."""

from __future__ import annotations

from typing import Any

from nicegui import run, ui

from paceline.console.confinement import NotFound
from paceline.console.library import ClipEntry, Library
from paceline.console.pages import results
from paceline.console.pages.layout import (
    READ_ONLY_TEXT,
    RESPONSE_TIMEOUT_S,
    TAB_RUNS,
    not_found_page,
    page,
    runs_address,
)
from paceline.console.pages.live_view import LiveView
from paceline.console.pages.run_list import RunList
from paceline.console.pages.settings_form import SettingsForm
from paceline.console.runs.kinds import FOLLOW_RUN, LIVE_RUN, MEASURING_KINDS, SPEED_RUN
from paceline.console.runs.options import UNIT_NAMES, command_options
from paceline.console.runs.results import result_files
from paceline.console.runs.run_queue import STATE_MEASURED, STATE_NOTHING, Run
from paceline.errors import UnusableInput
from paceline.speed.configuration import DEFAULTS

PAGE_POLL_INTERVAL_S = 0.5  # time between updates of the page
REMOVED_TEXT = "The clip has been removed."


def add(library: Library) -> None:
    """Adds the page /runs to the application."""

    @ui.page("/runs", response_timeout=RESPONSE_TIMEOUT_S)
    async def runs(clip: str = ".", number: int | None = None, unit: str = DEFAULTS.report.units) -> None:
        try:
            entry = await run.io_bound(library.entry, clip)
        except NotFound:
            return not_found_page()
        assert entry is not None, "is None only while the server ends"
        if unit not in UNIT_NAMES:
            unit = DEFAULTS.report.units
        chase = entry.contents.chase
        with page(f"{'Follow' if chase else 'Measure'} {clip}", entry, TAB_RUNS):
            _RunsPage(library, entry, number, unit)
            ui.add_body_html('<script type="module" src="/static/live_view.js"></script>')


class _RunsPage:
    """One tab's page of a clip's runs, updated whenever they change."""

    def __init__(self, library: Library, entry: ClipEntry, number: int | None, unit: str) -> None:
        self.library, self.clip, self.unit = library, entry.name, unit
        self.live, self.pictures = bool(entry.contents.live), entry.contents.pictures
        self.seconds = entry.contents.seconds
        self.chosen = number
        self.other: int | None = None
        self.shown_result: object = None  # what the result shows, to update it only on a change
        self.live_view: LiveView | None = None
        with ui.element("div").classes("pl-columns"):
            with ui.element("aside").classes("pl-side"):
                self._add_form(entry)
                ui.label("Runs").classes("pl-subtitle")
                self.list = RunList(library, self.live, self.choose, self.stop, self.cancel)
            self.result = ui.element("section").classes("pl-result")
        self.update()
        ui.timer(PAGE_POLL_INTERVAL_S, self.update)

    def _add_form(self, entry: ClipEntry) -> None:
        contents = entry.contents
        self.settings: SettingsForm | None = None
        with ui.element("div").classes("pl-panel"):
            ui.label("Follow the vehicle ahead" if contents.chase else "Measure the speeds").classes("pl-subtitle")
            if self.library.read_only:
                ui.label(READ_ONLY_TEXT).classes("pl-fact")
            else:
                self.kind = FOLLOW_RUN if contents.chase else LIVE_RUN if contents.live else SPEED_RUN
                ui.button("Start", on_click=self.start, color=None).props("unelevated no-caps").classes("pl-start")
                if text := _start_note(entry):
                    ui.label(text).classes("pl-fact")
                self.warning = ui.label().classes("pl-reason pl-warning").props('role="status"')
                self.warning.set_visibility(False)
                self.settings = SettingsForm(contents, self.unit, self.change_kind, self.warn)
            if not contents.chase:
                select = ui.select(list(UNIT_NAMES), value=self.unit, label="Speeds in", on_change=self.change_unit)
                select.props["hint"] = f"default: {DEFAULTS.report.units}"
                select.props("dense")

    def change_kind(self, live: bool) -> None:
        self.kind = LIVE_RUN if live else SPEED_RUN

    def warn(self, background_seconds: float | None) -> None:
        """Shows before the start why a run could measure nothing."""
        self.warning.text = _too_short(self.seconds, background_seconds) if self.kind == LIVE_RUN else ""
        self.warning.set_visibility(bool(self.warning.text))

    async def start(self) -> None:
        assert self.settings is not None, "there is no start button without them"
        if self.warning.text:
            ui.notify(self.warning.text, type="warning", multi_line=True, timeout=10_000)
            return
        try:
            options = command_options(self.kind, {"units": self.unit, **self.settings.values()})
            started = await run.io_bound(self.library.runs.start, self.clip, self.kind, options)
        except (UnusableInput, NotFound) as error:
            text = REMOVED_TEXT if isinstance(error, NotFound) else self.library.relative_message(error)
            ui.notify(text, type="negative", multi_line=True, timeout=10_000)
            return
        if started is not None:
            self.settings.close()  # it would cover the live view
            self.choose(started.number)

    def change_unit(self, event: Any) -> None:
        if self.settings is not None:
            self.settings.change_unit(self.unit, event.value)
        self.unit = event.value
        self.shown_result = None
        self.update()

    def choose(self, number: int) -> None:
        self.chosen, self.other, self.shown_result = number, None, None
        ui.run_javascript(f"history.replaceState(null, '', {runs_address(self.clip, number)!r})")
        self.update()

    def update(self) -> None:
        """Shows the present state of the runs, and the chosen one's progress or result."""
        try:
            runs = [r for r in self.library.runs.runs_of(self.clip) if r.kind in MEASURING_KINDS]
        except NotFound:
            return
        if self.chosen is None and runs:
            self.chosen = runs[0].number
        self.list.update(runs, self.chosen)
        chosen = next((r for r in runs if r.number == self.chosen), None)
        read = (chosen and (chosen.number, chosen.active or chosen.state)), self.unit, self.other, len(runs)
        if read != self.shown_result:
            self.shown_result = read
            self._show_result(chosen, runs)
        if chosen is not None and self.live_view is not None:
            self.live_view.update(chosen)

    def stop(self, number: int) -> None:
        self.library.runs.stop(self.clip, number)
        self.update()

    def cancel(self, number: int) -> None:
        self.library.runs.cancel(self.clip, number)
        self.update()

    def _show_result(self, chosen: Run | None, runs: list[Run]) -> None:
        self.result.clear()
        self.live_view = None
        with self.result:
            if chosen is None:
                ui.label("Nothing measured yet." if self.library.read_only else "Nothing measured yet. Start a run on "
                         "the left.").classes("pl-empty")  # fmt: skip
                return
            if chosen.active:
                self.live_view = LiveView(self.library, chosen, self.unit, self.pictures)
                return
            try:
                ended = chosen.state in (STATE_MEASURED, STATE_NOTHING)
                if not ended:
                    ui.label(f"Run {chosen.number} {_end_text(chosen)}").classes("pl-subtitle")
                    ui.label(chosen.reason).classes("pl-reason")
                if ended or (chosen.kind == LIVE_RUN and result_files(self.library.runs.output_folder(chosen))):
                    self._show_measured(chosen, runs)
            except (UnusableInput, NotFound) as error:
                text = REMOVED_TEXT if isinstance(error, NotFound) else self.library.relative_message(error)
                ui.label(text).classes("pl-reason")

    def _show_measured(self, chosen: Run, runs: list[Run]) -> None:
        results.show_links(self.library, chosen)
        if chosen.kind == FOLLOW_RUN:
            results.show_range(self.library, chosen, runs, self.other, self.compare)
        else:
            results.show_speeds(self.library, chosen, runs, self.unit, self.other, self.compare)

    def compare(self, event: Any) -> None:
        self.other = event.value
        self.update()


def _start_note(entry: ClipEntry) -> str:
    """What to know before starting a run; empty where nothing is special."""
    contents = entry.contents
    if entry.state in ("unreadable", "no rig", "no target"):
        return f"This clip cannot be {'followed' if contents.chase else 'measured'} yet: {entry.reason}"
    if contents.live:
        sources = " and ".join(contents.live)
        road = "" if contents.paths else " Lanes are detected first, unless the site has them."
        background = f"The background is estimated first, for {DEFAULTS.background.seconds:.0f} s by default"
        return f"Live, from {sources}. {background}; then every passing vehicle is measured, until you stop it.{road}"
    if contents.vehicles or contents.chase:
        return ""
    return f"No vehicle is outlined: {'vehicles' if contents.paths else 'lanes and vehicles'} are detected."


def _too_short(seconds: float | None, learn: float | None) -> str:
    """Why ``seconds`` of recording are too short for ``learn`` seconds of background; empty if they are not."""
    learn = DEFAULTS.background.seconds if learn is None else learn
    if seconds is None or learn < seconds:
        return ""
    return (
        f"This recording lasts {seconds:.1f} s, and {learn:g} s of them would be used to estimate the background: "
        "nothing would be measured. Set a shorter time, or use a longer recording."
    )


def _end_text(run: Run) -> str:
    return {"failed": "could not be measured", "cancelled": "was cancelled"}.get(run.state, "was interrupted")
