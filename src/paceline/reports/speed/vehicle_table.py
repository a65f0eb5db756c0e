"""The table of a report of many vehicles: a row for each, with its lane, direction, time and picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from paceline.number_format import NO_VALUE
from paceline.reports.common.formatting import (
    INTERVAL_LIMITATIONS,
    align_for_page,
    format_compliance,
    format_limit,
    format_measurement,
    format_seen,
    interval_title,
)
from paceline.reports.common.sortable_table import Cell, Column, SortableTable, text_column
from paceline.reports.speed.overlay import StereoStill, middle_still
from paceline.speed.results import Measurement


def vehicle_table(
    measurements: Sequence[Measurement], stills: Mapping[str, Sequence[StereoStill]], unit: str
) -> SortableTable:
    """A row for each vehicle, linked to its section; those that are rejected have no speed."""
    texts = [format_measurement(m, unit) if m.verdict == "measured" else None for m in measurements]
    known = [m.speed if m.verdict == "measured" else None for m in measurements]
    speeds = align_for_page([NO_VALUE if text is None else str(text) for text in texts])
    ends = align_for_page([NO_VALUE if text is None else text.ends for text in texts])
    since = [None if m.seen is None else m.seen[0] for m in measurements]
    names = [Cell(m.vehicle, link=f"#{section_anchor(i)}") for i, m in enumerate(measurements)]
    pictures = [Cell(m.vehicle, picture=identifying_picture(stills[m.vehicle])) for m in measurements]
    columns = [
        Column("vehicle", "vehicle", names, range(len(names))),
        Column("picture", "picture", pictures),
        text_column("speed", f"speed, {unit}", speeds, known),
        Column("interval", interval_title(m.interval_from for m in measurements), [Cell(text) for text in ends]),
        text_column("lane", "lane", [m.path or NO_VALUE for m in measurements]),
        text_column("direction", "direction", [m.travel or NO_VALUE for m in measurements]),
        text_column("seen", "seen, s", [format_seen(m.seen) for m in measurements], since),
        text_column("verdict", "verdict", [m.verdict for m in measurements]),
    ]
    columns[4:4] = limit_column([(m.compliance, m.limit) for m in measurements], unit)
    limitations = [INTERVAL_LIMITATIONS.get(m.interval_from or "", "") for m in measurements]
    return SortableTable(columns, [m.reason or text for m, text in zip(measurements, limitations, strict=True)])


def limit_column(compliance: Sequence[tuple[str | None, float | None]], unit: str) -> list[Column]:
    """A column with the compliance of each vehicle with its limit (m/s), which the title names if it is one for all;
    none without a limit."""
    limits = {limit for _, limit in compliance if limit is not None}
    if not limits:
        return []
    if len(limits) > 1:
        return [text_column("limit", "limit", [format_compliance(*vehicle, unit) for vehicle in compliance])]
    title = f"limit {format_limit(limits.pop(), unit)}"
    return [text_column("limit", title, [kind or NO_VALUE for kind, _ in compliance])]


def section_anchor(place: int) -> str:
    """The address on the page of the vehicle at this ``place``; its name may hold any characters."""
    return f"vehicle-{place}"


def identifying_picture(stills: Sequence[StereoStill]) -> bytes | None:
    """The picture by which a vehicle is recognised, as JPEG; None where it was not tracked."""
    return middle_still(stills).left if stills else None
