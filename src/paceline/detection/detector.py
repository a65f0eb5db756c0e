"""What stands upright on a way in one frame and was not there before: the faces of vehicles, nearest explained first.

On a card at every arc length the two views are compared with each other and with the empty scene. A place counts where
the views agree with each other and neither agrees with the scene behind. Shadows and the light of headlamps lie on the
road, leaves and rain are nowhere on the way for both views: they leave too little to count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Bytes, Image, Mask
from paceline.detection import plane_sweep_cpu
from paceline.detection.lane_paths import LEVELS, Grid, Way, laid_out, pyramid
from paceline.detection.photo_consistency import local_mean, stands
from paceline.detection.plane_sweep import Card, Views, card_of
from paceline.recordings.stereo import StereoFrame
from paceline.subpixel import parabola_peak

GRID = Grid(left=-3.2, top=2.6, bottom=0.2, cell=0.05)  # m; what lies lower is road
WINDOW = 7  # cells, over which pictures are compared
SEARCH, SEARCH_WINDOW = Grid(left=-3.2, top=2.6, bottom=0.2, cell=0.1), 5  # of the coarse look at all stations
SPARSE = 2  # stations from one of the coarse look to the next
PROMISING = 0.2  # m² of places that count in a coarse look, about which a fine one is worth while
RIVAL, RIVALS = 0.5, 4  # of the most that counts coarsely, and stations: a fine look may see another as the highest
WIDE, CLOSE = (0.7, 1000, 0.4), (0.9, 4, 0.6)  # of the most that counts, and stations on either side at which as much
# counts; times the misfit of the pictures at the best one, below which another of those is better: more clearly if far
CONTRAST = (1.0, 2.0)  # grey levels, and times the noise: less is no texture
COARSE = 2  # level of the pyramid at which a glance tells where nothing has changed
PART = 0.2  # of a vehicle's smallest area that is other than the empty scene at a glance
UNCHANGED = 0.5  # of the contrast that makes a texture
SOME = 16  # rows from one to the next that tell the noise
SMALLEST = 0.25  # m² of places that count, of a motorcycle far away
STANDS = 1.0, 1.2  # times worse that the views agree if it lies on the road, coarsely and finely: shadows do not
BODY = 5.0, 14.0  # m that a car, and what is taller than a van, reaches behind its face
CLEAR = 2.0  # m behind the longest, from where on what is seen over a roof is another vehicle: a lorry whose top the
# picture cuts off looks as a car does
BEFORE = 2.5  # m that its face may lie before where most of it was seen
TALL = 2.3  # m from which on a vehicle may be a lorry or a bus
CEILING = 4.5  # m, of the tallest
PIECE = 0.25  # mean of what counts about a place that belongs to a face
SLENDER, LONG = 0.3, 0.3  # of a face's height and width: columns and rows of less are not of the face, but of a mirror
# or a shadow; or, if they reach so many m above it, of another vehicle's roof: lamps and roofs are round
ASIDE = 1.6  # m from the middle of a way, from where on what counts belongs to the next lane more and more
HALF_WIDTH = 1.3  # m, of a bus
MARGIN, KEPT = 0.9, 1.0  # m about a face that are kept of the pictures, and px of disparity before and behind it, or
# `BEFORE`;
LANE = 2.0  # m to either side of its way are in any case: one lamp may be all that was seen of a vehicle


@dataclass(frozen=True, eq=False)
class Sighting:
    """The face of a vehicle in one frame, at arc length ``s`` of a ``way``: ``x`` and ``y``, each (2,), from where to
    where on the card, m; ``area`` m² of it agree, ``upright`` times better than if they lay on the road. ``crops`` of
    both views, and of what was there ``before`` it, begin at the pixels ``corners`` (2, 2)."""

    frame: int
    time: float
    way: Way
    s: float
    x: tuple[float, float]
    y: tuple[float, float]
    area: float
    upright: float
    crops: tuple[Image, Image]
    before: tuple[Bytes, Bytes]
    corners: Array

    @property
    def place(self) -> Array:
        """The face's middle at the road, (3,) in the world."""
        return self.way.place(self.s, self.middle, 0.0)

    @property
    def middle(self) -> float:
        """Metres from the middle of the way to the middle of the face."""
        return 0.5 * sum(self.x)

    def error(self, least: float, pixels: float) -> float:
        """Metres along the way of an error of so many ``pixels`` of disparity, but ``least`` metres."""
        return error_at(self.way, float(self.place[2]), least, pixels)

    @cached_property
    def _levels(self) -> list[list[Image]]:
        return [pyramid(crop) for crop in self.crops]

    @cached_property
    def _levels_before(self) -> list[list[Image]]:
        return [pyramid(crop.astype(np.float32)) for crop in self.before]

    def cards(self, s: float, grid: Grid, origin: Array) -> tuple[Image, Image]:
        """Both views on the card at ``s``, its grid moved to ``origin`` (2,) m, from what was kept of them."""
        return self._laid_out(self._levels, s, grid, origin)

    def cards_before(self, s: float, grid: Grid, origin: Array) -> tuple[Image, Image]:
        """As `cards`, of what was there before."""
        return self._laid_out(self._levels_before, s, grid, origin)

    def _laid_out(self, views: list[list[Image]], s: float, grid: Grid, origin: Array) -> tuple[Image, Image]:
        move = np.array([[1, 0, origin[0]], [0, 1, origin[1]], [0, 0, 1.0]])
        found = []
        for levels, corner, H in zip(views, self.corners, self.way.homographies(s), strict=True):
            kept = np.array([[1, 0, -corner[0]], [0, 1, -corner[1]], [0, 0, 1.0]])
            found.append(laid_out(levels, kept @ H @ move, grid))
        return found[0], found[1]


