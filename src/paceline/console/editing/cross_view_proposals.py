"""What is drawn in one view, proposed for the other: by how alike the pictures are over all distances."""

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

NEAREST, FARTHEST = 2.0, 400.0  # m, of what is looked for
ALIKE = 0.6  # correlation from which on a match is offered
RIVAL = 0.92  # a second place as alike as this share of the best one makes a match doubtful
FINEST = 40  # samples along the longer side of a patch
PATCH = 7  # px: half the size of a line's patches
LINE_SAMPLES = 48
MOST_ROWS = 32000  # of a picture that OpenCV resamples at once


@dataclass(frozen=True, eq=False)
class Proposal:
    """``pixels`` (N, 2), ideal ones of the other view, and how alike the two views are there, −1 … 1."""

    pixels: Array
    alike: float


def turned(rig: StereoRig) -> StereoRig:
    """The same pair with its views exchanged."""
    return StereoRig(rig.right, rig.left, rig.R.T, -rig.R.T @ rig.t)


def inverse_depths(rig: StereoRig) -> Array:
    """Inverse distances (M,), 1/m, that move a point by at most half a pixel from one to the next."""
    step = 0.5 / (max(rig.left.K[0, 0], rig.right.K[0, 0]) * rig.baseline)
    return np.linspace(1 / FARTHEST, 1 / NEAREST, int(np.clip((1 / NEAREST - 1 / FARTHEST) / step, 64, 6000)))


def propose_quadrilateral(
    rig: StereoRig, here: Image, there: Image, corners: Array, normal: Array | None = None
) -> Proposal:
    """Where the flat outline ``corners`` (4, 2) of one ideal picture, the rig's left one, is in the other.

    The plane's distance is found over all of them with the plane upright and facing the camera, or along ``normal``
    (3,) where a path gives it; then distance and slant together. Raises UnusableInput where nothing matches.
    """
    if wrong := check_quadrilateral(corners, rig.left.image_size):
        raise UnusableInput(f"the outline {wrong}")
    samples = _grid(corners)
    rays = rig.left.rays(samples)
    texture = _standardised(_sampled(here, samples))
    middle = rig.left.rays(corners.mean(axis=0))
    facing = np.array([middle[0], 0.0, 1.0]) if normal is None else normal
    facing = facing / (facing @ middle)

    def alike(plane: Array) -> float:  # plane·r is the inverse depth along the ray r
        w = rays @ plane
        if (w <= 0).any():
            return -1.0
        return float(texture @ _standardised(_sampled(there, _seen_at(rig, rays, w)))) / len(texture)

    depths = inverse_depths(rig)
    scores = np.array([alike(w * facing) for w in depths])
    best = int(np.argmax(scores))
    if scores[best] < ALIKE:
        raise UnusableInput("the other view shows nothing like it; outline it there by hand")
    width = max(float(np.ptp(corners[:, 0])), 8.0)
    disparity = depths * rig.left.K[0, 0] * rig.baseline
    away = np.abs(disparity - disparity[best]) > 0.5 * width
    if away.any() and scores[away].max() > max(RIVAL * scores[best], ALIKE):
        raise UnusableInput("several places in the other view look like it; outline it there by hand")
    start = depths[best] * facing
    spread = np.diag([0.15, 0.15, 0.02]) * depths[best]
    simplex = start + np.vstack([np.zeros(3), spread])
    options = {"initial_simplex": simplex, "maxfev": 240}
    fit = minimize(lambda x: -alike(x), start, method="Nelder-Mead", options=options)
    plane = fit.x if -fit.fun > scores[best] else start
    pixels = _seen_at(rig, rig.left.rays(corners), rig.left.rays(corners) @ plane)
    if check_quadrilateral(pixels, rig.right.image_size):
        raise UnusableInput("it lies outside the other view")
    return Proposal(pixels, alike(plane))


