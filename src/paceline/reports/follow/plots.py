"""Plots of a run over time: range, bearing, confidence, residual, processing time; and the target from above."""

from __future__ import annotations

from functools import partial
from itertools import groupby

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from paceline.arrays import Array
from paceline.follow.results import FollowResult
from paceline.progress import Progress, with_progress
from paceline.reports.common.plots import (
    FILTER_COLOR,
    INK_COLOR,
    INTERVAL_COLOR,
    MUTED_COLOR,
    REFINED_COLOR,
    Plot,
    make_plot,
)
from paceline.units import COVERAGE_95

WIDE_FIGURE_IN, HALF_FIGURE_IN = (9.4, 3.5), (4.6, 3.0)
STATUS_COLORS = {"coasting": INTERVAL_COLOR, "lost": MUTED_COLOR}


def follow_plots(result: FollowResult, progress: Progress | None = None) -> list[Plot]:
    """The plots of a run; frames in which the target was not tracked are left out and shaded. ``progress`` is called
    with the number of plots."""
    plots = (
        ("range", "Distance to the vehicle ahead over time", WIDE_FIGURE_IN, _draw_range),
        ("bearing", "Bearing and steering angle over time", HALF_FIGURE_IN, _draw_bearing),
        ("confidence", "Confidence of the fit over time", HALF_FIGURE_IN, _draw_confidence),
        ("residual", "Residual of the model's lines over time", HALF_FIGURE_IN, _draw_residual),
        ("latency", "Processing time of each frame", HALF_FIGURE_IN, _draw_latency),
    )
    return [
        make_plot(name, description, size, partial(draw, result=result))
        for name, description, size, draw in with_progress(plots, len(plots), progress)
    ]


def _draw_range(figure: Figure, result: FollowResult) -> None:
    axes = figure.subplots()
    distance = _tracked(result, result.position[:, 2])
    half = COVERAGE_95 * result.position_std[:, 2]
    time = _since_first(result)
    axes.fill_between(time, distance - half, distance + half, color=FILTER_COLOR, alpha=0.35, lw=0, label="95 %")
    axes.plot(time, distance, color=FILTER_COLOR, lw=1.4, label="distance ahead")
    known = distance[np.isfinite(distance)]
    if len(known):
        margin = max(0.08 * float(np.ptp(known)), 0.2)
        axes.set_ylim(max(0.0, float(known.min()) - margin), float(known.max()) + margin)
    _shade(axes, result)
    axes.set_ylabel("distance ahead, m")
    _label_time(axes, result)
    figure.legend(loc="outside upper left", ncols=4, handlelength=1.6, columnspacing=1.6)


def _draw_bearing(figure: Figure, result: FollowResult) -> None:
    axes = figure.subplots()
    axes.plot(
        _since_first(result), np.degrees(_tracked(result, result.bearing)), color=FILTER_COLOR, lw=1.2, label="bearing"
    )
    if np.isfinite(result.steering).any():
        axes.plot(_since_first(result), np.degrees(result.steering), color=REFINED_COLOR, lw=1.0, label="steering")
    _shade(axes, result, label=False)
    axes.set_ylabel("degrees, to the right")
    _label_time(axes, result)
    figure.legend(loc="outside upper left", ncols=4, handlelength=1.6, columnspacing=1.6)


def _draw_confidence(figure: Figure, result: FollowResult) -> None:
    axes = figure.subplots()
    names = "across (w_x)", "down (w_y)", "size (w_scale)"
    for values, color, name in zip(result.weights.T, (FILTER_COLOR, REFINED_COLOR, INK_COLOR), names, strict=True):
        shown = np.where(values > 0, values, np.nan)
        axes.plot(_since_first(result), shown, color=color, lw=1.1, label=name)
    if (result.weights > 0).any():
        _make_logarithmic(axes)
    _shade(axes, result, label=False)
    axes.set_ylabel("confidence")
    _label_time(axes, result)
    figure.legend(loc="outside upper left", ncols=4, handlelength=1.6, columnspacing=1.6)


def _draw_residual(figure: Figure, result: FollowResult) -> None:
    axes = figure.subplots()
    axes.plot(_since_first(result), result.residual, color=FILTER_COLOR, lw=1.1)
    axes.set_ylim(bottom=0)
    _shade(axes, result, label=False)
    axes.set_ylabel("residual (RMS), pixels")
    _label_time(axes, result)


def _draw_latency(figure: Figure, result: FollowResult) -> None:
    axes = figure.subplots()
    axes.plot(_since_first(result), 1e3 * result.latency, color=FILTER_COLOR, lw=0, marker=".", ms=3)
    if (result.latency > 0).any():
        _make_logarithmic(axes)
    axes.set_ylabel("processing time, ms")
    _label_time(axes, result)


def _make_logarithmic(axes: Axes) -> None:
    """A logarithmic scale with plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _tracked(result: FollowResult, values: Array) -> Array:
    """``values`` (F,) with NaN where the target was not tracked, so that the line is interrupted."""
    return np.where([status == "tracking" for status in result.status], values, np.nan)


def _since_first(result: FollowResult) -> Array:
    """Seconds (F,) since the first frame: a camera's own clock may count from when the computer was switched on."""
    return result.time - result.time[:1]


def _shade(axes: Axes, result: FollowResult, label: bool = True) -> None:
    """A coloured background where the target was not tracked."""
    named: set[str] = set()
    time = _since_first(result)
    for status, rows in groupby(range(len(result.status)), key=lambda row: result.status[row]):
        if status in STATUS_COLORS:
            inside = list(rows)
            stop = time[min(inside[-1] + 1, len(time) - 1)]
            name = status if label and status not in named else None
            named.add(status)
            axes.axvspan(time[inside[0]], stop, color=STATUS_COLORS[status], alpha=0.25, lw=0, label=name)


def _label_time(axes: Axes, result: FollowResult) -> None:
    axes.set_xlabel("time since the first frame, s")
    if len(result.time) > 1:
        axes.set_xlim(0.0, _since_first(result)[-1])