def error_at(way: Way, depth: float, least: float, pixels: float) -> float:
    """Metres along a ``way`` at a ``depth``, m, of an error of so many ``pixels`` of disparity, but ``least`` m."""
    return max(least, pixels * depth**2 / float(way.rig.left.K[0, 0] * way.rig.baseline))


class Lookout:
    """Looks along ``ways`` at the frames of a stationary rig: coarsely at the cards about which something has changed,
    and then finely at those about which most counts. Nothing is looked at outside certain ``rows`` of the pictures."""

    def __init__(self, ways: list[Way]) -> None:
        self._stations = [(way, float(s)) for way in ways for s in way.stations()]
        self._bounds = np.cumsum([0, *(sum(w is way for w, _ in self._stations) for way in ways)])
        self.rows = _rows_of(self._stations)
        self._places = np.array([way.place(s, 0.0, 0.0) for way, s in self._stations]).reshape(-1, 3)
        top, coarse = self.rows.start, self._stations[::SPARSE]
        self._fine = [card_of(way.homographies(s), GRID, WINDOW, top) for way, s in self._stations]
        self._standing = [card_of(way.homographies(s), SEARCH, SEARCH_WINDOW, top) for way, s in coarse]
        self._lying = [card_of(_lying(way, s), SEARCH, SEARCH_WINDOW, top) for way, s in coarse]
        boxes = [[_box(H, SEARCH) for H in card.cells] for card in self._standing]
        self._boxes = np.array(boxes, int).reshape(-1, 2, 4)
        per_metre = (self._boxes[:, 0, 2] - self._boxes[:, 0, 0]) / (-2 * GRID.left)
        self._least_changed = PART * SMALLEST * per_metre**2

    def see(self, frame: StereoFrame, empty: tuple[Image, Image], noise: float | None = None) -> list[Sighting]:
        """The faces in ``frame`` before the ``empty`` scene (both views of it), the largest first. The ``noise`` is the
        left view's standard deviation, grey levels, where its difference from the scene does not tell it."""
        if not self._stations:
            return []
        views, scene = ([pyramid(i[self.rows]) for i in pair] for pair in ((frame.left, frame.right), empty))
        noise = noise_of(views[0][0], scene[0][0]) if noise is None else noise
        least = max(CONTRAST[0], CONTRAST[1] * noise)
        look = _Look(views, scene, self._fine, self._places, least)
        coarse, areas = self._coarsely(views, scene, least)
        coarsely_upright = partial(self._stands, coarse, views)
        found: list[Sighting] = []
        while len(peaks := self._peaks(areas, coarsely_upright)):
            best = max((self._highest(look, SPARSE * k) for k in peaks), key=look.area)
            if look.area(best) < SMALLEST:
                areas[peaks] = 0.0
                continue
            station, s, counts, piece = self._placed(look, best)
            lying = card_of(_lying(*self._stations[station]), GRID, WINDOW, self.rows.start)
            upright = float(stands(counts * piece, *lying.correlation(views)))
            if upright < STANDS[1]:
                continue
            first, behind = self._way_of(station)
            sighting = self._sighting(frame, empty, self._stations[station][0], s, counts, piece, upright)
            if first < station < behind - 1:  # what counts most at an end of the way is beyond it
                found.append(sighting)
            explained = look.explain(sighting, self.rows.start)
            for k in np.flatnonzero(areas).tolist():
                self._standing[k].hide(coarse[k], explained.at(SPARSE * k))
                areas[k] = _area(coarse[k], SEARCH)
        return found

    def _coarsely(self, views: Views, scene: Views, least: float) -> tuple[dict[int, Image], Array]:
        """How much each place (rows, columns) of the coarse cards counts about which something has changed, and what
        counts (stations,) on all of them, m²."""
        busy = np.flatnonzero(self._busy(views, scene, least)).tolist()
        counts = {k: self._standing[k].counts(views, scene, least, PROMISING) for k in busy}
        areas = np.zeros(len(self._standing))
        areas[busy] = [_area(counts[k], SEARCH) for k in busy]
        return counts, areas

    def _stands(self, coarse: dict[int, Image], views: Views, k: int) -> bool:
        """Whether what counts on a coarse card stands there, rather than lies on the road."""
        return bool(stands(coarse[k], *self._lying[k].correlation(views)) >= STANDS[0])

    def _busy(self, views: Views, scene: Views, least: float) -> NDArray[np.bool_]:
        """Where (stations,) both coarse views about a card are not those of the empty scene: elsewhere is nothing."""
        busy = np.ones(len(self._boxes), bool)
        for i, (view, before) in enumerate(zip(views, scene, strict=True)):
            changed = np.abs(view[COARSE] - before[COARSE]) > UNCHANGED * least
            sums = cv2.integral(changed.astype(np.uint8))
            rows, columns = np.array(changed.shape)
            left, right = self._boxes[:, i, [0, 2]].clip(0, columns).T
            top, bottom = self._boxes[:, i, [1, 3]].clip(0, rows).T
            busy &= sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > self._least_changed
        return busy

    def _peaks(self, areas: Array, upright: Callable[[int], bool]) -> list[int]:
        """The stations between whose neighbours most counts, if it is promising and ``upright``; not those where far
        less does than at the first one. What is not upright is taken off the ``areas``."""
        while True:
            before, behind = np.append(0.0, areas[:-1]), np.append(areas[1:], 0.0)
            least = max(PROMISING, RIVAL * float(areas.max()))
            found = np.flatnonzero((areas >= before) & (areas >= behind) & (areas >= least))
            peaks = [int(k) for k in found[np.argsort(-areas[found])][:RIVALS]]
            lying = [k for k in peaks if not upright(k)]
            if not lying:
                return peaks
            areas[lying] = 0.0

    def _highest(self, look: _Look, k: int) -> int:
        """The station up the hill from ``k`` at which most counts."""
        first, last = self._way_of(k)
        while True:
            best = max(range(max(k - 1, first), min(k + 2, last)), key=look.area)
            if look.area(best) <= look.area(k):
                return k
            k = best

    def _placed(self, look: _Look, best: int) -> tuple[int, float, Image, Mask]:
        """Where a vehicle is that counts most at the ``best`` station: its station and arc length, what counts there,
        and the piece of it that is the vehicle, which counts no more from now on."""
        most = largest_piece(look.counts(best))
        station, height = self._sharpest(look, best, most)
        s, counts = self._between(station, height), look.counts(station)
        piece = largest_piece(counts)
        look.forget(best, most)
        look.forget(station, piece)
        return station, s, counts, piece

    def _sharpest(self, look: _Look, best: int, piece: Mask) -> tuple[int, Callable[[int], float]]:
        """The station where a vehicle is whose ``piece`` counts most at the ``best`` one, and what is highest there: as
        much counts all through a halo, and of those stations it is the one where the pictures fit each other far more
        sharply. By day they hardly do, and what counts tells the place better."""
        first, last = self._way_of(best)
        sharpness = cache(partial(look.sharpness, piece=piece, of=best))
        for share, reach, sharper in (WIDE, CLOSE):
            least, low, high = share * look.area(best), best, best
            while low > max(first, best - reach) and look.area(low - 1) >= least:
                low -= 1
            while high < min(last - 1, best + reach) and look.area(high + 1) >= least:
                high += 1
            sharp = max(range(low, high + 1), key=sharpness)
            if 1.0 - sharpness(sharp) < sharper * (1.0 - sharpness(best)):
                return sharp, sharpness
        return best, look.area

    def _between(self, station: int, height: Callable[[int], float]) -> float:
        """The arc length at the top of a parabola through the heights of a station and of its neighbours."""
        first, last = self._way_of(station)
        s = self._stations[station][1]
        if not first < station < last - 1:
            return s
        offset = parabola_peak(height(station - 1), height(station), height(station + 1))
        neighbour = self._stations[station + (1 if offset > 0 else -1)][1]
        return s + abs(offset) * (neighbour - s)

    def _way_of(self, station: int) -> tuple[int, int]:
        """The first station of the same way, and the one behind its last."""
        first, behind = self._bounds[np.searchsorted(self._bounds, station, "right") - 1 :][:2]
        return int(first), int(behind)

    @staticmethod
    def _sighting(
        frame: StereoFrame, empty: tuple[Image, Image], way: Way, s: float, counts: Image, piece: Mask, upright: float
    ) -> Sighting:
        area = float((counts * piece).sum()) * GRID.cell**2
        x, y = extent(piece)
        across = min(x[0] - MARGIN, -LANE), max(x[1] + MARGIN, LANE)
        card = np.array([[a, b] for a in across for b in (0.0, GRID.top)])
        kept = error_at(way, float(way.path.at(np.array(s))[2]), BEFORE, KEPT)
        around = [way.pixels(s + ahead, card) for ahead in (-kept, kept)]
        crops, before, corners = [], [], []
        for side, (image, scene) in enumerate(zip((frame.left, frame.right), empty, strict=True)):
            pixels = np.concatenate([pair[side] for pair in around])
            low = np.clip(np.floor(pixels.min(0)), 0, np.array(image.shape[::-1]) - 2).astype(int)
            high = np.maximum(np.ceil(pixels.max(0)).astype(int) + 1, low + 2)
            part = np.s_[low[1] : high[1], low[0] : high[0]]
            crops.append(image[part].copy())
            before.append(np.clip(np.rint(scene[part]), 0, 255).astype(np.uint8))
            corners.append(low)
        views, scenes, at = (crops[0], crops[1]), (before[0], before[1]), np.array(corners, float)
        return Sighting(frame.index, frame.time, way, s, x, y, area, upright, views, scenes, at)


