"""Plausibility checks of a rig, a drawn path, an outlined vehicle and a target; each returns the problem, or None."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from paceline.arrays import Array
from paceline.cameras import Camera, StereoRig
from paceline.geometry import epipolar_distance, triangulate

MAX_ORTHONORMALITY_ERROR = 1e-3  # greatest entry of RᵀR − I that rounding in a file explains
MIN_BASELINE_M, MAX_BASELINE_M = 0.01, 100.0
MIN_AREA_PX2, MIN_SIDE_PX = 64.0, 4.0  # least area and side of an outline: a smaller one has no texture to track
MIN_DRAWING_PX = 2.0
MAX_SEGMENT_OBLIQUENESS = 0.01  # offset across a segment's direction over its length, as rounding explains
MIN_TARGET_SEGMENT_M, MAX_TARGET_M = 0.01, 20.0
MIN_TARGET_PX = 8.0
MIN_TARGET_VISIBLE_SHARE = 0.5  # least visible share of a target in its first frame
CORNER_NAMES = ("top-left", "top-right", "bottom-right", "bottom-left")
CORNER_ORDER = f"{', '.join(CORNER_NAMES)} as seen in the image"


def check_intrinsics(camera: Camera) -> str | None:
    K, size = camera.K, np.array(camera.image_size)
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        return f"expected positive focal lengths, found {K[0, 0]:g} and {K[1, 1]:g}"
    if np.abs(np.array([K[0, 1], K[1, 0]])).max() > 1e-9 * K[0, 0] or not np.array_equal(K[2], [0, 0, 1]):
        return "expected the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
    centre = K[:2, 2]
    if (centre < -size).any() or (centre > 2 * size).any():
        return (
            f"the principal point ({centre[0]:g}, {centre[1]:g}) lies far outside the image; "
            f"expected it near ({size[0] / 2:g}, {size[1] / 2:g})"
        )
    return None


def check_rotation(R: Array) -> str | None:
    error = float(np.abs(R.T @ R - np.eye(3)).max())
    if error > MAX_ORTHONORMALITY_ERROR:
        return f"is not a rotation: RᵀR differs from the identity by {error:.2g}; expected orthonormal rows"
    if np.linalg.det(R) < 0:
        return "is a reflection, its determinant is -1; expected a rotation"
    return None


def nearest_rotation(R: Array) -> Array:
    """The rotation nearest to ``R`` (3, 3), so that six digits in a file do no harm."""
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt)


def check_baseline(rig: StereoRig) -> str | None:
    if rig.baseline == 0:
        return "both cameras stand in the same place; expected a distance in metres"
    if rig.baseline < MIN_BASELINE_M:
        return f"the cameras stand {rig.baseline:g} m apart; expected metres, at least {MIN_BASELINE_M:g}"
    if rig.baseline > MAX_BASELINE_M:
        return f"the cameras stand {rig.baseline:g} m apart; expected metres (are these millimetres?)"
    centre = -rig.t @ rig.R  # of the right camera, in the left one's axes
    if np.argmax(np.abs(centre)) == 0 and centre[0] < 0:
        return "the right camera lies to the left of the left one; left and right are swapped"
    return None


def check_path_points(points: Array) -> str | None:
    if len(points) < 2:
        return f"expected at least two [x, y, z] points, found {len(points)}"
    if (np.linalg.norm(np.diff(points, axis=0), axis=1) < 1e-6).any():
        return "two points in succession are the same; expected different ones"
    return None


def check_drawing(pixels: Array, shape: str) -> str | None:
    min_points, word = (2, "two") if shape == "line" else (4, "four")
    if len(pixels) < min_points:
        return f"expected at least {word} [x, y] points for a {shape}, found {len(pixels)}"
    if np.linalg.norm(np.ptp(pixels, axis=0)) < MIN_DRAWING_PX:
        return "all points lie in the same place; expected points along the road line"
    return None


def check_quadrilateral(corners: Array, image_size: tuple[int, int]) -> str | None:
    """What is wrong with ``corners`` (4, 2), as clicked in an image of that (width, height)."""
    limit = np.array(image_size) - 0.5
    outside = ((corners < -0.5) | (corners > limit)).any(axis=1)
    if outside.any():
        x, y = corners[outside][0]
        return f"the corner [{x:g}, {y:g}] lies outside the image of {image_size[0]} × {image_size[1]} pixels"
    if _cross(corners[0], corners[1], corners[2], corners[3]) or _cross(corners[1], corners[2], corners[3], corners[0]):
        return f"the sides cross each other; expected the corners in the order {CORNER_ORDER}"
    sides = np.roll(corners, -1, axis=0) - corners
    turns = _turn(sides, np.roll(sides, -1, axis=0))  # positive: clockwise as seen
    area = 0.5 * float(_turn(corners, np.roll(corners, -1, axis=0)).sum())
    shortest = float(np.linalg.norm(sides, axis=1).min())
    if abs(area) < MIN_AREA_PX2 or shortest < MIN_SIDE_PX:
        return (
            f"is too small to track (area {abs(area):.0f} px², shortest side {shortest:.1f} px); "
            f"expected at least {MIN_AREA_PX2:.0f} px² and {MIN_SIDE_PX:.0f} px"
        )
    if area < 0:
        return f"the corners go counter-clockwise; expected the order {CORNER_ORDER}"
    if (turns <= 0).any():
        return f"is not convex; expected four corners in the order {CORNER_ORDER}"
    turned = [np.roll(sides, -start, axis=0) for start in range(4)]
    upright = [s[0, 0] - s[2, 0] + s[1, 1] - s[3, 1] for s in turned]  # top and bottom run right, the sides down
    if upright[0] < max(upright):
        return f"the first corner is not the top-left one; expected the order {CORNER_ORDER}"
    return None


def check_views(rig: StereoRig, left: Array, right: Array) -> str | None:
    """What is wrong with the corners (4, 2) of one vehicle in the two views, ideal pixels.

    The outlines need not cover exactly the same part, so only a gross disagreement is one.
    """
    height = 0.5 * float(np.linalg.norm(right[[3, 2]] - right[[0, 1]], axis=1).sum())
    mismatch = abs(float(epipolar_distance(rig, left.mean(axis=0), right.mean(axis=0))))
    if mismatch > height:
        return (
            f"the views disagree: the right outline lies {mismatch:.0f} px off the epipolar line of the left one; "
            "expected the same part of the vehicle in both (are left and right swapped?)"
        )
    points = triangulate(rig, left, right)
    behind = ~((points[:, 2] > 0) & (rig.to_right(points)[:, 2] > 0))
    if behind.any():
        return (
            f"the {CORNER_NAMES[int(np.argmax(behind))]} corner triangulates behind the cameras; "
            "expected the same corner in both views (are left and right swapped?)"
        )
    return None


def check_segment(name_a: str, name_b: str, corners: Mapping[str, Array]) -> str | None:
    """What is wrong with the line between two named ``corners`` (2,) of a target, metres."""
    for name in (name_a, name_b):
        if name not in corners:
            return f"no corner is called {name!r}; expected one of {', '.join(corners)}"
    across, down = (float(d) for d in np.abs(corners[name_b] - corners[name_a]))
    if max(across, down) < MIN_TARGET_SEGMENT_M:
        return f"{name_a} and {name_b} lie in the same place; expected a line at least {MIN_TARGET_SEGMENT_M:g} m long"
    if min(across, down) > MAX_SEGMENT_OBLIQUENESS * max(across, down):
        return (
            f"the line from {name_a} to {name_b} is oblique, {across:g} m across and {down:g} m down; "
            "expected a horizontal or vertical one"
        )
    return None


def check_target(ends: Array) -> str | None:
    """What is wrong with a target's lines as a whole; ``ends`` (S, 2, 2) in metres, each horizontal or vertical."""
    if not len(ends):
        return "expected at least one horizontal and one vertical line, found none"
    extent = np.ptp(ends.reshape(-1, 2), axis=0)
    if extent.max() > MAX_TARGET_M:
        return f"the target is {extent.max():g} m large; expected metres (are these pixels or millimetres?)"
    across, down = np.abs(ends[:, 1] - ends[:, 0]).T
    vertical = down > across
    for direction, present in (("horizontal", ~vertical), ("vertical", vertical)):
        if not present.any():
            return f"there is no {direction} line; expected at least one horizontal and one vertical one"
    extents = [np.ptp(ends[lines].mean(axis=1)[:, axis]) for lines, axis in ((~vertical, 1), (vertical, 0))]
    if max(extents) < MIN_TARGET_SEGMENT_M:
        return "its lines show no size; expected two parallel ones, some distance apart"
    return None


