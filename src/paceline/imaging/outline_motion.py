"""How an outlined vehicle moves in the picture of one view, and so from the left exposure to the right one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.geometry import triangulate
from paceline.imaging.moving_features import PICTURE_REDUCTION, reduced
from paceline.subpixel import parabola_peak_at

SCALE_CANDIDATES = np.geomspace(0.72, 1.4, 23)  # of the template from the first frame to the second
MAX_SPEED_MPS = 60.0  # of a vehicle whose template is looked for
MIN_OUTLINE_SIZE_M = 1.5  # least root of an outline's area
MIN_REDUCED_TEMPLATE_PX = 12  # least side of a template that is looked for in the reduced picture first …
MAX_REDUCED_SHIFT_PX = 4.0  # … which tells its place to this
ALIGNMENT_SMOOTHING_PX = 1.0
RIM_SHARE = 0.05  # of an outline's width and height that is not aligned
EPIPOLAR_MARGIN_PX = 3  # by which a match in the other view may be off its epipolar line
MAX_ALIGNMENT_SHARE = 0.25  # by which an alignment may move a corner, as a share of the outline's shorter side


def displacement_between_exposures(rig: StereoRig, left: Array, right: Array, skew: float, motion: Array) -> Array:
    """How far (3,) m a vehicle moves from the left exposure to the right one, ``skew`` s later.

    It is outlined as ``left`` and ``right`` (4, 2) px, each at its own exposure, and moves by ``motion`` (3,) 1/s, in
    units of its depth at the left one.
    """
    ray = rig.left.rays(left.mean(0))
    later = ray + skew * motion
    depth = float(triangulate(rig, rig.left.project(later), right.mean(0))[2] / later[2])
    return depth * skew * motion


def motion_by_depth(rig: StereoRig, first: Image, second: Image, left: Array, dt: float) -> Array:
    """The velocity (3,) of a vehicle in units of its depth, 1/s, by which its template inside the outline ``left``
    (4, 2) of the ``first`` left picture moves and grows until the ``second`` one, ``dt`` s later."""
    size = float(np.sqrt(np.prod(np.ptp(left, axis=0))))
    shift, growth = match_template(first, second, left, MAX_SPEED_MPS * abs(dt) * size / MIN_OUTLINE_SIZE_M)
    before, after = rig.left.rays(np.stack([left.mean(0), left.mean(0) + shift]))
    return np.asarray((after / growth - before) / dt)


def followed(pictures: Sequence[Image], outline: Array) -> Array:
    """The ``outline`` (4, 2) px of the first of the ``pictures`` (H, W) in the last one.

    It is followed from each to the next: its template is matched, and then aligned by an affine map.
    """
    for first, second in pairwise(pictures):
        reach = 2.0 * float(np.ptp(outline, axis=0).max())
        shift, growth = match_template(first, second, outline, reach)
        outline = _aligned(first, second, outline, outline.mean(0) + shift + growth * (outline - outline.mean(0)))
    return outline


def _aligned(first: Image, second: Image, outline: Array, expected: Array) -> Array:
    """The ``outline`` (4, 2) px of the ``first`` picture in the ``second`` one, by the greatest correlation near the
    ``expected`` one; that where none is found."""
    rim = RIM_SHARE * np.ptp(outline, axis=0)  # which may show the background
    corner = np.maximum(np.ceil(outline.min(0) + rim).astype(int), 0)
    end = np.floor(outline.max(0) - rim).astype(int) + 1
    template, other = (cv2.GaussianBlur(picture, (0, 0), ALIGNMENT_SMOOTHING_PX) for picture in (first, second))
    template, everywhere = template[corner[1] : end[1], corner[0] : end[0]], np.full(other.shape, 255, np.uint8)
    start = cv2.getAffineTransform((outline - corner)[:3].astype(np.float32), expected[:3].astype(np.float32))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-5)
    try:
        affine = cv2.findTransformECC(
            template, other, start.astype(np.float32), cv2.MOTION_AFFINE, criteria, everywhere, 1
        )[1]
    except cv2.error:  # the iteration diverges
        return expected
    aligned = (outline - corner) @ affine[:, :2].T + affine[:, 2]
    distance = np.linalg.norm(aligned - expected, axis=1).max()
    return np.asarray(aligned) if distance < MAX_ALIGNMENT_SHARE * np.ptp(expected, axis=0).min() else expected


def place_between_views(rig: StereoRig, left: Array, views: tuple[Image, Image], depths: Array) -> Array | None:
    """The place (3,) m of the middle of what the outline ``left`` (4, 2) px shows in the left one of the ``views`` (H,
    W), by its best match in the right one at ``depths`` between these two (2,); None where it is outside a view."""
    corner = np.floor(left.min(0)).astype(int)
    end = np.ceil(left.max(0)).astype(int) + 1
    half, middle = (end - corner) / 2, (corner + end - 1) / 2
    expected = rig.right.project(rig.to_right(rig.left.rays(middle) * depths[:, None]))
    first = np.floor(expected.min(0) - half).astype(int) - EPIPOLAR_MARGIN_PX
    last = np.ceil(expected.max(0) + half).astype(int) + EPIPOLAR_MARGIN_PX
    if min(*corner, *first) < 0 or (end > views[0].shape[::-1]).any() or (last > views[1].shape[::-1]).any():
        return None
    template = views[0][corner[1] : end[1], corner[0] : end[0]]
    window = views[1][first[1] : last[1], first[0] : last[0]]
    correlation = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)  # not a number where nothing is seen
    scores = np.nan_to_num(np.asarray(correlation, float), nan=-1.0, posinf=-1.0, neginf=-1.0)
    y, x = (int(k) for k in np.unravel_index(int(np.argmax(scores)), scores.shape))
    peak = np.array([x + parabola_peak_at(scores[y], x), y + parabola_peak_at(scores[:, x], y)])
    return np.asarray(rig.left.rays(left.mean(0)) * triangulate(rig, middle, first + peak + half - 0.5)[2])


def match_template(first: Image, second: Image, quad: Array, reach: float) -> tuple[Array, float]:
    """Match the template inside ``quad`` (4, 2) of ``first`` in ``second``: its shift (2,) in pixels, at most about
    ``reach``, and its change of scale."""
    x0, y0 = np.maximum(np.floor(quad.min(0)).astype(int), 0)
    x1, y1 = np.ceil(quad.max(0)).astype(int) + 1
    template = first[y0:y1, x0:x1]
    across = int(reach) + (x1 - x0) // 4
    down = int(min(reach, 0.25 * reach + (y1 - y0)))
    left, top = max(x0 - across, 0), max(y0 - down, 0)
    window, corner, scales = second[top : y1 + down, left : x1 + across], np.array([left, top]), SCALE_CANDIDATES
    if min(template.shape) >= MIN_REDUCED_TEMPLATE_PX * PICTURE_REDUCTION:  # where about is seen in the reduced picture
        if (rough := _best_match(reduced(template), reduced(window), scales)) is None:
            return np.zeros(2), 1.0
        middle, scale = PICTURE_REDUCTION * rough[0], int(rough[1])
        scales = scales[max(scale - 1, 0) : scale + 2]
        half = scales[-1] * np.array(template.shape[::-1]) / 2 + MAX_REDUCED_SHIFT_PX
        start, end = np.maximum(np.floor(middle - half).astype(int), 0), np.ceil(middle + half).astype(int)
        window, corner = window[start[1] : end[1], start[0] : end[0]], corner + start
    if (best := _best_match(template, window, scales)) is None:
        return np.zeros(2), 1.0
    return corner + best[0] - np.array([x0 + x1, y0 + y1]) / 2, float(scales[best[1]])


def _best_match(template: Image, window: Image, scales: Array) -> tuple[Array, int] | None:
    """The middle (2,) px of the part of a ``window`` (H, W) that correlates best with the ``template`` at any of the
    ``scales``, and which of them; None where the window is too small for it."""
    best: tuple[Array, int] | None = None
    best_score = -1.0
    for number, scale in enumerate(scales.tolist()):
        scaled = cv2.resize(template, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        if scaled.shape[0] > window.shape[0] or scaled.shape[1] > window.shape[1]:
            continue
        scores = cv2.matchTemplate(window, scaled, cv2.TM_CCOEFF_NORMED)
        y, x = np.unravel_index(int(np.argmax(scores)), scores.shape)
        if scores[y, x] > best_score:
            best_score, best = (
                float(scores[y, x]),
                (np.array([x + scaled.shape[1] / 2, y + scaled.shape[0] / 2]), number),
            )
    return best
