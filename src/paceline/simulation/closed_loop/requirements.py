"""What a drive is judged by: figures gathered cycle by cycle, and the table of what must hold."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from paceline.simulation.closed_loop.drive_yaml import DriveModel
from paceline.simulation.closed_loop.loop import LoopStep

MIN_VISIBLE_SHARE = 0.6  # of the rear plane must be visible where a frame counts as one that shows the lead
MAX_RANGE_ERROR, MAX_LATERAL_ERROR_WIDTHS = (
    0.15,
    0.5,
)  # relative, and in widths of the lead: an estimate that is of something else
MAX_STANDING_SPEED_MPS = 0.1  # m/s
FINAL_FRAMES, MIN_FINAL_TRACKED_SHARE = (
    15,
    0.8,
)  # frames that tell how a drive ends, and the share of them that must be tracked


@dataclass(frozen=True)
class Requirement:
    """One row of the table: what, the figure found, and its bound with whether it is met."""

    what: str
    value: float
    bound: float
    unit: str
    holds: bool
    at_least: bool = False


@dataclass
class DriveStatistics:
    """Figures over all cycles of a drive; SI units."""

    frames: int = 0
    status: Counter[str] = field(default_factory=Counter)
    shown: int = 0  # frames with a lead, be it in view or hidden
    showing: int = 0  # frames that show it
    tracked: int = 0  # of those
    losses: int = 0  # times that a lead in view was lost
    wrong: int = 0  # frames that claim to track and are far off
    clearance: float = np.inf
    path_squares: float = 0.0
    path_max: float = 0.0
    gap_squares: float = 0.0
    gap_min: float = np.inf
    gap_max: float = -np.inf
    range_squares: float = 0.0
    range_frames: int = 0
    way: float = 0.0  # m driven
    way_unseen: float = 0.0  # m driven since the lead vanished
    speed_max: float = 0.0
    speed: float = 0.0  # at last
    _last: LoopStep | None = None
    _ending: list[str] = field(default_factory=list)

    def add(self, s: LoopStep, width: float) -> None:
        """Count a cycle; ``width``, m, is the lead's."""
        e, last = s.estimate, self._last
        tracking = e.status == "tracking"
        self.frames += 1
        self.status[e.status] += 1
        if s.shown and e.status == "lost" and (last is None or last.estimate.status != "lost"):
            self.losses += 1
        if s.shown and s.truth.visible >= MIN_VISIBLE_SHARE:
            self.showing += 1
            self.tracked += tracking
        off = e.position - s.truth.position
        self.wrong += tracking and (
            not s.shown or abs(off[2]) > MAX_RANGE_ERROR * s.gap or abs(off[0]) > MAX_LATERAL_ERROR_WIDTHS * width
        )
        if tracking and s.shown:
            self.range_squares += float(off[2] / s.gap) ** 2
            self.range_frames += 1
        if np.isfinite(s.clearance):
            self.clearance = min(self.clearance, s.clearance)
        if s.shown:
            self.path_squares += s.path_error**2
            self.path_max = max(self.path_max, abs(s.path_error))
            self.gap_squares += (s.gap - s.wanted) ** 2
            self.shown += 1
            self.gap_min, self.gap_max = min(self.gap_min, s.gap), max(self.gap_max, s.gap)
        if last is not None:
            moved = float(np.hypot(s.chase.x - last.chase.x, s.chase.y - last.chase.y))
            self.way += moved
            self.way_unseen += 0.0 if s.shown else moved
        self.speed, self.speed_max = s.chase.speed, max(self.speed_max, s.chase.speed)
        self._ending = [*self._ending[-FINAL_FRAMES + 1 :], e.status]
        self._last = s

    def forget(self) -> None:
        """Let go of the last cycle and its picture; the figures stay."""
        self._last = None

    @property
    def path_rms(self) -> float:
        return float(np.sqrt(self.path_squares / max(self.shown, 1)))

    @property
    def gap_rms(self) -> float:
        return float(np.sqrt(self.gap_squares / max(self.shown, 1)))

    @property
    def range_rms(self) -> float:
        """Relative."""
        return float(np.sqrt(self.range_squares / max(self.range_frames, 1)))

    @property
    def tracked_share(self) -> float:
        """Of the frames that show the lead."""
        return self.tracked / self.showing if self.showing else float("nan")

    @property
    def ends_tracking(self) -> bool:
        """Single frames may be coasted over: the lead is followed all the same."""
        return (
            self._ending.count("tracking") >= MIN_FINAL_TRACKED_SHARE * len(self._ending) and "lost" not in self._ending
        )


def check_requirements(model: DriveModel, f: DriveStatistics) -> list[Requirement]:
    """The table of what must hold, with what was found."""
    must = model.must

    def most(what: str, value: float, bound: float | None, unit: str) -> list[Requirement]:
        return [] if bound is None else [Requirement(what, value, bound, unit, bool(value <= bound))]

    def least(what: str, value: float, bound: float | None, unit: str) -> list[Requirement]:
        return [] if bound is None else [Requirement(what, value, bound, unit, bool(value >= bound), True)]

    rows = [
        *least("least distance to another vehicle", f.clearance, must.clearance, "m"),
        *most("path error, RMS", f.path_rms, must.rms_path_error, "m"),
        *most("path error, greatest", f.path_max, must.max_path_error, "m"),
        *most("gap error, RMS", f.gap_rms, must.rms_gap_error, "m"),
        *most("greatest gap", f.gap_max, must.max_gap, "m"),
        *most("times lost", f.losses, must.lost, ""),
        *least("share of frames tracked", f.tracked_share, must.tracked, ""),
        *most("frames in which something else was followed", f.wrong, must.wrong, ""),
        *most("way driven after it vanished", f.way_unseen, must.stops_within, "m"),
    ]
    if must.ends == "standing" or (must.ends == "either" and not f.ends_tracking):
        rows += most("speed at the end", f.speed, MAX_STANDING_SPEED_MPS, "m/s")
    else:
        rows += least("tracking at the end", float(f.ends_tracking), 1.0, "")
    return rows
