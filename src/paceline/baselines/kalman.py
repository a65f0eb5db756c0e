"""Kalman-filtered triangulation, as [Zhu] section V compares with: a constant velocity, measured by the triangulated
centroid with the covariance that half a pixel of error in its matches gives it (Matthies and Shafer 1987).

That covariance does not know that the centroid wanders over the vehicle as the set of matches changes. It is much too
small across the line of sight, and the filter takes that wandering for motion in depth. With ``wander``, the scatter of
the matched points is added.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array
from paceline.baselines.sift import Sift, centroid_covariance
from paceline.baselines.track import Sight, filtered, rejected
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.geometry import triangulate
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.measurement import by_vehicle
from paceline.speed.methods import register
from paceline.speed.results import Measurement

FRAME = 0.2  # s, the step that the configuration's noises belong to
UNKNOWN = 40.0  # m/s, each component of a velocity of which nothing is known


@dataclass(frozen=True, eq=False)
class Belief:
    """Place and velocity ``mean`` (6,), m and m/s, with their ``covariance`` (6, 6)."""

    mean: Array
    covariance: Array

    @property
    def speed(self) -> tuple[float, float]:
        """The speed and its standard deviation, m/s."""
        v, V = self.mean[3:], self.covariance[3:, 3:]
        speed = float(np.linalg.norm(v))
        ahead = v / max(speed, 1e-12)
        return speed, float(np.sqrt(ahead @ V @ ahead))


def first_belief(place: Array, noise: Array) -> Belief:
    """At the first measurement ``place`` (3,) with the covariance ``noise`` (3, 3), the velocity being unknown."""
    spread = np.zeros((6, 6))
    spread[:3, :3], spread[3:, 3:] = noise, UNKNOWN**2 * np.eye(3)
    return Belief(np.concatenate([place, np.zeros(3)]), spread)


def transition(dt: float) -> Array:
    """F (6, 6) of a constant velocity over ``dt`` seconds."""
    return np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(3))


def process_noise(dt: float, strength: float) -> Array:
    """Q (6, 6) of a velocity that walks at random, its variance growing by ``strength`` (m²/s³) each second."""
    return strength * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(3))


def predicted(belief: Belief, dt: float, strength: float) -> Belief:
    """The belief ``dt`` seconds later."""
    F = transition(dt)
    return Belief(F @ belief.mean, F @ belief.covariance @ F.T + process_noise(dt, strength))


def updated(belief: Belief, place: Array, noise: Array) -> Belief:
    """The belief after measuring ``place`` (3,) with the covariance ``noise`` (3, 3)."""
    P, surprise = belief.covariance, place - belief.mean[:3]
    S = P[:3, :3] + noise
    K = np.linalg.solve(S, P[:3]).T
    keep = np.eye(6)
    keep[:, :3] -= K
    spread = keep @ P @ keep.T + K @ noise @ K.T  # Joseph's form stays positive definite
    return Belief(belief.mean + K @ surprise, spread)


class Kalman:
    """One vehicle on its way through the clip."""

    def __init__(
        self, rig: StereoRig, vehicle: VehicleDocument, configuration: SpeedConfiguration, wander: bool
    ) -> None:
        self.rig, self.vehicle, self.wander = rig, vehicle, wander
        self.strength = configuration.translation_noise**2 / FRAME
        self.features = Sift(rig, vehicle, configuration.limits)
        self._beliefs: dict[int, Belief] = {}  # by frame
        self._last, self._time = 0, 0.0

    def process(self, frame: StereoFrame) -> bool:
        """Follow the vehicle into ``frame``; whether it can be followed further."""
        further = self.features.process(frame)
        sights = self.features.sights
        if sights and sights[-1].status == "tracking":
            self._measure(sights[-1])
        return further

    def _measure(self, sight: Sight) -> None:
        noise = centroid_covariance(self.rig, sight.position, int(sight.strength))
        if self.wander:
            points = triangulate(self.rig, sight.points_left, sight.points_right)
            noise = noise + np.cov(points.T) / len(points)
        if not self._beliefs:
            belief = first_belief(sight.position, noise)
        else:
            ahead = predicted(self._beliefs[self._last], sight.time - self._time, self.strength)
            belief = updated(ahead, sight.position, noise)
        self._last, self._time = sight.frame, sight.time
        self._beliefs[sight.frame] = belief

    def result(self) -> Measurement:
        """The measurement: the filter's speeds, averaged by what they claim to know."""
        first = self.features.sights[:1]  # where nothing is known of the speed yet
        sights = first + [self._filtered(s) for s in self.features.sights[1:]]
        if reason := self.features.unmeasurable():
            return rejected(self.vehicle.id, sights, reason)
        return filtered(self.vehicle.id, sights, "constant velocity", self.features.limits)

    def _filtered(self, sight: Sight) -> Sight:
        if sight.frame not in self._beliefs:
            return replace(sight, speed=float("nan"), speed_std=float("nan"))
        belief = self._beliefs[sight.frame]
        speed, std = belief.speed
        return replace(sight, position=belief.mean[:3], speed=speed, speed_std=std)


register("kalman", by_vehicle(lambda clip, vehicle, path, c: Kalman(clip.rig, vehicle, c, wander=False)))
register("kalman-wander", by_vehicle(lambda clip, vehicle, path, c: Kalman(clip.rig, vehicle, c, wander=True)))
