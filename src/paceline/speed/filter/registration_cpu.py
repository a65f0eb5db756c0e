"""The sums over samples that registration needs, compiled by Numba.

A part's samples take several short loops over scratch rows instead of one long one: apart from the gather they all
become vector instructions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.numba_cache import cached_njit

# Sums may be reordered to become vectors; NaN stays NaN, for places behind the camera can give one.
SUM_FASTMATH = {"reassoc", "contract", "arcp", "nsz"}


@cached_njit(nogil=True, error_model="numpy")
def image_gradient(texture: Array, pixels: Array, neighbours: NDArray[np.int64], slopes: Array) -> None:
    """Into ``slopes`` (2, samples): ∂I/∂x and ∂I/∂y of a ``texture`` (samples,) seen at ``pixels`` (2, samples), from
    the differences between each sample's ``neighbours`` (4, samples): left, right, above and below."""
    for s in range(len(texture)):
        left, right, above, below = neighbours[:, s]
        Tu, Tv = texture[right] - texture[left], texture[below] - texture[above]
        xu, xv = pixels[0, right] - pixels[0, left], pixels[0, below] - pixels[0, above]
        yu, yv = pixels[1, right] - pixels[1, left], pixels[1, below] - pixels[1, above]
        det = xu * yv - yu * xv
        slopes[0, s] = (Tu * yv - Tv * yu) / det
        slopes[1, s] = (Tv * xu - Tu * xv) / det


@cached_njit(nogil=True, fastmath=SUM_FASTMATH, error_model="numpy")
def part_products(
    image: NDArray[np.float32],
    K: Array,
    points: Array,
    shift: Array,
    directions: Array,
    axis: Array,
    pivot: Array,
    texture: Array,
    slopes: Array,
    sampled: Array,
    JJ: Array,
    JT: Array,
    JI: Array,
    TI: Array,
    II: Array,
) -> None:
    """Inner products, part by part, of one view's image I, the texture T and the sensitivities J to k parameters.

    All three are freed of their mean over the part. ``image`` (H, W); ``K`` (3, 3) to its pixels; ``points``
    (3, parts, samples) moved by ``shift`` (3,), all in the camera's frame. The parameters are shifts in the columns of
    ``directions`` (3, …) and, if there is one more, an angle about the ``axis`` (3,) through ``pivot`` (3,). Zero-mean
    ``texture`` (parts, samples), its ``slopes`` in the image (2, parts, samples). Writes what is ``sampled``
    (parts, samples), ``JJ`` (parts, k, k), ``JT`` and ``JI`` (parts, k), ``TI`` and ``II`` (parts,).
    """
    parts, samples = texture.shape
    k, shifts = JT.shape[1], directions.shape[1]
    flat, width = image.reshape(-1), np.int32(image.shape[1])
    right, bottom = image.shape[1] - 1.001, image.shape[0] - 1.001
    index = np.empty(samples, np.int32)
    fx, fy, a, b, c, value = np.empty((6, samples))
    J = np.empty((k, samples))
    for p in range(parts):
        for s in range(samples):
            X, Y, Z = points[0, p, s] + shift[0], points[1, p, s] + shift[1], points[2, p, s] + shift[2]
            x, y = K[0, 0] * X / Z + K[0, 2], K[1, 1] * Y / Z + K[1, 2]
            x, y = x if x > 0.0 else 0.0, y if y > 0.0 else 0.0
            x, y = x if x < right else right, y if y < bottom else bottom
            ix, iy = np.int32(x), np.int32(y)
            index[s] = iy * width + ix
            fx[s], fy[s] = x - ix, y - iy
            a[s], b[s] = slopes[0, p, s] * K[0, 0] / Z, slopes[1, p, s] * K[1, 1] / Z
            c[s] = -(a[s] * X + b[s] * Y) / Z
        for s in range(samples):
            i = index[s]
            top = flat[i] + fx[s] * (flat[i + 1] - flat[i])
            low = flat[i + width] + fx[s] * (flat[i + width + 1] - flat[i + width])
            sampled[p, s] = top + fy[s] * (low - top)
        brightness = 0.0
        for s in range(samples):
            brightness += sampled[p, s]
        brightness /= samples
        for s in range(samples):
            value[s] = sampled[p, s] - brightness
        TI[p] = _inner(texture[p], value)
        II[p] = _inner(value, value)
        for i in range(k):
            mean = 0.0
            for s in range(samples):
                if i < shifts:
                    J[i, s] = a[s] * directions[0, i] + b[s] * directions[1, i] + c[s] * directions[2, i]
                else:
                    X, Y, Z = points[0, p, s] - pivot[0], points[1, p, s] - pivot[1], points[2, p, s] - pivot[2]
                    J[i, s] = a[s] * (axis[1] * Z - axis[2] * Y) + b[s] * (axis[2] * X - axis[0] * Z)
                    J[i, s] += c[s] * (axis[0] * Y - axis[1] * X)
                mean += J[i, s]
            mean /= samples
            for s in range(samples):
                J[i, s] -= mean
            JT[p, i] = _inner(J[i], texture[p])
            JI[p, i] = _inner(J[i], value)
            for j in range(i + 1):
                JJ[p, i, j] = JJ[p, j, i] = _inner(J[i], J[j])


@cached_njit(nogil=True, fastmath=SUM_FASTMATH)
def _inner(a: Array, b: Array) -> float:
    total = 0.0
    for s in range(a.shape[0]):
        total += a[s] * b[s]
    return total


@cached_njit(nogil=True, error_model="numpy")
def normal_equations(
    JJ: Array,
    JT: Array,
    JI: Array,
    TT: Array,
    TI: Array,
    II: Array,
    samples: int,
    gains: tuple[float, float],
    quantisation: float,
    w: Array,
    normal: Array,
    scores: Array,
) -> None:
    """Gain, weights and normal equations from the products of `part_products` in all views.

    ``JJ`` (views, parts, k, k), ``JT`` and ``JI`` (views, parts, k), ``TT`` (parts,), ``TI`` and ``II``
    (views, parts); ``gains`` the least and the greatest; ``quantisation`` the least noise, grey levels². Updates the
    weights ``w`` (views, parts), and writes ``normal`` (k, k) and the parts' ``scores`` (views, parts, k).
    """
    views, parts, k = JT.shape
    variance, along = np.empty(parts), np.empty(k)
    normal[:] = 0.0
    for v in range(views):
        product, square = 0.0, 0.0  # in loops: NumPy's sums take seconds to compile
        for p in range(parts):
            product += w[v, p] * TI[v, p]
            square += w[v, p] * TT[p]
        gain = min(max(product / (square + 1e-9), gains[0]), gains[1])
        for p in range(parts):
            variance[p] = max(II[v, p] / gain**2 - 2 * TI[v, p] / gain + TT[p], 0.0) / samples
        median_variance = np.median(variance)
        contrast = 0.0
        along[:] = 0.0
        for p in range(parts):
            w[v, p] = 1.0 / (variance[p] + 0.5 * median_variance + quantisation)
            contrast += w[v, p] * TT[p]
            along += w[v, p] * JT[v, p]
        # the gain is common to the view: what it explains is taken from the sensitivities
        along /= contrast + 1e-9
        for p in range(parts):
            misfit = TI[v, p] / gain - TT[p]
            for i in range(k):
                scores[v, p, i] = w[v, p] * (JI[v, p, i] / gain - JT[v, p, i] - along[i] * misfit)
                for j in range(k):
                    normal[i, j] += w[v, p] * JJ[v, p, i, j]
        for i in range(k):
            for j in range(k):
                normal[i, j] -= contrast * along[i] * along[j]
