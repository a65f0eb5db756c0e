"""[Zhu] Table II(b): the noise of the dynamics on a winding road at 28 mph, like the sequence *Neil*."""

from __future__ import annotations

from zhu2012 import clips, repeats, tables
from zhu2012.items import Item, Numbers, run_alone

PAPER = ((27.63, 0.601), (27.71, 0.731), (27.86, 0.961), (27.69, 1.409), (27.89, 1.513))
SETTINGS: Numbers = {"speed_noise": [0.05, 0.10, 0.15, 0.20, 0.25], "particles": 400, "guess": 0.8}


def compute() -> Numbers:
    varied = [{"speed_noise": s} for s in SETTINGS["speed_noise"]]
    particles, guess = SETTINGS["particles"], SETTINGS["guess"]
    return {"shown": repeats.table("neil-28", guess, "speed_noise", varied, particles=particles), "drawn": {}}


def text(shown: Numbers) -> str:
    return tables.markdown(shown, "noise, m/s", PAPER, 3)


ITEM = Item(
    name="table-2b",
    script="zhu2012.table_2b",
    title="[Zhu] Table II(b): noise of the dynamics, winding road, 28 mph",
    compute=compute,
    text=text,
    settings=SETTINGS,
    scenes=("neil-28",),
    helpers=(clips, repeats),
)


def main() -> None:
    run_alone(ITEM)


if __name__ == "__main__":
    main()
