"""[Zhu] Table II(a): the number of particles on a winding road at 28 mph, like the sequence *Neil*."""

from __future__ import annotations

from zhu2012 import clips, repeats, tables
from zhu2012.items import Item, Numbers, run_alone

PAPER = (
    (27.03, 3.129, 142.5),
    (27.16, 1.892, 233.2),
    (27.86, 0.961, 415.7),
    (27.83, 0.665, 598.0),
    (27.87, 0.575, 790.7),
)
SETTINGS: Numbers = {"particles": [100, 200, 400, 600, 800], "speed_noise": 0.15, "guess": 0.8}


def compute() -> Numbers:
    varied = [{"particles": n} for n in SETTINGS["particles"]]
    noise, guess = SETTINGS["speed_noise"], SETTINGS["guess"]
    shown = repeats.table("neil-28", guess, "particles", varied, speed_noise=noise)
    return {"shown": shown | repeats.defaults("neil-28", guess), "drawn": {}}


def text(shown: Numbers) -> str:
    return "\n\n".join([tables.markdown(shown, "particles", PAPER, 3), tables.default_words(shown)])


ITEM = Item(
    name="table-2a",
    script="zhu2012.table_2a",
    title="[Zhu] Table II(a): particles, winding road, 28 mph",
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
