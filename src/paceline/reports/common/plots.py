"""Makes plots in one style, as PNG and as SVG for light and dark pages."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib
from matplotlib.figure import Figure

# Colours that colour-blind readers can distinguish, after Okabe and Ito.
INK_COLOR, MUTED_COLOR, GRID_COLOR = "#1f2933", "#66727f", "#dfe4ea"
FILTER_COLOR, REFINED_COLOR, INTERVAL_COLOR = "#5b8db8", "#c2500a", "#e8a33d"
VEHICLE_COLORS = [
    "#2b83c6",
    "#dd6b10",
    "#129b72",
    "#c66aa3",
    "#c99700",
    "#5fb0dd",
]  # on white, black and pictures alike
# of lanes, apart from those of vehicles
LANE_COLORS = ["#8f6ae0", "#8aa321", "#b0683c", "#d1495b", "#2aa5a0", "#8592a0"]
# The same colours on dark pages.
DARK_THEME = {
    INK_COLOR: "#e6eaee",
    MUTED_COLOR: "#9aa6b2",
    GRID_COLOR: "#39424c",
    FILTER_COLOR: "#7fb2dd",
    REFINED_COLOR: "#ff9a57",
    INTERVAL_COLOR: "#e8b04f",
}

PLOT_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 9,
    "text.color": INK_COLOR,
    "axes.edgecolor": MUTED_COLOR,
    "axes.labelcolor": INK_COLOR,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": GRID_COLOR,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED_COLOR,
    "ytick.color": MUTED_COLOR,
    "xtick.labelcolor": INK_COLOR,
    "ytick.labelcolor": INK_COLOR,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.solid_capstyle": "round",
    "text.parse_math": False,  # a vehicle may be called $1
    "svg.fonttype": "none",
    "svg.hashsalt": "paceline",  # the same result gives the same file
}


@dataclass(frozen=True)
class Plot:
    """One plot: ``png`` for a file, ``svg`` for the page (light and dark)."""

    name: str
    description: str
    png: bytes
    svg: str


def make_plot(name: str, description: str, size: tuple[float, float], draw: Callable[[Figure], None]) -> Plot:
    """The plot that ``draw`` makes on a figure of ``size`` (inches), in PLOT_STYLE."""
    with matplotlib.rc_context(PLOT_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        png, svg = io.BytesIO(), io.StringIO()
        figure.savefig(png, format="png", dpi=140, facecolor="white", metadata={"Software": None})
        figure.set_layout_engine("none")  # computing the layout again would cost as much as drawing
        figure.savefig(svg, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return Plot(name, description, png.getvalue(), _themed(svg.getvalue()))


def lane_color(index: int) -> str:
    """The colour of a lane by its place among the paths, the same in plots, pictures and text."""
    return LANE_COLORS[index % len(LANE_COLORS)]


def _themed(svg: str) -> str:
    """``svg`` with colours as CSS variables that follow the reader's light or dark setting."""
    names = {color: f"--c{i}" for i, color in enumerate(DARK_THEME)}
    svg = re.sub("|".join(DARK_THEME), lambda found: f"var({names[found[0]]})", svg)
    light = ";".join(f"{names[color]}:{color}" for color in DARK_THEME)
    dark = ";".join(f"{names[color]}:{other}" for color, other in DARK_THEME.items())
    style = f"<style>:root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}</style>"
    head = re.search(r"<svg[^>]*>", svg)
    assert head is not None
    return svg[head.start() : head.end()] + style + svg[head.end() :]
