"""Two estimates of one speed, by grey values and by tracked corners: how far apart they are where the first is right,
and where it is not.

python benchmarks/two_fits.py [--good 12] [--bad 8] [--moved 4] [--seed 300]
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np
from common import Array, head, machine, rendered, rms, row, true_mean

from paceline.blas import on_one_blas_thread
from paceline.documents.loading import Clip, VehicleDocument
from paceline.simulation.lane_change import LaneChange
from paceline.simulation.random_scenes.drawn import random_bend, random_crossing, random_scene
from paceline.simulation.stereo.scene import Scene
from paceline.speed import acceptance, run
from paceline.speed.measurement import measure_clip
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.model_selection import RefinedMotion
from paceline.speed.refinement.photometric_fit import PhotometricFit
from paceline.speed.refinement.point_fit import SecondEstimate, second_estimate
from paceline.speed.results import Measurement
from paceline.speed.run import VehicleMeasurement

SMALL: dict[str, Any] = {"image_size": (640, 480), "focal": 1400.0, "baseline": 0.5}
MAX_FRAMES, TRIES = 14, 200
GOOD = "straight or bend", "bend of 30-80 m", "brakes or gathers speed", "crosses", "changes lane", "noise"
BAD = "outline beside", "outline too wide", "two vehicles", "glare", "pole", "filter drifts"


@dataclass(frozen=True, eq=False)
class Case:
    """A measured vehicle with what both estimates need."""

    vehicle: VehicleDocument
    refined: RefinedMotion
    keyframes: list[Keyframe]
    fit: PhotometricFit
    measurement: Measurement
    true: float  # m/s
    seconds: float

    @on_one_blas_thread
    def second(self) -> SecondEstimate | None:
        return second_estimate(self.refined, self.keyframes)

    @property
    def is_right(self) -> bool:
        return self.measurement.speed_lo <= self.true <= self.measurement.speed_hi


def good_scene(kind: str, seed: int) -> Scene:
    """A small scene of a vehicle that does what ``kind`` says, in few frames and with nothing in its way."""
    rng = np.random.default_rng([seed, 77])
    for k in range(TRIES):
        vehicle: dict[str, Any] = {"glare": False}
        fixed: dict[str, Any] = {"occluder": False}
        if kind == "brakes or gathers speed":
            vehicle |= {"speed": rng.uniform(12, 27), "acceleration": float(rng.choice([-3.0, 3.0]))}
        if kind == "changes lane":
            speed = rng.uniform(12, 27)
            length = speed * rng.uniform(3, 5)
            shift = float(rng.choice([-1, 1]) * rng.uniform(3, 3.7))
            vehicle |= {"speed": speed, "lane_change": LaneChange(rng.uniform(-0.3, 0.1) * length, length, shift)}
        if kind == "noise":
            fixed["noise_sigma"] = float(rng.uniform(3, 6))
        if kind in ("glare", "pole"):
            vehicle["glare"], fixed["occluder"] = kind == "glare", kind == "pole"
        try:
            if kind == "bend of 30-80 m":
                scene = random_bend(TRIES * seed + k, image_size=(640, 480), focal=1400.0)
            elif kind == "crosses":
                size = {"image_size": (640, 480), "focal": 700.0}
                scene = random_crossing(TRIES * seed + k, vehicle=vehicle, **size, **fixed)
            else:
                scene = random_scene(TRIES * seed + k, vehicle=vehicle, **SMALL, **fixed)
        except ValueError:  # nowhere could this be seen well
            continue
        if scene.frames <= MAX_FRAMES:
            return scene
    raise ValueError(f"no scene of seed {seed}: {kind}")


def outlined(clip: Clip, shift: float = 0.0, widening: float = 1.0) -> Clip:
    """``clip`` with its first vehicle outlined ``shift`` widths beside it in both views, ``widening`` times as wide."""

    def moved(quad: Array) -> Array:
        x = quad[:, 0]
        return np.column_stack([x.mean() + widening * (x - x.mean()) + shift * np.ptp(x), quad[:, 1]])

    vehicle = clip.vehicles[0]
    return replace(clip, vehicles=[replace(vehicle, left=moved(vehicle.left), right=moved(vehicle.right))])


def bad_case(kind: str, seed: int) -> Case | None:
    rng = np.random.default_rng([seed, 99])
    side = float(rng.choice([-1, 1]))
    if kind in ("glare", "pole"):
        return case_of(good_scene(kind, seed))
    scene = good_scene(GOOD[seed % 3 == 2], seed)
    if kind == "outline beside":
        shift = side * float(rng.uniform(0.3, 0.7))
        return case_of(scene, lambda clip: outlined(clip, shift))
    if kind == "outline too wide":
        widening = float(rng.uniform(1.3, 2.0))
        return case_of(scene, lambda clip: outlined(clip, widening=widening))
    if kind == "filter drifts":
        return case_of(scene, drift=side * float(rng.uniform(0.1, 0.6)))
    vehicle = scene.vehicles[0]  # another one in front of half of it, at another speed
    other = replace(
        vehicle,
        id="v1",
        start_distance=vehicle.start_distance - rng.uniform(1.0, 4.0),
        lateral=vehicle.lateral + side * rng.uniform(0.7, 1.2),
        speed=vehicle.speed * (1 + float(rng.choice([-1, 1])) * rng.uniform(0.01, 0.1)),
        texture_seed=vehicle.texture_seed + 1,
    )
    scene = replace(scene, vehicles=(vehicle, other))
    return case_of(scene, lambda clip: replace(clip, vehicles=clip.vehicles[:1]))


def case_of(scene: Scene, changed: Callable[[Clip], Clip] = lambda clip: clip, drift: float = 0.0) -> Case | None:
    """The measured first vehicle of ``scene``, None where nothing was fitted. The filter's quadrilaterals are moved
    sideways, by ``drift`` widths until the last frame."""
    kept: dict[str, Any] = {}
    measure, average, result = (
        VehicleMeasurement._measured, PhotometricFit.average_over_grids, VehicleMeasurement.result
    )  # fmt: skip

    def keep_measured(vehicle: VehicleMeasurement, refined: RefinedMotion) -> Measurement:
        kept.update(vehicle=vehicle.vehicle, refined=refined, keyframes=vehicle.keyframes)
        return measure(vehicle, refined)

    def keep_fit(fit: PhotometricFit) -> tuple[Array, Array, float]:
        kept["fit"] = fit
        return average(fit)

    def drifting(vehicle: VehicleMeasurement) -> Measurement:
        shares = np.linspace(0.0, drift, len(vehicle.keyframes))
        vehicle.keyframes = [
            replace(k, quads=k.quads + s * np.ptp(k.quads[..., 0], axis=1).mean() * np.array([1.0, 0.0]))
            for k, s in zip(vehicle.keyframes, shares, strict=True)
        ]
        return result(vehicle)

    with (
        rendered(scene, states_cameras=bool(scene.seed % 2)) as (clip, truth),
        mock.patch.object(VehicleMeasurement, "_measured", keep_measured),
        mock.patch.object(PhotometricFit, "average_over_grids", keep_fit),
        mock.patch.object(VehicleMeasurement, "result", drifting),
        mock.patch.object(run, "second_estimate", return_value=None),  # it is compared here
    ):
        start = time.process_time()
        (m,) = measure_clip(changed(clip)).measurements
        seconds = time.process_time() - start
        if "refined" not in kept:
            return None
        return Case(**kept, measurement=m, true=true_mean(truth, m), seconds=seconds)


def disagree(case: Case, second: SecondEstimate | None) -> bool:
    """Whether a speed is rejected for its second estimate."""
    half = (case.measurement.speed_hi - case.measurement.speed_lo) / 2
    return second is not None and bool(acceptance.check_second_estimate(second, half))


def moved(case: Case, change: float, along_valley: bool) -> Case:
    """``case`` with a fit whose mean speed is off by a share ``change``: by the speed alone, or with all parameters
    as the images change least by it."""
    gradient, theta = case.refined.trajectory.mean_speed_gradient, case.refined.theta
    direction = case.refined.covariance @ gradient if along_valley else np.eye(len(theta))[1]
    theta = theta + direction * (change * (gradient @ theta) / (gradient @ direction))
    fit = copy(case.fit)
    fit.trajectory = case.refined.trajectory
    fit._reset(theta, [copy(level) for level in case.fit.levels], case.fit.depth_offsets)
    fit._assemble()  # for the variance of the patches
    offsets, share = fit.residual_offsets()
    refined = replace(case.refined, theta=theta, offsets=offsets, explained_share=share, residual_rms=fit.residual_rms)
    half = (case.measurement.speed_hi - case.measurement.speed_lo) / 2
    speed = refined.mean_speed()[0]
    click = 0.5  # px
    reason = (
        acceptance.check_refined(refined, speed, half)
        or acceptance.check_outline(refined, case.vehicle.right, click)
        or acceptance.check_motion(refined)
    )
    m = replace(case.measurement, speed=speed, speed_lo=speed - half, speed_hi=speed + half).with_verdict(reason)
    return replace(case, refined=refined, measurement=m)


def good_table(number: int, seed: int) -> None:
    print(head("clips", "measured", "second estimates", "rms of z", "median", "95 %", "largest", "rejected",
               "rms error, % (grey values)", "(corners)"), flush=True)  # fmt: skip
    everything: list[tuple[float, float, float, bool]] = []
    shares, none = [], 0
    for kind in GOOD:
        found: list[tuple[float, float, float, bool]] = []
        count = 0
        for k in range(number):
            case = case_of(good_scene(kind, seed + k))
            if case is None or case.measurement.verdict != "measured":
                continue
            count += 1
            start = time.process_time()
            second = case.second()
            shares.append((time.process_time() - start, case.seconds))
            if second is None:
                none += 1
                continue
            errors = [100 * (speed / case.true - 1) for speed in (second.speed - second.difference, second.speed)]
            found.append((second.difference / second.difference_std, *errors, disagree(case, second)))
        everything += found
        if found:
            print(cells(kind, count, found), flush=True)
    print(cells("all", len(shares), everything))
    z = np.abs([f[0] for f in everything])
    print("\n|z| at 50, 68, 90, 95, 99, 100 %:", np.quantile(z, [0.5, 0.68, 0.9, 0.95, 0.99, 1.0]).round(2))
    added, whole = np.array(shares).sum(0)
    print(f"processor time: {added / len(shares):.2f} s a vehicle, {added / whole:.1%} of what measuring it costs")


def cells(kind: str, count: int, found: list[tuple[float, float, float, bool]]) -> str:
    z = np.array([f[0] for f in found])
    size = [f"{np.quantile(np.abs(z), q):.2f}" for q in (0.5, 0.95, 1.0)]
    errors = (f"{rms([f[i] for f in found]):.3f}" for i in (1, 2))
    return row(kind, count, len(found), f"{rms(z):.2f}", *size, sum(f[3] for f in found), *errors)


def bad_table(number: int, seed: int) -> None:
    print("\n" + head("spoiled clips", "rejected before", "right", "of these rejected", "wrong", "of these rejected"))
    for kind in BAD:
        counts: dict[str, int] = defaultdict(int)
        for k in range(number):
            case = bad_case(kind, seed + k)
            if case is None or case.measurement.verdict != "measured":
                counts["before"] += 1
                continue
            name = "right" if case.is_right else "wrong"
            counts[name] += 1
            counts[f"{name} rejected"] += disagree(case, case.second())
        names = "before", "right", "right rejected", "wrong", "wrong rejected"
        print(row(kind, *(counts[name] for name in names)), flush=True)


def moved_table(number: int, seed: int) -> None:
    print("\n" + head("moved by", "how", "fits", "rejected before", "rejected by the second estimate", "both pass"))
    cases = [case_of(good_scene(kind, seed + k)) for kind in GOOD for k in range(number)]
    usable = [case for case in cases if case is not None and case.measurement.verdict == "measured"]
    for along_valley in (False, True):
        for size in (0.01, 0.02, 0.03):
            counts: dict[str, int] = defaultdict(int)
            for case in usable:
                for change in (-size, size):
                    wrong = moved(case, change, along_valley)
                    if wrong.measurement.verdict != "measured":
                        counts["before"] += 1
                    else:
                        counts["second" if disagree(wrong, wrong.second()) else "neither"] += 1
            how = "along the valley" if along_valley else "the speed alone"
            names = "before", "second", "neither"
            print(row(f"{size:.0%}", how, 2 * len(usable), *(counts[name] for name in names)), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Two estimates of one speed: how far they are apart.")
    parser.add_argument("--good", type=int, default=12, help="good clips of each kind")
    parser.add_argument("--bad", type=int, default=8, help="spoiled clips of each kind")
    parser.add_argument("--moved", type=int, default=4, help="clips of each kind whose fit is moved")
    parser.add_argument("--seed", type=int, default=300, help="the first seed")
    args = parser.parse_args()
    if args.good:
        good_table(args.good, args.seed)
    if args.bad:
        bad_table(args.bad, args.seed)
    if args.moved:
        moved_table(args.moved, args.seed)
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
