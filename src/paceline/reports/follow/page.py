"""report.html of a following run: one self-contained page that explains the result to anyone."""

from __future__ import annotations

from pathlib import Path

from paceline.follow.history import Episode, Tally
from paceline.follow.results import FollowResult
from paceline.reports.common.formatting import NO_VALUE, format_number
from paceline.reports.common.html import flatten_settings, render
from paceline.reports.common.plots import Plot
from paceline.reports.follow.overlay import TargetStill
from paceline.reports.follow.tables import finite_quantile
from paceline.units import COVERAGE_95

MAX_LISTED_EPISODES = 50  # episodes listed on the page; summary.json holds more
GOOD_TRACKED_SHARE = 0.95  # share of frames tracked from which no advice is given

# What each plot shows, for someone who has never seen one.
PLOT_CAPTIONS = {
    "range": "How far ahead the vehicle is. The band is the 95 % interval; shaded stretches were not tracked.",
    "bearing": "The direction to the vehicle, and the steering angle that would follow its path; to the right is up.",
    "confidence": "How firmly each frame fixes the target’s place across and down the picture and its size; higher is "
    "better.",
    "residual": "How far the vehicle’s edges lie from the model’s lines on average; a sudden rise means trouble.",
    "latency": "How long each frame took from its arrival to its estimate.",
}


def write_follow_page(
    result: FollowResult, tally: Tally, file: Path, *, plots: list[Plot], stills: list[TargetStill], overlay: bool
) -> None:
    """Writes the page. Needs no other file and no network; ``overlay`` says whether there is a video to link to."""
    tracking = [status == "tracking" for status in result.status]
    text = render(
        "follow/page.html.j2",
        result=result,
        tally=tally,
        overlay=overlay,
        share=format_percent(tally.share),
        nearest=format_number(tally.range_min, 1),
        farthest=format_number(tally.range_max, 1),
        mean=format_number(tally.range_mean, 1),
        typical=format_number(COVERAGE_95 * finite_quantile(result.position_std[tracking, 2]), 2),
        duration=format_number(tally.stop - tally.start, 1),
        median=format_number(1e3 * finite_quantile(result.latency), 2),
        slowest=format_number(1e3 * finite_quantile(result.latency, 0.99), 2),
        advice=advice(tally),
        episodes=[_episode_row(e) for e in tally.episodes[:MAX_LISTED_EPISODES]],
        unlisted=tally.episode_count - min(MAX_LISTED_EPISODES, len(tally.episodes)),
        reasons=tally.reasons.most_common(),
        plots=[(plot, PLOT_CAPTIONS[plot.name]) for plot in plots],
        stills=stills,
        settings=flatten_settings(result.configuration),
        seconds=format_number(result.seconds, 1),
        missing=NO_VALUE,
    )
    file.write_text(text, encoding="utf-8")


def format_percent(share: float) -> str:
    """``99.3 %``; 100 % only when nothing is missing."""
    shown = 100 * share
    return f"{format_number(min(shown, 99.9) if shown < 100 else shown, 0 if shown in (0.0, 100.0) else 1)} %"


def advice(tally: Tally) -> str:
    """What the person can do where too little was tracked; empty where nothing needs to be done."""
    if not tally.tracked:
        return (
            "Look at the first picture of the overlay: do the model’s lines lie on the vehicle’s edges? If not, "
            "correct the start in follow.yaml, or learn a model from this recording with paceline target learn."
        )
    if tally.share < GOOD_TRACKED_SHARE:
        return (
            "Find the moments listed below in the overlay. Something in front of the vehicle is normal and passes. If "
            "the lines slide off the vehicle by themselves, the model or the start does not fit it well enough."
        )
    return ""


def _episode_row(e: Episode) -> tuple[str, str, str, str, str]:
    frames = f"{e.first_frame}" if e.first_frame == e.last_frame else f"{e.first_frame} to {e.last_frame}"
    return frames, format_number(e.start, 2), format_number(e.stop, 2), e.status, e.reason
