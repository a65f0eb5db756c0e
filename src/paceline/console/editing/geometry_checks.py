"""Checks drawn paths and vehicles in space: distances, sizes, consistency of the two views. Pixels are as recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig, direction_name
from paceline.console.editing.clip_document import Entry
from paceline.console.editing.cross_view_proposals import Proposal, propose_line, propose_quadrilateral, swapped_views
from paceline.documents.plausibility import check_drawing, check_path_points, check_quadrilateral, check_views
from paceline.errors import UnusableInput
from paceline.geometry import epipolar_distance, triangulate
from paceline.speed.configuration import DEFAULTS
from paceline.speed.geometry.path_reconstruction import reconstruct
from paceline.speed.geometry.paths import Path, from_points

Facts = dict[str, Any]

VEHICLE_WIDTH_RANGE_M, VEHICLE_HEIGHT_RANGE_M = (0.3, 20.0), (0.1, 4.5)  # from a number plate to a lorry's side
MAX_EPIPOLAR_DISTANCE_PX = 3.0  # epipolar distance of a corner that click noise can cause
EPIPOLAR_MARKS_M = (5, 10, 20, 30, 50, 80, 150)  # distances marked on an epipolar line
MIN_CORRECTED_DISTANCE_M = 0.5  # from the lane centre, beyond which another one is offered
MAX_OFFERED_DISTANCE_M = 1.5  # from the centre of a lane that is offered
MAX_ROAD_SLOPE = 0.7  # greatest slope in camera axes, as the cameras may be tilted; steeper is a mistake


def epipolar_line(rig: StereoRig, view: int, pixel: Array) -> dict[str, list[Any]]:
    """The epipolar line in the other view of a ``pixel`` (2,) of ``view`` (0 left, 1 right): a polyline from far to
    near, and points at EPIPOLAR_MARKS_M, ``[metres, x, y]``."""
    pair = rig if view == 0 else swapped_views(rig)
    ray = pair.left.rays(pair.left.undistort_points(pixel[None]))[0]
    inverse = np.linspace(1e-4, 0.5, 64)
    line, visible_points = _project_ray(pair, ray, inverse)
    marks, visible = _project_ray(pair, ray, 1.0 / np.array(EPIPOLAR_MARKS_M, float))
    return {
        "line": np.round(line[visible_points], 2).tolist(),
        "marks": [
            [m, *np.round(p, 2).tolist()] for m, p, ok in zip(EPIPOLAR_MARKS_M, marks, visible, strict=True) if ok
        ],
    }


def _project_ray(pair: StereoRig, ray: Array, inverse: Array) -> tuple[Array, NDArray[np.bool_]]:
    points = ray / inverse[:, None]
    in_right = pair.to_right(points)
    ahead = in_right[:, 2] > 0.05 * points[:, 2]
    width, height = pair.right.image_size
    ideal = pair.right.project(np.where(ahead[:, None], in_right, [0.0, 0.0, 1.0]))
    near_image = (np.abs(ideal - [width / 2, height / 2]) < [width, height]).all(
        axis=1
    )  # the lens model holds only there
    pixels = pair.right.distort_points(np.where((ahead & near_image)[:, None], ideal, 0.0))
    return pixels, ahead & near_image


def check_setup(rig: StereoRig, paths: Mapping[str, Entry], vehicles: list[Entry]) -> dict[str, Any]:
    """Checks every path (by name) and vehicle (in order): facts in metres, ``problem`` where one cannot be measured,
    ``warning`` where it is implausible."""
    paths_in_space: dict[str, Path] = {}
    path_facts = {name: _check_path(rig, name, entry, paths_in_space) for name, entry in paths.items()}
    for name, path in paths_in_space.items():
        path_facts[name] |= _nearest_path(name, path, paths_in_space)
    return {"paths": path_facts, "vehicles": [_check_vehicle(rig, entry, paths, paths_in_space) for entry in vehicles]}


def _check_path(rig: StereoRig, name: str, entry: Entry, paths_in_space: dict[str, Path]) -> Facts:
    try:
        path = paths_in_space[name] = _path(rig, name, entry)
    except UnusableInput as error:
        return {"problem": str(error).removeprefix(f"path {name}: ")}
    ends = path.points[[0, -1]]
    across = float(np.hypot(*(ends[1] - ends[0])[[0, 2]]))
    slope = float(abs(ends[1, 1] - ends[0, 1]) / max(across, 1e-6))
    yaw = np.degrees(float(np.median(np.sqrt((path.heading_modes(path.s)[0] ** 2).sum(axis=0)))))
    depths = path.points[:, 2]
    facts: Facts = {
        "near_m": float(depths.min()), "far_m": float(depths.max()), "length_m": float(path.s[-1] - path.s[0]),
        "slope": slope, "direction_std_deg": yaw,
    }  # fmt: skip
    if slope > MAX_ROAD_SLOPE:
        facts["warning"] = "it is steeper than a road can be; is the same line drawn in both views?"
    return facts


def _path(rig: StereoRig, name: str, entry: Entry) -> Path:
    if "points" in entry:
        points = np.array(entry["points"], float)
        if problem := check_path_points(points):
            raise UnusableInput(problem)
        return from_points(name, entry["shape"], points)
    drawn = []
    for side, camera in zip(("left", "right"), rig.cameras, strict=True):
        pixels = np.array(entry.get(side) or [], float).reshape(-1, 2)
        if not len(pixels):
            raise UnusableInput(f"draw the same line in the {side} view")
        if problem := check_drawing(pixels, entry["shape"]):
            raise UnusableInput(f"{side} view: {problem}")
        drawn.append(camera.undistort_points(pixels))
    return reconstruct(name, entry["shape"], rig, drawn[0], drawn[1])


def _nearest_path(name: str, path: Path, paths: Mapping[str, Path]) -> Facts:
    """The nearest other path, and its distance from the middle of this one."""
    middle = path.points[len(path.points) // 2]
    gaps = {
        other: float(np.linalg.norm(p.at(np.array(p.nearest(middle))) - middle))
        for other, p in paths.items()
        if other != name
    }
    if not gaps:
        return {}
    nearest = min(gaps, key=lambda other: gaps[other])
    return {"beside": nearest, "gap_m": gaps[nearest]}


def _check_vehicle(
    rig: StereoRig, entry: Entry, paths: Mapping[str, Entry], paths_in_space: Mapping[str, Path]
) -> Facts:
    ideal = []
    for side, camera in zip(("left", "right"), rig.cameras, strict=True):
        corners = np.array(entry.get(side) or [], float).reshape(-1, 2)
        if len(corners) != 4:
            return {"problem": f"outline the same part in the {side} view"}
        if problem := check_quadrilateral(corners, camera.image_size):
            return {"problem": f"{side} view: {problem}"}
        ideal.append(camera.undistort_points(corners))
    left, right = ideal
    if problem := check_views(rig, left, right):
        return {"problem": problem}
    tl, tr, br, bl = triangulate(rig, left, right)
    centre = triangulate(rig, left.mean(axis=0), right.mean(axis=0))
    epipolar_px = float(np.abs(epipolar_distance(rig, left, right)).max())
    # sizes at the centre's depth: the depth of a single corner is too uncertain
    scale = float(centre[2]) / np.sqrt(np.prod(rig.left.K[[0, 1], [0, 1]]))
    width, height = (
        scale * float(np.linalg.norm(d, axis=1).mean()) for d in (_horizontal_edges(left), _vertical_edges(left))
    )
    facts: Facts = {
        "distance_m": float(np.linalg.norm(centre)), "width_m": width, "height_m": height, "epipolar_px": epipolar_px,
        "distance_std_m": DEFAULTS.click_sigma * np.sqrt(0.5) * float(centre[2]) ** 2
        / (rig.left.K[0, 0] * rig.baseline),
    }  # fmt: skip
    facts |= _place_in_lane(centre, entry.get("path"), paths, paths_in_space)
    for quantity, value, (minimum, maximum) in (
        ("wide", width, VEHICLE_WIDTH_RANGE_M),
        ("high", height, VEHICLE_HEIGHT_RANGE_M),
    ):
        if not minimum <= value <= maximum:
            facts["warning"] = (
                f"it would be {value:.2g} m {quantity}; does the outline mark the same corners in both views?"
            )
    if epipolar_px > MAX_EPIPOLAR_DISTANCE_PX:
        facts["warning"] = (
            f"a corner lies {epipolar_px:.1f} px off its epipolar line; mark the same corners in both views"
        )
    return facts


def _place_in_lane(
    centre: Array, own: str | None, paths: Mapping[str, Entry], paths_in_space: Mapping[str, Path]
) -> Facts:
    """How far a vehicle's ``centre`` (3,) is from the centre of its ``own`` lane. Where that is far, or it has none:
    ``lane_centres_m``, how far to the right of the line the lane centre would have to be, by direction of travel; and
    ``nearer_path``, the lane whose centre is nearest, if it is another one."""
    offsets = {name: _offset(centre, path) for name, path in paths_in_space.items()}
    # which side of the line the lane is on depends on the direction of travel
    distances = {
        name: abs(abs(offset) - abs(paths[name].get("lateral_offset") or 0.0)) for name, offset in offsets.items()
    }
    facts: Facts = {}
    if own in distances:
        facts["beside_lane_centre_m"] = distances[own]
        if distances[own] <= MIN_CORRECTED_DISTANCE_M:
            return facts
        ahead = paths_in_space[own].direction_near(centre)
        facts["lane_centres_m"] = {direction_name(ahead): offsets[own], direction_name(-ahead): -offsets[own]}
    nearest = min(distances, key=lambda name: distances[name], default=None)
    if nearest not in (None, own) and distances[nearest] <= MAX_OFFERED_DISTANCE_M:
        facts["nearer_path"] = nearest
    return facts


def _offset(point: Array, path: Path) -> float:
    """How far a ``point`` (3,) is to the right of ``path``, m, seen along increasing arc length."""
    s = np.array(path.nearest(point))
    return float((point - path.at(s)) @ path.frames(s)[:, 1])


def _horizontal_edges(q: Array) -> Array:
    return np.asarray(q[[1, 2]] - q[[0, 3]])


def _vertical_edges(q: Array) -> Array:
    return np.asarray(q[[3, 2]] - q[[0, 1]])


def propose_in_other_view(
    rig: StereoRig, view: int, pictures: tuple[Image, Image], entry: Entry, path: Entry | None
) -> tuple[Array, float]:
    """Proposes the pixels (N, 2) of a path or vehicle drawn in ``view`` in the other view; returns them with the
    correlation of the views there.

    ``pictures`` are the left and the right image as recorded, of the vehicle's frame. Raises UnusableInput.
    """
    pair = rig if view == 0 else swapped_views(rig)
    side = ("left", "right")[view]
    image, other_image = (
        camera.undistort_image(pictures[i]) for camera, i in zip(pair.cameras, (view, 1 - view), strict=True)
    )
    drawn = pair.left.undistort_points(np.array(entry.get(side) or [], float).reshape(-1, 2))
    proposal: Proposal
    if "shape" in entry:
        proposal = propose_line(pair, image, other_image, drawn, entry["shape"])
    else:
        normal = None
        if path is not None and entry.get("plane", "front") == "front":
            normal = _path_direction(rig, pair, drawn, path)
        proposal = propose_quadrilateral(pair, image, other_image, drawn, normal)
    return pair.right.distort_points(proposal.pixels), proposal.correlation


def _path_direction(rig: StereoRig, pair: StereoRig, corners: Array, entry: Entry) -> Array | None:
    """The direction (3,) of a vehicle's path at the vehicle, in the axes of ``pair.left``; None if it is unknown.

    The position on a curve is where the path's image is nearest to the outline's lower edge.
    """
    try:
        path = _path(rig, "path", entry)
    except UnusableInput:
        return None
    points = path.points if pair is rig else rig.to_right(path.points)
    ahead = points[:, 2] > 1.0
    if ahead.sum() < 2:
        return None
    pixels = pair.left.project(points[ahead])
    i = int(np.argmin(np.linalg.norm(pixels - corners[2:].mean(axis=0), axis=1)))
    T = np.gradient(points[ahead], axis=0)[i]
    middle = pair.left.rays(corners.mean(axis=0))
    turn = T / np.linalg.norm(T)
    return None if abs(turn @ middle) < 0.3 * np.linalg.norm(middle) else turn  # a plane seen edge-on is no front
