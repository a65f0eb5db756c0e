"""``paceline speed``: the speed of every vehicle in a stereo clip."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import file_named, print_columns
from paceline.commands.progress_output import progress_stages, speed_line_writer
from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_DONE, EXIT_NOTHING_MEASURED
from paceline.processor_cores import limit_cores
from paceline.speed.choices import DeviceName, Motion, OverlayChoice

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from paceline.speed.configuration import SpeedSettings
    from paceline.speed.results import ClipResult
    from paceline.units import SpeedUnit

MIN_LIVE_CORES = 2  # of --cores with --live
OLD_OPTIONS = {
    "--tolerance": "--max-half-width",
    "--parts": "--feature-parts",
    "--learn": "--background-seconds",
}
# of settings that are named otherwise
OPTION_BY_SETTING = {
    "parts": "--feature-parts",
    "background.seconds": "--background-seconds",
}


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
        str | None,
        typer.Option(metavar="NAME", help="Method: paceline, zhu (the paper's filter as printed), or a baseline."),
    ] = None,
    device: Annotated[
        DeviceName | None, typer.Option(help="Device; auto uses a GPU if there is one.", show_default="cpu")
    ] = None,
    units: Annotated[
        str | None,
        typer.Option(metavar="<mph|km/h|m/s>", help="Displayed unit; files are always in m/s.", show_default="mph"),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            "--max-half-width",
            help="Reject every speed whose 95 % interval is wider than ± this, in the unit of --units.",
        ),
    ] = None,
    parts: Annotated[
        int | None, typer.Option("--feature-parts", help="Number of parts of the plane in which features are compared.")
    ] = None,
    limit: Annotated[
        str | None,
        typer.Option(metavar="SPEED", help="Posted limit with its unit, such as '30 mph', in place of the files'."),
    ] = None,
    refine: Annotated[
        bool | None,
        typer.Option(
            "--refine/--no-refine",
            help="Fit the whole track at the end; --no-refine only filters.",
            show_default="refine",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE.yaml", help="Settings, as in summary.json's configuration; options override."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Measure vehicle after vehicle as the cameras record, until Ctrl-C.")
    ] = False,
    learn: Annotated[
        float | None,
        typer.Option("--background-seconds", help="Seconds in which --live estimates the background, the empty road."),
    ] = None,
    detector: Annotated[
        Path | None,
        typer.Option(metavar="MODEL.onnx", help="A detector of your own, in whose boxes vehicles are detected."),
    ] = None,
    overlay: Annotated[
        OverlayChoice | None,
        typer.Option(
            help="Frames in the overlay video; rejected: those with a rejected vehicle; auto: all up to a minute.",
            show_default="auto",
        ),
    ] = None,
    cores: Annotated[
        int | None,
        typer.Option(min=1, help="Processor cores to use at most; 1: one process on one core.", show_default="all"),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Measure the speed of every vehicle in a stereo clip: those that it outlines, or else those detected in it."""
    if cores is not None:
        if live and cores < MIN_LIVE_CORES:
            raise UnusableInput(
                f"--cores {cores}: --live detects and measures at once; expected {MIN_LIVE_CORES} or more"
            )
        limit_cores(cores - 1 if live else cores)  # the process that measures has those beside the one that detects
    given = {
        "particles": particles,
        "seed": seed,
        "motion": motion,
        "method": method,
        "device": device,
        "parts": parts,
        "refine": refine,
        "background.seconds": learn,
        "report.units": None if units is None else unit_named(units),
        "report.overlay": overlay,
    }
    settings = _settings(config, {key: value for key, value in given.items() if value is not None})
    if tolerance is not None:
        settings = settings.model_copy(update={"tolerance": _tolerance(tolerance, settings.report.units)})
    detector = detector_of(config, settings) if detector is None else detector
    limit_mps = None if limit is None else _limit(limit)
    if live:
        return _measure_live(clip, out, settings, quiet, detector, learn is not None, limit_mps)
    if learn is not None:
        raise UnusableInput("--background-seconds: goes with --live only")
    result = _measure(clip, out, settings, quiet, detector, limit_mps)
    if not quiet:
        from paceline.reports.speed.tables import PICTURES_FOLDER

        _print_result(result, settings.report.units)
        print()
        if (out / PICTURES_FOLDER).is_dir():
            print(f"Pictures of the vehicles: {out / PICTURES_FOLDER}")
        print(f"Report: {out / 'report.html'}")
    return EXIT_DONE if any(m.verdict == "measured" for m in result.measurements) else EXIT_NOTHING_MEASURED


def _measure(
    clip: Path, out: Path, settings: SpeedSettings, quiet: bool, detector: Path | None, limit: float | None
) -> ClipResult:
    """Measures a recording and writes the results; ``limit`` in m/s, or None for that of the files."""
    import paceline.baselines.registry  # noqa: F401  makes the baselines known
    from paceline.detection.onnx_detector import OnnxDetector
    from paceline.documents.loading import load_clip
    from paceline.recordings.stereo import open_recording
    from paceline.reports import OutputFolder, write_files
    from paceline.speed.methods import method_named
    from paceline.survey.recording import measure_recording

    method_named(settings.method, settings.device)
    document = load_clip(file_named(clip, "clip.yaml"))
    document = document if limit is None else document.with_limit(limit)
    if detector is not None and document.vehicles:
        raise UnusableInput(f"{document.path}: vehicles: --detector is to find them; expected none")
    # the folder before the work, so that one that cannot be written is reported at once
    with OutputFolder(out) as folder, progress_stages(quiet) as stage:
        recording = open_recording(document)
        result = measure_recording(
            document,
            recording,
            settings.configuration,
            settings.method,
            settings.device,
            None if detector is None else OnnxDetector(detector, settings.detection.score),
            stage,
            on_estimate=speed_line_writer(document.rig),
        )
        return write_files(result, recording, folder, settings.report.units, settings.report.overlay, stage)


