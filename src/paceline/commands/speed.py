"""``paceline speed``: the speed of every vehicle in a stereo clip."""

from __future__ import annotations

import sys
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import DONE, NOTHING_MEASURED, file_named, print_columns
from paceline.commands.progress_output import progress_bar, speed_teller
from paceline.errors import UnusableInput

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from paceline.documents.loading import Clip
    from paceline.speed.configuration import SpeedConfiguration
    from paceline.speed.results import ClipResult
    from paceline.units import SpeedUnit


class Motion(StrEnum):
    auto = "auto"
    free = "free"
    line = "line"
    curve = "curve"


class Method(StrEnum):
    """Ours, or one that it is compared with."""

    paceline = "paceline"
    sift = "sift"
    kalman = "kalman"
    kalman_wander = "kalman-wander"
    multimodal = "multimodal"
    lucas_kanade = "lucas-kanade"


class Device(StrEnum):
    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


def speed(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="A clip.yaml, or the folder that contains it.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the report and the tables.")],
    particles: Annotated[int | None, typer.Option(help="Number of particles of the filter.")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the random numbers; the same seed gives the same result.")
    ] = None,
    motion: Annotated[
        Motion | None, typer.Option(help="How vehicles may move; auto follows the path given in the clip.")
    ] = None,
    method: Annotated[
        Method, typer.Option(help="How to measure: Paceline's way, or one that it is compared with.")
    ] = Method.paceline,
    device: Annotated[Device, typer.Option(help="Where to compute; auto takes a GPU where it can.")] = Device.cpu,
    units: Annotated[
        str, typer.Option(metavar="<mph|km/h|m/s>", help="Unit shown to people; files are always in m/s.")
    ] = "mph",
    tolerance: Annotated[
        float | None,
        typer.Option(help="Reject every speed whose 95 % interval is wider than ± this, in the unit of --units."),
    ] = None,
    parts: Annotated[int | None, typer.Option(help="Number of parts of the likelihood.")] = None,
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Fit the whole track at the end; --no-refine only filters.")
    ] = True,
    live: Annotated[
        bool, typer.Option("--live", help="Measure vehicle after vehicle as the cameras record, until Ctrl-C.")
    ] = False,
    learn: Annotated[
        float | None, typer.Option(help="Seconds in which --live learns what the empty road looks like.")
    ] = None,
    detector: Annotated[
        Path | None,
        typer.Option(metavar="MODEL.onnx", help="A detector of your own, in whose boxes vehicles are looked for."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Measure the speed of every vehicle in a stereo clip: those that it outlines, or else those found in it."""
    if device is Device.cuda and method is not Method.paceline:
        raise UnusableInput(f"--device cuda: --method {method.value} computes on the CPU only; use --device cpu")
    unit = _unit(units)
    given = {
        "particles": particles,
        "seed": seed,
        "motion": motion and motion.value,
        "parts": parts,
        "tolerance": None if tolerance is None else _tolerance(tolerance, unit),
    }
    configuration = _configuration({key: value for key, value in given.items() if value is not None}, refine)

    from paceline.documents.loading import load_clip
    from paceline.recordings.stereo import open_recording
    from paceline.reports import OutputFolder, write_files

    document = load_clip(file_named(clip, "clip.yaml"))
    if live:
        from paceline.commands.speed_live import measure_live

        if method is not Method.paceline or device is not Device.cpu:
            raise UnusableInput("--live: measures by Paceline's own method on the CPU; leave --method and --device out")
        return measure_live(document, out, configuration, unit, learn, quiet, detector)
    if learn is not None:
        raise UnusableInput("--learn: goes with --live only")
    if detector is not None and document.vehicles:
        raise UnusableInput(f"{document.path}: vehicles: --detector is to find them; expected none")
    with OutputFolder(out) as folder:  # before the work, so that an unwritable folder is told at once
        recording, shown = open_recording(document), sys.stderr.isatty() and not quiet

        def measured(document: Clip) -> ClipResult:
            with progress_bar("measuring", shown) as advance:
                if method is Method.paceline:
                    from paceline.speed.measurement import measure

                    return measure(
                        document, recording, configuration, advance, device.value, speed_teller(document.rig)
                    )
                from paceline.baselines.registry import measure as measure_by

                return measure_by(document, recording, method.value, configuration, advance)

        if document.vehicles:
            result = measured(document)
        else:
            from paceline.detection.onnx_detector import Detector
            from paceline.detection.search import find_vehicles
            from paceline.survey.recording import measure_found

            detect = None if detector is None else Detector(detector)
            with progress_bar("looking", shown) as advance:
                search = find_vehicles(document, recording, advance, detect)
            result = measure_found(search, recording, configuration, measured)
            if detect is not None:
                result = replace(
                    result,
                    configuration={**result.configuration, "detector": detect.name},
                    versions={**result.versions, "onnxruntime": detect.runtime},
                )
        result = write_files(result, recording, folder, unit)
    if not quiet:
        _print_result(result, unit)
        print(f"\nReport: {out / 'report.html'}")
    return DONE if any(m.verdict == "measured" for m in result.measurements) else NOTHING_MEASURED


def _unit(text: str) -> SpeedUnit:
    from paceline.units import parse_unit

    try:
        return parse_unit(text)
    except ValueError as error:
        raise UnusableInput(f"--units: {error}") from error


def _tolerance(value: float, unit: SpeedUnit) -> float:
    """In m/s."""
    if not 0 < value < float("inf"):
        raise UnusableInput(f"--tolerance {value:g}: expected {unit} above 0")
    return value * unit.mps


def _configuration(given: dict[str, object], refine: bool) -> SpeedConfiguration:
    from pydantic import ValidationError

    from paceline.speed.configuration import SpeedConfiguration

    try:
        return SpeedConfiguration.model_validate({**given, "refine": refine})
    except ValidationError as error:
        first = error.errors()[0]
        expected = first["msg"].replace("Input should be", "expected")
        raise UnusableInput(f"--{first['loc'][0]} {first['input']}: {expected}") from error


def _print_result(result: ClipResult, unit: str) -> None:
    from paceline.reports.common.formatting import MISSING, speed_words, verdict_words

    rows = [("vehicle", f"speed, {unit}", "95 % interval", "verdict")]
    for m in result.measurements:
        words = speed_words(m, unit)
        interval = f"{words.lo} to {words.hi}" if words.lo != MISSING else MISSING
        speed = f"{words.speed} ± {words.plus_minus}" if words.known else MISSING
        rows.append((m.vehicle, speed, interval, verdict_words(m)))
    print_columns(rows)
    if not result.measurements:
        print("no vehicle was found")
    for notice in [*result.notices, *(f"{m.vehicle}: {text}" for m in result.measurements for text in m.notices)]:
        print(f"note: {notice}", file=sys.stderr)
