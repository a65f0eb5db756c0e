"""What each part of the refinement is worth: errors without it, on the same clips.

python benchmarks/speed_ablation.py [--n 12] [--straights 6] [--seed 1] [--renderer drawn|raytraced] [--clips FOLDER]
    [--workers 1]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
from baselines import Outcome, compare_methods, measured
from bends import STRAIGHT, Case, drawn_scene, folder_name, raytraced_scene
from common import Array, head, machine, raytraced, rendered, rms, row, share_out

from paceline.speed import run as vehicle_measurement
from paceline.speed.refinement import photometric_fit
from paceline.speed.refinement.photometric_fit import FIXED_INFORMATION, PhotometricFit
from paceline.speed.refinement.pyramid import ROWS_PER_PATCH

METHOD = "ours, refined"
WHOLE = "whole"


def _one_grid(fit: PhotometricFit) -> tuple[Array, Array, float]:
    return fit.rig_offset, fit.theta, fit.mean_speed_variance


def without(part: str) -> AbstractContextManager[object]:
    """Measuring without a ``part`` of the refinement, one of `PARTS`."""
    if part == WHOLE:
        return nullcontext()
    if part == "tracked corners":
        return mock.patch.object(vehicle_measurement, "second_estimate", lambda *_: None)
    if part == "depth offsets of patches":
        flat = FIXED_INFORMATION * np.eye(ROWS_PER_PATCH)
        return mock.patch.object(photometric_fit, "DEPTH_OFFSET_INFORMATION", flat)
    if part == "view-dependent appearance":
        return mock.patch.object(PhotometricFit, "with_view_dependence", lambda fit: fit)
    if part == "mean over patch grids":
        return mock.patch.object(PhotometricFit, "average_over_grids", _one_grid)
    raise ValueError(part)


PARTS = (
    WHOLE,
    "tracked corners",
    "depth offsets of patches",
    "view-dependent appearance",
    "mean over patch grids",
)


def outcomes(case: Case, renderer: str, clips: Path | None) -> list[Outcome]:
    """The clip of a case, measured without each of `PARTS`."""
    found = []
    with ExitStack() as stack:
        if renderer == "raytraced":
            scene = raytraced_scene(case)
            clip, truth = stack.enter_context(raytraced(scene, clips / folder_name(case) if clips else None))
        else:
            clip, truth = stack.enter_context(rendered(drawn_scene(case)))
        for part in PARTS:
            with without(part):
                found += compare_methods(clip, truth, [METHOD])
    return found


def row_of(road: str, part: str, ours: Sequence[Outcome], whole: Sequence[Outcome]) -> str:
    """Errors without a ``part``, and the mean increase of their squares with its standard error, over the clips that
    are measured with it and without."""
    both = [(a, b) for a, b in zip(ours, whole, strict=True) if not (a.reason or b.reason)]
    increase = np.array([a.error**2 - b.error**2 for a, b in both])
    standard_error = increase.std() / np.sqrt(len(increase))
    change = "" if part == WHOLE else f"{1e4 * increase.mean():+.1f} ± {2e4 * standard_error:.1f}"
    count, error, half = measured(ours)
    cells = count, f"{rms(error):.3f}", change, f"{np.mean(np.abs(error) <= half):.0%}", f"{np.median(half):.2f}"
    return row(road, part, *cells, f"{np.median([o.seconds for o in ours]):.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Speeds without parts of the refinement.")
    parser.add_argument("--renderer", choices=("drawn", "raytraced"), default="drawn")
    parser.add_argument("--n", type=int, default=12, help="bends of 30–80 m")
    parser.add_argument("--straights", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1, help="seed of the first clip")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--clips", type=Path, help="folder where ray-traced clips are kept; those there are not redone")
    args = parser.parse_args()
    cases = [Case(None, 5.0, args.seed + k) for k in range(args.n)]
    cases += [Case(STRAIGHT, 5.0, args.seed + k) for k in range(args.straights)]
    found = list(share_out(partial(outcomes, renderer=args.renderer, clips=args.clips), cases, args.workers))
    change = "increase of squared errors ± 2 s.e., 1e-4 mph²"
    print(head("road", "without", "measured", "RMS, mph", change, "covered", "median ±", "processor s per frame"))
    for road, curved in (("bends", True), ("straights", False)):
        group = [o for case, o in zip(cases, found, strict=True) if (case.radius is None) == curved]
        for k, part in enumerate(PARTS if group else ()):
            print(row_of(road, part, [o[k] for o in group], [o[0] for o in group]))
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
