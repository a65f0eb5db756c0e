"""[Zhu] figures 12 and 13: tracks, particles, speed and angular velocity on a winding road, as in *Neil*."""

from __future__ import annotations

from zhu2012.comparison import Comparison
from zhu2012.reproductions import run_alone

REPRODUCTION = Comparison(
    (12, 13),
    "winding road, 28 mph",
    scene="neil-28",
    settings={"particles": 400, "speed_noise": 0.15, "guess": 0.8},
    baselines=("sift", "kalman", "lucas-kanade"),
    pictured=("as printed",),
    beside_speed="turn",
).item()

if __name__ == "__main__":
    run_alone(REPRODUCTION)
