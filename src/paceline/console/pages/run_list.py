"""The list of a clip's runs on its page: number, state and time of each, and the progress of active ones."""

from __future__ import annotations

from collections.abc import Callable

from nicegui import ui

from paceline.console.library import Library
from paceline.console.pages.layout import badge, format_created, format_duration, progress_text
from paceline.console.runs.kinds import LIVE_RUN
from paceline.console.runs.run_queue import Run

STOPPING_TEXT = "stopping; the vehicles seen so far are still measured"


class RunList:
    """The list, updated by `update`; ``choose``, ``stop`` and ``cancel`` are called with the number of a run.

    The recording of a ``live`` clip has no end: its runs are stopped, others cancelled.
    """

    def __init__(
        self,
        library: Library,
        live: bool,
        choose: Callable[[int], None],
        stop: Callable[[int], None],
        cancel: Callable[[int], None],
    ) -> None:
        self.queue, self.live = library.runs, live
        self.choose, self.stop, self.cancel = choose, stop, cancel
        self.container = ui.element("div").classes("pl-runs")
        self.progress_bars: dict[int, tuple[ui.linear_progress, ui.label]] = {}
        self.shown: object = None  # numbers and states that are shown, to build the list anew only on a change

    def update(self, runs: list[Run], chosen: int | None) -> None:
        """Shows ``runs``, the ``chosen`` one marked."""
        listed = chosen, [(r.number, r.state, self.queue.is_stopping(r)) for r in runs]
        if listed != self.shown:
            self.shown = listed
            self._show(runs, chosen)
        for r in runs:
            if r.number in self.progress_bars:
                bar, text = self.progress_bars[r.number]
                bar.value = r.done / r.total if r.total else 0.0
                text.text = STOPPING_TEXT if self.queue.is_stopping(r) else progress_text(r)

    def _show(self, runs: list[Run], chosen: int | None) -> None:
        self.container.clear()
        self.progress_bars.clear()
        with self.container:
            if not runs:
                ui.label("None yet.").classes("pl-fact")
            for r in runs:
                with ui.element("div").classes("pl-run" + (" pl-here" if r.number == chosen else "")):
                    with ui.element("div").classes("pl-row"):
                        name = ui.button(f"Run {r.number}", on_click=lambda _, n=r.number: self.choose(n), color=None)
                        name.props("flat dense no-caps").classes("pl-run-name")
                        badge("live" if r.kind == LIVE_RUN and r.active else r.state)
                    if r.active:
                        self._add_progress(r)
                    else:
                        duration = format_duration(r.ended - r.started) if r.ended and r.started else ""
                        text = [format_created(r), duration, "live" if r.kind == LIVE_RUN else ""]
                        ui.label(", ".join(filter(None, text))).classes("pl-fact")

    def _add_progress(self, r: Run) -> None:
        bar = ui.linear_progress(0.0, show_value=False).props(f'aria-label="Run {r.number}"')
        bar.set_visibility(r.kind != LIVE_RUN)
        with ui.element("div").classes("pl-row"):
            text = ui.label(progress_text(r)).classes("pl-fact")
            self.progress_bars[r.number] = bar, text
            unlimited = r.kind == LIVE_RUN or self.live
            if unlimited and not self.queue.is_stopping(r) and r.started:
                stop = ui.button("Stop", on_click=lambda _, n=r.number: self.stop(n), color=None)
                stop.props("flat dense no-caps").tooltip(
                    "Stops the run; the vehicles seen so far are measured and kept."
                )
            else:
                cancel = ui.button("Cancel", on_click=lambda _, n=r.number: self.cancel(n), color=None)
                cancel.props("flat dense no-caps")
