"""[Zhu] figures 16 and 15(b): a lane change at 35 mph within 5 s and one at 30 mph within 3 s."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from zhu2012 import clips, drawing, figures, methods
from zhu2012.reproductions import Numbers, Reproduction, image, run_alone

SCENES = ("lane-change-35", "lane-change-30")
SETTINGS: Numbers = {"particles": 400, "speed_noise": 0.15, "guess": 0.9}
FRAMES = (2, 6, 10, 14, 18)
DRIFTS = "drifting"


def compute() -> Numbers:
    configuration = clips.as_printed(particles=SETTINGS["particles"], speed_noise=SETTINGS["speed_noise"])
    shown, drawn = {}, {}
    for scene in SCENES:
        found = methods.all_methods(scene, configuration, SETTINGS["guess"], ("sift", "lucas-kanade"))
        view = _drifting(clips.loaded(scene).with_guess(SETTINGS["guess"]))
        run = methods.of_filter(clips.filtered(view, configuration)[0])
        shown[scene] = {DRIFTS: methods.errors(view, view.clip.vehicles[0].id, run)} | found["shown"]
        drawn[scene] = found["drawn"] | {"runs": {DRIFTS: run} | found["drawn"]["runs"]}
    return {"shown": shown, "drawn": drawn}


def _drifting(view: clips.Loaded) -> clips.Loaded:
    """The road line taken as a curve: only on curves do [Zhu]'s particles drift sideways and up and down."""
    paths = {name: replace(path, shape="curve") for name, path in view.clip.paths.items()}
    return replace(view, clip=replace(view.clip, paths=paths))


def text(shown: Numbers) -> str:
    parts = [image("figure-16.webp", "Outlines and particles of both sequences in frames 2, 6, 10, 14 and 18")]
    for scene in SCENES:
        parts += [
            f"`{scene}`:",
            image(f"figure-15b-{scene}.svg", f"Speed and error of the depth over time in {scene}"),
            figures.markdown(shown[scene]),
        ]
    return "\n\n".join(parts)


def draw(numbers: Numbers, folder: Path) -> None:
    sheet = []
    for scene, drawn in numbers["drawn"].items():
        figures.over_time(folder / f"figure-15b-{scene}.svg", drawn, list(drawn["runs"]), ("speed", "depth"))
        for particles in (False, True):
            run = drawn["runs"][DRIFTS]
            name = scene.removeprefix("lane-change-") + " mph"
            sheet.append(figures.strip(scene, run, drawn["truth"], FRAMES, name, particles))
    drawing.save(folder / "figure-16.webp", drawing.montage(sheet))


REPRODUCTION = Reproduction(
    name="figures-16-15",
    script="zhu2012.figures_16_15",
    title="[Zhu] figures 16 and 15(b): lane changes",
    compute=compute,
    text=text,
    draw=draw,
    pictures=("figure-16.webp", *(f"figure-15b-{scene}.svg" for scene in SCENES)),
    settings=SETTINGS,
    scenes=SCENES,
    rooms=("speed", "baselines"),
    helpers=(clips, methods),
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
