"""The method's scalar pixel functions, in plain Python that a compiler for any device takes.

Scalars in, scalars out. `pixels_cpu` compiles them with ``numba.njit``.
"""

from __future__ import annotations

import numpy as np


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
