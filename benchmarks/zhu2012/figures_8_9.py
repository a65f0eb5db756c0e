"""[Zhu] figures 8 and 9: tracks, particles, speed and angular velocity on the circle at 36 mph."""

from __future__ import annotations

from zhu2012.comparison import Comparison
from zhu2012.reproductions import run_alone

REPRODUCTION = Comparison(
    (8, 9),
    "circle of 41 m, 36 mph",
    scene="circle-36",
    settings={"particles": 200, "speed_noise": 0.05, "guess": 0.9},
    baselines=("sift", "kalman", "lucas-kanade"),
    pictured=("as printed",),
    beside_speed="turn",
    operator_noise=False,
).item()

if __name__ == "__main__":
    run_alone(REPRODUCTION)
