"""The part of the Python API that measures the vehicles of stereo clips, as plain functions of a clip.

`paceline/__init__.py` lists the whole API. A clip is the path of a clip.yaml, or what `load_clip` returned for it.
Input that cannot be used raises UnusableInput.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import paceline.baselines.registry  # noqa: F401  registers the baselines
from paceline.detection import search
from paceline.detection.background_model import DetectBoxes, DetectorBackground, RunningMedianBackground
from paceline.detection.finder import VehicleFinder
from paceline.detection.lane_paths import lane_paths_of
from paceline.documents.loading import Clip, load_clip
from paceline.errors import UnusableInput
from paceline.imaging.recorded_cameras import estimate_cameras
from paceline.progress import Progress
from paceline.recordings.background import background_problem, estimate_background
from paceline.recordings.stereo import StereoFrame, open_recording
from paceline.speed import measurement
from paceline.speed.choices import DeviceName
from paceline.speed.configuration import DEFAULTS, SpeedConfiguration
from paceline.speed.filter.estimate import Estimate
from paceline.survey.recording import measure_clip as measure

__all__ = ["find_vehicles", "measure", "track", "vehicle_finder"]


def track(
    clip: Clip | Path | str,
    configuration: SpeedConfiguration | None = None,
    *,
    vehicle: str | None = None,
    frames: Iterable[StereoFrame] | None = None,
    device: DeviceName = "cpu",
) -> Iterator[Estimate]:
    """The filter's estimates of a clip's vehicles, frame by frame::

        for estimate in paceline.track("clip.yaml"):
            print(estimate.vehicle, estimate.time, estimate.speed, estimate.speed_std)

    All vehicles are tracked, or only the one whose id is ``vehicle``. If the clip outlines none, they are detected
    first. ``frames`` replaces the clip's recording by any source of `StereoFrame`, such as a live one. The refined
    speed needs the whole track: see `measure`.
    """
    loaded = _resolve_clip(clip)
    if loaded.vehicles and vehicle is not None:
        loaded = _only(loaded, vehicle)
    if frames is None:
        cameras = estimate_cameras(loaded, open_recording(loaded))
        loaded, recording = cameras.clip, cameras.recording
        if not loaded.vehicles:
            found = search.find_vehicles(loaded, recording, configuration=configuration or DEFAULTS)
            loaded = cameras.with_vehicles(found.clip).clip
            loaded = loaded if vehicle is None else _only(loaded, vehicle)
        frames = recording.frames(min((v.frame for v in loaded.vehicles), default=0))
    return measurement.track(loaded, frames, configuration or DEFAULTS, device)


def find_vehicles(
    clip: Clip | Path | str,
    progress: Progress | None = None,
    detect: DetectBoxes | None = None,
    configuration: SpeedConfiguration | None = None,
) -> search.SearchResult:
    """The vehicles that drive through a clip: their outlines and paths, and why some cannot be measured.

    ``detect`` is an object detector; if it is given, vehicles are searched for only inside its boxes.
    """
    loaded = _resolve_clip(clip)
    return search.find_recorded_vehicles(loaded, open_recording(loaded), progress, detect, configuration or DEFAULTS)


def vehicle_finder(
    clip: Clip | Path | str, detect: DetectBoxes | None = None, configuration: SpeedConfiguration | None = None
) -> VehicleFinder:
    """A finder of vehicles to be given frames one by one; see `find_vehicles` for a whole recording.

    The background is first estimated from some frames of the clip's recording, unless an object detector ``detect`` is
    given, which needs no background. The clip needs paths.
    """
    loaded = _resolve_clip(clip)
    if not loaded.paths:
        raise UnusableInput(f"{loaded.path}: paths: none; expected some, such as paceline lanes adds")
    settings = configuration or DEFAULTS
    lanes = lane_paths_of(loaded, settings.line_sigma)
    if detect is not None:
        return VehicleFinder(lanes, DetectorBackground(detect), settings)
    background = estimate_background(open_recording(loaded), settings.background.frames)
    if reason := background_problem(background):
        raise UnusableInput(f"{loaded.path}: {reason}")
    return VehicleFinder(lanes, RunningMedianBackground(background.images), settings)


def _only(clip: Clip, vehicle: str) -> Clip:
    """The ``clip`` with the ``vehicle`` of this id alone. Raises UnusableInput where there is none."""
    if vehicle not in (names := [v.id for v in clip.vehicles]):
        raise UnusableInput(f"{clip.path}: vehicles: none is called {vehicle!r}; expected one of {', '.join(names)}")
    return replace(clip, vehicles=[v for v in clip.vehicles if v.id == vehicle])


def _resolve_clip(clip: Clip | Path | str) -> Clip:
    """The clip itself, or the one that is read from the file ``clip``."""
    return clip if isinstance(clip, Clip) else load_clip(Path(clip))
