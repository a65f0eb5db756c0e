"""The filter's estimate at one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.recordings.stereo import StereoFrame
from paceline.speed.filter.motion_models import State, diagonal_crossings
from paceline.speed.filter.particle_set import MAX_DRAWN_PARTICLES, Posterior
from paceline.speed.geometry.initial_plane import InitialPlane

MIN_REFERENCE_SIMILARITY = 0.55  # to the reference, above which a frame updates it
MIN_VISIBLE_SIMILARITY = 0.25  # to the reference, below which the vehicle is occluded
MIN_VEHICLE_DEPTH_M = 1.0  # m before the left camera, below which a vehicle has left the image


@dataclass(frozen=True, eq=False)
class Estimate:
    """The filter's estimate at one frame (SI units, ideal pixels)."""

    frame: int
    time: float
    speed: float
    speed_std: float
    position: Array  # (3,)
    yaw_rate: float  # rad/s, positive to the right; NaN at the first frame
    left: Array  # (4, 2)
    right: Array  # (4, 2)
    ess: float
    status: str  # tracking | lost | ended
    similarity: float  # correlation with the reference, −1 … 1
    particles_left: Array  # (N, 2) of at most `particle_set.MAX_DRAWN_PARTICLES` particles
    particles_right: Array  # (N, 2)
    vehicle: str = ""  # its id


def initial_estimate(
    frame: StereoFrame, vehicle: VehicleDocument, plane: InitialPlane, state: State, n: int
) -> Estimate:
    """The estimate at the first frame: the operator's quadrilaterals, ``n`` particles of equal weights, and the
    operator's speed, NaN where none is stated."""
    drawn = slice(None, n, -(-n // MAX_DRAWN_PARTICLES))
    return Estimate(
        frame=frame.index,
        time=frame.time,
        speed=vehicle.speed or float("nan"),
        speed_std=float("nan"),
        position=plane.centre,
        yaw_rate=float("nan"),
        left=vehicle.left,
        right=vehicle.right,
        ess=float(n),
        status="tracking",
        similarity=1.0,
        particles_left=diagonal_crossings(state.left[drawn]),
        particles_right=diagonal_crossings(state.right[drawn]),
        vehicle=vehicle.id,
    )


def estimate_from(
    posterior: Posterior, frame: StereoFrame, yaw_rate: float, similarity: float, status: str, vehicle: str
) -> Estimate:
    """The estimate at ``frame`` from the ``posterior``, of the vehicle with this id."""
    return Estimate(
        frame=frame.index,
        time=frame.time,
        speed=posterior.speed,
        speed_std=posterior.speed_std,
        position=posterior.position,
        yaw_rate=yaw_rate,
        left=posterior.mean.left[0],
        right=posterior.mean.right[0],
        ess=posterior.ess,
        status=status,
        similarity=similarity,
        particles_left=posterior.particles_left,
        particles_right=posterior.particles_right,
        vehicle=vehicle,
    )


def has_left_image(posterior: Posterior, rig: StereoRig) -> bool:
    """Whether a corner of the mean region is outside its image, or the vehicle nearer than `MIN_VEHICLE_DEPTH_M`."""
    for corners, camera in ((posterior.mean.left[0], rig.left), (posterior.mean.right[0], rig.right)):
        inside = (corners >= 0) & (corners <= np.array(camera.image_size) - 1)  # false where a corner is not finite
        if not inside.all():
            return True
    return bool(posterior.position[2] < MIN_VEHICLE_DEPTH_M)
