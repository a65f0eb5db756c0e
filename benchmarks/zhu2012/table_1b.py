"""[Zhu] Table I(b): the number of parts N_p on the synthetic 55 mph sequence."""

from __future__ import annotations

from zhu2012 import clips, repeats, tables
from zhu2012.items import Item, Numbers, run_alone

PAPER = ((54.01, 2.72), (54.24, 1.33), (54.71, 0.65), (54.93, 0.33), (54.95, 0.35), (55.05, 0.52))
SETTINGS: Numbers = {"parts": [4, 6, 8, 10, 12, 16], "particles": 200, "speed_noise": 0.05, "guess": 0.9}


def compute() -> Numbers:
    varied = [{"parts": n} for n in SETTINGS["parts"]]
    fixed = {name: SETTINGS[name] for name in ("particles", "speed_noise")}
    return {"shown": repeats.table("straight-55", SETTINGS["guess"], "parts", varied, **fixed), "drawn": {}}


def text(shown: Numbers) -> str:
    return tables.markdown(shown, "N_p", PAPER, 2)


ITEM = Item(
    name="table-1b",
    script="zhu2012.table_1b",
    title="[Zhu] Table I(b): parts of the likelihood, straight road, 55 mph",
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
