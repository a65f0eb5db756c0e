"""The loops over the target's picture, compiled by Numba."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from paceline.follow.motion import solved, triangularise

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

UNLIKE, ALIKE = 0.2, 0.8  # correlation of a square from which, and at which fully, it has a say in the alignment
STRIDE = 1.5  # samples by which one step may move the picture
CORRELATED = 1.5  # neighbouring samples do not err independently: so much greater is the variance
CONTRAST = 4.0  # at most by so much are two squares' contrasts made equal
STILL = 0.02  # samples: a step that moves no corner by more is the last one


@njit(cache=True, nogil=True)
def sample(image: Bytes, x0: float, y0: float, dx: float, dy: float, out: Floats) -> int:
    """``out`` (h, w): ``image`` interpolated at x0 + dx·column, y0 + dy·row; returns how many samples lie inside, the
    others repeat the border."""
    h, w = image.shape
    inside = 0
    for r in range(out.shape[0]):
        y = y0 + dy * r
        for c in range(out.shape[1]):
            x = x0 + dx * c
            if 0.0 <= x <= w - 1 and 0.0 <= y <= h - 1:
                inside += 1
            px, py = min(max(x, 0.0), w - 1.001), min(max(y, 0.0), h - 1.001)
            i, j = int(px), int(py)
            fx, fy = px - i, py - j
            top = image[j, i] + fx * (np.float64(image[j, i + 1]) - image[j, i])
            low = image[j + 1, i] + fx * (np.float64(image[j + 1, i + 1]) - image[j + 1, i])
            out[r, c] = top + fy * (low - top)
    return inside


@njit(cache=True, nogil=True)
def _moments(a: Floats, b: Floats, x0: int, y0: int, cell: int) -> tuple[float, float, float, float, float]:
    """Means of ``a`` and ``b`` in one square of ``cell`` samples, their variances and their covariance."""
    n = float(cell * cell)
    sa = sb = saa = sbb = sab = 0.0
    for j in range(y0, y0 + cell):
        for i in range(x0, x0 + cell):
            u, v = float(a[j, i]), float(b[j, i])
            sa += u
            sb += v
            saa += u * u
            sbb += v * v
            sab += u * v
    return sa / n, sb / n, saa / n - (sa / n) ** 2, sbb / n - (sb / n) ** 2, sab / n - sa * sb / (n * n)


@njit(cache=True, nogil=True)
def likeness(a: Floats, b: Floats, cell: int, least: float, share: float, neutral: float, out: Array) -> float:
    """The mean of the highest ``share`` of the correlations of ``a`` and ``b`` (h, w) in squares of ``cell`` samples.

    Squares in which ``b`` has a standard deviation below ``least`` are left out; ``neutral`` where there is no other.
    ``out`` is scratch.
    """
    count = 0
    for y in range(0, a.shape[0] - cell + 1, cell):
        for x in range(0, a.shape[1] - cell + 1, cell):
            _, _, va, vb, together = _moments(a, b, x, y, cell)
            if vb < least * least:
                continue
            out[count] = together / np.sqrt(max(va, 0.25 * least * least) * vb)
            count += 1
    if count == 0:
        return neutral
    best = max(1, round(share * count))
    return float(np.sort(out[:count])[count - best :].mean())


@njit(cache=True, nogil=True)
def align(
    image: Bytes,
    picture: Floats,
    box: Array,
    location: Array,
    magnification: Array,
    steady: float,
    steps: int,
    cell: int,
    least: float,
    border: int,
    seen: Floats,
    covariance: Array,
) -> bool:
    """Move ``location`` (3,), c_x, c_y, scale, until ``image`` shows there what ``picture`` (h, w) shows.

    Gauss-Newton on the differences in brightness, each square of ``cell`` samples freed of its own brightness and
    contrast and counted by its correlation. ``box`` (4,) m is what the picture covers, ``magnification`` (2,) px per
    metre at scale 1, ``steady`` the relative standard deviation of the scale it starts with. What is
    less than ``border`` samples from its edge, at least one, is left out. ``seen`` (h, w) is
    scratch; ``covariance`` (3, 3) receives that of the location. False where nothing could be aligned.
    """
    h, w = picture.shape
    scale0 = location[2]
    rows = np.zeros((3, 4))
    normal = np.zeros((3, 3))
    variance = 0.0
    for _ in range(steps):
        mx, my = location[2] * magnification[0], location[2] * magnification[1]
        dx, dy = (box[2] - box[0]) * mx / w, (box[3] - box[1]) * my / h
        sample(image, location[0] + box[0] * mx + 0.5 * dx, location[1] + box[1] * my + 0.5 * dy, dx, dy, seen)
        normal[:] = 0.0
        right = np.zeros(3)
        squares, count = 0.0, 0.0
        for y0 in range(0, h - cell + 1, cell):
            for x0 in range(0, w - cell + 1, cell):
                mean, usual, va, vb, together = _moments(seen, picture, x0, y0, cell)
                va = max(va, 1e-3)
                if vb < least * least:
                    continue
                weight = min(together / np.sqrt(va * vb), ALIKE) - UNLIKE
                if weight <= 0.0:
                    continue
                gain = min(np.sqrt(vb / va), CONTRAST)
                weight /= vb  # all squares alike, whatever their contrast
                for j in range(max(y0, border), min(y0 + cell, h - border)):
                    v = (box[1] + (j + 0.5) * (box[3] - box[1]) / h) * magnification[1] * location[2]
                    for i in range(max(x0, border), min(x0 + cell, w - border)):
                        u = (box[0] + (i + 0.5) * (box[2] - box[0]) / w) * magnification[0] * location[2]
                        gx = gain * 0.5 * (float(seen[j, i + 1]) - float(seen[j, i - 1])) / dx
                        gy = gain * 0.5 * (float(seen[j + 1, i]) - float(seen[j - 1, i])) / dy
                        gs = gx * u + gy * v
                        r = (float(picture[j, i]) - usual) - gain * (float(seen[j, i]) - mean)
                        normal[0, 0] += weight * gx * gx
                        normal[0, 1] += weight * gx * gy
                        normal[0, 2] += weight * gx * gs
                        normal[1, 1] += weight * gy * gy
                        normal[1, 2] += weight * gy * gs
                        normal[2, 2] += weight * gs * gs
                        right[0] += weight * gx * r
                        right[1] += weight * gy * r
                        right[2] += weight * gs * r
                        squares += weight * r * r
                        count += weight * vb
        if count <= 0.0:
            return False
        variance = CORRELATED * max(squares / count, 1e-4)  # of a sample, in units of its square's own variance
        normal[2, 2] += variance / (steady * steady)
        right[2] -= variance / (steady * steady) * np.log(location[2] / scale0)
        for p in range(3):
            for q in range(3):
                rows[p, q] = normal[min(p, q), max(p, q)]
            rows[p, 3] = right[p]
        triangularise(rows)
        if min(abs(rows[0, 0]), abs(rows[1, 1]), abs(rows[2, 2])) < 1e-9:
            return False
        step = solved(rows)
        location[0] += min(max(step[0], -STRIDE * dx), STRIDE * dx)
        location[1] += min(max(step[1], -STRIDE * dy), STRIDE * dy)
        location[2] *= np.exp(min(max(step[2], -0.05), 0.05))
        if abs(step[0]) < STILL * dx and abs(step[1]) < STILL * dy and abs(step[2]) * max(h, w) < 2.0 * STILL:
            break
    for p in range(3):  # the inverse of the normal matrix, a column at a time
        rows[:3, 3] = 0.0
        for q in range(3):
            for k in range(3):
                rows[q, k] = normal[min(q, k), max(q, k)]
        rows[p, 3] = 1.0
        triangularise(rows)
        covariance[:, p] = variance * solved(rows)
    covariance[2] *= location[2]
    covariance[:, 2] *= location[2]
    return True
