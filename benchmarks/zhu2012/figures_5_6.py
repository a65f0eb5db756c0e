"""[Zhu] figures 5 and 6: tracks, particles, speed and depth on the straight road at 55 mph, with 800 particles."""

from __future__ import annotations

from zhu2012.comparison import Comparison
from zhu2012.reproductions import run_alone

REPRODUCTION = Comparison(
    (5, 6),
    "straight road, 55 mph",
    scene="straight-55",
    settings={"particles": 800, "speed_noise": 0.05, "guess": 0.9},
    baselines=("sift", "kalman", "multimodal", "lucas-kanade"),
    pictured=("as printed", "unconstrained", "multimodal"),
    beside_speed="depth",
    unconstrained=True,
).item()

if __name__ == "__main__":
    run_alone(REPRODUCTION)
