"""The requirements of a drive: statistics gathered cycle by cycle, and the table of each requirement and its bound."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from paceline.simulation.closed_loop.drive_yaml import DriveModel
from paceline.simulation.closed_loop.loop import LoopStep

MIN_LEAD_VISIBLE_SHARE = 0.6  # of the rear plane, where a frame counts as one that shows the lead
MAX_RANGE_ERROR = 0.15  # relative; beyond, the estimate is of something else
MAX_LATERAL_ERROR_WIDTHS = 0.5  # in widths of the lead; beyond, the estimate is of something else
MAX_STANDING_SPEED_MPS = 0.1
FINAL_FRAMES = 15  # that decide how a drive ends
MIN_FINAL_TRACKED_SHARE = 0.8  # of those frames


@dataclass(frozen=True)
class Requirement:
    """One row of the table: the quantity, its value, its bound, and whether the bound is met."""

    what: str
    value: float
    bound: float
    unit: str
    holds: bool
    at_least: bool = False


@dataclass
class DriveStatistics:
    """Statistics over all cycles of a drive; SI units."""

    frames: int = 0
    status: Counter[str] = field(default_factory=Counter)
    lead_frames: int = 0  # with a lead on the road, visible or hidden
    visible_frames: int = 0  # in which the lead is visible
    tracked_frames: int = 0  # of those
    losses: int = 0  # times that a lead on the road was lost
    wrong_frames: int = 0  # with status tracking and an estimate that is far off
    clearance: float = np.inf
    path_squares: float = 0.0
    path_max: float = 0.0
    gap_squares: float = 0.0
    gap_min: float = np.inf
    gap_max: float = -np.inf
    range_squares: float = 0.0
    range_frames: int = 0
    distance: float = 0.0  # m driven
    distance_unseen: float = 0.0  # m driven since the lead vanished
    speed_max: float = 0.0
    speed: float = 0.0  # in the last cycle
    _last: LoopStep | None = None
    _ending: list[str] = field(default_factory=list)

    def add(self, s: LoopStep, width: float) -> None:
        """Count a cycle; ``width``, m, is the lead's."""
        e, last = s.estimate, self._last
        tracking = e.status == "tracking"
        self.frames += 1
        self.status[e.status] += 1
        if s.lead_present and e.status == "lost" and (last is None or last.estimate.status != "lost"):
            self.losses += 1
        if s.lead_present and s.truth.visible >= MIN_LEAD_VISIBLE_SHARE:
            self.visible_frames += 1
            self.tracked_frames += tracking
        error = e.position - s.truth.position
        self.wrong_frames += tracking and (
            not s.lead_present
            or abs(error[2]) > MAX_RANGE_ERROR * s.gap
            or abs(error[0]) > MAX_LATERAL_ERROR_WIDTHS * width
        )
        if tracking and s.lead_present:
            self.range_squares += float(error[2] / s.gap) ** 2
            self.range_frames += 1
        if np.isfinite(s.clearance):
            self.clearance = min(self.clearance, s.clearance)
        if s.lead_present:
            self.path_squares += s.path_error**2
            self.path_max = max(self.path_max, abs(s.path_error))
            self.gap_squares += (s.gap - s.desired_gap) ** 2
            self.lead_frames += 1
            self.gap_min, self.gap_max = min(self.gap_min, s.gap), max(self.gap_max, s.gap)
        if last is not None:
            step_length = float(np.hypot(s.chase.x - last.chase.x, s.chase.y - last.chase.y))
            self.distance += step_length
            self.distance_unseen += 0.0 if s.lead_present else step_length
        self.speed, self.speed_max = s.chase.speed, max(self.speed_max, s.chase.speed)
        self._ending = [*self._ending[-FINAL_FRAMES + 1 :], e.status]
        self._last = s

    def release_step(self) -> None:
        """Drop the last cycle and its image; the statistics stay."""
        self._last = None

    @property
    def path_rms(self) -> float:
        return float(np.sqrt(self.path_squares / max(self.lead_frames, 1)))

    @property
    def gap_rms(self) -> float:
        return float(np.sqrt(self.gap_squares / max(self.lead_frames, 1)))

    @property
    def range_rms(self) -> float:
        """Relative."""
        return float(np.sqrt(self.range_squares / max(self.range_frames, 1)))

    @property
    def tracked_share(self) -> float:
        """Share of the frames that show the lead."""
        return self.tracked_frames / self.visible_frames if self.visible_frames else float("nan")

    @property
    def ends_tracking(self) -> bool:
        """Whether the lead is tracked at the end; single frames may be coasted over."""
        return (
            self._ending.count("tracking") >= MIN_FINAL_TRACKED_SHARE * len(self._ending) and "lost" not in self._ending
        )


def check_requirements(model: DriveModel, f: DriveStatistics) -> list[Requirement]:
    """The table of requirements with the values found."""
    bounds = model.requirements

    def at_most(name: str, value: float, bound: float | None, unit: str) -> list[Requirement]:
        return [] if bound is None else [Requirement(name, value, bound, unit, bool(value <= bound))]

    def at_least_bound(name: str, value: float, bound: float | None, unit: str) -> list[Requirement]:
        return [] if bound is None else [Requirement(name, value, bound, unit, bool(value >= bound), True)]

    rows = [
        *at_least_bound("least distance to another vehicle", f.clearance, bounds.clearance, "m"),
        *at_most("path error, RMS", f.path_rms, bounds.rms_path_error, "m"),
        *at_most("path error, greatest", f.path_max, bounds.max_path_error, "m"),
        *at_most("gap error, RMS", f.gap_rms, bounds.rms_gap_error, "m"),
        *at_most("greatest gap", f.gap_max, bounds.max_gap, "m"),
        *at_most("times lost", f.losses, bounds.lost, ""),
        *at_least_bound("share of frames tracked", f.tracked_share, bounds.tracked, ""),
        *at_most("frames in which something else was followed", f.wrong_frames, bounds.wrong, ""),
        *at_most("way driven after it vanished", f.distance_unseen, bounds.stops_within, "m"),
    ]
    if bounds.ends == "standing" or (bounds.ends == "either" and not f.ends_tracking):
        rows += at_most("speed at the end", f.speed, MAX_STANDING_SPEED_MPS, "m/s")
    else:
        rows += at_least_bound("tracking at the end", float(f.ends_tracking), 1.0, "")
    return rows
