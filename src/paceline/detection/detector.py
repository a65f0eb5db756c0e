"""Detection of vehicles in one image pair by a plane sweep: upright faces that are not in the background.

On each sweep plane the two views are compared with each other and with the background. A cell of the plane is
consistent where the views match each other and neither matches the background. Shadows and the light of headlamps are
on the road, and leaves and rain appear at different positions in the two views: their consistent area is small.
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
from paceline.detection.lane_paths import PYRAMID_LEVELS, LanePath, PlaneGrid, image_pyramid, warp_to_plane
from paceline.detection.photo_consistency import local_mean, upright_ratio
from paceline.detection.plane_sweep import Pyramids, SweepPlane, plane_at
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import DEFAULTS, DetectionSettings
from paceline.subpixel import parabola_peak

FINE_GRID = PlaneGrid(left=-3.2, top=2.6, bottom=0.2, cell=0.05)  # m; what is lower may be road
FINE_NCC_WINDOW = 7  # cells, on the fine grid
COARSE_GRID = PlaneGrid(left=-3.2, top=2.6, bottom=0.2, cell=0.1)  # of the first pass
COARSE_NCC_WINDOW = 5  # cells, on the coarse grid
COARSE_STRIDE = 2  # sweep planes from one of the coarse pass to the next
MIN_COARSE_AREA_M2 = 0.2  # consistent area on a coarse plane about which fine planes are evaluated
MIN_PEAK_RATIO, MAX_PEAKS = 0.5, 4  # coarse peaks, relative to the highest, whose order may change on the fine grid
# least area relative to the best plane, planes to either side, and greatest 1 − NCC relative to the best plane's, for
# another plane with nearly the same area to be preferred: the farther away it is, the clearer its better match must be
WIDE_PLATEAU, CLOSE_PLATEAU = (0.7, 1000, 0.4), (0.9, 4, 0.6)
MIN_TEXTURE_GREY, MIN_CONTRAST_NOISE_RATIO = 1.0, 2.0  # least local standard deviation of texture
COARSE_LEVEL = 2  # pyramid level at which unchanged regions are skipped
MIN_CHANGED_AREA_SHARE = 0.2  # of the smallest vehicle's area that differs from the background at that level
CHANGED_CONTRAST_SHARE = 0.5  # of the least contrast by which a pixel differs there
NOISE_ROW_STEP = 16  # step of the rows from which the noise is estimated
MIN_DETECTION_AREA_M2 = 0.25  # consistent area of a distant motorcycle
MIN_COARSE_UPRIGHT_RATIO, MIN_FINE_UPRIGHT_RATIO = 1.0, 1.2  # on coarse and on fine planes; a shadow has less
CAR_LENGTH_M, LORRY_LENGTH_M = 5.0, 14.0  # by which a car, and a vehicle taller than a van, extends behind its face
# behind the longest lorry, from where on what is seen over the roof of any vehicle is another one: a lorry whose top is
# cut off by the image looks like a car
BODY_CLEARANCE_M = 2.0
FACE_LEAD_M = 2.5  # distance by which a face may be nearer than the plane with the largest consistent area
MIN_LONG_VEHICLE_HEIGHT_M = 2.3  # height from which on a vehicle may be a lorry or a bus
MIN_CELL_SCORE = 0.25  # local mean of the consistency of cells that belong to a face
MIN_EXTENT_SHARE = 0.3  # of a face's height or width: columns and rows with less are a mirror or a shadow,
MAX_PROTRUSION_M = 0.3  # or, where narrow rows reach higher than this, the roof of another vehicle
LANE_CORE_M = 1.6  # from the middle of a lane, beyond which cells count less: they may belong to the next lane
BUS_HALF_WIDTH_M = 1.3
CROP_MARGIN_M = 0.9  # about a face that is kept of the images,
CROP_DISPARITY_PX = 1.0  # and in depth, or `FACE_LEAD_M` if that is more
MIN_CROP_HALF_WIDTH_M = 2.0  # kept in any case: one lamp may be all that was detected of a vehicle


@dataclass(frozen=True, eq=False)
class Detection:
    """The face of a vehicle detected in one frame.

    It stands on the plane at arc length ``s`` of ``lane``, between ``x`` and ``y``, each (2,) m; ``area`` m² of it are
    consistent, with an ``upright_ratio`` (see `photo_consistency.upright_ratio`). ``crops`` of both views and of their
    ``background`` begin at the pixels ``crop_origins`` (2, 2); ``noise`` is their standard deviation, grey levels.
    ``is_road_known`` says whether ``background`` shows the road behind the vehicle.
    """

    frame: int
    time: float
    lane: LanePath
    s: float
    x: tuple[float, float]
    y: tuple[float, float]
    area: float
    upright_ratio: float
    crops: tuple[Image, Image]
    background: tuple[Bytes, Bytes]
    crop_origins: Array
    noise: float = 1.0
    is_road_known: bool = True

    @property
    def position(self) -> Array:
        """The world point (3,) on the road below the middle of the face."""
        return self.lane.point(self.s, self.lateral_offset, 0.0)

    @property
    def lateral_offset(self) -> float:
        """Metres from the middle of the lane to the middle of the face."""
        return 0.5 * sum(self.x)

    def distance_error(self, min_m: float, pixels: float) -> float:
        """Metres along the lane that correspond to ``pixels`` of disparity, but at least ``min_m``."""
        return distance_error(self.lane, float(self.position[2]), min_m, pixels)

    @cached_property
    def _pyramids(self) -> list[list[Image]]:
        return [image_pyramid(crop) for crop in self.crops]

    @cached_property
    def _background_pyramids(self) -> list[list[Image]]:
        return [image_pyramid(crop.astype(np.float32)) for crop in self.background]

    def warp(self, s: float, grid: PlaneGrid, origin: Array) -> tuple[Image, Image]:
        """Both crops warped to the plane at ``s``, on ``grid`` moved to ``origin`` (2,) m."""
        left, right = self.lane.homographies(s)
        return self._warp(self._pyramids, 0, left, grid, origin), self._warp(self._pyramids, 1, right, grid, origin)

    def warp_on_road(self, s: float, grid: PlaneGrid, origin: Array) -> Image:
        """As `warp`, of the right view only, where what the left one shows there lies on the road."""
        return self._warp(self._pyramids, 1, on_road(self.lane, s)[1], grid, origin)

    def warp_background(self, s: float, grid: PlaneGrid, origin: Array) -> tuple[Image, Image]:
        """As `warp`, of the background."""
        left, right = self.lane.homographies(s)
        empty = self._background_pyramids
        return self._warp(empty, 0, left, grid, origin), self._warp(empty, 1, right, grid, origin)

    def _warp(self, views: list[list[Image]], side: int, homography: Array, grid: PlaneGrid, origin: Array) -> Image:
        """One of the ``views``, 0 or 1, that sees ``grid`` moved to ``origin`` through a ``homography`` (3, 3)."""
        move = np.array([[1, 0, origin[0]], [0, 1, origin[1]], [0, 0, 1.0]])
        corner = self.crop_origins[side]
        to_crop = np.array([[1, 0, -corner[0]], [0, 1, -corner[1]], [0, 0, 1.0]])
        return warp_to_plane(views[side], to_crop @ homography @ move, grid)


def distance_error(lane: LanePath, depth: float, min_m: float, pixels: float) -> float:
    """Metres along ``lane`` at ``depth`` m that correspond to ``pixels`` of disparity, but at least ``min_m``."""
    return max(min_m, pixels * depth**2 / float(lane.rig.left.K[0, 0] * lane.rig.baseline))


class PlaneSweepDetector:
    """Detects vehicles along ``lanes`` in the frames of a stationary rig.

    A coarse pass covers the planes about which the image has changed, a fine one only those about which the coarse
    consistent area is largest. Only certain ``rows`` of the images are used.
    """

    def __init__(self, lanes: list[LanePath], settings: DetectionSettings = DEFAULTS.detection) -> None:
        self._max_height = settings.max_height
        self._planes = [(lane, float(s)) for lane in lanes for s in lane.sweep_positions(settings.near, settings.far)]
        self._bounds = np.cumsum([0, *(sum(other is lane for other, _ in self._planes) for lane in lanes)])
        self.rows = _visible_rows(self._planes)
        self._points = np.array([lane.point(s, 0.0, 0.0) for lane, s in self._planes]).reshape(-1, 3)
        top, coarse = self.rows.start, self._planes[::COARSE_STRIDE]
        self._fine = [plane_at(lane.homographies(s), FINE_GRID, FINE_NCC_WINDOW, top) for lane, s in self._planes]
        self._upright = [plane_at(lane.homographies(s), COARSE_GRID, COARSE_NCC_WINDOW, top) for lane, s in coarse]
        self._on_road = [plane_at(on_road(lane, s), COARSE_GRID, COARSE_NCC_WINDOW, top) for lane, s in coarse]
        boxes = [[_bounding_box(H, COARSE_GRID) for H in plane.homographies] for plane in self._upright]
        self._boxes = np.array(boxes, int).reshape(-1, 2, 4)
        per_metre = (self._boxes[:, 0, 2] - self._boxes[:, 0, 0]) / (-2 * FINE_GRID.left)
        self._min_changed = MIN_CHANGED_AREA_SHARE * MIN_DETECTION_AREA_M2 * per_metre**2

    def detect(
        self, frame: StereoFrame, background: tuple[Image, Image], noise: float | None = None
    ) -> list[Detection]:
        """The vehicles in ``frame``, the largest first, given the ``background`` of both views. ``noise`` is the left
        view's standard deviation, grey levels; by default it is estimated from the difference to the background."""
        if not self._planes:
            return []
        views, empty = ([image_pyramid(i[self.rows]) for i in pair] for pair in ((frame.left, frame.right), background))
        noise = noise_std(views[0][0], empty[0][0]) if noise is None else noise
        min_contrast = max(MIN_TEXTURE_GREY, MIN_CONTRAST_NOISE_RATIO * noise)
        volume = _ConsistencyVolume(views, empty, self._fine, self._points, min_contrast)
        coarse, areas = self._coarse_pass(views, empty, min_contrast)
        coarse_is_upright = partial(self._is_upright, coarse, views)
        detections: list[Detection] = []
        while len(peaks := self._peaks(areas, coarse_is_upright)):
            best = max((self._climb(volume, COARSE_STRIDE * k) for k in peaks), key=volume.area)
            if volume.area(best) < MIN_DETECTION_AREA_M2:
                areas[peaks] = 0.0
                continue
            index, s, consistency, component = self._localise(volume, best)
            as_road = plane_at(on_road(*self._planes[index]), FINE_GRID, FINE_NCC_WINDOW, self.rows.start)
            upright = float(upright_ratio(consistency * component, *as_road.correlation_map(views)))
            if upright < MIN_FINE_UPRIGHT_RATIO:
                continue
            first, end = self._lane_range(index)
            lane = self._planes[index][0]
            detection = self._detection(frame, background, lane, s, consistency, component, upright, noise)
            if first < index < end - 1:  # at an end of the lane path the true maximum may lie beyond it
                detections.append(detection)
            mask = volume.mask_vehicle(detection, self.rows.start, self._max_height)
            for k in np.flatnonzero(areas).tolist():
                self._upright[k].clear_masked(coarse[k], mask.at(COARSE_STRIDE * k))
                areas[k] = _area(coarse[k], COARSE_GRID)
        return detections

    def _coarse_pass(
        self, views: Pyramids, background: Pyramids, min_contrast: float
    ) -> tuple[dict[int, Image], Array]:
        """The consistency (rows, columns) of the coarse planes about which something has changed, and the consistent
        area (planes,) of all of them, m²."""
        changed = np.flatnonzero(self._changed(views, background, min_contrast)).tolist()
        maps = {
            k: self._upright[k].consistency_map(views, background, min_contrast, MIN_COARSE_AREA_M2) for k in changed
        }
        areas = np.zeros(len(self._upright))
        areas[changed] = [_area(maps[k], COARSE_GRID) for k in changed]
        return maps, areas

    def _is_upright(self, coarse: dict[int, Image], views: Pyramids, k: int) -> bool:
        """Whether the consistent area of a coarse plane is an upright surface rather than the road's."""
        return bool(upright_ratio(coarse[k], *self._on_road[k].correlation_map(views)) >= MIN_COARSE_UPRIGHT_RATIO)

    def _changed(self, views: Pyramids, background: Pyramids, min_contrast: float) -> NDArray[np.bool_]:
        """Whether (planes,) both reduced views differ from the background about a coarse plane; others are skipped."""
        result = np.ones(len(self._boxes), bool)
        for i, (view, empty) in enumerate(zip(views, background, strict=True)):
            changed = np.abs(view[COARSE_LEVEL] - empty[COARSE_LEVEL]) > CHANGED_CONTRAST_SHARE * min_contrast
            sums = cv2.integral(changed.astype(np.uint8))
            rows, columns = np.array(changed.shape)
            left, right = self._boxes[:, i, [0, 2]].clip(0, columns).T
            top, bottom = self._boxes[:, i, [1, 3]].clip(0, rows).T
            result &= sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > self._min_changed
        return result

    def _peaks(self, areas: Array, is_upright: Callable[[int], bool]) -> list[int]:
        """The coarse planes at local maxima of the consistent area, the highest first; those that are far lower than
        the highest are left out. ``areas`` of peaks that are not upright are set to 0."""
        while True:
            previous, following = np.append(0.0, areas[:-1]), np.append(areas[1:], 0.0)
            min_area = max(MIN_COARSE_AREA_M2, MIN_PEAK_RATIO * float(areas.max()))
            peak_indices = np.flatnonzero((areas >= previous) & (areas >= following) & (areas >= min_area))
            peaks = [int(k) for k in peak_indices[np.argsort(-areas[peak_indices])][:MAX_PEAKS]]
            not_upright = [k for k in peaks if not is_upright(k)]
            if not not_upright:
                return peaks
            areas[not_upright] = 0.0

    def _climb(self, volume: _ConsistencyVolume, k: int) -> int:
        """The local maximum of the consistent area reached from plane ``k`` by hill climbing."""
        first, end = self._lane_range(k)
        while True:
            best = max(range(max(k - 1, first), min(k + 2, end)), key=volume.area)
            if volume.area(best) <= volume.area(k):
                return k
            k = best

    def _localise(self, volume: _ConsistencyVolume, best: int) -> tuple[int, float, Image, Mask]:
        """The place of the vehicle whose consistent area is largest on plane ``best``: its plane and arc length, the
        consistency there, and the component of it that is the vehicle, which is removed from the volume."""
        largest = largest_component(volume.consistency_map(best))
        index, height = self._best_match(volume, best, largest)
        s, consistency = self._interpolate(index, height), volume.consistency_map(index)
        component = largest_component(consistency)
        volume.discard(best, largest)
        volume.discard(index, component)
        return index, s, consistency, component

    def _best_match(self, volume: _ConsistencyVolume, best: int, component: Mask) -> tuple[int, Callable[[int], float]]:
        """The plane of a vehicle whose ``component`` has the largest area on plane ``best``, and the function that is
        largest there.

        In the glow about a lamp many planes have nearly the same area; of those the plane with a far better weighted
        NCC is taken. By day there is hardly such a plane, and the area locates the vehicle better.
        """
        first, end = self._lane_range(best)
        ncc = cache(partial(volume.weighted_ncc, component=component, peak=best))
        for share, reach, misfit_ratio in (WIDE_PLATEAU, CLOSE_PLATEAU):
            min_area, low, high = share * volume.area(best), best, best
            while low > max(first, best - reach) and volume.area(low - 1) >= min_area:
                low -= 1
            while high < min(end - 1, best + reach) and volume.area(high + 1) >= min_area:
                high += 1
            sharpest = max(range(low, high + 1), key=ncc)
            if 1.0 - ncc(sharpest) < misfit_ratio * (1.0 - ncc(best)):
                return sharpest, ncc
        return best, volume.area

    def _interpolate(self, index: int, height: Callable[[int], float]) -> float:
        """The arc length at the vertex of a parabola through the heights of a plane and of its neighbours."""
        first, end = self._lane_range(index)
        s = self._planes[index][1]
        if not first < index < end - 1:
            return s
        offset = parabola_peak(height(index - 1), height(index), height(index + 1))
        neighbour = self._planes[index + (1 if offset > 0 else -1)][1]
        return s + abs(offset) * (neighbour - s)

    def _lane_range(self, index: int) -> tuple[int, int]:
        """The first plane of the same lane, and the one after its last."""
        first, end = self._bounds[np.searchsorted(self._bounds, index, "right") - 1 :][:2]
        return int(first), int(end)

    @staticmethod
    def _detection(
        frame: StereoFrame,
        background: tuple[Image, Image],
        lane: LanePath,
        s: float,
        consistency: Image,
        component: Mask,
        upright: float,
        noise: float,
    ) -> Detection:
        area = float((consistency * component).sum()) * FINE_GRID.cell**2
        x, y = extent(component)
        across = min(x[0] - CROP_MARGIN_M, -MIN_CROP_HALF_WIDTH_M), max(x[1] + CROP_MARGIN_M, MIN_CROP_HALF_WIDTH_M)
        corners = np.array([[a, b] for a in across for b in (0.0, FINE_GRID.top)])
        lead = distance_error(lane, float(lane.path.at(np.array(s))[2]), FACE_LEAD_M, CROP_DISPARITY_PX)
        around = [lane.pixels(s + ahead, corners) for ahead in (-lead, lead)]
        crops, empty, origins = [], [], []
        for side, (image, scene) in enumerate(zip((frame.left, frame.right), background, strict=True)):
            pixels = np.concatenate([pair[side] for pair in around])
            low = np.clip(np.floor(pixels.min(0)), 0, np.array(image.shape[::-1]) - 2).astype(int)
            high = np.maximum(np.ceil(pixels.max(0)).astype(int) + 1, low + 2)
            part = np.s_[low[1] : high[1], low[0] : high[0]]
            crops.append(image[part].copy())
            empty.append(np.clip(np.rint(scene[part]), 0, 255).astype(np.uint8))
            origins.append(low)
        views, scenes, crop_origins = (crops[0], crops[1]), (empty[0], empty[1]), np.array(origins, float)
        return Detection(frame.index, frame.time, lane, s, x, y, area, upright, views, scenes, crop_origins, noise)


