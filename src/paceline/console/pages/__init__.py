"""The console's pages."""

from __future__ import annotations

from paceline.console.library import Library
from paceline.console.pages import clips, editor, runs


def add_pages(library: Library) -> None:
    """Adds every page to the application."""
    clips.add(library)
    editor.add(library)
    runs.add(library)
