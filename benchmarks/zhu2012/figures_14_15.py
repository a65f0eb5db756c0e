"""[Zhu] figures 14 and 15(a): two vehicles on a highway at 50 and 57 mph, as in *OH-315*, each with its own filter."""

from __future__ import annotations

from pathlib import Path

from zhu2012 import clips, drawing, figures, methods
from zhu2012.reproductions import Numbers, Reproduction, image, run_alone

SCENE = "oh315"
VEHICLES = ("v0", "v1")
SETTINGS: Numbers = {"particles": 400, "speed_noise": 0.15}  # both begin at 55 mph, the limit there; the clip says so


def compute() -> Numbers:
    configuration = clips.as_printed(particles=SETTINGS["particles"], speed_noise=SETTINGS["speed_noise"])
    found = [methods.all_methods(SCENE, configuration, None, ("sift", "lucas-kanade"), index) for index in range(2)]
    return {kind: {v: f[kind] for v, f in zip(VEHICLES, found, strict=True)} for kind in ("shown", "drawn")}


def text(shown: Numbers) -> str:
    parts = [
        image("figure-14.webp", "Outlines and particles of both vehicles"),
        image("figure-15a-v0.svg", "Speed of the left vehicle over time"),
        image("figure-15a-v1.svg", "Speed of the right vehicle over time"),
    ]
    for vehicle in VEHICLES:
        parts += [f"Vehicle {vehicle}:", figures.markdown(shown[vehicle])]
    return "\n\n".join(parts)


def draw(numbers: Numbers, folder: Path) -> None:
    sheet = []
    for vehicle, drawn in numbers["drawn"].items():
        figures.over_time(folder / f"figure-15a-{vehicle}.svg", drawn, list(drawn["runs"]), ("speed", "depth"))
        for particles in (False, True):
            run = drawn["runs"]["as printed"]
            sheet.append(figures.strip(SCENE, run, drawn["truth"], figures.SHOWN_FRAMES, vehicle, particles))
    drawing.save(folder / "figure-14.webp", drawing.montage(sheet))


REPRODUCTION = Reproduction(
    name="figures-14-15",
    script="zhu2012.figures_14_15",
    title="[Zhu] figures 14 and 15(a): two vehicles, 50 and 57 mph",
    compute=compute,
    text=text,
    draw=draw,
    pictures=("figure-14.webp", "figure-15a-v0.svg", "figure-15a-v1.svg"),
    settings=SETTINGS,
    scenes=(SCENE,),
    rooms=("speed", "baselines"),
    helpers=(clips, methods),
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