def propose_line(rig: StereoRig, here: Image, there: Image, drawn: Array, shape: Literal["line", "curve"]) -> Proposal:
    """Where the road line ``drawn`` (N, 2) in one ideal picture, the rig's left one, is in the other.

    Along a straight line in space the inverse distance is linear in its picture. So it is chosen at the ends of each
    straight piece, all pieces joined, for the best likeness of small patches along them. Raises UnusableInput.
    """
    knots = drawn[[0, -1]] if shape == "line" else drawn
    pieces = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    if len(knots) < 2 or pieces.sum() < 2 * PATCH:
        raise UnusableInput("the line is too short to be found in the other view; draw it there by hand")
    depths = inverse_depths(rig)[::2]
    depths = depths[depths < 0.34]  # a road is not looked for nearer than 3 m
    if len(depths) > 400:
        depths = depths[:: len(depths) // 400 + 1]
    total, score = np.zeros(len(depths)), 0
    back: list[NDArray[np.int64]] = []
    for a, b, length in zip(knots[:-1], knots[1:], pieces, strict=True):
        count = int(np.clip(LINE_SAMPLES * length / pieces.sum(), 3, LINE_SAMPLES))
        share = (np.arange(count) + 0.5) / count
        likeness = np.stack([_likeness(rig, here, there, (1 - t) * a + t * b, depths) for t in share])
        gain = np.zeros((len(depths), len(depths)))  # from the depth at a, over that at b
        i, j = np.arange(len(depths))[:, None], np.arange(len(depths))[None, :]
        for t, row in zip(share, likeness, strict=True):
            gain += row[np.rint((1 - t) * i + t * j).astype(int)]
        reached = total[:, None] + gain
        back.append(np.argmax(reached, axis=0))
        total, score = reached.max(axis=0), score + count
    at = [int(np.argmax(total))]
    for step in reversed(back):
        at.append(int(step[at[-1]]))
    alike = float(total.max()) / score
    if alike < ALIKE:
        raise UnusableInput("the other view shows nothing like it; draw it there by hand")
    knot_depths = depths[at[::-1]]
    along = np.concatenate([[0.0], np.cumsum(pieces)])
    places = _along(drawn, knots) if shape == "line" else along
    w = np.interp(places, along, knot_depths)
    return Proposal(_seen_at(rig, rig.left.rays(drawn), w), alike)


def _along(points: Array, ends: Array) -> Array:
    """Where (N,) along the straight line between ``ends`` (2, 2) the ``points`` (N, 2) lie, px."""
    d = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    return np.asarray((points - ends[0]) @ d)


def _likeness(rig: StereoRig, here: Image, there: Image, pixel: Array, depths: Array) -> Array:
    """Correlation (M,) of the patch about ``pixel`` with the other view at inverse ``depths`` (M,)."""
    u = np.arange(-PATCH, PATCH + 1.0)
    patch = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    texture = _standardised(_sampled(here, pixel + patch))
    centres = _seen_at(rig, np.repeat(rig.left.rays(pixel)[None], len(depths), axis=0), depths)
    zoom = rig.right.K[0, 0] / rig.left.K[0, 0]
    seen = _sampled(there, centres[:, None] + zoom * patch)
    return np.asarray(_standardised(seen) @ texture) / len(patch)


def _grid(corners: Array) -> Array:
    """Pixels (S, 2) inside the outline, a rim left out that shows what is behind."""
    size = np.ptp(corners, axis=0)
    counts = np.clip(np.rint(size * min(FINEST / size.max(), 1.0)), 6, FINEST).astype(int)
    u, v = (0.06 + 0.88 * (np.arange(n) + 0.5) / n for n in counts)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    H = cv2.getPerspectiveTransform(unit, corners.astype(np.float32))
    places = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    return np.asarray(cv2.perspectiveTransform(places, H), float).reshape(-1, 2)


def _seen_at(rig: StereoRig, rays: Array, inverse: Array) -> Array:
    """Ideal pixels (S, 2) of the other view at ``inverse`` distances (S,) along the left view's ``rays`` (S, 3)."""
    p = (rays @ rig.R.T + inverse[:, None] * rig.t) @ rig.right.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(p[:, :2] / p[:, 2:3])


def _sampled(image: Image, pixels: Array) -> Array:
    """Intensities (…) at ``pixels`` (…, 2); the image's edge repeats outside it."""
    places = np.nan_to_num(pixels, nan=-1e4, posinf=1e4, neginf=-1e4).astype(np.float32)
    strips = np.split(places.reshape(-1, 1, 2), range(MOST_ROWS, places.size // 2, MOST_ROWS))
    edge = cv2.BORDER_REPLICATE
    rows = [cv2.remap(image, s[..., 0], s[..., 1], cv2.INTER_LINEAR, borderMode=edge) for s in strips]
    return np.concatenate(rows).reshape(places.shape[:-1]).astype(float)


def _standardised(values: Array) -> Array:
    """``values`` (…, S) with mean 0 and mean square 1; without contrast, zeros."""
    centred = values - values.mean(axis=-1, keepdims=True)
    spread = centred.std(axis=-1, keepdims=True)
    return np.asarray(centred / np.where(spread > 0.5, spread, np.inf))
