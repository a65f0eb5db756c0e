"""``paceline lanes``: detects the lanes of a road in the recording of a stationary rig."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import file_named, print_columns, refuse_read_only
from paceline.commands.progress_output import progress_bar
from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_DONE, EXIT_NOTHING_MEASURED
from paceline.verdicts import message

if TYPE_CHECKING:
    from paceline.cameras import StereoRig
    from paceline.documents.loading import Clip
    from paceline.lanes.lane_proposals import Lane, RoadLine
    from paceline.recordings.background import Background

MAX_UNREPORTED_UNSTABLE_SHARE = 0.02  # share of the pixels above which a note is printed


def lanes(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="A clip.yaml, or the folder that contains it.")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="The site.yaml to write.")] = None,
    write: Annotated[bool, typer.Option("--in-place", help="Add the lanes to the clip.yaml itself.")] = False,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE.yaml", help="Settings, as paceline speed reads them: background, lanes."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Detect the lanes of a road and propose them as paths, with pictures to check.

    Ends with status 1 where no lane can be found.
    """
    if write and out is not None:
        raise UnusableInput("--in-place and --out exclude each other: the lanes go to the clip.yaml or to a site.yaml")

    from paceline.detection.known_lanes import without_known
    from paceline.documents.loading import load_clip, rig_file
    from paceline.lanes.lane_proposals import propose_lanes, road_lines
    from paceline.lanes.road_detection import RoadNotFound, detect_road
    from paceline.lanes.site_yaml import lane_names, with_lanes
    from paceline.recordings.background import background_problem, estimate_background
    from paceline.recordings.stereo import open_recording
    from paceline.reports.calibration import check_rig_file_name
    from paceline.speed.configuration import SpeedSettings, load_settings

    file = file_named(clip, "clip.yaml")
    settings = SpeedSettings() if config is None else load_settings(config)
    document = load_clip(file)
    if out is not None:
        check_rig_file_name(out)
        if out.resolve() in {file.resolve(), rig_file(file).resolve()}:
            raise UnusableInput(
                f"--out {out}: is the clip itself or its rig; expected a name of its own, or --in-place"
            )
    elif write:
        refuse_read_only(file, ", or use -o")
        with_lanes(file.read_text(encoding="utf-8"), str(file), {})  # refuses now what it would refuse at the end
    if write or out is not None:
        _check_pictures(document, _pictures(file, out))
    with progress_bar("averaging", sys.stderr.isatty() and not quiet) as advance:
        background = estimate_background(open_recording(document), settings.background.frames, advance)
    if reason := background_problem(background):
        print(f"no lane found: {reason}")
        return EXIT_NOTHING_MEASURED
    try:
        road = detect_road(document.rig, background)
    except RoadNotFound as error:
        print(f"no lane found: {error}")
        return EXIT_NOTHING_MEASURED
    lines = road_lines(road)
    proposed, remarks = propose_lanes(document.rig, road, settings.lanes.width)
    with_path = [lane for lane in proposed if lane.path is not None]
    remarks += [lane.reason for lane in proposed if lane.path is None]
    added, known = without_known(with_path, document) if write else (with_path, [])
    remarks += known
    named = dict(zip(lane_names(len(added), document.paths if write else ()), added, strict=True))
    if not quiet:
        _print(lines, named, remarks)
        if background.unstable_share > MAX_UNREPORTED_UNSTABLE_SHARE:
            unstable, limit = 100 * background.unstable_share, 100 * MAX_UNREPORTED_UNSTABLE_SHARE
            notice = message("background_partly_unstable", unstable=unstable, max_unstable=limit)
            print(f"note: {notice}", file=sys.stderr)
    if not with_path:
        print(f"no lane found: {message('no_lane_between_lines')}")
        return EXIT_NOTHING_MEASURED
    if not added:
        print(f"\nNothing was added to {file}: it has a path along every lane that was found.")
        return EXIT_DONE
    if write or out is not None:
        picture_names = _write(file, out, document.rig, background, lines, named)
        if not quiet:
            print(f"\nLook at the pictures before you use them: {picture_names}")
    return EXIT_DONE


def _pictures(file: Path, out: Path | None) -> tuple[Path, Path]:
    """The paths of both views' pictures: beside the clip.yaml or the site.yaml."""
    stem = file.with_name("lanes") if out is None else out.with_suffix("")
    return stem.with_name(f"{stem.name}-left.png"), stem.with_name(f"{stem.name}-right.png")


def _check_pictures(clip: Clip, pictures: tuple[Path, Path]) -> None:
    """Raises UnusableInput where a later run would read these pictures as frames of the recording."""
    for picture in pictures:
        for source in (clip.left, clip.right):
            inside = source.is_dir() and picture.parent.resolve() == source.resolve()
            if inside or picture.absolute().match(str(source.absolute())):
                raise UnusableInput(
                    f"{picture}: would be taken for a frame of {source}; expected an --out in another folder"
                )


def _print(lines: list[RoadLine], lanes: dict[str, Lane], remarks: Sequence[str]) -> None:
    from paceline.number_format import align_decimals, format_number, format_uncertain, significant_decimals
    from paceline.units import COVERAGE_95

    ranges = []
    for line in lines:
        least, greatest = COVERAGE_95 * line.lateral_std.min(), COVERAGE_95 * line.lateral_std.max()
        decimals = significant_decimals(least)
        ranges.append(f"± {format_number(least, decimals)} to {format_number(greatest, decimals)}")
    rows = zip([line.id for line in lines], [line.kind for line in lines], align_decimals(ranges), strict=True)
    print_columns([("line", "marking", "across, m, 95 %"), *rows])
    if lanes:
        print()
        widths = align_decimals([format_uncertain(lane.width, COVERAGE_95 * lane.width_std) for lane in lanes.values()])
        lane_rows = [
            (name, "–".join(lane.between), width, lane.shape)
            for (name, lane), width in zip(lanes.items(), widths, strict=True)
        ]
        print_columns([("lane", "lines", "width, m, 95 %", "shape"), *lane_rows])
    for remark in remarks:
        print(f"left out: {remark}")


def _write(
    file: Path, out: Path | None, rig: StereoRig, background: Background, lines: list[RoadLine], lanes: dict[str, Lane]
) -> str:
    """Writes the lanes and their pictures together; returns the names of the pictures."""
    from paceline.documents.loading import rig_file
    from paceline.lanes.site_yaml import site_yaml, with_lanes
    from paceline.reports.common.output_folder import write_all_or_none
    from paceline.reports.lanes import draw_lanes, encode_png

    if out is None:
        target, text = file.resolve(), with_lanes(file.read_text(encoding="utf-8"), str(file), lanes)
    else:
        relative = os.path.relpath(rig_file(file).resolve(), out.parent.resolve())
        target, text = out, site_yaml(Path(relative).as_posix(), lanes)
    pictures = {
        picture: encode_png(draw_lanes(rig, background, side, lines, lanes))
        for side, picture in enumerate(_pictures(file, out))
    }
    write_all_or_none({target: text.encode(), **pictures})
    return ", ".join(map(str, pictures))
