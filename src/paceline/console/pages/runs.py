"""Measuring a clip, watching it, and reading what came of it."""

from __future__ import annotations

from typing import Any

from nicegui import run, ui

from paceline.console.confinement import NotHere
from paceline.console.library import Entry, Library
from paceline.console.pages import results
from paceline.console.pages.layout import (
    PATIENCE,
    READ_AND_FOLLOW,
    READ_AND_MEASURE,
    READ_ONLY,
    badge,
    duration,
    moment,
    not_here,
    page,
    progress,
    runs_address,
)
from paceline.console.pages.live_view import Watching
from paceline.console.runs.kinds import AHEAD, LIVE, MEASURING, SPEED
from paceline.console.runs.options import (
    LEAST_LEARNING,
    LEAST_PARTICLES,
    MOST_LEARNING,
    MOST_PARTICLES,
    MOST_TOLERANCE,
    UNITS,
    in_unit,
    options_of,
)
from paceline.console.runs.results import files_of
from paceline.console.runs.run_list import MEASURED, NOTHING, Run
from paceline.errors import UnusableInput

AGAIN = 0.5  # s between looks at the runs
GONE = "The clip is no longer there."
ENDING = "ending; what has passed is measured"
LEARNS = 30.0  # s, as the command has it


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
        chase = entry.contents.chase
        with page(f"{'Follow' if chase else 'Measure'} {clip}", entry, READ_AND_FOLLOW if chase else READ_AND_MEASURE):
            _Page(library, entry, number, unit)
            ui.add_body_html('<script type="module" src="/static/watch.js"></script>')


