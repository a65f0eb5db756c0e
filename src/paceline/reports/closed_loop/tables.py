"""A drive as data: drive.csv, written cycle by cycle, and summary.json, in SI units."""

from __future__ import annotations

import csv
from pathlib import Path
from types import TracebackType

from paceline.reports.common.tables import format_cell, write_json
from paceline.simulation.closed_loop.loop import LoopStep
from paceline.simulation.closed_loop.results import DriveResult

DRIVE_COLUMNS = [
    "frame", "time_s",
    "chase_x_m", "chase_y_m", "chase_heading_rad", "chase_speed_mps", "chase_acceleration_mps2",
    "lead_x_m", "lead_y_m", "lead_heading_rad", "lead_speed_mps",
    "x_m", "y_m", "z_m", "z_std_m", "true_x_m", "true_y_m", "true_z_m",
    "steering_asked_rad", "steering_rad", "acceleration_asked_mps2", "effect_time_s",
    "wanted_gap_m", "path_error_m", "clearance_m", "visible", "processing_s", "status", "reason",
]  # fmt: skip


class DriveTable:
    """drive.csv, one row per cycle, an empty cell where there is no number."""

    def __init__(self, file: Path) -> None:
        self._stream = file.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._stream, lineterminator="\n")
        self._writer.writerow(DRIVE_COLUMNS)

    def add(self, s: LoopStep) -> None:
        c, e = s.chase, s.estimate
        numbers = [
            s.time, c.x, c.y, c.heading, c.speed, c.acceleration,
            s.lead.x, s.lead.y, s.lead.heading, s.lead_speed,
            *e.position, e.position_std[2], *s.truth.position,
            s.command.steering, c.steering, s.command.acceleration, s.command.time,
            s.desired_gap, s.path_error, s.clearance, s.truth.visible, e.latency,
        ]  # fmt: skip
        self._writer.writerow([s.frame, *map(format_cell, numbers), e.status, e.reason])

    def __enter__(self) -> DriveTable:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()


def write_drive_summary(result: DriveResult, file: Path) -> None:
    """Writes summary.json: the requirements, the figures, the scene and the configuration."""
    f = result.figures
    summary = {
        "scene": result.scene,
        "seed": result.seed,
        "holds": result.holds,
        "requirements": [
            {
                "what": r.what,
                "value": r.value,
                "least" if r.at_least else "most": r.bound,
                "unit": r.unit,
                "holds": r.holds,
            }
            for r in result.requirements
        ],
        "frames": f.frames,
        "duration_s": result.duration,
        "status": {name: f.status[name] for name in ("tracking", "coasting", "lost")},
        "tracked_share": f.tracked_share,
        "losses": f.losses,
        "wrong_frames": f.wrong_frames,
        "way_m": f.distance,
        "speed_max_mps": f.speed_max,
        "clearance_min_m": f.clearance,
        "path_error_m": {"rms": f.path_rms, "max": f.path_max},
        "gap_error_rms_m": f.gap_rms,
        "gap_m": {"min": f.gap_min, "max": f.gap_max},
        "range_error_rms": f.range_rms,
        "latency_s": result.latency,
        "processing_s": result.processing,
        "notices": result.notices,
        "drive": result.document,
        "configuration": result.configuration,
        "versions": result.versions,
        "seconds": result.seconds,
    }
    write_json(summary, file)
