"""Lane paths along which vehicles may drive, and upright sweep planes across them with coordinates in metres.

A *sweep plane* is perpendicular to a lane path at arc length s and reaches from the road up. Its coordinates are
metres: x to the right in the image from the middle of the lane, y up from the road. The front or the rear of a vehicle
lies in one such plane; the two views of it agree there, and only there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.documents.loading import Clip
from paceline.errors import UnusableInput
from paceline.speed.configuration import DEFAULTS
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.geometry.paths import Path

PATH_EXTENSION_M = 12.0  # distance by which a lane path is assumed to continue past the ends of its drawing
COINCIDENCE_M = 0.3  # lane paths so near each other are one; with a smaller offset one path serves both directions
COMPARED_POSITIONS = 5  # positions along a lane path at which it is compared with another
DISPARITY_STEP_PX = 0.7  # disparity between neighbouring sweep planes
DEPTH_SAMPLING_M = 0.1  # step of arc length at which depth is computed
PYRAMID_LEVELS = 4


@dataclass(frozen=True, eq=False)
class LanePath:
    """The middle of a lane, ``path``, called ``name`` as in the clip."""

    name: str
    rig: StereoRig
    path: Path

    def axes(self, s: float) -> tuple[Array, Array, Array]:
        """The sweep plane at ``s``: its origin (3,) on the road and its unit vectors, right in the image and up, (3,)
        each."""
        arc_length = np.array(s)
        _, right, down = self.path.frames(arc_length).T
        return self.path.at(arc_length), right * (1.0 if right[0] >= 0 else -1.0), -down

    def homographies(self, s: float) -> tuple[Array, Array]:
        """(3, 3) each, from plane coordinates (x, y, 1) at ``s`` to ideal pixels of the left and of the right view."""
        origin, right, up = self.axes(s)
        frame = np.column_stack([right, up, origin])
        other = self.rig.R @ frame
        other[:, 2] += self.rig.t
        return self.rig.left.K @ frame, self.rig.right.K @ other

    def road_homography(self, s: float) -> Array:
        """(3, 3), from ideal pixels of the left view to those of the right one, for points of the road about ``s``."""
        origin, _, up = self.axes(s)
        induced = self.rig.R + np.outer(self.rig.t, up) / (up @ origin)
        return np.asarray(self.rig.right.K @ induced @ self.rig.left.K_inv)

    def pixels(self, s: float, points: Array) -> tuple[Array, Array]:
        """Ideal pixels (…, 2) in both views of ``points`` (…, 2) on the plane at ``s``."""
        p = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
        views = [p @ H.T for H in self.homographies(s)]
        return views[0][..., :2] / views[0][..., 2:], views[1][..., :2] / views[1][..., 2:]

    def point(self, s: float, x: float, y: float) -> Array:
        """The world point (3,) at (x, y) on the plane at ``s``."""
        origin, right, up = self.axes(s)
        return np.asarray(origin + x * right + y * up)

    def plane_coordinates(self, point: Array) -> tuple[float, float, float]:
        """The arc length s of the plane on which a world ``point`` (3,) lies, and its (x, y) there: the inverse of
        `point`."""
        s = self.path.nearest(point)
        origin, right, up = self.axes(s)
        return s, float((point - origin) @ right), float((point - origin) @ up)

    def coincides_with(self, other: LanePath) -> bool:
        """Whether this path runs where ``other`` does, in the same direction."""
        for s in np.linspace(self.path.s[0], self.path.s[-1], COMPARED_POSITIONS):
            point = self.path.at(np.array(s))
            nearest = np.array(other.path.nearest(point))
            along = self.path.frames(np.array(s))[:, 0] @ other.path.frames(nearest)[:, 0]
            if along <= 0 or np.linalg.norm(other.path.at(nearest) - point) > COINCIDENCE_M:
                return False
        return True

    def sweep_positions(self, near: float = DEFAULTS.detection.near, far: float = DEFAULTS.detection.far) -> Array:
        """Arc lengths (N,) of the sweep planes, `DISPARITY_STEP_PX` apart, from ``near`` to ``far`` m, where the road
        is inside both images."""
        s = np.arange(self.path.s[0] - PATH_EXTENSION_M, self.path.s[-1] + PATH_EXTENSION_M, DEPTH_SAMPLING_M)
        points = self.path.at(s)
        depth = points[:, 2]
        visible = (depth > near) & (depth < far)
        pixels = self.rig.project(np.where(visible[:, None], points, [0.0, 0.0, 1.0]))
        for view, camera in zip(pixels, self.rig.cameras, strict=True):
            visible &= ((view >= 0) & (view <= np.array(camera.image_size) - 1)).all(1)
        s, depth = s[visible], depth[visible]
        if not len(s):
            return s
        disparity = self.rig.left.K[0, 0] * self.rig.baseline / depth
        disparity_sum = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(disparity)))])
        return np.interp(np.arange(0.0, disparity_sum[-1], DISPARITY_STEP_PX), disparity_sum, s)


def lane_paths_of(clip: Clip, line_sigma: float = DEFAULTS.line_sigma) -> list[LanePath]:
    """The lane paths of ``clip``. A path with a lateral offset gives one on each side of its line, because the side
    depends on the direction of travel; where the lines on both sides of a lane give the same path twice, the one of the
    line drawn in its direction is kept. ``line_sigma`` px is the noise of a drawn point. Raises
    UnusableInput for a path that its drawing does not determine."""
    lanes, reversed_paths = [], []
    for name, document in clip.paths.items():
        try:
            path = path_from_document(document, clip.rig, sigma=line_sigma)
        except UnusableInput as unusable:
            raise UnusableInput(f"{clip.path}: {unusable}") from None
        offset = document.lateral_offset
        if abs(offset) <= COINCIDENCE_M:
            lanes.append(LanePath(name, clip.rig, path.shifted(offset)))
        else:
            lanes.append(LanePath(name, clip.rig, path.shifted(offset)))
            reversed_paths.append(LanePath(name, clip.rig, path.reversed().shifted(offset)))
    for lane in reversed_paths:
        if not any(lane.coincides_with(other) for other in lanes):
            lanes.append(lane)
    return lanes


@dataclass(frozen=True)
class PlaneGrid:
    """Cells of a sweep plane: from ``left`` to −``left`` m across and from ``top`` down to ``bottom`` m, ``cell`` m
    apart."""

    left: float
    top: float
    bottom: float
    cell: float

    @cached_property
    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        return round(-2 * self.left / self.cell) + 1, round((self.top - self.bottom) / self.cell) + 1

    @cached_property
    def to_metres(self) -> Array:
        """(3, 3), from (column, row, 1) to plane coordinates (x, y, 1)."""
        return np.array([[self.cell, 0, self.left], [0, -self.cell, self.top], [0, 0, 1.0]])

    @cached_property
    def x(self) -> Array:
        return np.asarray(self.left + self.cell * np.arange(self.size[0]), float)

    @cached_property
    def y(self) -> Array:
        return np.asarray(self.top - self.cell * np.arange(self.size[1]), float)


def image_pyramid(image: Image) -> list[Image]:
    """``image`` (H, W) and its reductions by 2, 4 and 8."""
    levels = [image]
    while len(levels) < PYRAMID_LEVELS:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.float32))
    return levels


def pyramid_level(homography: Array, grid: PlaneGrid) -> int:
    """The pyramid level whose pixels are about as large as the cells of ``grid`` seen through ``homography`` (3, 3)."""
    columns, rows = grid.size
    x, y, w = homography @ grid.to_metres @ [0.5 * columns, rows - 1.0, 1.0]
    across = homography[:, 0] * grid.cell
    scale = math.hypot(across[0] - across[2] * x / w, across[1] - across[2] * y / w) / abs(w)  # px per column
    return min(max(math.floor(math.log2(max(scale, 1e-6))), 0), PYRAMID_LEVELS - 1)


def warp_to_plane(levels: list[Image], homography: Array, grid: PlaneGrid) -> Image:
    """An image, given as its pyramid ``levels``, resampled on the cells (rows, columns) of a plane that is seen through
    ``homography`` (3, 3)."""
    level = pyramid_level(homography, grid)
    H = homography @ grid.to_metres * np.array([[0.5**level], [0.5**level], [1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    border = cv2.BORDER_REPLICATE
    return np.asarray(cv2.warpPerspective(levels[level], H, grid.size, flags=flags, borderMode=border), np.float32)
