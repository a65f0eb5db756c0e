"""The frames that the refinement compares: what it keeps of each."""

from __future__ import annotations

from dataclasses import dataclass

from paceline.arrays import Array, Floats


@dataclass(frozen=True, eq=False)
class Glimpse:
    """What the refinement keeps of one frame: both images about the vehicle, and the filter's regions there."""

    frame: int
    times: tuple[float, float]  # s, each view's exposure
    crops: tuple[Floats, Floats]
    corners: Array  # (2, 2) first pixel of each crop
    quads: Array  # (2, 4, 2) px, of the filter
