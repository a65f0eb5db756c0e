"""The cameras of a speed report: what was not taken as ideal, where it is known from, and what it does to a speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from paceline.cameras import VIEW_NAMES
from paceline.number_format import NO_VALUE, format_number, format_uncertain
from paceline.units import COVERAGE_95


def camera_rows(cameras: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """The rows of the report's table: what, its value with the half-width of its 95 % interval, its source, and the
    relative change of a speed for one half-width; ``cameras`` as in summary.json."""
    rows = []
    if offset := cameras.get("offset_s"):
        rows.append(_row("the right camera exposes later by", offset, 1e3, "ms"))
    if (rate := cameras.get("rate_difference_ppm")) and rate["source"] == "estimated":
        rows.append(_row("which grows by", rate, 1.0, "ppm"))
    for view in VIEW_NAMES:
        of_view = cameras.get(view) or {}
        if readout := of_view.get("readout_s"):
            rows.append(_row(f"the {view} camera reads its rows within", readout, 1e3, "ms"))
        if sway := of_view.get("sway_px_rms"):
            rows.append((f"the {view} camera turns, RMS", f"{format_number(sway, 2)} px", "estimated", NO_VALUE))
        if drift := of_view.get("drift_px_per_min"):
            rows.append((f"the {view} camera drifts", f"{format_number(drift, 1)} px/min", "estimated", NO_VALUE))
    for knock in cameras.get("knocks", []):
        what = f"the {knock['view']} camera was knocked at {format_number(knock['time_s'], 2)} s"
        rows.append((what, f"{format_number(knock['px'], 2)} px", "estimated", NO_VALUE))
    if epipolar := cameras.get("epipolar_px"):
        what = "static points are off their epipolar lines, RMS"
        rows.append(_row(what, {**epipolar, "source": "estimated"}, 1.0, "px"))
    if "rig" in cameras.get("assumed", []):
        rows.append(("the calibration’s uncertainty", NO_VALUE, "assumed", "the systematic part of each speed"))
    return rows


def _row(what: str, quantity: Mapping[str, Any], scale: float, unit: str) -> tuple[str, str, str, str]:
    value, half_width = scale * quantity["value"], scale * COVERAGE_95 * quantity["std"]
    effect = quantity.get("speed_effect")  # 0 where no vehicle tells
    change = f"{format_number(100 * COVERAGE_95 * effect, 2)} %" if effect else NO_VALUE
    return what, f"{format_uncertain(value, half_width)} {unit}", str(quantity["source"]), change
