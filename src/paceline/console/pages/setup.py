"""Looking at a clip, and drawing its road lines and vehicles. The work is done by the stereo editor in static/."""

from __future__ import annotations

from nicegui import run, ui

from paceline.console.library import Library
from paceline.console.pages.layout import PATIENCE, badge, not_here, page, runs_address
from paceline.console.safety import NotHere


def add(library: Library) -> None:
    @ui.page("/setup", response_timeout=PATIENCE)
    async def setup(clip: str = ".") -> None:
        try:
            entry = await run.io_bound(library.entry, clip)
        except NotHere:
            return not_here()
        assert entry is not None, "is None only while the server ends"
        with page(f"Set up {clip}", clip, "Set up"):
            if entry.state in ("unreadable", "no rig"):
                with ui.element("div").classes("pl-panel"):
                    badge(entry.state)
                    ui.label(entry.reason).classes("pl-reason")
                    if entry.state == "no rig":
                        element = ui.element("pl-rig")
                        element.props["clip"] = clip
                ui.add_body_html('<script type="module" src="/static/importer.js"></script>')
                return
            editor = ui.element("pl-editor")
            editor.props["clip"] = clip
            editor.props["runs"] = runs_address(clip)
            ui.add_body_html('<script type="module" src="/static/editor.js"></script>')
