"""Keyframes: the frames that the refinement compares, cropped to the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

from paceline.arrays import Array, Floats


@dataclass(frozen=True, eq=False)
class Keyframe:
    """One frame: both images cropped around the vehicle, and its quadrilaterals from the filter."""

    frame: int
    times: tuple[float, float]  # s, each view's exposure
    crops: tuple[Floats, Floats]
    origins: Array  # (2, 2) the first pixel of each crop in its image
    quads: Array  # (2, 4, 2) px, of the filter
