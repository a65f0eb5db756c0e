"""Speed over time as a chart that answers to the mouse."""

from __future__ import annotations

from typing import Any

from paceline.console.results import Series
from paceline.units import convert

COLORS = ("#2f6fb0", "#c2601f", "#3a8a57", "#8a4fa3", "#a8323e", "#3d8f99", "#857022", "#666f7a")


def speed_chart(series: list[Series], compared: list[Series] | None, unit: str) -> dict[str, Any]:
    """Options of the chart: a line and a band per vehicle, dashed lines for those of another run."""
    shown: list[dict[str, Any]] = []
    colors = {s.vehicle: COLORS[i % len(COLORS)] for i, s in enumerate(series)}
    for s in series:
        speed = [round(float(convert(v, unit)), 2) for v in s.speed]
        half = [round(float(convert(v, unit)), 3) for v in s.half]
        low = [[t, round(v - h, 3)] for t, v, h in zip(s.time, speed, half, strict=True)]
        band = [[t, round(2 * h, 3)] for t, h in zip(s.time, half, strict=True)]
        hidden = {"type": "line", "name": s.vehicle, "color": colors[s.vehicle], "stack": f"band {s.vehicle}",
                  "symbol": "none", "silent": True, "lineStyle": {"opacity": 0},
                  "tooltip": {"show": False}}  # fmt: skip
        shown.append({**hidden, "data": low})
        shown.append({**hidden, "data": band, "areaStyle": {"color": colors[s.vehicle], "opacity": 0.15}})
        line = [[t, v] for t, v in zip(s.time, speed, strict=True)]
        shown.append({"type": "line", "name": s.vehicle, "data": line, "color": colors[s.vehicle], "symbolSize": 5})
    for s in compared or []:
        line = [[t, round(float(convert(v, unit)), 2)] for t, v in zip(s.time, s.speed, strict=True)]
        color = colors.get(s.vehicle, "#888888")
        shown.append({"type": "line", "name": f"{s.vehicle}, other run", "data": line, "color": color,
                      "symbol": "none", "lineStyle": {"type": "dashed"}})  # fmt: skip
    axis = {"nameTextStyle": {"color": "#888888"}, "axisLabel": {"color": "#888888"}, "scale": True,
            "splitLine": {"lineStyle": {"color": "#88888833"}}}  # fmt: skip
    return {
        "animation": False,
        # drawn on the canvas: names of vehicles come from files and are never HTML
        "tooltip": {"trigger": "axis", "renderMode": "richText", "order": "valueDesc"},
        "legend": {"textStyle": {"color": "#888888"}, "type": "scroll", "top": 0, "right": 10},
        "grid": {"left": 60, "right": 24, "top": 44, "bottom": 48},
        "xAxis": {**axis, "type": "value", "name": "s", "nameLocation": "end"},
        "yAxis": {**axis, "type": "value", "name": unit},
        "dataZoom": [{"type": "inside"}],
        "series": shown,
    }
