"""Braking, gathering speed and changing lanes: mean speeds and speeds frame by frame, beside Lucas–Kanade points.

python benchmarks/manoeuvres.py [--n 4] [--seed 7000] [--workers 1]
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from baselines import Outcome, by_each, measured, outcome_cell
from common import PLAIN_RIG, head, machine, rms, row, share_out
from numpy.typing import NDArray

from paceline.simulation.lane_change import LaneChange
from paceline.simulation.random_scenes.drawn import random_scene
from paceline.simulation.stereo.clip import Scene
from paceline.simulation.stereo.scene import Motion, PlacedRoad

Array = NDArray[np.float64]

METHODS = ("lucas-kanade", "ours, refined")
KINDS = (
    "brakes",
    "gathers speed",
    "begins to brake",
    "begins to gather speed",
    "changes lane",
    "changes lane and brakes",
)
ANY = "does any of these"
TRIES = 500
CHANGE = 3.0  # m/s²


def scene_of(kind: str, seed: int) -> Scene:
    """A clip of a vehicle that drives at least 25 m within 15–80 m in at least 10 frames, and does what ``kind`` says.

    Its speed changes throughout the clip or begins to within its middle third; a change of lane takes 3 to 5 s, of
    which the clip shows a part.
    """
    for k in range(TRIES):
        rng = np.random.default_rng([seed, k, 23])
        speed, lasting = rng.uniform(12.0, 27.0), rng.uniform(3.0, 5.0)
        vehicle: dict[str, Any] = {"speed": speed, "acceleration": 0.0, "glare": False, "relief": 0.03 * (seed % 2)}
        if "lane" in kind:
            length, shift = speed * lasting, rng.choice([-1.0, 1.0]) * rng.uniform(3.0, 3.7)
            vehicle["lane_change"] = LaneChange(rng.uniform(-0.3, 0.1) * length, length, float(shift))
        if "brake" in kind or "gather" in kind:
            vehicle["acceleration"] = CHANGE if "gather" in kind else -CHANGE
        if "begins" in kind:
            vehicle["acceleration_start"] = rng.uniform(0.5, 2.0)
        try:
            scene = random_scene(TRIES * seed + k, vehicle=vehicle, occluder=False, **PLAIN_RIG)
        except ValueError:  # nowhere could this motion be seen well
            continue
        if _suits(scene):
            return scene
    raise ValueError(f"no scene of seed {seed} in which a vehicle {kind}")


def _suits(scene: Scene) -> bool:
    duration = (scene.frames - 1) / scene.rate
    vehicle = scene.vehicles[0]
    distance = float(Motion(PlacedRoad(scene), vehicle, duration).travelled(np.array(duration)))
    ends = vehicle.start_distance, vehicle.start_distance + (distance if vehicle.receding else -distance)
    when = 3 * vehicle.acceleration_start / duration
    return (
        scene.frames >= 10 and distance >= 25 and min(ends) >= 15 and max(ends) <= 80 and (not when or 1 <= when <= 2)
    )


def run(item: tuple[str, int]) -> list[Outcome]:
    """The clip of a kind and a seed by every method."""
    return by_each(scene_of(*item), METHODS)


def main() -> None:
    parser = argparse.ArgumentParser(description="Speeds of vehicles that brake, gather speed or change lane.")
    parser.add_argument("--n", type=int, default=4, help="clips of each kind")
    parser.add_argument("--seed", type=int, default=7000, help="seed of the first clip")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    args = parser.parse_args()
    items = [(kind, seed) for kind in KINDS for seed in range(args.seed, args.seed + args.n)]
    outcomes: list[tuple[str, Outcome]] = []
    print(head("a vehicle that", "seed", *METHODS), flush=True)
    for (kind, seed), found in zip(items, share_out(run, items, args.workers), strict=True):
        outcomes += [(kind, o) for o in found]
        print(row(kind, seed, *(_cell(o) for o in found)), flush=True)
    print(f"\nSeeds {args.seed} to {args.seed + args.n - 1}, mph:\n")
    columns = (
        "measured",
        "mean speed: RMS",
        "worst",
        "covered",
        "frame by frame: RMS",
        "worst",
        "fitted: RMS",
        "worst",
    )
    print(head("a vehicle that", "method", *columns))
    for kind in (*KINDS, ANY):
        for method in METHODS:
            group = [o for k, o in outcomes if o.method == method and kind in (k, ANY)]
            print(row(kind, method, *_summary(group)))
    print(f"\n{machine()}")


def _summary(outcomes: list[Outcome]) -> list[str]:
    """Errors of what was measured."""
    count, error, half = measured(outcomes)
    if not len(error):
        return [count, *"–––––––"]
    good = [o for o in outcomes if not o.reason]
    cells = [count, *_rms_and_worst([error]), f"{np.mean(np.abs(error) <= half):.0%}"]
    return [*cells, *_rms_and_worst([o.frames for o in good]), *_rms_and_worst([o.smoothed for o in good])]


def _rms_and_worst(errors: list[Array]) -> tuple[str, str]:
    all_errors = np.concatenate(errors)
    return f"{rms(all_errors):.3f}", f"{np.abs(all_errors).max():.2f}"


def _cell(o: Outcome) -> str:
    return outcome_cell(o, f", frames up to {np.abs(o.smoothed).max():.2f}" if len(o.smoothed) else "")


if __name__ == "__main__":
    main()
