"""The command line: thin commands over plain functions."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.errors import UnusableInput

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from paceline.follow.history import Tally
    from paceline.follow.results import FollowResult
    from paceline.monocular import CameraRecording
    from paceline.speed.configuration import SpeedConfiguration
    from paceline.speed.results import ClipResult
    from paceline.units import SpeedUnit

DONE, NOTHING_MEASURED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130

app = typer.Typer(
    name="paceline",
    help="Measures how fast vehicles move, with ordinary cameras.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
target = typer.Typer(help="Line models of vehicles to follow.", rich_markup_mode=None)
app.add_typer(target, name="target")


class Motion(StrEnum):
    auto = "auto"
    free = "free"
    line = "line"
    curve = "curve"


class Device(StrEnum):
    cpu = "cpu"
    cuda = "cuda"


def main() -> None:
    """Runs the command line and exits with its status; every error is one plain line on standard error."""
    signal.signal(signal.SIGTERM, _terminate)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads, for matrices this small, only stand in the way
    try:
        status = app(prog_name="paceline", standalone_mode=False)
    except UnusableInput as error:
        print(f"paceline: {error}", file=sys.stderr)
        status = UNUSABLE
    except typer.TyperException as error:  # a wrong option or argument
        text = " ".join(error.format_message().split()).replace("Value error, ", "").rstrip(".")
        print(f"paceline: {text}; see paceline --help", file=sys.stderr)
        status = UNUSABLE
    if status == INTERRUPTED:  # how Typer answers Ctrl-C
        print("paceline: interrupted", file=sys.stderr)
    sys.exit(status)


def _terminate(number: int, frame: FrameType | None) -> None:
    """Ends as by Ctrl-C, so that nothing half written stays behind."""
    sys.exit(128 + number)


def _show_version(wanted: bool) -> None:
    if wanted:
        from paceline import __version__

        print(f"paceline {__version__}")
        raise typer.Exit


@app.callback()
def paceline(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Measures how fast vehicles move, with ordinary cameras."""


@app.command()
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
    device: Annotated[Device, typer.Option(help="Where to compute.")] = Device.cpu,
    units: Annotated[
        str, typer.Option(metavar="<mph|km/h|m/s>", help="Unit shown to people; files are always in m/s.")
    ] = "mph",
    parts: Annotated[int | None, typer.Option(help="Number of parts of the likelihood.")] = None,
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Fit the whole track at the end; --no-refine only filters.")
    ] = True,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Measure the speed of every vehicle in a stereo clip."""
    if device is Device.cuda:
        raise UnusableInput("--device cuda: this release computes on the CPU only; use --device cpu")
    unit = _unit(units)
    given = {"particles": particles, "seed": seed, "motion": motion and motion.value, "parts": parts}
    configuration = _configuration({key: value for key, value in given.items() if value is not None}, refine)

    from paceline.documents import load_clip
    from paceline.recordings import open_recording
    from paceline.reports import OutputFolder, write_files
    from paceline.speed.measurement import measure

    document = load_clip(clip / "clip.yaml" if clip.is_dir() else clip)
    with OutputFolder(out) as folder:  # before the work, so that an unwritable folder is told at once
        recording = open_recording(document)
        with _progress("measuring", sys.stderr.isatty() and not quiet) as advance:
            result = measure(document, recording, configuration, advance)
        result = write_files(result, recording, folder, unit)
    if not quiet:
        _print_result(result, unit)
        print(f"\nReport: {out / 'report.html'}")
    return DONE if any(m.verdict == "measured" for m in result.measurements) else NOTHING_MEASURED


@app.command("follow")
def follow_vehicle(
    follow: Annotated[Path, typer.Argument(metavar="FOLLOW", help="A follow.yaml, or the folder that contains it.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the report and the tables.")],
    overlay: Annotated[
        bool, typer.Option("--overlay/--no-overlay", help="Write the overlay video; it takes most of the time.")
    ] = True,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Follow the vehicle ahead in a recording, or live: where it is in metres, frame by frame."""
    from paceline.documents import load_follow
    from paceline.monocular import open_camera
    from paceline.reports.follow_report import write_follow_files
    from paceline.reports.output import OutputFolder

    document = load_follow(follow / "follow.yaml" if follow.is_dir() else follow)
    with OutputFolder(out) as folder:
        recording = open_camera(document)
        with _progress("following", sys.stderr.isatty() and not quiet) as advance, _ended_by_interrupt(recording):
            result, tally = write_follow_files(document, recording, folder, None, overlay, advance)
    if not quiet:
        _print_follow(result, tally)
        print(f"\nReport: {out / 'report.html'}")
    return DONE if tally.tracked else NOTHING_MEASURED


@contextmanager
def _ended_by_interrupt(recording: CameraRecording) -> Iterator[None]:
    """Ctrl-C ends a live recording, which has no other end; what was followed until then is reported."""
    if not recording.live:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        recording.stop()
        signal.signal(number, previous)  # the second one interrupts

    previous = signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


