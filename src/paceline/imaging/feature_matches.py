"""Matches between the two views, of points that move, with their velocities, and of points that do not.

Features (SIFT) of the moving parts of the picture are matched over time and between the views; those of the rest
between the views only. The places in the right view are refined to sub-pixels by Lucas–Kanade.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Indices, Mask, to_8_bit
from paceline.cameras import StereoRig
from paceline.geometry import epipolar_distance
from paceline.imaging.point_tracking import track_forth_and_back
from paceline.recordings.stereo import StereoFrame, StereoRecording
from paceline.sift_features import Descriptors, detect_features, match_descriptors

MAX_SECONDS = 60.0  # of a recording that are looked at
MAX_INSTANTS = 16  # instants of these at which moving features are matched
VELOCITY_STEP_S = 0.1  # least time between two frames from which a velocity is taken
PICTURE_REDUCTION = 2  # by which pictures are reduced where no sub-pixel place is asked for
MOTION_BLUR_PX = 2.0  # smoothing of differences between frames, in reduced pixels
MOTION_SIGMA = 6.0  # difference that counts as motion, in standard deviations of the noise …
MIN_MOTION_GREY = 3.0  # … and at least in grey levels
NOISE_STEP_PX = 4  # distance between the pixels from which the noise is estimated
MARGIN_PX = 6  # around what moves, in reduced pixels
MAX_REGIONS = 12  # moving regions of a picture, the largest
MIN_MOVING_AREA_PX = 400  # least area of one with its margin, in reduced pixels
MAX_EPIPOLAR_PX = 8.0  # of a match: the calibration's error and the offset together
FEATURE_CONTRAST = 0.02  # of features, half of OpenCV's: far vehicles are small and faint
MAX_RATIO = 0.85  # Lowe's ratio of the best match's distance to that of the second best
MAX_REFINEMENT_PX, MAX_MATCH_RETURN_PX = 2.0, 0.15  # by which a match is refined; by which it fails to come back
REFINEMENT_PRECISION_PX = 0.005
MAX_ACCELERATION_SHARE = 0.5  # difference between a point's displacements before and after over their sum
MIN_DISPLACEMENT_PX = 1.0


@dataclass(frozen=True, eq=False)
class Matches:
    """Points ``left`` and ``right`` (N, 2) px that match, the left ones' ``velocity`` (N, 2) px/s, and the ``growth``
    (N,) 1/s of their pictures as they come nearer: their speed over their depth."""

    left: Array
    right: Array
    velocity: Array
    growth: Array

    def later(self, dt: float) -> Matches:
        """The same with the left points as they are ``dt`` s later, by constant velocities in space."""
        nearer = 1.0 / (1.0 - dt * self.growth)
        left = self.left + dt * nearer[:, None] * self.velocity
        return Matches(left, self.right, nearer[:, None] ** 2 * self.velocity, nearer * self.growth)


NO_MATCHES = Matches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def match_views(recording: StereoRecording) -> tuple[Matches, Matches]:
    """The matches of static and of moving points of the beginning of ``recording``."""
    rig, detector = recording.rig, cv2.SIFT.create(contrastThreshold=FEATURE_CONTRAST)
    moving: list[Matches] = [NO_MATCHES]
    static: Matches | None = None
    for before, frame, after in _instants(recording):
        regions = [_moving(a, b, c) for a, b, c in zip(views(before), views(frame), views(after), strict=True)]
        if static is None:
            static = _match_static(detector, rig, frame, [~_grown(r) for r in regions])
        moving.append(_match_moving(detector, rig, (before, frame, after), regions))
    values = (np.concatenate([getattr(m, f.name) for m in moving]) for f in fields(Matches))
    return static or NO_MATCHES, Matches(*values)


@dataclass(frozen=True, eq=False)
class MovingFeatures:
    """Features of what moves at a ``time`` (s) in the ``left`` and the ``right`` view: places (N, 2) px and descriptors
    (N, 128) of each."""

    time: float
    left: tuple[Array, Descriptors]
    right: tuple[Array, Descriptors]


def moving_features(detector: cv2.SIFT, recording: StereoRecording, count: int) -> list[MovingFeatures]:
    """The features of up to ``count`` instants of the beginning of ``recording`` at which something moves."""
    found: list[MovingFeatures] = []
    for number, (before, frame, after) in enumerate(_triples(recording)):
        if number % velocity_step(recording):
            continue
        triples = zip(views(before), views(frame), views(after), strict=True)
        left, right = (masked_features(detector, b, _moving(a, b, c)[1]) for a, b, c in triples)
        if len(left[0]) or len(right[0]):
            found.append(MovingFeatures(frame.time, left, right))
        if len(found) == count:
            break
    return found


def left_motion(before: MovingFeatures, f: MovingFeatures, after: MovingFeatures) -> tuple[Indices, Array, Array]:
    """Which left features of ``f`` are found ``before`` and ``after`` (n,), their velocities (n, 2) px/s and growths
    (n,) 1/s."""
    left, described = f.left
    places = []
    for other in (before, after):
        i, j = match_descriptors(described, other.left[1], MAX_RATIO)
        place = np.full_like(left, np.nan)
        place[i] = other.left[0][j]
        places.append(place)
    behind, ahead = left - places[0], places[1] - left
    rows = np.flatnonzero(_is_steady(behind, ahead))
    return rows, *velocity_and_growth(behind[rows], ahead[rows], 0.5 * (after.time - before.time))


def _is_steady(behind: Array, ahead: Array) -> Mask:
    """Which points (N,), that move by ``behind`` and ``ahead`` (N, 2) px, move on, and much alike before and after."""
    shorter = np.minimum(np.linalg.norm(behind, axis=1), np.linalg.norm(ahead, axis=1))
    total = np.linalg.norm(ahead + behind, axis=1)
    is_uniform = np.linalg.norm(ahead - behind, axis=1) < MAX_ACCELERATION_SHARE * total
    return np.asarray(is_uniform & (shorter > MIN_DISPLACEMENT_PX))


def velocity_step(recording: StereoRecording) -> int:
    """Frames from one to the other of those from which a velocity is taken."""
    return max(1, round(VELOCITY_STEP_S / recording.pairing.interval))


def _instants(recording: StereoRecording) -> Iterator[tuple[StereoFrame, StereoFrame, StereoFrame]]:
    """Triples of frames, evenly spread over the beginning of ``recording`` and evenly spaced in time."""
    stride = max(1, (_looked_at(recording) - 2 * velocity_step(recording)) // MAX_INSTANTS)
    return islice(_triples(recording), 0, None, stride)


def _triples(recording: StereoRecording) -> Iterator[tuple[StereoFrame, StereoFrame, StereoFrame]]:
    """Each frame of the beginning of ``recording`` with those from which its velocities are taken."""
    step = velocity_step(recording)
    window: deque[StereoFrame] = deque(maxlen=2 * step + 1)
    for frame in islice(recording.frames(), _looked_at(recording)):
        window.append(frame)
        if len(window) == 2 * step + 1:
            yield window[0], window[step], window[2 * step]


def _looked_at(recording: StereoRecording) -> int:
    return min(len(recording), int(MAX_SECONDS / recording.pairing.interval))


def views(frame: StereoFrame) -> tuple[Image, Image]:
    return frame.left, frame.right


def _moving(before: Image, image: Image, after: Image) -> tuple[Mask, Mask, Mask]:
    """Where something moves in three images of one view, each (H, W), reduced."""
    first, middle, last = (_reduced(i) for i in (before, image, after))
    earlier, later = _difference(middle, first), _difference(middle, last)
    return _exceeds_noise(earlier), _exceeds_noise(np.minimum(earlier, later)), _exceeds_noise(later)


def motion_mask(image: Image, other: Image) -> Mask:
    """Where something moves between two images (H, W) of one view, reduced."""
    return _exceeds_noise(_difference(_reduced(image), _reduced(other)))


def _difference(image: Image, other: Image) -> Image:
    return np.asarray(np.abs(cv2.GaussianBlur(image - other, (0, 0), MOTION_BLUR_PX)))


def _exceeds_noise(difference: Image) -> Mask:
    noise = float(np.median(difference[::NOISE_STEP_PX, ::NOISE_STEP_PX])) / 0.6745
    moving = (difference > max(MOTION_SIGMA * noise, MIN_MOTION_GREY)).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(moving, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0)


def _reduced(image: Image) -> Image:
    size = (image.shape[1] // PICTURE_REDUCTION, image.shape[0] // PICTURE_REDUCTION)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _grown(masks: tuple[Mask, Mask, Mask]) -> Mask:
    """The union of ``masks``, with a margin."""
    return np.asarray(_with_margin(masks[0] | masks[1] | masks[2]) > 0)


def _with_margin(mask: Mask) -> NDArray[np.uint8]:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)))


def _match_moving(
    detector: cv2.SIFT,
    rig: StereoRig,
    frames: tuple[StereoFrame, StereoFrame, StereoFrame],
    regions: list[tuple[Mask, Mask, Mask]],
) -> Matches:
    """Matches of the middle one of three ``frames``, with the velocities by the frames before and after: the left
    points as they are when, by its time stamp, the right picture is exposed."""
    before, frame, after = frames
    left, descriptors = masked_features(detector, frame.left, regions[0][1])
    right, described = masked_features(detector, frame.right, regions[1][1])
    pairs = _match_views(rig, frame, (left, descriptors), (right, described))
    places = []
    for other, mask in ((before, regions[0][0]), (after, regions[0][2])):
        found, described = masked_features(detector, other.left, mask)
        i, j = match_descriptors(descriptors, described, MAX_RATIO)
        place = np.full_like(left, np.nan)
        place[i] = found[j]
        places.append(place)
    rows = (left[:, None] == pairs.left[None]).all(-1).argmax(0) if len(left) else np.zeros(0, np.int64)
    behind, ahead = left[rows] - places[0][rows], places[1][rows] - left[rows]
    steady = _is_steady(behind, ahead)
    dt = 0.5 * (after.time - before.time)
    motion = velocity_and_growth(behind[steady], ahead[steady], dt)
    return Matches(pairs.left[steady], pairs.right[steady], *motion).later(frame.skew)


def velocity_and_growth(behind: Array, ahead: Array, dt: float) -> tuple[Array, Array]:
    """The velocities (N, 2) px/s and growths (N,) 1/s of points that move by ``behind`` and ``ahead`` (N, 2) px in the
    ``dt`` s before and after.

    At a constant velocity in space a point is at x + v t / (1 − g t), with g its growth.
    """
    total = ahead + behind
    growing = ((ahead - behind) * total).sum(1) / (total**2).sum(1)  # g dt
    return 0.5 / dt * (1.0 - growing**2)[:, None] * total, growing / dt


def _match_static(detector: cv2.SIFT, rig: StereoRig, frame: StereoFrame, masks: list[Mask]) -> Matches:
    """Matches between the two views of ``frame`` where nothing moves; features are detected in the reduced pictures."""
    found = []
    for image, mask in zip(views(frame), masks, strict=True):
        found.append(_reduced_features(detector, image, mask.astype(np.uint8)))
    return _match_views(rig, frame, *found)


def _reduced_features(detector: cv2.SIFT, image: Image, mask: NDArray[np.uint8]) -> tuple[Array, Descriptors]:
    """Features of ``image`` where the ``mask``, of its size or reduced, is set: those of the reduced picture."""
    reduced = _reduced(image)
    mask = np.asarray(cv2.resize(mask, reduced.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    places, descriptors = detect_features(detector, reduced, mask)
    return PICTURE_REDUCTION * places + (PICTURE_REDUCTION - 1) / 2, descriptors


def _match_views(
    rig: StereoRig, frame: StereoFrame, of_left: tuple[Array, Descriptors], of_right: tuple[Array, Descriptors]
) -> Matches:
    """Matches between the features of the two views of ``frame``, refined to sub-pixels, with velocities of zero."""
    _, left, right = match_pair(rig, frame, of_left, of_right)
    return Matches(left, right, np.zeros_like(left), np.zeros(len(left)))


def match_pair(
    rig: StereoRig, frame: StereoFrame, of_left: tuple[Array, Descriptors], of_right: tuple[Array, Descriptors]
) -> tuple[Indices, Array, Array]:
    """Which features (N,) of the left view of ``frame`` match, and the places (N, 2) px in both views, refined to
    sub-pixels in the right one."""
    (left, described), (right, described_right) = of_left, of_right
    i, j = match_descriptors(described, described_right, MAX_RATIO)
    near = np.abs(epipolar_distance(rig, left[i], right[j])) < MAX_EPIPOLAR_PX
    i, right = i[near], right[j][near]
    pictures = to_8_bit(frame.left), to_8_bit(frame.right)
    refined, found = track_forth_and_back(*pictures, left[i], right, 0, REFINEMENT_PRECISION_PX, MAX_MATCH_RETURN_PX)
    found &= np.linalg.norm(refined - right, axis=1) < MAX_REFINEMENT_PX
    return i[found], left[i][found], refined[found]


def masked_features(
    detector: cv2.SIFT, image: Image, mask: Mask, max_area: float = np.inf
) -> tuple[Array, Descriptors]:
    """Features of ``image`` where the reduced ``mask`` is set, region by region: places (n, 2) px and descriptors
    (n, 128). Of regions larger than ``max_area`` px they are those of the reduced picture."""
    grown = _with_margin(mask)
    _, _, stats, _ = cv2.connectedComponentsWithStats(grown)
    boxes = sorted((s for s in stats[1:].tolist() if s[4] >= MIN_MOVING_AREA_PX), key=lambda s: -s[4])[:MAX_REGIONS]
    places, descriptors = [np.empty((0, 2))], [np.empty((0, 128), np.float32)]
    for x, y, width, height, _ in boxes:
        crop_mask = grown[y : y + height, x : x + width].repeat(PICTURE_REDUCTION, 0).repeat(PICTURE_REDUCTION, 1)
        corner = np.array([x, y]) * PICTURE_REDUCTION
        crop = image[corner[1] : corner[1] + crop_mask.shape[0], corner[0] : corner[0] + crop_mask.shape[1]]
        crop_mask = crop_mask[: crop.shape[0], : crop.shape[1]]
        if crop.size > max_area:
            found, described = _reduced_features(detector, crop, crop_mask)
        else:
            found, described = detect_features(detector, crop, crop_mask)
        places.append(found + corner)
        descriptors.append(described)
    return np.concatenate(places), np.concatenate(descriptors)
