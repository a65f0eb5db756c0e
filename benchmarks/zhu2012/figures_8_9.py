"""[Zhu] figures 8 and 9: tracks, particles, speed and angular velocity on the circle at 36 mph."""

from __future__ import annotations

from pathlib import Path

from zhu2012 import clips, figures, methods
from zhu2012.items import Item, Numbers, image, run_alone

SCENE = "circle-36"
SETTINGS: Numbers = {"particles": 200, "speed_noise": 0.05, "guess": 0.9}
BASELINES = ("sift", "kalman", "lucas-kanade")


def compute() -> Numbers:
    configuration = clips.as_printed(particles=SETTINGS["particles"], speed_noise=SETTINGS["speed_noise"])
    return methods.all_methods(SCENE, configuration, SETTINGS["guess"], BASELINES, hand=False)


def text(shown: Numbers) -> str:
    return "\n\n".join(
        [
            image("figure-8.webp", "Outlines and particles in frames 1, 3, 5, 7 and 9"),
            image("figure-9.svg", "Speed and angular velocity over time, by all methods"),
            figures.markdown(shown),
        ]
    )


def draw(numbers: Numbers, folder: Path) -> None:
    drawn = numbers["drawn"]
    figures.tracks(folder / "figure-8.webp", SCENE, drawn, ("as printed",))
    figures.over_time(folder / "figure-9.svg", drawn, list(drawn["runs"]), ("speed", "turn"))


ITEM = Item(
    name="figures-8-9",
    script="zhu2012.figures_8_9",
    title="[Zhu] figures 8 and 9: circle of 41 m, 36 mph",
    compute=compute,
    text=text,
    draw=draw,
    pictures=("figure-8.webp", "figure-9.svg"),
    settings=SETTINGS,
    scenes=(SCENE,),
    rooms=("speed", "baselines"),
    helpers=(clips, methods),
)


def main() -> None:
    run_alone(ITEM)


if __name__ == "__main__":
    main()
