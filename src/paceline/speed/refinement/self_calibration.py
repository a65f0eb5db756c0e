"""The rig as a prior and no rail: how far it may move from what rig.yaml states, and what that does to the pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig, perturbed_rig
from paceline.speed.refinement.trajectory import Trajectory

STEP = 1e-3  # standard uncertainties, or a share of the baseline, by which differences tell a derivative


@dataclass(frozen=True, eq=False)
class RigFit:
    """What a fit tells of its rig in Q directions in which that may move, in standard uncertainties: the ``moves``
    (Q,) at which its parameters are, the ``information`` (Q, Q) that its pictures add to what is stated, the
    ``response`` (n, Q) of its parameters to further moves, and their ``covariance`` (n, n) if the rig were known."""

    moves: Array
    information: Array
    response: Array
    covariance: Array


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
        rig = self._moved(moves)
        return replace(self.stated.grown(rig.baseline / self.stated.rig.baseline), rig=rig)

    def slopes(self, here: Trajectory, theta: Array, moves: Array, H: Array) -> Array:
        """∂H/∂moves (views, 3, 3, Q) at ``H`` (views, 3, 3), of ``theta`` (n,) and the trajectory ``here`` by ``moves``
        (Q,), by differences: the motion stays as it is, but that its path grows as the cameras part."""
        rigs = [self._moved(further) for further in moves + STEP * np.eye(len(moves))]
        by_rig = np.moveaxis((here.by_rigs(rigs, theta).reshape(-1, *H.shape) - H) / STEP, 0, -1)
        by_size = (here.grown(1.0 + STEP).homographies(theta)[0].reshape(H.shape) - H) / STEP
        growth = np.array([rig.baseline / here.rig.baseline - 1.0 for rig in rigs]) / STEP
        return np.asarray(by_rig + by_size[..., None] * growth)

    def _moved(self, moves: Array) -> StereoRig:
        """The rig moved so; it goes on stating its uncertainty."""
        rig = self.stated.rig
        return replace(perturbed_rig(rig, moves @ self.directions), uncertainty=rig.uncertainty)


def held(trajectory: Trajectory) -> FreeRig:
    """A rig that may not move."""
    return FreeRig(trajectory, np.zeros((0, 14)), 0.0)
