"""``paceline speed --live``: vehicle after vehicle, while two cameras record."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from paceline.commands import DONE, NOTHING_MEASURED
from paceline.commands.interrupts import ended_by_interrupt

if TYPE_CHECKING:
    from paceline.documents import Clip
    from paceline.speed.configuration import SpeedConfiguration
    from paceline.speed.results import Measurement
    from paceline.units import SpeedUnit
    from paceline.vehicles.finding import Found


def measure_live(
    clip: Clip, out: Path, configuration: SpeedConfiguration, unit: SpeedUnit, learning: float | None, quiet: bool
) -> int:
    """Measure every vehicle that passes, until the sources end or Ctrl-C; a line and a row for each."""
    import cv2

    from paceline.errors import UnusableInput
    from paceline.live_views import LiveViews
    from paceline.reports.live import LiveTables
    from paceline.speed.measurement import versions
    from paceline.vehicles.live import LEARNING, survey

    if clip.vehicles:
        raise UnusableInput(f"{clip.path}: vehicles: --live finds them itself; expected none")
    cv2.setNumThreads(1)  # the cards are small: a second thread costs more than it does, and is wanted for measuring
    views = LiveViews(clip)
    tables = LiveTables(
        out, {"clip": str(clip.path), "configuration": configuration.model_dump(), "versions": versions()}
    )
    learning = LEARNING if learning is None else learning

    def say(text: str) -> None:
        if not quiet:
            print(text, flush=True)

    def told(found: Found, measurement: Measurement | None, reason: str) -> None:
        if measurement is not None:
            tables.add(measurement, found.path, found.times)
        say(_line(found, measurement, reason, unit))

    def ready(paths: int) -> None:
        tables.begin()
        say(f"{paths} {'path' if paths == 1 else 'paths'}; measuring until Ctrl-C")

    say(f"learning the empty road for {learning:g} s")
    with ended_by_interrupt(views.stop):
        survey(clip, views, configuration, told, learning, ready)
    notices = list(views.notices)
    if views.dropped:
        notices.append(f"{views.dropped} frames were dropped: they came faster than this computer looks through them")
    tables.write(notices)
    for notice in notices:
        print(f"note: {notice}", file=sys.stderr)
    measured = sum(vehicle["verdict"] == "measured" for vehicle in tables.vehicles)
    say(f"{measured} of {len(tables.vehicles)} vehicles measured; tables in {out}")
    return DONE if measured else NOTHING_MEASURED


def _line(found: Found, measurement: Measurement | None, reason: str, unit: SpeedUnit) -> str:
    """What is shown of a vehicle that has passed."""
    from paceline.reports.wording import MISSING, speed_words, verdict_words

    name = found.vehicle.id if found.vehicle is not None else MISSING
    when = f"{time.strftime('%H:%M:%S')}  {name:<5} {found.path:<8}"
    if measurement is None:
        return f"{when} {reason}"
    words = speed_words(measurement, unit)
    speed = f"{words.speed} ± {words.plus_minus} {unit}" if words.known else MISSING
    return f"{when} {speed}  {verdict_words(measurement)}"
