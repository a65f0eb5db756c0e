"""[Zhu] figures 10 and 11: tracks, particles, speed and depth on a straight road as recorded, at 36 mph."""

from __future__ import annotations

from pathlib import Path

from zhu2012 import clips, figures, methods
from zhu2012.items import Item, Numbers, image, run_alone

SCENE = "recorded-straight-36"
SETTINGS: Numbers = {"particles": 400, "speed_noise": 0.15, "guess": 0.88}
BASELINES = ("sift", "kalman", "multimodal", "lucas-kanade")


def compute() -> Numbers:
    configuration = clips.as_printed(particles=SETTINGS["particles"], speed_noise=SETTINGS["speed_noise"])
    return methods.all_methods(SCENE, configuration, SETTINGS["guess"], BASELINES)


def text(shown: Numbers) -> str:
    return "\n\n".join(
        [
            image("figure-10.webp", "Outlines and particles in frames 1, 3, 5, 7 and 9"),
            image("figure-11.svg", "Speed and error of the depth over time, by all methods"),
            figures.markdown(shown),
        ]
    )


def draw(numbers: Numbers, folder: Path) -> None:
    drawn = numbers["drawn"]
    figures.tracks(folder / "figure-10.webp", SCENE, drawn, ("as printed", "multimodal"))
    figures.over_time(folder / "figure-11.svg", drawn, list(drawn["runs"]), ("speed", "depth"))


ITEM = Item(
    name="figures-10-11",
    script="zhu2012.figures_10_11",
    title="[Zhu] figures 10 and 11: straight road as recorded, 36 mph",
    compute=compute,
    text=text,
    draw=draw,
    pictures=("figure-10.webp", "figure-11.svg"),
    settings=SETTINGS,
    scenes=(SCENE,),
    rooms=("speed", "baselines"),
    helpers=(clips, methods),
)


def main() -> None:
    run_alone(ITEM)


if __name__ == "__main__":
    main()
