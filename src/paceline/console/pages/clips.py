"""The start page: every clip with a thumbnail and its state, and the import of new ones."""

from __future__ import annotations

import time
from urllib.parse import quote

from nicegui import run, ui

from paceline.console.confinement import NotFound
from paceline.console.library import STATE_BEING_READ, ClipEntry, Library
from paceline.console.pages.layout import (
    READ_ONLY_TEXT,
    RESPONSE_TIMEOUT_S,
    badge,
    clip_label,
    format_created,
    page,
    progress_text,
    runs_address,
    setup_address,
)

REFRESH_INTERVAL_S = 1.5  # time between updates of the list
LIST_TIMEOUT_S = 1.0  # time limit for reading the clips; slower ones are shown as being read
STATES_BEFORE_RESULTS = ("no paths", "no vehicles", "ready", "unreadable", "no rig", "no target", STATE_BEING_READ)

HELP_TEXT = (
    "A clip is one recording of a road by two fixed cameras. Import one, draw the road line and the vehicles, measure, "
    "and view the speeds with their uncertainty. Or import a recording by one camera behind a vehicle: the distance of "
    "the vehicle ahead is measured."
)


def add(library: Library) -> None:
    """Adds the page / to the application."""

    @ui.page("/", response_timeout=RESPONSE_TIMEOUT_S)
    async def clips() -> None:
        with page("Clips"):
            with ui.element("div").classes("pl-row"):
                ui.label("Clips").classes("pl-title").props('role="heading" aria-level="1"')
                if not library.read_only:
                    ui.element("pl-import")
            ui.label(READ_ONLY_TEXT if library.read_only else HELP_TEXT).classes("pl-help")
            grid = ui.element("div").classes("pl-grid")
            ui.add_body_html('<script type="module" src="/static/importer.js"></script>')
        shown_entries: list[ClipEntry] | None = None

        async def refresh() -> None:
            nonlocal shown_entries
            entries = await run.io_bound(_read_entries, library)
            if entries is None or entries == shown_entries:
                return
            shown_entries = entries
            grid.clear()
            with grid:
                if not entries:
                    ui.label("There is no clip in this folder yet.").classes("pl-empty")
                for entry in entries:
                    _show_card(entry)

        ui.timer(REFRESH_INTERVAL_S, refresh)


def _read_entries(library: Library) -> list[ClipEntry]:
    entries, deadline = [], time.monotonic() + LIST_TIMEOUT_S
    for name in library.names():
        try:
            entries.append(library.entry(name, max(deadline - time.monotonic(), 0.0)))
        except NotFound:  # it has been removed
            continue
    return entries


def _show_card(entry: ClipEntry) -> None:
    measured = entry.contents.live or (bool(entry.runs) and entry.state not in STATES_BEFORE_RESULTS)
    target = runs_address(entry.name) if measured else setup_address(entry.name)
    with ui.link(target=target).classes("pl-card"):
        if not entry.contents.pictures:
            ui.element("div").classes("pl-thumbnail")
        else:
            source = f"/api/thumbnail?clip={quote(entry.name, safe='')}"
            ui.element("img").classes("pl-thumbnail").props["src"] = source
        with ui.element("div").classes("pl-row"):
            ui.label(clip_label(entry.name)).classes("pl-name")
            badge(entry.state)
        contents, runs = entry.contents, _count(len(entry.runs), "run")
        if contents.chase:
            counts = [f"follows the {contents.target}" if contents.target else "one camera", runs]
        else:
            counts = [_count(contents.vehicles, "vehicle"), _count(contents.paths, "path"), runs]
        if entry.state not in ("unreadable", STATE_BEING_READ):
            ui.label(", ".join(counts)).classes("pl-fact")
        active = next((r for r in reversed(entry.runs) if r.active), None)
        latest = format_created(entry.runs[0]) if entry.runs else ""
        line = progress_text(active) if active else entry.reason or (f"last run {latest}" if latest else "")
        if line:
            ui.label(line).classes("pl-reason")


def _count(number: int, noun: str) -> str:
    return f"{number or 'no'} {noun}{'' if number == 1 else 's'}"
