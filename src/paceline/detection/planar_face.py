"""The planar part of a vehicle's front or rear that is measured: it looks the same in both views and over time.

A number plate, lamps and a bumper lie in one plane and keep their appearance there while the vehicle drives; a
windscreen slopes and reflects the surroundings, a bonnet shifts relative to the bumper as the viewing direction
changes. So the detections of a vehicle are aligned with each other, and the rectangle with the best agreement is
selected.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.detection.detector import FINE_GRID, Detection
from paceline.detection.lane_paths import LanePath, PlaneGrid
from paceline.detection.photo_consistency import MIN_STD_PRODUCT, LocalStatistics, local_ncc, photo_consistency
from paceline.detection.tracks import DetectionTrack
from paceline.speed.geometry.paths import Path
from paceline.subpixel import parabola_peak_at

Span = tuple[float, float]

FACE_GRID = PlaneGrid(left=-2.4, top=1.6, bottom=0.15, cell=0.025)
FACE_NCC_WINDOW = 9  # cells
SEARCH_RANGE_M_PX = 3.0, 1.0  # to either side of a detection along the lane, m, or px of disparity if that is more
SEARCH_STEPS = 25
DISTANCE_PENALTY_NCC = 0.06  # penalty at the ends of that range, for a position other than in the reference frame
# a position with so much of the largest consistent area is preferred if its 1 − NCC is so much smaller
MIN_SHARP_AREA_RATIO, MAX_SHARP_MISFIT_RATIO = 0.5, 0.7
MAX_FACE_SHIFT_M = 0.4  # greatest shift of the face on its plane from one frame to another
HEIGHT_PENALTY_NCC = 0.5  # penalty of the greatest vertical shift, which occurs on planes at a wrong distance
MIN_FACE_TEXTURE_GREY = 1.0  # local standard deviation of texture
UNCHANGED_NCC = 0.85  # NCC with the background above which a cell shows the background
# of the views: a cell beside the detection that differs from the background in fewer belongs to no vehicle
MIN_CHANGED_FRAME_SHARE = 0.3
NCC_THRESHOLDS = 0.78, 0.66, 0.54  # above which a cell counts for the rectangle; the lower ones where noise leaves none
MIN_FACE_WIDTH_M, MIN_FACE_HEIGHT_M = 0.4, 0.3  # of the rectangle
INSET_M = 0.075  # reduction of the rectangle on each side: a local NCC depends on half a window beyond its cell
MIN_WIDTH_RATIO = 0.7  # least ratio of the rectangle's width to the face's
# Greatest width of the rectangle on a car, and on a lorry or bus: a detection taller than `MIN_TALL_VEHICLE_HEIGHT_M`,
# wider than a car, or narrower than `MIN_CAR_WIDTH_M`, as one lamp of a lorry. The limit excludes guard rails, which
# agree in all frames too.
MAX_WIDTHS_M = 1.8, 2.3
MIN_CAR_WIDTH_M = 1.0
MAX_TOPS_M = 1.1, 1.6  # upper edge of the rectangle on a car, and on vehicles taller than `MIN_TALL_VEHICLE_HEIGHT_M`
FIRST_TOP_SHARES = 1.0, 0.57  # of that, up to where detections are aligned first: a bonnet or a windscreen may mislead
MIN_TALL_VEHICLE_HEIGHT_M = 2.2
MAX_FOOT_M = 1.5  # lower edge of a detection that shows a face: the lamps of lorries are so high
CELL_COST = 0.02  # cost of a cell without texture
COARSE_CELLS = 2  # step of the cells on which rectangles are compared
# of a detection's area to the usual one: outside, part of the vehicle is hidden or something else was detected with it,
# and the detection cannot be the reference
TYPICAL_AREA_RATIO = 0.7, 1.5
MIN_TEMPLATE_NCC = 0.55  # least NCC of a frame with the reference


@dataclass(frozen=True, eq=False)
class AlignedDetection:
    """A detection whose face was found at arc length ``s``, with the reference's origin at ``origin`` (2,) m on the
    plane; ``score`` is the mean NCC of both views with the reference."""

    detection: Detection
    s: float
    origin: Array
    score: float

    def arc_length_on(self, path: Path) -> float:
        """The arc length of the face on ``path``, m."""
        return path.nearest(self.detection.lane.point(self.s, self.detection.lateral_offset, 0.0))

    def origin_on(self, lane: LanePath) -> Array:
        """Its origin (2,) on the planes of another ``lane``."""
        if lane is self.detection.lane:
            return self.origin
        _, x, y = lane.plane_coordinates(self.detection.lane.point(self.s, *self.origin))
        return np.array([x, y])

    def warp(self) -> tuple[Image, Image]:
        """Both views on the plane, with the reference's origin."""
        return self.detection.warp(self.s, FACE_GRID, self.origin)

    def warp_background(self) -> tuple[Image, Image]:
        """As `warp`, of the background."""
        return self.detection.warp_background(self.s, FACE_GRID, self.origin)


