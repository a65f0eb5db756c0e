"""Interactive charts of values over time, as ECharts options."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from typing import Any

from paceline.console.runs.results import Series
from paceline.number_format import significant_decimals
from paceline.units import convert

SERIES_COLORS = ("#2f6fb0", "#c2601f", "#3a8a57", "#8a4fa3", "#a8323e", "#3d8f99", "#857022", "#666f7a")

AXIS_HALF_WIDTHS = 4.0  # the least height of the axis, in half-widths of the intervals: less would magnify noise
AXIS_MARGIN = 0.05  # beyond the values, as a share of their range
UNKNOWN_HALF_WIDTH_SHARE = 0.005  # taken as the half-width, as a share of the value, where there is none
MAX_DOTTED_VALUES = 100  # values of a series that is drawn with dots


def speed_chart(series: list[Series], compared: list[Series] | None, unit: str) -> dict[str, Any]:
    """Options of a chart of speeds in ``unit``, dashed for those ``compared``."""
    return _chart(series, compared, unit, lambda v: float(convert(v, unit)))


def distance_chart(series: list[Series], compared: list[Series] | None) -> dict[str, Any]:
    """Options of a chart of distances ahead, m."""
    return _chart(series, compared, "m", lambda v: v)


def _chart(
    series: list[Series], compared: list[Series] | None, unit: str, to_unit: Callable[[float], float]
) -> dict[str, Any]:
    """A line and a band per vehicle, dashed lines for those of another run."""
    chart_series: list[dict[str, Any]] = []
    colors = {s.vehicle: SERIES_COLORS[i % len(SERIES_COLORS)] for i, s in enumerate(series)}
    for s in series:
        value, half = [to_unit(v) for v in s.value], [to_unit(v) for v in s.half]
        low = [[t, v - h] for t, v, h in zip(s.time, value, half, strict=True)]
        band = [[t, 2 * h] for t, h in zip(s.time, half, strict=True)]
        hidden = {"type": "line", "name": s.vehicle, "color": colors[s.vehicle], "stack": f"band {s.vehicle}",
                  "symbol": "none", "silent": True, "lineStyle": {"opacity": 0},
                  "tooltip": {"show": False}}  # fmt: skip
        chart_series.append({**hidden, "data": low})
        chart_series.append({**hidden, "data": band, "areaStyle": {"color": colors[s.vehicle], "opacity": 0.15}})
        line = [[t, v] for t, v in zip(s.time, value, strict=True)]
        visible = {"type": "line", "name": s.vehicle, "color": colors[s.vehicle]}
        chart_series.append({**visible, "data": line, "symbolSize": 5 if len(line) < MAX_DOTTED_VALUES else 0})
    for s in compared or []:
        line = [[t, to_unit(v)] for t, v in zip(s.time, s.value, strict=True)]
        color = colors.get(s.vehicle, "#888888")
        chart_series.append({"type": "line", "name": f"{s.vehicle}, other run", "data": line, "color": color,
                      "symbol": "none", "lineStyle": {"type": "dashed"}})  # fmt: skip
    half_width = max((to_unit(_typical_half_width(s)) for s in series if s.value), default=1.0)
    labels = {"color": "#888888"}
    axis: dict[str, Any] = {"nameTextStyle": {"color": "#888888"}, "scale": True,
            "axisLabel": labels,
            "splitLine": {"lineStyle": {"color": "#88888833"}}}  # fmt: skip
    return {
        "animation": False,
        # drawn on the canvas: names of vehicles come from files and are never HTML
        "tooltip": {
            "trigger": "axis",
            "renderMode": "richText",
            "order": "valueDesc",
            ":valueFormatter": f"v => Number(v).toFixed({significant_decimals(half_width)})",
        },
        "legend": {"textStyle": {"color": "#888888"}, "type": "scroll", "top": 0, "right": 10},
        "grid": {"left": 60, "right": 24, "top": 44, "bottom": 48},
        "xAxis": {**axis, "type": "value", "name": "s", "nameLocation": "end"},
        "yAxis": {
            **axis,
            **_value_axis(AXIS_HALF_WIDTHS * half_width),
            "type": "value",
            "name": unit,
            "axisLabel": {**labels, "showMinLabel": False, "showMaxLabel": False},
        },
        "dataZoom": [{"type": "inside"}],
        "series": chart_series,
    }


def _typical_half_width(series: Series) -> float:
    """The median half-width of a series with values, or UNKNOWN_HALF_WIDTH_SHARE of the median value."""
    return median(series.half) or UNKNOWN_HALF_WIDTH_SHARE * abs(median(series.value))


def _value_axis(least_span: float) -> dict[str, Any]:
    """The limits of the axis of values: it holds all visible ones with a margin, and is at least ``least_span``
    high."""
    half = f"Math.max({least_span / 2}, (v.max - v.min) * {0.5 + AXIS_MARGIN})"  # in JavaScript
    return {":min": f"v => (v.min + v.max) / 2 - {half}", ":max": f"v => (v.min + v.max) / 2 + {half}"}
