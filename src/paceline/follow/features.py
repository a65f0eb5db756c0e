"""Stage 7 of [NIST]: where the features of a model are in the image, for a location of the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paceline.cameras import Camera
from paceline.follow.ranging import displaced, recorded
from paceline.follow.target import Target

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Features:
    """A model's features (35), px in the image as recorded."""

    places: Array  # (S,) across themselves
    spans: Array  # (S, 2) along themselves
    shifts: Array  # (S,) what the lens adds to the places

    @property
    def lengths(self) -> Array:
        """(S,) px."""
        return self.spans[:, 1] - self.spans[:, 0]


@dataclass(frozen=True, eq=False)
class Shown:
    """A model's location as the image shows it: ``location`` (3,) with the centre in recorded pixels, and what the
    lens does to each feature beyond what it does to the centre, ``shifts`` (S,) px."""

    location: Array
    shifts: Array


class Projection:
    """A target as a camera sees it. Locations (3,) are c_x, c_y in ideal pixels and the scale."""

    def __init__(self, camera: Camera, target: Target) -> None:
        self.camera, self.target = camera, target
        self.magnification = target.magnification(camera)  # (2,) px per metre at scale 1
        self.offsets = target.places * np.where(target.vertical, *self.magnification)  # u and v of (35), px

    def size(self, scale: float) -> float:
        """The target's greater extent, px."""
        return float(max(self.target.size * self.magnification) * scale)

    def distance(self, scale: float) -> float:
        """m from the camera at this scale (36)."""
        return float(self.target.nominal_range / scale)

    def drop(self, location: Array) -> float:
        """How far the target's centre is below a level camera, m."""
        return float((location[1] - self.camera.K[1, 2]) / (self.magnification[1] * location[2]))

    def lines(self, location: Array) -> Array:
        """(S, 2, 2): the ends of all segments, ideal pixels."""
        return self.target.lines(location[:2], location[2], self.magnification)

    def features(self, location: Array) -> Features:
        """The features where the lens shows them."""
        t, m = self.target, location[2] * self.magnification
        places = np.where(t.vertical, location[0], location[1]) + location[2] * self.offsets
        spans = np.where(t.vertical, location[1], location[0])[:, None]
        spans = spans + np.where(t.vertical, m[1], m[0])[:, None] * t.spans
        if not self.camera.has_distortion:
            return Features(places, spans, np.zeros(len(places)))
        across, onward = displaced(self.camera, self.lines(location), t.vertical)
        return Features(places + across, spans + onward[:, None], across)

    def shown(self, location: Array) -> Shown:
        """The location as recorded."""
        if not self.camera.has_distortion:
            return Shown(location, np.zeros(len(self.offsets)))
        center = recorded(self.camera, location[:2])
        shifts = self.features(location).shifts - np.where(self.target.vertical, *(center - location[:2]))
        return Shown(np.array([*center, location[2]]), shifts)

    def ideal(self, location: Array) -> Array:
        """A recorded location with its centre in ideal pixels."""
        if not self.camera.has_distortion:
            return location
        return np.array([*self.camera.undistort_points(location[:2]), location[2]])
