"""Sun and sky: the directional light of the sun and a map of the sky's radiance.

Irradiances are in kW/m², radiances in kW/m²/sr. Light has three channels, red, green and blue; a scalar irradiance is
their mean with the weights ``LUMINANCE_WEIGHTS``. Directions are in world axes: x east, y north, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array

SKY_ROWS = 256  # rows of the map, half of them above the horizon
GROUND_REFLECTANCE = 0.12  # reflectance of the land beyond the world's edge
LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # of red, green and blue, Rec. 709
SOLAR_CONSTANT = 1.353  # kW/m² above the atmosphere, as in Meinel and Meinel's formula
MIN_SIN_ELEVATION = 0.02  # least sine of an elevation, which bounds the air mass and the sky at the horizon
MIN_SKY_ELEVATION = 0.05  # least elevation of the sun (rad) for the sky's irradiance, so that dusk is not black
# The sky's irradiance of level ground (kW/m²) with the sun at the zenith: approximate values
CLEAR_SKY_IRRADIANCE, OVERCAST_SKY_IRRADIANCE = 0.13, 0.42
CLOUD_BRIGHTNESS = 2.2  # radiance of a small cloud over that of the clear sky; it decreases to 1 for an overcast sky

CLOUD_MAP_SIZE = 512  # pixels of the square map of cloud density, which repeats
CLOUD_OCTAVES = 6  # octaves of the noise that it is made of
COARSEST_CLOUD_CELLS = 4  # cells of the coarsest octave along each side
CLOUD_OCTAVE_RATIO = 1.8  # ratio of the amplitudes of successive octaves
CLOUD_PIXELS_PER_HEIGHT = 60.0  # pixels of that map per height of the cloud layer
CLOUD_HORIZON_SINE = 0.1  # added to the sine of the elevation: clouds at the horizon stay large enough to be resolved
CLOUD_EDGE_WIDTH = 0.6  # width of a cloud's edge, in standard deviations of the density
FULL_CLOUD_SHARE = 0.25  # least ``clouds`` with which clouds are opaque; fewer are also more transparent

# CIE S 011: gradation a, b and scattering c, d, e of the clear sky (type 12) and of the overcast one (type 1).
_CLEAR_SKY = (-1.0, -0.32, 10.0, -3.0, 0.45)
_OVERCAST_SKY = (4.0, -0.7, 0.0, -1.0, 0.0)
# Relative radiance of red, green and blue; only the ratios count. Approximate values
_ZENITH_TINT, _HORIZON_TINT, _OVERCAST_TINT = ((0.62, 0.95, 1.75), (0.95, 1.0, 1.1), (0.98, 1.0, 1.03))
_GROUND_TINT = (0.9, 1.0, 0.8)  # reflectance of the land over GROUND_REFLECTANCE, in red, green and blue
# Optical depth of the air at air mass 1 (sun at the zenith) in red, green and blue: about that of Rayleigh scattering
_AIR_OPTICAL_DEPTH = np.array([0.06, 0.11, 0.23])


@dataclass(frozen=True)
class Light:
    """The sun at ``azimuth`` (rad from east, counter-clockwise) and ``elevation`` (rad).

    ``clouds`` is the share of the sky that clouds cover: 0 is a clear sky, 1 an overcast one, in which nothing casts a
    shadow. ``seed`` is that of the clouds' pattern.
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
        """Irradiance (3,) of a surface that faces the sun.

        Its mean is that of Meinel and Meinel (Applied Solar Energy, 1976), 1.353 · 0.7^(m^0.678) for an air mass m,
        times the share (1 − clouds)^1.5 that clouds transmit; its colour is that of the air's transmittance.
        """
        air_mass = 1 / np.maximum(np.sin(self.elevation), MIN_SIN_ELEVATION)
        transmittance = np.exp(-_AIR_OPTICAL_DEPTH * air_mass)
        mean = SOLAR_CONSTANT * 0.7 ** (air_mass**0.678) * (1 - self.clouds) ** 1.5
        return np.asarray(mean * transmittance / (transmittance @ LUMINANCE_WEIGHTS))

    @property
    def sky_irradiance(self) -> float:
        """Irradiance of level ground by the sky, without the sun."""
        sin_sun = np.sin(max(self.elevation, MIN_SKY_ELEVATION))
        return float(
            (1 - self.clouds) * CLEAR_SKY_IRRADIANCE * np.sqrt(sin_sun)
            + self.clouds * OVERCAST_SKY_IRRADIANCE * sin_sun
        )

    @property
    def level_irradiance(self) -> float:
        """Irradiance of open level ground by the sun and the sky."""
        return float(self.sun_irradiance @ LUMINANCE_WEIGHTS * max(np.sin(self.elevation), 0.0) + self.sky_irradiance)

    def sky_radiance(self) -> NDArray[np.float32]:
        """Radiance (H, 2 H, 3) of the sky without the sun, and of the ground below the horizon.

        Rows go from the zenith to the nadir in equal steps of the angle, columns from north over east in equal steps of
        the azimuth.
        """
        zenith_angle = (np.arange(SKY_ROWS) + 0.5) * np.pi / SKY_ROWS
        bearing = (np.arange(2 * SKY_ROWS) + 0.5) * np.pi / SKY_ROWS
        sin_elevation = np.broadcast_to(np.cos(zenith_angle)[:, None], (SKY_ROWS, 2 * SKY_ROWS))
        cos_elevation = np.sin(zenith_angle)[:, None]
        directions = np.stack([cos_elevation * np.sin(bearing), cos_elevation * np.cos(bearing), sin_elevation], -1)
        sky_sine = np.maximum(sin_elevation, MIN_SIN_ELEVATION)
        sun_angle = np.arccos(np.clip(directions @ self.direction, -1, 1))
        clear = _cie_sky(_CLEAR_SKY, sky_sine, sun_angle)[..., None] * _sky_tint(sky_sine)
        overcast = _cie_sky(_OVERCAST_SKY, sky_sine, sun_angle)[..., None] * np.array(_OVERCAST_TINT)
        cloud_fraction = self._cloud_fraction(directions, sky_sine)[..., None]
        cloud_brightness = CLOUD_BRIGHTNESS - (CLOUD_BRIGHTNESS - 1) * self.clouds
        sky = (1 - cloud_fraction) * _normalize_sky(
            clear, sin_elevation, zenith_angle
        ) + cloud_fraction * _normalize_sky(overcast, sin_elevation, zenith_angle) * cloud_brightness
        sky = _normalize_sky(sky, sin_elevation, zenith_angle) * self.sky_irradiance
        # a Lambertian surface: radiance = reflectance · irradiance / π
        ground = GROUND_REFLECTANCE * self.level_irradiance / np.pi * np.array(_GROUND_TINT)
        return np.where(sin_elevation[..., None] > 0, sky, ground).astype(np.float32)

    def _cloud_fraction(self, directions: Array, sin_elevation: Array) -> Array:
        """The share (H, W) of the sky that clouds hide in each direction: noise on a plane layer above the land."""
        rng = np.random.default_rng([self.seed, 71])
        size = CLOUD_MAP_SIZE
        noise = np.zeros((size, size), np.float32)
        for octave in range(CLOUD_OCTAVES):
            n = COARSEST_CLOUD_CELLS << octave
            grid = np.pad(rng.standard_normal((n, n)).astype(np.float32), 2, mode="wrap")
            fine = cv2.resize(grid, None, fx=size / n, fy=size / n, interpolation=cv2.INTER_CUBIC)
            edge = 2 * size // n
            noise += (fine[edge : edge + size, edge : edge + size] / CLOUD_OCTAVE_RATIO**octave).astype(np.float32)
        layer = directions[..., :2] / (sin_elevation[..., None] + CLOUD_HORIZON_SINE) * CLOUD_PIXELS_PER_HEIGHT
        layer = layer.astype(np.float32)
        x, y = layer[..., 0].copy(), layer[..., 1].copy()
        density = cv2.remap(noise, x % size, y % size, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        threshold = np.quantile(noise, 1 - self.clouds) if self.clouds < 1 else noise.min() - 1
        fraction = np.clip(0.5 + (density - threshold) / (CLOUD_EDGE_WIDTH * noise.std()), 0, 1)
        return np.asarray(fraction * min(self.clouds / FULL_CLOUD_SHARE, 1))


def _cie_sky(parameters: tuple[float, ...], sin_elevation: Array, sun_angle: Array) -> Array:
    """Relative luminance (H, W) of a sky with the CIE's ``parameters`` a to e, in a direction of this elevation and at
    ``sun_angle`` (rad) from the sun; CIE S 011/E:2003."""
    a, b, c, d, e = parameters
    scatter = 1 + c * (np.exp(d * sun_angle) - np.exp(d * np.pi / 2)) + e * np.cos(sun_angle) ** 2
    return np.asarray((1 + a * np.exp(b / sin_elevation)) * scatter)


def _sky_tint(sin_elevation: Array) -> Array:
    """The clear sky's colour (H, W, 3), of mean 1: deep blue at the zenith, pale at the horizon."""
    zenith_weight = np.sqrt(sin_elevation)[..., None]
    color = zenith_weight * np.array(_ZENITH_TINT) + (1 - zenith_weight) * np.array(_HORIZON_TINT)
    return np.asarray(color / (color @ LUMINANCE_WEIGHTS)[..., None])


def _normalize_sky(radiance: Array, sin_elevation: Array, zenith_angle: Array) -> Array:
    """The ``radiance`` (H, W, 3) of a sky, scaled so that its irradiance of level ground is 1."""
    solid_angle = np.sin(zenith_angle)[:, None] * (np.pi / SKY_ROWS) ** 2
    return np.asarray(radiance / ((radiance @ LUMINANCE_WEIGHTS) * np.maximum(sin_elevation, 0) * solid_angle).sum())
