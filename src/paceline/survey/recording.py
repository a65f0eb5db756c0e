"""The speeds of all vehicles of a recording: those that its clip.yaml outlines, or else those detected in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from paceline.detection.background_model import DetectBoxes
from paceline.detection.onnx_detector import OnnxDetector
from paceline.detection.search import find_vehicles
from paceline.documents.loading import Clip, load_clip
from paceline.errors import UnusableInput
from paceline.imaging.recorded_cameras import RecordedCameras, estimate_cameras
from paceline.progress import Progress, Stage, frame_stage, no_stage
from paceline.recordings.stereo import StereoRecording, open_recording
from paceline.speed import methods
from paceline.speed.choices import DeviceName
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.methods import DEFAULT_METHOD, OnEstimate
from paceline.speed.results import ClipResult
from paceline.version import versions


def measure_clip(
    clip: Clip | Path | str,
    configuration: SpeedConfiguration | None = None,
    progress: Progress | None = None,
    device: DeviceName = "cpu",
    detect: DetectBoxes | None = None,
    method: str = DEFAULT_METHOD,
) -> ClipResult:
    """Measures every vehicle of ``clip``, a clip.yaml or what `load_clip` returned for it, by the ``method``
    of this name; if it outlines none, the vehicles in it are detected first, with ``detect`` only in its boxes.

    ``progress`` is called with the number of processed frames and their total. Raises UnusableInput.
    """
    loaded = clip if isinstance(clip, Clip) else load_clip(Path(clip))
    return measure_recording(
        loaded,
        open_recording(loaded),
        configuration or SpeedConfiguration(),
        method,
        device,
        detect,
        stage=frame_stage(progress),
    )


def measure_recording(
    clip: Clip,
    recording: StereoRecording,
    configuration: SpeedConfiguration,
    method: str = DEFAULT_METHOD,
    device: DeviceName = "cpu",
    detect: DetectBoxes | None = None,
    stage: Stage = no_stage,
    on_estimate: OnEstimate | None = None,
) -> ClipResult:
    """As `measure_clip`, in the ``recording`` of ``clip``; ``on_estimate`` is called with a vehicle and each of the
    filter's estimates as it is made."""
    if detect is not None and clip.vehicles:
        raise UnusableInput(f"{clip.path}: vehicles: --detector is to find them; expected none")

    with stage("estimating") as progress:
        cameras = estimate_cameras(clip, recording, progress)

    def measured(cameras: RecordedCameras) -> ClipResult:
        return methods.measure_as_seen(cameras, method, configuration, stage, device, on_estimate)

    if clip.vehicles:
        return measured(cameras)
    with stage("looking") as progress:
        search = find_vehicles(cameras.clip, cameras.recording, progress, detect, configuration)
    if search.reason:
        notices = [*cameras.recording.notices, *search.notices, *cameras.notices]
        settings = methods.named(method) | configuration.model_dump()
        summary = methods.camera_summary(cameras, {})
        result = ClipResult(str(clip.path), [], [], settings, versions(), notices, 0.0, cameras=summary)
    else:
        result = measured(cameras.with_vehicles(search.clip))
        result = replace(result, notices=[*result.notices, *search.notices])
    if isinstance(detect, OnnxDetector):
        result = replace(
            result,
            configuration={**result.configuration, "detector": detect.name},
            versions={**result.versions, "onnxruntime": detect.runtime},
        )
    return result
