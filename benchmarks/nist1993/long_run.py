"""[NIST] section 4: 17 minutes behind a lead vehicle, here with the loop closed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from common import head, row
from matplotlib.figure import Figure
from zhu2012 import drawing
from zhu2012.reproductions import Numbers, Reproduction, image, run_alone

from paceline.simulation.closed_loop.drive_yaml import resolve_drive
from paceline.simulation.closed_loop.loop import ClosedLoop
from paceline.simulation.closed_loop.requirements import DriveStatistics, check_requirements

SETTINGS: Numbers = {"scene": "long", "seed": 100}
EVERY = 15  # frames of the plots: one a second


def compute() -> Numbers:
    loop, figures = ClosedLoop(resolve_drive(SETTINGS["scene"], SETTINGS["seed"]), SETTINGS["seed"]), DriveStatistics()
    milliseconds, trace = [], []
    for step in loop.steps():
        figures.add(step, loop.scene.world.body.width)
        milliseconds.append(1e3 * step.estimate.latency)
        if step.frame % EVERY == 0:
            e = step.estimate
            error = 100 * (e.position[2] - step.truth.position[2]) / step.truth.position[2]
            seen = e.status == "tracking"
            trace.append([round(step.time, 1), *(round(float(v), 3) for v in (step.gap, step.chase.speed))])
            trace[-1] += [round(float(error), 3) if seen else None, round(float(step.path_error), 4)]
    requirements = check_requirements(loop.model, figures)
    shown: dict[str, Any] = {
        "kind": loop.scene.chase_scene.kind,
        "frames": figures.frames,
        "minutes": figures.frames / loop.scene.chase_scene.rate / 60,
        "way": figures.distance,
        "showing": figures.visible_frames,
        "tracked": figures.tracked_frames,
        "losses": figures.losses,
        "wrong": figures.wrong_frames,
        "path_rms": figures.path_rms,
        "path_max": figures.path_max,
        "range_rms": 100 * figures.range_rms,
        "gap_min": figures.gap_min,
        "gap_max": figures.gap_max,
        "clearance": figures.clearance,
        "median_ms": float(np.median(milliseconds)),
        "p99_ms": float(np.percentile(milliseconds, 99)),
        "max_ms": float(np.max(milliseconds)),
        "failed": [r.what for r in requirements if not r.holds],
        "required": len(requirements),
    }
    return {"shown": shown, "drawn": {"trace": trace}}


def text(shown: Numbers) -> str:
    s = shown
    rows = [
        ("way", f"{s['way'] / 1000:.2f} km in {s['minutes']:.1f} minutes, {s['frames']} frames, behind a {s['kind']}"),
        ("frames tracked, of those that show it", f"{s['tracked']} of {s['showing']}"),
        ("times lost", f"{s['losses']}"),
        ("frames in which something else was followed", f"{s['wrong']}"),
        ("range error, RMS", f"{s['range_rms']:.2f} %"),
        ("path error, RMS and greatest", f"{s['path_rms']:.3f} m, {s['path_max']:.2f} m"),
        ("gap", f"{s['gap_min']:.1f} to {s['gap_max']:.1f} m"),
        ("least distance to another vehicle", f"{s['clearance']:.2f} m"),
        ("what must hold", f"{s['required'] - len(s['failed'])} of {s['required']}"),
    ]
    parts = [
        image("nist-long.svg", "Gap, speed and range error over 17 minutes"),
        "\n".join([head("17 minutes", "found"), *(row(*r) for r in rows)]),
    ]
    if s["failed"]:
        parts.append("What did not hold: " + "; ".join(s["failed"]) + ".")
    return "\n\n".join(parts)


def draw(numbers: Numbers, folder: Path) -> None:
    trace = np.array(numbers["drawn"]["trace"], float)
    minutes = trace[:, 0] / 60

    def lines(figure: Figure) -> None:
        axes = figure.subplots(3, sharex=True)
        for ax, column, label in zip(axes, (1, 2, 3), ("gap, m", "speed, m/s", "range error, %"), strict=True):
            ax.plot(minutes, trace[:, column], color=drawing.OURS, lw=0.9)
            ax.set_ylabel(label)
            ax.margins(x=0.01)
        axes[-1].set_xlabel("time, minutes")

    drawing.plot(folder / "nist-long.svg", (8.0, 5.0), lines)


REPRODUCTION = Reproduction(
    name="nist-long",
    script="nist1993.long_run",
    title="[NIST] section 4: 17 minutes",
    compute=compute,
    text=text,
    draw=draw,
    pictures=("nist-long.svg",),
    settings=SETTINGS,
    rooms=("follow", "simulation/driving"),
)

if __name__ == "__main__":
    run_alone(REPRODUCTION)
