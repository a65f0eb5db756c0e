"""Ours and the methods that it is compared with, on the same clips in one run.

python benchmarks/baselines.py [--n 24] [--seed 1000] [--suite plain|hard|crossing] [--methods NAME …] [--workers 1]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import common
import cv2
import numpy as np
from common import MPH, Rows, head, rms, row
from numpy.typing import NDArray
from recordings import CROSSING

import paceline.baselines.registry  # noqa: F401  makes the baselines known
from paceline import UnusableInput, load_clip, open_recording
from paceline.documents.loading import Clip
from paceline.simulation.random_scenes.drawn import random_crossing, random_scene
from paceline.simulation.stereo.clip import Scene
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.methods import DEFAULT_METHOD, measure
from paceline.speed.results import ClipResult, Measurement

Array = NDArray[np.float64]

SUITES = {"plain": common.plain_scene, "hard": random_scene, "crossing": random_crossing}
OURS = {"ours, filter alone": False, "ours, refined": True}
ORDER = ["sift", "kalman", "kalman-scatter", "multimodal", "lucas-kanade", *OURS]


@dataclass(frozen=True, eq=False)
class Outcome:
    """One clip by one method, mph: the mean speed's error and half its interval, those of the speeds frame by frame as
    they came and as they were smoothed at the end, and processor seconds per frame."""

    method: str
    error: float = float("nan")
    half: float = float("nan")
    frames: Array = field(default_factory=lambda: np.empty(0))
    smoothed: Array = field(default_factory=lambda: np.empty(0))
    seconds: float = float("nan")
    reason: str = ""  # why it was rejected


def found_by(method: str, clip: Clip) -> tuple[ClipResult, float]:
    """The result and the processor seconds per frame."""
    recording, start_time = open_recording(clip), time.process_time()
    configuration = SpeedConfiguration(refine=OURS.get(method, True))
    result = measure(clip, recording, DEFAULT_METHOD if method in OURS else method, configuration)
    frames = max(len(m.track.frame) for m in result.measurements)
    return result, (time.process_time() - start_time) / max(1, frames)


def compared(method: str, m: Measurement, truth: Rows, seconds: float) -> Outcome:
    if not np.isfinite(m.speed):
        return Outcome(method, seconds=seconds, reason=m.reason)
    tracked = np.array([s == "tracking" for s in m.track.status])
    tracked[0] = False  # nothing is known of the speed yet
    speeds = common.true_speeds(truth, m)[tracked]
    errors = [(s[tracked] - speeds) / MPH for s in (m.track.speed, m.track.refined_speed)]
    error, half = m.speed - common.true_mean(truth, m), (m.speed_hi - m.speed_lo) / 2
    return Outcome(method, error / MPH, half / MPH, *(o[np.isfinite(o)] for o in errors), seconds, m.reason)


def by_each(scene: Scene, methods: Sequence[str]) -> list[Outcome]:
    """The clip of ``scene``, rendered once, by every method."""
    with common.rendered(scene) as (clip, truth):
        return compare_methods(clip, truth, methods)


def compare_methods(clip: Clip, truth: Rows, methods: Sequence[str]) -> list[Outcome]:
    """One vehicle's ``clip`` by every method."""
    cv2.setNumThreads(1)
    outcomes = []
    for method in methods:
        try:
            result, seconds = found_by(method, clip)
        except UnusableInput as unusable:
            outcomes.append(Outcome(method, reason=f"unusable: {unusable}"))
            continue
        outcomes.append(compared(method, result.measurements[0], truth, seconds))
    return outcomes


def measured(outcomes: Sequence[Outcome]) -> tuple[str, Array, Array]:
    """How many were measured, for a row of a table, and errors and half-widths (n,) of these, mph."""
    good = [o for o in outcomes if not o.reason]
    error, half = (np.array([getattr(o, name) for o in good]) for name in ("error", "half"))
    return f"{len(good)} of {len(outcomes)}", error, half


def outcome_cell(o: Outcome, more: str = "") -> str:
    """An outcome in the table of all clips, with ``more`` behind its numbers."""
    if not np.isfinite(o.error):
        return f"rejected: {o.reason}"
    return f"{o.error:+.3f} ± {o.half:.2f}{more}" + (f" (rejected: {o.reason})" if o.reason else "")