@dataclass(frozen=True, eq=False)
class PlanarFace:
    """The rectangle to track: ``x`` and ``y``, (2,) m each, from the reference's origin; ``aligned`` are the detections
    that show it, ``score`` is the sum of its cells' scores at the lowest NCC threshold."""

    x: Span
    y: Span
    aligned: list[AlignedDetection]
    score: float

    def corners(self, aligned: AlignedDetection) -> Array:
        """Plane coordinates (4, 2) of its corners in a frame: top left, top right, bottom right, bottom left."""
        (x0, x1), (y0, y1) = self.x, self.y
        return np.array([[x0, y1], [x1, y1], [x1, y0], [x0, y0]]) + aligned.origin


def find_face(detections: list[Detection]) -> PlanarFace | None:
    """The rectangle on a vehicle's face in which its ``detections`` agree; None where they agree in none."""
    if not detections:
        return None
    complete = [detection for detection in detections if _is_whole(detection)] or detections
    areas = [detection.area for detection in complete]
    typical_area = float(np.quantile(areas, 0.5, method="higher"))  # the area of one of them
    typical = (
        s for s in complete if TYPICAL_AREA_RATIO[0] * typical_area <= s.area <= TYPICAL_AREA_RATIO[1] * typical_area
    )
    reference = max(typical, key=_pixels_per_metre)
    half = float(np.clip(0.5 * (reference.x[1] - reference.x[0]), FACE_GRID.cell, -FACE_GRID.left))
    top = MAX_TOPS_M[reference.y[1] > MIN_TALL_VEHICLE_HEIGHT_M]
    faces = [
        _face_within((-half, half), (FACE_GRID.bottom, share * top), detections, reference)
        for share in FIRST_TOP_SHARES
    ]
    valid_faces = [face for face in faces if face is not None]
    return max(valid_faces, key=lambda face: face.score * len(face.aligned), default=None)


def _face_within(x: Span, y: Span, detections: list[Detection], reference: Detection) -> PlanarFace | None:
    """The rectangle in which all ``detections`` agree if they are aligned first by the part of the ``reference``
    between ``x`` and ``y``, and then by that rectangle."""
    face: PlanarFace | None = None
    for _ in range(2):
        aligned = _align(detections, reference, x, y)
        if len(aligned) < 2:
            return None
        face = _best_face(aligned, reference)
        if face is None:
            return None
        x, y = face.x, face.y
    return face


def with_visible_face(track: DetectionTrack) -> list[Detection]:
    """The detections that reach down to a face: one that begins higher is a roof behind another vehicle, or none."""
    return [detection for detection in track.kept if detection.y[0] < MAX_FOOT_M]


def nearer_half(detections: list[Detection]) -> list[Detection]:
    """The half of ``detections`` in which the vehicle is larger."""
    median_scale = np.median([_pixels_per_metre(detection) for detection in detections])
    return [detection for detection in detections if _pixels_per_metre(detection) >= median_scale]


def face_positions(aligned: list[AlignedDetection]) -> tuple[Array, Array]:
    """The times, s, and the arc lengths on the lane of the first, m, of the face in the frames ``aligned``: (N,)
    each."""
    path = aligned[0].detection.lane.path
    return np.array([a.detection.time for a in aligned]), np.array([a.arc_length_on(path) for a in aligned])


