"""All methods on one clip: what the figures of [Zhu] are drawn from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from common import MPH, measured, rms

import paceline.baselines.registry  # noqa: F401  makes the baselines known
from paceline import open_recording
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.estimate import Estimate
from paceline.speed.methods import measure as measure_by
from paceline.speed.results import Measurement, Track
from zhu2012.clips import Loaded, filtered, loaded

DOTS = 200  # particles kept for a picture at most

Run = dict[str, list[Any]]


def _rounded(values: Any, digits: int) -> Any:
    """Nested lists, with None for what is not known."""
    if np.ndim(values):
        return [_rounded(v, digits) for v in values]
    return round(float(values), digits) if np.isfinite(values) else None


def of_filter(estimates: Sequence[Estimate]) -> Run:
    return {
        "frame": [e.frame for e in estimates],
        "speed": _rounded([e.speed / MPH for e in estimates], 3),
        "depth": _rounded([e.position[2] for e in estimates], 3),
        "turn": _rounded([np.degrees(e.yaw_rate) for e in estimates], 2),
        "left": _rounded([e.left for e in estimates], 1),
        "right": _rounded([e.right for e in estimates], 1),
        "dots": _rounded([e.particles_left[:: len(e.particles_left) // DOTS + 1] for e in estimates], 1),
    }


def of_track(track: Track, refined: bool = False) -> Run:
    dots = [p[:: len(p) // DOTS + 1] if p.ndim == 2 else [] for p in track.particles_left]
    return {
        "frame": track.frame.tolist(),
        "speed": _rounded((track.refined_speed if refined else track.speed) / MPH, 3),
        "depth": _rounded(track.position[:, 2], 3),
        "left": _rounded(track.left, 1),
        "right": _rounded(track.right, 1),
        "dots": [_rounded([d for d in points if np.isfinite(d).all()], 1) for points in dots],
    }


def all_methods(
    scene: str,
    configuration: SpeedConfiguration,
    guess: float | None,
    methods: Sequence[str],
    index: int = 0,
    unconstrained: bool = False,
    operator_noise: bool = True,
) -> dict[str, Any]:
    """Every method on one vehicle of a clip: ``runs`` frame by frame, the truth beside them, and what is ``shown``.

    ``guess`` is the first guess of the speed over the true one; None leaves it to the methods or to the clip. Without
    a ``operator_noise`` outline and way are the true ones.
    """
    view = loaded(scene) if operator_noise else loaded(scene).without_noise()
    view = view if guess is None else view.with_guess(guess)
    vehicle = view.clip.vehicles[index].id
    runs = {"as printed": of_filter(filtered(view, configuration, index)[0])}
    if unconstrained:
        free = configuration.model_copy(update={"motion": "free"})
        runs["unconstrained"] = of_filter(filtered(view, free, index)[0])
    results: dict[str, Measurement] = {"refined": measured(view.clip)[index]}
    for method in methods:
        one = configuration if method == "multimodal" else SpeedConfiguration()
        results[method] = measure_by(view.clip, open_recording(view.clip), method, one).measurements[index]
    for name, m in results.items():
        runs[name] = of_track(m.track, name == "refined")
    shown = {name: errors(view, vehicle, run) for name, run in runs.items()}
    for name, m in results.items():
        shown[name] |= interval(view, vehicle, m)
    frames = [f.index for f in view.frames]
    known = [k for k in frames if any(r["frame"] == k and r["vehicle"] == vehicle for r in view.truth)]
    truth = {
        "frame": known,
        "time": [round(r["time_s"], 4) for r in view.truth if r["vehicle"] == vehicle and r["frame"] in known],
        "speed": _rounded(view.true(vehicle, known) / MPH, 3),
        "depth": _rounded(view.true(vehicle, known, "position")[:, 2], 3),
        "left": _rounded(view.true(vehicle, known, "left"), 1),
        "turn": _turns(view, vehicle, known),
    }
    return {"shown": shown, "drawn": {"runs": runs, "truth": truth}}


def _turns(view: Loaded, vehicle: str, frames: list[int]) -> list[float | None]:
    """True yaw rates, degrees per second, of the normal of the outlined plane in plan; None for the first frame."""
    corners, times = view.true(vehicle, frames, "corners"), view.true(vehicle, frames, "time_s")
    across = corners[:, 1] - corners[:, 0]
    heading = np.unwrap(np.arctan2(across[:, 2], across[:, 0]))
    return [None, *_rounded(np.degrees(-np.diff(heading) / np.diff(times)), 2)]


def errors(view: Loaded, vehicle: str, run: Run) -> dict[str, Any]:
    """Frame by frame, from the second speed on: RMS and largest error, mph; RMS of the depth's, per cent."""
    frames = np.array(run["frame"])
    visible_frames = [
        k for k in frames.tolist() if any(r["frame"] == k and r["vehicle"] == vehicle for r in view.truth)
    ]
    keep = np.isin(frames, visible_frames)
    errors_mph = np.array(run["speed"], float)[keep] - view.true(vehicle, visible_frames) / MPH
    errors_mph = errors_mph[2:][np.isfinite(errors_mph[2:])]
    true = view.true(vehicle, visible_frames, "position")[:, 2]
    depth = (np.array(run["depth"], float)[keep] - true) / true
    depth = depth[2:][np.isfinite(depth[2:])]
    none = float("nan")
    return {
        "frames": int(len(errors_mph)),
        "rms": rms(errors_mph) if len(errors_mph) else none,
        "max": float(np.abs(errors_mph).max()) if len(errors_mph) else none,
        "depth": 100 * rms(depth) if len(depth) else none,
        "last": float(run["speed"][len(visible_frames) - 1] or none) if visible_frames else none,
    }


def interval(view: Loaded, vehicle: str, m: Measurement) -> dict[str, Any]:
    """The mean speed that a method reports, mph, its error and half its interval."""
    if not np.isfinite(m.speed):
        return {"reason": m.reason}
    frames = [k for k, s in zip(m.track.frame.tolist(), m.track.status, strict=True) if s == "tracking"]
    speeds, times = view.true(vehicle, frames), view.true(vehicle, frames, "time_s")
    true = float(np.trapezoid(speeds, times) / (times[-1] - times[0]))
    half = (m.speed_hi - m.speed_lo) / 2
    return {"mean": m.speed / MPH, "error": (m.speed - true) / MPH, "half": half / MPH, "reason": m.reason}