@target.command("learn")
def target_learn(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="A picture of the vehicle's rear.")],
    box: Annotated[str, typer.Option(metavar="X0,Y0,X1,Y1", help="Box around the rear, pixels.")],
    width: Annotated[float, typer.Option(metavar="METRES", help="True width of what the box encloses.")],
    camera: Annotated[
        Path, typer.Option(help="The camera.yaml of the picture: its focal length turns pixels into metres.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The target.yaml to write; a picture appears beside it.")],
    name: Annotated[str | None, typer.Option(help="Name of the target; that of the file otherwise.")] = None,
) -> int:
    """Learn a line model from the strong horizontal and vertical edges inside a box."""
    from paceline.documents import load_camera
    from paceline.follow.learning import learn_target
    from paceline.reports.learned import start_lines, write_learned
    from paceline.sources import read_image_file, to_grey

    if out.suffix and image.resolve() in (out.resolve(), out.with_suffix(".png").resolve()):
        raise UnusableInput(f"--out {out}: would write over the picture {image}; expected another name")
    corners, lens = _box(box), load_camera(camera)
    picture = to_grey(read_image_file(image), 16, str(image))
    try:
        learned = learn_target(picture, corners, width, lens, name or out.stem)
    except UnusableInput as unusable:
        raise UnusableInput(f"{image}: {unusable}") from None
    beside = write_learned(learned, picture, out)
    print(f"{len(learned.target.segments)} lines in {out}; look at them in {beside}")
    print(f"follow.yaml, where this picture is the first frame:\n{start_lines(learned)}")
    return DONE


def _box(text: str) -> tuple[float, float, float, float]:
    try:
        x0, y0, x1, y1 = map(float, text.split(","))
    except ValueError:
        raise UnusableInput(f"--box {text}: expected four numbers x0,y0,x1,y1 in pixels") from None
    return x0, y0, x1, y1


def _unit(text: str) -> SpeedUnit:
    from paceline.units import parse_unit

    try:
        return parse_unit(text)
    except ValueError as error:
        raise UnusableInput(f"--units: {error}") from error


def _configuration(given: dict[str, object], refine: bool) -> SpeedConfiguration:
    from pydantic import ValidationError

    from paceline.speed.configuration import SpeedConfiguration

    try:
        return SpeedConfiguration.model_validate({**given, "refine": refine})
    except ValidationError as error:
        first = error.errors()[0]
        expected = first["msg"].replace("Input should be", "expected")
        raise UnusableInput(f"--{first['loc'][0]} {first['input']}: {expected}") from error


@contextmanager
def _progress(doing: str, show: bool) -> Iterator[Callable[[int, int | None], None] | None]:
    """A progress bar on standard error, moved on by calls with (frames done, frames in all if that is known)."""
    if not show:
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.1f} frames/s" if task.speed else "")

    columns = [TextColumn(doing), BarColumn(), MofNCompleteColumn(), TextColumn("frames"), Rate()]
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _print_result(result: ClipResult, unit: str) -> None:
    from paceline.reports.wording import MISSING, speed_words

    rows = [("vehicle", f"speed, {unit}", "95 % interval", "verdict")]
    for m in result.measurements:
        words = speed_words(m, unit)
        interval = f"{words.lo} to {words.hi}" if words.lo != MISSING else MISSING
        speed = f"{words.speed} ± {words.plus_minus}" if words.known else MISSING
        rows.append((m.vehicle, speed, interval, f"{m.verdict}: {m.reason}" if m.reason else m.verdict))
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for *cells, verdict in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + f"  {verdict}")
    if not result.measurements:
        print("no vehicle was found")
    for notice in [*result.notices, *(f"{m.vehicle}: {text}" for m in result.measurements for text in m.notices)]:
        print(f"note: {notice}", file=sys.stderr)


def _print_follow(result: FollowResult, tally: Tally) -> None:
    from paceline.reports.follow_page import percent
    from paceline.reports.follow_tables import middle

    counts = ", ".join(f"{tally.status[name]} {name}" for name in ("tracking", "coasting", "lost"))
    print(f"{result.target}: tracked in {percent(tally.share)} of {tally.frames} frames ({counts})")
    if tally.tracked:
        print(f"distance ahead {tally.range_min:.1f} to {tally.range_max:.1f} m, {tally.range_mean:.1f} m on average")
    slowest = 1e3 * middle(result.latency, 0.99)
    print(f"processing time {1e3 * middle(result.latency):.2f} ms per frame, 99 of 100 within {slowest:.2f} ms")
    for reason, count in tally.reasons.most_common(5):
        print(f"note: {reason}, in {count} frame{'' if count == 1 else 's'}", file=sys.stderr)
    for notice in result.notices:
        print(f"note: {notice}", file=sys.stderr)
