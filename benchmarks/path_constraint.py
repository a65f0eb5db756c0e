"""The drawn path as a hard constraint and as a prior: the speed error with each.

python benchmarks/path_constraint.py [--n 20] [--seed 2000] [--workers 2]
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from common import (
    MPH,
    Array,
    head,
    machine,
    measured,
    plain_scene,
    rendered,
    rms,
    row,
    share_out,
    true_mean,
    true_speeds,
)

from paceline.speed.results import Measurement

SETTLED = 6  # frames after which a filter is judged: by then the first guess is forgotten
FILTERS: dict[str, dict[str, Any]] = {
    "filter as printed, path as a hard constraint": {"guided": False, "exact_path": True},
    "filter as printed, path as a prior": {"guided": False},
    "filter with registration, path as a hard constraint": {"exact_path": True},
    "filter with registration, path as a prior": {},
}
REFINED = "refinement"
METHODS = [*FILTERS, REFINED]


def run(seed: int) -> tuple[int, float, list[float]]:
    """The clip's true speed and each method's error, both in m/s; NaN where the track was lost."""
    with rendered(plain_scene(seed, radius=None)) as (clip, truth):
        errors = []
        for settings in FILTERS.values():
            m = measured(clip, refine=False, **settings)[0]
            errors.append(_settled(m, true_speeds(truth, m)))
        m = measured(clip)[0]
        true = true_mean(truth, m)
        return seed, true, [*errors, m.speed - true]


def _settled(m: Measurement, true: Array) -> float:
    """A filter's mean error over the frames after it has settled."""
    tracked = np.array([s == "tracking" for s in m.track.status])
    late = (m.track.speed - true)[tracked][SETTLED:]
    return float(late.mean()) if len(late) else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description="The effect on the speed of a drawn path as a hard constraint.")
    parser.add_argument("--n", type=int, default=20, help="number of clips")
    parser.add_argument("--seed", type=int, default=2000, help="seed of the first clip")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    print(head("seed", "true, mph", *(f"{name}, %" for name in METHODS)), flush=True)
    speeds, errors = [], []
    for seed, true, missed in share_out(run, range(args.seed, args.seed + args.n), args.workers):
        speeds.append(true)
        errors.append(missed)
        print(row(seed, f"{true / MPH:.1f}", *(f"{100 * e / true:+.2f}" for e in missed)), flush=True)
    print("\n" + head("method", "n", "mean, %", "RMS, %", "largest, %", "RMS, mph", "largest, mph"))
    for name, column in zip(METHODS, np.array(errors).T, strict=True):
        known = np.isfinite(column)
        e, share = column[known] / MPH, 100 * column[known] / np.array(speeds)[known]
        max_errors = np.abs(share).max(), np.abs(e).max()
        numbers = (share.mean(), rms(share), max_errors[0], rms(e), max_errors[1])
        print(row(name, known.sum(), *(f"{x:+.2f}" if i == 0 else f"{x:.2f}" for i, x in enumerate(numbers))))
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
