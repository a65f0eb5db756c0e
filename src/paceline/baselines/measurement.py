"""From a clip to speeds by one of the methods that ours is compared with."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from paceline.baselines.kalman import Kalman
from paceline.baselines.lucas_kanade import LucasKanade
from paceline.baselines.multimodal import Multimodal
from paceline.baselines.sift import Sift
from paceline.documents import Clip, VehicleDocument
from paceline.errors import UnusableInput
from paceline.recordings import StereoFrame, StereoRecording
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.measurement import Progress, versions
from paceline.speed.paths import Path
from paceline.speed.reconstruction import path_of
from paceline.speed.results import ClipResult, Measurement, PathDrawing


class Run(Protocol):
    """One vehicle on its way through a clip."""

    def see(self, frame: StereoFrame) -> bool:
        """Follow the vehicle into ``frame``; whether it can be followed further."""

    def result(self) -> Measurement:
        """The measurement by what was seen."""


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
    begun = time.perf_counter()
    if method not in METHODS:
        raise UnusableInput(f"--method {method}: unknown; expected one of {', '.join(METHODS)}")
    if not clip.vehicles:
        raise UnusableInput(f"{clip.path}: vehicles: none is outlined; expected at least one vehicle to measure")
    for vehicle in clip.vehicles:
        if vehicle.frame not in recording.indices:
            raise UnusableInput(
                f"{clip.path}: vehicles: {vehicle.id}: frame {vehicle.frame} is not in the recording; "
                f"expected one of its frames {recording.indices[0]} to {recording.indices[-1]}"
            )
    drawn = _reconstruct(clip, configuration) if method in ON_A_PATH else {}
    runs = {v.id: METHODS[method](clip, v, drawn.get(v.path or ""), configuration) for v in clip.vehicles}
    done: dict[str, Measurement] = {}
    for count, frame in enumerate(recording.frames(), start=1):
        if count == 1 and np.ptp(frame.left) > 0 and np.array_equal(frame.left, frame.right):
            raise UnusableInput(
                f"{clip.path}: left and right: frame {frame.index} shows the same picture in both; "
                "expected the views of two cameras"
            )
        for vehicle in clip.vehicles:
            run = runs.get(vehicle.id)
            if run is not None and frame.index >= vehicle.frame and not frame.duplicate and not run.see(frame):
                done[vehicle.id] = runs.pop(vehicle.id).result()
        if progress is not None:
            progress(count, len(recording))
        if not runs:
            break
    done |= {name: run.result() for name, run in runs.items()}
    return ClipResult(
        clip=str(clip.path),
        measurements=[done[v.id] for v in clip.vehicles],
        paths=[PathDrawing(p.name, p.points, *clip.rig.project(p.points)) for p in drawn.values()],
        configuration={"method": method} | configuration.model_dump(),
        versions=versions(),
        notices=list(recording.notices),
        seconds=time.perf_counter() - begun,
    )


def _reconstruct(clip: Clip, configuration: SpeedConfiguration) -> dict[str, Path]:
    """The paths that vehicles drive on, by name."""
    if configuration.motion == "free":
        return {}
    shape = None if configuration.motion == "auto" else configuration.motion
    drawn = {}
    for name in dict.fromkeys(v.path for v in clip.vehicles if v.path is not None):
        try:
            drawn[name] = path_of(clip.paths[name], clip.rig, shape)
        except UnusableInput as unusable:
            raise UnusableInput(f"{clip.path}: {unusable}") from None
    return drawn
