"""The static model of [NIST] 2.1.1: the back of the vehicle ahead as horizontal and vertical line segments."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from paceline.arrays import Array, Indices, Mask
from paceline.cameras import Camera
from paceline.documents import loading
from paceline.documents.plausibility import MAX_SEGMENT_OBLIQUENESS


@dataclass(frozen=True, eq=False)
class Target:
    """Line segments on the rear plane of the vehicle ahead, in metres, x right and y down from its centre.

    ``corners`` (C, 2) are the points and ``segments`` (S, 2) the two corners that each line joins; scale 1 is the size
    at ``nominal_range`` metres; ``tolerance`` is the standard deviation of their width in metres, for a model that was
    not measured by hand. Raises ValueError, in one line, for a model that cannot be located: each segment must
    join two corners there are along x or along y, and both directions must occur.
    """

    name: str
    nominal_range: float
    corners: Array
    segments: Indices
    tolerance: float = 0.0
    vertical: Mask = field(init=False)  # (S,)

    def __post_init__(self) -> None:
        corners = np.array(self.corners, float).reshape(-1, 2)
        segments = np.array(self.segments, np.int64).reshape(-1, 2)
        if not (np.isfinite(self.nominal_range) and self.nominal_range > 0):
            raise ValueError(f"nominal_range: expected metres above 0, found {self.nominal_range:g}")
        if not (np.isfinite(self.tolerance) and self.tolerance >= 0):
            raise ValueError(f"tolerance: expected metres, 0 or above, found {self.tolerance:g}")
        if not np.isfinite(corners).all():
            raise ValueError("corners: expected finite metres")
        for i, (a, b) in enumerate(segments):
            if not (0 <= a < len(corners) and 0 <= b < len(corners)):
                raise ValueError(f"segments[{i}]: names a corner that is not in corners")
            along = np.abs(corners[b] - corners[a])
            if along.max() == 0:
                raise ValueError(f"segments[{i}]: its two corners lie in one place")
            if along.min() > MAX_SEGMENT_OBLIQUENESS * along.max():
                raise ValueError(f"segments[{i}]: is oblique; expected a horizontal or a vertical line")
        along = np.abs(corners[segments[:, 1]] - corners[segments[:, 0]])
        vertical = along[:, 1] > along[:, 0]
        if not vertical.any() or vertical.all():
            missing = "horizontal" if len(segments) and vertical.all() else "vertical"
            raise ValueError(f"segments: expected horizontal and vertical ones, found no {missing} one")
        for name, value in (("corners", corners), ("segments", segments), ("vertical", vertical)):
            object.__setattr__(self, name, value)

    @cached_property
    def places(self) -> Array:
        """(S,) m: u of the vertical and v of the horizontal segments, as in (15), each across its direction."""
        middle: Array = self.corners[self.segments].mean(1)
        return np.where(self.vertical, middle[:, 0], middle[:, 1])

    @cached_property
    def spans(self) -> Array:
        """(S, 2) m: start and end of each segment along its direction."""
        ends = self.corners[self.segments]
        along = np.where(self.vertical[:, None], ends[:, :, 1], ends[:, :, 0])
        return np.sort(along, axis=1)

    @cached_property
    def box(self) -> Array:
        """(4,) m: x0, y0, x1, y1 around all segments."""
        used_corners = self.corners[self.segments.ravel()]
        return np.concatenate([used_corners.min(0), used_corners.max(0)])

    @cached_property
    def size(self) -> Array:
        """(2,) m: width and height."""
        return np.subtract(self.box[2:], self.box[:2])

    def magnification(self, camera: Camera) -> Array:
        """(2,) px per metre along x and y at scale 1."""
        return np.array([camera.K[0, 0], camera.K[1, 1]]) / self.nominal_range

    def lines(self, center: Array, scale: float, magnification: Array) -> Array:
        """(S, 2, 2) px: the ends of every segment for a location, (35)."""
        return np.asarray(center + scale * magnification * self.corners[self.segments], float)


def target_of(document: loading.TargetDocument) -> Target:
    """The model that a target.yaml describes, as the tracker needs it."""
    return Target(document.name, document.nominal_range, document.corners, document.segments, document.tolerance)


def load_target(path: str | Path) -> Target:
    """The model in the target.yaml ``path``; raises UnusableInput, naming the key, for one that cannot be."""
    return target_of(loading.load_target(path))
