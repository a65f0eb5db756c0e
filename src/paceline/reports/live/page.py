"""report.html of a live run: a row for every vehicle, measured or not, and pictures of the latest ones."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from paceline.reports.common.formatting import (
    NO_VALUE,
    align_for_page,
    count_compliance,
    format_compliance,
    format_number,
    format_speed,
    format_speed_number,
    rejected_advice,
)
from paceline.reports.common.html import flatten_settings, render
from paceline.reports.common.plots import Plot
from paceline.reports.speed.tables import summary_column
from paceline.verdicts import advice_for

Passage = dict[str, Any]  # of one vehicle, as summary.json has it


def render_live_page(summary: dict[str, Any], pictures: Path, max_pictures: int, plot: Plot, unit: str) -> str:
    """The page for a ``summary`` as summary.json holds it; the folder ``pictures`` has those of the latest
    ``max_pictures`` vehicles. Needs no other file and no network."""
    vehicles: Sequence[Passage] = summary["vehicles"]
    measured = [v for v in vehicles if v["verdict"] == "measured"]
    passages = sorted([*vehicles, *summary["unmeasured"]], key=lambda v: float(v["seen_from_s"]))
    speeds = summary_column(measured, "speed_mps")
    return render(
        "live/page.html.j2",
        result=summary,
        unit=unit,
        vehicles=vehicles,
        measured=len(measured),
        unmeasured=len(summary["unmeasured"]),
        median=format_speed_number(float(np.median(speeds)), unit) if len(speeds) else NO_VALUE,
        compliance=count_compliance(v["compliance"] for v in vehicles),
        limits=any(v["limit_mps"] is not None for v in vehicles),
        period=_format_period(passages),
        rows=_passage_rows(passages, unit),
        pictures=_pictures(vehicles[-max_pictures:], pictures, unit),
        kept=max_pictures,
        plot=plot,
        settings=flatten_settings(summary["configuration"]),
        seconds=NO_VALUE,
        missing=NO_VALUE,
    )


def _format_period(passages: Sequence[Passage]) -> str:
    """The period in which vehicles were seen."""
    if not passages:
        return ""
    first, last = (passages[k]["seen_at"] for k in (0, -1))
    end = last[11:19] if last[:10] == first[:10] else f"{last[:10]} {last[11:19]}"
    return f"{first[:10]}, {first[11:19]} to {end}"


def _passage_rows(passages: Sequence[Passage], unit: str) -> list[dict[str, str]]:
    """The rows of the table, their numbers aligned."""
    rows = [_passage_row(v, unit) for v in passages]
    for key in ("speed", "interval"):
        for row, text in zip(rows, align_for_page([row[key] for row in rows]), strict=True):
            row[key] = text
    return rows


def _passage_row(passage: Passage, unit: str) -> dict[str, str]:
    x, z = passage["first_seen_m"]
    side = "right" if x >= 0 else "left"
    return {
        "name": passage.get("vehicle", NO_VALUE),
        "at": passage["seen_at"][11:19],
        "seen": f"{passage['seen_from_s']:.1f} to {passage['seen_to_s']:.1f}",
        "path": passage["path"],
        "place": f"{format_number(z, 0)} m ahead, {format_number(abs(x), 1)} m {side}",
        **_speed_columns(passage, unit),
        "compliance": format_compliance(passage.get("compliance"), passage.get("limit_mps"), unit),
        "verdict": passage.get("verdict", "not measured"),
        "reason": passage["reason"],
        "advice": _advice(passage),
    }


def _advice(passage: Passage) -> str:
    """The advice where there is no speed; empty where there is one."""
    verdict, code = passage.get("verdict"), passage["reason_code"]
    if verdict == "rejected":
        return rejected_advice(code)
    return "" if verdict == "measured" else advice_for(code)


def _speed_columns(passage: Passage, unit: str) -> dict[str, str]:
    if passage.get("verdict") != "measured":
        return {"speed": NO_VALUE, "interval": NO_VALUE}
    speed, lo, hi = (float(passage[key]) for key in ("speed_mps", "speed_lo_mps", "speed_hi_mps"))
    text = format_speed(speed, lo, hi, unit)
    return {"speed": str(text), "interval": text.ends}


def _pictures(vehicles: Sequence[Passage], folder: Path, unit: str) -> list[dict[str, Any]]:
    """The pictures of ``vehicles``, latest first."""
    pictures_data = []
    for vehicle in reversed(vehicles):
        with suppress(OSError):  # it has been removed
            row = _passage_row(vehicle, unit)
            speed = row["verdict"] if row["speed"] == NO_VALUE else f"{row['speed']} {unit}"
            caption = f"{row['name']}, {row['at']}, {row['path']}: {speed}"
            pictures_data.append(
                {"name": row["name"], "jpeg": (folder / f"{row['name']}.jpg").read_bytes(), "caption": caption}
            )
    return pictures_data
