"""[NIST] figures 2 and 3: the back of the lead vehicle, and the line segments that model it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from common import head, row
from follow import operators_start
from zhu2012 import drawing
from zhu2012.reproductions import Numbers, image, run_alone

from nist1993 import scenes
from paceline.reports.common.drawing import DARK_BGR, draw_line, draw_text, scale_points
from paceline.simulation.chase.clip import render_frames
from paceline.simulation.random_scenes.drawn import random_chase

SETTINGS: Numbers = {"seed": 907, "kind": "van", "gap": [7.0, 9.0], "shadows": 0.4, "paint": 150.0}
VIEW = (480, 454)
TEN = 10  # segments, as [NIST] has; the last of the file, the body's lower edge, comes and goes with the shadow there


def _first() -> tuple[np.ndarray, list, np.ndarray, list]:
    s = SETTINGS
    scene = random_chase(
        s["seed"], frames=1, kind=s["kind"], gap=tuple(s["gap"]), shadows=s["shadows"], paint=s["paint"], shake_px=0.0
    )
    picture, truth = next(iter(render_frames(scene)))
    whole, _ = operators_start(scene, truth)
    target = replace(whole, segments=whole.segments[:TEN])
    scale = target.nominal_range / truth.position[2]
    lines = target.lines(truth.center, scale, target.magnification(scene.camera))
    return picture, lines.tolist(), target.corners[target.segments], target.vertical.tolist()


def compute() -> Numbers:
    _, lines, ends, vertical = _first()
    segments = [
        {"number": i, "upright": v, "length": float(np.abs(e[1] - e[0]).max()), "ends": np.round(e, 3).tolist()}
        for i, (e, v) in enumerate(zip(ends, vertical, strict=True), 1)
    ]
    return {"shown": {"segments": segments}, "drawn": {"lines": lines}}


def text(shown: Numbers) -> str:
    lines = [head("segment", "direction", "from x, y, m", "to x, y, m", "length, m")]
    for s in shown["segments"]:
        ends = [", ".join(f"{v:.2f}" for v in end) for end in s["ends"]]
        lines.append(row(s["number"], "vertical" if s["upright"] else "horizontal", *ends, f"{s['length']:.2f}"))
    picture = image("nist-target.webp", "The back of a van, and the line segments that model it")
    words = (
        f"The back of a rendered van and {len(shown['segments'])} segments that model it, as many as in [NIST], "
        "numbered as in the table; x to the right and y down from the middle of the rear plane. Its `target.yaml` "
        "holds one more, the lower edge of the body, which comes and goes with the shadow under it."
    )
    return "\n\n".join([picture, words, "\n".join(lines)])


def draw(numbers: Numbers, folder: Path) -> None:
    picture, _, _, _ = _first()
    lines = np.array(numbers["drawn"]["lines"])
    middle, width = lines.reshape(-1, 2).mean(0), 1.5 * float(np.ptp(lines.reshape(-1, 2)[:, 0]))
    views = [drawing.crop(picture, middle, width, VIEW) for _ in range(2)]
    view, scale, shift = views[1]
    view[:] = cv2.addWeighted(view, 0.45, np.full_like(view, 255), 0.55, 0)
    for i, line in enumerate(lines, 1):
        a, b = scale_points(line, scale) + shift
        draw_line(view, a, b, (40, 40, 200), 2)
        x, y = (a + b) / 2
        draw_text(view, str(i), (int(x) + 4, int(y) - 4), 17, DARK_BGR, 600)
    drawing.save(folder / "nist-target.webp", drawing.montage([[v[0] for v in views]]))


REPRODUCTION = scenes.item(
    "target",
    "figures 2 and 3: the target and its segments",
    SETTINGS,
    compute,
    text,
    draw,
    "nist-target.webp",
    rooms=(),
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
