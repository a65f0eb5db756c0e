"""[Zhu] Table II(a): the number of particles on a winding road at 28 mph, like the sequence *Neil*."""

from __future__ import annotations

from zhu2012.reproductions import run_alone
from zhu2012.sweep import Sweep

PAPER = (
    (27.03, 3.129, 142.5),
    (27.16, 1.892, 233.2),
    (27.86, 0.961, 415.7),
    (27.83, 0.665, 598.0),
    (27.87, 0.575, 790.7),
)
REPRODUCTION = Sweep(
    "2a",
    "[Zhu] Table II(a): particles, winding road, 28 mph",
    scene="neil-28",
    setting="particles",
    values=(100, 200, 400, 600, 800),
    label="particles",
    paper=PAPER,
    digits=3,
    guess=0.8,
    fixed={"speed_noise": 0.15},
    defaults=True,
).item()

if __name__ == "__main__":
    run_alone(REPRODUCTION)
