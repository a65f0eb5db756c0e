"""[NIST] section 4: strong shadows and edges parallel to the model's, and what each remedy changes there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from common import head, row
from follow_ablation import SCENARIOS, remedies
from zhu2012 import drawing
from zhu2012.reproductions import Numbers, image, run_alone

from nist1993 import scenes
from paceline.follow.configuration import FollowConfiguration
from paceline.reports.common.drawing import draw_line, scale_points
from paceline.simulation.random_scenes.drawn import random_chase

SETTINGS: Numbers = {"scenarios": ["strong shadows", "parallel edges"], "seeds": [950, 951, 952], "frames": 150}
VIEW = (384, 300)
PUBLISHED, OURS = "as published", "all remedies"


def configurations() -> dict[str, FollowConfiguration]:
    published = FollowConfiguration.as_published()
    made = {PUBLISHED: published}
    made |= {f"published + {name}": published.model_copy(update={name: True}) for name in remedies()}
    made[OURS] = FollowConfiguration()
    made |= {f"all but {name}": FollowConfiguration(**{name: False}) for name in remedies()}
    return made


def _scene(scenario: str, seed: int) -> Any:
    return random_chase(seed, frames=SETTINGS["frames"], **SCENARIOS[scenario](seed))


def compute() -> Numbers:
    shown: Numbers = {}
    for scenario in SETTINGS["scenarios"]:
        found = scenes.judged([_scene(scenario, seed) for seed in SETTINGS["seeds"]], configurations())
        shown[scenario] = {name: v.shares for name, v in found.items()}
        shown[f"{scenario}, frames"] = found[OURS].frames
    return {"shown": shown, "drawn": {s: _moment(s) for s in SETTINGS["scenarios"]}}


def _moment(scenario: str) -> dict[str, Any]:
    """The last frame that the published method tracks before it is lost or wrong for the first time, and both models'
    lines there and half a second later."""
    pair = {PUBLISHED: FollowConfiguration.as_published(), OURS: FollowConfiguration()}
    for seed in SETTINGS["seeds"]:
        lines, fallen = [], None
        for _, truth, estimates in scenes.followed(_scene(scenario, seed), pair):
            verdict = scenes.Verdicts()
            verdict.add(estimates[PUBLISHED], truth, float(np.linalg.norm(truth.corners[1] - truth.corners[0])))
            lines.append({name: e.lines.tolist() for name, e in estimates.items()} | {"frame": truth.frame})
            lines[-1]["center"] = truth.center.tolist()
            if fallen is None and verdict.lost + verdict.wrong:
                fallen = truth.frame
            if fallen is not None and truth.frame >= fallen + 8:
                kept = [lines[max(0, fallen - 1)], lines[fallen + 4], lines[fallen + 8]]
                return {"seed": seed, "frames": kept}
    return {"seed": None, "frames": []}


def text(shown: Numbers) -> str:
    names = SETTINGS["scenarios"]
    columns = [f"{n}: {what}, %" for n in names for what in ("lost", "wrong")]
    lines = [head("configuration", *columns)]
    for name in shown[names[0]]:
        cells = [f"{shown[n][name][what]:.1f}" for n in names for what in ("lost", "wrong")]
        lines.append(row(name.replace("_", " "), *cells))
    count = ", ".join(f"{shown[f'{n}, frames']} frames of {n}" for n in names)
    words = (
        f"Shares of the frames that show the vehicle ({count}): *lost* are not tracked, *wrong* are tracked with the "
        "range more than 20 % or the centre more than a quarter of a width off."
    )
    return "\n\n".join([image("nist-failures.webp", "Where the published method fails"), words, "\n".join(lines)])


def draw(numbers: Numbers, folder: Path) -> None:
    sheet = []
    for scenario, moment in numbers["drawn"].items():
        wanted, views = {f["frame"]: f for f in moment["frames"]}, []
        if not wanted:
            continue
        for picture, truth, _ in scenes.followed(_scene(scenario, moment["seed"]), {}):
            if truth.frame not in wanted:
                continue
            one = wanted[truth.frame]
            ours = np.array(one[OURS])
            width = max(2.2 * float(np.ptp(ours.reshape(-1, 2)[:, 0])), 90.0)
            view, scale, shift = drawing.crop(picture, ours.reshape(-1, 2).mean(0), width, VIEW)
            for name, color in ((PUBLISHED, drawing.RED), (OURS, drawing.GREEN)):
                for a, b in scale_points(np.array(one[name]), scale) + shift:
                    draw_line(view, a, b, color, 2)
            views.append(drawing.captioned(view, f"{scenario}, frame {truth.frame}"))
        sheet.append(views)
    drawing.save(folder / "nist-failures.webp", drawing.montage(sheet))


REPRODUCTION = scenes.item(
    "failures", "section 4: shadows and parallel edges", SETTINGS, compute, text, draw, "nist-failures.webp"
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
