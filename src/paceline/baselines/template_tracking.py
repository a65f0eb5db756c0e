"""Template tracking of the vehicle's region in each view, by normalised cross-correlation over position and scale.

A method that matches features has no model of where its vehicle will be. So it searches for the last image of the
region: in a wide neighbourhood in the second frame, near the prediction of a constant velocity afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.geometry import epipolar_distance, triangulate
from paceline.recordings.stereo import StereoFrame
from paceline.subpixel import parabola_peak_at

INITIAL_SCALES = np.geomspace(0.66, 1.52, 19)  # searched while the motion is unknown
INITIAL_SEARCH_SHARE = 0.8  # search radius while the motion is unknown, as a share of the region's longer side
SCALE_STEPS = np.geomspace(0.91, 1.1, 9)  # searched about the predicted scale
SEARCH_SHARE = 0.25  # search radius about the prediction, as a share of the region's longer side
MIN_SEARCH_PX = 6.0
MAX_TEMPLATE_PX = 64  # width to which larger regions are reduced
MIN_REGION_NCC = 0.6  # NCC below which the vehicle is not found
MAX_MISSED_FRAMES = 4  # consecutive frames without a match after which the vehicle is lost
MIN_REGION_CONTRAST_GREY = 2.0  # standard deviation of a region, grey levels
MAX_REGION_EPIPOLAR_PX = 3.0  # greatest epipolar distance for both views to show the same region
MAX_DEPTH_MISMATCH = (0.25, 2.0)  # mismatch of depth and change of scale: a share, and px of disparity
MIN_DEPTH_SHARE = 0.3  # least ratio of the predicted depth to the last one
MIN_REGION_PX = 8.0


@dataclass(frozen=True, eq=False)
class ScaledShift:
    """A change of place and scale in an image: ``p' = scale · p + shift``."""

    scale: float
    shift: Array  # (2,)

    def __call__(self, points: Array) -> Array:
        return self.scale * points + self.shift

    @property
    def matrix(self) -> Array:
        """As an affine map (2, 3)."""
        return np.column_stack([self.scale * np.eye(2), self.shift])


def shift_between(before: Array, after: Array) -> ScaledShift:
    """The shift and scale that take the centre and the size of one quadrilateral (4, 2) to those of another."""
    scale = float(np.sqrt(_area(after) / _area(before)))
    return ScaledShift(scale, after.mean(0) - scale * before.mean(0))


class TemplateTracker:
    """Tracks the regions of one vehicle in both views.

    ``quads`` (2, 4, 2) px and ``images`` are those of the ``time`` at which it was last seen. ``status`` is tracking,
    lost (unseen for too long) or ended (out of an image).
    """

    def __init__(self, rig: StereoRig, quads: Array, frame: StereoFrame) -> None:
        """The regions as outlined in ``frame``. Raises numpy.linalg.LinAlgError where they hold no texture."""
        self.rig, self.quads, self.images, self.time = rig, quads, (frame.left, frame.right), frame.time
        self.status = "tracking"
        self._last_step: tuple[Array, float, float] | None = (
            None  # the centres (2, 2) before, the growth and the time since
        )
        self._unseen = 0
        if min(_crop(i, q).std() for i, q in zip(self.images, quads, strict=True)) < MIN_REGION_CONTRAST_GREY:
            raise np.linalg.LinAlgError("the region has no texture")

    def find(self, frame: StereoFrame) -> tuple[ScaledShift, ScaledShift] | None:
        """The motion of both regions to ``frame`` since they were last found; None where they are not found."""
        moves: list[ScaledShift] = []
        for view, image in enumerate((frame.left, frame.right)):
            expected = self._expected(view, frame.time)
            if self._last_step is None:
                scales, reach = INITIAL_SCALES, INITIAL_SEARCH_SHARE
            else:
                scales, reach = expected.scale * SCALE_STEPS ** (1 + self._unseen), SEARCH_SHARE * (1 + self._unseen)
            if moves:  # both views see about the same change of scale
                scales = moves[0].scale * np.geomspace(0.98, 1.02, 3)
            quad = self.quads[view]
            move, ncc = _search(self.images[view], quad, image, expected(quad.mean(0)), scales, reach)
            if ncc < MIN_REGION_NCC:
                return None
            moves.append(move)
        return (moves[0], moves[1]) if self._views_agree(*moves) else None

    def _views_agree(self, left: ScaledShift, right: ScaledShift) -> bool:
        """Whether both views found the same region, with a change of depth that agrees with its scale."""
        before = self.quads.mean(1)
        after = np.stack([left(before[0]), right(before[1])])
        depth_before, depth = (float(triangulate(self.rig, *centres)[2]) for centres in (before, after))
        max_mismatch = MAX_DEPTH_MISMATCH[0] + MAX_DEPTH_MISMATCH[1] * depth_before / (
            self.rig.left.K[0, 0] * self.rig.baseline
        )
        across = abs(float(epipolar_distance(self.rig, *after)))
        return across < MAX_REGION_EPIPOLAR_PX and abs(left.scale * depth / depth_before - 1) < max_mismatch

    def record_found(self, quads: Array, frame: StereoFrame) -> None:
        """Records that the vehicle is found in ``frame`` at ``quads`` (2, 4, 2)."""
        grown = shift_between(self.quads[0], quads[0]).scale
        self._last_step = self.quads.mean(1), grown, frame.time - self.time
        self.quads, self.images, self.time, self._unseen = quads, (frame.left, frame.right), frame.time, 0
        if self._outside(quads):
            self.status = "ended"

    def record_missed(self, time: float) -> bool:
        """Records that the vehicle is not found at ``time``; whether to search for it further."""
        self._unseen += 1
        expected = np.stack([self._expected(view, time)(self.quads[view]) for view in (0, 1)])
        if self._outside(expected):
            self.status = "ended"
        elif self._unseen >= MAX_MISSED_FRAMES:
            self.status = "lost"
        return self.status == "tracking"

    def _expected(self, view: int, time: float) -> ScaledShift:
        """The motion predicted from a constant velocity in space: depth, and pixels times depth, are linear in time."""
        if self._last_step is None:
            return ScaledShift(1.0, np.zeros(2))
        centres, grown, since = self._last_step
        steps, centre = (time - self.time) / since, self.quads[view].mean(0)
        depth = max(1 + (1 - grown) * steps, MIN_DEPTH_SHARE)  # in units of the depth now; before, it was ``grown``
        return ScaledShift(1 / depth, (centre + (centre - grown * centres[view]) * steps) / depth - centre / depth)

    def _outside(self, quads: Array) -> bool:
        """Whether a region has left its image, or has no area left."""
        for quad, image in zip(quads, self.images, strict=True):
            if not ((quad >= 0).all() and (quad <= np.array(image.shape[::-1]) - 1).all()):
                return True
        return bool(np.ptp(quads[0], axis=0).min() < MIN_REGION_PX)


