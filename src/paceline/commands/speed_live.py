"""``paceline speed --live``: the speed of each vehicle that passes while two cameras record."""

from __future__ import annotations

import sys
import time
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from paceline.commands import DONE, NOTHING_MEASURED
from paceline.commands.interrupts import ended_by_interrupt
from paceline.commands.progress_output import live_line_writer, write_progress

if TYPE_CHECKING:
    from paceline.cameras import StereoRig
    from paceline.detection.finder import DetectedVehicle
    from paceline.detection.tracks import DetectionTrack
    from paceline.documents.loading import Clip
    from paceline.recordings.live_stereo import RawPair
    from paceline.speed.configuration import SpeedConfiguration
    from paceline.speed.results import Measurement
    from paceline.units import SpeedUnit
    from paceline.verdicts import Message


def measure_live(
    clip: Clip,
    out: Path,
    configuration: SpeedConfiguration,
    unit: SpeedUnit,
    background_s: float | None,
    quiet: bool,
    detector: Path | None = None,
) -> int:
    """Measure every vehicle that passes, until the sources end or Ctrl-C; a line and a row for each."""
    import cv2

    from paceline.detection.onnx_detector import OnnxDetector
    from paceline.errors import UnusableInput
    from paceline.recordings.live_stereo import LiveStereo
    from paceline.reports.live.report import LiveResults
    from paceline.speed.configuration import DEFAULT_BACKGROUND_S
    from paceline.survey.live import survey
    from paceline.verdicts import message
    from paceline.version import versions

    if clip.vehicles:
        raise UnusableInput(f"{clip.path}: vehicles: --live finds them itself; expected none")
    at_once = detector is not None and bool(clip.paths)
    cv2.setNumThreads(1)  # images are small: a second thread costs more than it gains, and the measurement needs it
    detect = None if detector is None else OnnxDetector(detector)
    views = LiveStereo(clip)
    background_s = DEFAULT_BACKGROUND_S if background_s is None else background_s
    settings, package_versions = {**configuration.model_dump(), "learn": background_s}, versions()
    if detect is not None:
        settings["detector"], package_versions["onnxruntime"] = detect.name, detect.runtime
    max_pictures = configuration.live.kept_pictures
    results = LiveResults(
        out, {"clip": str(clip.path), "configuration": settings, "versions": package_versions}, unit, max_pictures
    )
    looking = _Looking(clip.rig, background_s)

    def say(text: str) -> None:
        if not quiet:
            print(text, flush=True)

    def on_result(found: DetectedVehicle, measurement: Measurement | None, reason: Message) -> None:
        seen_at = looking.time_of_day(found.times[0])
        if measurement is not None:
            results.add(measurement, found, seen_at)
        else:
            results.add_unmeasured(found, seen_at, reason)
        say(_line(found, measurement, reason, unit))

    def on_frame(pair: RawPair, tracks: list[DetectionTrack]) -> None:
        results.save()
        looking.looked(pair, tracks)

    def ready(paths: int) -> None:
        looking.has_learned()
        results.begin()
        say(f"{paths} {'path' if paths == 1 else 'paths'}; measuring until Ctrl-C")

    if not at_once:
        say(f"learning the empty road for {background_s:g} s")
    with results:
        with ended_by_interrupt(views.stop):
            try:
                no_vehicle = survey(clip, views, configuration, on_result, background_s, ready, on_frame, detect)
            except BrokenExecutor as error:
                killed = "the process that measures was killed; is there memory enough?"
                raise UnusableInput(f"{clip.path}: {killed}") from error
        results.notices += views.notices
        if detect is not None and not (results.vehicles or results.unmeasured):
            results.notices.append(no_vehicle.after("no vehicle was found"))
        if views.dropped:
            results.notices.append(message("frames_dropped_live", frames=views.dropped))
    for notice in results.notices:
        print(f"note: {notice}", file=sys.stderr)
    measured = sum(vehicle["verdict"] == "measured" for vehicle in results.vehicles)
    say(f"{measured} of {len(results.vehicles)} vehicles measured; report: {out / 'report.html'}")
    return DONE if measured else NOTHING_MEASURED


@dataclass
class _Looking:
    """What goes on while the cameras are looked at: what is told of it, and what time of day it is."""

    rig: StereoRig
    learning: float  # s
    _begun: float | None = None  # s, by the cameras' clock
    _learned: bool = False
    _ahead: float = field(default_factory=time.time)  # s, of the time of day over the cameras' clock

    def __post_init__(self) -> None:
        self._tell = live_line_writer(self.rig)

    def looked(self, pair: RawPair, tracks: list[DetectionTrack]) -> None:
        """Note that a ``pair`` has been looked through, with these ``tracks`` in view."""
        self._ahead = time.time() - pair.time
        if self._tell is None:
            return
        if self._begun is None:
            self._begun = pair.time
        if self._tell(pair, tracks) and not self._learned:
            write_progress("learning", int(pair.time - self._begun), int(self.learning))

    def has_learned(self) -> None:
        self._learned = True
        if self._tell is not None:
            write_progress("measuring", 0, None)

    def time_of_day(self, moment: float) -> str:
        """When a ``moment`` of the cameras' clock was, s, where they are played or come without delay."""
        return datetime.fromtimestamp(self._ahead + moment).astimezone().isoformat(timespec="seconds")


def _line(found: DetectedVehicle, measurement: Measurement | None, reason: Message, unit: SpeedUnit) -> str:
    """What is shown of a vehicle that has passed."""
    from paceline.reports.common.formatting import NO_VALUE, format_speed, format_verdict, rejected_advice

    name = found.vehicle.id if found.vehicle is not None else NO_VALUE
    when = f"{time.strftime('%H:%M:%S')}  {name:<5} {found.path:<8}"
    if measurement is None:
        return f"{when} not measured: {reason}{_advice(reason.advice)}"
    formatted = format_speed(measurement, unit)
    speed = f"{formatted.speed} ± {formatted.plus_minus} {unit}" if formatted.known else NO_VALUE
    advice = "" if measurement.verdict == "measured" else rejected_advice(measurement.reason_code)
    return f"{when} {speed}  {format_verdict(measurement)}{_advice(advice)}"


def _advice(text: str) -> str:
    """A line of its own for an advice, where there is one."""
    return f"\n          {text}" if text else ""
