"""Shows the results of a run: verdicts and speeds, or the distance of the vehicle ahead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from urllib.parse import quote

from nicegui import ui

from paceline.console.library import Library
from paceline.console.pages.charts import distance_chart, speed_chart
from paceline.console.pages.layout import format_created
from paceline.console.routes import result_address
from paceline.console.runs.kinds import FOLLOW_RUN, LIVE_RUN
from paceline.console.runs.results import (
    compare_summaries,
    has_outlines,
    picture_name,
    picture_stem,
    read_follow_summary,
    read_range_series,
    read_series,
    read_summary,
    result_files,
    vehicle_rows,
)
from paceline.console.runs.run_queue import STATE_MEASURED, Run
from paceline.number_format import format_number
from paceline.reports.common.formatting import interval_title
from paceline.reports.speed.tables import OUTLINES_FOLDER

VERDICT_TEMPLATE = """
<q-td :props="props">
  <span :class="['pl-badge', props.value === 'measured' ? 'pl-good' : 'pl-bad']">{{ props.value }}</span>
</q-td>
"""
PICTURE_TEMPLATE = """
<q-td :props="props">
  <img v-if="props.value" :src="props.value" :alt="props.row.vehicle" class="pl-thumbnail" loading="lazy">
</q-td>
"""
TABLE_COLUMNS = [
    {"name": name, "label": label, "field": name, "align": "left"}
    for name, label in (
        ("vehicle", "vehicle"), ("speed", "speed, {unit}"), ("interval", "{interval}"), ("lane", "lane"),
        ("travel", "direction"), ("seen", "seen, s"), ("verdict", "verdict"),
    )
]  # fmt: skip
PICTURE_COLUMN = {"name": "picture", "label": "picture", "field": "picture", "align": "left"}
LIMIT_COLUMN = {"name": "limit", "label": "limit", "field": "limit", "align": "left"}
REASON_COLUMN = {"name": "reason", "label": "reason", "field": "reason", "align": "left"}
UNBROKEN_COLUMNS = ("speed", "interval", "limit", "seen")  # numbers that stay on one line
ADVICE_COLUMN = {"name": "advice", "label": "advice", "field": "advice", "align": "left"}
ROWS_PER_PAGE = 50
MAX_ROWS = 1000  # rows of a table; ten times as many would block all pages for a second
MAX_OUTLINED_VEHICLES = 12  # whose outlines are on the page; the report has all
OUTLINES_TEXT = (
    "Does the outline stay on the same part of the vehicle? First, middle and last frame measured, the left view above "
    "the right one:"
)
MAX_RECENT_PICTURES = 3  # vehicles with a picture on the page; the report has more
CompareHandler = Callable[[Any], None]


def show_links(library: Library, run: Run) -> None:
    """Shows the run's name and links to its files."""
    with ui.element("div").classes("pl-row pl-wrap"):
        ui.label(f"Run {run.number}").classes("pl-subtitle")
        for name, text in result_files(library.runs.output_folder(run)).items():
            address = result_address(run.clip, run.number, name)
            report = name.endswith(".html")
            ui.link(text, address if report else f"{address}?save=true", new_tab=report)


def show_speeds(
    library: Library, run: Run, runs: list[Run], unit: str, other: int | None, compare: CompareHandler
) -> None:
    """Shows verdicts, and speeds over time. Raises UnusableInput."""
    out = library.runs.output_folder(run)
    summary, series = read_summary(out), read_series(out, growing=run.kind == LIVE_RUN)
    if run.kind == LIVE_RUN:
        show_recent_vehicles(run, summary, unit)
    else:
        show_outlines(library, run, summary["vehicles"], unit)
    show_vehicle_table(run, summary["vehicles"], unit)
    if not summary["vehicles"]:
        ui.label("No vehicle was detected.").classes("pl-reason")
    for notice in summary["notices"]:
        ui.label(f"Note: {notice}").classes("pl-fact")
    compared = None
    if (second := _choose_comparison(runs, run, other, compare)) is not None:
        compared = read_series(library.runs.output_folder(second), growing=second.kind == LIVE_RUN)
        rows = compare_summaries(
            summary["vehicles"], read_summary(library.runs.output_folder(second))["vehicles"], unit
        )
        headings = {"vehicle": "vehicle", "first": f"run {run.number}", "second": f"run {second.number}",
                    "change": f"difference, {unit}"}  # fmt: skip
        table = ui.table(
            columns=[{"name": k, "label": v, "field": k, "align": "left"} for k, v in headings.items()],
            rows=rows, row_key="vehicle",
        )  # fmt: skip
        table.props("flat dense").classes("pl-table")
    if series:
        interval = interval_title(vehicle.get("interval_from") for vehicle in summary["vehicles"])
        ui.label(f"Speed over time, {unit}, with the {interval}").classes("pl-fact")
        ui.echart(speed_chart(series, compared, unit)).classes("pl-chart")


