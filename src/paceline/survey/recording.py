"""From a recorded clip to the speeds of the vehicles in it, found first where it outlines none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from paceline.detection.background_model import Detect
from paceline.detection.search import Search, find_vehicles
from paceline.documents.loading import Clip, load_clip
from paceline.progress import Progress
from paceline.recordings.stereo import StereoRecording, open_recording
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.device import DeviceName
from paceline.speed.measurement import measure
from paceline.speed.results import ClipResult
from paceline.version import versions


def measure_clip(
    clip: Clip | Path | str,
    configuration: SpeedConfiguration | None = None,
    progress: Progress | None = None,
    device: DeviceName = "cpu",
    detect: Detect | None = None,
) -> ClipResult:
    """Measure every vehicle of ``clip``, a clip.yaml or what `load_clip` made of it; where it outlines none, the
    vehicles in it are found first, with ``detect`` only in its boxes. Raises UnusableInput."""
    loaded = clip if isinstance(clip, Clip) else load_clip(Path(clip))
    recording, configuration = open_recording(loaded), configuration or SpeedConfiguration()
    if loaded.vehicles:
        return measure(loaded, recording, configuration, progress, device)
    search = find_vehicles(loaded, recording, progress, detect)
    return measure_found(
        search, recording, configuration, lambda found: measure(found, recording, configuration, progress, device)
    )


def measure_found(
    search: Search,
    recording: StereoRecording,
    configuration: SpeedConfiguration,
    measured: Callable[[Clip], ClipResult],
) -> ClipResult:
    """What ``measured`` makes of the clip with the vehicles found in it, and what the ``search`` has to say; where
    there is no vehicle, why."""
    if search.reason:
        notices = [*recording.notices, *search.notices]
        return ClipResult(str(search.clip.path), [], [], configuration.model_dump(), versions(), notices, 0.0)
    result = measured(search.clip)
    return replace(result, notices=[*result.notices, *search.notices])
