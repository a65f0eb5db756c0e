"""Errors and intervals of the measured speeds on rendered clips with exact truth.

python benchmarks/accuracy.py [--suite plain|hard|crossing] [--n 120] [--seed 1000] [--gamma 1] [--rig exact]
    [--together 1]

--rig stated moves every clip's rig at random by what its file states as its uncertainty; --rig unstated moves it as
much, and it is taken as exact. With --together 10 the clips are by one rig ten by ten, and
what their vehicles tell of it puts all of them right, as if they had passed in one recording.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from common import (
    MPH,
    distances,
    head,
    machine,
    measured,
    plain_scene,
    rendered,
    rms,
    row,
    share_out,
    true_mean,
    why_not,
)

from paceline.cameras import RigUncertainty, StereoRig, perturbed_rig
from paceline.simulation.random_scenes.drawn import random_crossing, random_scene
from paceline.simulation.stereo.clip import Scene
from paceline.speed.joint_calibration import calibrate_jointly
from paceline.speed.results import Measurement

SUITES = {"plain": plain_scene, "hard": random_scene, "crossing": random_crossing}
RIGS = "exact", "stated", "unstated"
NAN = float("nan")


@dataclass(frozen=True)
class Outcome:
    """One clip: what was in it and what was measured (mph)."""

    seed: int
    scene: str
    curved: bool
    true: float = NAN
    error: float = NAN
    half: float = NAN  # half the width of the 95 % interval
    z: float = NAN  # the error in standard uncertainties
    model: str = "none"
    reason: str = ""  # why it was rejected

    @property
    def is_measured(self) -> bool:
        return not self.reason


def off(rig: StereoRig, seed: int, stated: bool) -> StereoRig:
    """``rig``, off by a draw from an uncertainty like that of a careful calibration, which it states or not."""
    rng = np.random.default_rng([seed, 11])
    turn, shift = rng.uniform(1e-5, 6e-5, 3), rng.uniform(1e-4, 4e-4, 3)
    uncertainty = RigUncertainty(float(rng.uniform(0.3, 2.0)), 0.0, tuple(turn), tuple(shift))
    moved = perturbed_rig(rig, rng.standard_normal(14) @ uncertainty.covariance_root)
    return replace(moved, uncertainty=uncertainty) if stated else moved


def run(seeds: Sequence[int], suite: str, gamma: float, rig: str) -> list[Outcome]:
    """Render, measure and compare the clips of ``seeds`` by cameras of ``gamma`` and one ``rig`` as in RIGS."""
    outcomes: dict[int, Outcome] = {}
    measurements: dict[int, Measurement] = {}
    true: dict[int, float] = {}
    for seed in seeds:
        scene = replace(SUITES[suite](seed), gamma=gamma)
        outcomes[seed] = Outcome(seed, _describe(scene), scene.radius is not None)
        with rendered(scene) as (clip, truth):
            if rig != "exact":
                clip = replace(clip, rig=off(clip.rig, seeds[0], rig == "stated"))
            try:
                m = measured(clip)[0]
            except Exception as error:  # shown in its row, and the others go on
                outcomes[seed] = replace(outcomes[seed], reason=why_not(error))
                continue
            true[seed] = true_mean(truth, m)
        later = len(measurements)  # as if it had passed after those before it
        track = replace(m.track, frame=m.track.frame + 1000 * later, time=m.track.time + 20.0 * later)
        measurements[seed] = replace(m, track=track)
    for seed, m in zip(measurements, calibrate_jointly(list(measurements.values())), strict=True):
        outcomes[seed] = replace(outcomes[seed], **_compared(m, true[seed]))
    return list(outcomes.values())


def _describe(scene: Scene) -> str:
    vehicle, (near, far) = scene.vehicles[0], distances(scene)
    distance_text = f"{near:.0f} → {far:.0f} m" if vehicle.receding else f"{far:.0f} → {near:.0f} m"
    if not scene.draw_path:
        distance_text = f"{far - near:.0f} m across, {scene.road_depth:.0f} m away"
    pictures = scene.frames - len(scene.dropped)
    extras = [
        f"curve {scene.radius:.0f} m" if scene.radius else "",
        f"{vehicle.acceleration:+.1f} m/s²" if vehicle.acceleration else "",
        "pole" if scene.occluder else "",
        "glare" if vehicle.glare else "",
    ]
    return ", ".join(
        [distance_text, f"{pictures} × {1 / scene.rate:.2f} s", f"f {scene.focal:.0f}", *filter(None, extras)]
    )


def _compared(m: Measurement, true: float) -> dict[str, Any]:
    error = m.speed - true
    return {
        "true": true / MPH,
        "error": error / MPH,
        "half": (m.speed_hi - m.speed_lo) / 2 / MPH,
        "z": error / float(np.hypot(m.random_std, np.nan_to_num(m.systematic_std))),
        "model": m.model,
        "reason": m.reason,
    }


def summary(outcomes: list[Outcome]) -> str:
    """The table of groups; the first holds every clip that was measured."""
    good = [o for o in outcomes if o.is_measured]
    groups = {
        "all measured": good,
        "straight": [o for o in good if not o.curved],
        "curved": [o for o in good if o.curved],
        "interval up to ± 0.5 mph": [o for o in good if o.half <= 0.5],
        "interval wider": [o for o in good if o.half > 0.5],
    }
    lines = [head("clips", "n", "RMS, mph", "median", "max", "RMS, % of speed", "median ±, mph", "covered", "z RMS")]
    for name, group in groups.items():
        if group:
            lines.append(_summary_row(name, group))
    return "\n".join(lines)


def _summary_row(name: str, group: list[Outcome]) -> str:
    error, half = np.array([o.error for o in group]), np.array([o.half for o in group])
    size, share = np.abs(error), 100 * error / np.array([o.true for o in group])
    return row(
        name,
        len(group),
        f"{rms(error):.3f}",
        f"{np.median(size):.3f}",
        f"{size.max():.3f}",
        f"{rms(share.tolist()):.2f}",
        f"{np.median(half):.2f}",
        f"{np.mean(size <= half):.0%}",
        f"{rms([o.z for o in group]):.2f}",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Errors and intervals on rendered clips with exact truth.")
    parser.add_argument("--suite", choices=SUITES, default="hard")
    parser.add_argument("--n", type=int, default=120, help="number of clips")
    parser.add_argument("--seed", type=int, default=1000, help="seed of the first clip")
    parser.add_argument("--gamma", type=float, default=1.0, help="values go as light to the power 1 / γ")
    parser.add_argument("--rig", choices=RIGS, default="exact", help="whether the rig is off, and its file says so")
    parser.add_argument("--together", type=int, default=1, help="clips by one rig")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    if args.together > 1 and args.suite != "plain":
        parser.error("--together: goes with --suite plain, whose clips are all by the same cameras")
    start_time, outcomes = time.perf_counter(), []
    print(head("seed", "clip", "true, mph", "error", "95 % ±", "z", "model", "verdict"), flush=True)
    seeds = range(args.seed, args.seed + args.n)
    by_rig = [seeds[i : i + args.together] for i in range(0, args.n, args.together)]
    measuring = partial(run, suite=args.suite, gamma=args.gamma, rig=args.rig)
    for o in chain.from_iterable(share_out(measuring, by_rig, args.workers)):
        outcomes.append(o)
        numbers = (f"{o.true:.2f}", f"{o.error:+.3f}", f"{o.half:.3f}", f"{o.z:+.1f}")
        verdict = "measured" if o.is_measured else f"rejected: {o.reason}"
        print(row(o.seed, o.scene, *numbers, o.model, verdict), flush=True)
    print(f"\nSuite {args.suite}, seeds {args.seed} to {args.seed + args.n - 1}:\n\n{summary(outcomes)}")
    rejected = [str(o.seed) for o in outcomes if not o.is_measured]
    print(f"\n{len(rejected)} of {args.n} rejected{': seeds ' + ', '.join(rejected) if rejected else ''}.")
    print(f"{time.perf_counter() - start_time:.0f} s with {args.workers} processes.\n\n{machine()}")


if __name__ == "__main__":
    main()
