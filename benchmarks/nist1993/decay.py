"""[NIST] section 4: the trade-off of the exponential decay between abrupt motion and shadows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from common import head, row
from follow_ablation import CALM
from matplotlib.figure import Figure
from zhu2012 import drawing
from zhu2012.reproductions import Numbers, image, run_alone

from nist1993 import scenes
from paceline.follow.configuration import FollowConfiguration
from paceline.simulation.chase.clip import ChaseScene
from paceline.simulation.random_scenes.drawn import random_chase

SETTINGS: Numbers = {
    "decays": [0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.95],
    "seeds": [970, 971, 972, 973, 974],
    "frames": 120,
}
ABRUPT: dict[str, Any] = CALM | {"shake_px": 0.0, "weave": 2.5}
SHADED: dict[str, Any] = CALM | {"shake_px": 0.0, "shadows": 1.6, "ambient": 0.28}
KINDS: dict[str, dict[str, Any]] = {"abrupt motion": ABRUPT, "shadows": SHADED}
ADAPTIVE = "adaptive, all remedies"


def _scenes(kind: str) -> list[ChaseScene]:
    return [random_chase(seed, frames=SETTINGS["frames"], **KINDS[kind]) for seed in SETTINGS["seeds"]]


def compute() -> Numbers:
    published = FollowConfiguration.as_published()
    made = {str(d): published.model_copy(update={"decay": d, "scale_decay": d}) for d in SETTINGS["decays"]} | {
        ADAPTIVE: FollowConfiguration()
    }
    shown: Numbers = {}
    for kind in KINDS:
        found = scenes.judged(_scenes(kind), made)
        shown[kind] = {name: v.shares["lost"] + v.shares["wrong"] for name, v in found.items()}
        shown[f"{kind}, frames"] = found[ADAPTIVE].frames
    return {"shown": shown, "drawn": {}}


def text(shown: Numbers) -> str:
    lines = [head("decay λ", *(f"{kind}: frames off target, %" for kind in KINDS))]
    for name in shown[next(iter(KINDS))]:
        lines.append(row(name, *(f"{shown[kind][name]:.1f}" for kind in KINDS)))
    return "\n\n".join([image("nist-decay.svg", "Frames off target against the decay"), "\n".join(lines)])


def draw(numbers: Numbers, folder: Path) -> None:
    shown, decays = numbers["shown"], SETTINGS["decays"]

    def curves(figure: Figure) -> None:
        ax = figure.subplots()
        for kind, color in zip(KINDS, (drawing.OURS, drawing.REFINED), strict=True):
            shares = [shown[kind][str(d)] for d in decays]
            ax.plot(decays, shares, color=color, marker="o", ms=4, lw=1.6, label=f"{kind}, as published")
            label = f"{kind}, {ADAPTIVE}"
            ax.axhline(shown[kind][ADAPTIVE], color=color, lw=1.2, ls=(0, (5, 3)), label=label)
        ax.set_xlabel("decay λ per cycle (smaller forgets sooner)")
        ax.set_ylabel("frames off target, %")
        ax.set_ylim(bottom=-1)
        figure.legend(loc="outside upper left", ncols=2)

    drawing.plot(folder / "nist-decay.svg", (7.0, 4.0), curves)


REPRODUCTION = scenes.item("decay", "section 4: the decay's trade-off", SETTINGS, compute, text, draw, "nist-decay.svg")

if __name__ == "__main__":
    run_alone(REPRODUCTION)
