"""Cameras that are not ideal, of which no file says so: ours and Lucas–Kanade on the same clips in one run.

python benchmarks/cameras.py [--n 12] [--seed 1] [--imperfections NAME …] [--random-errors]
    [--renderer drawn|raytraced] [--workers 1] [--clips FOLDER]

Each imperfection and level is put to the same ``--n`` straights and ``--n`` bends, at 5 and 10 frames/s in turn. NAME
is the beginning of one of the table's, as in ``--imperfections offset "sway 4"``. With ``--random-errors`` each clip
draws all of its errors at once instead, those of the calibration as well.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from baselines import Outcome, compare_methods, measured, outcome_cell
from bends import METHODS
from common import PLAIN_RIG, Rows, head, machine, raytraced, rendered, rms, row, share_out, suitable, why_not

from paceline import UnusableInput
from paceline.cameras import StereoRig, perturbed_rig
from paceline.documents.loading import Clip
from paceline.simulation.camera_errors import CameraErrors, StereoErrors
from paceline.simulation.random_scenes.drawn import random_bend, random_scene
from paceline.simulation.random_scenes.raytraced import random_raytraced_bend, random_raytraced_straight
from paceline.simulation.raytraced.scene_yaml import SpeedScene, StereoErrorsModel
from paceline.simulation.stereo.clip import Scene, World

ROADS = "straight", "bend"
RATES_HZ = 5.0, 10.0  # frames/s, of even and of odd seeds
RANDOM_ERRORS = "random errors"

# of random errors
MAX_RANDOM_OFFSET_S = 0.02
READOUT_STD_S, SWAY_STD_RAD, ZOOM_STD = 0.012, 2e-4, 5e-4
RANDOM_CRFS = (None, 18, 23, 28)


def _both(**errors: Any) -> StereoErrors:
    return StereoErrors(CameraErrors(**errors), CameraErrors(**errors))


def _right(**errors: Any) -> StereoErrors:
    return StereoErrors(right=CameraErrors(**errors))


def _together(readout: float, zoom: float, offset: float, sway: float, crf: int) -> StereoErrors:
    return StereoErrors(CameraErrors(readout), CameraErrors(readout, zoom), offset, sway=sway, crf=crf)


# A right camera drifts and is knocked half along the epipolar lines and half across them, in mid-recording.
IMPERFECTIONS = {
    "ideal": StereoErrors(),
    **{f"offset {ms} ms": StereoErrors(offset=ms / 1000) for ms in (2, 8, 33)},
    **{f"offset {s:+g} s, videos": StereoErrors(offset=s, crf=18) for s in (0.4, -0.4)},
    "rate 100 ppm": StereoErrors(rate_ppm=100.0),
    **{f"readout {ms} ms": _both(readout=ms / 1000) for ms in (10, 25)},
    "readout 10 ms, right": _right(readout=0.010),
    **{f"sway {k}e-4 rad": StereoErrors(sway=k * 1e-4) for k in (1, 4, 10)},
    **{f"drift {p:g} px/frame": _right(drift=(p * 0.5**0.5, p * 0.5**0.5)) for p in (0.03, 0.3)},
    "knock 2 px": _right(knock=(2**0.5, 2**0.5)),
    **{f"crf {q}": StereoErrors(crf=q) for q in (18, 26, 30)},
    **{f"zoom {p:g} %": _right(zoom=p / 100) for p in (0.2, 0.5, 1.0)},
    "zoom 1 %, both": _both(zoom=0.01),
    "dirt on 5 %": _right(dirt=0.05),
    "rain on 5 %": _right(rain=0.05),
    "exposure +30 %": _right(exposure_step=0.3),
    "mild together": _together(0.010, 0.002, offset=0.002, sway=1e-4, crf=18),
    "rough together": _together(0.025, 0.002, offset=0.008, sway=4e-4, crf=26),
}


@dataclass(frozen=True)
class Case:
    """A clip to render: a straight or a bend whose cameras have an ``imperfection``."""

    imperfection: str
    road: str
    seed: int

    @property
    def rate(self) -> float:
        return RATES_HZ[self.seed % 2]


@dataclass(frozen=True, eq=False)
class Compared:
    """A clip by each method."""

    case: Case
    outcomes: list[Outcome]


def random_errors(seed: int, rate: float) -> StereoErrors:
    """All that an ordinary pair of cameras may have and no file says, drawn at once."""
    rng = np.random.default_rng([seed, 43])
    longest = min(0.5 / rate, MAX_RANDOM_OFFSET_S)

    def camera() -> CameraErrors:
        return CameraErrors(abs(float(rng.normal(0, READOUT_STD_S))), float(rng.normal(0, ZOOM_STD)))

    left, right, offset = camera(), camera(), float(rng.uniform(-longest, longest))
    sway, crf = abs(float(rng.normal(0, SWAY_STD_RAD))), RANDOM_CRFS[int(rng.integers(len(RANDOM_CRFS)))]
    return StereoErrors(left, right, offset, sway=sway, crf=crf)


def errors_of(case: Case, frames: int) -> StereoErrors:
    """Those of a case whose clip has so many ``frames``."""
    if case.imperfection == RANDOM_ERRORS:
        return random_errors(case.seed, case.rate)
    errors = IMPERFECTIONS[case.imperfection]
    return replace(errors, right=replace(errors.right, knock_frame=frames // 2, exposure_frame=frames // 2))


def calibrated(rig: StereoRig, seed: int) -> StereoRig:
    """A ``rig`` whose calibration is off by a draw from what is assumed where its uncertainty is not stated."""
    assert rig.uncertainty is not None and rig.uncertainty.is_assumed
    root = rig.uncertainty.covariance_root
    moved = perturbed_rig(rig, np.random.default_rng([seed, 47]).standard_normal(len(root)) @ root)
    return replace(moved, uncertainty=rig.uncertainty)


def drawn_scene(case: Case) -> Scene:
    def make(seed: int) -> Scene:
        if case.road == "bend":
            scene = random_bend(seed, None, case.rate)
        else:
            steady = {"acceleration": 0.0, "glare": False}
            scene = random_scene(
                seed, vehicle=steady, radius=None, rate=case.rate, occluder=False, dropped=(), **PLAIN_RIG
            )
        scene = replace(scene, errors=errors_of(case, scene.frames))
        World(scene)  # raises ValueError where a view that is late does not show the vehicle beside the other
        return scene

    return suitable(make, case.seed)


def raytraced_scene(case: Case) -> SpeedScene:
    make = random_raytraced_straight if case.road == "straight" else random_raytraced_bend
    scene = suitable(lambda seed: make(seed, rate=case.rate), case.seed)
    return scene.model_copy(update={"camera_errors": StereoErrorsModel.of(errors_of(case, scene.frames))})


def run(case: Case, renderer: str, clips: Path | None) -> Compared:
    """The clip of a case by every method. Ray-traced clips are kept in a folder ``clips``."""
    made: AbstractContextManager[tuple[Clip, Rows]]
    if renderer == "raytraced":
        name = f"{case.imperfection}_{case.road}_{case.seed}".replace(" ", "-").replace("/", "-per-")
        made = raytraced(raytraced_scene(case), clips / name if clips else None, states_cameras=False)
    else:
        made = rendered(drawn_scene(case), states_cameras=False)
    try:
        with made as (clip, truth):
            if case.imperfection == RANDOM_ERRORS:
                clip = replace(clip, rig=calibrated(clip.rig, case.seed))
            return Compared(case, compare_methods(clip, truth, METHODS))
    except UnusableInput as unusable:  # a clip whose drawings contradict each other
        return Compared(case, [Outcome(method, reason=why_not(unusable)) for method in METHODS])


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Errors of what was measured, mph, and how well the intervals hold."""
    count, error, half = measured(outcomes)
    if not len(error):
        return [count, *"–––––"]
    distance = np.abs(error) / half - 1  # beyond the interval's end, in half-widths
    cells = [count, *(f"{v:.3f}" for v in (rms(error), np.abs(error).max()))]
    return [*cells, f"{np.mean(distance <= 0):.0%}", f"{np.median(half):.2f}", f"{max(0.0, distance.max()):.2f}"]


