"""Whether what stands still in an outline is a vehicle or the road itself: which plane carries one view onto the other.

The face of a vehicle is nearly upright, so its disparity is nearly the same everywhere; on the road it grows downwards.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.speed.geometry.paths import Path
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.model_selection import RefinedMotion
from paceline.speed.refinement.pyramid import BLUR_CORRELATED_SAMPLES, areas

OUTLINE_SAMPLES = 48, 32  # across and down the outline
FACE_TILTS_RAD = np.radians([-30.0, -15.0, 0.0, 15.0, 30.0])  # of faces from the fitted one, as of windscreens
ROAD_ROLLS_RAD = np.radians([-4.0, 0.0, 4.0])  # of a road across its path, by its banking and the camera's own roll
MIN_UNEXPLAINED_SHARE = 1e-4  # of the variance: that of two pictures with hardly any noise
DISPARITY_ERRORS_PX = np.linspace(-3.0, 3.0, 25)  # of a plane as a whole, by the clicks, the path and the calibration


def log_likelihood_ratio_of_road(refined: RefinedMotion, keyframes: Sequence[Keyframe], path: Path) -> float:
    """Log likelihood ratio of the road under a ``path``, over a vehicle's face, being what the outline shows in all
    ``keyframes``, in which it stands still; 0 where no view shows it wholly.

    Both are planes, with an unknown error of their disparity and, the road, of its roll: the camera need not be level.
    The residuals of the best plane of each are compared, as many of them as are independent.
    """
    trajectory, theta = refined.trajectory, refined.theta
    _, _, normal, _ = trajectory.motion(theta)
    (centre,) = trajectory.places(theta, np.array([[0.5, 0.5]]))
    s = np.array(path.nearest(centre))
    ground, (_, across, down) = path.at(s), path.frames(s).T
    faces = [(np.cos(tilt) * normal + np.sin(tilt) * down, centre) for tilt in FACE_TILTS_RAD]
    roads = [(np.cos(roll) * down + np.sin(roll) * across, ground) for roll in ROAD_ROLLS_RAD]
    pixels = _outline_pixels(trajectory.homographies(theta)[0][0, 0])
    left = _mean_sampled(keyframes, 0, pixels)
    if left is None:
        return 0.0
    of_face, of_road = (
        min(_unexplained_shares(trajectory.rig, keyframes, pixels, left, planes), default=1.0)
        for planes in (faces, roads)
    )
    samples = min(float(areas(trajectory.quads(theta)[0, 0])) / BLUR_CORRELATED_SAMPLES, float(len(pixels)))
    return 0.5 * samples * float(np.log(of_face / of_road))


def _outline_pixels(H: Array) -> Array:
    """Samples (N, 2) px of the outline, to which ``H`` (3, 3) takes the unit square."""
    across, down = ((np.arange(n) + 0.5) / n for n in OUTLINE_SAMPLES)
    square = np.stack([*np.meshgrid(across, down), np.ones(OUTLINE_SAMPLES[::-1])], axis=-1).reshape(-1, 3)
    rays = square @ H.T
    return np.asarray(rays[:, :2] / rays[:, 2:])


def _unexplained_shares(
    rig: StereoRig, keyframes: Sequence[Keyframe], pixels: Array, left: Array, planes: list[tuple[Array, Array]]
) -> Iterator[float]:
    """The share of the variance of the grey values ``left`` (N,) at ``pixels`` (N, 2) of the left view that the right
    one does not explain, by each of the ``planes`` (normal, point) with each of the errors of disparity."""
    rays, along = rig.left.rays(pixels), rig.t[:2] / np.linalg.norm(rig.t[:2])
    for normal, point in planes:
        depths = (normal @ point) / (rays @ normal)
        if not (depths > 0).all():
            continue
        places = rig.project(rays * depths[:, None])[1]
        for error in DISPARITY_ERRORS_PX:
            right = _mean_sampled(keyframes, 1, places + error * along)
            if right is not None and min(left.std(), right.std()) > 0.0:
                correlation = max(float(np.corrcoef(left, right)[0, 1]), 0.0)
                yield max(1.0 - correlation**2, MIN_UNEXPLAINED_SHARE)


def _mean_sampled(keyframes: Sequence[Keyframe], side: int, pixels: Array) -> Array | None:
    """The mean grey values (N,) of one view at ``pixels`` (N, 2), over the ``keyframes`` whose crops hold them all;
    None where none does."""
    values = []
    for k in keyframes:
        if k.holds(side, pixels).all():
            x, y = (pixels - k.origins[side]).astype(np.float32).T
            values.append(cv2.remap(k.crops[side], x, y, cv2.INTER_LINEAR).ravel())
    return np.asarray(np.mean(values, axis=0), float) if values else None
