"""What a person draws, judged in space while drawing it. Pixels are those of the images as recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.console.editing.clip_document import Entry
from paceline.console.editing.cross_view_proposals import Proposal, propose_line, propose_quadrilateral, turned
from paceline.documents.plausibility import check_drawing, check_path_points, check_quadrilateral, check_views
from paceline.errors import UnusableInput
from paceline.geometry import epipolar_distance, triangulate
from paceline.speed.geometry.path_reconstruction import reconstruct
from paceline.speed.geometry.paths import Path, from_points

Facts = dict[str, Any]

CLICK = 0.5  # px, standard deviation of a drawn corner
VEHICLE_WIDTH, VEHICLE_HEIGHT = (0.3, 20.0), (0.1, 4.5)  # m: from a number plate to a lorry's side
MISMATCH = 3.0  # px off the epipolar line that a careful hand does not explain
MARKS = (5, 10, 20, 30, 50, 80, 150)  # m, distances shown on an epipolar line
STEEP = 0.7  # of a road as the cameras see it, which may look down at it: more is a mistake


def epipolar_line(rig: StereoRig, view: int, pixel: Array) -> dict[str, list[Any]]:
    """The points of the other view that a ``pixel`` (2,) of ``view`` (0 left, 1 right) may show: a polyline from far
    away to near, and places at some distances, ``[metres, x, y]``."""
    pair = rig if view == 0 else turned(rig)
    ray = pair.left.rays(pair.left.undistort_points(pixel[None]))[0]
    inverse = np.linspace(1e-4, 0.5, 64)
    line, seen = _other(pair, ray, inverse)
    marks, there = _other(pair, ray, 1.0 / np.array(MARKS, float))
    return {
        "line": np.round(line[seen], 2).tolist(),
        "marks": [[m, *np.round(p, 2).tolist()] for m, p, ok in zip(MARKS, marks, there, strict=True) if ok],
    }


def _other(pair: StereoRig, ray: Array, inverse: Array) -> tuple[Array, NDArray[np.bool_]]:
    points = ray / inverse[:, None]
    seen = pair.to_right(points)
    ahead = seen[:, 2] > 0.05 * points[:, 2]
    width, height = pair.right.image_size
    ideal = pair.right.project(np.where(ahead[:, None], seen, [0.0, 0.0, 1.0]))
    near = (np.abs(ideal - [width / 2, height / 2]) < [width, height]).all(axis=1)  # distortion is known only there
    pixels = pair.right.distort_points(np.where((ahead & near)[:, None], ideal, 0.0))
    return pixels, ahead & near


def check_setup(rig: StereoRig, paths: Mapping[str, Entry], vehicles: list[Entry]) -> dict[str, Any]:
    """What every path (by name) and vehicle (in order) is in space: facts in metres, ``problem`` where one cannot be
    measured, ``doubt`` where it looks unlikely."""
    found: dict[str, Path] = {}
    shown = {name: _check_path(rig, name, entry, found) for name, entry in paths.items()}
    for name, path in found.items():
        shown[name] |= _neighbour(name, path, found)
    return {"paths": shown, "vehicles": [_check_vehicle(rig, entry, found) for entry in vehicles]}


def _check_path(rig: StereoRig, name: str, entry: Entry, found: dict[str, Path]) -> Facts:
    try:
        path = found[name] = _path(rig, name, entry)
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
    if slope > STEEP:
        facts["doubt"] = "it rises or falls before the cameras as no road does; is the same line drawn in both views?"
    return facts


def _path(rig: StereoRig, name: str, entry: Entry) -> Path:
    if "points" in entry:
        points = np.array(entry["points"], float)
        if wrong := check_path_points(points):
            raise UnusableInput(wrong)
        return from_points(name, entry["shape"], points)
    drawn = []
    for side, camera in zip(("left", "right"), rig.cameras, strict=True):
        pixels = np.array(entry.get(side) or [], float).reshape(-1, 2)
        if not len(pixels):
            raise UnusableInput(f"draw the same line in the {side} view")
        if wrong := check_drawing(pixels, entry["shape"]):
            raise UnusableInput(f"{side} view: {wrong}")
        drawn.append(camera.undistort_points(pixels))
    return reconstruct(name, entry["shape"], rig, *drawn)


def _neighbour(name: str, path: Path, paths: Mapping[str, Path]) -> Facts:
    """How far it is to the nearest other path, from the middle of this one."""
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


def _check_vehicle(rig: StereoRig, entry: Entry, paths: Mapping[str, Path]) -> Facts:
    ideal = []
    for side, camera in zip(("left", "right"), rig.cameras, strict=True):
        corners = np.array(entry.get(side) or [], float).reshape(-1, 2)
        if len(corners) != 4:
            return {"problem": f"outline the same part in the {side} view"}
        if wrong := check_quadrilateral(corners, camera.image_size):
            return {"problem": f"{side} view: {wrong}"}
        ideal.append(camera.undistort_points(corners))
    left, right = ideal
    if wrong := check_views(rig, left, right):
        return {"problem": wrong}
    tl, tr, br, bl = triangulate(rig, left, right)
    centre = triangulate(rig, left.mean(axis=0), right.mean(axis=0))
    off = float(np.abs(epipolar_distance(rig, left, right)).max())
    # at the centre's distance: single corners are too uncertain in depth to be measured between
    scale = float(centre[2]) / np.sqrt(np.prod(rig.left.K[[0, 1], [0, 1]]))
    width, height = (scale * float(np.linalg.norm(d, axis=1).mean()) for d in (_across(left), _down(left)))
    facts: Facts = {
        "distance_m": float(np.linalg.norm(centre)), "width_m": width, "height_m": height, "epipolar_px": off,
        "distance_std_m": CLICK * np.sqrt(0.5) * float(centre[2]) ** 2 / (rig.left.K[0, 0] * rig.baseline),
    }  # fmt: skip
    path = paths.get(entry.get("path") or "")
    if path is not None:
        foot = path.at(np.array(path.nearest(centre)))
        facts["beside_path_m"] = float(np.hypot(*(foot - centre)[[0, 2]]))
        facts["above_path_m"] = float(foot[1] - centre[1])
    for what, value, (least, most) in (("wide", width, VEHICLE_WIDTH), ("high", height, VEHICLE_HEIGHT)):
        if not least <= value <= most:
            facts["doubt"] = f"it would be {value:.2g} m {what}; does the outline mark the same corners in both views?"
    if off > MISMATCH:
        facts["doubt"] = f"a corner lies {off:.1f} px off its epipolar line; mark the same corners in both views"
    return facts


def _across(q: Array) -> Array:
    return np.asarray(q[[1, 2]] - q[[0, 3]])


def _down(q: Array) -> Array:
    return np.asarray(q[[3, 2]] - q[[0, 1]])


def propose(
    rig: StereoRig, view: int, pictures: tuple[Image, Image], entry: Entry, path: Entry | None
) -> tuple[Array, float]:
    """The other view's pixels (N, 2) of a path or vehicle drawn in ``view``, and how alike the views are there.

    ``pictures`` are the left and the right one as recorded, of the vehicle's frame. Raises UnusableInput.
    """
    pair = rig if view == 0 else turned(rig)
    side = ("left", "right")[view]
    here, there = (
        camera.undistort_image(pictures[i]) for camera, i in zip(pair.cameras, (view, 1 - view), strict=True)
    )
    drawn = pair.left.undistort_points(np.array(entry.get(side) or [], float).reshape(-1, 2))
    found: Proposal
    if "shape" in entry:
        found = propose_line(pair, here, there, drawn, entry["shape"])
    else:
        normal = None
        if path is not None and entry.get("plane", "front") == "front":
            normal = _normal(rig, pair, drawn, path)
        found = propose_quadrilateral(pair, here, there, drawn, normal)
    return pair.right.distort_points(found.pixels), found.alike


def _normal(rig: StereoRig, pair: StereoRig, corners: Array, entry: Entry) -> Array | None:
    """The direction (3,) of a vehicle's path in the axes of the view it is outlined in; None while that is not known.

    Where on a curve the vehicle is follows from where its picture meets that of the path.
    """
    try:
        path = _path(rig, "path", entry)
    except UnusableInput:
        return None
    points = path.points if pair is rig else rig.to_right(path.points)
    ahead = points[:, 2] > 1.0
    if ahead.sum() < 2:
        return None
    seen = pair.left.project(points[ahead])
    i = int(np.argmin(np.linalg.norm(seen - corners[2:].mean(axis=0), axis=1)))
    T = np.gradient(points[ahead], axis=0)[i]
    middle = pair.left.rays(corners.mean(axis=0))
    turn = T / np.linalg.norm(T)
    return None if abs(turn @ middle) < 0.3 * np.linalg.norm(middle) else turn  # seen from the side it is no front
