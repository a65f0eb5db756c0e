"""Recordings whose pictures are missing, repeated or swapped in both views alike, of which no file says so.

python benchmarks/frame_faults.py [--n 3] [--seed 1] [--rates 5 25] [--faults NAME …] [--workers 1] [--plain]

Each fault is put to the same ``--n`` straights and bends at each rate, and to straights on which the vehicle brakes.
Clips are folders of pictures with a `rate`; pictures that appear twice are compressed anew unless NAME says `exact`.
NAME is the beginning of one of the table's. ``--plain`` prints one line for each clip as well.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from cameras import suitable
from common import PLAIN_RIG, Array, Rows, head, machine, measured, row, share_out, why_not

from paceline import UnusableInput, load_clip
from paceline.simulation.random_scenes.drawn import random_bend, random_scene
from paceline.simulation.stereo.clip import Scene, render, write
from paceline.speed.results import Measurement

ROADS = "straight", "bend", "braking"
FRAMES_BY_RATE = {5.0: 12, 10.0: 16, 25.0: 40}  # of straights
BRAKING_MPS2 = 5.0
JPEG_QUALITY = 85  # of repeated pictures
FAULTS = (
    "none",
    "swapped",
    *(f"{count} missing" for count in (1, 2, 3)),
    *(f"repeated {count}×" for count in (1, 2, 3)),
    *(f"repeated {count}×, exact" for count in (1, 3)),
    *(f"first repeated {count}×" for count in (1, 3)),
    "all doubled",
)


@dataclass(frozen=True)
class Case:
    fault: str
    road: str
    rate: float
    seed: int


@dataclass(frozen=True)
class Outcome:
    """The error of a measured speed and its half-width, m/s, or why there is none."""

    case: Case
    true: float = float("nan")
    error: float = float("nan")
    half_width: float = float("nan")
    reason: str = ""
    notices: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        if self.reason:
            return "rejected"
        return "right" if abs(self.error) <= self.half_width else "wrong"


def scene_of(case: Case) -> Scene:
    if case.road == "bend":
        return suitable(lambda seed: random_bend(seed, None, case.rate), case.seed)
    frames = FRAMES_BY_RATE[case.rate]
    vehicle: dict[str, Any] = {"acceleration": 0.0, "glare": False}

    def make(seed: int) -> Scene:
        if case.road == "braking":
            speed = float(np.random.default_rng([seed, 71]).uniform(14.0, 25.0))
            vehicle.update(speed=speed, acceleration=-min(BRAKING_MPS2, 0.9 * speed * case.rate / frames))
        return random_scene(
            seed,
            vehicle=vehicle,
            radius=None,
            rate=case.rate,
            frames=frames,
            occluder=False,
            dropped=(),
            **PLAIN_RIG,
        )

    return suitable(make, case.seed)


def picture_order(fault: str, count: int, at: int) -> list[int]:
    """The pictures of a recording of ``count`` as a ``fault`` after picture ``at`` leaves them."""
    order = list(range(count))
    number = next((int(c) for c in fault if c.isdigit()), 0)
    if fault == "swapped":
        order[at : at + 2] = [at + 1, at]
    elif fault.endswith("missing"):
        del order[at : at + number]
    elif fault.startswith("first repeated"):
        order = [0] * number + order
    elif fault.startswith("repeated"):
        order[at:at] = [at] * number
    elif fault == "all doubled":
        order = [k for k in order for _ in range(2)]
    return order


def spoil(folder: Path, spoiled: Path, case: Case) -> list[int]:
    """Writes the clip of ``folder`` with the fault of ``case`` to the folder ``spoiled``; returns its pictures."""
    names = sorted(path.name for path in (folder / "left").iterdir())
    place = int(np.random.default_rng([case.seed, 73]).integers(3, len(names) - 6))
    order = picture_order(case.fault, len(names), place)
    for side in ("left", "right"):
        (spoiled / side).mkdir(parents=True)
        shown: set[int] = set()
        for k, picture in enumerate(order):
            source, target = folder / side / names[picture], spoiled / side / f"{k:04d}.png"
            if picture in shown and not case.fault.endswith("exact"):
                image = np.asarray(cv2.imread(str(source), cv2.IMREAD_UNCHANGED))
                coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
                cv2.imwrite(str(target), np.asarray(cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)))
            else:
                shutil.copy(source, target)
            shown.add(picture)
    shutil.copy(folder / "rig.yaml", spoiled)
    document = yaml.safe_load((folder / "clip.yaml").read_text())
    document["rate"] = case.rate * (2 if case.fault == "all doubled" else 1)
    for vehicle in document["vehicles"]:
        vehicle["frame"] = order.index(vehicle["frame"])
    (spoiled / "clip.yaml").write_text(yaml.safe_dump(document))
    return order


def true_mean_speed(truth: Rows, order: Sequence[int], m: Measurement) -> float:
    """The true mean speed (m/s) between the frames of a track, by when its pictures were taken."""
    rows = {r["frame"]: r for r in truth if r["vehicle"] == m.vehicle}
    tracked = [k for k, status in zip(m.track.frame.tolist(), m.track.status, strict=True) if status == "tracking"]
    pictures = sorted({order[k] for k in tracked})
    t: Array = np.array([rows[k]["time_s"] for k in pictures])
    v: Array = np.array([rows[k]["speed_mps"] for k in pictures])
    return float(np.trapezoid(v, t) / (t[-1] - t[0]))


def run(cases: Sequence[Case]) -> list[Outcome]:
    """The outcomes of ``cases`` of one clip."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, outcomes = Path(temporary) / "clip", []
        rendered = render(scene_of(cases[0]))
        write(rendered, folder, states_cameras=False)
        for n, case in enumerate(cases):
            order = spoil(folder, Path(temporary) / str(n), case)
            try:
                clip = load_clip(Path(temporary) / str(n) / "clip.yaml")
                m = measured(clip)[0]
            except (UnusableInput, ArithmeticError, ValueError) as error:
                outcomes.append(Outcome(case, reason=why_not(error)))
                continue
            if m.verdict == "rejected":
                outcomes.append(Outcome(case, reason=m.reason))
                continue
            true = true_mean_speed(rendered.truth, order, m)
            outcomes.append(Outcome(case, true, m.speed - true, (m.speed_hi - m.speed_lo) / 2))
        return outcomes


