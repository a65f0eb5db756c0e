"""The measurement of a clip: every vehicle tracked, refined, and accepted or rejected."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path as FilePath
from typing import Protocol

import numpy as np

from paceline.blas import on_one_blas_thread
from paceline.cameras import StereoRig
from paceline.documents.loading import Clip, VehicleDocument, load_clip
from paceline.errors import UnusableInput
from paceline.progress import Progress, Stage, no_stage, with_progress
from paceline.recordings.stereo import StereoFrame, StereoFrames, open_recording
from paceline.speed import acceptance, methods
from paceline.speed.choices import DeviceName
from paceline.speed.configuration import DEFAULTS, SpeedConfiguration
from paceline.speed.filter.batch import TrackerBatch
from paceline.speed.filter.device import open_device
from paceline.speed.filter.estimate import Estimate
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.geometry.paths import Path, UndeterminedPath
from paceline.speed.joint_calibration import calibrate_jointly, estimate_exposures
from paceline.speed.methods import DEFAULT_METHOD, Method, OnEstimate, register
from paceline.speed.results import ClipResult, Measurement, PathDrawing
from paceline.speed.run import VehicleMeasurement
from paceline.verdicts import Message, message
from paceline.version import versions


def measure_clip(
    clip: Clip | FilePath | str,
    configuration: SpeedConfiguration | None = None,
    progress: Progress | None = None,
    device: DeviceName = "cpu",
) -> ClipResult:
    """Measures every vehicle of ``clip``, a clip.yaml or what `load_clip` returned for it. Raises UnusableInput."""
    loaded = clip if isinstance(clip, Clip) else load_clip(FilePath(clip))
    return methods.measure(
        loaded, open_recording(loaded), DEFAULT_METHOD, configuration or SpeedConfiguration(), progress, device
    )


@on_one_blas_thread
def measure(
    clip: Clip,
    recording: StereoFrames,
    configuration: SpeedConfiguration,
    stage: Stage = no_stage,
    device: DeviceName = "cpu",
    on_estimate: OnEstimate | None = None,
) -> ClipResult:
    """Measure every vehicle of ``clip`` in one pass over its ``recording``.

    ``on_estimate`` is called with a vehicle and each of the filter's estimates. Raises UnusableInput; a DeviceFailure
    where ``device`` is ``cuda`` and fails.
    """
    result = measure_separately(clip, recording, configuration, stage, device, on_estimate)
    exposures = estimate_exposures(result.measurements)
    jointly = calibrate_jointly(result.measurements, configuration)
    measurements = [acceptance.apply_tolerance(m, configuration.tolerance) for m in jointly]
    return replace(result, measurements=measurements, exposures=exposures)


@on_one_blas_thread
def measure_separately(
    clip: Clip,
    recording: StereoFrames,
    configuration: SpeedConfiguration,
    stage: Stage = no_stage,
    device: DeviceName = "cpu",
    on_estimate: OnEstimate | None = None,
) -> ClipResult:
    """As `measure`, before vehicles are calibrated jointly and without a tolerance."""
    batch = TrackerBatch(open_device(device), fall_back_to_cpu=device == "auto")
    begin = partial(VehicleMeasurement, batch=batch, on_estimate=on_estimate)
    result = measure_each(clip, recording, configuration, begin, stage)
    return replace(result, notices=[*result.notices, *batch.notices])


register(DEFAULT_METHOD, Method(measure, uses_gpu=True))


def track(
    clip: Clip,
    frames: Iterable[StereoFrame],
    configuration: SpeedConfiguration = DEFAULTS,
    device: DeviceName = "cpu",
) -> Iterator[Estimate]:
    """The filter's estimates of every vehicle of ``clip``, made as the ``frames`` arrive; it ends with the last track.

    Raises UnusableInput and DeviceFailure as `measure` does.
    """
    batch = TrackerBatch(open_device(device), fall_back_to_cpu=device == "auto")
    estimates: list[Estimate] = []
    filtering = configuration.model_copy(update={"refine": False})  # so that no images are kept
    drawn, _ = _reconstruct(clip, configuration)
    runs = {
        v.id: VehicleMeasurement(
            clip, v, drawn, filtering, batch, on_estimate=lambda name, estimate: estimates.append(estimate)
        )
        for v in clip.vehicles
    }
    for frame in frames:
        for vehicle in clip.vehicles:
            run = runs.get(vehicle.id)
            if (
                run is not None
                and frame.index >= vehicle.frame
                and not frame.duplicate
                and not on_one_blas_thread(run.process)(frame)
            ):
                del runs[vehicle.id]
        yield from estimates
        estimates.clear()
        if not runs:
            return


class VehicleProcessor(Protocol):
    """A method that processes the frames of one vehicle."""

    def process(self, frame: StereoFrame) -> bool:
        """Track the vehicle into ``frame``; False where the track ends."""

    def result(self) -> Measurement:
        """The measurement from the frames so far."""


@on_one_blas_thread
def measure_each(
    clip: Clip,
    recording: StereoFrames,
    configuration: SpeedConfiguration,
    begin: Callable[[Clip, VehicleDocument, dict[str, Path], SpeedConfiguration], VehicleProcessor],
    stage: Stage = no_stage,
    *,
    on_paths: bool = True,
) -> ClipResult:
    """As `measure`, by the processor that ``begin`` makes for each vehicle; paths are reconstructed if ``on_paths``."""
    start_time = time.perf_counter()
    if not clip.vehicles:
        raise UnusableInput(f"{clip.path}: vehicles: none is outlined; expected at least one vehicle to measure")
    for vehicle in clip.vehicles:
        if vehicle.frame not in recording.indices:
            raise UnusableInput(
                f"{clip.path}: vehicles: {vehicle.id}: frame {vehicle.frame} is not in the recording; "
                f"expected one of its frames {recording.indices[0]} to {recording.indices[-1]}"
            )
    drawn, undetermined = _reconstruct(clip, configuration) if on_paths else ({}, [])
    runs = {v.id: begin(clip, v, drawn, configuration) for v in clip.vehicles}
    finished: dict[str, Measurement] = {}
    frames = enumerate(recording.frames(), start=1)
    while runs:
        with stage("measuring") as progress:
            ended = _track_until_one_ends(clip, runs, frames, len(recording), progress)
        with stage("refining") as progress:
            for name in with_progress(ended, len(ended), progress):
                finished[name] = runs.pop(name).result()
    return ClipResult(
        clip=str(clip.path),
        measurements=[finished[v.id] for v in clip.vehicles],
        paths=[_path_drawing(clip.rig, p) for p in drawn.values()],
        configuration=configuration.model_dump(),
        versions=versions(),
        notices=[*undetermined, *recording.notices],
        seconds=time.perf_counter() - start_time,
    )


def _track_until_one_ends(
    clip: Clip,
    runs: dict[str, VehicleProcessor],
    frames: Iterator[tuple[int, StereoFrame]],
    total: int,
    progress: Progress | None,
) -> list[str]:
    """Tracks the vehicles of ``runs`` through the ``frames``, counted from 1 to ``total``, to one in which a track
    ends; returns the vehicles whose tracks end there, which are all at the end of the recording."""
    for count, frame in frames:
        if count == 1:
            require_two_views(clip, frame)
        ended = [
            vehicle.id
            for vehicle in clip.vehicles
            if (run := runs.get(vehicle.id)) is not None
            and frame.index >= vehicle.frame
            and not frame.duplicate
            and not run.process(frame)
        ]
        if progress is not None:
            progress(count, total)
        if ended:
            return ended
    return list(runs)


def by_vehicle(
    begin: Callable[[Clip, VehicleDocument, Path | None, SpeedConfiguration], VehicleProcessor],
    *,
    on_paths: bool = False,
) -> Method:
    """The method that measures each vehicle by itself.

    ``begin`` makes the processor of a vehicle from the clip, the vehicle, its reconstructed path (None without one, or
    unless ``on_paths``) and the configuration.
    """

    def measure_clip(
        clip: Clip,
        recording: StereoFrames,
        configuration: SpeedConfiguration,
        stage: Stage,
        device: DeviceName,
        on_estimate: OnEstimate | None,
    ) -> ClipResult:
        def begin_on(
            clip: Clip, vehicle: VehicleDocument, drawn: dict[str, Path], c: SpeedConfiguration
        ) -> VehicleProcessor:
            return begin(clip, vehicle, drawn.get(vehicle.path or ""), c)

        result = measure_each(clip, recording, configuration, begin_on, stage, on_paths=on_paths)
        return replace(
            result, measurements=[acceptance.apply_tolerance(m, configuration.tolerance) for m in result.measurements]
        )

    return Method(measure_clip)


def require_two_views(clip: Clip, frame: StereoFrame) -> None:
    """Raise UnusableInput where both views of a clip's first ``frame`` are the same image."""
    if np.ptp(frame.left) > 0 and np.array_equal(frame.left, frame.right):
        raise UnusableInput(
            f"{clip.path}: left and right: frame {frame.index} shows the same picture in both; "
            "expected the views of two cameras"
        )


def _reconstruct(clip: Clip, configuration: SpeedConfiguration) -> tuple[dict[str, Path], list[Message]]:
    """The paths of the clip's vehicles in space, as drawn, without their lateral offsets.

    Of a path that its drawing does not determine there is a notice instead: its vehicles are measured in free motion.
    Raises UnusableInput where a motion along such a path was asked for.
    """
    drawn: dict[str, Path] = {}
    undetermined: list[Message] = []
    if configuration.motion == "free":
        return drawn, undetermined
    shape = None if configuration.motion == "auto" else configuration.motion
    for name in dict.fromkeys(v.path for v in clip.vehicles if v.path is not None):
        try:
            drawn[name] = path_from_document(clip.paths[name], clip.rig, shape, configuration.line_sigma)
        except UndeterminedPath as path:
            if shape is not None:
                raise UnusableInput(f"{clip.path}: {path}") from None
            undetermined.append(message("path_undetermined", path=path.name, cause=path.cause))
    return drawn, undetermined


def _path_drawing(rig: StereoRig, path: Path) -> PathDrawing:
    left, right = rig.project(path.points)
    return PathDrawing(path.name, path.points, left, right)
