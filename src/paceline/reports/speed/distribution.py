"""The distribution of the speeds of many vehicles: mean, 85th percentile, and what a sample says about traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.special import bdtr, stdtrit

from paceline.arrays import Array
from paceline.number_format import NO_VALUE, format_number, format_uncertain
from paceline.reports.common.plots import FILTER_COLOR, INK_COLOR, INTERVAL_COLOR, REFINED_COLOR, Plot, make_plot
from paceline.speed.results import CONFIDENCE_LEVEL
from paceline.units import convert

MANY_VEHICLES = 8  # more are shown as a table with their distribution
LIMIT_QUANTILE = 0.85  # of speeds, by which limits are set
MIN_UPPER_LIMIT_VEHICLES = 23  # the fewest of which one exceeds the percentile with 97.5 % probability


@dataclass(frozen=True)
class Distribution:
    """The speeds of a report as text in its unit, and their histogram."""

    vehicles: int
    mean: str
    percentile: str
    note: str
    plot: Plot


def describe_distribution(speeds: Array, unit: str, limit: float | None = None) -> Distribution | None:
    """The distribution of ``speeds`` (V,) m/s in ``unit``, with the posted ``limit`` (m/s) if all have one; None where
    they are too few to have one."""
    if len(speeds) <= MANY_VEHICLES:
        return None
    shown = convert(speeds, unit)
    mean = float(shown.mean())
    half = float(stdtrit(len(shown) - 1, 0.5 + CONFIDENCE_LEVEL / 2) * shown.std(ddof=1) / np.sqrt(len(shown)))
    percentile = float(np.quantile(shown, LIMIT_QUANTILE))
    limit_shown = None if limit is None else convert(limit, unit)
    plot = make_plot(
        "distribution",
        f"Histogram of {len(shown)} speeds",
        (9.4, 3.0),
        lambda figure: _draw(figure, shown, unit, {"mean": mean, "85th percentile": percentile}, limit_shown),
    )
    text = f"{format_number(percentile, 1)} {unit}"
    return Distribution(len(shown), f"{format_uncertain(mean, half)} {unit}", text, _note(shown, unit), plot)


def percentile_interval(values: Array, share: float, confidence: float) -> tuple[float, float]:
    """The interval that holds the ``share`` quantile of what ``values`` (V,) are a random sample of, with at least this
    ``confidence``, from order statistics; an end that so few values do not give is NaN."""
    ordered, count, tail = np.sort(values), len(values), (1 - confidence) / 2
    below = bdtr(np.arange(count), count, share)  # of at most k values below the quantile, k = 0 … V - 1
    lower, upper = np.flatnonzero(below <= tail), np.flatnonzero(below >= 1 - tail)
    return (
        float(ordered[lower[-1]]) if len(lower) else float("nan"),
        float(ordered[upper[0]]) if len(upper) else float("nan"),
    )


def _note(shown: Array, unit: str) -> str:
    """What the figures are worth."""
    lo, hi = (format_number(end, 1) for end in percentile_interval(shown, LIMIT_QUANTILE, CONFIDENCE_LEVEL))
    if hi != NO_VALUE:
        place = f"between {lo} and {hi} {unit}"
    elif lo != NO_VALUE:
        place = f"above {lo} {unit}; how far above, so few do not tell: that takes {MIN_UPPER_LIMIT_VEHICLES} or more"
    else:
        place = "anywhere: so few do not tell"
    return (
        f"{len(shown)} vehicles are a sample. With 95 % confidence the 85th percentile of the traffic that they are "
        f"drawn from lies {place}. Other hours and days, and errors that all speeds share, as of the calibration, are "
        "not in these figures."
    )


def _draw(figure: Figure, shown: Array, unit: str, marks: dict[str, float], limit: float | None) -> None:
    axes = figure.subplots()
    axes.hist(shown, bins="auto", color=FILTER_COLOR, edgecolor="none", rwidth=0.94)
    for (name, value), color in zip(marks.items(), (INTERVAL_COLOR, REFINED_COLOR), strict=True):
        axes.axvline(value, color=color, lw=2, label=name)
    if limit is not None:
        axes.axvline(limit, color=INK_COLOR, lw=1.2, ls=(0, (4, 2)), label="limit")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f"speed, {unit}")
    axes.set_ylabel("vehicles")
    figure.legend(loc="outside upper left", ncols=3, handlelength=1.6, columnspacing=1.6)