def similarity(face: PlanarFace, aligned: list[AlignedDetection]) -> Array:
    """How much each of the frames ``aligned`` (N,) looks like most of them inside ``face``: the NCC with their median
    image, in the view in which it is lower."""
    rows, columns = _grid_window(face.x, face.y)
    images = np.array([[image[rows, columns] for image in detection.warp()] for detection in aligned], float)
    images -= images.mean((2, 3), keepdims=True)
    images /= np.maximum(images.std((2, 3), keepdims=True), 1e-6)
    median_image = np.median(images, axis=(0, 1))
    return np.asarray((images * median_image).mean((2, 3)).min(1) / max(float(median_image.std()), 1e-6))


def _is_whole(detection: Detection) -> bool:
    """Whether a face is cut off neither by its plane nor by an image: beyond its edge an image is repeated in both
    views."""
    (left, right), (bottom, top) = detection.x, detection.y
    if min(left - FINE_GRID.left, -FINE_GRID.left - right) <= 0.5 * FINE_GRID.cell:
        return False
    highest = min(top, MAX_TOPS_M[top > MIN_TALL_VEHICLE_HEIGHT_M])
    corners = np.array([[x, y] for x in (left, right) for y in (bottom, highest)])
    views = zip(detection.lane.pixels(detection.s, corners), detection.lane.rig.cameras, strict=True)
    return all(((quad >= 0) & (quad <= np.array(camera.image_size) - 1)).all() for quad, camera in views)


def _pixels_per_metre(detection: Detection) -> float:
    left = detection.lane.pixels(detection.s, detection.lateral_offset + np.array([[-0.5, 0.5], [0.5, 0.5]]))[0]
    return float(np.linalg.norm(left[1] - left[0]))


def _grid_window(x: Span, y: Span) -> tuple[slice, slice]:
    """Rows and columns of the face grid within a rectangle."""
    columns, rows = (
        np.flatnonzero((FACE_GRID.x >= x[0]) & (FACE_GRID.x <= x[1])),
        np.flatnonzero((FACE_GRID.y >= y[0]) & (FACE_GRID.y <= y[1])),
    )
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _align(detections: list[Detection], reference: Detection, x: Span, y: Span) -> list[AlignedDetection]:
    """Where each detection shows what the ``reference`` shows inside a rectangle, from one frame to the next."""
    rows, columns = _grid_window(x, y)
    s = _stereo_position(reference, rows, columns)
    if s is None:
        return []
    offset = float(np.clip(s - reference.s, -SEARCH_RANGE_M_PX[0], SEARCH_RANGE_M_PX[0]))
    first = AlignedDetection(reference, s, np.array([reference.lateral_offset, 0.0]), 1.0)
    template = first.warp()[0][rows, columns]
    start, aligned = detections.index(reference), [first]
    for others in (detections[start + 1 :], detections[:start][::-1]):
        previous = first
        for detection in others:
            candidate = _register(detection, template, rows, columns, previous.origin_on(detection.lane), offset)
            if candidate.score >= MIN_TEMPLATE_NCC:
                aligned.append(candidate)
                previous = candidate
    return sorted(aligned, key=lambda candidate: candidate.detection.frame)


def _stereo_position(detection: Detection, rows: slice, columns: slice) -> float | None:
    """The arc length at which the consistent area of a window of the face is largest; or, of those where it is large,
    the one with a far better NCC, because the wide glow about lamps agrees at any distance. None at an end of the
    search range."""
    origin, reach = np.array([detection.lateral_offset, 0.0]), detection.distance_error(*SEARCH_RANGE_M_PX)
    ahead, scores = np.linspace(-reach, reach, SEARCH_STEPS), []
    for s in detection.s + ahead:
        left, right = (LocalStatistics(image, FACE_NCC_WINDOW) for image in detection.warp(float(s), FACE_GRID, origin))
        area = (photo_consistency(left, right) * _texture_weight(left))[rows, columns].sum()
        scores.append((area, _ncc(left.image[rows, columns], right.image[rows, columns])))
    areas, correlations = np.array(scores, float).T
    best, heights = int(np.argmax(areas)), areas
    candidates = np.where(areas >= MIN_SHARP_AREA_RATIO * areas[best], correlations, -1.0)
    sharp = int(np.argmax(candidates))
    if 1.0 - correlations[sharp] < MAX_SHARP_MISFIT_RATIO * (1.0 - correlations[best]):
        best, heights = sharp, correlations
    if not areas[best] > 0.0 or not 0 < best < SEARCH_STEPS - 1:
        return None
    return float(detection.s + ahead[best] + parabola_peak_at(heights, best) * (ahead[1] - ahead[0]))


