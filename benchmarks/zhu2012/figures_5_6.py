"""[Zhu] figures 5 and 6: tracks, particles, speed and depth on the straight road at 55 mph, with 800 particles."""

from __future__ import annotations

from pathlib import Path

from zhu2012 import clips, figures, methods
from zhu2012.items import Item, Numbers, image, run_alone

SCENE = "straight-55"
SETTINGS: Numbers = {"particles": 800, "speed_noise": 0.05, "guess": 0.9}
BASELINES = ("sift", "kalman", "multimodal", "lucas-kanade")


def compute() -> Numbers:
    configuration = clips.as_printed(particles=SETTINGS["particles"], speed_noise=SETTINGS["speed_noise"])
    return methods.all_methods(SCENE, configuration, SETTINGS["guess"], BASELINES, unconstrained=True)


def text(shown: Numbers) -> str:
    return "\n\n".join(
        [
            image("figure-5.webp", "Outlines and particles in frames 1, 3, 5, 7 and 9, by three methods"),
            image("figure-6.svg", "Speed and error of the depth over time, by all methods"),
            figures.markdown(shown),
        ]
    )


def draw(numbers: Numbers, folder: Path) -> None:
    drawn = numbers["drawn"]
    figures.tracks(folder / "figure-5.webp", SCENE, drawn, ("as printed", "unconstrained", "multimodal"))
    figures.over_time(folder / "figure-6.svg", drawn, list(drawn["runs"]), ("speed", "depth"))


ITEM = Item(
    name="figures-5-6",
    script="zhu2012.figures_5_6",
    title="[Zhu] figures 5 and 6: straight road, 55 mph",
    compute=compute,
    text=text,
    draw=draw,
    pictures=("figure-5.webp", "figure-6.svg"),
    settings=SETTINGS,
    scenes=(SCENE,),
    rooms=("speed", "baselines"),
    helpers=(clips, methods),
)


def main() -> None:
    run_alone(ITEM)


if __name__ == "__main__":
    main()
