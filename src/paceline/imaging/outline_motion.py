"""How an outlined vehicle moves in the picture of one view, and so from the left exposure to the right one."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.geometry import triangulate

SCALE_CANDIDATES = np.geomspace(0.72, 1.4, 23)  # of the template from the first frame to the second
MAX_SPEED_MPS = 60.0  # of a vehicle whose template is looked for
MIN_OUTLINE_SIZE_M = 1.5  # least root of an outline's area


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


def match_template(first: Image, second: Image, quad: Array, reach: float) -> tuple[Array, float]:
    """Match the template inside ``quad`` (4, 2) of ``first`` in ``second``: its shift (2,) in pixels, at most about
    ``reach``, and its change of scale."""
    x0, y0 = np.maximum(np.floor(quad.min(0)).astype(int), 0)
    x1, y1 = np.ceil(quad.max(0)).astype(int) + 1
    template = first[y0:y1, x0:x1]
    across = int(reach) + (x1 - x0) // 4
    down = int(min(reach, 0.25 * reach + (y1 - y0)))
    left, top = max(x0 - across, 0), max(y0 - down, 0)
    window = second[top : y1 + down, left : x1 + across]
    best = (-1.0, np.zeros(2), 1.0)
    for growth in SCALE_CANDIDATES:
        scaled = cv2.resize(template, None, fx=growth, fy=growth, interpolation=cv2.INTER_LINEAR)
        if scaled.shape[0] > window.shape[0] or scaled.shape[1] > window.shape[1]:
            continue
        scores = cv2.matchTemplate(window, scaled, cv2.TM_CCOEFF_NORMED)
        y, x = np.unravel_index(int(np.argmax(scores)), scores.shape)
        if scores[y, x] > best[0]:
            middle = np.array([left + x + scaled.shape[1] / 2, top + y + scaled.shape[0] / 2])
            best = (float(scores[y, x]), middle - np.array([x0 + x1, y0 + y1]) / 2, float(growth))
    return best[1], best[2]
