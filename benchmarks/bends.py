"""Drawn clips of vehicles on bends that cross the view: ours and Lucas–Kanade on the same clips in one run.

python benchmarks/bends.py [--n 4] [--seed 1] [--radii 20 30 45 60 80] [--rates 5 10 25] [--free] [--workers 1]
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import product

import numpy as np
from baselines import Outcome, by_each, measured, outcome_cell
from common import head, machine, rms, row, share_out

from paceline.simulation.random_scenes.drawn import random_bend

METHODS = ("lucas-kanade", "ours, refined")
ANY = "all"

Item = tuple[float, float, int]  # radius (m), frames/s, seed


def run(item: Item, free: bool) -> list[Outcome]:
    """A bend of this radius, rate and seed by every method; ``free``: without the drawn road line."""
    radius, rate, seed = item
    return by_each(random_bend(seed, radius, rate, draw_path=not free), METHODS)


def summary(outcomes: list[Outcome]) -> list[str]:
    """Errors of what was measured, mph, and how often the intervals hold."""
    count, error, half = measured(outcomes)
    if not len(error):
        return [count, *"––––––"]
    standard_error = error.std() / np.sqrt(len(error))
    cells = [count, *(f"{v:.3f}" for v in (rms(error), np.abs(error).max()))]
    cells += [f"{error.mean():+.3f} ± {2 * standard_error:.3f}", f"{np.mean(np.abs(error) <= half):.0%}"]
    return [*cells, f"{np.median(half):.2f}", f"{np.median([o.seconds for o in outcomes]):.2f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description="Speeds on bends that cross the view.")
    parser.add_argument("--n", type=int, default=4, help="clips of each radius and rate")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first clip")
    parser.add_argument("--radii", type=float, nargs="+", default=[20.0, 30.0, 45.0, 60.0, 80.0], help="m")
    parser.add_argument("--rates", type=float, nargs="+", default=[5.0, 10.0, 25.0], help="frames/s")
    parser.add_argument("--free", action="store_true", help="without the drawn road line")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    args = parser.parse_args()
    items = list(product(args.radii, args.rates, range(args.seed, args.seed + args.n)))
    print(head("radius, m", "frames/s", "seed", *METHODS), flush=True)
    outcomes: list[tuple[Item, Outcome]] = []
    for item, found in zip(items, share_out(partial(run, free=args.free), items, args.workers), strict=True):
        outcomes += [(item, o) for o in found]
        print(row(f"{item[0]:g}", f"{item[1]:g}", item[2], *(outcome_cell(o) for o in found)), flush=True)
    columns = ("measured", "RMS, mph", "worst", "mean ± 2 s.e.", "covered", "median ±", "processor s per frame")
    print("\n" + head("bends", "method", *columns))
    groups = [(f"{r:g} m", 0, r) for r in args.radii] + [(f"{f:g} frames/s", 1, f) for f in args.rates]
    for (name, place, value), method in product([*groups, (ANY, 0, None)], METHODS):
        group = [o for item, o in outcomes if o.method == method and value in (None, item[place])]
        print(row(name, method, *summary(group)))
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
