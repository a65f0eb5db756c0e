"""report.html of a following run: one self-contained page with the result and its explanation."""

from __future__ import annotations

from pathlib import Path

from paceline.follow.history import Episode, Tally
from paceline.follow.results import FollowResult
from paceline.number_format import NO_VALUE, format_half_width, format_number, format_uncertain
from paceline.path_following.steering_goal import SteeringGoal
from paceline.reports.common.html import flatten_settings, render
from paceline.reports.common.plots import Plot
from paceline.reports.follow.overlay import TargetStill
from paceline.reports.follow.tables import finite_quantile
from paceline.units import COVERAGE_95

MAX_LISTED_EPISODES = 50  # on the page; summary.json holds more
GOOD_TRACKED_SHARE = 0.95  # from which on no advice is given

# What each plot shows, in plain words.
PLOT_CAPTIONS = {
    "range": "Distance of the vehicle ahead, with its 95 % interval. In shaded intervals it was not tracked.",
    "bearing": "Direction to the vehicle, and the steering angle, where there is one; positive to the right.",
    "confidence": "How well each frame determines the target’s position and size; higher is better.",
    "residual": "RMS distance of the vehicle’s edges from the model’s lines.",
    "latency": "Time of each frame from its arrival to its estimate.",
}


STEERING_TEXTS: dict[SteeringGoal, str] = {
    "path": "along the path that the lead has driven, by odometry",
    "lead": "towards the lead itself and not along its path, so that it cuts the corner in bends",
    "none": "no angle, as asked",
}
ASSUMED_TEXTS = {
    "wheelbase": "wheelbase {:g} m",
    "camera_ahead": "camera {:g} m ahead of the rear axle",
    "lookahead": "lookahead {:g} s",
}


def describe_steering(result: FollowResult) -> str:
    """What the steering angle of a run is for, and what was assumed for it."""
    assumed = ", ".join(ASSUMED_TEXTS[key].format(value) for key, value in result.assumed.items())
    return STEERING_TEXTS[result.steering_goal] + (f"; assumed: {assumed}" if assumed else "")


def describe_width(result: FollowResult) -> str:
    """For example ``1.700 ± 0.050 m wide``, half of a 95 % interval, and whether that was assumed."""
    width = format_uncertain(result.width.metres, COVERAGE_95 * result.width.std)
    return f"{width} m wide" + (" (± assumed)" if result.width.assumed else "")


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
        typical=format_half_width(COVERAGE_95 * finite_quantile(result.position_std[tracking, 2])),
        duration=format_number(tally.stop - tally.start, 1),
        median=format_number(1e3 * finite_quantile(result.latency), 2),
        slowest=format_number(1e3 * finite_quantile(result.latency, 0.99), 2),
        advice=advice(tally),
        steering=describe_steering(result),
        width=describe_width(result),
        width_share=format_half_width(100 * COVERAGE_95 * result.width.std / result.width.metres),
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
    """``99.3 %``; 100 % only if every frame is tracked."""
    shown = 100 * share
    return f"{format_number(min(shown, 99.9) if shown < 100 else shown, 0 if shown in (0.0, 100.0) else 1)} %"


def advice(tally: Tally) -> str:
    """Advice where too few frames were tracked; empty otherwise."""
    if not tally.tracked:
        return (
            "Check the first frame of the overlay: do the model’s lines lie on the vehicle’s edges? If not, "
            "correct the start in follow.yaml, or learn a model from this recording with paceline target learn."
        )
    if tally.share < GOOD_TRACKED_SHARE:
        return (
            "Find the frames listed below in the overlay. A short occlusion is normal. If the lines drift off the "
            "vehicle without one, the model or the start does not fit it well enough."
        )
    return ""


def _episode_row(e: Episode) -> tuple[str, str, str, str, str]:
    frames = f"{e.first_frame}" if e.first_frame == e.last_frame else f"{e.first_frame} to {e.last_frame}"
    return frames, format_number(e.start, 2), format_number(e.stop, 2), e.status, e.reason