def run(seed: int, suite: str, methods: list[str]) -> list[Outcome]:
    return by_each(SUITES[suite](seed), methods)


def summary_row(method: str, all_of_it: list[Outcome]) -> str:
    known = [o for o in all_of_it if np.isfinite(o.error)]
    if not known:
        return row(method, f"0 of {len(all_of_it)}", *("–" for _ in range(7)))
    error, half = (np.array([getattr(o, name) for o in known]) for name in ("error", "half"))
    frames = np.concatenate([o.frames for o in known])
    smoothed = np.concatenate([o.smoothed for o in known])
    return row(
        method,
        f"{sum(not o.reason for o in all_of_it)} of {len(all_of_it)}",
        f"{rms(error):.3f}",
        f"{np.abs(error).max():.3f}",
        f"{error.mean():+.3f}",
        f"{np.mean(np.abs(error) <= half):.0%}",
        _rms_and_worst(frames),
        _rms_and_worst(smoothed),
        f"{1e3 * np.median([o.seconds for o in known]):.0f}",
    )


def _rms_and_worst(errors: Array) -> str:
    return f"{rms(errors):.2f}, {np.abs(errors).max():.1f}" if len(errors) else "–"


def recorded(folder: Path, methods: list[str]) -> None:
    """One table of the recordings beside the project."""
    print(head("recording", "vehicle", "reference, mph", *methods))
    absent = []
    for name in ("rendered/straight", "rendered/curve", "kitti_crossing"):
        if not (folder / name / "clip.yaml").exists():
            absent.append(name)
            continue
        clip = load_clip(folder / name / "clip.yaml")
        results = [found_by(method, clip)[0] for method in methods]
        for i, vehicle in enumerate(clip.vehicles):
            found = [r.measurements[i] for r in results]
            if name == "kitti_crossing":
                reference, errors = CROSSING[vehicle.id], [m.speed - CROSSING[vehicle.id] for m in found]
            else:
                truth = common.read_truth(folder / name)
                reference = common.true_mean(truth, found[-1])
                errors = [m.speed - common.true_mean(truth, m) if np.isfinite(m.speed) else m.speed for m in found]
            cells = [_cell(m, e) for m, e in zip(found, errors, strict=True)]
            print(row(name, vehicle.id, f"{reference / MPH:.2f}", *cells), flush=True)
    for name in absent:
        print(f"\n{folder / name} is absent: skipped.")


def _cell(m: Measurement, error: float) -> str:
    if not np.isfinite(error):
        return f"rejected: {m.reason}"
    half = (m.speed_hi - m.speed_lo) / 2
    return f"{error / MPH:+.2f} ± {half / MPH:.2f}" + (" (rejected)" if m.reason else "")


def main() -> None:
    parser = argparse.ArgumentParser(description="Ours and the baselines on the same clips.")
    parser.add_argument("--suite", choices=SUITES, default="plain")
    parser.add_argument("--n", type=int, default=24, help="number of clips")
    parser.add_argument("--seed", type=int, default=1000, help="seed of the first clip")
    parser.add_argument("--methods", nargs="+", choices=ORDER, default=ORDER, metavar="NAME")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--data", type=Path, default=common.SHARED, help="folder of recordings")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    work = partial(run, suite=args.suite, methods=args.methods)
    outcomes: list[Outcome] = []
    print(head("seed", *args.methods), flush=True)
    for seed, found in enumerate(common.share_out(work, range(args.seed, args.seed + args.n), args.workers), args.seed):
        outcomes += found
        print(
            row(seed, *(f"{o.error:+.3f} ± {o.half:.2f}" + " (rejected)" * bool(o.reason) for o in found)), flush=True
        )
    print(f"\nSuite {args.suite}, seeds {args.seed} to {args.seed + args.n - 1}, mph:\n")
    frame_by_frame = ("frame by frame: RMS, worst", "smoothed: RMS, worst")
    print(head("method", "measured", "mean speed: RMS", "worst", "bias", "covered", *frame_by_frame, "ms/frame"))
    for method in args.methods:
        print(summary_row(method, [o for o in outcomes if o.method == method]))
    print()
    recorded(args.data, args.methods)
    print(f"\n{common.machine()}")


if __name__ == "__main__":
    main()
