"""The loops over the target's picture, compiled by Numba."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Bytes, Floats
from paceline.follow.motion import solved, triangularise
from paceline.numba_cache import cached_njit

UNLIKE, ALIKE = 0.2, 0.8  # correlation of a square from which, and at which fully, it has a say in the alignment
STRIDE = 1.5  # samples by which one step may move the picture
CORRELATED = 1.5  # neighbouring samples do not err independently: so much greater is the variance
CONTRAST = 4.0  # at most by so much are two squares' contrasts made equal
SUMS = {"reassoc", "contract", "nsz"}  # sums may be taken in another order
STILL = 0.02  # samples: a step that moves no corner by more is the last one


@cached_njit(nogil=True, error_model="numpy")
def sample(image: Bytes, x0: float, y0: float, dx: float, dy: float, out: Floats) -> int:
    """``out`` (h, w): ``image`` interpolated at x0 + dx·column, y0 + dy·row; returns how many samples lie inside, the
    others repeat the border."""
    h, w = image.shape
    n = out.shape[1]
    within = 0
    columns, shares = np.empty(n, np.int64), np.empty(n)
    for c in range(n):
        x = x0 + dx * c
        within += 0.0 <= x <= w - 1
        x = min(max(x, 0.0), w - 1.001)
        columns[c] = int(x)
        shares[c] = x - columns[c]
    inside = 0
    for r in range(out.shape[0]):
        y = y0 + dy * r
        if 0.0 <= y <= h - 1:
            inside += within
        y = min(max(y, 0.0), h - 1.001)
        row = int(y)
        share, upper, lower, seen = y - row, image[row], image[row + 1], out[r]
        for c in range(n):
            i, f = columns[c], shares[c]
            top = upper[i] + f * (np.float64(upper[i + 1]) - upper[i])
            low = lower[i] + f * (np.float64(lower[i + 1]) - lower[i])
            seen[c] = top + share * (low - top)
    return inside


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def _moments(a: Floats, b: Floats, x0: int, y0: int, cell: int) -> tuple[float, float, float, float, float]:
    """Means of ``a`` and ``b`` in one square of ``cell`` samples, their variances and their covariance."""
    n = float(cell * cell)
    sa = sb = saa = sbb = sab = 0.0
    for j in range(y0, y0 + cell):
        row, other = a[j, x0:], b[j, x0:]
        for i in range(cell):
            u, v = float(row[i]), float(other[i])
            sa += u
            sb += v
            saa += u * u
            sbb += v * v
            sab += u * v
    return sa / n, sb / n, saa / n - (sa / n) ** 2, sbb / n - (sb / n) ** 2, sab / n - sa * sb / (n * n)


@cached_njit(nogil=True, error_model="numpy")
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


@cached_njit(nogil=True, fastmath=SUMS, error_model="numpy")
def _products(
    seen: Floats,
    picture: Floats,
    border: int,
    y1: int,
    y2: int,
    weights: Array,
    gains: Array,
    levels: Array,
    left: float,
    top: float,
    dx: float,
    dy: float,
) -> Array:
    """(4, 4): the products of the slopes along c_x, c_y and the logarithm of the scale and of the difference that is
    left, with each other, summed over the rows y1 ≤ y < y2 but for the ``border`` with the ``weights`` (w,).

    ``gains`` (w,) and ``levels`` (w,) make what is ``seen`` (h, w) as bright as the ``picture``. Sample x, y lies
    ``left`` + x·dx, ``top`` + y·dy px from the centre.
    """
    w = seen.shape[1]
    weight, gain, level = weights[border : w - border], gains[border : w - border], levels[border : w - border]
    xx = xy = xs = xr = yy = ys = yr = ss = sr = rr = 0.0
    for y in range(y1, y2):
        v = top + y * dy
        above, below = seen[y - 1, border : w - border], seen[y + 1, border : w - border]
        before, here, after = seen[y, border - 1 :], seen[y, border:], seen[y, border + 1 :]
        wanted = picture[y, border : w - border]
        for i in range(w - 2 * border):
            gx = gain[i] * (0.5 / dx) * (after[i] - before[i])
            gy = gain[i] * (0.5 / dy) * (below[i] - above[i])
            gs = gx * (left + (border + i) * dx) + gy * v
            r = wanted[i] - level[i] - gain[i] * here[i]
            xx += weight[i] * gx * gx
            xy += weight[i] * gx * gy
            xs += weight[i] * gx * gs
            xr += weight[i] * gx * r
            yy += weight[i] * gy * gy
            ys += weight[i] * gy * gs
            yr += weight[i] * gy * r
            ss += weight[i] * gs * gs
            sr += weight[i] * gs * r
            rr += weight[i] * r * r
    return np.array([[xx, xy, xs, xr], [xy, yy, ys, yr], [xs, ys, ss, sr], [xr, yr, sr, rr]])


@cached_njit(nogil=True, error_model="numpy")
def _fill_rows(rows: Array, total: Array) -> None:
    """Copy the first of ``total`` (4, 4) to ``rows`` (3, 4): by element, as the check of an array's shape takes seconds
    to compile."""
    for i in range(3):
        for j in range(4):
            rows[i, j] = total[i, j]


@cached_njit(nogil=True, error_model="numpy")
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
    weights, gains, levels = np.zeros(w), np.zeros(w), np.zeros(w)
    total = np.zeros((4, 4))  # what `_products` sums up, over all squares
    variance = 0.0
    for _ in range(steps):
        mx, my = location[2] * magnification[0], location[2] * magnification[1]
        dx, dy = (box[2] - box[0]) * mx / w, (box[3] - box[1]) * my / h
        left, top = box[0] * mx + 0.5 * dx, box[1] * my + 0.5 * dy
        sample(image, location[0] + left, location[1] + top, dx, dy, seen)
        total[:] = 0.0
        count = 0.0
        for y0 in range(0, h - cell + 1, cell):
            y1, y2 = max(y0, border), min(y0 + cell, h - border)
            weights[:] = 0.0
            for x0 in range(0, w - cell + 1, cell):
                mean, usual, va, vb, together = _moments(seen, picture, x0, y0, cell)
                va = max(va, 1e-3)
                if vb < least * least:
                    continue
                alike = min(together / np.sqrt(va * vb), ALIKE) - UNLIKE
                if alike <= 0.0:
                    continue
                gain = min(np.sqrt(vb / va), CONTRAST)
                gains[x0 : x0 + cell] = gain
                levels[x0 : x0 + cell] = usual - gain * mean
                weights[x0 : x0 + cell] = alike / vb  # all squares alike, whatever their contrast
                count += alike * (y2 - y1) * (min(x0 + cell, w - border) - max(x0, border))
            total += _products(seen, picture, border, y1, y2, weights, gains, levels, left, top, dx, dy)
        if count <= 0.0:
            return False
        variance = CORRELATED * max(total[3, 3] / count, 1e-4)  # of a sample, in units of its square's own variance
        total[2, 2] += variance / (steady * steady)
        total[2, 3] -= variance / (steady * steady) * np.log(location[2] / scale0)
        _fill_rows(rows, total)
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
        _fill_rows(rows, total)
        rows[:, 3] = 0.0
        rows[p, 3] = 1.0
        triangularise(rows)
        column = solved(rows)
        for k in range(3):
            covariance[k, p] = variance * column[k]
    covariance[2] *= location[2]
    covariance[:, 2] *= location[2]
    return bool(covariance[0, 0] > 0.0 and covariance[1, 1] > 0.0 and covariance[2, 2] > 0.0)