def cells(outcomes: Sequence[Outcome]) -> list[str]:
    """How many are measured right, measured wrong and rejected, and the farthest outside its interval."""
    counts = [sum(o.kind == kind for o in outcomes) for kind in ("right", "wrong", "rejected")]
    outside = [abs(o.error) / o.half_width - 1 for o in outcomes if not o.reason]
    return [*map(str, counts), f"{max(0.0, *outside):.1f}" if outside else "–"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rates", type=float, nargs="*", default=[5.0, 25.0], choices=FRAMES_BY_RATE)
    parser.add_argument("--roads", nargs="*", default=ROADS, choices=ROADS)
    parser.add_argument("--faults", nargs="*", default=[""])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--plain", action="store_true")
    options = parser.parse_args()
    faults = [fault for fault in FAULTS if fault.startswith(tuple(options.faults))]
    clips = [
        [Case(fault, road, rate, seed) for fault in faults]
        for rate in options.rates
        for road in options.roads
        for seed in range(options.seed, options.seed + options.n)
    ]
    outcomes: list[Outcome] = []
    for of_clip in share_out(run, clips, options.workers):
        outcomes += of_clip
        if options.plain:
            for o in of_clip:
                c = o.case
                print(
                    f"{c.fault:22} {c.road:9} {c.rate:g} {c.seed} {o.kind:9} {o.true:.2f} {o.error:+.3f} ± "
                    f"{o.half_width:.3f} {o.reason}",
                    flush=True,
                )
    print(machine() + "\n")
    print(head("fault", "measured right", "measured wrong", "rejected", "farthest outside, half-widths"))
    for fault in faults:
        print(row(fault, *cells([o for o in outcomes if o.case.fault == fault])))
    print(row("all", *cells(outcomes)))


if __name__ == "__main__":
    main()
