"""Features (SIFT) of what moves in each frame of a recording, and their matches between the two views.

They are detected once a frame, for all that they are matched with later: the other view, and other frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Indices, Mask, to_8_bit
from paceline.cameras import StereoRig
from paceline.geometry import epipolar_distance
from paceline.imaging.point_tracking import track_forth_and_back
from paceline.recordings.stereo import StereoFrame
from paceline.sift_features import Descriptors, detect_features, match_descriptors

WINDOW_FRAMES = 5  # frames before and after one that may repeat it: where something moves in them, it is looked at
PICTURE_REDUCTION = 2  # by which pictures are reduced where no sub-pixel place is asked for
MOTION_BLUR_PX = 2.0  # smoothing of differences between frames, in reduced pixels
MOTION_SIGMA = 6.0  # difference that counts as motion, in standard deviations of the noise …
MIN_MOTION_GREY = 3.0  # … and at least in grey levels
NOISE_STEP_PX = 4  # distance between the pixels from which the noise is estimated
MARGIN_PX = 6  # around what moves, in reduced pixels
MAX_REGIONS = 12  # moving regions of a picture, the largest
MIN_MOVING_AREA_PX = 400  # least area of one with its margin, in reduced pixels
MAX_WHOLE_AREA_PX = 500_000  # larger regions are searched in the reduced picture: at full size one takes half a second
MAX_EPIPOLAR_PX = 8.0  # of a match: the calibration's error and the offset together
FEATURE_CONTRAST = 0.02  # of features, half of OpenCV's: far vehicles are small and faint
MAX_RATIO = 0.85  # Lowe's ratio of the best match's distance to that of the second best
MAX_REFINEMENT_PX, MAX_MATCH_RETURN_PX = 2.0, 0.15  # by which a match is refined; by which it fails to come back
REFINEMENT_PRECISION_PX = 0.005

Features = tuple[Array, Descriptors]  # places (N, 2) px and descriptors (N, 128)


@dataclass(frozen=True, eq=False)
class MovingFeatures:
    """Features of what moves in the ``left`` and the ``right`` view of a frame, at a ``time`` (s) and ``skew`` s later.

    The left ones ``matched`` (M,) are found in the right view at ``places`` (M, 2) px.
    """

    time: float
    skew: float
    left: Features
    right: Features
    matched: Indices
    places: Array


def feature_detector() -> cv2.SIFT:
    """The detector of features of what moves."""
    return cv2.SIFT.create(contrastThreshold=FEATURE_CONTRAST)


def moving_features(
    rig: StereoRig, frames: Iterable[StereoFrame], selection: Container[int] | None = None
) -> Iterator[tuple[StereoFrame, MovingFeatures]]:
    """Each of the ``frames``, or of those whose index is in the ``selection``, with its features."""
    detector = feature_detector()
    for frame, masks in _with_masks(frames):
        if selection is None or frame.index in selection:
            left, right = (masked_features(detector, i, m) for i, m in zip(views(frame), masks, strict=True))
            matched, places = match_pair(rig, frame, left, right)
            yield frame, MovingFeatures(frame.time, frame.skew, left, right, matched, places)


def views(frame: StereoFrame) -> tuple[Image, Image]:
    return frame.left, frame.right


def motion_mask(image: Image, other: Image) -> Mask:
    """Where something moves between two images (H, W) of one view, reduced."""
    difference = np.abs(cv2.GaussianBlur(reduced(image) - reduced(other), (0, 0), MOTION_BLUR_PX))
    noise = float(np.median(difference[::NOISE_STEP_PX, ::NOISE_STEP_PX])) / 0.6745
    moving = (difference > max(MOTION_SIGMA * noise, MIN_MOTION_GREY)).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(moving, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0)


def reduced(image: Image, reduction: int = PICTURE_REDUCTION) -> Image:
    """The ``image`` (H, W), reduced."""
    size = max(image.shape[1] // reduction, 1), max(image.shape[0] // reduction, 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def with_margin(mask: Mask) -> NDArray[np.uint8]:
    """The reduced ``mask`` with a margin."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)))


