"""Paceline measures how fast vehicles move, with ordinary cameras.

The names below are the Python API. They are imported when first used, so that ``import paceline`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from paceline.version import __version__ as __version__

if TYPE_CHECKING:
    from paceline.documents.loading import load_clip, load_follow, load_rig
    from paceline.errors import UnusableInput
    from paceline.follow.configuration import FollowConfiguration
    from paceline.follow.following import follow_recording, tracker_for
    from paceline.follow.tracker import FollowTracker
    from paceline.recordings.monocular import open_camera
    from paceline.recordings.stereo import open_recording
    from paceline.reports import write_report
    from paceline.reports.follow.report import follow_and_report
    from paceline.speed.configuration import SpeedConfiguration
    from paceline.speed.filter.tracker import Tracker
    from paceline.survey.recording import measure_clip as measure

__all__ = [
    "FollowConfiguration",
    "FollowTracker",
    "SpeedConfiguration",
    "Tracker",
    "UnusableInput",
    "follow_and_report",
    "follow_recording",
    "load_clip",
    "load_follow",
    "load_rig",
    "measure",
    "open_camera",
    "open_recording",
    "tracker_for",
    "write_report",
]

_HOMES = {
    "FollowConfiguration": ("paceline.follow.configuration", "FollowConfiguration"),
    "FollowTracker": ("paceline.follow.tracker", "FollowTracker"),
    "SpeedConfiguration": ("paceline.speed.configuration", "SpeedConfiguration"),
    "Tracker": ("paceline.speed.filter.tracker", "Tracker"),
    "UnusableInput": ("paceline.errors", "UnusableInput"),
    "follow_and_report": ("paceline.reports.follow.report", "follow_and_report"),
    "follow_recording": ("paceline.follow.following", "follow_recording"),
    "load_clip": ("paceline.documents.loading", "load_clip"),
    "load_follow": ("paceline.documents.loading", "load_follow"),
    "load_rig": ("paceline.documents.loading", "load_rig"),
    "measure": ("paceline.survey.recording", "measure_clip"),
    "open_camera": ("paceline.recordings.monocular", "open_camera"),
    "open_recording": ("paceline.recordings.stereo", "open_recording"),
    "tracker_for": ("paceline.follow.following", "tracker_for"),
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
