"""Corners of the region tracked from a few reference views into all views, for a fit that compares no textures.

All views are resampled by the fitted motion to the place, size and sharpness that the region has in a reference view:
what is tracked is the remaining displacement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from paceline.arrays import Array, Floats, to_8_bit
from paceline.imaging.point_tracking import WINDOW_PX, track_forth_and_back
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.pyramid import band_pass
from paceline.speed.refinement.trajectory import corners_of

REFERENCE_VIEWS = 3  # left views in which corners are found: the first, the middle and the last one
CORNERS_PER_REFERENCE = 12
CORNER_RESPONSE_SHARE = 0.02  # least corner response relative to the best corner
CORNER_SPACING_PX = 4.0  # least distance between two corners
MAX_WINDOW_SHARE = 0.6  # greatest size of a window as a share of the region's, which is enlarged where it is smaller
MAX_EXCLUDED_SHARE = 0.25  # greatest share of a side that is left out for half a window, which shows what is beside
MAX_SIZE_RATIO = 1.8  # greatest ratio between the sizes of the region in a view and in the reference view
CORNER_TRACKING_LEVELS = 1
LAST_TRACKING_STEP_PX, MAX_RETURN_DISTANCE_PX = 1e-2, 0.5
LENS_BLUR_STD_PX = 0.6  # of ordinary lenses and pixels; what a view differs from it by is estimated in each window
REGISTRATION_STEPS = 2
SAMPLING_STEPS_PER_PX = 32  # places between which OpenCV does not distinguish when it interpolates
WINDOW_STD_SHARE = 0.25  # standard deviation of the weights in a window, as a share of its size
NORMALISED_MEAN_GREY, NORMALISED_STD_GREY = 128.0, 40.0  # grey levels of the region in every resampled view


@dataclass(frozen=True, eq=False)
class CornerTracks:
    """N corners, ``square`` (N, 2) on the unit square of the region, in V = 2 F views, left and right in turn.

    ``pixels`` (N, V, 2) are where they are in views resampled for their own reference: ``resampling`` (N, V, 3, 3)
    takes these to pixels of the view. ``information`` (N, V) is relative, zero where a corner is not tracked.
    """

    square: Array
    pixels: Array
    resampling: Array
    information: Array


def track_corners(keyframes: Sequence[Keyframe], homographies: Array, gamma: float) -> CornerTracks:
    """Corners of the region tracked through F ``keyframes``, from ``homographies`` (F, 2, 3, 3) of the unit square to
    both views, of cameras whose grey values are light to the power 1 / ``gamma``."""
    H = homographies.reshape(-1, 3, 3)
    references = np.unique(np.linspace(0, len(keyframes) - 1, REFERENCE_VIEWS).round().astype(int))
    tracks = [_track_from(2 * int(k), keyframes, H, gamma) for k in references]
    return CornerTracks(*(np.concatenate(values) for values in zip(*tracks, strict=True)))


def _track_from(
    reference: int, keyframes: Sequence[Keyframe], H: Array, gamma: float
) -> tuple[Array, Array, Array, Array]:
    """What `CornerTracks` holds, of the corners of one ``reference`` view."""
    sides = _side_lengths(H)
    margin = WINDOW_PX[0]
    size = sides[reference] * max(1.0, margin / (MAX_WINDOW_SHARE * sides[reference].min()))
    to_square = np.array([[1 / size[0], 0, -margin / size[0]], [0, 1 / size[1], -margin / size[1]], [0, 0, 1]])
    resampling = H @ to_square
    scale = np.sqrt(size.prod() / sides.prod(1))  # resampled px for each px of a view
    ratio = scale / scale[reference]
    shown = np.array([crop.size > 0 for k in keyframes for crop in k.crops])
    if not shown[reference]:
        return np.zeros((0, 2)), np.zeros((0, len(H), 2)), np.zeros((0, *H.shape)), np.zeros((0, len(H)))
    used = np.flatnonzero(shown & (ratio < MAX_SIZE_RATIO) & (ratio > 1 / MAX_SIZE_RATIO)).tolist()
    blur = LENS_BLUR_STD_PX * float(scale[used].max())
    views = {v: _resampled(keyframes[v // 2], v % 2, resampling[v], size, blur, scale[v], gamma) for v in used}
    template = views.pop(reference)
    corners = _corners(template, size)
    pixels, information = np.zeros((len(corners), len(H), 2)), np.zeros((len(corners), len(H)))
    pixels[:, reference], information[:, reference] = corners, 1.0
    window = _Windows(template, corners)
    for v, image in views.items():
        tracked, is_found = track_forth_and_back(
            to_8_bit(template),
            to_8_bit(image),
            corners,
            corners,
            CORNER_TRACKING_LEVELS,
            LAST_TRACKING_STEP_PX,
            MAX_RETURN_DISTANCE_PX,
        )
        pixels[:, v] = window.registered(image, tracked)
        rays = np.c_[pixels[:, v], np.ones(len(corners))] @ resampling[v].T
        is_found &= keyframes[v // 2].holds(v % 2, rays[:, :2] / rays[:, 2:])
        information[:, v] = is_found / max(1.0, ratio[v]) ** 2  # a smaller view shows a place less precisely
    square = corners @ to_square[:2, :2].T + to_square[:2, 2]
    return square, pixels, np.tile(resampling, (len(corners), 1, 1, 1)), information


def _side_lengths(H: Array) -> Array:
    """Mean width and height (V, 2) px of the region in every view."""
    q = corners_of(H)
    across, down = q[:, [1, 2]] - q[:, [0, 3]], q[:, [3, 2]] - q[:, [0, 1]]
    return np.stack([np.linalg.norm(sides, axis=-1).mean(1) for sides in (across, down)], axis=1)


def _resampled(
    keyframe: Keyframe, side: int, resampling: Array, size: Array, blur: float, scale: float, gamma: float
) -> Floats:
    """A view resampled with a margin of one window around the region, as sharp as a lens of ``blur`` px would make it,
    which blurs light, and of the same mean and contrast as all others."""
    image, margin = np.asarray(keyframe.crops[side], np.float32), WINDOW_PX[0]
    further = np.sqrt(max((blur / scale) ** 2 - LENS_BLUR_STD_PX**2, 0.0))  # px of the view
    if further > 0.0:
        image = band_pass(image, [float(further)], gamma)
    shift = np.eye(3)
    shift[:2, 2] = -keyframe.origins[side]
    shape = np.ceil(size + 2 * margin).astype(int).tolist()
    flags = (
        cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP
    )  # OpenCV's bicubic kernel shifts what it resamples, by up to 0.04 px
    image = np.asarray(
        cv2.warpPerspective(image, shift @ resampling, shape, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.float32
    )
    region = image[margin:-margin, margin:-margin]
    gain = NORMALISED_STD_GREY / max(float(region.std()), 1e-3)
    return np.asarray((image - region.mean()) * gain + NORMALISED_MEAN_GREY, np.float32)


def _corners(template: Floats, size: Array) -> Array:
    """Corners (N, 2) of a resampled region whose windows show nothing, or little, beside it."""
    margin = WINDOW_PX[0]
    x, y = (margin + np.minimum(0.5 * margin, MAX_EXCLUDED_SHARE * size)).astype(int)
    mask = np.zeros(template.shape, np.uint8)
    mask[y:-y, x:-x] = 255
    corners = cv2.goodFeaturesToTrack(
        to_8_bit(template), CORNERS_PER_REFERENCE, CORNER_RESPONSE_SHARE, CORNER_SPACING_PX, mask=mask, blockSize=3
    )
    return np.empty((0, 2)) if corners is None else np.asarray(corners.reshape(-1, 2), float)


class _Windows:
    """Windows about N ``corners`` (N, 2) of a ``template``, to be registered in other images.

    A window's gain, offset and blur are nuisance parameters of its displacement: where an image is a little less sharp
    than the template, corners appear nearer to each other, which looks like a greater distance.
    """

    def __init__(self, template: Floats, corners: Array) -> None:
        steps = np.arange(WINDOW_PX[0]) - WINDOW_PX[0] // 2
        self._x, self._y = (g.ravel() for g in np.meshgrid(steps, steps))
        weights = np.exp(-0.5 * (self._x**2 + self._y**2) / (WINDOW_STD_SHARE * WINDOW_PX[0]) ** 2)
        down, right = np.gradient(template)
        images = right, down, np.ones_like(template), template, cv2.Laplacian(template, cv2.CV_32F)
        basis = np.stack([self._sampled(np.asarray(image, np.float32), corners) for image in images], axis=-1)
        self._template = basis[..., 3].copy()
        basis[..., 3] -= basis[..., 3].mean(1, keepdims=True)
        weighted = np.swapaxes(basis, 1, 2) * weights
        self._response = np.linalg.pinv(weighted @ basis, hermitian=True)[:, :2] @ weighted

    def registered(self, image: Floats, pixels: Array) -> Array:
        """The corners' places (N, 2) px in an ``image``, from those tracked there, by Gauss–Newton."""
        for _ in range(REGISTRATION_STEPS if len(pixels) else 0):
            pixels = np.rint(SAMPLING_STEPS_PER_PX * pixels) / SAMPLING_STEPS_PER_PX
            difference = self._sampled(image, pixels) - self._template
            pixels = pixels - np.clip((self._response @ difference[..., None])[..., 0], -1.0, 1.0)
        return pixels

    def _sampled(self, image: Floats, pixels: Array) -> Array:
        """The grey values (N, M) of the M pixels of a window about each of ``pixels`` (N, 2)."""
        x, y = ((pixels[:, i, None] + step).astype(np.float32) for i, step in enumerate((self._x, self._y)))
        if not len(pixels):
            return np.zeros(x.shape)
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE), float)
