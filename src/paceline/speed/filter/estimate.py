"""The filter's estimate at one frame."""

from __future__ import annotations

from dataclasses import dataclass

from paceline.arrays import Array

MIN_REFERENCE_SIMILARITY = 0.55  # to the reference, above which a frame updates it
MIN_VISIBLE_SIMILARITY = 0.25  # to the reference, below which the vehicle is occluded


@dataclass(frozen=True, eq=False)
class Estimate:
    """The filter's estimate at one frame (SI units, ideal pixels)."""

    frame: int
    time: float
    speed: float
    speed_std: float
    position: Array  # (3,)
    yaw_rate: float  # rad/s, positive to the right; NaN at the first frame
    left: Array  # (4, 2)
    right: Array  # (4, 2)
    ess: float
    status: str  # tracking | lost | ended
    similarity: float  # correlation with the reference, −1 … 1
    particles_left: Array  # (N, 2) of at most `particle_set.MAX_DRAWN_PARTICLES` particles
    particles_right: Array  # (N, 2)
    vehicle: str = ""  # its id
