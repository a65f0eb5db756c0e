"""The set-up page: shows a clip and lets paths and vehicles, or the target, be drawn by the editors in static/."""

from __future__ import annotations

from nicegui import run, ui

from paceline.console.confinement import NotFound
from paceline.console.library import Library
from paceline.console.pages.layout import (
    RESPONSE_TIMEOUT_S,
    TAB_SET_UP,
    TAB_TARGET,
    badge,
    not_found_page,
    page,
    runs_address,
)

LIVE_SETUP_TEXT = (
    "The cameras are live: their frames are not shown here. Paths come from the site file or the clip.yaml, or lanes "
    "are detected at the start. Vehicles are detected automatically. Continue with Run and results."
)


def add(library: Library) -> None:
    """Adds the page /setup to the application."""

    @ui.page("/setup", response_timeout=RESPONSE_TIMEOUT_S)
    async def setup(clip: str = ".") -> None:
        try:
            entry = await run.io_bound(library.entry, clip)
        except NotFound:
            return not_found_page()
        assert entry is not None, "is None only while the server ends"
        contents = entry.contents
        with page(f"Set up {clip}", entry, TAB_TARGET if contents.chase else TAB_SET_UP):
            if not contents.pictures:
                with ui.element("div").classes("pl-panel"):
                    badge(entry.state)
                    ui.label(LIVE_SETUP_TEXT if contents.live and not contents.state else entry.reason).classes(
                        "pl-reason"
                    )
                    if entry.state == "no rig" and not library.read_only:
                        element = ui.element("pl-rig")
                        element.props["clip"] = clip
                ui.add_body_html('<script type="module" src="/static/importer.js"></script>')
                return
            editor = ui.element("pl-target" if contents.chase else "pl-editor")
            editor.props["clip"] = clip
            editor.props["runs"] = runs_address(clip)
            if library.read_only:
                editor.props["readonly"] = True
            script = "target" if contents.chase else "editor"
            ui.add_body_html(f'<script type="module" src="/static/{script}.js"></script>')
