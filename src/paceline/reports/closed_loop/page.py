"""report.html of a drive: one self-contained page with the verdict, the requirements, and the plots."""

from __future__ import annotations

from pathlib import Path

from paceline.number_format import NO_VALUE, format_number
from paceline.reports.common.html import flatten_settings, render
from paceline.reports.common.plots import Plot
from paceline.reports.follow.overlay import TargetStill
from paceline.reports.follow.page import format_percent
from paceline.simulation.closed_loop.requirements import Requirement
from paceline.simulation.closed_loop.results import DriveResult

# What each plot shows, in plain words.
PLOT_CAPTIONS = {
    "plan": "The paths of the vehicle ahead and of the one that follows it by its camera; ideally they coincide.",
    "gap": "The gap to the vehicle ahead: true, estimated by the camera, and wanted by the throttle control. In shaded "
    "intervals it was not tracked.",
    "path_error": "Distance of the rear axle from the path of the vehicle ahead; positive to the right.",
    "steering": "The commanded angle, and that of the front wheels, with their delay and limited rate.",
    "speed": "Both vehicles. The speed of the follower should vary less than that of the lead.",
    "processing": "Computing time of the tracker per frame on this machine; the loop itself runs on simulated time.",
}


def write_drive_page(
    result: DriveResult, file: Path, *, plots: list[Plot], stills: list[TargetStill], overlay: bool
) -> None:
    """Writes the page. Needs no other file and no network; ``overlay``: whether there is a video to link to."""
    f = result.figures
    text = render(
        "closed_loop/page.html.j2",
        result=result,
        overlay=overlay,
        rows=[format_requirement(r) for r in result.requirements],
        failed=sum(not r.holds for r in result.requirements),
        duration=format_number(result.duration, 1),
        distance=format_number(f.distance, 0),
        fastest=format_number(3.6 * f.speed_max, 1),
        path_rms=format_number(f.path_rms, 3),
        path_max=format_number(f.path_max, 2),
        clearance=format_number(f.clearance, 1),
        nearest=format_number(f.gap_min, 1),
        farthest=format_number(f.gap_max, 1),
        share=format_percent(f.tracked_share),
        latency=format_number(1e3 * result.latency, 0),
        median=format_number(1e3 * result.processing["median"], 2),
        slowest=format_number(1e3 * result.processing["p99"], 2),
        plots=[(plot, PLOT_CAPTIONS[plot.name]) for plot in plots],
        stills=stills,
        settings=[*flatten_settings(result.document, "drive."), *flatten_settings(result.configuration)],
        seconds=format_number(result.seconds, 1),
        missing=NO_VALUE,
    )
    file.write_text(text, encoding="utf-8")


def format_requirement(r: Requirement) -> tuple[str, str, str, str]:
    """Text of a requirement: its name, its value, its bound, and whether it holds."""
    if r.what == "tracking at the end":
        return r.what, "yes" if r.value else "no", "yes", "holds" if r.holds else "fails"
    is_integer = r.unit == "" and float(r.value).is_integer() and float(r.bound).is_integer()
    decimals = 0 if is_integer else 3 if max(abs(r.bound), 1e-9) < 1 else 2
    unit = f" {r.unit}" if r.unit else ""
    bound = f"at {'least' if r.at_least else 'most'} {format_number(r.bound, decimals)}{unit}"
    return r.what, f"{format_number(r.value, decimals)}{unit}", bound, "holds" if r.holds else "fails"
