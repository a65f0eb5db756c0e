"""What each remedy for [NIST]'s stated failures is worth: each one off, in the scenes that it is for.

python benchmarks/follow_ablation.py [--n 4] [--seed 900] [--frames 300] [--workers 2] [--scenario NAME ...]

A row is one scenario and one configuration; "off" frames are those that were not tracked, or tracked wrongly, out of
those in which the vehicle can be seen.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from common import head, machine, rms, row, share_out
from follow import PUBLISHED, Makers, Paceline, Record, run

from paceline.follow.configuration import FollowConfiguration
from paceline.simulation.following import ChaseScene, Occlusion, random_chase

CALM: dict[str, Any] = {"shadows": 0.0, "parallel": 0.0, "bounce": 2.0, "crowding": 0.5, "ambient": 0.6}
SCENARIOS: dict[str, Callable[[int], dict[str, Any]]] = {
    "plain": lambda seed: CALM,
    "strong shadows": lambda seed: CALM | {"shadows": 1.6, "ambient": 0.28, "sun_azimuth": 2.7 if seed % 2 else -2.7},
    "parallel edges": lambda seed: CALM | {"parallel": 1.0, "crowding": 1.6},
    "bounce": lambda seed: CALM | {"bounce": 5.0},
    "occlusion": lambda seed: CALM | {"occlusions": _crossings(seed)},
    "turned by 10°": lambda seed: CALM | {"yaw": np.radians(10.0 if seed % 2 else -10.0)},
    "everything": lambda seed: {"shadows": 1.3, "parallel": 0.7, "bounce": 4.0, "occlusions": _crossings(seed)},
}


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
    made[PUBLISHED] = FollowConfiguration.as_published()
    return {name: partial(Paceline, configuration=c) for name, c in made.items()}


def _run(item: tuple[str, int], frames: int) -> tuple[str, list[Record]]:
    scenario, seed = item
    scene: ChaseScene = random_chase(seed, frames=frames, **SCENARIOS[scenario](seed))
    return scenario, run(scene, configurations())


def main() -> None:
    parser = argparse.ArgumentParser(description="Remedies on and off, per scenario.")
    parser.add_argument("--n", type=int, default=4, help="clips per scenario")
    parser.add_argument("--seed", type=int, default=900, help="seed of the first clip")
    parser.add_argument("--frames", type=int, default=300, help="frames of each clip")
    parser.add_argument("--scenario", nargs="+", choices=list(SCENARIOS), default=list(SCENARIOS), metavar="NAME")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    items = [(name, seed) for name in args.scenario for seed in range(args.seed, args.seed + args.n)]
    columns = ("lost, %", "wrong, %", "whole clips", "range RMS, %", "worst, %", "lateral RMS, m")
    print(head("scenario", "configuration", *columns), flush=True)
    gathered: dict[str, list[Record]] = {}
    for scenario, records in share_out(partial(_run, frames=args.frames), items, args.workers):
        gathered.setdefault(scenario, []).extend(records)
        if len({r.scene.seed for r in gathered[scenario]}) == args.n:
            for name in configurations():
                _print(scenario, name, [r for r in gathered[scenario] if r.follower == name])
    print("\n" + machine())


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