def _search(
    before: Image, quad: Array, image: Image, centre: Array, scales: Array, reach: float
) -> tuple[ScaledShift, float]:
    """The motion of the template ``quad`` (4, 2) of ``before`` to ``image``, and its NCC there, −1 … 1."""
    size = np.ptp(quad, axis=0)
    shrink = min(1.0, MAX_TEMPLATE_PX / float(size[0]))
    template = _resized(_crop(before, quad), shrink)
    edge = np.maximum(np.floor(quad.min(0)), 0) - 0.5  # of the template, where its first pixel begins
    best = (ScaledShift(1.0, np.zeros(2)), -1.0)
    for scale in scales.tolist():
        half = 0.5 * scale * size + max(reach * float(size.max()), MIN_SEARCH_PX)
        x0, y0 = np.maximum(np.floor(centre - half), 0).astype(int)
        x1, y1 = np.maximum(np.ceil(centre + half), 0).astype(int) + 1
        window = _resized(image[y0:y1, x0:x1], shrink)
        width, height = np.maximum(np.rint(np.array(template.shape[::-1]) * scale), 2).astype(int).tolist()
        if window.shape[0] < height or window.shape[1] < width:
            continue
        scaled_template = cv2.resize(template, (width, height), interpolation=cv2.INTER_LINEAR)
        score = np.asarray(cv2.matchTemplate(window, scaled_template, cv2.TM_CCOEFF_NORMED), float)
        score = np.nan_to_num(score, posinf=-1.0, neginf=-1.0)
        _, ncc, _, (x, y) = cv2.minMaxLoc(score)
        if ncc > best[1]:
            peak = np.array([x + parabola_peak_at(score[y], x), y + parabola_peak_at(score[:, x], y)])
            position = peak / shrink + [x0 - 0.5, y0 - 0.5]
            best = (ScaledShift(scale, position - scale * edge), float(ncc))
    return best


def _crop(image: Image, quad: Array) -> Image:
    """The upright box of ``image`` about ``quad`` (4, 2)."""
    x0, y0 = np.maximum(np.floor(quad.min(0)), 0).astype(int)
    x1, y1 = np.ceil(quad.max(0)).astype(int) + 1
    return image[y0:y1, x0:x1]


def _resized(image: Image, factor: float) -> Image:
    if factor == 1.0 or factor * min(image.shape) < 1.0:  # too small for anything to be found in it
        return image
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.float32)


def _area(quad: Array) -> float:
    x, y = quad.T
    return float(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
