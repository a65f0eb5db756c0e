"""The plane on a vehicle that is tracked, as first outlined by the operator in both views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.geometry import triangulate
from paceline.speed.geometry.paths import Path

UPRIGHT = np.radians(6.0)  # fronts and sides of vehicles stand upright to about this
TURNED = np.radians(30.0)  # a side outlined for measurement faces the cameras to about this
ALONG_PATH, SQUARE = np.radians(1.5), np.radians(3.0)  # to this its yaw follows a path, or a travel that is a guess
# How faces stand, mean and deviation of the tilt: fronts and rears lean back, the more of bonnet or boot they hold
LEANING = {"front": np.radians((8.0, 10.0)), "side": np.radians((0.0, 5.0))}


@dataclass(frozen=True, eq=False)
class FirstPlane:
    """The plane n·P = d at the first frame.

    ``centre`` (3,) m; ``normal`` (3,), away from the cameras, so that ``distance`` > 0; ``normal_std`` (2,) rad: of
    its yaw and its tilt; ``lean``: the tilt away from it that is most likely, rad; ``inverse_depth_std``: relative,
    from the operator's hand.
    """

    centre: Array
    normal: Array
    normal_std: Array
    distance: float
    inverse_depth_std: float
    lean: float = 0.0


def first_plane(rig: StereoRig, vehicle: VehicleDocument, path: Path | None, click_sigma: float) -> FirstPlane:
    """The plane that the quadrilaterals of ``vehicle`` outline.

    A front (or rear) is perpendicular to the path and a side parallel to it; otherwise the normal comes from the
    triangulated corners, which determine it weakly at a distance, and from how vehicles stand.
    """
    centre = triangulate(rig, vehicle.left.mean(0), vehicle.right.mean(0))
    disparity_std = click_sigma * np.sqrt(2.0 / 4.0)
    relative = float(disparity_std * centre[2] / (rig.left.K[0, 0] * rig.baseline))
    if vehicle.plane == "free" or path is None:
        normal, std = normal_from_corners(rig, vehicle.left, vehicle.right, click_sigma)
        lean = 0.0
    else:
        T, P, _ = path.frames(np.array(path.nearest(centre))).T
        normal = T if vehicle.plane == "front" else P
        lean, doubt = LEANING[vehicle.plane]
        std = np.array([ALONG_PATH, doubt])
    if normal @ centre < 0:
        normal = -normal
    return FirstPlane(centre, normal, std, float(normal @ centre), relative, lean)


def squared(plane: FirstPlane, travel: Array) -> FirstPlane:
    """``plane`` set square to the direction of ``travel`` (3,), if its corners allow.

    The flat faces of vehicles are perpendicular or parallel to the way they drive. Where the corners' normal is within
    its own uncertainty of one of these, that one holds, far more closely; a face that is clearly oblique stays so.
    """
    k = travel / np.linalg.norm(travel)
    along = float(plane.normal @ k)
    oblique = np.degrees(np.arccos(np.clip(abs(along), 0.0, 1.0)))  # 0° a front, 90° a side
    doubt = 2.0 * np.degrees(float(plane.normal_std[0])) + 5.0
    if 90.0 - oblique <= min(doubt, oblique):
        normal, (lean, std) = plane.normal - along * k, LEANING["side"]
    elif oblique <= doubt:
        normal, (lean, std) = k * np.sign(along), LEANING["front"]
    else:
        return plane
    normal /= np.linalg.norm(normal)
    return FirstPlane(
        plane.centre, normal, np.array([SQUARE, std]), float(normal @ plane.centre), plane.inverse_depth_std, lean
    )


def normal_from_corners(rig: StereoRig, left: Array, right: Array, click_sigma: float) -> tuple[Array, Array]:
    """Unit normal (3,) of the plane through triangulated corners (4, 2), and the std (2,) of its yaw and tilt, rad.

    Inverse depth is linear over the image of a plane: 1/Z = (n/d)·r with rays r. That linear fit is joined with a
    prior: the plane stands upright and is not turned far from facing the cameras.
    """
    corners = triangulate(rig, left, right)
    inverse = 1.0 / corners[:, 2]
    sigma = click_sigma * np.sqrt(2.0) / (rig.left.K[0, 0] * rig.baseline)
    facing = float(inverse.mean())
    rows = np.concatenate(
        [rig.left.rays(left) / sigma, [[1 / (facing * np.tan(TURNED)), 0, 0], [0, 1 / (facing * np.tan(UPRIGHT)), 0]]]
    )
    plane = np.linalg.lstsq(rows, np.concatenate([inverse / sigma, [0.0, 0.0]]))[0]
    covariance = np.linalg.inv(rows.T @ rows) / facing**2
    return plane / np.linalg.norm(plane), np.sqrt(np.diag(covariance)[:2])
