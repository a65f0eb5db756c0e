"""The rig as a prior and no rail: how far it may move from what rig.yaml states, and what that does to the pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from paceline.cameras import StereoRig, moved_rig
from paceline.speed.trajectory import Trajectory

Array = NDArray[np.float64]

STEP = 1e-3  # standard uncertainties, or a share of the baseline, by which differences tell a derivative


@dataclass(frozen=True, eq=False)
class FreeRig:
    """The trajectory as ``stated``, the ``directions`` (Q, 14) in which its rig may move, one standard uncertainty
    each, and the ``firmness`` of each: how much information it counts for."""

    stated: Trajectory
    directions: Array
    firmness: float

    def trajectory(self, moves: Array) -> Trajectory:
        """The trajectory with the rig moved by ``moves`` (Q,) standard uncertainties, and all that was reconstructed as
        large as that rig would have made it."""
        return replace(self.stated.grown(self._farther_apart(moves)), rig=self._moved(moves))

    def slopes(self, theta: Array, moves: Array, H: Array) -> Array:
        """∂H/∂moves (views, 3, 3, Q) at ``H`` (views, 3, 3), of ``theta`` (n,) and ``moves`` (Q,), by differences: the
        motion stays as it is, but that its path grows as the cameras part."""
        here, further = self.trajectory(moves), moves + STEP * np.eye(len(moves))
        seen = here.by_rigs([self._moved(m) for m in further], theta)
        by_rig = np.moveaxis((seen.reshape(-1, *H.shape) - H) / STEP, 0, -1)
        by_size = (here.grown(1.0 + STEP).homographies(theta)[0].reshape(H.shape) - H) / STEP
        growth = [(self._farther_apart(m) / self._farther_apart(moves) - 1.0) / STEP for m in further]
        return np.asarray(by_rig + by_size[..., None] * np.array(growth))

    def _moved(self, moves: Array) -> StereoRig:
        """The rig moved so; it goes on stating its uncertainty."""
        rig = self.stated.rig
        return replace(moved_rig(rig, moves @ self.directions), uncertainty=rig.uncertainty)

    def _farther_apart(self, moves: Array) -> float:
        """How many times as far apart the cameras are then."""
        return self._moved(moves).baseline / self.stated.rig.baseline


def held(trajectory: Trajectory) -> FreeRig:
    """A rig that may not move."""
    return FreeRig(trajectory, np.zeros((0, 14)), 0.0)
