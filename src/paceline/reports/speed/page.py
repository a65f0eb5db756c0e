"""report.html: one self-contained page with the result and its explanation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from paceline.number_format import NO_VALUE, IntervalText, format_number, format_uncertain
from paceline.reports.common.formatting import (
    INTERVAL_LIMITATIONS,
    align_for_page,
    count_compliance,
    distance_travelled,
    format_compliance,
    format_measurement,
    format_parts,
    format_seen,
    interval_title,
    path_length,
    recording_title,
    rejected_advice,
    speed_at,
)
from paceline.reports.common.html import flatten_settings, render
from paceline.reports.common.plots import Plot, lane_color
from paceline.reports.speed.cameras import camera_rows
from paceline.reports.speed.distribution import MANY_VEHICLES, Distribution, describe_distribution
from paceline.reports.speed.overlay import StereoStill
from paceline.reports.speed.vehicle_table import identifying_picture, section_anchor, vehicle_table
from paceline.speed.results import ClipResult, Measurement
from paceline.units import COVERAGE_95, convert
from paceline.verdicts import Message, plural


def write_page(
    result: ClipResult,
    file: Path,
    unit: str,
    *,
    plots: dict[str, list[Plot]],
    plan: Plot,
    stills: dict[str, list[StereoStill]],
    colors: dict[str, str],
    overlay: bool,
) -> None:
    """Writes the page; ``plots``, ``stills`` and ``colors`` are by vehicle; ``overlay``: whether there
    is a video beside it. Needs no other file and no network."""
    vehicles = [
        {
            "id": m.vehicle,
            "anchor": section_anchor(i),
            "m": m,
            "text": (text := format_measurement(m, unit)),
            "parts": format_parts(m, unit),
            "limitation": INTERVAL_LIMITATIONS.get(m.interval_from or "", ""),
            "compliance": format_compliance(m.compliance, m.limit, unit),
            "headline": _headline(m, text, unit),
            "assumed": _is_calibration_assumed(m),
            "passage": _passage(m),
            "picture": identifying_picture(stills[m.vehicle]),
            "color": colors[m.vehicle],
            "advice": rejected_advice(m.reason_code),
            "facts": _facts(m, unit),
            "stills": stills[m.vehicle],
            "outline_check": _outline_check(m),
            "plots": plots[m.vehicle],
            "rows": _rows(m, unit),
        }
        for i, m in enumerate(result.measurements)
    ]
    is_survey = len(vehicles) > MANY_VEHICLES
    html = render(
        "speed/page.html.j2",
        result=result,
        fitted=interval_title(m.interval_from for m in result.measurements) != "interval",
        title=recording_title(result.clip),
        unit=unit,
        vehicles=vehicles,
        measured=sum(m.verdict == "measured" for m in result.measurements),
        table=vehicle_table(result.measurements, stills, unit) if is_survey else None,
        distribution=_distribution(result.measurements, unit),
        compliance=count_compliance(m.compliance for m in result.measurements),
        plan=plan,
        overlay=overlay,
        paths=[
            (path.name, format_number(path_length(path.points), 1), lane_color(i))
            for i, path in enumerate(result.paths)
        ],
        cameras=camera_rows(result.cameras),
        settings=flatten_settings(result.configuration),
        seconds=format_number(result.seconds, 1),
        missing=NO_VALUE,
    )
    file.write_text(html, encoding="utf-8")


def _passage(measurement: Measurement) -> str:
    """Lane, direction and time of a vehicle in one line."""
    period = format_seen(measurement.seen)
    parts = (measurement.path, measurement.travel, None if period == NO_VALUE else f"{period} s")
    return ", ".join(part for part in parts if part)


def _distribution(measurements: Sequence[Measurement], unit: str) -> Distribution | None:
    measured = [m for m in measurements if m.verdict == "measured"]
    limits = {m.limit for m in measured}
    return describe_distribution(
        np.array([m.speed for m in measured]), unit, limits.pop() if len(limits) == 1 else None
    )


def _headline(measurement: Measurement, text: IntervalText, unit: str) -> str:
    """The result in one line."""
    if measurement.verdict != "measured":
        return f"Rejected: {measurement.reason}"
    title = INTERVAL_LIMITATIONS.get(measurement.interval_from or "", "95 % interval")
    return f"{text} {unit}, {title} {text.ends} {unit}"


def _is_calibration_assumed(measurement: Measurement) -> bool:
    """Whether the uncertainty of the calibration is assumed, as rig.yaml states none."""
    return any(isinstance(n, Message) and n.code == "rig_uncertainty_missing" for n in measurement.notices)


def _facts(measurement: Measurement, unit: str) -> list[tuple[str, str]]:
    track = measurement.track
    tracked = track.tracked
    seconds = float(np.ptp(track.time[tracked])) if tracked.any() else 0.0
    depth = track.position[tracked, 2]
    facts = [
        ("frames measured", _counted_frames(measurement, seconds)),
        ("distance travelled", f"{format_number(distance_travelled(track), 1)} m"),
        ("motion model", measurement.model),
    ]
    if len(depth):
        facts.insert(
            2, ("distance ahead", f"{format_number(float(depth[0]), 1)} m to {format_number(float(depth[-1]), 1)} m")
        )
    if (acceleration := format_number(measurement.acceleration, 2)) != NO_VALUE:
        per_second = format_number(float(convert(measurement.acceleration, unit)), 2)
        facts.append(("acceleration", f"{acceleration} m/s² ({per_second} {unit} each second)"))
    if (residual := format_number(measurement.residual_rms, 1)) != NO_VALUE:
        facts.append(("image residual (RMS)", f"{residual} of 255 grey levels"))
    return facts


def _counted_frames(measurement: Measurement, seconds: float) -> str:
    """How many frames counted, over so many ``seconds``, and in how many it was hidden."""
    hidden = int(measurement.track.hidden.sum())
    counted = f"{measurement.frames}, over {seconds:.2f} s"
    return f"{counted}; hidden in {plural(hidden, 'more frame')}" if hidden else counted


def _outline_check(measurement: Measurement) -> str:
    """Whether the outline stays on the same part of the vehicle, as far as that was checked."""
    if (offset := format_number(measurement.outline_offset, 2)) == NO_VALUE:
        return "Nothing has checked that the outline stays on the same part of the vehicle: look whether it does."
    return (
        "That the outline stays on the same part of the vehicle was checked: in both views of the frames that were "
        f"fitted, that part is {offset} px (RMS) from where the motion puts it."
    )


def _rows(measurement: Measurement, unit: str) -> list[list[str]]:
    """The table of frames as text."""
    track = measurement.track
    speeds = [format_uncertain(*(convert(v, unit) for v in speed_at(measurement, i))) for i in range(len(track.frame))]
    filtered = [
        format_uncertain(convert(speed, unit), convert(COVERAGE_95 * std, unit))
        for speed, std in zip(track.speed.tolist(), track.speed_std.tolist(), strict=True)
    ]
    columns = (
        [str(frame) for frame in track.frame],
        [f"{time:.3f}" for time in track.time],
        track.appearance,
        align_for_page(speeds),
        align_for_page(filtered),
        [format_number(float(z), 2) for z in track.position[:, 2]],
        [format_number(float(ess), 0) for ess in track.ess],
    )
    return [list(row) for row in zip(*columns, strict=True)]
