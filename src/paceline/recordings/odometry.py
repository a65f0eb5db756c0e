"""The pose of a vehicle at each frame of a recording, from its own odometry."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from paceline.arrays import Array, Indices
from paceline.errors import UnusableInput, refuse_pipe_or_device

ODOMETRY_COLUMNS = ["frame", "x_m", "y_m", "heading_rad"]


@dataclass(frozen=True)
class Pose:
    """The pose of the chase vehicle's camera in a level world frame: x and y in metres, heading in radians from x to y.

    The world's y axis lies to the left of its x axis.
    """

    x: float
    y: float
    heading: float


@dataclass(frozen=True, eq=False)
class Odometry:
    """Poses of a vehicle: ``frame`` (N,), increasing, and ``pose`` (N, 3) with x and y in metres, heading in rad."""

    frame: Indices
    pose: Array

    def at(self, frame: int) -> Array | None:
        """The pose (3,) at one frame, None where it is not known."""
        i = int(np.searchsorted(self.frame, frame))
        return self.pose[i] if i < len(self.frame) and self.frame[i] == frame else None


def read_odometry(path: Path) -> Odometry:
    """The rows of an odometry.csv (frame,x_m,y_m,heading_rad).

    Raises UnusableInput, naming the line, for anything but finite numbers with frames that increase.
    """
    frames: list[int] = []
    poses: list[list[float]] = []
    refuse_pipe_or_device(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file)
            header = [name.strip() for name in next(rows, [])]
            if header[:4] != ODOMETRY_COLUMNS:
                header_text = ",".join(header)
                raise UnusableInput(
                    f"{path}: the first line reads {header_text!r}; expected {','.join(ODOMETRY_COLUMNS)!r}"
                )
            for row in filter(None, rows):
                row_name = f"{path}: line {rows.line_num}"
                try:
                    frame, pose = int(row[0]), [float(cell) for cell in row[1:4]]
                except ValueError:
                    raise UnusableInput(f"{row_name}: {','.join(row)!r}; expected a frame and three numbers") from None
                if len(pose) < 3 or not np.isfinite(pose).all():
                    raise UnusableInput(f"{row_name}: {','.join(row)!r}; expected a frame and three finite numbers")
                if frames and frame <= frames[-1]:
                    raise UnusableInput(
                        f"{row_name}: frame {frame} follows frame {frames[-1]}; expected them to increase"
                    )
                frames.append(frame)
                poses.append(pose)
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UnusableInput(f"{path}: is not a table of comma-separated text") from error
    if not frames:
        raise UnusableInput(f"{path}: has no rows; expected one per frame")
    return Odometry(np.array(frames, np.int64), np.array(poses))
