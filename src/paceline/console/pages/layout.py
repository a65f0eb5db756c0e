"""What all pages share: the head of the page, addresses, and words for times and states."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import quote

from nicegui import ui

from paceline.console.library import BEING_READ, Entry
from paceline.console.runs.kinds import AHEAD, LIVE
from paceline.console.runs.run_list import CANCELLED, FAILED, INTERRUPTED, MEASURED, NOTHING, RUNNING, WAITING, Run

HEAD = '<link rel="stylesheet" href="/static/console.css">'
ACCENT = "#2f7ac4"
DOING = {"looking": "looking for vehicles: ", "averaging": "looking for lanes: "}
LEARNING = "learning"
SET_UP, READ_AND_MEASURE = "Set up", "Measure and read"
TARGET, READ_AND_FOLLOW = "Target", "Follow and read"
READ_ONLY = "This folder cannot be written: its clips can be looked at and read, not changed or measured."
PATIENCE = 60.0  # s, for a page whose clip lies on a slow disk
TONES = {
    MEASURED: "good", "ready": "good", RUNNING: "busy", WAITING: "busy", NOTHING: "warn", INTERRUPTED: "warn",
    CANCELLED: "calm", FAILED: "bad", "unreadable": "bad", "no rig": "warn", "no paths": "calm", "no vehicles": "calm",
    "no target": "calm", "live": "busy", BEING_READ: "calm",
}  # fmt: skip


@contextmanager
def page(title: str, entry: Entry | None = None, here: str = "") -> Iterator[None]:
    """The head of a page and, within the context, its contents; ``here`` is the tab that is shown of a clip."""
    ui.page_title(f"{title} – Paceline")
    ui.add_head_html(HEAD)
    ui.colors(primary=ACCENT)
    with ui.header(elevated=False).classes("pl-header"):
        ui.link("Paceline", "/").classes("pl-brand")
        if entry is not None:
            tabs = (TARGET, READ_AND_FOLLOW) if entry.contents.chase else (SET_UP, READ_AND_MEASURE)
            ui.label(shown_name(entry.name)).classes("pl-clip")
            with ui.element("nav").classes("pl-tabs").props('aria-label="Parts of this clip"'):
                for name, target in zip(tabs, (setup_address(entry.name), runs_address(entry.name)), strict=True):
                    link = ui.link(name, target).classes("pl-tab")
                    if name == here:
                        link.classes("pl-here").props('aria-current="page"')
    with ui.element("main").classes("pl-main"):
        yield


def shown_name(clip: str) -> str:
    return "this folder's clip" if clip == "." else clip


def setup_address(clip: str) -> str:
    return f"/setup?clip={quote(clip, safe='')}"


def runs_address(clip: str, number: int | None = None) -> str:
    return f"/runs?clip={quote(clip, safe='')}" + ("" if number is None else f"&number={number}")


def badge(state: str) -> None:
    """A state as a small coloured word."""
    ui.label(state).classes(f"pl-badge pl-{TONES.get(state, 'calm')}")


def not_here() -> None:
    """What is shown for an address that leads nowhere."""
    with page("Not here"):
        ui.label("There is no such clip here.").classes("pl-title")
        ui.link("All clips", "/")


def duration(seconds: float) -> str:
    """For people: 8 s, 3 min 20 s, 1 h 5 min."""
    whole = max(round(seconds), 0)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def moment(run: Run) -> str:
    """When a run was asked for."""
    return time.strftime("%-d %B %Y, %H:%M", time.localtime(run.created))


def progress(run: Run) -> str:
    """How far a run is, in words."""
    if run.state == WAITING:
        return "waits for the run before it"
    if run.state != RUNNING:
        return ""
    if run.kind == LIVE and run.doing == LEARNING:
        return f"learning the empty road, {run.done} of {run.total} s"
    if run.kind == LIVE and run.started is not None:
        return f"for {duration(time.time() - run.started)}"
    if run.done == 0:
        return "starting"
    if run.done == run.total and run.doing == ("following" if run.kind == AHEAD else "measuring"):
        return "writing the report"
    told = DOING.get(run.doing, "") + f"frame {run.done}" + ("" if run.total is None else f" of {run.total}")
    left = run.seconds_left(time.time())
    return told if left is None else f"{told}, about {duration(left)} left"
