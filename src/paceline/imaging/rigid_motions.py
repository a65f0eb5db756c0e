"""How far what moves has moved in space from each frame to the next: displacements of groups of points that move alike.

Features of the moving parts of both views are matched between the views and over time. Points that move alike,
as those of a vehicle do, are one group, which its points carry on from frame to frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Indices, Mask, to_8_bit
from paceline.cameras import StereoRig
from paceline.geometry import triangulate
from paceline.imaging.camera_rotation import TRACKING_PRECISION_PX
from paceline.imaging.moving_features import MAX_RATIO, WINDOW_FRAMES, MovingFeatures
from paceline.imaging.point_tracking import track_forth_and_back
from paceline.imaging.robust_weights import tukey_weights
from paceline.recordings.stereo import StereoFrame
from paceline.sift_features import Descriptors, match_descriptors

MIN_GROUP_POINTS = 5  # that move alike
MIN_CARRIED_POINTS = 3  # of these that were in the group before
MIN_GROUP_SHARE = 0.5  # of the points of a group that are found again
MIN_GROUP_DISPLACEMENT_PX = 0.4  # by which a group moves in its first interval
MATCH_STD_PX = 0.15  # of a point's place in the next frame, and of its disparity
FEATURE_STD_PX = 1.0  # of its place there where only features tell it
DISTORTION_STD = 0.02  # of its place there as a share of its displacement: it looks different from nearer
COMMON_STD_PX = 0.04  # of what all points of a group share of these
MAX_DISPLACEMENT_SIGMA = 4.0  # of a point's displacement from its group's
MAX_TRACK_RETURN_PX = 0.3  # by which a point fails to come back
MAX_TRACK_CORRECTION_PX = 2.0  # by which Lucas–Kanade corrects a match of features
MAX_DEPTH_M = 200.0
MAX_CANDIDATES = 64  # points whose displacement is tried as the group's
CONSENSUS_STEPS = 5


@dataclass(frozen=True, eq=False)
class Displacement:
    """The displacement ``vector`` (3,) m of a ``group`` over an interval, with its ``covariance`` (3, 3) m²."""

    group: int
    vector: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Interval:
    """From one frame to the next: their indices, the ``duration`` (s) by their times, and what moves in it how far."""

    first: int
    second: int
    duration: float
    displacements: list[Displacement]


@dataclass(frozen=True, eq=False)
class _Points:
    """Points of a frame seen by both cameras: pixels (N, 2) in each, places (N, 3) m, descriptors (N, 128)."""

    left: Array
    right: Array
    places: Array
    descriptors: Descriptors


@dataclass(frozen=True, eq=False)
class _Links:
    """Points of a frame that are found in the next: rows ``i`` there and ``j`` here, displacements (M, 3) m of the
    places, their covariances (M, 3, 3) and the displacements (M, 2) px in the left view."""

    i: Indices
    j: Indices
    vectors: Array
    covariances: Array
    pixels: Array


def rigid_motions(rig: StereoRig, features: Iterable[tuple[StereoFrame, MovingFeatures]]) -> Iterator[Interval]:
    """Every interval between successive frames, with the displacements of the groups of points that move in it, by the
    ``features`` of each.

    A group that begins to move is followed back over up to `WINDOW_FRAMES` intervals in which it does not: an interval
    is given when those after it have been looked at.
    """
    groups = _Groups()
    previous: tuple[StereoFrame, _Points] | None = None
    for frame, moving in features:
        points = _points(rig, moving)
        if previous is not None:
            earlier, earlier_points = previous
            links = _link(rig, earlier, frame, earlier_points, points)
            groups.add(links, len(points.left))
            groups.durations.append((earlier.index, frame.index, frame.time - earlier.time))
            yield from groups.finished(WINDOW_FRAMES)
        previous = frame, points
    yield from groups.finished(0)


class _Groups:
    """The groups of the latest frame, and the displacements of the latest intervals."""

    def __init__(self) -> None:
        self.durations: deque[tuple[int, int, float]] = deque()
        self._displacements: deque[list[Displacement]] = deque()
        self._links: deque[_Links] = deque(maxlen=WINDOW_FRAMES + 1)
        self._members = np.zeros(0, np.int64)  # group of each point of the latest frame, −1 where it has none
        self._count = 0

    def finished(self, delay: int) -> Iterator[Interval]:
        """The intervals that are ``delay`` intervals old."""
        while len(self.durations) > delay:
            yield Interval(*self.durations.popleft(), self._displacements.popleft())

    def add(self, links: _Links, count: int) -> None:
        """Carries the groups on over ``links`` to the next frame's ``count`` points, and begins new ones."""
        self._links.append(links)
        current: list[Displacement] = []
        self._displacements.append(current)
        carried = self._members[links.i] if len(self._members) else np.full(len(links.i), -1)
        of_link = np.full(len(links.i), -1)
        for group in np.unique(carried[carried >= 0]).tolist():
            rows = np.flatnonzero(carried == group)
            if (found := _consensus(links, rows, MIN_CARRIED_POINTS)) is not None:
                vector, covariance, inliers = found
                joining = np.flatnonzero((carried < 0) & (of_link < 0))
                joining = joining[_is_near(links, joining, vector)]
                rows = np.concatenate([rows[inliers], joining])
                if (found := _consensus(links, rows)) is not None:
                    vector, covariance, inliers = found
                    of_link[rows[inliers]] = group
                    current.append(Displacement(group, vector, covariance))
        while found := _consensus(links, rows := np.flatnonzero(_moves(links) & (carried < 0) & (of_link < 0))):
            vector, covariance, inliers = found
            of_link[rows[inliers]] = self._count
            current.append(Displacement(self._count, vector, covariance))
            self._trace_back(links.i[rows[inliers]], self._count)
            self._count += 1
        self._members = np.full(count, -1)
        self._members[links.j] = of_link

    def _trace_back(self, points: Indices, group: int) -> None:
        """Adds the displacements of a new ``group`` of ``points`` in the intervals before in which they stand still."""
        for links, displacements in zip(list(self._links)[-2::-1], list(self._displacements)[-2::-1], strict=False):
            rows = np.flatnonzero(np.isin(links.j, points))
            if len(rows) < MIN_GROUP_SHARE * len(points) or (found := _consensus(links, rows)) is None:
                return
            vector, covariance, inliers = found
            displacements.append(Displacement(group, vector, covariance))
            points = links.i[rows[inliers]]


