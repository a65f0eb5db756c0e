"""What stands upright on a way in one frame and was not there before: the faces of vehicles, nearest explained first.

On a card at every arc length the two views are compared with each other and with the empty scene. A place counts where
the views agree with each other and neither agrees with the scene behind. Shadows and the light of headlamps lie on the
road, leaves and rain are nowhere on the way for both views: they leave too little to count.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.recordings import StereoFrame
from paceline.vehicles.agreement import Texture, correlation, local_mean
from paceline.vehicles.ways import Grid, Way, laid_out, pyramid

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.uint8]

GRID = Grid(left=-3.2, top=2.6, bottom=0.2, cell=0.05)  # m; what lies lower is road
WINDOW = 7  # cells, over which pictures are compared
AGREE = (0.6, 1.0)  # correlation of the views at which a place begins to count, and counts wholly
CHANGED = 0.3  # one minus the correlation with the empty scene, from which on something else is there
CONTRAST = (1.0, 2.0)  # grey levels, and times the noise: less is no texture
COARSE = 2  # level of the pyramid at which a glance tells where nothing has changed
UNCHANGED = 0.5  # of the contrast that makes a texture
SMALLEST = 0.25  # m² of places that count, of a motorcycle far away
FLATTEST = 0.8  # of the views' agreement if it stands, that may be left if it lies on the road: shadows have all of it
BODY = 5.0, 14.0  # m that a car, and what is taller than a van, reaches behind its face
BEFORE = 2.5  # m that its face may lie before where most of it was seen
TALL = 2.3  # m from which on a vehicle may be a lorry or a bus
CEILING = 4.5  # m, of the tallest
PIECE = 0.25  # mean of what counts about a place that belongs to a face
SLENDER = 0.3  # of a face's height: columns of less are not of the face, but of a mirror or a shadow
ASIDE = 1.6  # m from the middle of a way, from where on what counts belongs to the next lane more and more
HALF_WIDTH = 1.3  # m, of a bus
MARGIN = 0.9  # m about a face that are kept of the pictures


_CENTRED = np.clip(1.0 - 0.4 * (np.abs(GRID.x) - ASIDE), 0.3, 1.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Sighting:
    """The face of a vehicle in one frame, at arc length ``s`` of a ``way``: ``x`` and ``y``, each (2,), from where to
    where on the card, m; ``area`` m² of it agree. ``crops`` of both views begin at the pixels ``corners`` (2, 2)."""

    frame: int
    time: float
    way: Way
    s: float
    x: tuple[float, float]
    y: tuple[float, float]
    area: float
    crops: tuple[Image, Image]
    corners: Array

    @property
    def place(self) -> Array:
        """The face's middle at the road, (3,) in the world."""
        return self.way.place(self.s, self.middle, 0.0)

    @property
    def middle(self) -> float:
        """Metres from the middle of the way to the middle of the face."""
        return 0.5 * sum(self.x)

    @cached_property
    def _levels(self) -> list[list[Image]]:
        return [pyramid(crop) for crop in self.crops]

    def cards(self, s: float, grid: Grid, origin: Array) -> tuple[Image, Image]:
        """Both views on the card at ``s``, its grid moved to ``origin`` (2,) m, from what was kept of them."""
        move = np.array([[1, 0, origin[0]], [0, 1, origin[1]], [0, 0, 1.0]])
        found = []
        for levels, corner, H in zip(self._levels, self.corners, self.way.homographies(s), strict=True):
            kept = np.array([[1, 0, -corner[0]], [0, 1, -corner[1]], [0, 0, 1.0]])
            found.append(laid_out(levels, kept @ H @ move, grid))
        return found[0], found[1]


