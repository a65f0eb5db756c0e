"""[Zhu] Table I(a): the number of particles on the synthetic 55 mph sequence."""

from __future__ import annotations

from zhu2012 import clips, repeats, tables
from zhu2012.items import Item, Numbers, run_alone

PAPER = ((54.50, 0.82, 127.5), (54.93, 0.33, 213.1), (54.95, 0.28, 405.3), (55.01, 0.31, 575.2), (54.95, 0.25, 761.4))
SETTINGS: Numbers = {"particles": [100, 200, 400, 600, 800], "speed_noise": 0.05, "guess": 0.9}


def compute() -> Numbers:
    varied = [{"particles": n} for n in SETTINGS["particles"]]
    noise, guess = SETTINGS["speed_noise"], SETTINGS["guess"]
    shown = repeats.table("straight-55", guess, "particles", varied, speed_noise=noise)
    return {"shown": shown | repeats.defaults("straight-55", guess), "drawn": {}}


def text(shown: Numbers) -> str:
    return "\n\n".join(
        [
            tables.markdown(shown, "particles", PAPER, 2),
            tables.default_words(shown),
        ]
    )


ITEM = Item(
    name="table-1a",
    script="zhu2012.table_1a",
    title="[Zhu] Table I(a): particles, straight road, 55 mph",
    compute=compute,
    text=text,
    settings=SETTINGS,
    scenes=("straight-55",),
    helpers=(clips, repeats),
)


def main() -> None:
    run_alone(ITEM)


if __name__ == "__main__":
    main()
