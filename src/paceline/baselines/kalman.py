"""Kalman-filtered triangulation, the comparison of [Zhu] section V: a constant-velocity model, measured by the
triangulated centroid with the covariance that half a pixel of error in its matches propagates to (Matthies and Shafer
1987).

That covariance ignores that the centroid moves over the vehicle as the set of matches changes. It is much too small
across the line of sight, and the filter interprets that movement as motion in depth. With ``centroid_scatter``, the
scatter of the matched points is added.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array
from paceline.baselines.sift import Sift, centroid_covariance
from paceline.baselines.track import NOISE_STEP_S, FrameResult, measurement_of_filter, rejected
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.geometry import triangulate
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.measurement import by_vehicle
from paceline.speed.methods import register
from paceline.speed.results import Measurement

INITIAL_VELOCITY_STD_MPS = 40.0  # standard deviation of each velocity component before the second measurement


@dataclass(frozen=True, eq=False)
class KalmanState:
    """Mean (6,) of position and velocity, m and m/s, and their ``covariance`` (6, 6)."""

    mean: Array
    covariance: Array

    @property
    def speed(self) -> tuple[float, float]:
        """The speed and its standard deviation, m/s."""
        v, V = self.mean[3:], self.covariance[3:, 3:]
        speed = float(np.linalg.norm(v))
        ahead = v / max(speed, 1e-12)
        return speed, float(np.sqrt(ahead @ V @ ahead))


def initial_state(place: Array, noise: Array) -> KalmanState:
    """The state at the first measured position ``place`` (3,) of covariance ``noise`` (3, 3); velocity unknown."""
    spread = np.zeros((6, 6))
    spread[:3, :3], spread[3:, 3:] = noise, INITIAL_VELOCITY_STD_MPS**2 * np.eye(3)
    return KalmanState(np.concatenate([place, np.zeros(3)]), spread)


def transition(dt: float) -> Array:
    """State transition F (6, 6) of a constant velocity over ``dt`` seconds."""
    return np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(3))


def process_noise(dt: float, strength: float) -> Array:
    """Process noise Q (6, 6) of a random-walk velocity whose variance grows by ``strength`` (m²/s³) each second."""
    return strength * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(3))


def predict(state: KalmanState, dt: float, strength: float) -> KalmanState:
    """The predicted state ``dt`` seconds later."""
    F = transition(dt)
    return KalmanState(F @ state.mean, F @ state.covariance @ F.T + process_noise(dt, strength))


def update(state: KalmanState, place: Array, noise: Array) -> KalmanState:
    """The state updated with the measured position ``place`` (3,) of covariance ``noise`` (3, 3)."""
    P, innovation = state.covariance, place - state.mean[:3]
    S = P[:3, :3] + noise
    K = np.linalg.solve(S, P[:3]).T
    keep = np.eye(6)
    keep[:, :3] -= K
    spread = keep @ P @ keep.T + K @ noise @ K.T  # Joseph's form stays positive definite
    return KalmanState(state.mean + K @ innovation, spread)


class Kalman:
    """The Kalman filter of one vehicle."""

    def __init__(
        self, rig: StereoRig, vehicle: VehicleDocument, configuration: SpeedConfiguration, centroid_scatter: bool
    ) -> None:
        self.rig, self.vehicle, self.centroid_scatter = rig, vehicle, centroid_scatter
        self.strength = configuration.translation_noise**2 / NOISE_STEP_S
        self.features = Sift(rig, vehicle, configuration.limits)
        self._states: dict[int, KalmanState] = {}  # by frame
        self._last, self._time = 0, 0.0

    def process(self, frame: StereoFrame) -> bool:
        """Process ``frame``; whether the vehicle can be tracked further."""
        further = self.features.process(frame)
        results = self.features.frame_results
        if results and results[-1].status == "tracking":
            self._measure(results[-1])
        return further

    def _measure(self, result: FrameResult) -> None:
        noise = centroid_covariance(self.rig, result.position, int(result.effective_points))
        if self.centroid_scatter:
            points = triangulate(self.rig, result.points_left, result.points_right)
            noise = noise + np.cov(points.T) / len(points)
        if not self._states:
            state = initial_state(result.position, noise)
        else:
            ahead = predict(self._states[self._last], result.time - self._time, self.strength)
            state = update(ahead, result.position, noise)
        self._last, self._time = result.frame, result.time
        self._states[result.frame] = state

    def result(self) -> Measurement:
        """The measurement: the mean of the filter's speeds, weighted by their inverse variances."""
        first = self.features.frame_results[:1]  # without a speed yet
        results = first + [self._filtered(s) for s in self.features.frame_results[1:]]
        if reason := self.features.unmeasurable():
            return rejected(self.vehicle.id, results, reason)
        return measurement_of_filter(self.vehicle.id, results, "constant velocity", self.features.limits)

    def _filtered(self, result: FrameResult) -> FrameResult:
        if result.frame not in self._states:
            return replace(result, speed=float("nan"), speed_std=float("nan"))
        state = self._states[result.frame]
        speed, std = state.speed
        return replace(result, position=state.mean[:3], speed=speed, speed_std=std)


register("kalman", by_vehicle(lambda clip, vehicle, path, c: Kalman(clip.rig, vehicle, c, centroid_scatter=False)))
register(
    "kalman-scatter",
    by_vehicle(lambda clip, vehicle, path, c: Kalman(clip.rig, vehicle, c, centroid_scatter=True)),
    old_name="kalman-wander",
)