def _ncc(left: Image, right: Image) -> float:
    """The NCC of two images (H, W) as a whole; 0 where either has no contrast."""
    a, b = left - left.mean(), right - right.mean()
    contrast = float(np.sqrt((a * a).mean() * (b * b).mean()))
    return float((a * b).mean()) / contrast if contrast > MIN_STD_PRODUCT else 0.0


def _texture_weight(texture: LocalStatistics) -> Image:
    """The weight of each cell, 0 to 1: strong edges count no more than clear ones."""
    return np.asarray(
        np.clip(texture.std / (4 * MIN_FACE_TEXTURE_GREY), 0.0, 1.0) * (texture.std > MIN_FACE_TEXTURE_GREY), np.float32
    )


def _register(
    detection: Detection, template: Image, rows: slice, columns: slice, origin: Array, offset: float
) -> AlignedDetection:
    """Where both views of ``detection`` match the ``template`` best: preferably at the height of ``origin``, which it
    has in a neighbouring frame, and about ``offset`` metres past the detection."""
    along, reach = detection.distance_error(*SEARCH_RANGE_M_PX), round(MAX_FACE_SHIFT_M / FACE_GRID.cell)
    relative_offset, shift_scores, moves = np.linspace(-1.0, 1.0, SEARCH_STEPS), [], []
    ahead = offset + along * relative_offset
    penalty = HEIGHT_PENALTY_NCC * np.linspace(-1.0, 1.0, 2 * reach + 1, dtype=np.float32)[:, None] ** 2
    for s in detection.s + ahead:
        images = detection.warp(float(s), FACE_GRID, origin)
        left, right = (_match_template(image, template, rows, columns, reach) for image in images)
        ncc = 0.5 * (left + right)
        penalised = ncc - penalty
        peak = np.unravel_index(int(np.argmax(penalised)), penalised.shape)
        shift_scores.append((ncc[peak], penalised[peak]))
        moves.append(_subpixel(penalised, peak) - reach)
    scores, preferred = np.array(shift_scores, float).T
    preferred -= DISTANCE_PENALTY_NCC * relative_offset**2
    best = int(np.argmax(preferred))
    s = detection.s + ahead[best] + parabola_peak_at(preferred, best) * (ahead[1] - ahead[0])
    down, across = moves[best]
    shift = np.array([across, -down]) * FACE_GRID.cell
    return AlignedDetection(detection, float(s), origin + shift, float(scores[best]))


