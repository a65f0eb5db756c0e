"""Two figures of [Zhu] about one vehicle: its tracks and particles in pictures, and all methods over time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zhu2012 import clips, figures, methods
from zhu2012.reproductions import Numbers, Reproduction, image

BESIDE_SPEED = {"depth": "error of the depth", "turn": "angular velocity"}  # the second panel of the plot over time


@dataclass(frozen=True)
class Comparison:
    """The ``figures`` by their numbers; ``settings`` are particles, noise of the speed and the first guess over the
    true one, ``pictured`` the methods whose tracks are shown. See `methods.all_methods`."""

    figures: tuple[int, int]
    title: str
    scene: str
    settings: Numbers
    baselines: tuple[str, ...]
    pictured: tuple[str, ...]
    beside_speed: str
    unconstrained: bool = False
    operator_noise: bool = True

    def compute(self) -> Numbers:
        s = self.settings
        configuration = clips.as_printed(particles=s["particles"], speed_noise=s["speed_noise"])
        return methods.all_methods(
            self.scene,
            configuration,
            s["guess"],
            self.baselines,
            unconstrained=self.unconstrained,
            operator_noise=self.operator_noise,
        )

    @property
    def pictures(self) -> tuple[str, str]:
        return f"figure-{self.figures[0]}.webp", f"figure-{self.figures[1]}.svg"

    def text(self, shown: Numbers) -> str:
        tracks = "Outlines and particles in frames 1, 3, 5, 7 and 9"
        if "multimodal" in self.pictured:
            tracks += ", and the multimodal tracker's disparities"
        over_time = f"Speed and {BESIDE_SPEED[self.beside_speed]} over time, by all methods"
        parts = [image(*what) for what in zip(self.pictures, (tracks, over_time), strict=True)]
        return "\n\n".join([*parts, figures.markdown(shown)])

    def draw(self, numbers: Numbers, folder: Path) -> None:
        drawn = numbers["drawn"]
        tracks, over_time = (folder / name for name in self.pictures)
        figures.tracks(tracks, self.scene, drawn, self.pictured)
        figures.over_time(over_time, drawn, list(drawn["runs"]), ("speed", self.beside_speed))

    def item(self) -> Reproduction:
        first, second = self.figures
        chosen = {
            "baselines": list(self.baselines),
            "unconstrained": self.unconstrained,
            "operator_noise": self.operator_noise,
        }
        return Reproduction(
            name=f"figures-{first}-{second}",
            script=f"zhu2012.figures_{first}_{second}",
            title=f"[Zhu] figures {first} and {second}: {self.title}",
            compute=self.compute,
            text=self.text,
            draw=self.draw,
            pictures=self.pictures,
            settings=self.settings | {"scene": self.scene} | chosen,
            scenes=(self.scene,),
            rooms=("speed", "baselines"),
            helpers=(clips, methods),
        )