class _ConsistencyVolume:
    """The consistency of the fine ``planes`` at ``points`` (planes, 3) in one frame, computed when asked for; the
    regions of vehicles that were detected are 0."""

    def __init__(
        self, views: Pyramids, background: Pyramids, planes: list[SweepPlane], points: Array, min_contrast: float
    ) -> None:
        self._views, self._background, self._planes = views, background, planes
        self._points, self._min_contrast = points, min_contrast
        self._maps: dict[int, Image] = {}
        self._areas: dict[int, float] = {}
        self._masks: list[_VehicleMask] = []

    def consistency_map(self, index: int) -> Image:
        """The consistency of each cell of a plane, 0 to 1."""
        if index not in self._maps:
            self._maps[index] = self._planes[index].consistency_map(self._views, self._background, self._min_contrast)
            for mask in self._masks:
                self._planes[index].clear_masked(self._maps[index], mask.at(index))
        return self._maps[index]

    def area(self, index: int) -> float:
        """The consistent area of a plane, m²."""
        if index not in self._areas:
            self._areas[index] = _area(self.consistency_map(index), FINE_GRID)
        return self._areas[index]

    def weighted_ncc(self, index: int, component: Mask, peak: int) -> float:
        """The weighted NCC of both views on plane ``index``, where the left view shows the ``component`` of plane
        ``peak``."""
        plane = self._planes[index]
        return plane.weighted_ncc(self._views, plane.transfer_mask(component, self._planes[peak]))

    def discard(self, index: int, component: Mask) -> None:
        """Set a ``component`` (rows, columns) of a plane to 0, with the cells about it that made it one."""
        self._maps[index] = without_component(component, self._maps[index])
        self._areas.pop(index, None)

    def mask_vehicle(self, detection: Detection, top: int, max_height: float) -> _VehicleMask:
        """Set to 0 what belongs to a vehicle that was detected, and return its mask; the image begins at row
        ``top``, and the tallest vehicles have ``max_height`` m."""
        mask = _vehicle_mask(detection, self._points, self._views[0][0].shape, top, max_height)
        self._masks.append(mask)
        self._areas = {}
        for index, consistency in self._maps.items():
            self._planes[index].clear_masked(consistency, mask.at(index))
        return mask