def show_vehicle_table(run: Run, vehicles: list[dict[str, Any]], unit: str, max_rows: int = MAX_ROWS) -> None:
    """Shows a row for each of the last ``max_rows`` vehicles of a ``run``; of a live one latest first."""
    if len(vehicles) > max_rows:
        ui.label(f"The last {max_rows} of {len(vehicles)} vehicles; the files hold all of them.").classes("pl-fact")
        vehicles = vehicles[-max_rows:]
    rows = vehicle_rows(vehicles, unit)
    interval = interval_title(vehicle.get("interval_from") for vehicle in vehicles)
    columns = [{**column, "label": column["label"].format(unit=unit, interval=interval)} for column in TABLE_COLUMNS]
    if any(vehicle.get("limit_mps") is not None for vehicle in vehicles):
        columns.insert(3, LIMIT_COLUMN)
    if any(row["reason"] for row in rows):
        columns.append(REASON_COLUMN)
    if any(row["advice"] for row in rows):
        columns.append(ADVICE_COLUMN)
    stems = [picture_stem(vehicle) for vehicle in vehicles]
    if any(stems):
        columns.insert(1, PICTURE_COLUMN)
        for row, stem in zip(rows, stems, strict=True):
            row["picture"] = "" if stem is None else result_address(run.clip, run.number, quote(picture_name(stem)))
    if run.kind == LIVE_RUN:
        rows.reverse()
    columns = [
        {**column, "style": "white-space: nowrap"} if column["name"] in UNBROKEN_COLUMNS else column
        for column in columns
    ]
    pages = ROWS_PER_PAGE if len(rows) > ROWS_PER_PAGE else None
    table = ui.table(columns=columns, rows=rows, row_key="vehicle", pagination=pages)
    table.props("flat dense wrap-cells").classes("pl-table").add_slot("body-cell-verdict", VERDICT_TEMPLATE)
    table.add_slot("body-cell-picture", PICTURE_TEMPLATE)


def show_recent_vehicles(run: Run, summary: dict[str, Any], unit: str) -> None:
    """Shows the pictures of the latest vehicles that a live run has measured, latest first, and how many it could not
    measure."""
    if unmeasured := summary["unmeasured"]:
        more = "1 vehicle was" if len(unmeasured) == 1 else f"{len(unmeasured)} vehicles were"
        ui.label(f"{more} seen, but not measured: {unmeasured[-1]}").classes("pl-fact")
    rows = vehicle_rows(summary["vehicles"][-MAX_RECENT_PICTURES:], unit)
    with ui.element("div").classes("pl-recent"):
        for row in reversed(rows):
            _show_figure(run, picture_name(row["vehicle"]), row, unit)


def show_outlines(library: Library, run: Run, vehicles: list[dict[str, Any]], unit: str) -> None:
    """Shows the outlines of the first vehicles of a ``run``, where it has written them."""
    out = library.runs.output_folder(run)
    outlined = [v for v in vehicles if (stem := picture_stem(v)) is not None and has_outlines(out, stem)]
    if not outlined:
        return
    shown = outlined[:MAX_OUTLINED_VEHICLES]
    more = "" if len(shown) == len(outlined) else f" (of {len(shown)} of {len(outlined)} vehicles; the report has all)"
    ui.label(OUTLINES_TEXT + more).classes("pl-fact")
    with ui.element("div").classes("pl-outlines"):
        for vehicle, row in zip(shown, vehicle_rows(shown, unit), strict=True):
            _show_figure(run, picture_name(str(picture_stem(vehicle)), OUTLINES_FOLDER), row, unit)


def _show_figure(run: Run, name: str, row: dict[str, str], unit: str) -> None:
    """Shows the picture ``name`` of the vehicle of a ``row``, with its speed."""
    with ui.element("figure"):
        picture = ui.element("img")
        picture.props["src"] = result_address(run.clip, run.number, quote(name))
        picture.props["alt"] = f"{row['vehicle']} in both views"
        speed = f"{row['speed']} {unit}" if row["verdict"] == "measured" else row["reason"]
        ui.label(f"{row['vehicle']}: {speed}").classes("pl-fact")


def show_range(library: Library, run: Run, runs: list[Run], other: int | None, compare: CompareHandler) -> None:
    """Shows the distance of the vehicle ahead, and in how many frames it was tracked. Raises UnusableInput."""
    out = library.runs.output_folder(run)
    summary = read_follow_summary(out)
    series = read_range_series(out, summary["target"])
    counts = ", ".join(f"{count} {status}" for status, count in summary["status"].items())
    ui.label(f"{summary['target']}: tracked in {100 * summary['share']:.0f} % of {summary['frames']} frames ({counts})")
    if summary["status"]["tracking"]:
        minimum, mean, maximum = (format_number(value, 1) for value in summary["range"])
        ui.label(f"Distance ahead {minimum} to {maximum} m, {mean} m on average")
    for reason, count in summary["reasons"].items():
        ui.label(f"In {count} {'frame' if count == 1 else 'frames'}: {reason}").classes("pl-fact")
    for notice in summary["notices"]:
        ui.label(f"Note: {notice}").classes("pl-fact")
    second = _choose_comparison(runs, run, other, compare)
    compared = None
    if second is not None:
        compared = read_range_series(library.runs.output_folder(second), summary["target"])
    if any(s.time for s in series):
        ui.label("Distance over time, m, with the 95 % interval, where the vehicle was tracked").classes("pl-fact")
        ui.echart(distance_chart(series, compared)).classes("pl-chart")


def _choose_comparison(runs: list[Run], run: Run, other: int | None, compare: CompareHandler) -> Run | None:
    """Shows a choice of runs to compare with; returns the chosen one."""
    comparable = [
        r for r in runs if r.state == STATE_MEASURED and r != run and (r.kind == FOLLOW_RUN) == (run.kind == FOLLOW_RUN)
    ]
    if not comparable:
        return None
    names = {r.number: f"Run {r.number}, {format_created(r)}" for r in comparable}
    value = other if other in names else None
    ui.select({None: "no other run", **names}, value=value, label="Compare with", on_change=compare)
    return next((r for r in comparable if r.number == other), None)
