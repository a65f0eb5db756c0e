"""Following as data: track.csv, written row by row, and summary.json, in SI units."""

from __future__ import annotations

import csv
from pathlib import Path
from types import TracebackType

import numpy as np

from paceline.follow.history import Tally
from paceline.follow.results import FollowEstimate, FollowResult
from paceline.reports.common.tables import format_cell, write_json

TRACK_COLUMNS = [
    "frame", "time_s", "cx", "cy", "scale", "w_x", "w_y", "w_scale", "x_m", "y_m", "z_m", "steering_rad", "status",
    "reason", "x_std_m", "y_std_m", "z_std_m", "bearing_rad", "residual_px", "latency_s",
]  # fmt: skip


class TrackTable:
    """track.csv, one row per frame, an empty cell where there is no number."""

    def __init__(self, file: Path) -> None:
        self._stream = file.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._stream, lineterminator="\n")
        self._writer.writerow(TRACK_COLUMNS)

    def add(self, e: FollowEstimate) -> None:
        numbers = [e.time, *e.center, e.scale, *e.weights, *e.position, e.steering]
        more = [*e.position_std, e.bearing, e.residual, e.latency]
        self._writer.writerow([e.frame, *map(format_cell, numbers), e.status, e.reason, *map(format_cell, more)])

    def __enter__(self) -> TrackTable:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()


def write_summary(result: FollowResult, tally: Tally, file: Path) -> None:
    """Writes summary.json: what was tracked, how far away, why not, the configuration and the versions."""
    tracking = np.array([status == "tracking" for status in result.status], bool)
    summary = {
        "clip": result.clip,
        "target": result.target,
        "width": {"value": result.width.metres, "std": result.width.std, "assumed": result.width.assumed},
        "frames": tally.frames,
        "tracked_share": tally.share,
        "status": {name: tally.status[name] for name in ("tracking", "coasting", "lost")},
        "reasons": dict(tally.reasons.most_common()),
        "episodes": [
            {
                "first_frame": e.first_frame, "last_frame": e.last_frame, "start_s": e.start, "stop_s": e.stop,
                "status": e.status, "reason": e.reason,
            }
            for e in tally.episodes
        ],
        "range_m": {
            "min": tally.range_min, "mean": tally.range_mean, "max": tally.range_max,
            "typical_std": finite_quantile(result.position_std[tracking, 2]),
        },
        "latency_s": {
            "median": finite_quantile(result.latency), "p99": finite_quantile(result.latency, 0.99),
            "max": tally.latency_max,
        },
        "steering": result.steering_goal,
        "assumed": result.assumed,
        "duration_s": tally.stop - tally.start,
        "notices": result.notices,
        "configuration": result.configuration,
        "versions": result.versions,
        "seconds": result.seconds,
    }  # fmt: skip
    write_json(summary, file)


def finite_quantile(values: np.ndarray, share: float = 0.5) -> float:
    """The median, or another quantile, of the finite ``values``; NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if len(known) else float("nan")
