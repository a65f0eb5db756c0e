"""The first page: every clip with its picture and its state, and the way in for new ones."""

from __future__ import annotations

import time
from urllib.parse import quote

from nicegui import run, ui

from paceline.console.confinement import NotHere
from paceline.console.library import BEING_READ, Entry, Library
from paceline.console.pages.layout import (
    PATIENCE,
    READ_ONLY,
    badge,
    moment,
    page,
    progress,
    runs_address,
    setup_address,
    shown_name,
)

AGAIN = 1.5  # s between looks at the folder
PATIENT = 1.0  # s for clips to be read; the list does not wait for longer
NOT_YET = ("no paths", "no vehicles", "ready", "unreadable", "no rig", "no target", BEING_READ)

HELP = (
    "A clip is one recording of a road by two fixed cameras. Import one, draw the road line and the vehicles, measure, "
    "and read the speeds with their uncertainty. Or a recording by one camera behind a vehicle: how far ahead it is."
)


def add(library: Library) -> None:
    @ui.page("/", response_timeout=PATIENCE)
    async def clips() -> None:
        with page("Clips"):
            with ui.element("div").classes("pl-row"):
                ui.label("Clips").classes("pl-title").props('role="heading" aria-level="1"')
                if not library.read_only:
                    ui.element("pl-import")
            ui.label(READ_ONLY if library.read_only else HELP).classes("pl-help")
            grid = ui.element("div").classes("pl-grid")
            ui.add_body_html('<script type="module" src="/static/importer.js"></script>')
        shown: list[Entry] | None = None

        async def look() -> None:
            nonlocal shown
            entries = await run.io_bound(_entries, library)
            if entries is None or entries == shown:
                return
            shown = entries
            grid.clear()
            with grid:
                if not entries:
                    ui.label("There is no clip in this folder yet.").classes("pl-empty")
                for entry in entries:
                    _card(entry)

        ui.timer(AGAIN, look)


def _entries(library: Library) -> list[Entry]:
    found, until = [], time.monotonic() + PATIENT
    for name in library.names():
        try:
            found.append(library.entry(name, max(until - time.monotonic(), 0.0)))
        except NotHere:  # removed in the meantime
            continue
    return found


def _card(entry: Entry) -> None:
    measured = entry.contents.live or (bool(entry.runs) and entry.state not in NOT_YET)
    target = runs_address(entry.name) if measured else setup_address(entry.name)
    with ui.link(target=target).classes("pl-card"):
        if not entry.contents.pictures:
            ui.element("div").classes("pl-thumbnail")
        else:
            source = f"/api/thumbnail?clip={quote(entry.name, safe='')}"
            ui.element("img").classes("pl-thumbnail").props["src"] = source
        with ui.element("div").classes("pl-row"):
            ui.label(shown_name(entry.name)).classes("pl-name")
            badge(entry.state)
        what, runs = entry.contents, _count(len(entry.runs), "run")
        if what.chase:
            counts = [f"follows the {what.target}" if what.target else "one camera", runs]
        else:
            counts = [_count(what.vehicles, "vehicle"), _count(what.paths, "path"), runs]
        if entry.state not in ("unreadable", BEING_READ):
            ui.label(", ".join(counts)).classes("pl-fact")
        active = next((r for r in reversed(entry.runs) if r.active), None)
        latest = moment(entry.runs[0]) if entry.runs else ""
        line = progress(active) if active else entry.reason or (f"last run {latest}" if latest else "")
        if line:
            ui.label(line).classes("pl-reason")


def _count(number: int, what: str) -> str:
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"