class _Look:
    """A fine look at single ``cards`` at ``places`` (stations, 3) in one frame; what vehicles that were seen explain in
    the left picture counts no more."""

    def __init__(self, views: Views, scene: Views, cards: list[Card], places: Array, least: float) -> None:
        self._views, self._scene, self._cards, self._places, self._least = views, scene, cards, places, least
        self._counts: dict[int, Image] = {}
        self._areas: dict[int, float] = {}
        self._explained: list[_Explained] = []

    def counts(self, station: int) -> Image:
        """How much each place of a card counts, 0 to 1."""
        if station not in self._counts:
            self._counts[station] = self._cards[station].counts(self._views, self._scene, self._least)
            for vehicle in self._explained:
                self._cards[station].hide(self._counts[station], vehicle.at(station))
        return self._counts[station]

    def area(self, station: int) -> float:
        """What counts on a card, m²."""
        if station not in self._areas:
            self._areas[station] = _area(self.counts(station), GRID)
        return self._areas[station]

    def sharpness(self, station: int, piece: Mask, of: int) -> float:
        """How well the pictures fit each other if what is a ``piece`` of the card ``of`` in the left one stands at a
        ``station``."""
        return self._cards[station].sharpness(self._views, self._cards[station].showing(piece, self._cards[of]))

    def forget(self, station: int, piece: Mask) -> None:
        """Count nothing any more in a ``piece`` (rows, columns) of a card, nor about it, which made it one."""
        self._counts[station] = apart_from(piece, self._counts[station])
        self._areas.pop(station, None)

    def explain(self, sighting: Sighting, top: int) -> _Explained:
        """Count nothing any more of what belongs to a vehicle that was seen, which is returned; the picture begins at
        the row ``top``."""
        explained = _explained_by(sighting, self._places, self._views[0][0].shape, top)
        self._explained.append(explained)
        self._areas = {}
        for station, counts in self._counts.items():
            self._cards[station].hide(counts, explained.at(station))
        return explained


