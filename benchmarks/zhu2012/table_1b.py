"""[Zhu] Table I(b): the number of parts N_p on the synthetic 55 mph sequence."""

from __future__ import annotations

from zhu2012.reproductions import run_alone
from zhu2012.sweep import Sweep

PAPER = ((54.01, 2.72), (54.24, 1.33), (54.71, 0.65), (54.93, 0.33), (54.95, 0.35), (55.05, 0.52))
REPRODUCTION = Sweep(
    "1b",
    "[Zhu] Table I(b): parts of the likelihood, straight road, 55 mph",
    scene="straight-55",
    setting="parts",
    values=(4, 6, 8, 10, 12, 16),
    label="N_p",
    paper=PAPER,
    digits=2,
    guess=0.9,
    fixed={"particles": 200, "speed_noise": 0.05},
).item()

if __name__ == "__main__":
    run_alone(REPRODUCTION)
