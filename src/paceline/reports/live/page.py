"""report.html of a live run: a row for every vehicle, measured or not, and pictures of the latest ones."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from paceline.number_format import NO_VALUE, format_number
from paceline.reports.common.formatting import (
    align_for_page,
    count_compliance,
    format_speed,
    format_speed_number,
    recording_title,
    rejected_advice,
)
from paceline.reports.common.html import flatten_settings, render
from paceline.reports.common.plots import Plot
from paceline.reports.common.sortable_table import Cell, Column, SortableTable, text_column
from paceline.reports.speed.distribution import Distribution, describe_distribution
from paceline.reports.speed.tables import summary_column
from paceline.reports.speed.vehicle_table import limit_column
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
        title=recording_title(summary["clip"]),
        unit=unit,
        vehicles=vehicles,
        measured=len(measured),
        unmeasured=len(summary["unmeasured"]),
        median=format_speed_number(float(np.median(speeds)), unit) if len(speeds) else NO_VALUE,
        compliance=count_compliance(v["compliance"] for v in vehicles),
        period=_format_period(passages),
        table=_table(passages, unit) if passages else None,
        distribution=_distribution(measured, unit),
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


def _table(passages: Sequence[Passage], unit: str) -> SortableTable:
    """A row for each vehicle."""
    rows = [_passage_row(passage, unit) for passage in passages]
    texts = {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}
    speeds, ends = align_for_page(texts["speed"]), align_for_page(texts["interval"])
    known = [p["speed_mps"] if p.get("verdict") == "measured" else None for p in passages]
    moments = [float(passage["seen_from_s"]) for passage in passages]
    columns = [
        Column("vehicle", "vehicle", [Cell(name) for name in texts["name"]], range(len(rows))),
        text_column("speed", f"speed, {unit}", speeds, known),
        Column("interval", "95 % interval", [Cell(text) for text in ends]),
        text_column("at", "at", texts["at"], moments),
        Column("seen", "in view, s", [Cell(text) for text in texts["seen"]]),
        text_column("path", "path", texts["path"]),
        text_column("direction", "direction", texts["travel"]),
        text_column("verdict", "verdict", texts["verdict"]),
        Column("place", "first seen", [Cell(text) for text in texts["place"]]),
    ]
    columns[3:3] = limit_column([(p.get("compliance"), p.get("limit_mps")) for p in passages], unit)
    return SortableTable(
        columns, [f"{row['reason']}. {row['advice']}".strip() if row["reason"] else "" for row in rows]
    )


def _distribution(measured: Sequence[Passage], unit: str) -> Distribution | None:
    limits = {vehicle["limit_mps"] for vehicle in measured}
    return describe_distribution(
        summary_column(measured, "speed_mps"), unit, limits.pop() if len(limits) == 1 else None
    )


def _passage_row(passage: Passage, unit: str) -> dict[str, str]:
    x, z = passage["first_seen_m"]
    side = "right" if x >= 0 else "left"
    return {
        "name": passage.get("vehicle", NO_VALUE),
        "at": passage["seen_at"][11:19],
        "seen": f"{passage['seen_from_s']:.1f} to {passage['seen_to_s']:.1f}",
        "path": passage["path"],
        "travel": passage.get("travel") or NO_VALUE,
        "place": f"{format_number(z, 0)} m ahead, {format_number(abs(x), 1)} m {side}",
        **_speed_columns(passage, unit),
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