def _area(counts: Image, grid: Grid) -> float:
    """What counts on a card (rows, columns), m²; less of it beside the lane."""
    return float(plane_sweep_cpu.weighted(counts, _centred(grid))) * grid.cell**2


@cache
def _centred(grid: Grid) -> Image:
    return np.clip(1.0 - 0.4 * (np.abs(grid.x) - ASIDE), 0.3, 1.0).astype(np.float32)


def _box(cells: Array, grid: Grid) -> list[int]:
    """Left, top, right and bottom of a card, whose ``cells`` (3, 3) lie at these pixels, in a coarse view, px."""
    columns, rows = grid.size
    corners = np.array([[x, y, 1.0] for x in (0, columns - 1) for y in (0, rows - 1)]) @ cells.T
    pixels = corners[:, :2] / corners[:, 2:] / 2**COARSE
    return [*np.floor(pixels.min(0)).astype(int).tolist(), *(np.ceil(pixels.max(0)).astype(int) + 1).tolist()]


def _rows_of(stations: list[tuple[Way, float]]) -> slice:
    """The rows of both pictures in which there may be something to see from the ``stations``."""
    x = GRID.left - MARGIN
    card = np.array([[a, b] for a in (x, -x) for b in (0.0, GRID.top)])
    rows = [way.pixels(s + d, card)[side][:, 1] for way, s in stations for d in (-BEFORE, BEFORE) for side in (0, 1)]
    if not rows:
        return slice(0, 0)
    height, whole = stations[0][0].rig.left.image_size[1], 2 ** (LEVELS - 1)
    top = int(np.min(rows) // whole) * whole
    return slice(max(top, 0), min(int(np.max(rows)) + 2, height))


def _lying(way: Way, s: float) -> tuple[Array, Array]:
    """As `Way.homographies`, but what a card shows the left view lies on the road for the right one."""
    left, _ = way.homographies(s)
    return left, way.over_road(s) @ left


def largest_piece(counts: Image) -> Mask:
    """Where on a card (rows, columns) the largest piece of what counts is; all of it where nothing hangs together."""
    dense = (local_mean(counts, WINDOW) > PIECE).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(dense)
    if len(stats) < 2:
        return np.ones(counts.shape, bool)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def apart_from(piece: Mask, counts: Image) -> Image:
    """What ``counts`` on a card (rows, columns) but not in a ``piece`` of it, nor so near that it is part of its mean:
    a piece may lie between what counts."""
    about = cv2.dilate(piece.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))
    return np.where(about, np.float32(0.0), counts)


