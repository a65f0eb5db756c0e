"""[Zhu] figures 10 and 11: tracks, particles, speed and depth on a straight road as recorded, at 36 mph."""

from __future__ import annotations

from zhu2012.comparison import Comparison
from zhu2012.reproductions import run_alone

REPRODUCTION = Comparison(
    (10, 11),
    "straight road as recorded, 36 mph",
    scene="recorded-straight-36",
    settings={"particles": 400, "speed_noise": 0.15, "guess": 0.88},
    baselines=("sift", "kalman", "multimodal", "lucas-kanade"),
    pictured=("as printed", "multimodal"),
    beside_speed="depth",
).item()

if __name__ == "__main__":
    run_alone(REPRODUCTION)
