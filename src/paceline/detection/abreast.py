"""Two vehicles abreast in one lane, such as a motorcycle beside a car, of which the detector makes one face.

Far away, their distances differ by less than a pixel of disparity, and on one plane both views agree about either. One
vehicle is no wider than the law allows, and no road is seen through it. So the hypothesis of two is accepted where road
is seen in a gap up to the height of a rider, and both sides, each on its own plane, are together wider than any one:
the side of one vehicle, which is seen at an angle, lies behind the edge of its face.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Image
from paceline.detection.detector import FINE_GRID, FINE_NCC_WINDOW, Detection
from paceline.detection.lane_paths import PlaneGrid
from paceline.detection.photo_consistency import LocalStatistics, local_ncc, photo_consistency, upright_ratio
from paceline.detection.tracks import DetectionTrack
from paceline.subpixel import parabola_peak_at

Span = tuple[float, float]

GAP_GRID = PlaneGrid(left=FINE_GRID.left, top=1.5, bottom=0.4, cell=FINE_GRID.cell)  # m; below are shadows, above none
LEAST_NOISE_GREY = 0.5  # grey levels, of rounding and of the background's own error
MIN_CHANGE_SIGMA = 3.0  # standard deviations of the noise by which a column on a vehicle differs from the road
MIN_GAP_M = 0.1  # columns of the gap that look like road
# share of the columns on either side that look like road: the body of a vehicle as grey as the road shows no gap
MAX_ROAD_SHARE = 0.1
MIN_SIDE_WIDTH_M = 0.4  # of a motorcycle without its handlebars
MAX_VEHICLE_WIDTH_M = 2.6  # greatest width of a vehicle's body: Directive 96/53/EC, annex I, 1.2
WIDTH_ERROR_M = 0.2  # two standard deviations of a width of two sides on their own planes
MIN_GAP_DETECTIONS, MIN_GAP_SHARE = 3, 0.4  # of the detections, that show a gap where there are two vehicles
MIN_DOUBTFUL_GAPS = 2  # detections with a gap from which on there may be two: one shows a gap by chance
MIN_SIDE_TEXTURE_GREY = 3.0  # least local standard deviation: paint that is nearly even agrees on many planes
SIDE_RANGE_M_PX, SIDE_STEPS = (4.0, 1.0), 33  # to either side of a detection along the lane, as it may be between


@dataclass(frozen=True)
class Gap:
    """The gap of a detection: what is to the ``left`` and to the ``right`` of it, each (2,) m across on its plane."""

    left: Span
    right: Span


def separated(track: DetectionTrack) -> list[DetectionTrack]:
    """The tracks of two vehicles that are abreast in a ``track``, from the left to the right; else that alone, of which
    `DetectionTrack.may_be_two` says whether some of its detections are as wide as two, with a gap."""
    if not track.first.is_road_known:
        return [track]
    gaps = {k: gap for k, detection in enumerate(track.kept) if (gap := gap_of(detection)) is not None}
    widths = [width for k, gap in gaps.items() if (width := _joint_width(track.kept[k], gap)) is not None]
    if len(widths) < MIN_DOUBTFUL_GAPS or float(np.median(widths)) < MAX_VEHICLE_WIDTH_M + WIDTH_ERROR_M:
        return [track]
    if len(gaps) < MIN_GAP_SHARE * len(track.kept) or len(widths) < MIN_GAP_DETECTIONS:
        track.may_be_two = True
        return [track]
    tracks = [DetectionTrack(), DetectionTrack()]
    for k, detection in enumerate(track.kept):
        gap = gaps[min(gaps, key=lambda c: abs(c - k))]
        for result, x in zip(tracks, (gap.left, gap.right), strict=True):
            if (own := on_own_plane(detection, x)) is not None:
                result.add(own)
    tracks[0].beside, tracks[1].beside = tracks[1], tracks[0]
    return tracks


def _joint_width(detection: Detection, gap: Gap) -> float | None:
    """The width (m) of both sides of a ``gap`` together, each on its own plane; None where one has none."""
    left, right = (on_own_plane(detection, x) for x in (gap.left, gap.right))
    return None if left is None or right is None else right.x[1] - left.x[0]


def gap_of(detection: Detection) -> Gap | None:
    """The gap through which a ``detection`` shows road in both views; None where there is none, or less than a
    motorcycle to one side of it."""
    origin, x = np.zeros(2), GAP_GRID.x
    views, scenes = (warp(detection.s, GAP_GRID, origin) for warp in (detection.warp, detection.warp_background))
    changes = [np.abs(np.median(view - scene, axis=0)) for view, scene in zip(views, scenes, strict=True)]
    least = MIN_CHANGE_SIGMA * max(detection.noise, LEAST_NOISE_GREY)
    inside = (x >= detection.x[0]) & (x <= detection.x[1])
    on_vehicle = np.flatnonzero((np.max(changes, axis=0) > least) & inside)
    if len(on_vehicle) < 2:
        return None
    before = int(np.argmax(np.diff(on_vehicle)))  # the last column before the widest gap
    left, right = on_vehicle[: before + 1], on_vehicle[before + 1 :]
    sides = [(float(x[columns[0]]), float(x[columns[-1]])) for columns in (left, right)]
    wide = all(high - low >= MIN_SIDE_WIDTH_M for low, high in sides)
    dense = all(len(columns) >= (1 - MAX_ROAD_SHARE) * (np.ptp(columns) + 1) for columns in (left, right))
    return Gap(*sides) if wide and dense and sides[1][0] - sides[0][1] > MIN_GAP_M else None


def on_own_plane(detection: Detection, x: Span) -> Detection | None:
    """What a ``detection`` shows between ``x`` m across, on the plane on which its consistent area is largest; None at
    an end of the range of planes."""
    reach = detection.distance_error(*SIDE_RANGE_M_PX)
    ahead = np.linspace(-reach, reach, SIDE_STEPS)
    matches = [_Match.of(detection, float(s), _moved(detection, float(s), x)) for s in detection.s + ahead]
    areas = [match.area for match in matches]
    best = int(np.argmax(areas))
    if not 0 < best < SIDE_STEPS - 1 or not areas[best] > 0.0:
        return None
    s = float(matches[best].s + parabola_peak_at(np.array(areas), best) * (ahead[1] - ahead[0]))
    ratio = matches[best].upright_ratio(detection)
    return replace(detection, s=s, x=_moved(detection, s, x), area=areas[best], upright_ratio=ratio)


def _moved(detection: Detection, s: float, x: Span) -> Span:
    """Where the columns ``x`` m of the left view of a ``detection`` are on the plane at ``s``."""
    height = 0.5 * (GAP_GRID.bottom + GAP_GRID.top)
    to_other = np.linalg.solve(detection.lane.homographies(s)[0], detection.lane.homographies(detection.s)[0])
    points = np.array([[across, height, 1.0] for across in x]) @ to_other.T
    return float(points[0, 0] / points[0, 2]), float(points[1, 0] / points[1, 2])


@dataclass(frozen=True, eq=False)
class _Match:
    """The views of a detection compared between two columns on the plane at ``s``: the ``left`` one, the
    ``consistency`` of each cell, 0 to 1, and the ``area`` (m²) that is consistent and not even paint."""

    s: float
    left: LocalStatistics
    consistency: Image
    area: float

    @staticmethod
    def of(detection: Detection, s: float, x: Span) -> _Match:
        """The match of what is between ``x`` m."""
        left, right = (LocalStatistics(view, FINE_NCC_WINDOW) for view in detection.warp(s, GAP_GRID, np.zeros(2)))
        consistency = photo_consistency(left, right) * ((GAP_GRID.x >= x[0]) & (GAP_GRID.x <= x[1]))
        textured = np.minimum(left.std, right.std) > MIN_SIDE_TEXTURE_GREY
        return _Match(s, left, consistency, float((consistency * textured).sum()) * GAP_GRID.cell**2)

    def upright_ratio(self, detection: Detection) -> float:
        """As `Detection.upright_ratio`, of what was compared."""
        on_road = LocalStatistics(detection.warp_on_road(self.s, GAP_GRID, np.zeros(2)), FINE_NCC_WINDOW)
        return float(upright_ratio(self.consistency, local_ncc(self.left, on_road), self.left.std))
