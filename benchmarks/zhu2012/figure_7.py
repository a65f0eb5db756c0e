"""[Zhu] figure 7: tracks with 4, 10 and 16 parts on the straight road at 55 mph, the parts drawn over them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import MPH, head, row

from paceline.speed.filter.likelihood import PartGrid
from zhu2012 import clips, drawing, figures, methods
from zhu2012.reproductions import Numbers, Reproduction, image, run_alone

SCENE = "straight-55"
SETTINGS: Numbers = {"parts": [4, 10, 16], "particles": 200, "speed_noise": 0.05, "guess": 0.9}


def compute() -> Numbers:
    view = clips.loaded(SCENE).with_guess(SETTINGS["guess"])
    vehicle = view.clip.vehicles[0]
    shown, runs = [], []
    for parts in SETTINGS["parts"]:
        configuration = clips.as_printed(
            parts=parts, particles=SETTINGS["particles"], speed_noise=SETTINGS["speed_noise"]
        )
        estimates, _ = clips.filtered(view, configuration)
        grid = PartGrid.for_region(parts, vehicle.left)
        frames = [e.frame for e in estimates]
        offsets = np.array([e.left for e in estimates]) - view.true(vehicle.id, frames, "left")
        shown.append(
            {
                "parts": parts,
                "across": grid.across,
                "down": grid.down,
                "last": estimates[-1].speed / MPH,
                "pixels": float(np.sqrt((offsets.mean(1) ** 2).sum(1).mean())),
            }
        )
        runs.append(methods.of_filter(estimates))
    known = list(range(len(view.frames)))
    truth = {"frame": known, "left": np.round(view.true(vehicle.id, known, "left"), 1).tolist()}
    return {"shown": {"rows": shown}, "drawn": {"runs": runs, "truth": truth}}


def text(shown: Numbers) -> str:
    lines = [head("N_p", "parts across × down", "last speed, mph", "centre off in the picture, px RMS")]
    for r in shown["rows"]:
        lines.append(row(r["parts"], f"{r['across']} × {r['down']}", f"{r['last']:.2f}", f"{r['pixels']:.2f}"))
    return "\n\n".join([image("figure-7.webp", "Tracks with 4, 10 and 16 parts"), "\n".join(lines)])


def draw(numbers: Numbers, folder: Path) -> None:
    drawn, sheet = numbers["drawn"], []
    for run, r in zip(drawn["runs"], numbers["shown"]["rows"], strict=True):
        grid = (r["across"], r["down"])
        name = f"N_p {r['parts']}"
        sheet.append(figures.strip(SCENE, run, drawn["truth"], figures.SHOWN_FRAMES, name, False, grid=grid))
    drawing.save(folder / "figure-7.webp", drawing.montage(sheet))


REPRODUCTION = Reproduction(
    name="figure-7",
    script="zhu2012.figure_7",
    title="[Zhu] figure 7: parts of the likelihood",
    compute=compute,
    text=text,
    draw=draw,
    pictures=("figure-7.webp",),
    settings=SETTINGS,
    scenes=(SCENE,),
    helpers=(clips, methods),
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
