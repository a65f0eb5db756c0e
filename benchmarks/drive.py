"""The closed loop over scenes and seeds: does what must hold hold, and how near to the lead's path does it drive?

python benchmarks/drive.py [--scene NAME ...] [--n 3] [--seed 100] [--latency 0.128] [--without REMEDY ...] [--each]

A row is one scene over --n seeds, each with vehicles, light and a way of its own; --each prints every drive as well.
The scenes `long` and `motorway-100` take minutes a drive and are left out unless they are named.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from common import head, machine, row, share_out
from follow_ablation import remedies

from paceline.follow.configuration import FollowConfiguration
from paceline.simulation.closed_loop.drive_yaml import resolve_drive
from paceline.simulation.closed_loop.loop import LATENCY_S, ClosedLoop
from paceline.simulation.closed_loop.named_scenes import NAMED_SCENES
from paceline.simulation.closed_loop.requirements import DriveStatistics, Requirement, check_requirements

SLOW = ("long", "motorway-100")


@dataclass(frozen=True)
class Drive:
    scene: str
    seed: int
    kind: str
    figures: DriveStatistics
    requirements: list[Requirement]
    milliseconds: float  # of the tracker, median

    @property
    def failed(self) -> list[str]:
        return [r.what for r in self.requirements if not r.holds]


def run(item: tuple[str, int], latency: float, without: Sequence[str] = ()) -> Drive:
    scene, seed = item
    configuration = FollowConfiguration.model_validate(dict.fromkeys(without, False))
    loop = ClosedLoop(resolve_drive(scene, seed), seed, latency, configuration=configuration)
    figures, taken = DriveStatistics(), []
    for step in loop.steps():
        figures.add(step, loop.scene.world.body.width)
        taken.append(step.estimate.latency)
    rows = check_requirements(loop.model, figures)
    figures.release_step()
    return Drive(scene, seed, loop.scene.chase_scene.kind, figures, rows, 1e3 * float(np.median(taken)))


COLUMNS = (
    "all holds",
    "frames",
    "lost",
    "wrong frames",
    "path RMS, m",
    "worst, m",
    "least distance, m",
    "gap error RMS, m",
    "range RMS, %",
    "ms, median",
)


def cells(drives: list[Drive]) -> tuple[str, ...]:
    """The columns of a table for some drives together."""
    f = [d.figures for d in drives]
    return (
        f"{sum(not d.failed for d in drives)} of {len(drives)}",
        str(sum(x.frames for x in f)),
        str(sum(x.losses for x in f)),
        str(sum(x.wrong_frames for x in f)),
        f"{np.sqrt(np.mean([x.path_rms**2 for x in f])):.3f}",
        f"{max(x.path_max for x in f):.2f}",
        f"{min(x.clearance for x in f):.2f}",
        f"{np.sqrt(np.mean([x.gap_rms**2 for x in f])):.2f}",
        f"{100 * np.sqrt(np.mean([x.range_rms**2 for x in f])):.2f}",
        f"{np.median([d.milliseconds for d in drives]):.2f}",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Closed loops over scenes and seeds.")
    quick = [name for name in NAMED_SCENES if name not in SLOW]
    parser.add_argument("--scene", nargs="+", choices=list(NAMED_SCENES), default=quick, metavar="NAME")
    parser.add_argument("--n", type=int, default=3, help="seeds per scene")
    parser.add_argument("--seed", type=int, default=100, help="the first one")
    parser.add_argument("--latency", type=float, default=LATENCY_S, help="s")
    parser.add_argument("--without", nargs="+", choices=remedies(), default=[], metavar="REMEDY", help="switched off")
    parser.add_argument("--each", action="store_true", help="a row for every drive too")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    items = [(name, seed) for name in args.scene for seed in range(args.seed, args.seed + args.n)]
    drives: list[Drive] = []
    print(head("scene", *COLUMNS, "what fails"), flush=True)
    for done in share_out(partial(run, latency=args.latency, without=args.without), items, args.workers):
        drives.append(done)
        if args.each:
            name = f"{done.scene}, seed {done.seed}, {done.kind}"
            print(row(name, *cells([done]), ", ".join(done.failed) or "–"), flush=True)
        same_scene = [d for d in drives if d.scene == done.scene]
        if len(same_scene) == args.n:
            failed = sorted({what for d in same_scene for what in d.failed})
            print(row(f"`{done.scene}`", *cells(same_scene), ", ".join(failed) or "–"), flush=True)
    print("\n" + machine())


if __name__ == "__main__":
    main()
