"""Both trackers on ray-traced clips: errors, coverage of the intervals, frames lost, by properties of the scenes.

paceline simulate suite -n 60 --seed 1 -o suites/speed
paceline simulate suite -n 20 --seed 1 --kind follow -o suites/follow
python benchmarks/raytraced.py suites/speed [--workers 2]
python benchmarks/raytraced.py suites/follow [--workers 2] [--starts 3]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from common import head, machine, measured, read_truth, rms, row, share_out, true_mean, why_not
from follow import OFF_PLACE, OFF_RANGE, SEEN

from paceline import load_clip, load_follow, open_camera
from paceline.documents.loading import FollowClip
from paceline.follow.following import follow
from paceline.simulation.operator import OPERATOR_NOISE
from paceline.simulation.raytraced.scene_yaml import load_follow_scene, load_speed_scene
from paceline.speed.results import Measurement
from paceline.units import COVERAGE_95, SpeedUnit

KMH = SpeedUnit.KMH.mps
NAN = float("nan")

Groups = dict[str, Callable[[Any], bool]]
Outcome = TypeVar("Outcome")

LOUD = 0.006  # shares of white: half of the scenes have more noise


def noise_of(scene: dict[str, Any]) -> float:
    """Standard deviation of a scene's sensor in mid-grey light, in shares of white."""
    s = scene["sensor"]
    return float(np.sqrt(0.2 * s["full_well"] + s["read_noise"] ** 2) / s["full_well"])


# --- speed ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Speed:
    """One clip: what was in it and what was measured (km/h)."""

    name: str
    scene: dict[str, Any]
    distance: float = NAN  # m, mean
    true: float = NAN
    error: float = NAN
    half: float = NAN  # half the width of the 95 % interval
    reason: str = ""  # why it was rejected

    @property
    def car(self) -> dict[str, Any]:
        car: dict[str, Any] = self.scene["vehicles"][0]
        return car

    @property
    def is_steady(self) -> bool:
        return not self.car["acceleration"] and not self.car["lane_change"]

    @property
    def is_calibrated(self) -> bool:
        return self.scene["rig"]["rig_error_std"] is None

    def describe(self) -> str:
        car, rig, road = self.car, self.scene["rig"], self.scene["road"]
        words = [
            car["kind"],
            "oncoming" if car["oncoming"] else "receding",
            f"{self.distance:.0f} m",
            road["kind"] + (f" {road['radius']:.0f} m" if road["radius"] else ""),
            f"{self.scene['frames']} × {1 / self.scene['rate']:.2f} s",
            f"f {rig['focal']:.0f}",
            f"{car['acceleration']:+.1f} m/s²" if car["acceleration"] else "",
            "changes lane" if car["lane_change"] else "",
            "" if self.is_calibrated else "miscalibrated",
        ]
        return ", ".join(filter(None, words))


SPEED_GROUPS: Groups = {
    "steady, calibrated": lambda o: o.is_steady and o.is_calibrated,
    "all": lambda o: True,
    "known to ± 1 km/h (--max-half-width 1)": lambda o: o.half <= 1,
    "miscalibrated": lambda o: not o.is_calibrated,
    "accelerates": lambda o: o.car["acceleration"] != 0,
    "changes lane": lambda o: o.car["lane_change"] is not None,
    "nearer than 35 m": lambda o: o.distance < 35,
    "farther": lambda o: o.distance >= 35,
    "to 60 km/h": lambda o: o.true < 60,
    "faster": lambda o: o.true >= 60,
    "less noise than most": lambda o: noise_of(o.scene) < LOUD,
    "more": lambda o: noise_of(o.scene) >= LOUD,
    "straight road": lambda o: o.scene["road"]["kind"] == "straight",
    "bend": lambda o: o.scene["road"]["kind"] != "straight",
    "cars": lambda o: o.car["kind"] in ("saloon", "estate"),
    "vans, lorries, buses": lambda o: o.car["kind"] in ("van", "lorry", "bus"),
    "motorcycles": lambda o: o.car["kind"] == "motorcycle",
}


