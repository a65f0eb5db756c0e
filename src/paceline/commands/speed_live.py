"""``paceline speed --live``: the speed of each vehicle that passes while two cameras record."""

from __future__ import annotations

import sys
import time
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from paceline.commands.interrupts import ended_by_interrupt
from paceline.commands.progress_output import compilation_notice, live_line_writer, write_progress
from paceline.exit_status import EXIT_DONE, EXIT_NOTHING_MEASURED

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
    quiet: bool,
    detector: Path | None = None,
) -> int:
    """Measures every vehicle that passes, until the sources end or Ctrl-C; prints a line and writes a row for each."""
    import cv2

    from paceline.detection.onnx_detector import OnnxDetector
    from paceline.errors import UnusableInput
    from paceline.recordings.live_stereo import LiveStereo
    from paceline.reports.live.report import LiveResults
    from paceline.survey.live import survey
    from paceline.verdicts import message
    from paceline.version import versions

    if clip.vehicles:
        raise UnusableInput(f"{clip.path}: vehicles: --live finds them itself; expected none")
    at_once = detector is not None and bool(clip.paths)
    cv2.setNumThreads(1)  # images are small: a second thread costs more than it gains, and the measurement needs it
    detect = None if detector is None else OnnxDetector(detector, configuration.detection.score)
    views = LiveStereo(clip)
    background_s, unit = configuration.background.seconds, configuration.report.units
    settings, package_versions = {**configuration.model_dump(), "learn": background_s}, versions()
    if detect is not None:
        settings["detector"], package_versions["onnxruntime"] = detect.name, detect.runtime
    max_pictures = configuration.live.kept_pictures
    results = LiveResults(
        out, {"clip": str(clip.path), "configuration": settings, "versions": package_versions}, unit, max_pictures
    )
    live_progress = _LiveProgress(clip.rig, background_s)

    def print_line(text: str) -> None:
        if not quiet:
            print(text, flush=True)

    def on_result(detected: DetectedVehicle, measurement: Measurement | None, reason: Message) -> None:
        seen_at = live_progress.time_of_day(detected.times[0])
        results.notices += detected.notices
        if measurement is not None:
            results.add(measurement, detected, seen_at)
        else:
            results.add_unmeasured(detected, seen_at, reason)
        print_line(_format_vehicle(detected, measurement, reason, unit))

    def on_frame(pair: RawPair, tracks: list[DetectionTrack]) -> None:
        results.save()
        live_progress.report_pair(pair, tracks)

    def on_ready(paths: int) -> None:
        live_progress.end_background()
        results.begin()
        print_line(f"{paths} {'path' if paths == 1 else 'paths'}; measuring until Ctrl-C")

    if not at_once:
        print_line(f"estimating the background for {background_s:g} s")
    with results:
        with compilation_notice(not quiet), ended_by_interrupt(views.stop):
            try:
                no_vehicle = survey(clip, views, configuration, on_result, on_ready, on_frame, detect)
            except BrokenExecutor as error:
                problem = "the process that measures was killed; is there memory enough?"
                raise UnusableInput(f"{clip.path}: {problem}") from error
        results.notices += views.notices
        if detect is not None and not (results.vehicles or results.unmeasured):
            results.notices.append(no_vehicle.after("no vehicle was found"))
        if views.dropped:
            results.notices.append(message("frames_dropped_live", frames=views.dropped))
    for notice in results.notices:
        print(f"note: {notice}", file=sys.stderr)
    measured = sum(vehicle["verdict"] == "measured" for vehicle in results.vehicles)
    print_line(f"{measured} of {len(results.vehicles)} vehicles measured; report: {out / 'report.html'}")
    return EXIT_DONE if measured else EXIT_NOTHING_MEASURED


@dataclass
class _LiveProgress:
    """Reports the progress of a live measurement, and converts the cameras' clock to the time of day."""

    rig: StereoRig
    background_s: float
    _first_time: float | None = None  # s, by the cameras' clock
    _background_estimated: bool = False
    _clock_offset: float = field(default_factory=time.time)  # s, of the time of day from the cameras' clock

    def __post_init__(self) -> None:
        self._write_line = live_line_writer(self.rig)

    def report_pair(self, pair: RawPair, tracks: list[DetectionTrack]) -> None:
        """Reports that a ``pair`` has been processed, with these ``tracks`` in view."""
        self._clock_offset = time.time() - pair.time
        if self._write_line is None:
            return
        if self._first_time is None:
            self._first_time = pair.time
        if self._write_line(pair, tracks) and not self._background_estimated:
            write_progress("learning", int(pair.time - self._first_time), int(self.background_s))

    def end_background(self) -> None:
        """Reports that the background is estimated and the measurement begins."""
        self._background_estimated = True
        if self._write_line is not None:
            write_progress("measuring", 0, None)

    def time_of_day(self, moment: float) -> str:
        """The time of day at ``moment`` (s) of the cameras' clock, if they deliver frames without delay."""
        return datetime.fromtimestamp(self._clock_offset + moment).astimezone().isoformat(timespec="seconds")


def _format_vehicle(
    detected: DetectedVehicle, measurement: Measurement | None, reason: Message, unit: SpeedUnit
) -> str:
    """The printed line of a vehicle that has passed."""
    from paceline.number_format import NO_VALUE
    from paceline.reports.common.formatting import (
        format_compliance,
        format_measurement,
        format_verdict,
        rejected_advice,
    )

    name = detected.vehicle.id if detected.vehicle is not None else NO_VALUE
    prefix = f"{time.strftime('%H:%M:%S')}  {name:<5} {detected.path:<8}"
    prefix += f" {(measurement.travel if measurement else None) or NO_VALUE:<12}"
    if measurement is None:
        return f"{prefix} not measured: {reason}{_advice(reason.advice)}"
    formatted = format_measurement(measurement, unit)
    speed = f"{formatted} {unit}" if formatted.known else NO_VALUE
    compliance = format_compliance(measurement.compliance, measurement.limit, unit)
    speed = speed if compliance == NO_VALUE else f"{speed}  {compliance}"
    advice = "" if measurement.verdict == "measured" else rejected_advice(measurement.reason_code)
    return f"{prefix} {speed}  {format_verdict(measurement)}{_advice(advice)}"


def _advice(text: str) -> str:
    """The advice on a line of its own; empty if there is none."""
    return f"\n          {text}" if text else ""