def _match_template(image: Image, template: Image, rows: slice, columns: slice, reach: int) -> Image:
    """The NCC of ``template`` with a window of ``image``, shifted by up to ``reach`` cells in both directions."""
    pad = cv2.copyMakeBorder(image, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    window = np.ascontiguousarray(pad[rows.start : rows.stop + 2 * reach, columns.start : columns.stop + 2 * reach])
    scores = cv2.matchTemplate(window, np.ascontiguousarray(template), cv2.TM_CCOEFF_NORMED)
    return np.asarray(np.nan_to_num(scores, nan=-1.0, posinf=-1.0, neginf=-1.0), np.float32)


def _subpixel(scores: Image, peak: tuple[np.intp, ...]) -> Array:
    row, column = int(peak[0]), int(peak[1])
    return np.array(
        [
            row + parabola_peak_at(scores[:, column].astype(float), row),
            column + parabola_peak_at(scores[row].astype(float), column),
        ]
    )


def _best_face(aligned: list[AlignedDetection], reference: Detection) -> PlanarFace | None:
    """The rectangle in which all ``aligned`` detections agree with the reference best."""
    first = next(a for a in aligned if a.detection is reference)
    template = LocalStatistics(first.warp()[0], FACE_NCC_WINDOW)
    correlations, changes = [], []
    for a in aligned:
        views, background = (
            [LocalStatistics(image, FACE_NCC_WINDOW) for image in images] for images in (a.warp(), a.warp_background())
        )
        correlations += [local_ncc(template, view) for view in views[a is first :]]
        changes += [local_ncc(view, empty) <= UNCHANGED_NCC for view, empty in zip(views, background, strict=True)]
    ncc = np.median(correlations, axis=0)  # a shadow that passes over a face is there in few frames
    changed = np.mean(changes, axis=0)
    outside_reference = np.abs(FACE_GRID.x) > 0.5 * (reference.x[1] - reference.x[0])
    ncc[(changed < MIN_CHANGED_FRAME_SHARE) & outside_reference] = (
        0.0  # the background looks the same in all frames as well
    )
    weight = _texture_weight(template)
    highest, widest = MAX_TOPS_M[reference.y[1] > MIN_TALL_VEHICLE_HEIGHT_M], _max_width(reference)
    narrowest = max(MIN_FACE_WIDTH_M, MIN_WIDTH_RATIO * min(reference.x[1] - reference.x[0], widest))
    cell = COARSE_CELLS * FACE_GRID.cell
    widths = round((narrowest + 2 * INSET_M) / cell), round((widest + 2 * INSET_M) / cell)
    height, middle = round((MIN_FACE_HEIGHT_M + 2 * INSET_M) / cell), len(FACE_GRID.x[::COARSE_CELLS]) // 2
    for threshold in NCC_THRESHOLDS:
        scores = _cell_scores(ncc, weight, threshold)
        scores[FACE_GRID.y > highest] = -1.0
        rectangle = best_rectangle(scores[::COARSE_CELLS, ::COARSE_CELLS], height, widths, middle)
        if rectangle is not None:
            break
    else:
        return None
    top, bottom, left, right = (COARSE_CELLS * k for k in rectangle)
    x = FACE_GRID.x[[left, min(right, len(FACE_GRID.x)) - 1]]
    y = FACE_GRID.y[[min(bottom, len(FACE_GRID.y)) - 1, top]]
    part = np.s_[top:bottom, left:right]
    score = float(_cell_scores(ncc[part], weight[part], NCC_THRESHOLDS[-1]).sum())
    return PlanarFace(_inset(x), _inset(y), aligned, score)


def _max_width(reference: Detection) -> float:
    """The greatest width of a rectangle on a vehicle as large as the ``reference``, m."""
    width = reference.x[1] - reference.x[0]
    is_large = reference.y[1] > MIN_TALL_VEHICLE_HEIGHT_M or width < MIN_CAR_WIDTH_M
    return MAX_WIDTHS_M[1] if is_large else float(np.clip(width, *MAX_WIDTHS_M))


def _cell_scores(ncc: Image, weight: Image, threshold: float) -> Array:
    """The contribution of each cell (rows, columns) to the score of a rectangle that holds it; positive above the
    ``threshold`` of the NCC."""
    return np.asarray((np.maximum(ncc, 0.0) - threshold) * weight - CELL_COST, float)


def _inset(span: Array) -> Span:
    return float(span[0]) + INSET_M, float(span[1]) - INSET_M


def best_rectangle(
    scores: Array, height: int, widths: tuple[int, int], column: int
) -> tuple[int, int, int, int] | None:
    """The rectangle of ``scores`` (H, W) with the largest sum, at least ``height`` high and between ``widths`` wide,
    that holds a ``column``: (top, bottom, left, right), the ends excluded; None where no sum is positive."""
    H, W = scores.shape
    narrowest, widest = widths
    sums = np.zeros((H + 1, W + 1))
    sums[1:, 1:] = scores.cumsum(0).cumsum(1)
    best, bounds = 0.0, None
    for top in range(H - height + 1):
        rows = sums[top + height :] - sums[top]  # (bottoms, W + 1): sums from the left
        for width in range(narrowest, min(widest, W) + 1):
            first, last = max(column + 1 - width, 0), min(column, W - width)
            gains = rows[:, first + width : last + width + 1] - rows[:, first : last + 1]
            bottom, left = np.unravel_index(int(np.argmax(gains)), gains.shape)
            if gains[bottom, left] > best:
                best = float(gains[bottom, left])
                bounds = (top, top + height + int(bottom), first + int(left), first + int(left) + width)
    return bounds
