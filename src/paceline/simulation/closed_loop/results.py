"""The results of a drive: rows for its plots, subsampled evenly if the drive is long, statistics and the verdict."""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, fields

import numpy as np

from paceline.arrays import Array
from paceline.simulation.closed_loop.loop import LoopStep
from paceline.simulation.closed_loop.requirements import DriveStatistics, Requirement

MAX_LOG_ROWS = 20_000  # rows, even
STATUS_NAMES = ("tracking", "coasting", "lost")


@dataclass(frozen=True)
class LogRow:
    """What the plots show of one cycle; SI units."""

    time: float
    chase_x: float
    chase_y: float
    lead_x: float
    lead_y: float
    speed: float
    lead_speed: float
    gap: float
    range: float  # as estimated; NaN where the lead is not tracked
    desired_gap: float
    path_error: float
    steering_command: float  # steering
    steering: float
    acceleration: float
    processing: float
    status: float  # index into `STATUS_NAMES`
    lead_present: float


class DriveLog:
    """Collects rows. Of a drive longer than `MAX_LOG_ROWS` cycles every second row is dropped, as often as it takes."""

    def __init__(self, keep: int = MAX_LOG_ROWS) -> None:
        self._rows = np.empty((keep, len(fields(LogRow))))
        self._count = self._seen = 0
        self._every = 1

    def add(self, s: LoopStep) -> None:
        if self._seen % self._every == 0:
            if self._count == len(self._rows):
                self._count = len(self._rows) // 2
                self._rows[: self._count] = self._rows[::2]
                self._every *= 2
            if self._seen % self._every == 0:
                self._rows[self._count] = astuple(_log_row(s))
                self._count += 1
        self._seen += 1

    def __getattr__(self, name: str) -> Array:
        """A column (N,) by the name of a field of `LogRow`."""
        names = [f.name for f in fields(LogRow)]
        if name not in names:
            raise AttributeError(name)
        return np.array(self._rows[: self._count, names.index(name)])


def _log_row(s: LoopStep) -> LogRow:
    e, c = s.estimate, s.chase
    tracking = e.status == "tracking"
    return LogRow(
        time=s.time,
        chase_x=c.x,
        chase_y=c.y,
        lead_x=s.lead.x,
        lead_y=s.lead.y,
        speed=c.speed,
        lead_speed=s.lead_speed,
        gap=s.gap if s.lead_present else np.nan,
        range=float(e.position[2]) if tracking else np.nan,
        desired_gap=s.desired_gap,
        path_error=s.path_error,
        steering_command=s.command.steering,
        steering=c.steering,
        acceleration=c.acceleration,
        processing=e.latency,
        status=float(STATUS_NAMES.index(e.status)),
        lead_present=float(s.lead_present),
    )


@dataclass(frozen=True, eq=False)
class DriveResult:
    """A whole drive and its verdict."""

    scene: str
    seed: int
    throttle: str
    target: str
    latency: float  # s from picture to effect, as set
    duration: float  # s, simulated
    figures: DriveStatistics
    requirements: list[Requirement]
    log: DriveLog
    document: dict[str, object]
    configuration: dict[str, object]
    versions: dict[str, str]
    notices: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def holds(self) -> bool:
        """Whether all that must hold does."""
        return all(r.holds for r in self.requirements)

    @property
    def processing(self) -> dict[str, float]:
        """Seconds that the tracker took for a picture: median, 99 of 100, and the longest."""
        times = self.log.processing
        return {"median": float(np.median(times)), "p99": float(np.quantile(times, 0.99)), "max": float(times.max())}
