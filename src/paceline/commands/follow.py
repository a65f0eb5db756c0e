"""``paceline follow``: the position of the vehicle ahead in every frame of a recording or a live camera."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import file_named
from paceline.commands.interrupts import ended_by_interrupt
from paceline.commands.progress_output import progress_stages, range_line_writer
from paceline.exit_status import EXIT_DONE, EXIT_NOTHING_MEASURED
from paceline.path_following.steering_goal import SteeringGoal

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from paceline.follow.history import Tally
    from paceline.follow.results import FollowResult
    from paceline.recordings.monocular import CameraRecording


def follow_vehicle(
    follow: Annotated[Path, typer.Argument(metavar="FOLLOW", help="A follow.yaml, or the folder that contains it.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the report and the tables.")],
    overlay: Annotated[
        bool, typer.Option("--overlay/--no-overlay", help="Write the overlay video; it takes most of the time.")
    ] = True,
    steering: Annotated[
        SteeringGoal | None,
        typer.Option(
            help="What the steering angle is for: the lead's path (the default with odometry), the lead "
            "itself (without), or none: the column stays empty."
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Follow the vehicle ahead in a recording, or live: where it is in metres, frame by frame."""
    from paceline.documents.loading import load_follow
    from paceline.follow.configuration import FollowConfiguration
    from paceline.recordings.monocular import open_camera
    from paceline.reports.common.output_folder import OutputFolder
    from paceline.reports.follow.report import write_follow_files

    document = load_follow(file_named(follow, "follow.yaml"))
    configuration = FollowConfiguration(steering=steering)
    with OutputFolder(out) as folder:
        recording = open_camera(document)
        with progress_stages(quiet) as stage, _ended(recording):
            on_frame = range_line_writer(document.target.name, recording.live)
            result, tally = write_follow_files(document, recording, folder, configuration, overlay, stage, on_frame)
    if not quiet:
        _print_follow(result, tally)
        print(f"\nReport: {out / 'report.html'}")
    return EXIT_DONE if tally.tracked else EXIT_NOTHING_MEASURED


def _ended(recording: CameraRecording) -> AbstractContextManager[None]:
    """Ctrl-C ends a live recording, which has no other end; what was followed until then is reported."""
    return ended_by_interrupt(recording.stop) if recording.live else nullcontext()


def _print_follow(result: FollowResult, tally: Tally) -> None:
    from paceline.reports.follow.page import describe_steering, describe_width, format_percent
    from paceline.reports.follow.tables import finite_quantile

    counts = ", ".join(f"{tally.status[name]} {name}" for name in ("tracking", "coasting", "lost"))
    print(f"{result.target}: tracked in {format_percent(tally.share)} of {tally.frames} frames ({counts})")
    if tally.tracked:
        print(f"distance ahead {tally.range_min:.1f} to {tally.range_max:.1f} m, {tally.range_mean:.1f} m on average")
        print(f"the model is {describe_width(result)}: every distance is as uncertain")
    slowest = 1e3 * finite_quantile(result.latency, 0.99)
    print(
        f"processing time {1e3 * finite_quantile(result.latency):.2f} ms per frame, 99 of 100 within {slowest:.2f} ms"
    )
    print(f"steering: {describe_steering(result)}")
    for reason, count in tally.reasons.most_common(5):
        print(f"note: {reason}, in {count} frame{'' if count == 1 else 's'}", file=sys.stderr)
    for notice in result.notices:
        print(f"note: {notice}", file=sys.stderr)
