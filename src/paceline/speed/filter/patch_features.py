"""Scalar functions of the patch features, in plain Python that Numba compiles for the CPU and the GPU.

Scalars in, scalars out; a few take small arrays. `patch_features_cpu` compiles them with ``numba.njit``,
`cuda.patch_features` with ``numba.cuda.jit(device=True)``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

CORRELATION_ROW_STEP = 4  # the cross-view correlation uses every fourth row of samples
MIN_OVERLAP = 0.25  # share of the region that must lie in both views for a correlation


def sampling_bounds(shape, left, top):
    """Least and greatest x and y at which a packed image can be sampled, its width, and its first pixel's index."""
    height, width = shape
    x, y = np.float32(left), np.float32(top)
    right = x + np.float32(width) - np.float32(1.001)
    bottom = y + np.float32(height) - np.float32(1.001)
    return x, right, y, bottom, np.int32(width), np.int32(top * width + left)


def sample_centre(i, step):
    """Coordinate in the unit square of the ``i``-th of samples that are ``step`` apart."""
    return (np.float32(i) + np.float32(0.5)) * step


def row_terms(h0, h1, h2, v):
    """A row (h0, h1, h2) of a homography at the row ``v`` of the unit square: its slope along the row and its start."""
    return h0, h1 * v + h2


def clamp(x, minimum, maximum):
    """``x``, no less than ``minimum`` and no more than ``maximum``."""
    return min(max(x, minimum), maximum)


def inside(e, x, y):
    """1 where (x, y) lies on the inner side of all edges ``e`` (4, 3), else 0."""
    nearest = min(
        min(e[0, 0] * x + e[0, 1] * y + e[0, 2], e[1, 0] * x + e[1, 1] * y + e[1, 2]),
        min(e[2, 0] * x + e[2, 1] * y + e[2, 2], e[3, 0] * x + e[3, 1] * y + e[3, 2]),
    )
    return np.float32(1.0) if nearest >= np.float32(0.0) else np.float32(0.0)


def correlation(s: Any, min_samples: Any) -> Any:
    """The normalised cross-correlation (17) by the sums ``s`` = Σ1, Σa, Σb, Σaa, Σbb, Σab; −1 for less than
    ``min_samples`` samples."""
    if s[0] < min_samples:
        return np.float32(-1.0)
    aa, bb, ab = s[3] - s[1] * s[1] / s[0], s[4] - s[2] * s[2] / s[0], s[5] - s[1] * s[2] / s[0]
    least_variance = np.float32(0.1) * s[0]
    return ab / math.sqrt(max(aa, least_variance) * max(bb, least_variance))


def interpolate(neighbourhood, fx, fy):
    """Bilinear value at fractions (fx, fy) within a 2×2 neighbourhood packed in one uint32.

    Byte 0 is pixel (x, y), byte 1 (x + 1, y), byte 2 (x, y + 1), byte 3 (x + 1, y + 1). All in 32 bits: wider
    intermediates would halve the vector width.
    """
    a = np.float32(np.int32(neighbourhood & np.uint32(255)))
    b = np.float32(np.int32((neighbourhood >> np.uint32(8)) & np.uint32(255)))
    c = np.float32(np.int32((neighbourhood >> np.uint32(16)) & np.uint32(255)))
    d = np.float32(np.int32(neighbourhood >> np.uint32(24)))
    top = a + fx * (b - a)
    return top + fy * (c + fx * (d - c) - top)


def haar_average(a, b, c, d):
    """Scaling coefficient of the orthonormal 2×2 Haar transform; the pixels are a b over c d."""
    return (a + b + c + d) / 2


def haar_left_right(a, b, c, d):
    """Left minus right."""
    return (a - b + c - d) / 2


def haar_up_down(a, b, c, d):
    """Up minus down."""
    return (a + b - c - d) / 2


def haar_diagonal(a, b, c, d):
    """One diagonal minus the other."""
    return (a - b - c + d) / 2