def _area(consistency: Image, grid: PlaneGrid) -> float:
    """The consistent area of a plane (rows, columns), m²; cells beside the lane count less."""
    return float(plane_sweep_cpu.weighted_sum(consistency, _lane_weights(grid))) * grid.cell**2


@cache
def _lane_weights(grid: PlaneGrid) -> Image:
    return np.clip(1.0 - 0.4 * (np.abs(grid.x) - LANE_CORE_M), 0.3, 1.0).astype(np.float32)


def _bounding_box(homography: Array, grid: PlaneGrid) -> list[int]:
    """Left, top, right and bottom, px of the reduced image, of a plane whose cells ``homography`` (3, 3) maps to
    pixels."""
    columns, rows = grid.size
    corners = np.array([[x, y, 1.0] for x in (0, columns - 1) for y in (0, rows - 1)]) @ homography.T
    pixels = corners[:, :2] / corners[:, 2:] / 2**COARSE_LEVEL
    return [*np.floor(pixels.min(0)).astype(int).tolist(), *(np.ceil(pixels.max(0)).astype(int) + 1).tolist()]


def _visible_rows(planes: list[tuple[LanePath, float]]) -> slice:
    """The rows of both images in which vehicles on the ``planes`` may appear."""
    x = FINE_GRID.left - CROP_MARGIN_M
    corners = np.array([[a, b] for a in (x, -x) for b in (0.0, FINE_GRID.top)])
    rows = [
        lane.pixels(s + d, corners)[side][:, 1]
        for lane, s in planes
        for d in (-FACE_LEAD_M, FACE_LEAD_M)
        for side in (0, 1)
    ]
    if not rows:
        return slice(0, 0)
    height, row_multiple = planes[0][0].rig.left.image_size[1], 2 ** (PYRAMID_LEVELS - 1)
    top = int(np.min(rows) // row_multiple) * row_multiple
    return slice(max(top, 0), min(int(np.max(rows)) + 2, height))


def on_road(lane: LanePath, s: float) -> tuple[Array, Array]:
    """As `LanePath.homographies`, but what the left view shows on the plane lies on the road for the right one."""
    left, _ = lane.homographies(s)
    return left, lane.road_homography(s) @ left


def largest_component(consistency: Image) -> Mask:
    """The largest connected component (rows, columns) of the locally averaged consistency; every cell where there is
    none."""
    dense = (local_mean(consistency, FINE_NCC_WINDOW) > MIN_CELL_SCORE).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(dense)
    if len(stats) < 2:
        return np.ones(consistency.shape, bool)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def without_component(component: Mask, consistency: Image) -> Image:
    """``consistency`` (rows, columns), set to 0 in a ``component`` and where it contributed to the local mean: the
    cells of a component are not all consistent themselves."""
    around = cv2.dilate(component.astype(np.uint8), np.ones((FINE_NCC_WINDOW, FINE_NCC_WINDOW), np.uint8))
    return np.where(around, np.float32(0.0), consistency)


def extent(component: Mask) -> tuple[tuple[float, float], tuple[float, float]]:
    """The extent of a ``component`` (rows, columns) on the plane, x and y in m, without thin parts at its sides and
    thin and high parts above it."""
    columns = np.flatnonzero(component.sum(0) >= MIN_EXTENT_SHARE * component.sum(0).max())
    rows = np.flatnonzero(component.any(1)).tolist()
    top, bottom = rows[0], rows[-1]
    widths = component[:, columns].sum(1)
    wide = int(np.argmax(widths >= MIN_EXTENT_SHARE * widths.max()))
    if FINE_GRID.y[top] - FINE_GRID.y[wide] > MAX_PROTRUSION_M:
        top = wide
    x, y = FINE_GRID.x, FINE_GRID.y
    return (float(x[columns[0]]), float(x[columns[-1]])), (float(y[bottom]), float(y[top]))


def noise_std(image: Image, background: Image) -> float:
    """The standard deviation of an image's noise, grey levels, from its difference to the background in some rows."""
    differences = np.abs(np.diff((image[::NOISE_ROW_STEP] - background[::NOISE_ROW_STEP]), axis=1))
    return float(1.4826 * np.median(differences) / np.sqrt(2.0))


@dataclass(frozen=True, eq=False)
class _VehicleMask:
    """The region of the left image (H, W: not 0) that a detected vehicle covers: its whole ``body`` for planes that are
    ``near`` it (planes,), only its ``face`` for those behind it, because what is seen over its roof there is another
    vehicle."""

    body: Bytes
    face: Bytes
    near: NDArray[np.bool_]

    def at(self, index: int) -> Bytes:
        return self.body if self.near[index] else self.face


def _vehicle_mask(
    detection: Detection, points: Array, shape: tuple[int, ...], top: int, max_height: float
) -> _VehicleMask:
    """The mask of a ``detection`` for planes at ``points`` (planes, 3), in an image that begins at row ``top``; the
    tallest vehicles have ``max_height`` m."""
    lane, s = detection.lane, detection.s
    is_tall = detection.y[1] > MIN_LONG_VEHICLE_HEIGHT_M
    high, length = (max_height, LORRY_LENGTH_M) if is_tall else (detection.y[1] + 0.2, CAR_LENGTH_M)
    x = (detection.x[0] - 0.2, detection.x[1] + 0.2)
    if abs(detection.lateral_offset) < LANE_CORE_M:  # a lane holds one vehicle across, of which parts may be missing
        x = min(x[0], -BUS_HALF_WIDTH_M), max(x[1], BUS_HALF_WIDTH_M)
    corners = np.array([[a, b] for a in x for b in (0.0, high)])
    forward = lane.path.frames(np.array(s))[:, 0]
    ahead = np.sign(forward[2]) or 1.0
    before, at_face, behind = (lane.pixels(s + ahead * d, corners)[0] for d in (-FACE_LEAD_M, 0.0, length))
    if lane.path.at(np.array(s - ahead * FACE_LEAD_M))[2] <= 1.0:
        before = at_face
    masks = []
    for hull in ((before, behind), (before, at_face)):
        pixels = np.clip(np.concatenate(hull) - [0, top], -1e4, 1e4).round().astype(np.int32)
        masks.append(np.zeros(shape, np.uint8))
        cv2.fillConvexPoly(masks[-1], cv2.convexHull(pixels), 1)
    distance_behind = ahead * ((points - detection.position) @ forward)
    return _VehicleMask(masks[0], masks[1], distance_behind < LORRY_LENGTH_M + BODY_CLEARANCE_M)
