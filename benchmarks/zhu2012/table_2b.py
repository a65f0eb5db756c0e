"""[Zhu] Table II(b): the noise of the dynamics on a winding road at 28 mph, like the sequence *Neil*."""

from __future__ import annotations

from zhu2012.reproductions import run_alone
from zhu2012.sweep import Sweep

PAPER = ((27.63, 0.601), (27.71, 0.731), (27.86, 0.961), (27.69, 1.409), (27.89, 1.513))
REPRODUCTION = Sweep(
    "2b",
    "[Zhu] Table II(b): noise of the dynamics, winding road, 28 mph",
    scene="neil-28",
    setting="speed_noise",
    values=(0.05, 0.10, 0.15, 0.20, 0.25),
    label="noise, m/s",
    paper=PAPER,
    digits=3,
    guess=0.8,
    fixed={"particles": 400},
).item()

if __name__ == "__main__":
    run_alone(REPRODUCTION)
