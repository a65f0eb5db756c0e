"""The image cues of the multimodal tracker: grey levels, edges and depth inside a particle's box.

After R. Muñoz-Salinas, M. García-Silvente, R. Medina Carnicer, "Adaptive multi-modal stereo people tracking without
background modelling", J. Vis. Commun. Image Represent. 19(2), 2008. Theirs are histograms of colour; recordings here
are grey, and so are the histograms.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image

Picture = NDArray[np.floating]

HISTOGRAM_BINS = 16
SAMPLES_ACROSS, SAMPLES_DOWN = 24, 12  # grid of samples inside a box
SAMPLES_PER_SIDE = 24  # samples on each side of a box


def _bilinear(u: Array, v: Array) -> Array:
    """Shares (n, 4) of the corners tl, tr, br, bl in places (u, v) of a box."""
    return np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)


_U, _V = (
    x.ravel()
    for x in np.meshgrid(
        (np.arange(SAMPLES_ACROSS) + 0.5) / SAMPLES_ACROSS, (np.arange(SAMPLES_DOWN) + 0.5) / SAMPLES_DOWN
    )
)
CORNER_SHARES = _bilinear(_U, _V)
EPANECHNIKOV_WEIGHTS = np.maximum(
    1 - 0.5 * ((2 * _U - 1) ** 2 + (2 * _V - 1) ** 2), 0.0
)  # Epanechnikov's, over the whole box
EPANECHNIKOV_WEIGHTS /= EPANECHNIKOV_WEIGHTS.sum()


def sample_points(boxes: Array) -> Array:
    """Sample places (N, n, 2) inside ``boxes`` (N, 4, 2)."""
    return np.asarray(np.einsum("nc,bcd->bnd", CORNER_SHARES, boxes))


def sample_nearest(picture: Picture, places: Array) -> Array:
    """The pixels (…) of ``picture`` (H, W) nearest to ``places`` (…, 2), NaN outside it."""
    x, y = (np.rint(places[..., i]).astype(np.int64) for i in (0, 1))
    height, width = picture.shape
    within = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    values = picture[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return np.where(within, values, np.nan)


def histograms(greys: Array) -> Array:
    """Normalised histograms (N, HISTOGRAM_BINS) of ``greys`` (N, n), 0–255, with Epanechnikov weights."""
    N = len(greys)
    known = np.isfinite(greys)
    bins = np.clip(np.where(known, greys, 0.0) * (HISTOGRAM_BINS / 256), 0, HISTOGRAM_BINS - 1).astype(np.int64)
    index = np.arange(N)[:, None] * HISTOGRAM_BINS + bins
    weights = np.where(known, EPANECHNIKOV_WEIGHTS, 0.0)
    counts = np.bincount(index.ravel(), weights.ravel(), N * HISTOGRAM_BINS).reshape(N, HISTOGRAM_BINS)
    return np.asarray(counts / np.maximum(counts.sum(1, keepdims=True), 1e-12))


def bhattacharyya(histogram: Array, reference: Array) -> Array:
    """Bhattacharyya coefficients (N,), 0 … 1, of each ``histogram`` (N, HISTOGRAM_BINS) with the ``reference``."""
    return np.asarray(np.sqrt(histogram * reference).sum(-1))


def image_gradients(grey: Image) -> Array:
    """∂I/∂x and ∂I/∂y (2, H, W) of an image, by the Sobel operator."""
    return np.stack([cv2.Sobel(grey, cv2.CV_32F, *order) / 8 for order in ((1, 0), (0, 1))]).astype(float)


def edge_strengths(gradient: Array, boxes: Array) -> Array:
    """Mean size (N,) of the ``gradient`` (2, H, W) across the sides of ``boxes`` (N, 4, 2) (Birchfield 1998)."""
    t = (np.arange(SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE
    start, end = boxes, np.roll(boxes, -1, axis=1)
    side = end - start
    places = start[:, :, None] + t[:, None] * side[:, :, None]
    normal = np.stack([side[..., 1], -side[..., 0]], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    across = sum(sample_nearest(gradient[i], places) * normal[:, :, None, i] for i in (0, 1))
    return np.asarray(np.nan_to_num(np.abs(across)).mean((1, 2)))


def mean_of_finite(values: Array) -> tuple[Array, Array]:
    """The mean (N,) of the finite ``values`` (N, n), 0 where there are none, and their share (N,)."""
    known = np.isfinite(values)
    count = known.sum(1)
    return np.where(known, values, 0.0).sum(1) / np.maximum(count, 1), count / values.shape[1]
