"""What each remedy for [NIST]'s stated failures is worth: each one off, in the scenes that it is for.

python benchmarks/follow_ablation.py [--n 4] [--seed 900] [--frames 300] [--workers 2] [--scenario NAME ...] [--starts]

A row is one scenario and one configuration; "off" frames are those that were not tracked, or tracked wrongly, out of
those in which the vehicle can be seen. --starts instead begins beside the target, or with another size: a row is one
error of the start, and a frame is wrong that is called tracking with the centre off by more than a tenth of the
vehicle's width or the scale by more than a tenth.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from common import head, machine, rms, row, share_out
from follow import PUBLISHED, SEEN, Makers, Paceline, Record, operators_start, run

from paceline.follow.configuration import FollowConfiguration
from paceline.follow.hindsight import at_once, in_hindsight
from paceline.follow.results import FollowEstimate
from paceline.follow.tracker import FollowTracker
from paceline.recordings.monocular import CameraFrame
from paceline.simulation.chase.clip import ChaseScene, ChaseTruth, Occlusion, render_frames
from paceline.simulation.random_scenes.drawn import random_chase
from paceline.simulation.vehicle_catalogue import RASTERIZED_KINDS

CALM: dict[str, Any] = {"shadows": 0.0, "parallel_share": 0.0, "shake_px": 2.0, "object_density": 0.5, "ambient": 0.6}
SCENARIOS: dict[str, Callable[[int], dict[str, Any]]] = {
    "plain": lambda seed: CALM,
    "strong shadows": lambda seed: CALM | {"shadows": 1.6, "ambient": 0.28, "sun_azimuth": 2.7 if seed % 2 else -2.7},
    "parallel edges": lambda seed: CALM | {"parallel_share": 1.0, "object_density": 1.6},
    "camera shake": lambda seed: CALM | {"shake_px": 5.0},
    "occlusion": lambda seed: CALM | {"occlusions": _crossings(seed)},
    "turned by 10°": lambda seed: CALM | {"yaw": np.radians(10.0 if seed % 2 else -10.0)},
    "everything": lambda seed: {"shadows": 1.3, "parallel_share": 0.7, "shake_px": 4.0, "occlusions": _crossings(seed)},
}

OFF = {  # of the start: x and y in sizes of the target, and the factor of its scale
    "none": (0.0, 0.0, 1.0),
    "right 0.05": (0.05, 0.0, 1.0),
    "down 0.1": (0.0, 0.1, 1.0),
    "left 0.1": (-0.1, 0.0, 1.0),
    "scale 0.9": (0.0, 0.0, 0.9),
    "scale 1.1": (0.0, 0.0, 1.1),
    "right 0.25": (0.25, 0.0, 1.0),
    "left 0.25": (-0.25, 0.0, 1.0),
    "down 0.25": (0.0, 0.25, 1.0),
    "up 0.25": (0.0, -0.25, 1.0),
    "up and right 0.3": (0.3, -0.3, 1.0),
    "scale 0.7": (0.0, 0.0, 0.7),
    "scale 0.85": (0.0, 0.0, 0.85),
    "scale 1.15": (0.0, 0.0, 1.15),
    "scale 1.4": (0.0, 0.0, 1.4),
    "right 0.2, down 0.15, scale 0.8": (0.2, 0.15, 0.8),
    "left 0.2, down 0.1, scale 1.3": (-0.2, 0.1, 1.3),
}
WRONG = 0.1  # of the vehicle's width, and of the scale


def _crossings(seed: int) -> tuple[Occlusion, ...]:
    kinds = ("vehicle", "post") if seed % 2 else ("post", "vehicle")
    return Occlusion(6.0, 0.9, kinds[0]), Occlusion(13.0, 0.9, kinds[1])


def remedies() -> list[str]:
    """The switches of the configuration."""
    return [name for name, field in FollowConfiguration.model_fields.items() if field.annotation is bool]


def configurations() -> Makers:
    """All remedies, all but one, none."""
    made = {"all remedies": FollowConfiguration()}
    made |= {f"without {name}": FollowConfiguration(**{name: False}) for name in remedies()}
    neither = ("wide_search", "predicted_gates")  # the gates are for those who do without the search
    made[f"without {' and '.join(neither)}"] = FollowConfiguration(**dict.fromkeys(neither, False))
    made[PUBLISHED] = FollowConfiguration.as_published()
    return {name: partial(Paceline, configuration=c) for name, c in made.items()}


def _run(item: tuple[str, int], frames: int) -> tuple[str, list[Record]]:
    scenario, seed = item
    scene: ChaseScene = random_chase(seed, frames=frames, **SCENARIOS[scenario](seed))
    return scenario, run(scene, configurations())


# --- the operator's start --------------------------------------------------------------------------------------------


def _begin(scene: ChaseScene, first: ChaseTruth, off: tuple[float, float, float], probation: bool) -> FollowTracker:
    target, (*middle, scale) = operators_start(scene, first)
    size = scale * target.size * target.magnification(scene.camera)
    center = np.clip(middle + size * np.array(off[:2]), 0.0, np.array(scene.image_size) - 1.0)
    return FollowTracker(scene.camera, target, (*center, scale * off[2]), FollowConfiguration(probation=probation))


def _verdict(e: FollowEstimate, truth: ChaseTruth, nominal_range: float) -> str:
    if e.status != "tracking":
        return "none"
    width = np.ptp(truth.corners[:, 0])
    away = np.abs(e.center - truth.center).max() / width
    grown = abs(e.scale * truth.position[2] / nominal_range - 1.0)
    return "wrong" if max(away, grown) > WRONG else "right"


STARTED = {  # whether there is a probation, and when it is told what came of it
    "all remedies, live": (True, at_once),
    "all remedies, a recording": (True, in_hindsight),
    "without probation": (False, at_once),
}


def _run_starts(seed: int, frames: int) -> dict[tuple[str, str], Counter[str]]:
    """Verdicts by the start's error and how it is followed, over the frames of one clip."""
    scene = random_chase(seed, frames=frames, kind=RASTERIZED_KINDS[seed % len(RASTERIZED_KINDS)])
    pictures, truths = zip(*render_frames(scene), strict=True)
    taken = [(CameraFrame(t.frame, t.time, picture), None) for picture, t in zip(pictures, truths, strict=True)]
    counts = {(name, how): Counter[str]() for name in OFF for how in STARTED}
    for (name, how), count in counts.items():
        probation, told = STARTED[how]
        tracker = _begin(scene, truths[0], OFF[name], probation)
        for (_, estimate), truth in zip(told(tracker, taken), truths, strict=True):
            if truth.visible >= SEEN:
                count[_verdict(estimate, truth, tracker.target.nominal_range)] += 1
    return counts