def run_speed(folder: Path) -> Speed:
    """Measure and compare the clip in ``folder``."""
    scene = load_speed_scene(folder / "scene.yaml").model_dump()
    rows = read_truth(folder)
    make = partial(Speed, folder.name, scene, float(np.mean([r["distance_m"] for r in rows])))
    try:
        m: Measurement = measured(load_clip(folder / "clip.yaml"))[0]
    except Exception as error:  # shown in its row, and the others go on
        return make(reason=why_not(error))
    if np.isnan(m.speed):
        return make(true=rows[0]["speed_mps"] / KMH, reason=m.reason)
    true = true_mean(rows, m)
    return make(
        true=true / KMH, error=(m.speed - true) / KMH, half=(m.speed_hi - m.speed_lo) / 2 / KMH, reason=m.reason
    )


def print_speed(o: Speed) -> None:
    verdict = f"rejected: {o.reason}" if o.reason else "measured"
    print(row(o.name, o.describe(), f"{o.true:.2f}", f"{o.error:+.3f}", f"{o.half:.3f}", verdict), flush=True)


def speed_summary(outcomes: Sequence[Speed]) -> str:
    """Errors of what was measured, by group, km/h."""
    columns = ("scenes", "measured", "mean error", "σ", "median size", "worst", "median ±", "covered", "over 1 km/h")
    lines = [head("group", *columns)]
    for name, group in grouped(outcomes, SPEED_GROUPS):
        good = [o for o in group if not o.reason]
        error, half = np.array([o.error for o in good]), np.array([o.half for o in good])
        numbers = ["–"] * 7
        if good:
            size = np.abs(error)
            numbers = [f"{v:.3f}" for v in (error.mean(), error.std(), np.median(size), size.max(), np.median(half))]
            numbers += [f"{np.mean(size <= half):.0%}", str(int((size > 1).sum()))]
        lines.append(row(name, len(group), len(good), *numbers))
    return "\n".join(lines)


# --- following -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sight:
    """One frame in which the vehicle can be seen: how far it is (m), and what following said of it."""

    far: float
    tracking: bool
    wrong: bool = False
    range_error: float = NAN  # relative
    lateral_error: float = NAN  # m
    covered: bool = False


@dataclass(frozen=True)
class Chase:
    """One clip, over the frames in which the vehicle can be seen."""

    name: str
    scene: dict[str, Any]
    sights: list[Sight]

    @property
    def kind(self) -> str:
        return str(self.scene["lead"]["kind"])

    def describe(self) -> str:
        light, low = self.scene["light"], min(s.far for s in self.sights)
        distances = f"{low:.0f}–{max(s.far for s in self.sights):.0f} m"
        return f"{self.kind}, {distances}, clouds {light['clouds']:.1f}, noise {noise_of(self.scene):.4f}"


CHASE_GROUPS: Groups = {
    "all": lambda o: True,
    "sun": lambda o: o.scene["light"]["clouds"] < 0.5,
    "clouds": lambda o: o.scene["light"]["clouds"] >= 0.5,
    "less noise than most": lambda o: noise_of(o.scene) < LOUD,
    "more": lambda o: noise_of(o.scene) >= LOUD,
    "cars": lambda o: o.kind in ("saloon", "estate"),
    "vans, lorries, buses": lambda o: o.kind in ("van", "lorry", "bus"),
    "bends tighter than 120 m": lambda o: abs(o.scene["road"]["radius"]) < 120,
    "wider": lambda o: abs(o.scene["road"]["radius"]) >= 120,
}
SIGHT_GROUPS: Groups = {
    "frames nearer than 8 m": lambda s: s.far < 8,
    "frames at 8 to 12 m": lambda s: 8 <= s.far < 12,
    "frames farther": lambda s: s.far >= 12,
}


def run_chase(job: tuple[Path, int]) -> Chase:
    """Follow and compare the clip in a folder, from its own start or, with a number above 0, from another one."""
    folder, start = job
    clip = load_follow(folder / "follow.yaml")
    truth = {r["frame"]: r for r in json.loads((folder / "truth.json").read_text())}
    if start:
        clip = with_another_start(clip, truth[clip.frame], np.random.default_rng([*folder.name.encode(), start]))
    sights = []
    for frame, e in follow(clip, open_camera(clip)):
        true = truth[frame.index]
        if true["visible"] < SEEN:
            continue
        far = true["position"][2]
        if e.status != "tracking":
            sights.append(Sight(far, False))
            continue
        x, _, z = e.position - np.array(true["position"])
        off = float(np.linalg.norm(e.center - np.array(true["center"])))
        wrong = bool(abs(z) > OFF_RANGE * far or off > OFF_PLACE * true["width_px"])
        covered = bool(abs(z) <= COVERAGE_95 * e.position_std[2])
        sights.append(Sight(far, True, wrong, float(z / far), float(x), covered))
    name = f"{folder.name}, start {start}" if start else folder.name
    return Chase(name, load_follow_scene(folder / "scene.yaml").model_dump(), sights)


