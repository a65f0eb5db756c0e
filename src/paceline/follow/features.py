"""Stage 7 of [NIST]: where the features of a model are in the image, for a location of the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.cameras import Camera, line_displacement
from paceline.numba_cache import cached_njit
from paceline.targets.line_model import Target


@dataclass(frozen=True, eq=False)
class Features:
    """A model's features (35), px in the image as recorded."""

    places: Array  # (S,) across themselves
    spans: Array  # (S, 2) along themselves
    lengths: Array  # (S,)
    shifts: Array  # (S,) what the lens adds to the places


@dataclass(frozen=True, eq=False)
class Shown:
    """A model's location as the image shows it: ``location`` (3,) with the centre in recorded pixels, and what the
    lens does to each feature beyond what it does to the centre, ``shifts`` (S,) px."""

    location: Array
    shifts: Array


@cached_njit(nogil=True, error_model="numpy")
def _featured(
    location: Array, magnification: Array, vertical: NDArray[np.bool_], offsets: Array, extents: Array
) -> tuple[Array, Array, Array]:
    """The features without the lens: their places (S,), spans (S, 2) and lengths (S,), px."""
    n = len(offsets)
    places, spans, lengths = np.empty(n), np.empty((n, 2)), np.empty(n)
    for j in range(n):
        across, along = (0, 1) if vertical[j] else (1, 0)
        places[j] = location[across] + location[2] * offsets[j]
        for end in range(2):  # by element: the check of an array's shape takes seconds to compile
            spans[j, end] = location[along] + location[2] * magnification[along] * extents[j, end]
        lengths[j] = spans[j, 1] - spans[j, 0]
    return places, spans, lengths


class Projection:
    """A target as a camera sees it. Locations (3,) are c_x, c_y in ideal pixels and the scale."""

    def __init__(self, camera: Camera, target: Target) -> None:
        self.camera, self.target = camera, target
        self.magnification = target.magnification(camera)  # (2,) px per metre at scale 1
        self.offsets = target.places * np.where(target.vertical, *self.magnification)  # u and v of (35), px
        self.horizon = float(camera.K[1, 2])  # px, of a level camera
        self._extent = float(max(target.size * self.magnification))
        self._unmoved = np.zeros(len(self.offsets))

    def size(self, scale: float) -> float:
        """The target's greater extent, px."""
        return self._extent * float(scale)

    def sizes(self, scale: float) -> Array:
        """(3,): what one size of the target and its whole scale are, in the units of a location."""
        size = self.size(scale)
        return np.array([size, size, scale])

    def distance(self, scale: float) -> float:
        """m from the camera at this scale (36)."""
        return float(self.target.nominal_range / scale)

    def drop(self, location: Array) -> float:
        """How far the target's centre is below a level camera, m."""
        return float((location[1] - self.horizon) / (self.magnification[1] * location[2]))

    def lines(self, location: Array) -> Array:
        """(S, 2, 2): the ends of all segments, ideal pixels."""
        return self.target.lines(location[:2], location[2], self.magnification)

    def features(self, location: Array) -> Features:
        """The features where the lens shows them."""
        vertical = self.target.vertical
        places, spans, lengths = _featured(location, self.magnification, vertical, self.offsets, self.target.spans)
        if not self.camera.has_distortion:
            return Features(places, spans, lengths, self._unmoved)
        across, onward = line_displacement(self.camera, self.lines(location), vertical)
        return Features(places + across, spans + onward[:, None], lengths, across)

    def shown(self, location: Array) -> Shown:
        """The location as recorded."""
        if not self.camera.has_distortion:
            return Shown(location, self._unmoved)
        center = self.camera.distort_points(location[:2])
        shifts = self.features(location).shifts - np.where(self.target.vertical, *(center - location[:2]))
        return Shown(np.array([*center, location[2]]), shifts)

    def ideal(self, location: Array) -> Array:
        """A recorded location with its centre in ideal pixels."""
        if not self.camera.has_distortion:
            return location
        return np.array([*self.camera.undistort_points(location[:2]), location[2]])
