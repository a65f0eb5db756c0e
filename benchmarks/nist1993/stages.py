"""[NIST] section 2 and figure 1: the stages of processing on one frame, as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from common import head, row
from zhu2012 import drawing
from zhu2012.reproductions import Numbers, image, run_alone

from nist1993 import scenes
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.edges import EdgeExtractor
from paceline.reports.common.drawing import draw_line, scale_points
from paceline.reports.common.plots import VEHICLE_COLORS
from paceline.simulation.random_scenes.drawn import random_chase

SETTINGS: Numbers = {"seed": 907, "kind": "van", "gap": [6.0, 10.0], "shake_px": 2.0, "shadows": 0.4, "frame": 40}
VIEW = (384, 363)


def _frames() -> tuple[Any, Any, Any, Any]:
    """The picture of the frame, the estimates before it and at it, and its truth."""
    s = SETTINGS
    scene = random_chase(
        s["seed"],
        frames=s["frame"] + 1,
        kind=s["kind"],
        gap=tuple(s["gap"]),
        shake_px=s["shake_px"],
        shadows=s["shadows"],
        paint=150.0,
    )
    before = None
    for picture, truth, estimates in scenes.followed(scene, {"ours": FollowConfiguration()}):
        if truth.frame == s["frame"]:
            return picture, before, estimates["ours"], truth
        before = estimates["ours"]
    raise AssertionError("the scene ended early")


def compute() -> Numbers:
    picture, before, e, truth = _frames()
    c = FollowConfiguration()
    edges = EdgeExtractor(picture.shape[::-1], c).extract(picture, e.window)
    lists = [[[round(float(v), 2) for v in p[:2]] for p in found] for found in edges]
    used = np.bincount(e.owners, minlength=len(e.lines))
    off = e.position - truth.position
    shown = {
        "window": list(e.window),
        "window_share": (e.window[2] - e.window[0]) * (e.window[3] - e.window[1]) / picture.size,
        "vertical": len(lists[0]),
        "horizontal": len(lists[1]),
        "believed": int(len(e.points)),
        "features": int((used > 0).sum()),
        "segments": len(e.lines),
        "residual": e.residual,
        "range": float(truth.position[2]),
        "range_error": float(off[2]),
        "lateral_error": float(off[0]),
        "range_std": float(e.position_std[2]),
    }
    drawn = {
        "edges": lists,
        "before": before.lines.tolist(),
        "lines": e.lines.tolist(),
        "points": np.round(e.points, 2).tolist(),
        "owners": e.owners.tolist(),
    }
    return {"shown": shown, "drawn": drawn}


def text(shown: Numbers) -> str:
    x0, y0, x1, y1 = shown["window"]
    rows = [
        ("window of interest", f"{x1 - x0} × {y1 - y0} px, {100 * shown['window_share']:.0f} % of the picture"),
        ("1 edge points", f"{shown['vertical']} near-vertical, {shown['horizontal']} near-horizontal"),
        ("2 association", f"{shown['believed']} points belong to {shown['features']} of {shown['segments']} features"),
        ("3 and 4 fit", f"features {shown['residual']:.2f} px off the fitted model, RMS"),
        (
            "8 place",
            f"{shown['range']:.2f} m ahead; off by {shown['range_error']:+.3f} m along the axis (stated standard "
            f"deviation {shown['range_std']:.3f} m) and {shown['lateral_error']:+.3f} m across",
        ),
    ]
    picture = image("nist-stages.webp", "Picture, window, edge points, association and fit of one frame")
    return "\n\n".join([picture, "\n".join([head("stage", "in this frame"), *(row(*r) for r in rows)])])


def _bgr(color: str) -> tuple[int, int, int]:
    return int(color[5:7], 16), int(color[3:5], 16), int(color[1:3], 16)


def draw(numbers: Numbers, folder: Path) -> None:
    picture, drawn = _frames()[0], numbers["drawn"]
    x0, y0, x1, y1 = numbers["shown"]["window"]
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    colors = [_bgr(c) for c in VEHICLE_COLORS]

    def view() -> tuple[drawing.Picture, float, Any]:
        return drawing.crop(picture, middle, 1.12 * max(x1 - x0, (y1 - y0) * VIEW[0] / VIEW[1]), VIEW)

    def lines(canvas: drawing.Picture, scale: float, shift: Any, which: str, color: Any) -> None:
        for a, b in scale_points(np.array(drawn[which]), scale) + shift:
            draw_line(canvas, a, b, color, 2)

    first, scale, shift = view()
    drawing.outlined(first, scale, shift, [[x0, y0], [x1, y0], [x1, y1], [x0, y1]], drawing.GREEN, 1)
    lines(first, scale, shift, "before", (190, 190, 190))
    second, *_ = view()
    for points, color in zip(drawn["edges"], (drawing.BLUE, (80, 160, 255)), strict=True):
        drawing.dotted(second, scale, shift, points, color, 1.6)
    third, *_ = view()
    for owner in sorted(set(drawn["owners"])):
        mine = [p for p, o in zip(drawn["points"], drawn["owners"], strict=True) if o == owner]
        drawing.dotted(third, scale, shift, mine, colors[owner % len(colors)], 2.2)
    fourth, *_ = view()
    lines(fourth, scale, shift, "lines", drawing.GREEN)
    names = ("window, last model", "edge points", "association", "fitted model")
    sheet = [drawing.captioned(v, n) for v, n in zip((first, second, third, fourth), names, strict=True)]
    drawing.save(folder / "nist-stages.webp", drawing.montage([sheet[:2], sheet[2:]]))


REPRODUCTION = scenes.item(
    "stages", "figure 1: the stages on one frame", SETTINGS, compute, text, draw, "nist-stages.webp"
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
