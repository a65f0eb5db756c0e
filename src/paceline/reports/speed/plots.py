"""Plots of a track over time, and of all tracks from above."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paceline.arrays import Array, Mask
from paceline.reports.common.formatting import coverage_factor, interval_title
from paceline.reports.common.plots import (
    FILTER_COLOR,
    INK_COLOR,
    INTERVAL_COLOR,
    MUTED_COLOR,
    REFINED_COLOR,
    Plot,
    lane_color,
    make_plot,
)
from paceline.speed.results import ClipResult, Measurement, Track
from paceline.units import COVERAGE_95, convert

MAX_DOTTED_FRAMES = 80


def vehicle_plots(measurement: Measurement, unit: str, color: str) -> list[Plot]:
    """Speed, depth, particle spread and effective sample size over time; speeds in ``unit``."""
    name, track = measurement.vehicle, measurement.track
    wide, half = (9.4, 3.5), (4.6, 3.0)
    return [
        make_plot("speed", f"Speed of {name} over time", wide, lambda figure: _draw_speed(figure, measurement, unit)),
        make_plot("depth", f"Distance of {name} over time", half, lambda figure: _draw_depth(figure, track, color)),
        make_plot(
            "particles",
            f"Spread of the particles and effective sample size of {name} over time",
            half,
            lambda figure: _draw_particles(figure, track),
        ),
    ]


def plan_plot(result: ClipResult, colors: dict[str, str]) -> Plot:
    """All vehicles and paths from above, the left camera at the origin."""
    return make_plot(
        "plan", "Vehicles and paths seen from above", (9.4, 3.8), lambda figure: _draw_plan(figure, result, colors)
    )


def _draw_speed(figure: Figure, measurement: Measurement, unit: str) -> None:
    track = measurement.track
    axes = figure.subplots()
    time = track.time
    mean, half_width = convert(track.speed, unit), convert(COVERAGE_95 * track.speed_std, unit)
    axes.fill_between(time, mean - half_width, mean + half_width, color=FILTER_COLOR, alpha=0.22, lw=0)
    _draw_frames(axes, time, mean, FILTER_COLOR, track.hidden, label="filter, frame by frame (95 %, its spread alone)")
    refined = np.isfinite(track.refined_speed)
    visible = [mean]
    if refined.any():
        line = convert(track.refined_speed[refined], unit)
        half = convert(coverage_factor(measurement) * track.refined_std[refined], unit)
        axes.fill_between(time[refined], line - half, line + half, color=REFINED_COLOR, alpha=0.25, lw=0)
        axes.plot(time[refined], line, color=REFINED_COLOR, lw=2, label="refined track (95 %)")
        visible += [line - half, line + half]
    if np.isfinite([measurement.speed_lo, measurement.speed_hi]).all():
        lo, hi = convert(measurement.speed_lo, unit), convert(measurement.speed_hi, unit)
        for value in (lo, hi):
            axes.axhline(value, color=INTERVAL_COLOR, lw=1.1, ls=(0, (4, 2)))
        axes.lines[-1].set_label(f"mean speed, {interval_title([measurement.interval_from])}")
        visible.append(np.array([lo, hi]))
    _limit_y(axes, np.concatenate(visible), mean - half_width, mean + half_width)
    _label_time(axes, track)
    axes.set_ylabel(f"speed, {unit}")
    figure.legend(loc="outside upper left", ncols=4, handlelength=1.6, columnspacing=1.6)


def _limit_y(axes: Axes, visible: Array, lower: Array, upper: Array) -> None:
    """Shows ``visible`` and most of the band between ``lower`` and ``upper``, which is often wide at its beginning."""
    values = np.concatenate([visible, *(_central_values(edge) for edge in (lower, upper))])
    values = values[np.isfinite(values)]
    if len(values):
        lo, hi = float(values.min()), float(values.max())
        margin = max(0.08 * (hi - lo), 0.1)
        axes.set_ylim(lo - margin, hi + margin)


def _central_values(values: Array) -> Array:
    known = values[np.isfinite(values)]
    return np.quantile(known, [0.1, 0.9]) if len(known) else known


def _draw_depth(figure: Figure, track: Track, color: str) -> None:
    axes = figure.subplots()
    _draw_frames(axes, track.time, track.position[:, 2], color, track.hidden)
    axes.set_ylabel("distance ahead of the camera, m")
    _label_time(axes, track)


def _draw_particles(figure: Figure, track: Track) -> None:
    spread, sample = figure.subplots(2, sharex=True)
    spreads = np.array([_spread(points) for points in track.particles_left])
    _draw_frames(spread, track.time, spreads, FILTER_COLOR, track.hidden)
    spread.set_ylim(bottom=0)
    spread.set_title("spread of the particles, pixels")
    _draw_frames(sample, track.time, track.ess, FILTER_COLOR, track.hidden)
    sample.set_ylim(bottom=0)
    sample.set_title("effective sample size")
    _label_time(sample, track)


def _spread(points: Array) -> float:
    """Root mean square distance from their centre of those ``points`` (P, 2) that are finite; NaN where none is."""
    known = points[np.isfinite(points).all(axis=1)]
    return float(np.sqrt(((known - known.mean(0)) ** 2).sum(1).mean())) if len(known) else np.nan


def _draw_plan(figure: Figure, result: ClipResult, colors: dict[str, str]) -> None:
    axes = figure.subplots()
    for i, path in enumerate(result.paths):
        x, _, z = path.points.T
        axes.plot(z, -x, color=lane_color(i), lw=1.4, ls=(0, (6, 3)), label=f"path {path.name}")
    for measurement in result.measurements:
        track = measurement.track
        x, _, z = track.position.T
        _draw_frames(axes, z, -x, colors[measurement.vehicle], track.hidden, label=f"vehicle {measurement.vehicle}")
    axes.plot(0, 0, marker=">", color=INK_COLOR, ms=7, ls="", label="left camera")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("distance ahead, m")
    axes.set_ylabel("to the left, m")
    figure.legend(loc="outside upper left", ncols=6, handlelength=1.6, columnspacing=1.6)


def _draw_frames(axes: Axes, x: Array, y: Array, color: str, hidden: Mask, label: str | None = None) -> None:
    """A line, with a dot per frame for at most MAX_DOTTED_FRAMES, and a cross for each that is ``hidden``."""
    axes.plot(x, y, color=color, lw=1.4, label=label)
    if len(x) <= MAX_DOTTED_FRAMES:
        axes.plot(x[~hidden], y[~hidden], color=color, ls="", marker="o", ms=3)
    if hidden.any():
        axes.plot(x[hidden], y[hidden], color=MUTED_COLOR, ls="", marker="x", ms=5, label=label and f"{label}, hidden")


def _label_time(axes: Axes, track: Track) -> None:
    axes.set_xlabel("time, s")
    if len(track.time) > 1:
        axes.margins(x=0.02)
