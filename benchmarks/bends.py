"""Vehicles on bends that cross the view, and on straights: ours and Lucas–Kanade on the same clips in one run.

python benchmarks/bends.py [--n 4] [--seed 1] [--radii 20 30 45 60 80] [--rates 5 10 25] [--straights 0] [--free]
    [--aside 0] [--workers 1] [--renderer drawn|raytraced] [--clips FOLDER]

With ``--radii`` alone, without a number, each seed draws its radius from 30 to 80 m.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from itertools import product, zip_longest
from pathlib import Path

import numpy as np
from baselines import Outcome, compare_methods, measured, outcome_cell
from common import PLAIN_RIG, Rows, head, machine, raytraced, rendered, rms, row, share_out, suitable

from paceline.documents.loading import Clip, VehicleDocument
from paceline.simulation.random_scenes.drawn import random_bend, random_scene
from paceline.simulation.random_scenes.raytraced import random_raytraced_bend, random_raytraced_straight
from paceline.simulation.raytraced.scene_yaml import SpeedScene
from paceline.simulation.stereo.scene import Scene
from paceline.simulation.vehicle_catalogue import RAYTRACED_KINDS

METHODS = ("lucas-kanade", "ours, refined")
DRAWN_RADII_M = (20.0, 30.0, 45.0, 60.0, 80.0)
STRAIGHT = float("inf")  # m, the radius of a straight
MIDDLE_RADIUS_M = 50.0  # between the groups of bends whose seeds draw the radius


@dataclass(frozen=True)
class Case:
    """A clip to render: ``radius`` m, infinite on a straight and None where the seed draws it; ``rate`` frames/s."""

    radius: float | None
    rate: float
    seed: int


@dataclass(frozen=True, eq=False)
class Compared:
    """A clip by each method, with the ``radius`` (m) of its road and the ``kind`` of its vehicle."""

    case: Case
    radius: float
    kind: str
    outcomes: list[Outcome]


def drawn_scene(case: Case) -> Scene:
    if case.radius == STRAIGHT:
        steady = {"acceleration": 0.0, "glare": False}
        road = {"radius": None, "rate": case.rate, "occluder": False, **PLAIN_RIG}
        return suitable(lambda seed: random_scene(seed, vehicle=steady, **road), case.seed)
    return random_bend(case.seed, case.radius, case.rate)


def raytraced_scene(case: Case) -> SpeedScene:
    if case.radius == STRAIGHT:
        return random_raytraced_straight(case.seed, case.rate)
    return random_raytraced_bend(case.seed, case.radius, case.rate)


def folder_name(case: Case) -> str:
    road = "straight" if case.radius == STRAIGHT else "bend" if case.radius is None else f"bend_{case.radius:g}m"
    return road + (f"_{case.rate:g}hz" if case.rate != 5 else "") + f"_{case.seed}"


def moved_aside(vehicle: VehicleDocument, share: float) -> VehicleDocument:
    """``vehicle`` with its outlines to the right of where they were drawn, by a ``share`` of their width."""
    shift = np.array([share * np.ptp(vehicle.left[:, 0]), 0.0])
    return replace(vehicle, left=vehicle.left + shift, right=vehicle.right + shift)


def run(case: Case, renderer: str, free: bool, aside: float, clips: Path | None) -> Compared:
    """The clip of a case by every method, without the drawn road line if ``free``, the outline moved ``aside`` by a
    share of its width. Ray-traced clips are kept in a folder ``clips``."""
    kind: str
    made: AbstractContextManager[tuple[Clip, Rows]]
    if renderer == "raytraced":
        scene = raytraced_scene(case)
        kind, radius = scene.vehicles[0].kind, scene.road.radius
        made = raytraced(scene, clips / folder_name(case) if clips else None)
    else:
        drawn = drawn_scene(case)
        kind, radius = "plane", drawn.radius
        made = rendered(drawn)
    with made as (clip, truth):
        if free:
            clip = replace(clip, paths={}, vehicles=[replace(v, path=None) for v in clip.vehicles])
        clip = replace(clip, vehicles=[moved_aside(v, aside) for v in clip.vehicles])
        outcomes = compare_methods(clip, truth, METHODS)
    return Compared(case, STRAIGHT if radius is None else abs(radius), kind, outcomes)


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Errors of what was measured, mph, and how often the intervals hold."""
    count, error, half = measured(outcomes)
    if not len(error):
        return [count, *"––––––"]
    standard_error = error.std() / np.sqrt(len(error))
    cells = [count, *(f"{v:.3f}" for v in (rms(error), np.abs(error).max()))]
    cells += [f"{error.mean():+.3f} ± {2 * standard_error:.3f}", f"{np.mean(np.abs(error) <= half):.0%}"]
    return [*cells, f"{np.median(half):.2f}", f"{np.median([o.seconds for o in outcomes]):.2f}"]


def labels(c: Compared) -> tuple[str, ...]:
    """The groups of the summary that a clip belongs to: by road, by rate, by vehicle, and all bends or straights."""
    kind = (c.kind,) if c.kind in RAYTRACED_KINDS else ()
    if c.radius == STRAIGHT:
        return "", f"{c.case.rate:g} frames/s", *kind, "all straights"
    if c.case.radius is None:
        road = f"bends under {MIDDLE_RADIUS_M:g} m" if c.radius < MIDDLE_RADIUS_M else "wider bends"
    else:
        road = f"{c.radius:g} m"
    return road, f"{c.case.rate:g} frames/s", *kind, "all bends"


def main() -> None:
    parser = argparse.ArgumentParser(description="Speeds on bends that cross the view.")
    parser.add_argument("--renderer", choices=("drawn", "raytraced"), default="drawn")
    parser.add_argument("--n", type=int, default=4, help="clips of each radius and rate")
    parser.add_argument("--straights", type=int, default=0, help="clips of straights of each rate")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first clip")
    parser.add_argument("--radii", type=float, nargs="*", default=DRAWN_RADII_M, help="m; none: drawn from 30–80 m")
    parser.add_argument("--rates", type=float, nargs="+", default=[5.0, 10.0, 25.0], help="frames/s")
    parser.add_argument("--free", action="store_true", help="without the drawn road line")
    parser.add_argument("--aside", type=float, default=0.0, help="outlines this share of their width to the right")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--clips", type=Path, help="folder where ray-traced clips are kept; those there are not redone")
    args = parser.parse_args()
    bends = product(args.radii or [None], args.rates, range(args.seed, args.seed + args.n))
    straights = product([STRAIGHT], args.rates, range(args.seed, args.seed + args.straights))
    cases = [Case(*values) for values in (*bends, *straights)]
    print(head("radius, m", "frames/s", "seed", "vehicle", *METHODS), flush=True)
    compared: list[Compared] = []
    work = partial(run, renderer=args.renderer, free=args.free, aside=args.aside, clips=args.clips)
    for c in share_out(work, cases, args.workers):
        compared.append(c)
        found = (outcome_cell(o) for o in c.outcomes)
        print(row(f"{c.radius:.3g}", f"{c.case.rate:g}", c.case.seed, c.kind, *found), flush=True)
    columns = ("measured", "RMS, mph", "worst", "mean ± 2 s.e.", "covered", "median ±", "processor s per frame")
    print("\n" + head("group", "method", *columns))
    # by road first, then by rate, …
    names = dict.fromkeys(name for place in zip_longest(*(labels(c) for c in compared)) for name in place if name)
    for name, method in product(names, METHODS):
        group = [o for c in compared if name in labels(c) for o in c.outcomes if o.method == method]
        print(row(name, method, *summary(group)))
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
