"""Keyframes: the frames that the refinement compares, cropped to the vehicle, and when they were exposed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Floats
from paceline.cameras import Quantity, StereoRig
from paceline.speed.refinement.trajectory import EXPOSURE_QUANTITIES, ExposureTiming


@dataclass(frozen=True, eq=False)
class Keyframe:
    """One frame: both images cropped around the vehicle, and its quadrilaterals from the filter."""

    frame: int
    times: tuple[float, float]  # s, each view's exposure, of its middle row
    crops: tuple[Floats, Floats]
    origins: Array  # (2, 2) the first pixel of each crop in its image
    quads: Array  # (2, 4, 2) px, of the filter


def exposures(keyframes: Sequence[Keyframe], rig: StereoRig, offset: Quantity | None) -> tuple[Array, ExposureTiming]:
    """When each view exposes the vehicle, (F, 2) s, and how uncertain that is.

    The rows of a rolling shutter are exposed one after another; the vehicle is small enough for that of its centre to
    count. The times of the keyframes hold the ``offset`` (s) of the right view already. What is None is taken as exact.
    """
    rows = np.array([[quad[:, 1].mean() for quad in k.quads] for k in keyframes])
    heights = np.array([camera.image_size[1] for camera in rig.cameras])
    below_middle = (rows + 0.5) / heights - 0.5
    times = np.array([k.times for k in keyframes])
    right, left = np.array([0.0, 1.0]), np.array([1.0, 0.0])
    shares = np.broadcast_to(right, times.shape), below_middle * left, below_middle * right
    modes, stds = [], {}
    for name, quantity, share in zip(
        EXPOSURE_QUANTITIES, (offset, rig.left.readout, rig.right.readout), shares, strict=True
    ):
        if quantity is None:
            continue
        if name != "offset":
            times = times + quantity.value * share
        if quantity.std:
            modes.append(quantity.std * share)
            stds[name] = quantity.std
    return times, ExposureTiming(np.array(modes).reshape(-1, *times.shape), stds)
