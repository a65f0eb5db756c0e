"""Self-calibration: what is uncertain of the cameras as parameters with a prior.

These are the rig, whose prior is the calibration and its uncertainty, and the exposures: the time between the views and
the readouts of the rows, as stated, estimated from the whole recording, or assumed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig, perturbed_rig
from paceline.speed.refinement.trajectory import Trajectory

DIFFERENCE_STEP = 1e-3  # step of finite differences, in prior standard deviations or as a share of the baseline


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """What a fit determines of its rig along Q directions, in prior standard deviations: those of the calibration.

    ``offset`` (Q,) is the rig's offset at which the motion parameters are, ``information`` (Q, Q) what the images add
    to the prior, ``response`` (n, Q) the derivative of the motion parameters by a further offset, and ``covariance``
    (n, n) theirs with the rig known, by the scatter of the images.
    """

    offset: Array
    information: Array
    response: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class RigParameters:
    """The cameras' parameters in a fit: Q of the rig and M of the exposures.

    ``stated`` is the trajectory with the rig of rig.yaml and the exposures as known beforehand, ``directions`` (Q, 14)
    are those in which the rig is uncertain, one prior standard deviation each, and ``prior_weight`` is the information
    of the prior in each of the Q + M directions.
    """

    stated: Trajectory
    directions: Array
    prior_weight: float

    def trajectory(self, offset: Array) -> Trajectory:
        """The trajectory with the cameras at ``offset`` (Q + M,), its path and plane scaled with the baseline."""
        rig = self._offset_rig(offset[: len(self.directions)])
        scaled = self.stated.scaled(rig.baseline / self.stated.rig.baseline)
        return replace(scaled, rig=rig).exposed(offset[len(self.directions) :])

    def homography_jacobian(self, trajectory: Trajectory, theta: Array, offset: Array, H: Array) -> Array:
        """∂H/∂offset (views, 3, 3, Q + M) by finite differences; the motion stays, but the path scales with the
        baseline.

        ``H`` (views, 3, 3) are the homographies of ``theta`` (n,) of ``trajectory`` at ``offset`` (Q + M,).
        """
        by_rig = self._by_rig(trajectory, theta, offset[: len(self.directions)], H)
        steps = DIFFERENCE_STEP * np.eye(len(trajectory.timing.modes))
        by_exposure = [
            (trajectory.exposed(step).homographies(theta)[0].reshape(H.shape) - H) / DIFFERENCE_STEP for step in steps
        ]
        return np.concatenate([by_rig, *(d[..., None] for d in by_exposure)], axis=-1)

    def _by_rig(self, trajectory: Trajectory, theta: Array, offset: Array, H: Array) -> Array:
        """∂H/∂offset (views, 3, 3, Q) by the rig's ``offset`` (Q,)."""
        if not len(offset):
            return np.zeros((*H.shape, 0))
        rigs = [self._offset_rig(further) for further in offset + DIFFERENCE_STEP * np.eye(len(offset))]
        by_rig = np.moveaxis(
            (trajectory.homographies_by_rig(rigs, theta).reshape(-1, *H.shape) - H) / DIFFERENCE_STEP, 0, -1
        )
        by_scale = (
            trajectory.scaled(1.0 + DIFFERENCE_STEP).homographies(theta)[0].reshape(H.shape) - H
        ) / DIFFERENCE_STEP
        scaling = np.array([rig.baseline / trajectory.rig.baseline - 1.0 for rig in rigs]) / DIFFERENCE_STEP
        return np.asarray(by_rig + by_scale[..., None] * scaling)

    def _offset_rig(self, offset: Array) -> StereoRig:
        """The rig at ``offset`` (Q,), with the same uncertainty."""
        rig = self.stated.rig
        return replace(perturbed_rig(rig, offset @ self.directions), uncertainty=rig.uncertainty)


def fixed_rig(trajectory: Trajectory) -> RigParameters:
    """Cameras without free parameters."""
    return RigParameters(trajectory, np.zeros((0, 14)), 0.0)


def rig_directions(trajectory: Trajectory) -> Array:
    """The directions (Q, 14) in which the rig of a trajectory is uncertain, one standard deviation each."""
    uncertainty = trajectory.rig.uncertainty
    if uncertainty is None:
        return np.zeros((0, 14))
    root = uncertainty.covariance_root
    return root[root.any(1)]
