"""The motion of a chase vehicle and its lead: the road, smooth noise in time, bumps.

Everything is a closed-form function of time or of arc length, so that a run of any length needs no memory of its past.
Plan view: x east, y north, headings counter-clockwise from x; lateral positions to the right of travel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.simulation.road import POLYGON_STEP_M, Axis, PolygonalAxis

BUMP_PERIOD_S = 2.5  # s
BUMP_DECAY_S = 0.25  # s
VIBRATION_HZ = (5.0, 25.0)  # Hz, of a camera in its vehicle: from wheels on their springs to an engine at idle
VIBRATION_MODES = 6  # about each axis


class SmoothNoise:
    """A smooth random function of time within ±1: a sum of sines with periods of ``shortest`` to ``longest`` s."""

    def __init__(self, rng: np.random.Generator, shortest: float, longest: float, terms: int = 6) -> None:
        self.omega = 2 * np.pi / np.exp(rng.uniform(np.log(shortest), np.log(longest), terms))
        self.phase = rng.uniform(0, 2 * np.pi, terms)
        weight = rng.uniform(0.5, 1.0, terms)
        self.weight = weight / weight.sum()

    def __call__(self, t: float) -> float:
        return float(self.weight @ np.sin(self.omega * t + self.phase))

    def rate(self, t: float) -> float:
        return float((self.weight * self.omega) @ np.cos(self.omega * t + self.phase))

    def integral(self, t: float) -> float:
        """The integral from 0 to ``t``."""
        return float((self.weight / self.omega) @ (np.cos(self.phase) - np.cos(self.omega * t + self.phase)))


class CameraShake:
    """Band-limited roughness (0.6–4 Hz) with bumps now and then: a function of time of size ``amplitude``."""

    def __init__(self, rng: np.random.Generator, amplitude: float) -> None:
        self.roughness, self.amplitude = SmoothNoise(rng, 0.25, 1.6, terms=12), amplitude
        self.seed = int(rng.integers(2**31))

    def __call__(self, t: float) -> float:
        index = int(t // BUMP_PERIOD_S)
        return self.amplitude * (1.2 * self.roughness(t) + sum(self._bump(k, t) for k in (index - 1, index)))

    def rate(self, t: float) -> float:
        """The derivative in time, per second."""
        return (self(t + 1e-4) - self(t - 1e-4)) / 2e-4

    def _bump(self, k: int, t: float) -> float:
        """The ``k``-th bump at time ``t``: a damped oscillation."""
        rng = np.random.default_rng([self.seed, k + 2])
        since = t - (k + rng.uniform(0, 1)) * BUMP_PERIOD_S
        size, frequency = rng.uniform(-1, 1), rng.uniform(1.5, 3.0)
        if since < 0:
            return 0.0
        return float(size * np.sin(2 * np.pi * frequency * since) * np.exp(-since / BUMP_DECAY_S))


class CameraVibration:
    """The rotation of a camera in its vehicle, as wheels and engine shake it: about each of its axes a sum of modes
    within `VIBRATION_HZ`, of ``rms`` rad."""

    def __init__(self, rng: np.random.Generator, rms: float) -> None:
        modes = 3, VIBRATION_MODES
        low, high = np.log(VIBRATION_HZ)
        self.omega = 2 * np.pi * np.exp(rng.uniform(low, high, modes))
        self.phase = rng.uniform(0, 2 * np.pi, modes)
        weight = rng.uniform(0.5, 1.0, modes)
        self.amplitude = np.sqrt(2) * rms * weight / np.linalg.norm(weight, axis=1, keepdims=True)

    def __call__(self, t: float) -> Array:
        """The rotation vector (3,) in camera axes, rad."""
        return np.asarray((self.amplitude * np.sin(self.omega * t + self.phase)).sum(1))

    def rate(self, t: float) -> Array:
        """The derivative (3,) in time, rad/s."""
        return np.asarray((self.amplitude * self.omega * np.cos(self.omega * t + self.phase)).sum(1))


class GapProfile:
    """The distance from the camera to the lead and its rate, m and m/s, sweeping between two bounds."""

    def __init__(self, rng: np.random.Generator, bounds: tuple[float, float]) -> None:
        self.low, self.high = bounds
        shortest = 2.0 + 5.0 * np.sqrt((self.high - self.low) / 2)  # s: no harder than drivers brake and accelerate
        self.noise = SmoothNoise(rng, shortest, 2.5 * shortest, terms=4)

    def __call__(self, t: float) -> tuple[float, float]:
        bent = np.sin(np.pi * self.noise(t) * 0.9)
        half = (self.high - self.low) / 2
        slope = np.cos(np.pi * self.noise(t) * 0.9) * np.pi * 0.9 * self.noise.rate(t)
        return float(self.low + half * (1 + bent)), float(half * slope)


def winding_road(rng: np.random.Generator, length: float, radius: float) -> PolygonalAxis:
    """A road of straights and turns joined by clothoids; no turn is tighter than ``radius``, m."""
    s = np.arange(0.0, length + POLYGON_STEP_M, POLYGON_STEP_M)
    # One row per bend, so that a longer road begins as a shorter one does.
    draws = rng.random((int(length / (0.4 * radius)) + 2, 3))
    ends = np.cumsum(0.4 + 0.8 * draws[:, 0]) * radius
    bends = (1 - np.floor(3 * draws[:, 1])) * (0.4 + 0.6 * draws[:, 2]) / radius
    knots = np.concatenate([[0.0], np.ravel(np.column_stack([ends, ends + 0.3 * radius]))])
    values = np.ravel(np.column_stack([bends, np.append(bends[1:], 0.0)]))
    return PolygonalAxis(np.interp(s, knots, np.append(bends[0], values)), length)


@dataclass(frozen=True)
class RoadPose:
    """A vehicle on the road at one time: arc length (m), lateral position (m), plan position (m), heading (rad)."""

    arc: float
    lateral: float
    x: float
    y: float
    heading: float


def road_pose(road: Axis, arc: float, lateral: float, slope: float) -> RoadPose:
    """The state of a vehicle that drifts to the right by ``slope`` metres per metre of road."""
    x, y, heading = road.frame(arc, lateral)
    return RoadPose(arc, lateral, float(x), float(y), float(heading) - float(np.arctan(slope)))