def _measure_live(
    clip: Path,
    out: Path,
    settings: SpeedSettings,
    quiet: bool,
    detector: Path | None,
    background_given: bool,
    limit: float | None,
) -> int:
    """Measures what two cameras record; the exit status. ``background_given``: whether an option sets its time;
    ``limit`` as in `_measure`."""
    from paceline.commands.speed_live import measure_live
    from paceline.documents.loading import load_clip

    document = load_clip(file_named(clip, "clip.yaml"))
    document = document if limit is None else document.with_limit(limit)
    if settings.method != "paceline" or settings.device != "cpu":
        raise UnusableInput("--live: measures by Paceline's own method on the CPU; leave --method and --device out")
    at_once = detector is not None and bool(document.paths)
    if at_once and background_given:
        raise UnusableInput(
            "--background-seconds: no background is needed with --detector along given paths; leave it out"
        )
    configuration = settings.configuration
    if at_once:
        none = configuration.background.model_copy(update={"seconds": 0.0})
        configuration = configuration.model_copy(update={"background": none})
    return measure_live(document, out, configuration, quiet, detector)


def unit_named(text: str) -> SpeedUnit:
    """The unit that the option --units names."""
    from paceline.units import parse_unit

    try:
        return parse_unit(text)
    except ValueError as error:
        raise UnusableInput(f"--units: {error}") from error


def _limit(text: str) -> float:
    """The posted limit in m/s."""
    from paceline.units import parse_speed

    try:
        return parse_speed(text)
    except ValueError as error:
        raise UnusableInput(f"--limit: {error}") from error


def _tolerance(value: float, unit: SpeedUnit) -> float:
    """The tolerance in m/s."""
    if not 0 < value < float("inf"):
        raise UnusableInput(f"--max-half-width {value:g}: expected {unit} above 0")
    return value * unit.mps


def _settings(config: Path | None, options: dict[str, object]) -> SpeedSettings:
    """The settings of the file ``config``; ``options``, by key or section.key, override them."""
    from pydantic import ValidationError

    from paceline.speed.configuration import SpeedSettings, load_settings

    chosen = {} if config is None else load_settings(config).model_dump(exclude_unset=True)
    chosen.pop("learn", None)  # it is background.seconds by now
    for key, value in options.items():
        section, _, name = key.rpartition(".")
        (chosen.setdefault(section, {}) if section else chosen)[name] = value
    try:
        return SpeedSettings.model_validate(chosen)
    except ValidationError as error:
        first = error.errors()[0]
        expected = first["msg"].replace("Input should be", "expected")
        key = ".".join(map(str, first["loc"]))
        raise UnusableInput(f"{OPTION_BY_SETTING.get(key, f'--{key}')} {first['input']}: {expected}") from error


def detector_of(config: Path | None, settings: SpeedSettings) -> Path | None:
    """The detector that a configuration file names: beside it, or where the command runs."""
    file = settings.detector_file
    if config is None or file is None:
        return None
    beside_config = config.parent / file
    path = file if file.exists() and not beside_config.exists() else beside_config
    if settings.detector != str(file):  # as a summary names it, with the digest
        from paceline.detection.onnx_detector import detector_name

        if (name := detector_name(path)) != settings.detector:
            raise UnusableInput(f"{config}: detector: expected {settings.detector}, found {path.parent / name}")
    return path


def _print_result(result: ClipResult, unit: str) -> None:
    from paceline.number_format import NO_VALUE, align_decimals
    from paceline.reports.common.formatting import (
        format_compliance,
        format_measurement,
        format_seen,
        format_verdict,
        interval_title,
        rejected_advice,
    )

    texts = [format_measurement(m, unit) for m in result.measurements]
    columns = [
        ("vehicle", *(m.vehicle for m in result.measurements)),
        (f"speed, {unit}", *align_decimals([str(text) for text in texts])),
        (interval_title(m.interval_from for m in result.measurements), *align_decimals([text.ends for text in texts])),
    ]
    if any(m.limit is not None for m in result.measurements):
        columns.append(("limit", *(format_compliance(m.compliance, m.limit, unit) for m in result.measurements)))
    columns += [
        ("lane", *(m.path or NO_VALUE for m in result.measurements)),
        ("direction", *(m.travel or NO_VALUE for m in result.measurements)),
        ("seen, s", *(format_seen(m.seen) for m in result.measurements)),
    ]
    columns.append(("verdict", *map(format_verdict, result.measurements)))
    print_columns(list(zip(*columns, strict=True)))
    for m in result.measurements:
        if m.verdict != "measured":
            print(f"{m.vehicle}: {rejected_advice(m.reason_code)}")
    if not result.measurements:
        print("no vehicle was found")
    for notice in [*result.notices, *(f"{m.vehicle}: {text}" for m in result.measurements for text in m.notices)]:
        print(f"note: {notice}", file=sys.stderr)
