"""Writes the report of a measurement: tables, plots, overlay and page."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from paceline.progress import Stage, no_stage, with_progress
from paceline.recordings.stereo import StereoRecording
from paceline.reports.common.output_folder import OutputFolder
from paceline.reports.common.plots import VEHICLE_COLORS
from paceline.reports.speed.overlay import StereoStill, join_stills, middle_still, write_overlay
from paceline.reports.speed.page import write_page
from paceline.reports.speed.plots import plan_plot, vehicle_plots
from paceline.reports.speed.tables import (
    OUTLINES_FOLDER,
    PICTURES_FOLDER,
    vehicle_summary,
    write_estimates,
    write_summary,
    write_vehicles,
)
from paceline.speed.choices import OverlayChoice
from paceline.speed.configuration import DEFAULTS
from paceline.speed.results import ClipResult


def write_report(
    result: ClipResult,
    recording: StereoRecording,
    out: str | Path,
    unit: str = DEFAULTS.report.units,
    overlay: OverlayChoice = DEFAULTS.report.overlay,
) -> ClipResult:
    """Writes tables, plots, overlay and page into the folder ``out``, whole or not at all.

    ``unit`` (mph, km/h or m/s) is that of the report; data files are in SI units. ``overlay`` is which frames the
    video shows: ``all``, those with a ``rejected`` vehicle or ``none``; ``auto`` is all of a recording of up to
    `MAX_OVERLAY_S`, none of a longer one. Returns ``result`` with any notice that came up on the way. Raises
    UnusableInput when ``out`` cannot be written.
    """
    with OutputFolder(out) as folder:
        return write_files(result, recording, folder, unit, overlay)


def write_files(
    result: ClipResult,
    recording: StereoRecording,
    folder: Path,
    unit: str,
    overlay: OverlayChoice = DEFAULTS.report.overlay,
    stage: Stage = no_stage,
) -> ClipResult:
    """As `write_report`, straight into an existing ``folder``, in the stages ``drawing`` and ``writing``."""
    colors = {m.vehicle: VEHICLE_COLORS[i % len(VEHICLE_COLORS)] for i, m in enumerate(result.measurements)}
    with stage("drawing") as progress:
        drawn = write_overlay(result, recording, folder / "overlay.mp4", unit, colors, overlay, progress)
    result = dataclasses.replace(result, notices=result.notices + drawn.notices)
    write_estimates(result, folder / "estimates.csv")
    stems = dict(zip(colors, _file_stems(list(colors)), strict=True))
    pictures = _write_pictures(drawn.stills, stems, folder)
    entries = [vehicle_summary(m, pictures.get(m.vehicle)) for m in result.measurements]
    write_summary(result, entries, folder / "summary.json")
    write_vehicles(entries, folder / "vehicles.csv")

    plan = plan_plot(result, colors)
    with stage("writing") as progress:
        measurements = with_progress(result.measurements, len(result.measurements), progress)
        plots = {m.vehicle: vehicle_plots(m, unit, colors[m.vehicle]) for m in measurements}
    (folder / "plots").mkdir(exist_ok=True)
    (folder / "plots" / "plan.png").write_bytes(plan.png)
    for vehicle, drawings in plots.items():
        for plot in drawings:
            (folder / "plots" / f"{stems[vehicle]}-{plot.name}.png").write_bytes(plot.png)
    write_page(
        result,
        folder / "report.html",
        unit,
        plots=plots,
        plan=plan,
        stills=drawn.stills,
        colors=colors,
        overlay=drawn.has_video,
    )
    return result


def _write_pictures(
    stills: Mapping[str, Sequence[StereoStill]], stems: Mapping[str, str], folder: Path
) -> dict[str, str]:
    """Writes a picture of each vehicle that has stills, and one of all of them; returns the names of the former in the
    ``folder``."""
    names = {vehicle: f"{stems[vehicle]}.jpg" for vehicle, shown in stills.items() if shown}
    if names:
        (folder / PICTURES_FOLDER).mkdir(exist_ok=True)
        (folder / OUTLINES_FOLDER).mkdir(exist_ok=True)
    for vehicle, name in names.items():
        (folder / PICTURES_FOLDER / name).write_bytes(middle_still(stills[vehicle]).left)
        (folder / OUTLINES_FOLDER / name).write_bytes(join_stills(stills[vehicle]))
    return {vehicle: f"{PICTURES_FOLDER}/{name}" for vehicle, name in names.items()}


def _file_stems(vehicles: list[str]) -> list[str]:
    """A file name for each vehicle: its id with unsafe characters replaced, numbered where two would clash."""
    stems: list[str] = []
    for vehicle in vehicles:
        base = re.sub(r"[^\w.-]+", "_", vehicle).strip("._")[:60] or "vehicle"
        stem, count = base, 1
        while stem.lower() in (other.lower() for other in stems):
            count += 1
            stem = f"{base}_{count}"
        stems.append(stem)
    return stems