class _Page:
    """One tab's view of a clip's runs; what it shows is read anew from the runs whenever they change."""

    def __init__(self, library: Library, entry: Entry, number: int | None, unit: str) -> None:
        self.library, self.clip, self.unit = library, entry.name, unit
        self.live, self.pictures = bool(entry.contents.live), entry.contents.pictures
        self.seconds = entry.contents.seconds
        self.chosen = number
        self.other: int | None = None
        self.listed: object = None  # what the list and the result show now, to leave them alone until it changes
        self.read: object = None
        self.watching: Watching | None = None
        self.going: dict[int, tuple[ui.linear_progress, ui.label]] = {}
        with ui.element("div").classes("pl-columns"):
            with ui.element("aside").classes("pl-side"):
                self._ask(entry)
                ui.label("Runs").classes("pl-subtitle")
                self.list = ui.element("div").classes("pl-runs")
            self.result = ui.element("section").classes("pl-result")
        self.look()
        ui.timer(AGAIN, self.look)

    def _ask(self, entry: Entry) -> None:
        contents = entry.contents
        self.fields: dict[str, Any] = {}
        with ui.element("div").classes("pl-panel"):
            ui.label("Follow the vehicle ahead" if contents.chase else "Measure the speeds").classes("pl-subtitle")
            if self.library.read_only:
                ui.label(READ_ONLY).classes("pl-fact")
            else:
                self.kind = AHEAD if contents.chase else LIVE if contents.live else SPEED
                ui.button("Start", on_click=self.start, color=None).props("unelevated no-caps").classes("pl-start")
                if words := _before(entry):
                    ui.label(words).classes("pl-fact")
                self.warning = ui.label().classes("pl-reason pl-warning").props('role="status"')
                self.warning.set_visibility(False)
                with ui.expansion("Settings").classes("pl-settings").props("dense") as self.settings:
                    self._settings(entry)
            if not contents.chase:
                ui.select(list(UNITS), value=self.unit, label="Speeds in", on_change=self.change_unit).props("dense")

    def _settings(self, entry: Entry) -> None:
        if entry.contents.chase:
            self.fields["overlay"] = ui.checkbox("Write the video, which takes most of the time", value=True)
            return
        particles = ui.number("Particles", min=LEAST_PARTICLES, max=MOST_PARTICLES, precision=0)
        particles.props("dense clearable")
        particles.tooltip("More are slower and steadier; empty takes the usual number.")
        seed = ui.number("Seed", min=0, precision=0).props("dense clearable")
        seed.tooltip("The same seed gives the same result.")
        motion = ui.select(
            {"auto": "along their paths", "free": "freely", "line": "straight", "curve": "on a curve"},
            value="auto",
            label="Vehicles move",
        )
        tolerance = ui.number(f"Tolerance ±, {self.unit}", min=0, max=MOST_TOLERANCE).props("dense clearable")
        tolerance.tooltip("Speeds that are known less well are rejected as well; empty takes the usual limits alone.")
        self.fields |= {"particles": particles, "seed": seed, "motion": motion.props("dense"), "tolerance": tolerance}
        if not entry.contents.live:
            live = ui.checkbox("Play it as a live stream", on_change=self.change_kind)
            live.tooltip("To try what live measuring does: vehicle after vehicle, as if the cameras recorded now.")
        self.learn = ui.number(
            "Learn the empty road for, s", value=LEARNS, min=LEAST_LEARNING, max=MOST_LEARNING, on_change=self.warn
        ).props("dense")
        self.learn.set_visibility(self.kind == LIVE)
        self.fields["learn"] = self.learn

    def change_kind(self, event: Any) -> None:
        self.kind = LIVE if event.value else SPEED
        self.learn.set_visibility(event.value)
        self.warn()

    def warn(self) -> None:
        """Says before the start what cannot come to anything."""
        self.warning.text = _too_short(self.seconds, self.learn.value) if self.kind == LIVE else ""
        self.warning.set_visibility(bool(self.warning.text))

    async def start(self) -> None:
        if self.warning.text:
            ui.notify(self.warning.text, type="warning", multi_line=True, timeout=10_000)
            return
        asked: dict[str, Any] = {"units": self.unit}
        for name, field in self.fields.items():
            value = field.value
            asked[name] = int(value) if name in ("particles", "seed") and value is not None else value
        try:
            options = options_of(self.kind, asked)
            started = await run.io_bound(self.library.runs.start, self.clip, self.kind, options)
        except (UnusableInput, NotHere) as error:
            words = GONE if isinstance(error, NotHere) else self.library.shown(error)
            ui.notify(words, type="negative", multi_line=True, timeout=10_000)
            return
        if started is not None:
            self.settings.close()  # it would stand before what is to be watched
            self.choose(started.number)

    def change_unit(self, event: Any) -> None:
        if tolerance := self.fields.get("tolerance"):
            tolerance.props["label"] = f"Tolerance ±, {event.value}"
            if tolerance.value is not None:
                tolerance.value = in_unit(tolerance.value, self.unit, event.value)
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
            runs = [r for r in self.library.runs.of(self.clip) if r.kind in MEASURING]
        except NotHere:
            return
        if self.chosen is None and runs:
            self.chosen = runs[0].number
        listed = self.chosen, [(r.number, r.state, self.library.runs.is_stopping(r)) for r in runs]
        if listed != self.listed:
            self.listed = listed
            self._show_list(runs)
        for r in runs:
            if r.number in self.going:
                bar, words = self.going[r.number]
                bar.value = r.done / r.total if r.total else 0.0
                words.text = ENDING if self.library.runs.is_stopping(r) else progress(r)
        chosen = next((r for r in runs if r.number == self.chosen), None)
        read = (chosen and (chosen.number, chosen.active or chosen.state)), self.unit, self.other, len(runs)
        if read != self.read:
            self.read = read
            self._show_result(chosen, runs)
        if chosen is not None and self.watching is not None:
            self.watching.look(chosen)

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
                        badge("live" if r.kind == LIVE and r.active else r.state)
                    if r.active:
                        self._show_going(r)
                    else:
                        took = duration(r.ended - r.started) if r.ended and r.started else ""
                        words = [moment(r), took, "live" if r.kind == LIVE else ""]
                        ui.label(", ".join(filter(None, words))).classes("pl-fact")

    def _show_going(self, r: Run) -> None:
        bar = ui.linear_progress(0.0, show_value=False).props(f'aria-label="Run {r.number}"')
        bar.set_visibility(r.kind != LIVE)
        with ui.element("div").classes("pl-row"):
            words = ui.label(progress(r)).classes("pl-fact")
            self.going[r.number] = bar, words
            endless = r.kind == LIVE or self.live
            if endless and not self.library.runs.is_stopping(r) and r.started:
                stop = ui.button("Stop", on_click=lambda _, n=r.number: self.stop(n), color=None)
                stop.props("flat dense no-caps").tooltip("Ends it; what has been measured stays.")
            else:
                cancel = ui.button("Cancel", on_click=lambda _, n=r.number: self.cancel(n), color=None)
                cancel.props("flat dense no-caps")

    def stop(self, number: int) -> None:
        self.library.runs.stop(self.clip, number)
        self.look()

    def cancel(self, number: int) -> None:
        self.library.runs.cancel(self.clip, number)
        self.look()

    def _show_result(self, chosen: Run | None, runs: list[Run]) -> None:
        self.result.clear()
        self.watching = None
        with self.result:
            if chosen is None:
                ui.label("Nothing measured yet." if self.library.read_only else "Nothing measured yet. Start a run on "
                         "the left.").classes("pl-empty")  # fmt: skip
                return
            if chosen.active:
                self.watching = Watching(self.library, chosen, self.unit, self.pictures)
                return
            try:
                ended = chosen.state in (MEASURED, NOTHING)
                if not ended:
                    ui.label(f"Run {chosen.number} {_ended(chosen)}").classes("pl-subtitle")
                    ui.label(chosen.reason).classes("pl-reason")
                if ended or (chosen.kind == LIVE and files_of(self.library.runs.out(chosen))):
                    self._show_measured(chosen, runs)
            except (UnusableInput, NotHere) as error:
                words = GONE if isinstance(error, NotHere) else self.library.shown(error)
                ui.label(words).classes("pl-reason")

    def _show_measured(self, chosen: Run, runs: list[Run]) -> None:
        results.links(self.library, chosen)
        if chosen.kind == AHEAD:
            results.ahead(self.library, chosen, runs, self.other, self.compare)
        else:
            results.speeds(self.library, chosen, runs, self.unit, self.other, self.compare)

    def compare(self, event: Any) -> None:
        self.other = event.value
        self.look()


