"""Plots of the published results: accuracy, intervals, following and time at a glance.

python benchmarks/plots.py -o plots

Everything that is drawn stands in results/*.json beside this file.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

RESULTS = Path(__file__).with_name("results")
Rows = list[dict[str, Any]]


def rows(benchmark: str, run: int | str = 0) -> Rows:
    """The rows of one run of a benchmark, by its place in the file or its name."""
    runs = json.loads((RESULTS / f"{benchmark}.json").read_text(encoding="utf-8"))["runs"]
    found: Rows = (runs[run] if isinstance(run, int) else next(r for r in runs if r.get("name") == run))["rows"]
    return found


def labelled(axes: Axes, labels: Sequence[str], title: str, unit: str) -> list[int]:
    """Places for one row per label, the first on top."""
    at = list(range(len(labels)))
    axes.set_yticks(at, labels)
    axes.set(title=title, xlabel=unit, ylim=(len(labels) - 0.5, -0.5))
    axes.grid(axis="x", alpha=0.3)
    return at


def bars(axes: Axes, labels: Sequence[str], title: str, unit: str, values: Sequence[float]) -> None:
    drawn = axes.barh(labelled(axes, labels, title, unit), values, height=0.6)
    axes.bar_label(drawn, fmt="%.2g", padding=3)
    axes.margins(x=0.15)


def dots(
    axes: Axes, labels: Sequence[str], title: str, unit: str, rms: Sequence[float], worst: Sequence[float]
) -> None:
    at = labelled(axes, labels, title, unit)
    axes.hlines(at, rms, worst, color="lightgrey")
    axes.plot(rms, at, "o", color="C0", label="RMS")
    axes.plot(worst, at, "|", color="C3", markersize=12, markeredgewidth=2, label="worst")
    axes.set_xscale("log")


def speed() -> Figure:
    """The mean speed of a clip, by method and by suite."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained", sharex=True)
    found = rows("baselines")
    dots(
        left,
        [r["method"] for r in found],
        "Methods on 24 plain clips",
        "error of the mean speed, mph",
        [r["rms_mph"] for r in found],
        [r["max_mph"] for r in found],
    )
    suites = [(name, rows("accuracy", name)[0]) for name in ("plain", "hard", "hard, other seeds", "crossing")]
    suites += [(f"rig off: {r['clips']}", r) for r in rows("accuracy", "rigs off by what they state")]
    dots(
        right,
        [f"{name} ({r['coverage_percent']} %)" for name, r in suites],
        "Drawn clips (intervals that hold)",
        "error of the mean speed, mph",
        [r["rms_mph"] for _, r in suites],
        [r["max_error_mph"] for _, r in suites],
    )
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


def intervals() -> Figure:
    """Errors beside the half-widths of their 95 % intervals; below the line the interval holds."""
    figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
    clips = rows("raytraced", "suite 1, clip by clip")
    kinds = [("calibrated", "C0"), ("rig not as stated", "C1")]
    for (name, colour), off in zip(kinds, (False, True), strict=True):
        for measured, face in ((True, colour), (False, "none")):
            chosen = [r for r in clips if ("miscalibrated" in r["scene"]) == off and r["measured"] == measured]
            axes.scatter(
                [r["half_width_kmh"] for r in chosen],
                [abs(r["error_kmh"]) for r in chosen],
                edgecolors=colour,
                facecolors=face,
                label=name if measured else f"{name}, rejected",
            )
    axes.axline((0.1, 0.1), (1, 1), color="grey", linewidth=1, label="error = half-width")
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="half-width of the 95 % interval, km/h",
        ylabel="error, km/h",
        title="60 ray-traced clips",
    )
    axes.legend()
    return figure


def following() -> Figure:
    """Frames lost and wrong by tracker, and what each remedy is worth."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4.5), layout="constrained")
    found = rows("follow", "trackers")
    bars(
        left,
        [r["tracker"] for r in found],
        "Ten clips of 300 frames",
        "frames lost or wrong, %",
        [100 * (r["lost"] + r["wrong"]) / r["frames"] for r in found],
    )
    by_name: dict[str, Rows] = {}
    for r in rows("follow_ablation", "scenarios"):
        by_name.setdefault(r["configuration"], []).append(r)
    del by_name["Paceline, as published"]  # far off the scale, and on the left
    bars(
        middle,
        list(by_name),
        "Remedies: mean over seven scenarios",
        "frames lost or wrong, %",
        [sum(r["lost_percent"] + r["wrong_percent"] for r in found) / len(found) for found in by_name.values()],
    )
    bars(
        right,
        list(by_name),
        "Remedies: mean over seven scenarios",
        "range error RMS of frames tracked, %",
        [sum(r["range_rms_percent"] for r in found) / len(found) for found in by_name.values()],
    )
    right.set_yticklabels([])
    return figure


def starts() -> Figure:
    """Frames on the right place, on a wrong one, and not tracked, for starts that are off."""
    figure, panels = plt.subplots(1, 3, figsize=(13, 5), layout="constrained", sharey=True)
    found = rows("follow_ablation", "starts")
    kinds = [("right", "C0"), ("not_tracking", "lightgrey"), ("wrong", "C3")]
    for axes, name in zip(panels, dict.fromkeys(r["configuration"] for r in found), strict=True):
        chosen = [r for r in found if r["configuration"] == name]
        left = [0.0] * len(chosen)
        for kind, colour in kinds:
            share = [r[f"{kind}_percent"] for r in chosen]
            axes.barh([r["start"] for r in chosen], share, left=left, color=colour, label=kind.replace("_", " "))
            left = [a + b for a, b in zip(left, share, strict=True)]
        axes.set(title=name, xlabel="frames, %")
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def duration() -> Figure:
    """Milliseconds of the likelihood and of a filter step, on one thread of a CPU and on a GPU."""
    figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
    found = [(r["work"], r["one_thread_ms"]) for r in rows("likelihood")]
    found += [
        (f"GPU, filter step: {r['vehicles']} × {r['particles_each']} particles", r["step_ms"]) for r in rows("gpu")
    ]
    bars(axes, [name for name, _ in found], "400 particles, both views, unless stated", "ms", [ms for _, ms in found])
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    folder: Path = parser.parse_args().output
    folder.mkdir(parents=True, exist_ok=True)
    for draw in (speed, intervals, following, starts, duration):
        figure = draw()
        figure.savefig(folder / f"{draw.__name__}.svg")
        plt.close(figure)


if __name__ == "__main__":
    main()
