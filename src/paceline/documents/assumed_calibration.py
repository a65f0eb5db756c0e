"""The uncertainty of a calibration where rig.yaml states none: that of an ordinary, carefully made one.

Which parameters err together, and how much focal lengths, principal points and the position err, is what calibrations
from rendered boards state (`benchmarks/calibration.py --n 0 --rendered 30`): the root mean squares over these, rounded
up. How well pictures fit together afterwards they overrate, with 0.06 px across and 0.03 px down: lenses and mounts of
real cameras are no models. The one real rig at hand, KITTI's, is 0.15 px off in height and 0.1 px in roll.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from paceline.arrays import Array
from paceline.cameras import RigUncertainty, StereoRig

# One standard deviation each
COMMON_FOCAL_SHARE = 3e-4  # of all focal lengths, by which they err together: the distance of the board
CAMERA_FOCAL_SHARE = 1e-3  # of the two focal lengths of one camera, whose lens is not touched, but warms and ages
AXIS_FOCAL_SHARE = 5e-5  # of one focal length by itself
PRINCIPAL_POINT_SHARE = 5e-4  # of the focal length, by which a principal point is off and its camera's axes turned
PICTURE_SHIFT_PX = 0.1  # by which the pictures do not fit together across
PICTURE_HEIGHT_PX = 0.3  # by which they do not down, and by roll at ROLL_RADIUS_SHARE
ROLL_RADIUS_SHARE = 0.25  # of the picture's width
TRANSLATION_SHARE = 5e-4  # of the baseline: half a millimetre in a metre of the board


def assumed_uncertainty(rig: StereoRig) -> RigUncertainty:
    """The uncertainty of an ordinary, careful calibration of ``rig``."""
    U = _independent_changes(rig)
    return RigUncertainty(covariance=U.T @ U, is_assumed=True)


def with_assumed_uncertainty(rig: StereoRig) -> StereoRig:
    """``rig`` with the uncertainty of an ordinary, careful calibration."""
    return replace(rig, uncertainty=assumed_uncertainty(rig))


def without_statements(rig: StereoRig) -> StereoRig:
    """``rig`` as a rig.yaml describes it that states neither shutters nor uncertainty."""
    left, right = (replace(camera, readout=None) for camera in rig.cameras)
    return with_assumed_uncertainty(replace(rig, left=left, right=right))


def _independent_changes(rig: StereoRig) -> Array:
    """Changes (M, 14) of the rig by one standard deviation each, in the order of :class:`RigUncertainty`."""
    fx, fy = rig.right.K[[0, 1], [0, 1]]
    axes = np.diag([*rig.left.K[[0, 1], [0, 1]], 0.0, 0.0, fx, fy, *np.zeros(8)])[[0, 1, 4, 5]]
    changes = [COMMON_FOCAL_SHARE * axes.sum(0), *(AXIS_FOCAL_SHARE * axes)]
    changes += [CAMERA_FOCAL_SHARE * camera.sum(0) for camera in (axes[:2], axes[2:])]
    # A principal point that is off comes with the turn of its camera's axes that leaves each ray where it is.
    for side, camera, sign in ((0, rig.left, 1.0), (1, rig.right, -1.0)):
        for axis, turn in ((0, [0.0, sign, 0.0]), (1, [-sign, 0.0, 0.0])):
            change = np.zeros(14)
            change[4 * side + 2 + axis] = camera.K[axis, axis]
            change[8:11] = turn
            if side == 0:  # the right camera's axes stay, and the left one's centre in them
                change[11:] = np.cross(rig.t, turn)
            changes.append(PRINCIPAL_POINT_SHARE * change)
    roll_radius = ROLL_RADIUS_SHARE * rig.right.image_size[0]
    turns = np.array([PICTURE_HEIGHT_PX / fy, PICTURE_SHIFT_PX / fx, PICTURE_HEIGHT_PX / roll_radius])
    pose = np.diag([*np.zeros(8), *turns, *[TRANSLATION_SHARE * rig.baseline] * 3])[8:]
    return np.array([*changes, *pose])
