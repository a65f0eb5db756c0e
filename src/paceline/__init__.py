"""Paceline measures how fast vehicles move, with ordinary cameras.

The names below are the Python API. They are imported when first used, so that ``import paceline`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from paceline.documents import load_clip, load_rig
    from paceline.errors import UnusableInput
    from paceline.recordings import open_recording
    from paceline.reports import write_report
    from paceline.speed.configuration import SpeedConfiguration
    from paceline.speed.measurement import measure_clip as measure
    from paceline.speed.tracker import Tracker

__version__ = "0.1.0"
__all__ = [
    "SpeedConfiguration",
    "Tracker",
    "UnusableInput",
    "load_clip",
    "load_rig",
    "measure",
    "open_recording",
    "write_report",
]

_HOMES = {
    "SpeedConfiguration": ("paceline.speed.configuration", "SpeedConfiguration"),
    "Tracker": ("paceline.speed.tracker", "Tracker"),
    "UnusableInput": ("paceline.errors", "UnusableInput"),
    "load_clip": ("paceline.documents", "load_clip"),
    "load_rig": ("paceline.documents", "load_rig"),
    "measure": ("paceline.speed.measurement", "measure_clip"),
    "open_recording": ("paceline.recordings", "open_recording"),
    "write_report": ("paceline.reports", "write_report"),
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
