"""Vehicles that drive close together, found without clicking: platoons, motorcycles beside cars, cars behind lorries.

python benchmarks/traffic.py [--n 4] [--seed 1] [--kinds platoon …] [--workers 1] [--clips FOLDER]

Ray-traced scenes at 5 frames/s, seen from a mast beside the road until all have passed. Counted are the vehicles of
which 97 % of the front or rear is visible in at least 8 frames: found once or twice, listed as not measured, or missed;
and detections of which is said that they may be of two.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from common import Rows, head, machine, raytraced, rms, row, share_out
from vehicles import SAME, Speed, countable, speeds, who

from paceline.detection.finder import DetectedVehicle
from paceline.detection.search import find_vehicles
from paceline.documents.loading import Clip
from paceline.recordings.stereo import open_recording
from paceline.simulation.raytraced.scene_yaml import SpeedScene

KINDS = ("platoon", "abreast", "hidden", "opposing")
HEADWAY_S = 0.5, 3.0  # from the front of one vehicle to that of the next, in time
MIN_HEADWAY_M = {"saloon": 7.0, "estate": 7.0, "van": 8.0, "lorry": 12.0, "bus": 15.0, "motorcycle": 5.0}
CARS, SLOW = ("saloon", "estate", "van"), ("lorry", "bus")
SPEED_MPS = 9.0, 20.0
NEAR_M, FAR_M = 22.0, 85.0  # from the mast along the road, between which vehicles are looked for
EYE_M = 30.0  # arc length of the mast
RATE_HZ, MAX_FRAMES, SAMPLES = 5.0, 60, 8
COUNTED = "vehicles", "once", "twice", "not measured", "missed", "false", "may be two"


@dataclass(frozen=True, eq=False)
class Found:
    """What came of a scene: how many vehicles of each of COUNTED, and the speeds of those found once."""

    kind: str
    seed: int
    counts: Counter[str]
    speeds: dict[str, Speed]
    names: tuple[str, ...]  # of the vehicles that were missed


def platoon(
    rng: np.random.Generator, kinds: Sequence[str], lane: int, first_m: float, speed: float
) -> list[dict[str, Any]]:
    """Vehicles of ``kinds`` one behind the other in lane 0, which comes nearer, or 1, at about one ``speed`` (m/s);
    the first one has ``first_m`` still to drive to where it is first looked for."""
    vehicles, behind = [], first_m
    for k, kind in enumerate(kinds):
        if k:
            behind += max(speed * rng.uniform(*HEADWAY_S), MIN_HEADWAY_M[kinds[k - 1]])
        vehicles.append(
            {
                "kind": kind,
                "seed": int(rng.integers(2**31)),
                "lane": lane,
                "oncoming": lane == 0,
                "offset": float(rng.normal(0, 0.2)),
                "start": EYE_M + (FAR_M + behind if lane == 0 else NEAR_M - behind),
                "speed": speed,
            }
        )
    return vehicles


def scene(seed: int, kind: str) -> SpeedScene:
    """A scene of one of KINDS."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 83])
    speed, lane = float(rng.uniform(*SPEED_MPS)), int(rng.random() < 0.35)
    if kind == "hidden":
        vehicles = platoon(rng, [str(rng.choice(SLOW)), str(rng.choice(CARS))], lane, 0.0, speed)
    elif kind == "opposing":
        vehicles = [v for k in (0, 1) for v in platoon(rng, [str(c) for c in rng.choice(CARS, 2)], k, 0.0, speed)]
    else:
        vehicles = platoon(rng, [str(c) for c in rng.choice(CARS, 1 if kind == "abreast" else 3)], lane, 0.0, speed)
    if kind == "abreast":  # a motorcycle passes between the car and the line
        side, beside = float(rng.choice([-1, 1])), vehicles[0]
        vehicles[0] = beside | {"offset": -0.5 * side}
        along = float(rng.uniform(-2.0, 2.0))
        vehicles.append(beside | {"kind": "motorcycle", "offset": 1.35 * side, "start": beside["start"] + along})
    lanes = [v["lane"] for v in vehicles]
    length = float(np.ptp([v["start"] for v in vehicles if v["lane"] == vehicles[0]["lane"]]))
    height, target = float(rng.uniform(4.0, 7.0)), 50.0
    return SpeedScene.model_validate(
        {
            "kind": "speed",
            "seed": seed,
            "frames": min(MAX_FRAMES, round(RATE_HZ * (FAR_M - NEAR_M + length) / speed)),
            "rate": RATE_HZ,
            "samples": SAMPLES,
            "road": {"kind": "straight", "length": 200.0, "wear": float(rng.uniform(0, 0.6))},
            "light": {"azimuth": float(rng.uniform(-np.pi, np.pi)), "elevation": float(rng.uniform(0.35, 1.1))},
            "scenery": {"trees": 0.0, "poles": 0.0, "buildings": 0.3},
            "vehicles": [  # the first one of each lane is measured, so that the clip has a path there
                v | {"id": f"t{k}", "measured": lanes.index(v["lane"]) == k} for k, v in enumerate(vehicles)
            ],
            "rig": {
                "image_size": [1024, 768],
                "focal": 1500.0,
                "baseline": 0.6,
                "eye": {"along": EYE_M, "right": float(rng.choice([-1, 1]) * rng.uniform(5.5, 8.0)), "height": height},
                "target": {"along": EYE_M + target, "right": 0.0, "height": 0.0},
            },
        }
    )