def compare_starts(args: argparse.Namespace) -> None:
    total: dict[tuple[str, str], Counter[str]] = {}
    for counts in share_out(
        partial(_run_starts, frames=args.frames), range(args.seed, args.seed + args.n), args.workers
    ):
        for key, count in counts.items():
            total.setdefault(key, Counter()).update(count)
    print(head("start off by", "configuration", "right, %", "wrong, %", "not tracking, %"))
    for (name, how), count in total.items():
        shares = (f"{100 * count[v] / count.total():.2f}" for v in ("right", "wrong", "none"))
        print(row(name, how, *shares))


# --- the remedies ----------------------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description="Remedies on and off, per scenario.")
    parser.add_argument("--n", type=int, default=4, help="clips per scenario")
    parser.add_argument("--seed", type=int, default=900, help="seed of the first clip")
    parser.add_argument("--frames", type=int, default=300, help="frames of each clip")
    parser.add_argument("--scenario", nargs="+", choices=list(SCENARIOS), default=list(SCENARIOS), metavar="NAME")
    parser.add_argument("--starts", action="store_true", help="errors of the operator's start instead")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    compare_starts(args) if args.starts else compare_remedies(args)
    print("\n" + machine())


def compare_remedies(args: argparse.Namespace) -> None:
    items = [(name, seed) for name in args.scenario for seed in range(args.seed, args.seed + args.n)]
    columns = ("lost, %", "wrong, %", "whole clips", "range RMS, %", "worst, %", "lateral RMS, m")
    print(head("scenario", "configuration", *columns), flush=True)
    gathered: dict[str, list[Record]] = {}
    for scenario, records in share_out(partial(_run, frames=args.frames), items, args.workers):
        gathered.setdefault(scenario, []).extend(records)
        if len({r.scene.seed for r in gathered[scenario]}) == args.n:
            for name in configurations():
                _print(scenario, name, [r for r in gathered[scenario] if r.follower == name])


def _print(scenario: str, name: str, records: list[Record]) -> None:
    frames = sum(r.frames for r in records)
    lost, wrong = (100 * sum(getattr(r, n) for r in records) / frames for n in ("lost", "wrong"))
    whole = f"{sum(r.lost + r.wrong == 0 for r in records)} of {len(records)}"
    errors, lateral = (np.concatenate([getattr(r, n) for r in records]) for n in ("range_errors", "lateral_errors"))
    numbers = ("–", "–", "–")
    if len(errors):
        numbers = f"{100 * rms(errors):.2f}", f"{100 * np.abs(errors).max():.1f}", f"{rms(lateral):.3f}"
    print(row(scenario, name, f"{lost:.1f}", f"{wrong:.1f}", whole, *numbers), flush=True)


if __name__ == "__main__":
    main()
