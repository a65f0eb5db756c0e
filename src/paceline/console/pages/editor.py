"""Looking at a clip, and drawing what is measured. The work is done in static/: by the stereo editor, or the editor of
the vehicle ahead."""

from __future__ import annotations

from nicegui import run, ui

from paceline.console.confinement import NotHere
from paceline.console.library import Library
from paceline.console.pages.layout import PATIENCE, SET_UP, TARGET, badge, not_here, page, runs_address

LIVE = (
    "Its cameras are live: their pictures are not shown here. Paths come from the site file or the clip.yaml, or lanes "
    "are found at the start. Vehicles are found by themselves. Go on to measure."
)


def add(library: Library) -> None:
    @ui.page("/setup", response_timeout=PATIENCE)
    async def setup(clip: str = ".") -> None:
        try:
            entry = await run.io_bound(library.entry, clip)
        except NotHere:
            return not_here()
        assert entry is not None, "is None only while the server ends"
        contents = entry.contents
        with page(f"Set up {clip}", entry, TARGET if contents.chase else SET_UP):
            if not contents.pictures:
                with ui.element("div").classes("pl-panel"):
                    badge(entry.state)
                    ui.label(LIVE if contents.live and not contents.state else entry.reason).classes("pl-reason")
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