def extent(piece: Mask) -> tuple[tuple[float, float], tuple[float, float]]:
    """From where to where on the card, across and up in m, a piece (rows, columns) reaches, but for what is slender at
    its sides, and slender and long above it."""
    columns = np.flatnonzero(piece.sum(0) >= SLENDER * piece.sum(0).max())
    rows = np.flatnonzero(piece.any(1)).tolist()
    top, bottom = rows[0], rows[-1]
    widths = piece[:, columns].sum(1)
    wide = int(np.argmax(widths >= SLENDER * widths.max()))
    if GRID.y[top] - GRID.y[wide] > LONG:
        top = wide
    return (float(GRID.x[columns[0]]), float(GRID.x[columns[-1]])), (float(GRID.y[bottom]), float(GRID.y[top]))


def noise_of(image: Image, empty: Image) -> float:
    """The standard deviation of a picture's noise, grey levels, where it shows the empty scene; from some rows."""
    differences = np.abs(np.diff((image[::SOME] - empty[::SOME]), axis=1))
    return float(1.4826 * np.median(differences) / np.sqrt(2.0))


@dataclass(frozen=True, eq=False)
class _Explained:
    """What a vehicle that was seen explains in the left picture (H, W: not 0): all about its ``body`` at the stations
    (stations,) ``near`` that, only what its ``face`` hides at the others. What stands farther behind and is seen over
    its roof is another one."""

    body: Bytes
    face: Bytes
    near: NDArray[np.bool_]

    def at(self, station: int) -> Bytes:
        return self.body if self.near[station] else self.face