def _before(entry: Entry) -> str:
    """What a person should know before they start a run."""
    contents = entry.contents
    if entry.state in ("unreadable", "no rig", "no target"):
        return f"This clip cannot be {'followed' if contents.chase else 'measured'} yet: {entry.reason}"
    if contents.live:
        sources = " and ".join(contents.live)
        road = "" if contents.paths else " Lanes are looked for first, unless the site has them."
        learn = f"The empty road is learned first, {LEARNS:.0f} s long if you set nothing else"
        return f"Live, from {sources}. {learn}; then every vehicle that passes is measured, until you stop it.{road}"
    if contents.vehicles or contents.chase:
        return ""
    return f"No vehicle is outlined: {'vehicles' if contents.paths else 'lanes and vehicles'} are looked for."


def _too_short(seconds: float | None, learn: float | None) -> str:
    """Why a recording of ``seconds`` cannot be played as a live one whose first ``learn`` seconds show the road."""
    learn = LEARNS if learn is None else learn
    if seconds is None or learn < seconds:
        return ""
    return (
        f"This recording lasts {seconds:.1f} s, and the empty road would be learned for {learn:g} s of them: nothing "
        "would be measured. Learn for less, or take a longer recording."
    )


def _ended(run: Run) -> str:
    return {"failed": "could not be measured", "cancelled": "was cancelled"}.get(run.state, "was interrupted")
