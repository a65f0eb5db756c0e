"""The tracked plane of a vehicle at the first frame, from the quadrilaterals drawn in both views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.geometry import triangulate
from paceline.speed.geometry.paths import Path

TILT_STD_RAD = np.radians(6.0)  # of the tilt from the vertical, where only the corners are known
YAW_STD_RAD = np.radians(30.0)  # of the yaw from facing the cameras, where only the corners are known
PATH_YAW_STD_RAD = np.radians(1.5)  # of the yaw from that of the path
TRAVEL_YAW_STD_RAD = np.radians(3.0)  # of the yaw from that of the direction of travel, which is estimated itself
# Mean and standard deviation of the tilt: fronts and rears lean back, the more so the more bonnet or boot they contain
TILT_PRIOR_RAD = {"front": np.radians((8.0, 10.0)), "side": np.radians((0.0, 5.0))}

Face = Literal["front", "side"]  # perpendicular to the direction of travel (a rear, too), or parallel to it
# Median width of an outlined face, m, and standard deviation of its logarithm: cars and lorries, whole or in part
FACE_WIDTH_M: dict[Face, tuple[float, float]] = {"front": (1.8, 0.25), "side": (3.5, 0.5)}


@dataclass(frozen=True, eq=False)
class InitialPlane:
    """The plane n·P = d at the first frame.

    ``centre`` (3,) m; ``normal`` (3,), away from the cameras, so that ``distance`` > 0; ``normal_std`` (2,) rad: of
    its yaw and its tilt; ``mean_tilt``: the prior mean of the tilt from it, rad; ``inverse_depth_std``: relative, from
    the drawing noise.
    """

    centre: Array
    normal: Array
    normal_std: Array
    distance: float
    inverse_depth_std: float
    mean_tilt: float = 0.0


def plane_from_outlines(
    rig: StereoRig, vehicle: VehicleDocument, path: Path | None, click_sigma: float
) -> InitialPlane:
    """The plane that the quadrilaterals of ``vehicle`` outline, with a drawing noise of ``click_sigma`` px per corner.

    A front (or rear) is perpendicular to the path and a side parallel to it; otherwise the normal comes from the
    triangulated corners, which determine it weakly at a distance, joined with a prior. It is where the left view is
    exposed.
    """
    rig = rig.displaced(vehicle.displacement)
    centre = triangulate(rig, vehicle.left.mean(0), vehicle.right.mean(0))
    disparity_std = click_sigma * np.sqrt(2.0 / 4.0)
    relative = float(disparity_std * centre[2] / (rig.left.K[0, 0] * rig.baseline))
    if vehicle.plane == "free" or path is None:
        normal, std = normal_from_corners(rig, vehicle.left, vehicle.right, click_sigma)
        mean_tilt = 0.0
    else:
        T, P, _ = path.frames(np.array(path.nearest(centre))).T
        normal = T if vehicle.plane == "front" else P
        mean_tilt, tilt_std = TILT_PRIOR_RAD[vehicle.plane]
        std = np.array([PATH_YAW_STD_RAD, tilt_std])
    if normal @ centre < 0:
        normal = -normal
    return InitialPlane(centre, normal, std, float(normal @ centre), relative, mean_tilt)


def plane_across(plane: InitialPlane, travel: Array) -> InitialPlane:
    """``plane`` made perpendicular or parallel to the direction of ``travel`` (3,), if its corners allow.

    The flat faces of vehicles are perpendicular or parallel to their direction of travel. Where the corners' normal is
    within its own uncertainty of one of these, that one is taken; a face that is clearly oblique is left unchanged.
    """
    face = nearest_face(plane, travel)
    if face is None:
        return plane
    normal, (mean_tilt, std) = normal_of_face(plane.normal, travel, face), TILT_PRIOR_RAD[face]
    return InitialPlane(
        plane.centre,
        normal,
        np.array([TRAVEL_YAW_STD_RAD, std]),
        float(normal @ plane.centre),
        plane.inverse_depth_std,
        mean_tilt,
    )


def likeliest_face(
    rig: StereoRig, vehicle: VehicleDocument, plane: InitialPlane, travel: Array, travel_std: float = 0.0
) -> Face | None:
    """The outlined face of ``vehicle``: the stated one, or the likelier by the normal of ``plane`` and by the width of
    the outline on it; None where the normal is clearly oblique to the direction of ``travel`` (3,).

    ``travel_std`` is the standard deviation of that direction's yaw, rad.
    """
    if vehicle.plane != "free":
        return vehicle.plane
    std = float(np.hypot(plane.normal_std[0], travel_std))
    candidates: list[tuple[float, Face]] = []
    for face, (width, log_std) in FACE_WIDTH_M.items():
        normal = normal_of_face(plane.normal, travel, face)
        angle = float(np.arccos(np.clip(plane.normal @ normal, -1.0, 1.0)))
        if angle <= 2.0 * std + np.radians(5.0):
            rays = rig.left.rays(vehicle.left)
            corners = rays * (normal @ plane.centre / (rays @ normal))[:, None]
            outline = np.linalg.norm(corners[1] - corners[0] + corners[2] - corners[3]) / 2.0
            of_width = np.log(outline / width) / log_std
            log_odds = float(-0.5 * (angle / std) ** 2 - 0.5 * of_width**2 - np.log(log_std))
            candidates.append((log_odds, face))
    return max(candidates)[1] if candidates else None


def normal_of_face(normal: Array, travel: Array, face: Face) -> Array:
    """The unit vector next to ``normal`` (3,) that is along the ``travel`` (3,) for a front, across it for a side."""
    k = travel / np.linalg.norm(travel)
    along = float(normal @ k)
    turned = normal - along * k if face == "side" else k * np.sign(along)
    return np.asarray(turned / np.linalg.norm(turned))


def nearest_face(plane: InitialPlane, travel: Array) -> Face | None:
    """The face that ``plane`` is by its angle to the direction of ``travel`` (3,); None where it is clearly oblique."""
    along = float(plane.normal @ (travel / np.linalg.norm(travel)))
    oblique = np.degrees(np.arccos(np.clip(abs(along), 0.0, 1.0)))  # 0° a front, 90° a side
    limit = 2.0 * np.degrees(float(plane.normal_std[0])) + 5.0
    if 90.0 - oblique <= min(limit, oblique):
        return "side"
    return "front" if oblique <= limit else None


def normal_from_corners(rig: StereoRig, left: Array, right: Array, click_sigma: float) -> tuple[Array, Array]:
    """Unit normal (3,) of the plane through triangulated corners (4, 2), and the std (2,) of its yaw and tilt, rad.

    Inverse depth is linear over the image of a plane: 1/Z = (n/d)·r with rays r. That linear fit is joined with a
    prior: the plane is nearly vertical and nearly faces the cameras.
    """
    corners = triangulate(rig, left, right)
    inverse = 1.0 / corners[:, 2]
    sigma = click_sigma * np.sqrt(2.0) / (rig.left.K[0, 0] * rig.baseline)
    facing = float(inverse.mean())
    rows = np.concatenate(
        [
            rig.left.rays(left) / sigma,
            [[1 / (facing * np.tan(YAW_STD_RAD)), 0, 0], [0, 1 / (facing * np.tan(TILT_STD_RAD)), 0]],
        ]
    )
    plane = np.linalg.lstsq(rows, np.concatenate([inverse / sigma, [0.0, 0.0]]))[0]
    covariance = np.linalg.inv(rows.T @ rows) / facing**2
    return plane / np.linalg.norm(plane), np.sqrt(np.diag(covariance)[:2])
