"""Keyframes: the frames that the refinement compares, cropped to the vehicle, and when they were exposed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Floats, Mask
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

    def holds(self, side: int, pixels: Array) -> Mask:
        """Which ``pixels`` (…, 2) of a view are inside its crop (…)."""
        place, (height, width) = pixels - self.origins[side], self.crops[side].shape
        return np.asarray(((place >= 0) & (place <= (width - 1, height - 1))).all(-1))


def exposures(
    keyframes: Sequence[Keyframe], rig: StereoRig, offset: Quantity | None
) -> tuple[Array, ExposureTiming, Array]:
    """When each view exposes the vehicle, (F, 2) s, how uncertain that is, and both readouts (2,) s.

    The rows of a rolling shutter are exposed one after another: the vehicle is exposed when the row of its centre is,
    and sheared by its motion in the image while its rows are read. The times of the keyframes hold the ``offset`` (s)
    of the right view already. What is None is taken as exact.
    """
    centres = np.array([k.quads.mean(1) for k in keyframes])
    heights = np.array([camera.image_size[1] for camera in rig.cameras])
    below_middle = (centres[..., 1] + 0.5) / heights - 0.5
    times = np.array([k.times for k in keyframes])
    velocity = np.stack([np.gradient(centres[:, side], times[:, side], axis=0) for side in (0, 1)], axis=1)
    left, right = np.eye(2)
    shares = np.broadcast_to(right, times.shape), below_middle * left, below_middle * right
    readouts, modes, readout_modes, stds = np.zeros(2), [], [], {}
    for name, quantity, share, views in zip(
        EXPOSURE_QUANTITIES,
        (offset, rig.left.readout, rig.right.readout),
        shares,
        (np.zeros(2), left, right),
        strict=True,
    ):
        if quantity is None:
            continue
        readouts = readouts + quantity.value * views
        if quantity.std:
            modes.append(quantity.std * share)
            readout_modes.append(quantity.std * views)
            stds[name] = quantity.std
    timing = ExposureTiming(
        np.array(modes).reshape(-1, *times.shape),
        np.array(readout_modes).reshape(-1, 2),
        velocity / heights[:, None],
        centres[..., 1],
        stds,
    )
    return times + readouts * below_middle, timing, readouts
