"""The plot of a live survey: every vehicle's speed, by the time at which it was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paceline.arrays import Array
from paceline.reports.common.plots import MUTED_COLOR, VEHICLE_COLORS, Plot, make_plot
from paceline.reports.speed.tables import summary_column
from paceline.units import convert

Vehicles = Sequence[dict[str, object]]  # as summary.json has them
MINUTES_AXIS_FROM_S = 600.0  # longer time axes are in minutes
MAX_DRAWN_INTERVALS = 400  # more intervals would blacken the plot


def speeds_plot(vehicles: Vehicles, unit: str) -> Plot:
    """Measured speeds with their 95 % intervals, a colour for each path; rejected ones are left out."""
    return make_plot("speeds", "Speed of every vehicle by time", (9.4, 3.5), lambda f: _draw(f, vehicles, unit))


def _draw(figure: Figure, vehicles: Vehicles, unit: str) -> None:
    axes = figure.subplots()
    measured = [v for v in vehicles if v["verdict"] == "measured"]
    time = summary_column(measured, "seen_from_s")
    time = time - (time.min() if len(time) else 0.0)
    minutes = bool(len(time)) and time.max() > MINUTES_AXIS_FROM_S
    time = time / 60 if minutes else time
    mean, lo, hi = (convert(summary_column(measured, k), unit) for k in ("speed_mps", "speed_lo_mps", "speed_hi_mps"))
    paths = [str(v["path"]) for v in measured]
    for i, path in enumerate(sorted(set(paths))):
        on_path = np.array([p == path for p in paths])
        _draw_path(
            axes,
            time[on_path],
            mean[on_path],
            np.stack([lo[on_path], hi[on_path]]),
            VEHICLE_COLORS[i % len(VEHICLE_COLORS)],
            path,
        )
    if not measured:
        axes.text(0.5, 0.5, "no vehicle was measured", transform=axes.transAxes, ha="center", color=MUTED_COLOR)
    axes.set_xlabel(f"seen first, {'minutes' if minutes else 's'} since the first vehicle")
    axes.set_ylabel(f"speed, {unit}")
    if measured:
        figure.legend(loc="outside upper left", ncols=6, handlelength=1.6, columnspacing=1.6)


def _draw_path(axes: Axes, time: Array, mean: Array, interval: Array, color: str, path: str) -> None:
    half = np.nan_to_num(np.abs(interval - mean)) if len(time) <= MAX_DRAWN_INTERVALS else None
    axes.errorbar(time, mean, yerr=half, fmt="o", ms=4, lw=1.2, color=color, label=path)
