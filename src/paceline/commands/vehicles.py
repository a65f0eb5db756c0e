"""``paceline vehicles``: detects the vehicles that drive through a stereo clip, without outlines drawn by a person."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import file_named, print_columns, refuse_read_only
from paceline.commands.progress_output import progress_stages
from paceline.commands.speed import detector_of
from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_DONE, EXIT_NOTHING_MEASURED

if TYPE_CHECKING:
    from paceline.detection.search import SearchResult


def vehicles(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="A clip.yaml, or the folder that contains it.")],
    write: Annotated[
        bool, typer.Option("--in-place", help="Add the vehicles to the clip.yaml, with a picture of each beside it.")
    ] = False,
    detector: Annotated[
        Path | None,
        typer.Option(metavar="MODEL.onnx", help="A detector of your own, in whose boxes vehicles are detected."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE.yaml", help="Settings, as paceline speed reads them: background, lanes, detection."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Detect the vehicles that drive along the paths of a stereo clip and propose their outlines.

    Ends with status 1 where no vehicle can be found.
    """
    from paceline.detection.clip_entries import with_vehicles
    from paceline.detection.onnx_detector import OnnxDetector
    from paceline.detection.search import find_recorded_vehicles
    from paceline.documents.loading import load_clip
    from paceline.recordings.stereo import open_recording
    from paceline.speed.configuration import SpeedSettings, load_settings

    file = file_named(clip, "clip.yaml")
    settings = SpeedSettings() if config is None else load_settings(config)
    detector = detector_of(config, settings) if detector is None else detector
    document = load_clip(file)
    if write:
        refuse_read_only(file)
        if not document.paths:
            raise UnusableInput(f"{file}: paths: none; expected some, such as paceline lanes --in-place adds")
        # refuses now what it would refuse at the end
        with_vehicles(file.read_text(encoding="utf-8"), str(file), document.rig, [])
    detect = None if detector is None else OnnxDetector(detector, settings.detection.score)
    with progress_stages(quiet) as stage, stage("looking") as advance:
        search = find_recorded_vehicles(document, open_recording(document), advance, detect, settings.configuration)
    if not quiet:
        _print(search)
    if search.reason:
        return EXIT_NOTHING_MEASURED
    if write:
        pictures = _write(file, search)
        if not quiet:
            print(f"\nLook at the pictures before you use them: {', '.join(map(str, pictures))}")
    return EXIT_DONE


def _print(search: SearchResult) -> None:
    rows = [("vehicle", "path", "seen, s", "outlined", "away", "large")]
    for f in search.detected:
        if f.vehicle is not None:
            distance = float(f.position @ f.position) ** 0.5
            width, height = (f.vehicle.left.max(0) - f.vehicle.left.min(0)).tolist()
            period = f"{f.times[0]:.2f} to {f.times[1]:.2f}"
            frame, size = f"frame {f.vehicle.frame}", f"{width:.0f} × {height:.0f} px"
            rows.append((f.vehicle.id, f.path, period, frame, f"{distance:.0f} m", size))
    if len(rows) > 1:
        print_columns(rows)
    for notice in search.notices:
        print(notice)


def _write(file: Path, search: SearchResult) -> list[Path]:
    """Writes the vehicles and their pictures together; returns where the pictures are."""
    from paceline.detection.clip_entries import with_vehicles
    from paceline.reports.common.output_folder import write_all_or_none
    from paceline.reports.detected_vehicles import draw_detected_vehicle
    from paceline.reports.lanes import encode_png

    text = with_vehicles(file.read_text(encoding="utf-8"), str(file), search.clip.rig, search.detected)
    pictures = {
        file.with_name(f"vehicle-{f.vehicle.id}.png"): encode_png(draw_detected_vehicle(f))
        for f in search.detected
        if f.vehicle is not None
    }
    write_all_or_none({file.resolve(): text.encode(), **pictures})
    return list(pictures)
