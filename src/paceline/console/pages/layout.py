"""Parts that all pages share: the header with its tabs, addresses of pages, and the display of times and states."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import quote

from nicegui import ui

from paceline.console.library import ClipEntry
from paceline.console.runs.kinds import LIVE_RUN
from paceline.console.runs.run_queue import (
    STATE_FAILED,
    STATE_INTERRUPTED,
    STATE_MEASURED,
    STATE_NOTHING,
    STATE_RUNNING,
    STATE_WAITING,
    Run,
)
from paceline.progress import COMPILING_ACTIVITY, describe_progress

STYLESHEET_LINK = '<link rel="stylesheet" href="/static/console.css">'
ACCENT_COLOR = "#2f7ac4"
PREPARING_ACTIVITIES = ("estimating", "looking", "averaging")  # activities of progress lines that come before measuring
BACKGROUND_ACTIVITY = "learning"  # the activity of a live run before it measures
TAB_SET_UP, TAB_TARGET, TAB_RUNS = "Set up", "Target", "Run and results"
READ_ONLY_TEXT = "This folder cannot be written: clips and results can be viewed, not changed or measured."
RESPONSE_TIMEOUT_S = 60.0  # time limit of a page whose clip is on a slow disk
STATE_TONES = {
    STATE_MEASURED: "good",
    "ready": "good",
    STATE_RUNNING: "busy",
    STATE_WAITING: "busy",
    "live": "busy",
    STATE_NOTHING: "warn",
    STATE_INTERRUPTED: "warn",
    "no rig": "warn",
    STATE_FAILED: "bad",
    "unreadable": "bad",
}  # others are calm


@contextmanager
def page(title: str, entry: ClipEntry | None = None, active_tab: str = "") -> Iterator[None]:
    """The header of a page and, within the context, its contents; ``active_tab`` is the one of the clip's tabs."""
    ui.page_title(f"{title} – Paceline")
    ui.add_head_html(STYLESHEET_LINK)
    ui.colors(primary=ACCENT_COLOR)
    with ui.header(elevated=False).classes("pl-header"):
        ui.link("Paceline", "/").classes("pl-brand")
        if entry is not None:
            tabs = (TAB_TARGET if entry.contents.chase else TAB_SET_UP, TAB_RUNS)
            ui.label(clip_label(entry.name)).classes("pl-clip")
            with ui.element("nav").classes("pl-tabs").props('aria-label="Parts of this clip"'):
                for name, target in zip(tabs, (setup_address(entry.name), runs_address(entry.name)), strict=True):
                    link = ui.link(name, target).classes("pl-tab")
                    if name == active_tab:
                        link.classes("pl-here").props('aria-current="page"')
    with ui.element("main").classes("pl-main"):
        yield


def clip_label(clip: str) -> str:
    """The displayed name of a clip."""
    return "this folder's clip" if clip == "." else clip


def setup_address(clip: str) -> str:
    """The address of a clip's set-up page."""
    return f"/setup?clip={quote(clip, safe='')}"


def runs_address(clip: str, number: int | None = None) -> str:
    """The address of the page of a clip's runs, or of one of them."""
    return f"/runs?clip={quote(clip, safe='')}" + ("" if number is None else f"&number={number}")


def badge(state: str) -> None:
    """A small coloured label of a state."""
    ui.label(state).classes(f"pl-badge pl-{STATE_TONES.get(state, 'calm')}")


def not_found_page() -> None:
    """The page for an address without a clip."""
    with page("Not found"):
        ui.label("There is no such clip here.").classes("pl-title")
        ui.link("All clips", "/")


def format_duration(seconds: float) -> str:
    """For example 8 s, 3 min 20 s, 1 h 5 min."""
    total_s = max(round(seconds), 0)
    if total_s < 60:
        return f"{total_s} s"
    if total_s < 3600:
        return f"{total_s // 60} min {total_s % 60} s"
    return f"{total_s // 3600} h {total_s % 3600 // 60} min"


def format_created(run: Run) -> str:
    """The time at which a run was requested."""
    return time.strftime("%-d %B %Y, %H:%M", time.localtime(run.created))


def progress_text(run: Run) -> str:
    """The progress of an active run; empty for others."""
    if run.state == STATE_WAITING:
        return "waiting for the previous run"
    if run.state != STATE_RUNNING:
        return ""
    if run.kind == LIVE_RUN and run.doing not in (BACKGROUND_ACTIVITY, COMPILING_ACTIVITY) and run.started is not None:
        return f"running for {format_duration(time.time() - run.started)}"
    if not run.doing:
        return "starting"
    left = run.seconds_left(time.time())
    text = describe_progress(run.doing, run.done, run.total)
    return text if left is None else f"{text}, about {format_duration(left)} left"