class Lookout:
    """Looks along ``ways`` at the frames of a stationary rig."""

    def __init__(self, ways: list[Way]) -> None:
        self._stations = [(way, float(s)) for way in ways for s in way.stations()]
        self._homographies = [way.homographies(s) for way, s in self._stations]
        self._boxes = np.array([_box(way, s) for way, s in self._stations], np.int64).reshape(-1, 4)
        self._bounds = np.cumsum([0, *(sum(w is way for w, _ in self._stations) for way in ways)])

    def see(self, frame: StereoFrame, empty: tuple[Image, Image]) -> list[Sighting]:
        """The faces in ``frame`` before the ``empty`` scene (both views of it), the largest first."""
        views = [pyramid(image) for image in (frame.left, frame.right)]
        scene = [pyramid(image) for image in empty]
        least = max(CONTRAST[0], CONTRAST[1] * noise_of(frame.left, empty[0]))
        blank = np.zeros(GRID.size[::-1], np.float32)
        counts = [
            self._counting(views, scene, H, least) if busy else blank
            for H, busy in zip(self._homographies, self._busy(views[0], scene[0], least), strict=True)
        ]
        found: list[Sighting] = []
        explained = np.zeros(frame.left.shape, np.uint8)
        while counts:
            areas = np.array([float((c * _CENTRED).sum()) for c in counts]) * GRID.cell**2
            best = int(np.argmax(areas))
            if areas[best] < SMALLEST:
                break
            way, s = self._stations[best]
            standing, counts[best] = counts[best], np.zeros_like(counts[best])
            if _flat(views, way, s, standing) > FLATTEST:
                continue
            sighting = self._sighting(frame, way, self._between(areas, best), standing)
            found.append(sighting)
            cv2.fillConvexPoly(explained, _outline(sighting), 1)
            flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
            for k, (H, _) in enumerate(self._homographies):
                if areas[k] >= SMALLEST:
                    hidden = cv2.warpPerspective(explained, H @ GRID.to_metres, GRID.size, flags=flags)
                    counts[k] = counts[k] * (hidden == 0)
        return found

    def _busy(self, view: list[Image], scene: list[Image], least: float) -> NDArray[np.bool_]:
        """Where (stations,) the coarse left view about a card is not that of the empty scene: elsewhere is nothing."""
        changed = np.abs(view[COARSE] - scene[COARSE]) > UNCHANGED * least
        sums = cv2.integral(changed.astype(np.uint8))
        rows, columns = np.array(changed.shape)
        left, right = self._boxes[:, [0, 2]].clip(0, columns).T
        top, bottom = self._boxes[:, [1, 3]].clip(0, rows).T
        return np.asarray(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0)

    @staticmethod
    def _counting(views: list[list[Image]], scene: list[list[Image]], H: tuple[Array, Array], least: float) -> Image:
        """How much each place of a card counts, 0 to 1."""
        left, right = (Texture(laid_out(v, h, GRID), WINDOW) for v, h in zip(views, H, strict=True))
        textured = np.minimum(left.std, right.std) > least
        if textured.sum() * GRID.cell**2 < SMALLEST:
            return np.zeros_like(left.image)
        changed = np.ones_like(textured)
        for now, before, h in zip((left, right), scene, H, strict=True):
            changed &= correlation(now, Texture(laid_out(before, h, GRID), WINDOW)) < 1 - CHANGED
        agree = np.clip((correlation(left, right) - AGREE[0]) / (AGREE[1] - AGREE[0]), 0.0, 1.0)
        return np.asarray(np.where(textured & changed, agree, 0.0), np.float32)

    def _between(self, areas: Array, best: int) -> float:
        """The arc length at the top of a parabola through the best station and its neighbours."""
        first, last = self._bounds[np.searchsorted(self._bounds, best, "right") - 1 :][:2]
        s = self._stations[best][1]
        if not first < best < last - 1:
            return s
        a, b, c = areas[best - 1 : best + 2]
        offset = 0.5 * (a - c) / min(a - 2 * b + c, -1e-9)
        neighbour = self._stations[best + (1 if offset > 0 else -1)][1]
        return s + float(min(abs(offset), 0.5)) * (neighbour - s)

    @staticmethod
    def _sighting(frame: StereoFrame, way: Way, s: float, counts: Image) -> Sighting:
        area = float(counts.sum()) * GRID.cell**2
        x, y = _extent(counts)
        card = np.array([[a, b] for a in (x[0] - MARGIN, x[1] + MARGIN) for b in (0.0, GRID.top)])
        around = [way.pixels(s + ahead, card) for ahead in (-BEFORE, BEFORE)]
        crops, corners = [], []
        for side, image in enumerate((frame.left, frame.right)):
            pixels = np.concatenate([pair[side] for pair in around])
            low = np.clip(np.floor(pixels.min(0)), 0, np.array(image.shape[::-1]) - 2).astype(int)
            high = np.maximum(np.ceil(pixels.max(0)).astype(int) + 1, low + 2)
            crops.append(image[low[1] : high[1], low[0] : high[0]].copy())
            corners.append(low)
        return Sighting(frame.index, frame.time, way, s, x, y, area, (crops[0], crops[1]), np.array(corners, float))


