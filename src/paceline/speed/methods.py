"""The registry of measuring methods, by name: each takes a clip, its recording and a configuration and returns speeds.

A method is registered by one line in the module that defines it. Other packages add methods of their own as entry
points of the group ``paceline.methods``; the name of the entry point is the name of the method.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np

from paceline.cameras import VIEW_NAMES, Quantity
from paceline.documents.loading import Clip
from paceline.errors import UnusableInput
from paceline.imaging.frame_times import FrameTimes
from paceline.imaging.recorded_cameras import RecordedCameras, estimate_cameras, growth_std
from paceline.progress import Progress, Stage, frame_stage, no_stage
from paceline.recordings.stereo import StereoFrames, StereoRecording
from paceline.speed.choices import DeviceName
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.estimate import Estimate
from paceline.speed.passage import with_passage
from paceline.speed.results import ClipResult, ExposureEstimate, Measurement
from paceline.verdicts import message

ENTRY_POINT_GROUP = "paceline.methods"  # group of the entry points
DEFAULT_METHOD = "paceline"

OnEstimate = Callable[[str, Estimate], None]  # called with a vehicle's id and each estimate as it is made
MeasureClip = Callable[[Clip, StereoFrames, SpeedConfiguration, Stage, DeviceName, OnEstimate | None], ClipResult]


@dataclass(frozen=True)
class Method:
    """How to measure all vehicles of a clip; ``measure`` raises UnusableInput, and reports its progress in the stages
    ``measuring``, by frames, and ``refining``, by vehicles. A method without ``uses_gpu`` is only ever called with the
    device ``cpu`` or ``auto``."""

    measure: MeasureClip
    uses_gpu: bool = False


_registered: dict[str, Method] = {}
_old_names: dict[str, str] = {}  # accepted, but not listed


def register(name: str, method: Method, old_name: str | None = None) -> None:
    """Makes ``method`` known under ``name``, and under an ``old_name`` that is accepted but not listed.

    Raises ValueError for a name that is taken by another method.
    """
    if _registered.setdefault(name, method) is not method:
        raise ValueError(f"method {name!r} is registered twice")
    if old_name is not None:
        _old_names[old_name] = name


def current_name(name: str) -> str:
    """The present name of a method, given that or an old one."""
    return _old_names.get(name, name)


def method_names() -> list[str]:
    """The names of all methods that are known: those registered, then those of other packages."""
    return [*_registered, *sorted(set(_plugins()) - set(_registered))]


def method_named(name: str, device: DeviceName = "cpu") -> Method:
    """The method called ``name``. Raises UnusableInput where there is none, listing the known ones, and where it does
    not compute on the ``device``."""
    name = current_name(name)
    method = _registered.get(name) or _loaded(name)
    if device == "cuda" and not method.uses_gpu:
        raise UnusableInput(f"--device cuda: --method {name} computes on the CPU only; use --device cpu")
    return method


def _loaded(name: str) -> Method:
    """The method called ``name`` of another package."""
    if name not in (plugins := _plugins()):
        raise UnusableInput(f"--method {name}: unknown; expected one of {', '.join(method_names())}")
    point = plugins[name]
    try:
        method = point.load()
    except Exception as error:  # whatever another package raises while it is imported
        raise UnusableInput(f"--method {name}: {point.value} cannot be loaded ({error})") from error
    if not isinstance(method, Method):
        raise UnusableInput(f"--method {name}: {point.value} is no paceline.Method")
    return method


def measure(
    clip: Clip,
    recording: StereoRecording,
    method: str,
    configuration: SpeedConfiguration,
    progress: Progress | None = None,
    device: DeviceName = "cpu",
    on_estimate: OnEstimate | None = None,
) -> ClipResult:
    """Measure every vehicle of ``clip`` by the ``method`` of this name, after what its ``recording`` tells of the
    cameras has been estimated.

    ``progress`` is called with frames done and frames in all. Raises UnusableInput.
    """
    cameras = estimate_cameras(clip, recording)
    return measure_as_seen(cameras, method, configuration, frame_stage(progress), device, on_estimate)


def measure_as_seen(
    cameras: RecordedCameras,
    method: str,
    configuration: SpeedConfiguration,
    stage: Stage = no_stage,
    device: DeviceName = "cpu",
    on_estimate: OnEstimate | None = None,
) -> ClipResult:
    """As `measure`, of cameras that were estimated before."""
    chosen = method_named(method, device)
    result = chosen.measure(cameras.clip, cameras.recording, configuration, stage, device, on_estimate)
    measurements = [
        replace(
            m,
            track=replace(
                m.track,
                left=cameras.as_recorded(m.track.frame, m.track.left, 0),
                right=cameras.as_recorded(m.track.frame, m.track.right, 1),
                particles_left=cameras.as_recorded(m.track.frame, m.track.particles_left, 0),
                particles_right=cameras.as_recorded(m.track.frame, m.track.particles_right, 1),
            ),
        )
        for m in result.measurements
    ]
    measurements = [with_passage(m, cameras.clip, result.paths) for m in measurements]
    if (found := cameras.frame_times) is not None:
        measurements = [_of_clear_times(m, found) for m in measurements]
    return replace(
        result,
        measurements=measurements,
        notices=[*result.notices, *cameras.notices],
        configuration=named(method) | result.configuration,
        cameras=camera_summary(cameras, result.exposures),
        lag=cameras.lag,
    )


def _of_clear_times(measurement: Measurement, found: FrameTimes) -> Measurement:
    """The ``measurement``, rejected where its track goes on over frames whose times cannot be told."""
    frames = measurement.track.frame[np.array([status == "tracking" for status in measurement.track.status], bool)]
    if measurement.verdict == "rejected" or not len(frames):
        return measurement
    frame = found.unclear_within(int(frames[0]), int(frames[-1]))
    return measurement if frame is None else measurement.with_verdict(message("time_unclear", frame=frame))


def camera_summary(cameras: RecordedCameras, exposures: Mapping[str, ExposureEstimate]) -> dict[str, object]:
    """The entry ``cameras`` of summary.json: what was known of the cameras and what the vehicles add to it."""
    clip = cameras.clip
    summary = cameras.summary()

    def entry(name: str, quantity: Quantity | None) -> dict[str, Any] | None:
        if quantity is None:
            return None
        if name not in exposures:
            return {"value": quantity.value, "std": quantity.std, "source": quantity.source, "speed_effect": 0.0}
        e = exposures[name]
        source = quantity.source if quantity.source == "stated" else "estimated"
        return {
            "value": quantity.value + e.difference,
            "std": e.std,
            "source": source,
            "speed_effect": e.speed_effect,
        }

    views = {
        name: {"readout_s": entry(f"{name} readout", camera.readout), **summary[name]}
        for name, camera in zip(VIEW_NAMES, clip.rig.cameras, strict=True)
    }
    offset = entry("offset", clip.offset)
    return {"offset_s": offset, "rate_difference_ppm": _rate_entry(cameras, offset), **summary, **views}


def _rate_entry(cameras: RecordedCameras, offset: Mapping[str, Any] | None) -> dict[str, object] | None:
    """The entry for the rate by which the ``offset`` between the views, an entry itself, grows: its effect on a speed
    is that of the offset which it amounts to over the recording, RMS. None where the offset is stated as constant."""
    if cameras.rate is None or offset is None:
        return None
    rate, grown = cameras.rate, growth_std(cameras.rate, cameras.recording.times)
    effect = offset["speed_effect"] * grown / offset["std"] if offset["std"] else 0.0
    return {"value": 1e6 * rate.value, "std": 1e6 * rate.std, "source": rate.source, "speed_effect": effect}


def named(method: str) -> dict[str, object]:
    """The entry for ``method`` in a result's configuration: empty for Paceline's own method."""
    return {} if method == DEFAULT_METHOD else {"method": current_name(method)}


def _plugins() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=ENTRY_POINT_GROUP)}
