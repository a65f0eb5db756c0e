"""``paceline drive``: simulates a vehicle that follows another by camera, in a closed loop, and checks its drive."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import print_columns
from paceline.commands.progress_output import progress_bar

if TYPE_CHECKING:
    from paceline.simulation.closed_loop.results import DriveResult

EXIT_REQUIREMENTS_MET, EXIT_REQUIREMENT_FAILED = 0, 1


def drive(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="A drive.yaml, or the name of a scene.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the report and the tables.")],
    latency: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.0, max=2.0, help="Delay from image to effect of its command.")
    ] = 0.128,
    seed: Annotated[int, typer.Option(min=0, help="Seed of world, vehicles and light.")] = 1,
    overlay: Annotated[bool, typer.Option("--overlay/--no-overlay", help="Write the overlay video.")] = True,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Simulate a vehicle that follows the one ahead by its camera, and check the requirements."""
    from paceline.reports.closed_loop.report import write_drive_files
    from paceline.reports.common.output_folder import OutputFolder
    from paceline.simulation.closed_loop.drive_yaml import resolve_drive
    from paceline.simulation.closed_loop.loop import ClosedLoop

    model = resolve_drive(scene, seed)
    with OutputFolder(out) as folder, progress_bar("driving", sys.stderr.isatty() and not quiet) as advance:
        result = write_drive_files(ClosedLoop(model, seed, latency), folder, overlay, advance)
    if not quiet:
        _print_drive(result)
        print(f"\nReport: {out / 'report.html'}")
    return EXIT_REQUIREMENTS_MET if result.holds else EXIT_REQUIREMENT_FAILED


def _print_drive(result: DriveResult) -> None:
    from paceline.reports.closed_loop.page import format_requirement

    f = result.figures
    print(
        f"{result.scene}, seed {result.seed}: {result.duration:.0f} s and {f.distance:.0f} m behind a {result.target}, "
        f"up to {3.6 * f.speed_max:.0f} km/h"
    )
    rows = [("requirement", "found", "must be", ""), *map(format_requirement, result.requirements)]
    print_columns(rows)
    times = result.processing
    print(f"processing time {1e3 * times['median']:.2f} ms per picture, 99 of 100 within {1e3 * times['p99']:.2f} ms")
    for notice in result.notices:
        print(f"note: {notice}", file=sys.stderr)
