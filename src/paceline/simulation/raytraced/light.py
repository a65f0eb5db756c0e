"""Sun and sky: the directional light of the sun and a map of the sky's radiance.

Radiances are relative: 1 kW/m² of irradiance is 1. Directions are in world axes: x east, y north, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array

SKY_ROWS = 256  # of the map, half of them above the horizon
GROUND_REFLECTANCE = 0.12  # reflectance of the land beyond the world's edge
LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709

# CIE S 011: gradation a, b and scattering c, d, e of the clear sky (type 12) and of the overcast one (type 1).
_CLEAR_SKY = (-1.0, -0.32, 10.0, -3.0, 0.45)
_OVERCAST_SKY = (4.0, -0.7, 0.0, -1.0, 0.0)
_ZENITH_TINT, _HORIZON_TINT, _OVERCAST_TINT = ((0.62, 0.95, 1.75), (0.95, 1.0, 1.1), (0.98, 1.0, 1.03))
_AIR_EXTINCTION = np.array([0.06, 0.11, 0.23])  # what a zenith's worth of air takes from red, green and blue sunlight


@dataclass(frozen=True)
class Light:
    """The sun at ``azimuth`` (rad from east, counter-clockwise) and ``elevation`` (rad).

    ``clouds`` goes from 0, a clear sky, to 1, an overcast one without shadows; ``seed`` draws the clouds.
    """

    azimuth: float
    elevation: float
    clouds: float = 0.1
    seed: int = 0

    @property
    def direction(self) -> Array:
        """The unit vector (3,) towards the sun."""
        c = np.cos(self.elevation)
        return np.array([c * np.cos(self.azimuth), c * np.sin(self.azimuth), np.sin(self.elevation)])

    @property
    def sun_irradiance(self) -> Array:
        """Irradiance (3,) of red, green and blue on a surface that faces the sun.

        Meinel and Meinel's attenuation, 1.353 · 0.7^(m^0.678) for an air mass m.
        """
        mass = 1 / np.maximum(np.sin(self.elevation), 0.02)
        color = np.exp(-_AIR_EXTINCTION * mass)
        strength = 1.353 * 0.7 ** (mass**0.678) * (1 - self.clouds) ** 1.5
        return np.asarray(strength * color / (color @ LUMINANCE_WEIGHTS))

    @property
    def sky_irradiance(self) -> float:
        """Luminance of the sky's light on level ground."""
        s = np.sin(max(self.elevation, 0.05))
        return float((1 - self.clouds) * 0.13 * np.sqrt(s) + self.clouds * 0.42 * s)

    @property
    def level_irradiance(self) -> float:
        """Luminance of all light on open level ground."""
        return float(self.sun_irradiance @ LUMINANCE_WEIGHTS * max(np.sin(self.elevation), 0.0) + self.sky_irradiance)

    def sky_radiance(self) -> NDArray[np.float32]:
        """The sky's radiance (H, 2 H, 3), without the sun: rows from the zenith to the nadir, evenly in angle; columns
        from north over east, evenly in azimuth."""
        zenith = (np.arange(SKY_ROWS) + 0.5) * np.pi / SKY_ROWS
        bearing = (np.arange(2 * SKY_ROWS) + 0.5) * np.pi / SKY_ROWS
        up = np.broadcast_to(np.cos(zenith)[:, None], (SKY_ROWS, 2 * SKY_ROWS))
        level = np.sin(zenith)[:, None]
        directions = np.stack([level * np.sin(bearing), level * np.cos(bearing), up], -1)
        above = np.maximum(up, 0.02)
        angle = np.arccos(np.clip(directions @ self.direction, -1, 1))
        clear = _cie_sky(_CLEAR_SKY, above, angle)[..., None] * _sky_tint(above)
        overcast = _cie_sky(_OVERCAST_SKY, above, angle)[..., None] * np.array(_OVERCAST_TINT)
        part = self._cloud_cover(directions, above)[..., None]
        sky = (1 - part) * _normalize_sky(clear, up, zenith) + part * _normalize_sky(overcast, up, zenith) * (
            2.2 - 1.2 * self.clouds
        )
        sky = _normalize_sky(sky, up, zenith) * self.sky_irradiance
        ground = GROUND_REFLECTANCE * self.level_irradiance / np.pi * np.array([0.9, 1.0, 0.8])
        return np.where(up[..., None] > 0, sky, ground).astype(np.float32)

    def _cloud_cover(self, directions: Array, above: Array) -> Array:
        """How much cloud (H, W) hides of the sky, 0 to 1: noise on a layer above the land."""
        rng = np.random.default_rng([self.seed, 71])
        size = 512
        noise = np.zeros((size, size), np.float32)
        for octave in range(6):
            n = 4 << octave
            grid = np.pad(rng.standard_normal((n, n)).astype(np.float32), 2, mode="wrap")
            fine = cv2.resize(grid, None, fx=size / n, fy=size / n, interpolation=cv2.INTER_CUBIC)
            edge = 2 * size // n
            noise += (fine[edge : edge + size, edge : edge + size] / 1.8**octave).astype(np.float32)
        layer = (directions[..., :2] / (above[..., None] + 0.1) * 60).astype(np.float32)
        x, y = layer[..., 0].copy(), layer[..., 1].copy()
        density = cv2.remap(noise, x % size, y % size, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        threshold = np.quantile(noise, 1 - self.clouds) if self.clouds < 1 else noise.min() - 1
        return np.asarray(np.clip(0.5 + (density - threshold) / (0.6 * noise.std()), 0, 1) * min(4 * self.clouds, 1))


def _cie_sky(kind: tuple[float, ...], above: Array, angle: Array) -> Array:
    """Relative luminance at a height whose sine is ``above`` and at ``angle`` from the sun; CIE S 011/E:2003."""
    a, b, c, d, e = kind
    scatter = 1 + c * (np.exp(d * angle) - np.exp(d * np.pi / 2)) + e * np.cos(angle) ** 2
    return np.asarray((1 + a * np.exp(b / above)) * scatter)


def _sky_tint(above: Array) -> Array:
    """The clear sky's colour: deep blue at the zenith, pale at the horizon."""
    part = np.sqrt(above)[..., None]
    color = part * np.array(_ZENITH_TINT) + (1 - part) * np.array(_HORIZON_TINT)
    return np.asarray(color / (color @ LUMINANCE_WEIGHTS)[..., None])


def _normalize_sky(sky: Array, up: Array, zenith: Array) -> Array:
    """``sky_radiance`` (H, W, 3) so that it lights level ground with a luminance of 1."""
    cell = np.sin(zenith)[:, None] * (np.pi / SKY_ROWS) ** 2
    return np.asarray(sky / ((sky @ LUMINANCE_WEIGHTS) * np.maximum(up, 0) * cell).sum())
