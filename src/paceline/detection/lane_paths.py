"""Ways that vehicles may drive, and upright cards across them, on which both views are laid out in metres.

A *card* is a rectangle perpendicular to a way at arc length s, from the road up. Its coordinates are metres: x to the
right in the picture from the way's middle, y up from the road. A vehicle's front or rear lies in one card, so there,
and only there, the two views agree on it.
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
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.geometry.paths import Path

NEAREST, FARTHEST = 5.0, 150.0  # m of depth at which vehicles are looked for
BEYOND = 12.0  # m past its drawn ends that a way is believed to run on
SAME = 0.3  # m: with an offset as small, both senses of travel use one way, and so near each other two ways are one
COMPARED = 5  # places along a way at which it is compared with another
STEP = 0.7  # px of disparity between neighbouring cards
DENSE = 0.1  # m of arc length at which depth is looked up
LEVELS = 4  # of a picture's pyramid


@dataclass(frozen=True, eq=False)
class Way:
    """A path moved to the middle of its lane, ``path``, named ``name`` as in the clip."""

    name: str
    rig: StereoRig
    path: Path

    def axes(self, s: float) -> tuple[Array, Array, Array]:
        """Origin (3,) on the road, and the card's directions right in the picture and up, each (3,), at ``s``."""
        at = np.array(s)
        _, right, down = self.path.frames(at).T
        return self.path.at(at), right * (1.0 if right[0] >= 0 else -1.0), -down

    def homographies(self, s: float) -> tuple[Array, Array]:
        """(3, 3) each: ideal pixels of the left and the right view of card coordinates (x, y, 1) at ``s``."""
        origin, right, up = self.axes(s)
        frame = np.column_stack([right, up, origin])
        other = self.rig.R @ frame
        other[:, 2] += self.rig.t
        return self.rig.left.K @ frame, self.rig.right.K @ other

    def over_road(self, s: float) -> Array:
        """(3, 3): the right view's ideal pixels of the left one's, for what lies on the road about ``s``."""
        origin, _, up = self.axes(s)
        induced = self.rig.R + np.outer(self.rig.t, up) / (up @ origin)
        return np.asarray(self.rig.right.K @ induced @ self.rig.left.K_inv)

    def pixels(self, s: float, points: Array) -> tuple[Array, Array]:
        """Ideal pixels (…, 2) in both views of card ``points`` (…, 2) at ``s``."""
        p = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
        views = [p @ H.T for H in self.homographies(s)]
        return views[0][..., :2] / views[0][..., 2:], views[1][..., :2] / views[1][..., 2:]

    def place(self, s: float, x: float, y: float) -> Array:
        """The world point (3,) at a card's (x, y)."""
        origin, right, up = self.axes(s)
        return np.asarray(origin + x * right + y * up)

    def on_card(self, place: Array) -> tuple[float, float, float]:
        """Of a world ``place`` (3,) the arc length of the card that it lies on, and its (x, y) there: the inverse of
        `place`."""
        s = self.path.nearest(place)
        origin, right, up = self.axes(s)
        return s, float((place - origin) @ right), float((place - origin) @ up)

    def is_that_of(self, other: Way) -> bool:
        """Whether it runs where another one does, in the same sense."""
        for s in np.linspace(self.path.s[0], self.path.s[-1], COMPARED):
            place = self.path.at(np.array(s))
            there = np.array(other.path.nearest(place))
            along = self.path.frames(np.array(s))[:, 0] @ other.path.frames(there)[:, 0]
            if along <= 0 or np.linalg.norm(other.path.at(there) - place) > SAME:
                return False
        return True

    def stations(self) -> Array:
        """Arc lengths (N,) at which to look, `STEP` px of disparity apart, where the road is in both pictures."""
        s = np.arange(self.path.s[0] - BEYOND, self.path.s[-1] + BEYOND, DENSE)
        points = self.path.at(s)
        depth = points[:, 2]
        seen = (depth > NEAREST) & (depth < FARTHEST)
        pixels = self.rig.project(np.where(seen[:, None], points, [0.0, 0.0, 1.0]))
        for view, camera in zip(pixels, self.rig.cameras, strict=True):
            seen &= ((view >= 0) & (view <= np.array(camera.image_size) - 1)).all(1)
        s, depth = s[seen], depth[seen]
        if not len(s):
            return s
        disparity = self.rig.left.K[0, 0] * self.rig.baseline / depth
        passed = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(disparity)))])
        return np.interp(np.arange(0.0, passed[-1], STEP), passed, s)


def ways_of(clip: Clip) -> list[Way]:
    """The ways along the paths of ``clip``, on both sides of a line beside a lane: which one is meant depends on the
    sense of travel. Where the lines on both sides of a lane give it twice, it is that of the line drawn in its sense.
    Raises UnusableInput for a path that its drawing does not determine."""
    found, other_sense = [], []
    for name, document in clip.paths.items():
        try:
            path = path_from_document(document, clip.rig)
        except UnusableInput as unusable:
            raise UnusableInput(f"{clip.path}: {unusable}") from None
        offset = document.lateral_offset
        if abs(offset) <= SAME:
            found.append(Way(name, clip.rig, path.shifted(offset)))
        else:
            found.append(Way(name, clip.rig, path.shifted(offset)))
            other_sense.append(Way(name, clip.rig, path.reversed().shifted(offset)))
    for way in other_sense:
        if not any(way.is_that_of(other) for other in found):
            found.append(way)
    return found


@dataclass(frozen=True)
class Grid:
    """The pixels of cards: ``left`` to −``left`` m across, ``top`` down to ``bottom`` m, ``cell`` m each."""

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
        """(3, 3): card coordinates (x, y, 1) of (column, row, 1)."""
        return np.array([[self.cell, 0, self.left], [0, -self.cell, self.top], [0, 0, 1.0]])

    @cached_property
    def x(self) -> Array:
        return np.asarray(self.left + self.cell * np.arange(self.size[0]), float)

    @cached_property
    def y(self) -> Array:
        return np.asarray(self.top - self.cell * np.arange(self.size[1]), float)


def pyramid(image: Image) -> list[Image]:
    """``image`` and what it is when reduced by 2, 4 and 8."""
    levels = [image]
    while len(levels) < LEVELS:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.float32))
    return levels


def level_of(homography: Array, grid: Grid) -> int:
    """The level of a picture's pyramid that is about as fine as the ``grid`` of a card seen through ``homography``."""
    columns, rows = grid.size
    x, y, w = homography @ grid.to_metres @ [0.5 * columns, rows - 1.0, 1.0]
    across = homography[:, 0] * grid.cell
    scale = math.hypot(across[0] - across[2] * x / w, across[1] - across[2] * y / w) / abs(w)  # px per column
    return min(max(math.floor(math.log2(max(scale, 1e-6))), 0), LEVELS - 1)


def laid_out(levels: list[Image], homography: Array, grid: Grid) -> Image:
    """The picture on a card (rows, columns) as seen through ``homography``, from the level that is about as fine."""
    level = level_of(homography, grid)
    H = homography @ grid.to_metres * np.array([[0.5**level], [0.5**level], [1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    border = cv2.BORDER_REPLICATE
    return np.asarray(cv2.warpPerspective(levels[level], H, grid.size, flags=flags, borderMode=border), np.float32)