def _moves(links: _Links) -> Mask:
    return np.asarray(np.linalg.norm(links.pixels, axis=1) > MIN_GROUP_DISPLACEMENT_PX)


def _consensus(links: _Links, rows: Indices, least: int = MIN_GROUP_POINTS) -> tuple[Array, Array, Mask] | None:
    """The displacement (3,) of most of the links ``rows``, its covariance (3, 3), and which of them move so; None where
    too few do."""
    if len(rows) < least:
        return None
    vectors, information = links.vectors[rows], np.linalg.inv(links.covariances[rows])
    candidates = vectors[:: -(-len(rows) // MAX_CANDIDATES)]
    between = candidates[:, None] - vectors[None]
    sigma = np.sqrt(np.einsum("abi,bij,abj->ab", between, information, between))
    vector = candidates[np.argmax((sigma < MAX_DISPLACEMENT_SIGMA).sum(1))]
    for _ in range(CONSENSUS_STEPS):
        residual = vectors - vector
        sigma = np.sqrt(np.einsum("ni,nij,nj->n", residual, information, residual))
        weights = tukey_weights(sigma, 1.0)
        inliers = weights > 0
        if inliers.sum() < least:
            return None
        A = np.einsum("n,nij->ij", weights, information)
        vector = np.linalg.solve(A, np.einsum("n,nij,nj->i", weights, information, vectors))
    if inliers.mean() < MIN_GROUP_SHARE:
        return None
    scatter = max(1.0, float((weights * sigma**2).sum() / (3 * weights.sum())))
    common = (COMMON_STD_PX / MATCH_STD_PX) ** 2 * np.mean(links.covariances[rows[inliers]], axis=0)
    return vector, np.linalg.inv(A) * scatter + common, np.asarray(inliers)


def _is_near(links: _Links, rows: Indices, vector: Array) -> Mask:
    """Which of the links ``rows`` move by ``vector`` (3,) m as well."""
    residual = links.vectors[rows] - vector
    information = np.linalg.inv(links.covariances[rows]) if len(rows) else np.zeros((0, 3, 3))
    inliers = np.einsum("ni,nij,nj->n", residual, information, residual) < MAX_DISPLACEMENT_SIGMA**2
    return np.asarray(inliers & _moves(links)[rows])


def _points(rig: StereoRig, features: MovingFeatures) -> _Points:
    (left, descriptors), rows, right = features.left, features.matched, features.places
    places = triangulate(rig, left[rows], right) if len(rows) else np.zeros((0, 3))
    near = (places[:, 2] > 0) & (places[:, 2] < MAX_DEPTH_M)
    return _Points(left[rows][near], right[near], places[near], descriptors[rows[near]])


def _link(rig: StereoRig, earlier: StereoFrame, later: StereoFrame, a: _Points, b: _Points) -> _Links:
    """The points ``a`` of the ``earlier`` frame that are found among ``b`` of the ``later`` one."""
    i, j = match_descriptors(a.descriptors, b.descriptors, MAX_RATIO)
    pictures = to_8_bit(earlier.left), to_8_bit(later.left)
    tracked, found = track_forth_and_back(
        *pictures, a.left[i], b.left[j], 0, TRACKING_PRECISION_PX, MAX_TRACK_RETURN_PX
    )
    found &= np.linalg.norm(tracked - b.left[j], axis=1) < MAX_TRACK_CORRECTION_PX
    if not len(i):
        none = np.zeros(0, np.int64)
        return _Links(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 2)))
    # what has come much nearer cannot be tracked: there the features' own places count
    tracked = np.where(found[:, None], tracked, b.left[j])
    places = triangulate(rig, tracked, b.right[j] + tracked - b.left[j])
    pixels = tracked - a.left[i]
    place_std = np.where(found, MATCH_STD_PX, FEATURE_STD_PX)
    covariances = displacement_covariance(rig, a.places[i], places, pixels, place_std)
    return _Links(i, j, places - a.places[i], covariances, pixels)


def displacement_covariance(
    rig: StereoRig, places: Array, later: Array, pixels: Array, place_std: Array | float = MATCH_STD_PX
) -> Array:
    """Covariance (N, 3, 3) m² of displacements from ``places`` (N, 3) to ``later`` (N, 3), by ``pixels`` (N, 2) in the
    left view, the latter there to ``place_std`` (N,) px: by disparities along the rays, by places in that view across
    them."""
    focal = rig.left.K[0, 0]
    ray = later / np.linalg.norm(later, axis=1, keepdims=True)
    along = np.einsum("ni,nj->nij", ray, ray)
    by_disparity = (places[:, 2] ** 4 + later[:, 2] ** 4) * (MATCH_STD_PX / (focal * rig.baseline)) ** 2
    place_variance = np.square(place_std) + DISTORTION_STD**2 * (pixels**2).sum(1)
    by_place = place_variance * (later[:, 2] / focal) ** 2
    return np.asarray(by_disparity[:, None, None] * along + by_place[:, None, None] * (np.eye(3) - along))