def with_another_start(clip: FollowClip, first: dict[str, Any], rng: np.random.Generator) -> FollowClip:
    """A ``clip`` with its start drawn anew about the truth of its ``first`` frame."""
    center = np.array(first["center"]) + rng.normal(0, OPERATOR_NOISE.center_px, 2)
    scale = clip.target.nominal_range / first["position"][2] * (1 + rng.normal(0, OPERATOR_NOISE.scale))
    return replace(clip, center=center, scale=float(scale))


CHASE_COLUMNS = ("frames", "lost", "wrong", "range mean, %", "RMS", "worst", "lateral RMS, m", "covered: range")


def sight_cells(sights: Sequence[Sight]) -> list[str]:
    found = [s for s in sights if s.tracking]
    counts = [str(n) for n in (len(sights), len(sights) - len(found), sum(s.wrong for s in found))]
    if not found:
        return [*counts, *["–"] * 5]
    errors, lateral = (np.array([getattr(s, name) for s in found]) for name in ("range_error", "lateral_error"))
    numbers = (100 * errors.mean(), 100 * rms(errors), 100 * float(np.abs(errors).max()))
    covered = np.mean([s.covered for s in found])
    return [*counts, *(f"{v:.2f}" for v in numbers), f"{rms(lateral):.3f}", f"{covered:.0%}"]


def print_chase(o: Chase) -> None:
    print(row(o.name, o.describe(), *sight_cells(o.sights)), flush=True)


def chase_summary(outcomes: Sequence[Chase]) -> str:
    lines = [head("group", "clips", "without a frame lost or wrong", *CHASE_COLUMNS)]
    for name, group in grouped(outcomes, CHASE_GROUPS):
        complete = sum(all(s.tracking and not s.wrong for s in o.sights) for o in group)
        lines.append(row(name, len(group), complete, *sight_cells([s for o in group for s in o.sights])))
    for name, sights in grouped([s for o in outcomes for s in o.sights], SIGHT_GROUPS):
        lines.append(row(name, "–", "–", *sight_cells(sights)))
    return "\n".join(lines)


def grouped(outcomes: Sequence[Outcome], groups: Groups) -> list[tuple[str, list[Outcome]]]:
    """The groups that are not empty."""
    found = [(name, [o for o in outcomes if belongs(o)]) for name, belongs in groups.items()]
    return [(name, group) for name, group in found if group]


def main() -> None:
    parser = argparse.ArgumentParser(description="Both trackers on ray-traced clips.")
    parser.add_argument("suite", type=Path, help="folder that paceline simulate suite has made")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--starts", type=int, default=1, help="operators' starts of each chase")
    args = parser.parse_args()
    start_time = time.perf_counter()
    if speeds := sorted(p.parent for p in args.suite.glob("*/clip.yaml")):
        print(head("clip", "scene", "true, km/h", "error", "95 % ±", "verdict"), flush=True)
        measurements = []
        for o in share_out(run_speed, speeds, args.workers):
            measurements.append(o)
            print_speed(o)
        print(f"\n{speed_summary(measurements)}\n")
    if chases := sorted(p.parent for p in args.suite.glob("*/follow.yaml")):
        print(head("clip", "scene", *CHASE_COLUMNS), flush=True)
        followed = []
        for c in share_out(run_chase, list(product(chases, range(args.starts))), args.workers):
            followed.append(c)
            print_chase(c)
        print(f"\n{chase_summary(followed)}\n")
    if not speeds and not chases:
        parser.error(f"{args.suite}: holds no clips; expected the folder of a suite")
    print(f"{time.perf_counter() - start_time:.0f} s with {args.workers} processes.\n\n{machine()}")


if __name__ == "__main__":
    main()
