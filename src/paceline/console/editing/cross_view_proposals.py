"""Proposes in one view the outline or road line that the user drew in the other.

Patches of the two images are compared by normalised correlation at all distances of the epipolar line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.documents.plausibility import check_quadrilateral
from paceline.errors import UnusableInput

MIN_SEARCH_DISTANCE_M, MAX_SEARCH_DISTANCE_M = 2.0, 400.0  # search range of distances
MIN_CORRELATION = 0.6  # least correlation of a proposed match
MAX_SECOND_PEAK_RATIO = 0.92  # ratio of the second peak to the best, above which a match is ambiguous
MAX_GRID_SAMPLES = 40  # greatest number of samples along the longer side of an outline
PATCH_RADIUS_PX = 7  # radius of the patches along a line
MAX_LINE_SAMPLES = 48
MAX_REMAP_ROWS = 32000  # greatest number of rows that OpenCV resamples at once


@dataclass(frozen=True, eq=False)
class Proposal:
    """``pixels`` (N, 2), ideal ones of the other view, and the correlation of the two views there, −1 … 1."""

    pixels: Array
    correlation: float


def swapped_views(rig: StereoRig) -> StereoRig:
    """``rig`` with its left and right camera exchanged."""
    return StereoRig(rig.right, rig.left, rig.R.T, -rig.R.T @ rig.t)


def inverse_depths(rig: StereoRig) -> Array:
    """Inverse depths (M,), 1/m, between which a point moves by at most half a pixel in the other view."""
    step = 0.5 / (max(rig.left.K[0, 0], rig.right.K[0, 0]) * rig.baseline)
    return np.linspace(
        1 / MAX_SEARCH_DISTANCE_M,
        1 / MIN_SEARCH_DISTANCE_M,
        int(np.clip((1 / MIN_SEARCH_DISTANCE_M - 1 / MAX_SEARCH_DISTANCE_M) / step, 64, 6000)),
    )


def propose_quadrilateral(
    rig: StereoRig, image: Image, other_image: Image, corners: Array, normal: Array | None = None
) -> Proposal:
    """Finds the outline ``corners`` (4, 2) of a plane, drawn in the rig's left ideal image, in the right one.

    A search over depth with the plane upright and facing the camera, or with the ``normal`` (3,) that a path gives,
    starts a Nelder-Mead search over depth and slant. Raises UnusableInput where nothing matches.
    """
    if problem := check_quadrilateral(corners, rig.left.image_size):
        raise UnusableInput(f"the outline {problem}")
    samples = _sample_grid(corners)
    rays = rig.left.rays(samples)
    texture = _standardized(_sample_image(image, samples))
    middle = rig.left.rays(corners.mean(axis=0))
    facing = np.array([middle[0], 0.0, 1.0]) if normal is None else normal
    facing = facing / (facing @ middle)

    def correlation(plane: Array) -> float:  # plane · r is the inverse depth along the ray r
        w = rays @ plane
        if (w <= 0).any():
            return -1.0
        return float(texture @ _standardized(_sample_image(other_image, _project_to_other_view(rig, rays, w)))) / len(
            texture
        )

    depths = inverse_depths(rig)
    scores = np.array([correlation(w * facing) for w in depths])
    best = int(np.argmax(scores))
    if scores[best] < MIN_CORRELATION:
        raise UnusableInput("nothing in the other view matches it; outline it there by hand")
    width = max(float(np.ptp(corners[:, 0])), 8.0)
    disparity = depths * rig.left.K[0, 0] * rig.baseline
    other_peaks = np.abs(disparity - disparity[best]) > 0.5 * width
    if other_peaks.any() and scores[other_peaks].max() > max(MAX_SECOND_PEAK_RATIO * scores[best], MIN_CORRELATION):
        raise UnusableInput("several places in the other view match it equally well; outline it there by hand")
    start = depths[best] * facing
    spread = np.diag([0.15, 0.15, 0.02]) * depths[best]
    simplex = start + np.vstack([np.zeros(3), spread])
    options = {"initial_simplex": simplex, "maxfev": 240}
    fit = minimize(lambda x: -correlation(x), start, method="Nelder-Mead", options=options)
    plane = fit.x if -fit.fun > scores[best] else start
    pixels = _project_to_other_view(rig, rig.left.rays(corners), rig.left.rays(corners) @ plane)
    if check_quadrilateral(pixels, rig.right.image_size):
        raise UnusableInput("it lies outside the other view")
    return Proposal(pixels, correlation(plane))


def propose_line(
    rig: StereoRig, image: Image, other_image: Image, drawn: Array, shape: Literal["line", "curve"]
) -> Proposal:
    """Finds the road line ``drawn`` (N, 2) in the rig's left ideal image in the right one.

    Along a straight line in space the inverse depth is linear in its image. So inverse depths are chosen at the ends of
    all straight pieces at once, by dynamic programming, for the highest correlation of small patches along them.
    Raises UnusableInput.
    """
    knots = drawn[[0, -1]] if shape == "line" else drawn
    pieces = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    if len(knots) < 2 or pieces.sum() < 2 * PATCH_RADIUS_PX:
        raise UnusableInput("the line is too short to be found in the other view; draw it there by hand")
    depths = inverse_depths(rig)[::2]
    depths = depths[depths < 0.34]  # no road is nearer than 3 m
    if len(depths) > 400:
        depths = depths[:: len(depths) // 400 + 1]
    total, score = np.zeros(len(depths)), 0
    back: list[NDArray[np.int64]] = []
    for a, b, length in zip(knots[:-1], knots[1:], pieces, strict=True):
        count = int(np.clip(MAX_LINE_SAMPLES * length / pieces.sum(), 3, MAX_LINE_SAMPLES))
        share = (np.arange(count) + 0.5) / count
        correlations = np.stack(
            [_patch_correlations(rig, image, other_image, (1 - t) * a + t * b, depths) for t in share]
        )
        gain = np.zeros((len(depths), len(depths)))  # from the depth at a, over that at b
        i, j = np.arange(len(depths))[:, None], np.arange(len(depths))[None, :]
        for t, row in zip(share, correlations, strict=True):
            gain += row[np.rint((1 - t) * i + t * j).astype(int)]
        total_with_step = total[:, None] + gain
        back.append(np.argmax(total_with_step, axis=0))
        total, score = total_with_step.max(axis=0), score + count
    indices = [int(np.argmax(total))]
    for step in reversed(back):
        indices.append(int(step[indices[-1]]))
    correlation = float(total.max()) / score
    if correlation < MIN_CORRELATION:
        raise UnusableInput("nothing in the other view matches it; draw it there by hand")
    knot_depths = depths[indices[::-1]]
    along = np.concatenate([[0.0], np.cumsum(pieces)])
    places = _positions_along(drawn, knots) if shape == "line" else along
    w = np.interp(places, along, knot_depths)
    return Proposal(_project_to_other_view(rig, rig.left.rays(drawn), w), correlation)


def _positions_along(points: Array, ends: Array) -> Array:
    """Positions (N,) of ``points`` (N, 2) along the straight line between ``ends`` (2, 2), px."""
    d = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    return np.asarray((points - ends[0]) @ d)


def _patch_correlations(rig: StereoRig, image: Image, other_image: Image, pixel: Array, depths: Array) -> Array:
    """Correlations (M,) of the patch about ``pixel`` with the other view at inverse ``depths`` (M,)."""
    u = np.arange(-PATCH_RADIUS_PX, PATCH_RADIUS_PX + 1.0)
    patch = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    texture = _standardized(_sample_image(image, pixel + patch))
    centres = _project_to_other_view(rig, np.repeat(rig.left.rays(pixel)[None], len(depths), axis=0), depths)
    zoom = rig.right.K[0, 0] / rig.left.K[0, 0]
    patches = _sample_image(other_image, centres[:, None] + zoom * patch)
    return np.asarray(_standardized(patches) @ texture) / len(patch)


def _sample_grid(corners: Array) -> Array:
    """Pixels (S, 2) inside the outline, without a rim that may show the background."""
    size = np.ptp(corners, axis=0)
    counts = np.clip(np.rint(size * min(MAX_GRID_SAMPLES / size.max(), 1.0)), 6, MAX_GRID_SAMPLES).astype(int)
    u, v = (0.06 + 0.88 * (np.arange(n) + 0.5) / n for n in counts)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    H = cv2.getPerspectiveTransform(unit, corners.astype(np.float32))
    places = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    return np.asarray(cv2.perspectiveTransform(places, H), float).reshape(-1, 2)


def _project_to_other_view(rig: StereoRig, rays: Array, inverse: Array) -> Array:
    """Ideal pixels (S, 2) in the other view of points at ``inverse`` depths (S,) along the left ``rays`` (S, 3)."""
    p = (rays @ rig.R.T + inverse[:, None] * rig.t) @ rig.right.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(p[:, :2] / p[:, 2:3])


def _sample_image(image: Image, pixels: Array) -> Array:
    """Intensities (…) at ``pixels`` (…, 2); the image's edge repeats outside it."""
    places = np.nan_to_num(pixels, nan=-1e4, posinf=1e4, neginf=-1e4).astype(np.float32)
    strips = np.split(places.reshape(-1, 1, 2), range(MAX_REMAP_ROWS, places.size // 2, MAX_REMAP_ROWS))
    edge = cv2.BORDER_REPLICATE
    rows = [cv2.remap(image, s[..., 0], s[..., 1], cv2.INTER_LINEAR, borderMode=edge) for s in strips]
    return np.concatenate(rows).reshape(places.shape[:-1]).astype(float)


def _standardized(values: Array) -> Array:
    """``values`` (…, S) scaled to mean 0 and mean square 1; zeros where there is no contrast."""
    centred = values - values.mean(axis=-1, keepdims=True)
    spread = centred.std(axis=-1, keepdims=True)
    return np.asarray(centred / np.where(spread > 0.5, spread, np.inf))