def _box(way: Way, s: float) -> list[int]:
    """Left, top, right and bottom of a card in the coarse left view, px."""
    card = np.array([[x, y] for x in (GRID.left, -GRID.left) for y in (GRID.bottom, GRID.top)])
    pixels = way.pixels(s, card)[0] / 2**COARSE
    return [*np.floor(pixels.min(0)).astype(int).tolist(), *(np.ceil(pixels.max(0)).astype(int) + 1).tolist()]


def _flat(views: list[list[Image]], way: Way, s: float, counts: Image) -> float:
    """How well the views agree on what ``counts`` on the card at ``s`` if it lies on the road, relative to how well
    they agree if it stands."""
    left, _ = way.homographies(s)
    seen = Texture(laid_out(views[0], left, GRID), WINDOW)
    road = Texture(laid_out(views[1], way.over_road(s) @ left, GRID), WINDOW)
    agree = np.clip((correlation(seen, road) - AGREE[0]) / (AGREE[1] - AGREE[0]), 0.0, 1.0)
    return float(agree[counts > 0].sum() / counts.sum())


def _extent(counts: Image) -> tuple[tuple[float, float], tuple[float, float]]:
    """From where to where on the card, across and up in m, the largest piece of what counts reaches."""
    dense = (local_mean(counts, WINDOW) > PIECE).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(dense)
    if len(stats) < 2:
        return (-0.5, 0.5), (GRID.bottom, 1.0)
    piece = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    columns = np.flatnonzero(piece.sum(0) >= SLENDER * piece.sum(0).max())
    rows = np.flatnonzero(piece.any(1))
    return (float(GRID.x[columns[0]]), float(GRID.x[columns[-1]])), (float(GRID.y[rows[-1]]), float(GRID.y[rows[0]]))


def noise_of(image: Image, empty: Image) -> float:
    """The standard deviation of a picture's noise, grey levels, where it shows the empty scene."""
    differences = np.abs(np.diff((image - empty)[::2], axis=1))
    return float(1.4826 * np.median(differences) / np.sqrt(2.0))


def _outline(sighting: Sighting) -> NDArray[np.int32]:
    """The left view's pixels (N, 2) around all that belongs to a vehicle whose face was seen."""
    way, s = sighting.way, sighting.s
    top, body = (CEILING, BODY[1]) if sighting.y[1] > TALL else (sighting.y[1] + 0.2, BODY[0])
    x = (sighting.x[0] - 0.2, sighting.x[1] + 0.2)
    if abs(sighting.middle) < ASIDE:  # a lane holds one vehicle across, of which only parts may have been seen
        x = min(x[0], -HALF_WIDTH), max(x[1], HALF_WIDTH)
    card = np.array([[a, b] for a in x for b in (0.0, top)])
    ahead = np.sign(way.path.at(np.array(s + 0.1))[2] - way.path.at(np.array(s))[2]) or 1.0
    near, far = (way.pixels(s + ahead * d, card)[0] for d in (-BEFORE, body))
    depth = way.path.at(np.array(s - ahead * BEFORE))[2]
    points = np.concatenate([near, far]) if depth > 1.0 else far
    return np.asarray(cv2.convexHull(np.clip(points, -1e4, 1e4).round().astype(np.int32)), np.int32)
