"""report.html of a live survey: every vehicle with its speed, verdict and place, and pictures of the latest ones."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from paceline.reports.common.formatting import MISSING, number, shown_speed
from paceline.reports.common.html import flat, render
from paceline.reports.common.plots import Plot
from paceline.reports.speed.tables import numbers_of

Passage = dict[str, Any]  # of one vehicle, as summary.json has it


def live_page(summary: dict[str, Any], pictures: Path, kept: int, plot: Plot, unit: str) -> str:
    """The page for a ``summary`` as summary.json holds it; the folder ``pictures`` has those of the ``kept`` latest
    vehicles. Needs no other file and no network."""
    vehicles: Sequence[Passage] = summary["vehicles"]
    measured = [v for v in vehicles if v["verdict"] == "measured"]
    passages = sorted([*vehicles, *summary["unmeasured"]], key=lambda v: float(v["seen_from_s"]))
    speeds = numbers_of(measured, "speed_mps")
    return render(
        "live/page.html.j2",
        result=summary,
        unit=unit,
        vehicles=vehicles,
        measured=len(measured),
        unmeasured=len(summary["unmeasured"]),
        median=shown_speed(float(np.median(speeds)), unit) if len(speeds) else MISSING,
        period=_period(passages),
        rows=[_row(v, unit) for v in passages],
        pictures=_pictures(vehicles[-kept:], pictures, unit),
        kept=kept,
        plot=plot,
        settings=flat(summary["configuration"]),
        seconds=MISSING,
        missing=MISSING,
    )


def _period(passages: Sequence[Passage]) -> str:
    """From when to when vehicles were seen, for people."""
    if not passages:
        return ""
    first, last = (passages[k]["seen_at"] for k in (0, -1))
    until = last[11:19] if last[:10] == first[:10] else f"{last[:10]} {last[11:19]}"
    return f"{first[:10]}, {first[11:19]} to {until}"


def _row(passage: Passage, unit: str) -> dict[str, str]:
    x, z = passage["first_seen_m"]
    side = "right" if x >= 0 else "left"
    return {
        "name": passage.get("vehicle", MISSING),
        "at": passage["seen_at"][11:19],
        "seen": f"{passage['seen_from_s']:.1f} to {passage['seen_to_s']:.1f}",
        "path": passage["path"],
        "place": f"{number(z, 0)} m ahead, {number(abs(x), 1)} m {side}",
        **_speed(passage, unit),
        "verdict": passage.get("verdict", "not measured"),
        "reason": passage["reason"].removeprefix("not measured: "),
    }


def _speed(passage: Passage, unit: str) -> dict[str, str]:
    if passage.get("verdict") != "measured":
        return {"speed": MISSING, "interval": MISSING}
    speed, lo, hi = (float(passage[key]) for key in ("speed_mps", "speed_lo_mps", "speed_hi_mps"))
    half = (hi - lo) / 2
    shown = [shown_speed(value, unit, half) for value in (speed, half, lo, hi)]
    return {"speed": f"{shown[0]} ± {shown[1]}", "interval": f"{shown[2]} to {shown[3]}"}


def _pictures(vehicles: Sequence[Passage], folder: Path, unit: str) -> list[dict[str, Any]]:
    """The pictures of ``vehicles``, the latest first."""
    found = []
    for vehicle in reversed(vehicles):
        with suppress(OSError):  # somebody removed it
            row = _row(vehicle, unit)
            speed = row["verdict"] if row["speed"] == MISSING else f"{row['speed']} {unit}"
            words = f"{row['name']}, {row['at']}, {row['path']}: {speed}"
            found.append({"name": row["name"], "jpeg": (folder / f"{row['name']}.jpg").read_bytes(), "words": words})
    return found
