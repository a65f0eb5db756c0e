"""[Zhu] figures 12 and 13: tracks, particles, speed and angular velocity on a winding road, as in *Neil*."""

from __future__ import annotations

from pathlib import Path

from zhu2012 import clips, figures, methods
from zhu2012.items import Item, Numbers, image, run_alone

SCENE = "neil-28"
SETTINGS: Numbers = {"particles": 400, "speed_noise": 0.15, "guess": 0.8}
BASELINES = ("sift", "kalman", "lucas-kanade")


def compute() -> Numbers:
    configuration = clips.as_printed(particles=SETTINGS["particles"], speed_noise=SETTINGS["speed_noise"])
    return methods.all_methods(SCENE, configuration, SETTINGS["guess"], BASELINES)


def text(shown: Numbers) -> str:
    return "\n\n".join(
        [
            image("figure-12.webp", "Outlines and particles in frames 1, 3, 5, 7 and 9"),
            image("figure-13.svg", "Speed and angular velocity over time, by all methods"),
            figures.markdown(shown),
        ]
    )


def draw(numbers: Numbers, folder: Path) -> None:
    drawn = numbers["drawn"]
    figures.tracks(folder / "figure-12.webp", SCENE, drawn, ("as printed",))
    figures.over_time(folder / "figure-13.svg", drawn, list(drawn["runs"]), ("speed", "turn"))


ITEM = Item(
    name="figures-12-13",
    script="zhu2012.figures_12_13",
    title="[Zhu] figures 12 and 13: winding road, 28 mph",
    compute=compute,
    text=text,
    draw=draw,
    pictures=("figure-12.webp", "figure-13.svg"),
    settings=SETTINGS,
    scenes=(SCENE,),
    rooms=("speed", "baselines"),
    helpers=(clips, methods),
)


def main() -> None:
    run_alone(ITEM)


if __name__ == "__main__":
    main()
