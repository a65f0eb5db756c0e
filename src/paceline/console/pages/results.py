"""What came of a run, for people: verdicts and speeds, or where the vehicle ahead was."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from paceline.console.library import Library
from paceline.console.pages.charts import distance_chart, speed_chart
from paceline.console.pages.layout import moment
from paceline.console.routes import results_address
from paceline.console.runs.kinds import AHEAD, LIVE
from paceline.console.runs.results import (
    differences,
    files_of,
    picture_of,
    read_distance,
    read_followed,
    read_series,
    read_summary,
    vehicle_rows,
)
from paceline.console.runs.run_list import MEASURED, Run
from paceline.reports.common.formatting import format_number

VERDICT = """
<q-td :props="props">
  <span :class="['pl-badge', props.value === 'measured' ? 'pl-good' : 'pl-bad']">{{ props.value }}</span>
</q-td>
"""
COLUMNS = [
    {"name": name, "label": label, "field": name, "align": "left"}
    for name, label in (
        ("vehicle", "vehicle"), ("speed", "speed, {unit}"), ("interval", "95 % interval"), ("frames", "frames"),
        ("verdict", "verdict"), ("reason", "reason"),
    )
]  # fmt: skip
SEEN = {"name": "seen", "label": "seen, s", "field": "seen", "align": "left"}
ADVICE = {"name": "advice", "label": "what helps", "field": "advice", "align": "left"}
PAGE = 50  # rows
MOST = 1000  # rows; with ten times as many, all pages would wait for a second until they are sent
LATEST = 3  # vehicles whose pictures are shown; the report has more
COMPARE = Callable[[Any], None]


def links(library: Library, run: Run) -> None:
    """The run's name, and all that it has left behind."""
    with ui.element("div").classes("pl-row pl-wrap"):
        ui.label(f"Run {run.number}").classes("pl-subtitle")
        for name, words in files_of(library.runs.out(run)).items():
            address = results_address(run.clip, run.number, name)
            report = name.endswith(".html")
            ui.link(words, address if report else f"{address}?save=true", new_tab=report)


def speeds(library: Library, run: Run, runs: list[Run], unit: str, other: int | None, compare: COMPARE) -> None:
    """Verdicts, speeds and their course. Raises UnusableInput."""
    out = library.runs.out(run)
    summary, series = read_summary(out), read_series(out, growing=run.kind == LIVE)
    if run.kind == LIVE:
        passed(run, summary, unit)
    vehicle_table(summary["vehicles"], unit)
    if not summary["vehicles"]:
        ui.label("No vehicle was found.").classes("pl-reason")
    for notice in summary["notices"]:
        ui.label(f"Note: {notice}").classes("pl-fact")
    compared = None
    if (second := _other(runs, run, other, compare)) is not None:
        compared = read_series(library.runs.out(second), growing=second.kind == LIVE)
        rows = differences(summary["vehicles"], read_summary(library.runs.out(second))["vehicles"], unit)
        headings = {"vehicle": "vehicle", "first": f"run {run.number}", "second": f"run {second.number}",
                    "change": f"difference, {unit}"}  # fmt: skip
        table = ui.table(
            columns=[{"name": k, "label": v, "field": k, "align": "left"} for k, v in headings.items()],
            rows=rows, row_key="vehicle",
        )  # fmt: skip
        table.props("flat dense").classes("pl-table")
    if series:
        ui.label(f"Speed over time, {unit}, with the 95 % interval").classes("pl-fact")
        ui.echart(speed_chart(series, compared, unit)).classes("pl-chart")


def vehicle_table(vehicles: list[dict[str, Any]], unit: str, most: int = MOST) -> None:
    """A row for each of the last ``most`` vehicles; those of a live run with the time at which they were seen, the
    latest first."""
    if len(vehicles) > most:
        ui.label(f"The last {most} of {len(vehicles)} vehicles; the files have all of them.").classes("pl-fact")
        vehicles = vehicles[-most:]
    live = any("seen_from_s" in vehicle for vehicle in vehicles)
    rows = vehicle_rows(vehicles, unit)
    columns = [{**column, "label": column["label"].format(unit=unit)} for column in COLUMNS]
    if any(row["advice"] for row in rows):
        columns.append(ADVICE)
    if live:
        columns.insert(1, SEEN)
        for row, vehicle in zip(rows, vehicles, strict=True):
            row["seen"] = f"{vehicle['seen_from_s']:.1f} to {vehicle['seen_to_s']:.1f}"
        rows.reverse()
    pages = PAGE if len(rows) > PAGE else None
    table = ui.table(columns=columns, rows=rows, row_key="vehicle", pagination=pages)
    table.props("flat dense wrap-cells").classes("pl-table").add_slot("body-cell-verdict", VERDICT)


def passed(run: Run, summary: dict[str, Any], unit: str) -> None:
    """The pictures of the latest vehicles that a live run has measured, the last one first, and how many it could not
    measure."""
    if unmeasured := summary["unmeasured"]:
        more = "1 vehicle was" if len(unmeasured) == 1 else f"{len(unmeasured)} vehicles were"
        ui.label(f"{more} seen, but not measured: {unmeasured[-1]}").classes("pl-fact")
    rows = vehicle_rows(summary["vehicles"][-LATEST:], unit)
    with ui.element("div").classes("pl-passed"):
        for row in reversed(rows):
            name = row["vehicle"]
            with ui.element("figure"):
                picture = ui.element("img")
                picture.props["src"] = results_address(run.clip, run.number, picture_of(name))
                picture.props["alt"] = f"{name} in both views"
                speed = f"{row['speed']} {unit}" if row["verdict"] == "measured" else row["reason"]
                ui.label(f"{name}: {speed}").classes("pl-fact")


def ahead(library: Library, run: Run, runs: list[Run], other: int | None, compare: COMPARE) -> None:
    """Where the vehicle ahead was, and in which frames that is known. Raises UnusableInput."""
    out = library.runs.out(run)
    found = read_followed(out)
    series = read_distance(out, found["target"])
    counts = ", ".join(f"{count} {status}" for status, count in found["status"].items())
    ui.label(f"{found['target']}: tracked in {100 * found['share']:.0f} % of {found['frames']} frames ({counts})")
    if found["status"]["tracking"]:
        least, mean, most = (format_number(value, 1) for value in found["range"])
        ui.label(f"Distance ahead {least} to {most} m, {mean} m on average")
    for reason, count in found["reasons"].items():
        ui.label(f"In {count} {'frame' if count == 1 else 'frames'}: {reason}").classes("pl-fact")
    for notice in found["notices"]:
        ui.label(f"Note: {notice}").classes("pl-fact")
    second = _other(runs, run, other, compare)
    compared = None
    if second is not None:
        compared = read_distance(library.runs.out(second), found["target"])
    if any(s.time for s in series):
        ui.label("Distance over time, m, with the 95 % interval, where it is tracked").classes("pl-fact")
        ui.echart(distance_chart(series, compared)).classes("pl-chart")


def _other(runs: list[Run], run: Run, other: int | None, compare: COMPARE) -> Run | None:
    """The run to compare with, which a person may choose here."""
    alike = [r for r in runs if r.state == MEASURED and r != run and (r.kind == AHEAD) == (run.kind == AHEAD)]
    if not alike:
        return None
    names = {r.number: f"Run {r.number}, {moment(r)}" for r in alike}
    value = other if other in names else None
    ui.select({None: "no other run", **names}, value=value, label="Compare with", on_change=compare)
    return next((r for r in alike if r.number == other), None)