def excess(group: Sequence[Compared]) -> str:
    """How much larger our errors are than Lucas–Kanade's on the clips that both measure, ± two standard errors."""
    pairs = [[abs(o.error) for o in c.outcomes] for c in group if not any(o.reason for o in c.outcomes)]
    if len(pairs) < 2:
        return "–"
    more = np.diff(np.array(pairs), axis=1)
    return f"{more.mean():+.3f} ± {2 * more.std(ddof=1) / np.sqrt(len(more)):.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Speeds by cameras that are not ideal.")
    parser.add_argument("--renderer", choices=("drawn", "raytraced"), default="drawn")
    parser.add_argument("--n", type=int, default=12, help="straights, and as many bends, of each imperfection")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first clip")
    parser.add_argument("--imperfections", nargs="+", default=[""], metavar="NAME", help="those that begin with it")
    parser.add_argument("--random-errors", action="store_true", help="all errors at once, drawn for each clip")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--clips", type=Path, help="folder where ray-traced clips are kept; those there are not redone")
    args = parser.parse_args()
    names = [name for name in IMPERFECTIONS if name.startswith(tuple(args.imperfections))]
    if args.random_errors:
        names = [RANDOM_ERRORS]
    if not names:
        parser.error(f"--imperfections: expected beginnings of {', '.join(IMPERFECTIONS)}")
    seeds = range(args.seed, args.seed + args.n)
    cases = [Case(name, road, seed) for name in names for road in ROADS for seed in seeds]
    print(head("imperfection", "road", "seed", *METHODS), flush=True)
    compared: list[Compared] = []
    for c in share_out(partial(run, renderer=args.renderer, clips=args.clips), cases, args.workers):
        compared.append(c)
        found = (outcome_cell(o) for o in c.outcomes)
        print(row(c.case.imperfection, c.case.road, c.case.seed, *found), flush=True)
    columns = ("measured", "RMS, mph", "worst", "covered", "median ±", "farthest outside, in ±")
    print("\n" + head("imperfection", "road", "method", *columns, "error beyond Lucas–Kanade's"))
    for name in names:
        for road in ROADS:
            group = [c for c in compared if (c.case.imperfection, c.case.road) == (name, road)]
            for k, method in enumerate(METHODS):
                cells = summary([c.outcomes[k] for c in group])
                print(row(name, road, method, *cells, excess(group) if k else ""))
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
