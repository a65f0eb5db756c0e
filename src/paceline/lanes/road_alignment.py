"""Horizontal alignment of a road: an arc with a smooth deviation, and road coordinates along and across it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from paceline.arrays import Array

ALIGNMENT_SCALE_M = 30.0  # arc length s at which each term of the deviation is 1
MIN_CURVATURE_PER_M = 1e-9  # curvature below which an arc is a line


@dataclass(frozen=True, eq=False)
class Alignment:
    """A circular arc through ``origin`` (2,) on the ground with ``heading`` (rad, from ahead to the right) there and
    ``curvature`` (1/m, positive to the right), and how far the road deviates from it to the right:
    δ(s) = Σⱼ ``deviation``ⱼ (s / `ALIGNMENT_SCALE_M`)ʲ in metres.

    Road coordinates of a ground point are s, metres along the arc from ``origin``, and d, metres to the right of the
    deviating road.
    """

    origin: Array
    heading: float
    curvature: float
    deviation: Array = field(default_factory=lambda: np.zeros(5))

    @property
    def axes(self) -> tuple[Array, Array]:
        """Unit vectors (2,) along and to the right at ``origin``."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.array([s, c]), np.array([c, -s])

    def lateral_deviation(self, s: Array) -> Array:
        """δ(s), shape of ``s``."""
        return np.asarray(np.polynomial.polynomial.polyval(np.asarray(s) / ALIGNMENT_SCALE_M, self.deviation))

    def direction(self, s: Array) -> Array:
        """Where the road heads (rad, from ahead to the right) at ``s`` (…)."""
        slope = np.polynomial.polynomial.polyval(
            np.asarray(s) / ALIGNMENT_SCALE_M, np.polynomial.polynomial.polyder(self.deviation)
        )
        return np.asarray(self.heading + self.curvature * np.asarray(s) + np.arctan(slope / ALIGNMENT_SCALE_M))

    def to_ground(self, s: Array, d: Array | float) -> Array:
        """Ground coordinates (…, 2) of road coordinates, which are broadcast."""
        s, d = np.broadcast_arrays(np.asarray(s, float), np.asarray(d, float))
        d = np.asarray(d + self.lateral_deviation(s))
        turned = self.curvature * s
        along = s * np.sinc(turned / np.pi) - d * np.sin(turned)
        lateral_axis = 0.5 * self.curvature * s**2 * np.sinc(turned / (2 * np.pi)) ** 2 + d * np.cos(turned)
        forward, right = self.axes
        return np.asarray(self.origin + along[..., None] * forward + lateral_axis[..., None] * right)

    def from_ground(self, ground: Array) -> tuple[Array, Array]:
        """Road coordinates s and d (…) of ``ground`` (…, 2)."""
        forward, right = self.axes
        relative = np.asarray(ground, float) - self.origin
        u, v = relative @ forward, relative @ right
        k = self.curvature
        q = np.hypot(k * u, 1 - k * v)
        d = (2 * v - k * (u * u + v * v)) / (1 + q)
        s = u if abs(k) < MIN_CURVATURE_PER_M else np.arctan2(k * u, 1 - k * v) / k
        return np.asarray(s), np.asarray(d - self.lateral_deviation(s))

    def lateral_axis(self, s: Array) -> Array:
        """Unit vectors (…, 2) to the right of the arc at ``s`` (…)."""
        angle = self.heading + self.curvature * np.asarray(s)
        return np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
