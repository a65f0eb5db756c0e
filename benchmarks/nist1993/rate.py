"""[NIST] section 3: update rate and delay, 15 Hz and 128 ms there."""

from __future__ import annotations

import numpy as np
from common import head, row
from follow import operators_start
from zhu2012.reproductions import Numbers, run_alone

from nist1993 import scenes
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.tracker import FollowTracker, warm_up
from paceline.recordings.odometry import Pose
from paceline.simulation.chase.clip import render_frames
from paceline.simulation.random_scenes.drawn import random_chase

SETTINGS: Numbers = {"seeds": [980, 981, 982], "frames": 200}
PAPER = ((128.0, 15.0),)  # ms of delay, pictures a second
CONFIGURATIONS = {"as published": FollowConfiguration.as_published(), "all remedies": FollowConfiguration()}


def compute() -> Numbers:
    warm_up()
    spent: dict[str, list[float]] = {name: [] for name in CONFIGURATIONS}
    for seed in SETTINGS["seeds"]:
        scene = random_chase(seed, frames=SETTINGS["frames"])
        frames = list(render_frames(scene))  # beforehand: rendering between two frames would empty the caches
        for name, configuration in CONFIGURATIONS.items():
            tracker = FollowTracker(scene.camera, *operators_start(scene, frames[0][1]), configuration)
            for image, truth in frames:
                pose = Pose(truth.x, truth.y, truth.heading)
                spent[name].append(1e3 * tracker.update(image, truth.time, truth.frame, pose).latency)
    shown = {
        name: {
            "frames": len(ms),
            "median": float(np.median(ms)),
            "p99": float(np.percentile(ms, 99)),
            "max": float(np.max(ms)),
            "rate": 1000 / float(np.mean(ms)),
        }
        for name, ms in spent.items()
    }
    return {"shown": shown, "drawn": {}}


def text(shown: Numbers) -> str:
    lines = [head("method", "frames", "median, ms", "99 %, ms", "slowest, ms", "frames/s, one core")]
    lines += [row("[NIST]", "–", "–", "–", f"{delay:.0f}", f"{hertz:.0f}") for delay, hertz in PAPER]
    for name, s in shown.items():
        lines.append(row(name, s["frames"], *(f"{s[k]:.2f}" for k in ("median", "p99", "max")), f"{s['rate']:.0f}"))
    return "\n".join(lines)


REPRODUCTION = scenes.item("rate", "section 3: rate and delay", SETTINGS, compute, text)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
