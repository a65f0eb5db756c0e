"""What the first guess of the speed does to the tables of [Zhu]."""

from __future__ import annotations

from common import head, row

from zhu2012 import clips, repeats
from zhu2012.clips import as_printed, loaded
from zhu2012.reproductions import Numbers, Reproduction, run_alone

SETTINGS: Numbers = {"guesses": [0.8, 0.9, 1.0, 1.1], "particles": 400, "straight-55": 0.05, "neil-28": 0.15}
SCENES = ("straight-55", "neil-28")


def compute() -> Numbers:
    shown: Numbers = {}
    for scene in SCENES:
        configuration = as_printed(particles=SETTINGS["particles"], speed_noise=SETTINGS[scene])
        perfect = loaded(scene).without_noise()
        shown[scene] = [repeats.repeated(perfect.with_guess(guess), configuration) for guess in SETTINGS["guesses"]]
    return {"shown": shown, "drawn": {}}


def text(shown: Numbers) -> str:
    columns = (f"`{scene}`: {what}" for scene in SCENES for what in ("average, mph", "max error"))
    lines = [head("first guess over the true speed", *columns)]
    for i, guess in enumerate(SETTINGS["guesses"]):
        lines.append(row(f"{guess:.1f}", *(f"{shown[s][i][k]:.2f}" for s in SCENES for k in ("mean", "max"))))
    return "\n".join(lines)


REPRODUCTION = Reproduction(
    name="first-guess",
    script="zhu2012.first_guess",
    title="What the first guess of the speed does to these tables",
    compute=compute,
    text=text,
    settings=SETTINGS,
    scenes=SCENES,
    helpers=(clips, repeats),
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
