"""Errors of measured speeds: of each vehicle's mean, whether its interval holds the truth, and frame by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.verification.saved_results import FrameSpeeds, SavedResult, SavedVehicle
from paceline.verification.truth import TrueSpeeds


@dataclass(frozen=True, eq=False)
class VehicleError:
    """A vehicle that was measured and whose true mean speed over the same frames is known, m/s; ``frame_errors`` of the
    speeds as estimated frame by frame, ``refined_errors`` of those of the fit, without unknown ones."""

    vehicle: SavedVehicle
    true_speed: float
    frame_errors: Array
    refined_errors: Array

    @property
    def error(self) -> float:
        assert self.vehicle.speed_mps is not None, "it was measured"
        return self.vehicle.speed_mps - self.true_speed

    @property
    def inside(self) -> bool:
        """Whether the 95 % interval holds the truth."""
        lo, hi = self.vehicle.speed_lo_mps, self.vehicle.speed_hi_mps
        return lo is not None and hi is not None and lo <= self.true_speed <= hi


def vehicle_errors(result: SavedResult, truth: Mapping[str, TrueSpeeds]) -> list[VehicleError]:
    """The errors of the vehicles of ``result`` that are measured and in the ``truth``, matched by their ids."""
    errors = []
    for vehicle in result.vehicles:
        true, speeds = truth.get(vehicle.vehicle), result.frames.get(vehicle.vehicle)
        if vehicle.verdict != "measured" or vehicle.speed_mps is None or true is None or speeds is None:
            continue
        found = _vehicle_error(vehicle, speeds, true)
        if np.isfinite(found.true_speed):
            errors.append(found)
    return errors


def _vehicle_error(vehicle: SavedVehicle, speeds: FrameSpeeds, true: TrueSpeeds) -> VehicleError:
    at_frames = true.at(speeds.frame)
    by_frame, refined = speeds.speed - at_frames, speeds.refined - at_frames
    return VehicleError(
        vehicle,
        true.mean_over(int(speeds.frame[0]), int(speeds.frame[-1])),
        by_frame[np.isfinite(by_frame)],
        refined[np.isfinite(refined)],
    )


def rms(errors: Array) -> float:
    """The root mean square of ``errors`` (N,), NaN without any."""
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")


def largest(errors: Array) -> float:
    """The largest of ``errors`` (N,) by size, NaN without any."""
    return float(np.abs(errors).max()) if len(errors) else float("nan")


def all_errors(errors: Sequence[VehicleError]) -> Array:
    """The errors of the vehicles' mean speeds, (V,) m/s."""
    return np.array([e.error for e in errors])


def all_frame_errors(errors: Sequence[VehicleError]) -> Array:
    """The errors of all speeds as estimated frame by frame, m/s."""
    return np.concatenate([e.frame_errors for e in errors]) if errors else np.empty(0)
