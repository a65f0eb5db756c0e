"""Effect of the operator's noise on the tables of [Zhu]: errors in the road line, in the outline, both or neither."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from common import MPH, head, measured, row

from zhu2012 import clips, repeats
from zhu2012.clips import Loaded, as_printed, loaded
from zhu2012.reproductions import Numbers, Reproduction, run_alone

SETTINGS: Numbers = {"straight-55": [0.05, 0.9], "neil-28": [0.15, 0.8], "particles": 400}
SCENES = ("straight-55", "neil-28")
DRAWN = {
    "both": (True, True),
    "the line alone": (True, False),
    "the outline alone": (False, True),
    "neither": (False, False),
}


def _drawn(view: Loaded, line: bool, outline: bool) -> Loaded:
    """``view`` with the operator's errors in the road line, in the outline, in both or in neither."""
    perfect = view.without_noise()
    if not line:
        vehicles = [
            replace(p, left=v.left, right=v.right) if outline else p
            for v, p in zip(view.clip.vehicles, perfect.clip.vehicles, strict=True)
        ]
        return replace(perfect, clip=replace(perfect.clip, vehicles=vehicles))
    vehicles = [
        v if outline else replace(v, left=p.left, right=p.right)
        for v, p in zip(view.clip.vehicles, perfect.clip.vehicles, strict=True)
    ]
    return replace(view, clip=replace(view.clip, vehicles=vehicles))


def _refined(view: Loaded) -> dict[str, float | str]:
    """What `paceline speed` reports: mean speed, mph, its motion's model and acceleration, m/s²."""
    m = measured(view.clip)[0]
    acceleration = float(m.acceleration) if np.isfinite(m.acceleration) else 0.0
    return {"refined": m.speed / MPH, "model": m.model, "acceleration": acceleration}


def compute() -> Numbers:
    shown: Numbers = {}
    for scene in SCENES:
        noise, guess = SETTINGS[scene]
        view = loaded(scene).with_guess(guess)
        configuration = as_printed(particles=SETTINGS["particles"], speed_noise=noise)
        shown[scene] = {
            name: repeats.repeated(_drawn(view, *what), configuration) | _refined(_drawn(view, *what))
            for name, what in DRAWN.items()
        }
    return {"shown": shown, "drawn": {}}


def text(shown: Numbers) -> str:
    columns = ("as printed: average, mph", "max error", "refined, mph", "its model", "acceleration, m/s²")
    lines = [head("clip", "drawn with noise", *columns)]
    for scene in SCENES:
        for name in DRAWN:
            s = shown[scene][name]
            cells = [f"{s[k]:.2f}" for k in ("mean", "max", "refined")] + [s["model"], f"{s['acceleration']:+.2f}"]
            lines.append(row(f"`{scene}`", name, *cells))
    return "\n".join(lines)


REPRODUCTION = Reproduction(
    name="operator-noise",
    script="zhu2012.operator_noise",
    title="Effect of the operator's noise on these tables",
    compute=compute,
    text=text,
    settings=SETTINGS,
    scenes=SCENES,
    helpers=(clips, repeats),
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