def check_start(center: Array, scale: float, ends: Array, image_size: tuple[int, int]) -> tuple[str, str] | None:
    """The key and its problem, where a target cannot be tracked from its start.

    ``ends`` (N, 2) of its lines are px from its centre at scale 1.
    """
    size = np.array(image_size)
    x, y = center
    if ((center < 0) | (center > size - 1)).any():
        return "center", f"[{x:g}, {y:g}] lies outside the image of {size[0]} × {size[1]} pixels"
    low, high = scale * ends.min(axis=0), scale * ends.max(axis=0)
    width, height = high - low
    if max(width, height) < MIN_TARGET_PX:
        return "scale", (
            f"{scale:g} makes the target {width:.2g} × {height:.2g} px large; expected at least {MIN_TARGET_PX:g} px"
        )
    if width > 2 * size[0] or height > 2 * size[1]:
        return "scale", f"{scale:g} makes the target {width:.0f} × {height:.0f} px large, far more than the image"
    inside = np.prod(np.minimum(center + high, size - 1) - np.maximum(center + low, 0)) / (width * height)
    if inside < MIN_TARGET_VISIBLE_SHARE:
        return "center", (
            f"[{x:g}, {y:g}] leaves {100 * inside:.0f} % of the target, {width:.0f} × {height:.0f} px, in the image of "
            f"{size[0]} × {size[1]}; expected at least {100 * MIN_TARGET_VISIBLE_SHARE:.0f} %"
        )
    return None


def _turn(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _cross(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Whether the segments a–b and c–d cross each other."""
    return bool(_turn(b - a, c - a) * _turn(b - a, d - a) < 0 and _turn(d - c, a - c) * _turn(d - c, b - c) < 0)
