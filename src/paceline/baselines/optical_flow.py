"""Point tracking by Lucas and Kanade's method, with a forward-backward check."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Mask, to_8_bit
from paceline.baselines.template_tracking import ScaledShift

FLOW_WINDOW_LIMITS_PX = (7, 17)
FLOW_WINDOW_SHARE = 0.4  # window size as a share of the region's height
MAX_FORWARD_BACKWARD_PX = 0.3  # distance between a point and its position tracked forth and back
MAX_CORNERS = 150
CORNER_QUALITY = 0.01  # least corner response relative to the best corner
MIN_CORNER_SPACING_PX = 3.0
MAX_RIM_SHARE = 0.25  # greatest share of a side that is excluded at the region's border
CROP_BORDER_PX = 40  # margin of image around the points
NORMALIZED_MEAN, NORMALIZED_STD = 128.0, 45.0  # grey levels of the normalised crop
FLOW_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)


def detect_corners(image: Image, quad: Array, known: Array) -> Array:
    """Corners (n, 2) inside ``quad`` (4, 2) that are clear of the ``known`` points (m, 2).

    They are at least half a window from its sides: a window that shows the background is biased to its depth.
    """
    rim = np.minimum(0.5 * window_size(quad) / np.ptp(quad, axis=0), MAX_RIM_SHARE)
    inner = quad.mean(0) + (1 - 2 * rim) * (quad - quad.mean(0))
    low = np.maximum(np.floor(quad.min(0)).astype(int), 0)
    high = np.ceil(quad.max(0)).astype(int) + 1
    picture = to_8_bit(image[low[1] : high[1], low[0] : high[0]])
    max_new = MAX_CORNERS - len(known)
    if max_new <= 0 or not picture.size:
        return np.empty((0, 2))
    mask = np.zeros(picture.shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(inner - low).astype(np.int32), 255)
    for x, y in np.rint(known - low).astype(int).tolist():
        cv2.circle(mask, (x, y), round(MIN_CORNER_SPACING_PX), 0, cv2.FILLED)
    corners = cv2.goodFeaturesToTrack(picture, max_new, CORNER_QUALITY, MIN_CORNER_SPACING_PX, mask=mask, blockSize=3)
    return np.empty((0, 2)) if corners is None else np.asarray(corners.reshape(-1, 2) + low, float)


def track_points(before: Image, after: Image, points: Array, move: ScaledShift, window: int) -> tuple[Array, Mask]:
    """The positions of ``points`` (n, 2) of ``before`` in ``after``, starting from ``move``, and which pass the check.

    The earlier image is first warped to the position and scale of the later one, because the method itself estimates
    shifts only.
    """
    start = move(points)
    low, high = _crop_bounds(start, after)
    crop_after = after[low[1] : high[1], low[0] : high[0]]
    matrix = move.matrix - np.column_stack([np.zeros((2, 2)), low])
    size = int(high[0] - low[0]), int(high[1] - low[1])
    start_crop = np.asarray(cv2.warpAffine(before, matrix, size, flags=cv2.INTER_CUBIC), np.float32)
    tracked, valid = _forward_backward(start_crop, crop_after, start - low, start - low, window)
    return tracked + low, valid


def match_points(left: Image, right: Image, points: Array, guess: Array, window: int) -> tuple[Array, Mask]:
    """The positions of ``points`` (n, 2) of ``left`` in ``right``, starting from ``guess`` (n, 2), and which pass."""
    low, high = _crop_bounds(points, left)
    low_right, high_right = _crop_bounds(guess, right)
    a = left[low[1] : high[1], low[0] : high[0]]
    b = right[low_right[1] : high_right[1], low_right[0] : high_right[0]]
    height, width = min(a.shape[0], b.shape[0]), min(a.shape[1], b.shape[1])
    crops = a[:height, :width], b[:height, :width]
    matched, valid = _forward_backward(*crops, points - low, guess - low_right, window)
    return matched + low_right, valid


def window_size(quad: Array) -> int:
    """The odd window width in pixels for a region."""
    size = int(np.clip(FLOW_WINDOW_SHARE * np.ptp(quad[:, 1]), *FLOW_WINDOW_LIMITS_PX))
    return size | 1


def _forward_backward(before: Image, after: Image, points: Array, guess: Array, window: int) -> tuple[Array, Mask]:
    a, b = _normalized(before, points), _normalized(after, guess)
    start = points.astype(np.float32)
    options = (None, None, (window, window), 1, FLOW_CRITERIA, cv2.OPTFLOW_USE_INITIAL_FLOW)
    tracked, tracked_found, _ = map(
        np.asarray, cv2.calcOpticalFlowPyrLK(a, b, start, guess.astype(np.float32), *options)
    )
    returned, returned_found, _ = map(np.asarray, cv2.calcOpticalFlowPyrLK(b, a, tracked, start.copy(), *options))
    valid = (
        (tracked_found.ravel() == 1)
        & (returned_found.ravel() == 1)
        & (np.linalg.norm(returned - start, axis=1) < MAX_FORWARD_BACKWARD_PX)
    )
    return np.asarray(
        tracked - 0.5 * (returned - start), float
    ), valid  # the mean of both directions, in which common errors cancel


def _crop_bounds(points: Array, image: Image) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first pixel, and the one after the last, of the crop around ``points``."""
    end = np.array(image.shape[::-1])
    low = np.clip(np.floor(points.min(0)).astype(np.int64) - CROP_BORDER_PX, 0, end - 1)
    high = np.clip(np.ceil(points.max(0)).astype(np.int64) + CROP_BORDER_PX, low + 1, end)
    return low, high


def _normalized(image: Image, points: Array) -> NDArray[np.uint8]:
    """``image`` with the mean and the contrast around ``points`` (n, 2) normalised to fixed values.

    The method takes a change of exposure for motion.
    """
    (x0, y0), (x1, y1) = np.floor(points.min(0)).astype(int), np.ceil(points.max(0)).astype(int) + 1
    about = image[max(y0, 0) : y1, max(x0, 0) : x1]
    if not about.size:
        return to_8_bit(image)
    return to_8_bit(NORMALIZED_MEAN + NORMALIZED_STD * (image - about.mean()) / max(float(about.std()), 1.0))
