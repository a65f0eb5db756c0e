"""Paceline measures how fast vehicles move, with ordinary cameras.

The names below are the Python API. They are imported when first used, so that ``import paceline`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from paceline.version import __version__ as __version__

if TYPE_CHECKING:
    from paceline.api import find_vehicles, measure, track, vehicle_finder
    from paceline.detection.onnx_detector import OnnxDetector
    from paceline.documents.loading import load_camera, load_clip, load_follow, load_rig
    from paceline.errors import UnusableInput
    from paceline.follow.configuration import FollowConfiguration
    from paceline.follow.following import estimates as follow
    from paceline.follow.following import follow_recording, tracker_for
    from paceline.follow.tracker import FollowTracker, warm_up
    from paceline.recordings.monocular import open_camera
    from paceline.recordings.odometry import Pose
    from paceline.recordings.stereo import StereoFrame, open_recording
    from paceline.reports import write_report
    from paceline.reports.follow.report import follow_and_report
    from paceline.simulation.chase.clip import write as write_chase_clip
    from paceline.simulation.chase.scene import Occlusion as ChaseOcclusion
    from paceline.simulation.closed_loop.drive_yaml import resolve_drive as load_drive
    from paceline.simulation.closed_loop.loop import ClosedLoop
    from paceline.simulation.random_scenes.drawn import random_chase as random_chase_scene
    from paceline.simulation.random_scenes.drawn import random_crossing as random_crossing_scene
    from paceline.simulation.random_scenes.drawn import random_scene as random_stereo_scene
    from paceline.simulation.stereo.clip import render as render_stereo_clip
    from paceline.simulation.stereo.clip import write as write_stereo_clip
    from paceline.simulation.stereo.clip import write_documents as write_stereo_documents
    from paceline.simulation.stereo.scene import Scene as StereoScene
    from paceline.simulation.stereo.scene import Vehicle as StereoVehicle
    from paceline.speed.configuration import SpeedConfiguration, load_settings
    from paceline.speed.filter.tracker import Tracker
    from paceline.speed.measurement import by_vehicle
    from paceline.speed.methods import Method
    from paceline.speed.results import ClipResult, Measurement
    from paceline.targets.line_model import load_target

__all__ = [
    "ChaseOcclusion",
    "ClipResult",
    "ClosedLoop",
    "OnnxDetector",
    "FollowConfiguration",
    "FollowTracker",
    "Measurement",
    "Method",
    "Pose",
    "SpeedConfiguration",
    "StereoFrame",
    "StereoScene",
    "StereoVehicle",
    "Tracker",
    "UnusableInput",
    "by_vehicle",
    "find_vehicles",
    "follow",
    "follow_and_report",
    "follow_recording",
    "load_camera",
    "load_clip",
    "load_drive",
    "load_follow",
    "load_rig",
    "load_settings",
    "load_target",
    "measure",
    "open_camera",
    "open_recording",
    "random_chase_scene",
    "random_crossing_scene",
    "random_stereo_scene",
    "render_stereo_clip",
    "track",
    "tracker_for",
    "vehicle_finder",
    "warm_up",
    "write_chase_clip",
    "write_report",
    "write_stereo_clip",
    "write_stereo_documents",
]

# The module that defines each name, and its name there. ``follow`` is a package that can be called.
_DEFINING_MODULES = {
    "ChaseOcclusion": ("paceline.simulation.chase.scene", "Occlusion"),
    "ClipResult": ("paceline.speed.results", "ClipResult"),
    "ClosedLoop": ("paceline.simulation.closed_loop.loop", "ClosedLoop"),
    "OnnxDetector": ("paceline.detection.onnx_detector", "OnnxDetector"),
    "FollowConfiguration": ("paceline.follow.configuration", "FollowConfiguration"),
    "FollowTracker": ("paceline.follow.tracker", "FollowTracker"),
    "Measurement": ("paceline.speed.results", "Measurement"),
    "Method": ("paceline.speed.methods", "Method"),
    "Pose": ("paceline.recordings.odometry", "Pose"),
    "SpeedConfiguration": ("paceline.speed.configuration", "SpeedConfiguration"),
    "StereoFrame": ("paceline.recordings.stereo", "StereoFrame"),
    "StereoScene": ("paceline.simulation.stereo.scene", "Scene"),
    "StereoVehicle": ("paceline.simulation.stereo.scene", "Vehicle"),
    "Tracker": ("paceline.speed.filter.tracker", "Tracker"),
    "UnusableInput": ("paceline.errors", "UnusableInput"),
    "by_vehicle": ("paceline.speed.measurement", "by_vehicle"),
    "find_vehicles": ("paceline.api", "find_vehicles"),
    "follow_and_report": ("paceline.reports.follow.report", "follow_and_report"),
    "follow_recording": ("paceline.follow.following", "follow_recording"),
    "load_camera": ("paceline.documents.loading", "load_camera"),
    "load_clip": ("paceline.documents.loading", "load_clip"),
    "load_drive": ("paceline.simulation.closed_loop.drive_yaml", "resolve_drive"),
    "load_follow": ("paceline.documents.loading", "load_follow"),
    "load_rig": ("paceline.documents.loading", "load_rig"),
    "load_settings": ("paceline.speed.configuration", "load_settings"),
    "load_target": ("paceline.targets.line_model", "load_target"),
    "measure": ("paceline.api", "measure"),
    "open_camera": ("paceline.recordings.monocular", "open_camera"),
    "open_recording": ("paceline.recordings.stereo", "open_recording"),
    "random_chase_scene": ("paceline.simulation.random_scenes.drawn", "random_chase"),
    "random_crossing_scene": ("paceline.simulation.random_scenes.drawn", "random_crossing"),
    "random_stereo_scene": ("paceline.simulation.random_scenes.drawn", "random_scene"),
    "render_stereo_clip": ("paceline.simulation.stereo.clip", "render"),
    "track": ("paceline.api", "track"),
    "tracker_for": ("paceline.follow.following", "tracker_for"),
    "vehicle_finder": ("paceline.api", "vehicle_finder"),
    "warm_up": ("paceline.follow.tracker", "warm_up"),
    "write_chase_clip": ("paceline.simulation.chase.clip", "write"),
    "write_report": ("paceline.reports", "write_report"),
    "write_stereo_clip": ("paceline.simulation.stereo.clip", "write"),
    "write_stereo_documents": ("paceline.simulation.stereo.clip", "write_documents"),
}


def __getattr__(name: str) -> object:
    if name == "follow":
        return import_module("paceline.follow")
    if name not in _DEFINING_MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _DEFINING_MODULES[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
