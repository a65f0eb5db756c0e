"""[Zhu] Table I(a): the number of particles on the synthetic 55 mph sequence."""

from __future__ import annotations

from zhu2012.reproductions import run_alone
from zhu2012.sweep import Sweep

PAPER = ((54.50, 0.82, 127.5), (54.93, 0.33, 213.1), (54.95, 0.28, 405.3), (55.01, 0.31, 575.2), (54.95, 0.25, 761.4))
REPRODUCTION = Sweep(
    "1a",
    "[Zhu] Table I(a): particles, straight road, 55 mph",
    scene="straight-55",
    setting="particles",
    values=(100, 200, 400, 600, 800),
    label="particles",
    paper=PAPER,
    digits=2,
    guess=0.9,
    fixed={"speed_noise": 0.05},
    defaults=True,
).item()

if __name__ == "__main__":
    run_alone(REPRODUCTION)