def listed(clip: Clip, detected: DetectedVehicle, truth: Rows) -> str | None:
    """The true vehicle nearest to one that was detected and cannot be measured."""
    near = {
        r["vehicle"]: float(np.linalg.norm(np.array(r["position"]) - detected.position))
        for r in truth
        if abs(r["time_s"] - detected.times[0]) < 0.5 / RATE_HZ
    }
    name = min(near, key=lambda k: near[k], default=None)
    depth = float(detected.position[2])
    limit = max(2 * SAME[0], 2 * SAME[1] * depth**2 / float(clip.rig.left.K[0, 0] * clip.rig.baseline))
    return name if name is not None and near[name] < limit else None


def run(case: tuple[str, int], clips: Path | None) -> Found:
    kind, seed = case
    with raytraced(scene(seed, kind), clips / f"{kind}_{seed}" if clips else None) as (clip, truth):
        recording = open_recording(clip)
        search = find_vehicles(replace(clip, vehicles=[]), recording)
        names = [who(clip, v, truth) for v in search.clip.vehicles]
        times, expected = Counter(name for name in names if name is not None), countable(truth)
        unmeasured = {listed(clip, d, truth) for d in search.detected if d.vehicle is None}
        missed = tuple(name for name in expected if not times[name] and name not in unmeasured)
        counts = Counter(
            {
                "vehicles": len(expected),
                "once": sum(times[name] == 1 for name in expected),
                "twice": sum(count > 1 for count in times.values()),
                "not measured": sum(not times[name] and name in unmeasured for name in expected),
                "missed": len(missed),
                "false": names.count(None),
                "may be two": sum(n.code == "vehicles_not_told_apart" for d in search.detected for n in d.notices),
            }
        )
        once = {name: v for v, name in zip(search.clip.vehicles, names, strict=True) if name and times[name] == 1}
        found = replace(search.clip, vehicles=list(once.values()))
        return Found(kind, seed, counts, speeds(found, recording, list(once), truth), missed)


def main() -> None:
    parser = argparse.ArgumentParser(description="Vehicles that drive close together, found without clicking.")
    parser.add_argument("--n", type=int, default=4, help="scenes of each kind")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first scene")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--clips", type=Path, help="folder where clips are kept; those there are not rendered again")
    args = parser.parse_args()
    cases = list(product(args.kinds, range(args.seed, args.seed + args.n)))
    print(head("kind", "seed", *COUNTED, "missed are", "speeds, mph"), flush=True)
    results: list[Found] = []
    for found in share_out(partial(run, clips=args.clips), cases, args.workers):
        results.append(found)
        cells = [found.counts[name] for name in COUNTED]
        measured = ", ".join(str(s) for s in found.speeds.values())
        print(row(found.kind, found.seed, *cells, ", ".join(found.names), measured), flush=True)
    print("\n" + head("kind", *COUNTED, "measured", "RMS, mph", "within 95 %"))
    for kind in (*args.kinds, "all"):
        group = [f for f in results if kind in (f.kind, "all")]
        counts = sum((f.counts for f in group), Counter())
        good = [s for f in group for s in f.speeds.values() if s.is_measured]
        inside = f"{sum(abs(s.error) <= s.half for s in good)} of {len(good)}"
        error = f"{rms([s.error for s in good]):.2f}" if good else "–"
        print(row(kind, *(counts[name] for name in COUNTED), len(good), error, inside))
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
