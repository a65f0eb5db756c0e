"""The particle filter of [Zhu] as printed: nothing but the dynamics proposes particles, the drawn path is a hard
constraint, and no fit of the whole track follows."""

from __future__ import annotations

from paceline.documents.loading import Clip
from paceline.progress import Stage, no_stage
from paceline.recordings.stereo import StereoFrames
from paceline.speed.choices import DeviceName
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.measurement import measure
from paceline.speed.methods import Method, OnEstimate, register
from paceline.speed.results import ClipResult


def as_printed(configuration: SpeedConfiguration) -> SpeedConfiguration:
    """``configuration`` without what this project adds to the filter; its noises and particles are kept."""
    return configuration.model_copy(update={"guided": False, "exact_path": True, "refine": False})


def measure_as_printed(
    clip: Clip,
    recording: StereoFrames,
    configuration: SpeedConfiguration,
    stage: Stage = no_stage,
    device: DeviceName = "cpu",
    on_estimate: OnEstimate | None = None,
) -> ClipResult:
    """Measure every vehicle of ``clip`` by the filter as printed. Raises UnusableInput and DeviceFailure."""
    return measure(clip, recording, as_printed(configuration), stage, device, on_estimate)


register("zhu", Method(measure_as_printed, uses_gpu=True))