def _explained_by(sighting: Sighting, places: Array, shape: tuple[int, ...], top: int) -> _Explained:
    """What a ``sighting`` explains to stations at ``places`` (stations, 3), in a picture that begins at the row
    ``top``."""
    way, s = sighting.way, sighting.s
    high, length = (CEILING, BODY[1]) if sighting.y[1] > TALL else (sighting.y[1] + 0.2, BODY[0])
    x = (sighting.x[0] - 0.2, sighting.x[1] + 0.2)
    if abs(sighting.middle) < ASIDE:  # a lane holds one vehicle across, of which only parts may have been seen
        x = min(x[0], -HALF_WIDTH), max(x[1], HALF_WIDTH)
    card = np.array([[a, b] for a in x for b in (0.0, high)])
    forward = way.path.frames(np.array(s))[:, 0]
    ahead = np.sign(forward[2]) or 1.0
    before, at, behind = (way.pixels(s + ahead * d, card)[0] for d in (-BEFORE, 0.0, length))
    if way.path.at(np.array(s - ahead * BEFORE))[2] <= 1.0:
        before = at
    masks = []
    for points in ((before, behind), (before, at)):
        pixels = np.clip(np.concatenate(points) - [0, top], -1e4, 1e4).round().astype(np.int32)
        masks.append(np.zeros(shape, np.uint8))
        cv2.fillConvexPoly(masks[-1], cv2.convexHull(pixels), 1)
    beyond = ahead * ((places - sighting.place) @ forward)
    return _Explained(masks[0], masks[1], beyond < BODY[1] + CLEAR)
