"""Vehicles found without clicking, and their speeds, against the exact truth of rendered clips and against clicks.

python benchmarks/vehicles.py [--count] CLIP...   (folders that `paceline simulate speed` or `simulate suite` wrote)
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import MPH, Rows, head, machine, read_truth, rms, row, true_mean

from paceline.detection.search import find_vehicles
from paceline.documents.loading import Clip, VehicleDocument, load_clip
from paceline.geometry import triangulate
from paceline.recordings.stereo import StereoRecording, open_recording
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.methods import DEFAULT_METHOD, measure

FRAMES = 8  # in which a vehicle has to be wholly visible, to count
VISIBLE = 0.97  # of its plane
SAME = 3.0, 1.0  # m, or px of disparity, between a found plane and the true one of the same vehicle


@dataclass(frozen=True)
class Speed:
    """A measured speed against the truth, mph."""

    error: float
    half: float
    verdict: str

    @property
    def is_measured(self) -> bool:
        return self.verdict == "measured"

    def __str__(self) -> str:
        return f"{self.error:+.2f} ± {self.half:.2f}" + ("" if self.is_measured else " (rejected)")


def countable(truth: Rows) -> list[str]:
    """The vehicles that are wholly visible for long enough."""
    frame_counts = Counter(row["vehicle"] for row in truth if row["inside"] and row["visible"] >= VISIBLE)
    return [name for name, frames in frame_counts.items() if frames >= FRAMES]


def who(clip: Clip, vehicle: VehicleDocument, truth: Rows) -> str | None:
    """The true vehicle whose plane is where ``vehicle`` is outlined; of several, as far as its depth is known, the one
    that stands there in the pictures."""
    place = triangulate(clip.rig, vehicle.left.mean(0), vehicle.right.mean(0))
    max_distance = max(SAME[0], SAME[1] * float(place[2]) ** 2 / float(clip.rig.left.K[0, 0] * clip.rig.baseline))
    beside = {
        row["vehicle"]: float(np.linalg.norm(np.array(row["left"]).mean(0) - vehicle.left.mean(0)))
        for row in truth
        if row["frame"] == vehicle.frame and np.linalg.norm(np.array(row["position"]) - place) < max_distance
    }
    return min(beside, key=lambda k: beside[k], default=None)


def speeds(clip: Clip, recording: StereoRecording, names: list[str], truth: Rows) -> dict[str, Speed]:
    """The speeds of the vehicles of ``clip``, which are called ``names`` in truth."""
    if not clip.vehicles:
        return {}
    measured = measure(clip, recording, DEFAULT_METHOD, SpeedConfiguration()).measurements
    return {
        name: Speed(
            (m.speed - true_mean(truth, replace(m, vehicle=name))) / MPH, (m.speed_hi - m.speed) / MPH, m.verdict
        )
        for m, name in zip(measured, names, strict=True)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Vehicles found without clicking, and their speeds.")
    parser.add_argument("clips", nargs="+", type=Path, metavar="CLIP", help="folder of a rendered clip")
    parser.add_argument("--count", action="store_true", help="find them, but do not measure")
    args = parser.parse_args()
    folders: list[Path] = args.clips
    print(head("clip", "vehicles", "once", "twice", "false", "error found, mph", "error clicked, mph", "s per frame"))
    totals: Counter[str] = Counter()
    both: list[tuple[Speed | None, Speed]] = []
    for folder in folders:
        clip, truth = load_clip(folder / "clip.yaml"), read_truth(folder)
        recording, start_time = open_recording(clip), time.process_time()
        search = find_vehicles(replace(clip, vehicles=[]), recording)
        seconds = (time.process_time() - start_time) / len(recording)
        names = [who(clip, v, truth) for v in search.clip.vehicles]
        times, expected = Counter(name for name in names if name is not None), countable(truth)
        counts = {
            "vehicles": len(expected),
            "once": sum(times[name] == 1 for name in expected),
            "twice": sum(count > 1 for count in times.values()),
            "false": names.count(None),
        }
        totals.update(counts)
        if args.count:
            print(row(folder.name, *counts.values(), "", "", f"{seconds:.2f}"), flush=True)
            continue
        real = {name: v for v, name in zip(search.clip.vehicles, names, strict=True) if name is not None}
        found = speeds(replace(clip, vehicles=list(real.values())), recording, list(real), truth)
        clicked = speeds(clip, recording, [v.id for v in clip.vehicles], truth)
        both += [(found.get(name), clicked[name]) for name in clicked]
        cells = [", ".join(str(s[name]) for name in expected if name in s) for s in (found, clicked)]
        print(row(folder.name, *counts.values(), *cells, f"{seconds:.2f}"), flush=True)
    print(f"\n{totals['once']} of {totals['vehicles']} found once, {totals['twice']} twice, {totals['false']} false.")
    if args.count:
        print(f"\n{machine()}")
        return
    fair = [(a, b) for a, b in both if a and a.is_measured and b.is_measured]
    for what, chosen in (("found", [a for a, _ in fair]), ("clicked", [b for _, b in fair])):
        inside = sum(abs(s.error) <= s.half for s in chosen)
        errors = [s.error for s in chosen]
        print(f"{what}: {rms(errors):.2f} mph rms, {inside} of {len(chosen)} within their 95 % intervals")
    measured = [sum(s is not None and s.is_measured for s in side) for side in zip(*both, strict=True)]
    print(f"measured: {measured[0]} of {len(both)} as found, {measured[1]} as clicked")
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
