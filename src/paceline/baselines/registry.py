"""From a clip to speeds by one of the methods that ours is compared with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from paceline.baselines.kalman import Kalman
from paceline.baselines.lucas_kanade import LucasKanade
from paceline.baselines.multimodal import Multimodal
from paceline.baselines.sift import Sift
from paceline.documents.loading import Clip, VehicleDocument
from paceline.errors import UnusableInput
from paceline.progress import Progress
from paceline.recordings.stereo import StereoRecording
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.geometry.paths import Path
from paceline.speed.measurement import Run, measure_each
from paceline.speed.results import ClipResult
from paceline.speed.verdict import apply_tolerance

Method = Callable[[Clip, VehicleDocument, Path | None, SpeedConfiguration], Run]

METHODS: dict[str, Method] = {
    "sift": lambda clip, vehicle, path, configuration: Sift(clip.rig, vehicle),
    "kalman": lambda clip, vehicle, path, configuration: Kalman(clip.rig, vehicle, configuration, wander=False),
    "kalman-wander": lambda clip, vehicle, path, configuration: Kalman(clip.rig, vehicle, configuration, wander=True),
    "multimodal": lambda clip, vehicle, path, configuration: Multimodal(clip.rig, vehicle, path, configuration),
    "lucas-kanade": lambda clip, vehicle, path, configuration: LucasKanade(clip.rig, vehicle),
}

ON_A_PATH = {"multimodal"}  # methods that make use of the drawn path


def measure(
    clip: Clip,
    recording: StereoRecording,
    method: str,
    configuration: SpeedConfiguration,
    progress: Progress | None = None,
) -> ClipResult:
    """Measure every vehicle of ``clip`` by ``method``, one of METHODS, in one pass over its ``recording``.

    ``progress`` is called with frames done and frames in all. Raises UnusableInput.
    """
    if method not in METHODS:
        raise UnusableInput(f"--method {method}: unknown; expected one of {', '.join(METHODS)}")

    def begin(clip: Clip, vehicle: VehicleDocument, drawn: dict[str, Path], configuration: SpeedConfiguration) -> Run:
        return METHODS[method](clip, vehicle, drawn.get(vehicle.path or ""), configuration)

    result = measure_each(clip, recording, configuration, begin, progress, on_paths=method in ON_A_PATH)
    tolerated = [apply_tolerance(m, configuration.tolerance) for m in result.measurements]
    return replace(result, measurements=tolerated, configuration={"method": method} | result.configuration)