def match_pair(rig: StereoRig, frame: StereoFrame, of_left: Features, of_right: Features) -> tuple[Indices, Array]:
    """Which features (N,) of the left view of ``frame`` match one of the right view, and their places (N, 2) px there,
    refined to sub-pixels."""
    (left, described), (right, described_right) = of_left, of_right
    i, j = match_descriptors(described, described_right, MAX_RATIO)
    near = np.abs(epipolar_distance(rig, left[i], right[j])) < MAX_EPIPOLAR_PX
    i, right = i[near], right[j][near]
    pictures = to_8_bit(frame.left), to_8_bit(frame.right)
    refined, found = track_forth_and_back(*pictures, left[i], right, 0, REFINEMENT_PRECISION_PX, MAX_MATCH_RETURN_PX)
    found &= np.linalg.norm(refined - right, axis=1) < MAX_REFINEMENT_PX
    return i[found], refined[found]


def masked_features(detector: cv2.SIFT, image: Image, mask: Mask) -> Features:
    """Features of ``image`` where the reduced ``mask`` is set, region by region. Of regions larger than
    `MAX_WHOLE_AREA_PX` they are those of the reduced picture."""
    grown = with_margin(mask)
    _, _, stats, _ = cv2.connectedComponentsWithStats(grown)
    boxes = sorted((s for s in stats[1:].tolist() if s[4] >= MIN_MOVING_AREA_PX), key=lambda s: -s[4])[:MAX_REGIONS]
    places, descriptors = [np.empty((0, 2))], [np.empty((0, 128), np.float32)]
    for x, y, width, height, _ in boxes:
        crop_mask = grown[y : y + height, x : x + width].repeat(PICTURE_REDUCTION, 0).repeat(PICTURE_REDUCTION, 1)
        corner = np.array([x, y]) * PICTURE_REDUCTION
        crop = image[corner[1] : corner[1] + crop_mask.shape[0], corner[0] : corner[0] + crop_mask.shape[1]]
        crop_mask = crop_mask[: crop.shape[0], : crop.shape[1]]
        detect = reduced_features if crop.size > MAX_WHOLE_AREA_PX else detect_features
        found, described = detect(detector, crop, crop_mask)
        places.append(found + corner)
        descriptors.append(described)
    return np.concatenate(places), np.concatenate(descriptors)


def reduced_features(detector: cv2.SIFT, image: Image, mask: NDArray[np.uint8]) -> Features:
    """Features of ``image`` where the ``mask``, of its size or reduced, is set: those of the reduced picture."""
    small = reduced(image)
    mask = np.asarray(cv2.resize(mask, small.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    places, descriptors = detect_features(detector, small, mask)
    return PICTURE_REDUCTION * places + (PICTURE_REDUCTION - 1) / 2, descriptors


def _with_masks(frames: Iterable[StereoFrame]) -> Iterator[tuple[StereoFrame, tuple[Mask, Mask]]]:
    """Each of the ``frames``, with where something moves in both views, reduced: from the frame before or to the next,
    or, where nothing does, in the intervals around."""
    window: deque[StereoFrame] = deque()
    changes: deque[tuple[Mask, Mask]] = deque()  # where something has moved since the frame before
    done = 0  # frames at the beginning of the window whose masks are given
    for frame in frames:
        before = views(window[-1] if window else frame)
        left, right = (motion_mask(a, b) for a, b in zip(before, views(frame), strict=True))
        window.append(frame)
        changes.append((left, right))
        if len(window) - done > WINDOW_FRAMES + 1:
            yield window[done], _around(changes, done)
            done += 1
        if done > WINDOW_FRAMES:
            window.popleft()
            changes.popleft()
            done -= 1
    for k in range(done, len(window)):
        yield window[k], _around(changes, k)


def _around(changes: Sequence[tuple[Mask, Mask]], k: int) -> tuple[Mask, Mask]:
    """Where something moves in either view in the shortest span of intervals around frame ``k`` in which something
    does; ``changes`` are those since the frame before each."""
    for reach in range(WINDOW_FRAMES):
        span = [changes[n] for n in range(max(k - reach, 0), min(k + 2 + reach, len(changes)))]
        left, right = (np.logical_or.reduce([masks[side] for masks in span]) for side in (0, 1))
        if left.any() and right.any():
            break
    return left, right
