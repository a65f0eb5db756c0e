"""Plots of a drive: both paths from above, and over time the gap, the path error, steering, speeds, processing."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paceline.arrays import Array
from paceline.reports.common.plots import (
    FILTER_COLOR,
    INK_COLOR,
    INTERVAL_COLOR,
    MUTED_COLOR,
    REFINED_COLOR,
    Plot,
    make_plot,
)
from paceline.simulation.closed_loop.results import DriveLog

WIDE_FIGURE_IN, HALF_FIGURE_IN = (9.4, 3.3), (4.6, 3.0)
STATUS_COLORS = {1.0: INTERVAL_COLOR, 2.0: MUTED_COLOR}


def drive_plots(log: DriveLog) -> list[Plot]:
    """The plots of a drive, with intervals shaded in which the lead was not tracked."""
    return [
        make_plot("plan", "Both paths from above", _plan_size(log), lambda f: _draw_plan(f, log)),
        make_plot("gap", "Gap to the lead over time", WIDE_FIGURE_IN, lambda f: _draw_gap(f, log)),
        make_plot(
            "path_error", "Distance from the lead's path over time", HALF_FIGURE_IN, lambda f: _draw_error(f, log)
        ),
        make_plot("steering", "Steering angle over time", HALF_FIGURE_IN, lambda f: _draw_steering(f, log)),
        make_plot("speed", "Speeds over time", HALF_FIGURE_IN, lambda f: _draw_speed(f, log)),
        make_plot(
            "processing", "Computing time of the tracker per frame", HALF_FIGURE_IN, lambda f: _draw_processing(f, log)
        ),
    ]


def _rotated_to_horizontal(log: DriveLog) -> tuple[Array, Array]:
    """Both paths (N, 2), rotated so that their principal axis is horizontal."""
    both = np.column_stack([log.chase_x, log.chase_y]), np.column_stack([log.lead_x, log.lead_y])
    centre = both[0].mean(0)
    _, _, axes = np.linalg.svd(np.vstack(both) - centre, full_matrices=False)
    axes[0] *= 1.0 if axes[0] @ (both[0][-1] - both[0][0]) >= 0 else -1.0
    across = np.array([-axes[0, 1], axes[0, 0]])  # to the left: no mirroring
    turned = np.column_stack([axes[0], across])
    return (both[0] - centre) @ turned, (both[1] - centre) @ turned


def _plan_size(log: DriveLog) -> tuple[float, float]:
    extent = np.ptp(np.vstack(_rotated_to_horizontal(log)), axis=0)
    return WIDE_FIGURE_IN[0], float(np.clip(WIDE_FIGURE_IN[0] * extent[1] / max(extent[0], 1.0) + 0.9, 2.2, 8.0))


def _draw_plan(figure: Figure, log: DriveLog) -> None:
    axes = figure.subplots()
    chase, lead = _rotated_to_horizontal(log)
    lead_present = log.lead_present > 0
    axes.plot(*lead[lead_present].T, color=INTERVAL_COLOR, lw=3.2, alpha=0.8, label="lead")
    axes.plot(*chase.T, color=FILTER_COLOR, lw=1.2, label="chase vehicle")
    axes.plot(*chase[0], marker="o", color=INK_COLOR, ms=5, ls="", label="start")
    is_lost = log.status == 2
    if is_lost.any():
        axes.plot(*chase[is_lost].T, color=REFINED_COLOR, lw=0, marker=".", ms=3, label="lost")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("m")
    axes.set_ylabel("m")
    _legend(figure)


def _draw_gap(figure: Figure, log: DriveLog) -> None:
    axes = figure.subplots()
    axes.plot(log.time, log.desired_gap, color=MUTED_COLOR, lw=1.0, ls=(0, (4, 2)), label="wanted")
    axes.plot(log.time, log.gap, color=INK_COLOR, lw=1.4, label="true")
    axes.plot(log.time, log.range, color=FILTER_COLOR, lw=1.0, label="estimated")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("camera to the lead's rear, m")
    _finish_axes(figure, axes, log)


def _draw_error(figure: Figure, log: DriveLog) -> None:
    axes = figure.subplots()
    axes.axhline(0.0, color=MUTED_COLOR, lw=0.8)
    axes.plot(log.time, log.path_error, color=FILTER_COLOR, lw=1.1)
    half = max(0.2, 1.1 * float(np.abs(log.path_error).max()))
    axes.set_ylim(-half, half)
    axes.set_ylabel("path error, m, to the right")
    _finish_axes(figure, axes, log, legend=False)


def _draw_steering(figure: Figure, log: DriveLog) -> None:
    axes = figure.subplots()
    axes.plot(log.time, np.degrees(log.steering_command), color=INTERVAL_COLOR, lw=0.9, label="command")
    axes.plot(log.time, np.degrees(log.steering), color=FILTER_COLOR, lw=1.2, label="wheels")
    axes.set_ylabel("degrees, to the right")
    _finish_axes(figure, axes, log)


def _draw_speed(figure: Figure, log: DriveLog) -> None:
    axes = figure.subplots()
    axes.plot(log.time, log.lead_speed * 3.6, color=INTERVAL_COLOR, lw=2.4, alpha=0.8, label="lead")
    axes.plot(log.time, log.speed * 3.6, color=FILTER_COLOR, lw=1.2, label="chase vehicle")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("speed, km/h")
    _finish_axes(figure, axes, log)


def _draw_processing(figure: Figure, log: DriveLog) -> None:
    axes = figure.subplots()
    axes.plot(log.time, 1e3 * log.processing, color=FILTER_COLOR, lw=0, marker=".", ms=2)
    axes.set_yscale("log")
    axes.set_ylabel("processing time, ms")
    _finish_axes(figure, axes, log, legend=False)


def _finish_axes(figure: Figure, axes: Axes, log: DriveLog, legend: bool = True) -> None:
    """Shades, the time's label and the legend."""
    for status, color in STATUS_COLORS.items():
        edges = np.flatnonzero(np.diff(np.concatenate([[0], log.status == status, [0]]).astype(int)))
        for first, stop in edges.reshape(-1, 2):
            axes.axvspan(log.time[first], log.time[min(stop, len(log.time) - 1)], color=color, alpha=0.25, lw=0)
    axes.set_xlabel("time, s")
    if len(log.time) > 1:
        axes.set_xlim(log.time[0], log.time[-1])
    if legend:
        _legend(figure)


def _legend(figure: Figure) -> None:
    figure.legend(loc="outside upper left", ncols=4, handlelength=1.6, columnspacing=1.6)
