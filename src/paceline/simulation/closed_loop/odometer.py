"""The chase vehicle's odometry: dead reckoning from wheel speed and yaw rate, with their errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.recordings.odometry import Pose


@dataclass(frozen=True)
class OdometerErrors:
    """Standard deviations. The first two are drawn once for a drive, the others anew for every frame."""

    scale: float = 0.005  # of the wheel speed, relative
    drift: float = 0.0005  # rad/s, of the yaw rate
    slip: float = 0.005  # of the distance between two frames, relative
    jitter: float = 0.0002  # rad, of the turn between two frames


class Odometer:
    """Reckons the camera's pose from its true ones, frame by frame; ``speed`` is the measured one, m/s."""

    def __init__(self, errors: OdometerErrors, rng: np.random.Generator, speed: float = 0.0) -> None:
        self._errors, self._rng = errors, rng
        self._scale, self._drift = 1 + errors.scale * rng.standard_normal(), errors.drift * rng.standard_normal()
        self._last: tuple[float, Pose] | None = None
        self._pose = Pose(0.0, 0.0, 0.0)
        self.speed = speed

    def read(self, time: float, true: Pose) -> Pose:
        """The pose at ``time``, s, as it is reckoned, in a world of its own that begins at the first one."""
        if self._last is None:
            self._last = time, true
            return self._pose
        before, last = self._last
        self._last = time, true
        dt = time - before
        step_length = np.hypot(true.x - last.x, true.y - last.y)
        # the chord's direction in the vehicle's own axes, then the turn, each as it is measured
        course = np.arctan2(true.y - last.y, true.x - last.x) - last.heading if step_length > 0 else 0.0
        slip, jitter = self._rng.standard_normal(2)
        distance = step_length * self._scale * (1 + self._errors.slip * slip)
        turn = true.heading - last.heading + self._drift * dt + self._errors.jitter * jitter * (step_length > 0)
        p = self._pose
        self._pose = Pose(
            float(p.x + distance * np.cos(p.heading + course)),
            float(p.y + distance * np.sin(p.heading + course)),
            float(p.heading + turn),
        )
        self.speed = float(distance / dt)
        return self._pose
