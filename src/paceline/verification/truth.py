"""True speeds to compare results with: a truth.json as the simulators write it, or another result in its place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, RootModel

from paceline.arrays import Array
from paceline.documents.models import checked_content
from paceline.verification.saved_results import SavedResult, read_json, read_result

MAX_MISSING_FRAMES = 1


class TruthRow(BaseModel):
    """A vehicle in one frame of a truth.json, as far as it is compared."""

    model_config = ConfigDict(allow_inf_nan=False)

    vehicle: str
    frame: Annotated[int, Field(ge=0)]
    time_s: float
    speed_mps: float


class TruthFile(RootModel[list[TruthRow]]):
    """A truth.json."""


@dataclass(frozen=True, eq=False)
class TrueSpeeds:
    """A vehicle's true speeds (N,) m/s in frames in ascending order."""

    frame: NDArray[np.int64]
    time: Array  # s
    speed: Array

    def mean_over(self, first: int, last: int) -> float:
        """The mean speed from the frame ``first`` to ``last``, distance by time; NaN where it is not known there, but
        for MAX_MISSING_FRAMES at either end: a filter has no speed in its first frame."""
        rows = (self.frame >= first) & (self.frame <= last)
        frame, time, speed = self.frame[rows], self.time[rows], self.speed[rows]
        if not len(frame) or max(frame[0] - first, last - frame[-1]) > MAX_MISSING_FRAMES:
            return float("nan")
        return float(np.trapezoid(speed, time) / (time[-1] - time[0])) if time[-1] > time[0] else float(speed[0])

    def at(self, frames: NDArray[np.int64]) -> Array:
        """The speeds in ``frames`` (M,); NaN in those that are not known."""
        known = dict(zip(self.frame.tolist(), self.speed.tolist(), strict=True))
        return np.array([known.get(frame, np.nan) for frame in frames.tolist()])


def read_truth(path: Path) -> dict[str, TrueSpeeds]:
    """The true speeds by vehicle: in a truth.json, or in the output folder of another result. Raises UnusableInput,
    naming file and key."""
    if path.is_dir():
        return speeds_as_truth(read_result(path))
    content = read_json(path, "expected a truth.json, or the output folder of another result")
    rows: dict[str, list[TruthRow]] = {}
    for row in checked_content(TruthFile, content, path).root:
        rows.setdefault(row.vehicle, []).append(row)
    return {
        vehicle: true_speeds(
            np.array([r.frame for r in known]),
            np.array([r.time_s for r in known]),
            np.array([r.speed_mps for r in known]),
        )
        for vehicle, known in rows.items()
    }


def speeds_as_truth(result: SavedResult) -> dict[str, TrueSpeeds]:
    """The speeds of the vehicles that a ``result`` has measured, in place of true ones."""
    measured = {v.vehicle for v in result.vehicles if v.verdict == "measured"}
    return {
        vehicle: true_speeds(speeds.frame, speeds.time, speeds.best)
        for vehicle, speeds in result.frames.items()
        if vehicle in measured
    }


def true_speeds(frame: NDArray[np.int64], time: Array, speed: Array) -> TrueSpeeds:
    """The known ones of these speeds, in ascending order."""
    known = np.isfinite(speed)
    order = np.argsort(frame[known], kind="stable")
    return TrueSpeeds(frame[known][order], time[known][order], speed[known][order])
