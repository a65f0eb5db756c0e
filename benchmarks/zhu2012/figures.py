"""How the figures of [Zhu] are shown: a table of the methods, pictures of tracks and particles, plots over time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import Array, head, row
from matplotlib.figure import Figure

from paceline.baselines.disparity import Rectification
from paceline.recordings.stereo import StereoFrame
from zhu2012 import drawing
from zhu2012.clips import loaded
from zhu2012.methods import Run

SHOWN_FRAMES = (1, 3, 5, 7, 9)
VIEW = (310, 200)  # pixels of one picture of a montage
NEAREST = (0.85, 1.15)  # disparities drawn black and white, as shares of the tracked vehicle's
NO_MATCH = (120, 60, 30)  # BGR
BRIGHTER = 0.7  # exponent: the recordings leave room for glare
LEGEND = {
    "as printed": "[Zhu]'s filter",
    "unconstrained": "without a path",
    "drifting": "[Zhu]'s, drifting",
    "multimodal": "multimodal particles",
}


def _number(value: float | None, form: str) -> str:
    return "–" if value is None or not np.isfinite(value) else format(value, form)


def markdown(shown: dict[str, Any]) -> str:
    """A table of all methods on one vehicle."""
    columns = ("method", "mean speed: error", "stated ±", "frame by frame: RMS", "largest", "depth: RMS, %", "verdict")
    lines = [head(*columns)]
    for name, s in shown.items():
        cells = [_number(s.get("error"), "+.2f"), _number(s.get("half"), ".2f")]
        cells += [_number(s["rms"], ".2f"), _number(s["max"], ".2f"), _number(s["depth"], ".2f")]
        verdict = "" if "reason" not in s else s["reason"].partition(":")[0] or "measured"
        lines.append(row(LEGEND.get(name, name), *cells, verdict))
    return "\n".join(lines)


# --- pictures -----------------------------------------------------------------------------------------------------


def strip(
    scene: str,
    run: Run,
    truth: Run,
    frames: Sequence[int],
    name: str,
    particles: bool,
    grid: tuple[int, int] | None = None,
) -> list[drawing.Picture]:
    """The track in some frames of the left view, one picture each: the particles, or the outline in green over the
    true one in red, with the parts of a ``grid`` (across, down)."""
    views = []
    for k, frame, true in _shown(scene, truth, frames):
        grey = (255 * (np.clip(frame.left, 0, 255) / 255) ** BRIGHTER).astype(np.uint8)
        view, scale, shift = drawing.crop(grey, true.mean(0), _width(true), VIEW)
        if k not in run["frame"]:
            views.append(drawing.captioned(view, f"{name}, frame {k}: lost"))
            continue
        at = run["frame"].index(k)
        if particles:
            drawing.dotted(view, scale, shift, run["dots"][at])
        else:
            drawing.outlined(view, scale, shift, true, drawing.RED, 1)
            drawing.outlined(view, scale, shift, run["left"][at], drawing.GREEN, 1 if grid else 2)
            if grid is not None:
                drawing.divided(view, scale, shift, run["left"][at], grid)
        views.append(drawing.captioned(view, f"{name}, frame {k}"))
    return views


def _shown(scene: str, truth: Run, frames: Sequence[int]) -> Iterator[tuple[int, StereoFrame, Array]]:
    """Those of the ``frames`` in which the vehicle is, with its true outline (4, 2)."""
    frame_by_index = {f.index: f for f in loaded(scene).frames}
    for k in frames:
        if k in frame_by_index and k in truth["frame"]:
            yield k, frame_by_index[k], np.array(truth["left"][truth["frame"].index(k)])


def _width(true: Array) -> float:
    """Pixels of the recording across a picture of a vehicle with the outline ``true`` (4, 2)."""
    return max(2.6 * float(np.ptp(true[:, 0])), 110.0)


def disparities(scene: str, run: Run, truth: Run, frames: Sequence[int], name: str) -> list[drawing.Picture]:
    """The disparities that the multimodal tracker weighs its particles by, turned back into the left view: the lighter
    the nearer, blue where the views do not match; with its outline in green over the true one in red."""
    rig, views = loaded(scene).clip.rig, []
    rectified = Rectification(rig)
    for k, frame, true in _shown(scene, truth, frames):
        blank, scale, shift = drawing.crop(np.zeros_like(frame.left, np.uint8), true.mean(0), _width(true), VIEW)
        if k not in run["frame"]:
            views.append(drawing.captioned(blank, f"{name}, frame {k}: lost"))
            continue
        at = run["frame"].index(k)
        outline = np.array(run["left"][at])
        corners = (np.array([[0, 0], [VIEW[0], 0], VIEW, [0, VIEW[1]]]) - shift) / scale
        place = run["depth"][at] * rig.left.rays(outline.mean(0))
        depth = float(rectified.rotation[2] @ place)
        found = rectified.depths((frame.left, frame.right), rectified.project(rig.left.rays(corners)), depth)
        tint = np.clip((depth / found.Z - NEAREST[0]) / (NEAREST[1] - NEAREST[0]), 0, 1)
        colors = np.where(np.isnan(tint)[..., None], NO_MATCH, 255 * np.nan_to_num(tint)[..., None]).astype(np.uint8)
        # from the rectified crop to the left view, and from there to the picture
        of_crop = np.array([[1, 0, found.low[0]], [0, 1, found.low[1]], [0, 0, rectified.f]])
        to_left = rig.left.K @ rectified.rotation.T @ of_crop
        to_view = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])
        view = cv2.warpPerspective(colors, to_view @ to_left, VIEW, flags=cv2.INTER_NEAREST, borderValue=NO_MATCH)
        drawing.outlined(view, scale, shift, true, drawing.RED, 1)
        drawing.outlined(view, scale, shift, outline, drawing.GREEN)
        views.append(drawing.captioned(view, f"disparity, frame {k}"))
    return views


def tracks(path: Path, scene: str, drawn: Any, names: Sequence[str], frames: Sequence[int] = SHOWN_FRAMES) -> None:
    """Outlines and particles of some methods, and the disparities of the multimodal tracker."""
    rows = []
    for name in names:
        for particles in (False, True):
            rows.append(strip(scene, drawn["runs"][name], drawn["truth"], frames, LEGEND.get(name, name), particles))
    if "multimodal" in names:
        rows.append(disparities(scene, drawn["runs"]["multimodal"], drawn["truth"], frames, LEGEND["multimodal"]))
    drawing.save(path, drawing.montage(rows))


PANELS = {"speed": ("speed, mph", 12.0), "depth": ("depth error, m", 6.0), "turn": ("angular velocity, °/s", 25.0)}


def over_time(path: Path, drawn: Any, names: Sequence[str], panels: Sequence[str]) -> None:
    """Speeds, errors of the depth and angular velocities of some methods over time."""

    def draw(figure: Figure) -> None:
        truth = drawn["truth"]
        at = dict(zip(truth["frame"], truth["time"], strict=True))
        axes = np.atleast_1d(figure.subplots(1, len(panels)))
        for ax, panel in zip(axes, panels, strict=True):
            label, reach = PANELS[panel]
            true = np.array(truth[panel], float)
            values = []
            for name in names:
                run = drawn["runs"][name]
                follows = np.isfinite(np.array(run["speed"][1:], float)).any()  # beyond the first guess
                if panel not in run or not follows or (panel == "depth" and name == "refined"):
                    continue
                frames = [k for k in run["frame"] if k in at]
                y = np.array(run[panel], float)[[k in at for k in run["frame"]]]
                if panel == "depth":
                    y = y - true[[truth["frame"].index(k) for k in frames]]
                strong = name in ("as printed", "refined")
                style: dict[str, Any] = {"lw": 1.8 if strong else 1.2, "marker": "o", "ms": 3.5 if strong else 2.5}
                ax.plot([at[k] for k in frames], y, color=drawing.COLORS[name], label=LEGEND.get(name, name), **style)
                values.append(y)
            true = np.zeros_like(true) if panel == "depth" else true
            ax.plot(truth["time"], true, color=drawing.TRUTH, lw=1.2, ls=(0, (5, 3)), label="truth")
            ax.set_ylim(*drawing.limits([*values, true], float(np.nanmean(true)), reach))
            ax.set_xlabel("time, s")
            ax.set_ylabel(label)
        lines, labels = axes[0].get_legend_handles_labels()
        figure.legend(lines, labels, loc="outside upper left", ncols=4, handlelength=1.6, columnspacing=1.4)

    drawing.plot(path, (8.0, 3.6), draw)
