"""The loops of the search for the whole model, compiled by Numba."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Bytes, Floats, Indices, Mask
from paceline.follow.edges_cpu import gradient_row
from paceline.numba_cache import cached_njit

FULL = 1.1  # evidence along a clear line: none counts for more in a survey
TOLD = 0.3  # share of its own strength that a feature's learned evidence must keep to tell which side is brighter


@cached_njit(nogil=True, error_model="numpy")
def pool(image: Bytes, x0: int, y0: int, side: int, out: Bytes) -> None:
    """``out`` (h, w): means of ``side`` × ``side`` squares of ``image``, the first of which begins at x0, y0."""
    h, w = out.shape
    if side == 1:
        for y in range(h):
            source, here = image[y0 + y, x0 : x0 + w], out[y]
            for x in range(w):
                here[x] = source[x]
        return
    n = side * side
    sums = np.empty(w * side, np.uint32)
    for y in range(h):
        sums[:] = 0
        for row in range(side):
            source = image[y0 + y * side + row, x0 : x0 + w * side]
            for x in range(w * side):
                sums[x] += source[x]
        for x in range(w):
            total = np.uint32(n // 2)
            for column in range(side):
                total += sums[x * side + column]
            out[y, x] = total // n


@cached_njit(nogil=True, fastmath=True, error_model="numpy")
def evidence(image: Bytes, soft: float, gx: Floats, gy: Floats, vertical: Floats, horizontal: Floats) -> None:
    """How much each pixel of ``image`` (h, w) looks like an edge, −1 to 1 by the sign of the step, in running sums.

    The evidence is the cosine squared of the edge's direction times m/(m + soft) of its magnitude m, so that a strong
    edge counts little more than a clear one. ``vertical`` (h + 1, w) sums it down the columns, ``horizontal``
    (h, w + 1) along the rows. ``gx``, ``gy`` (3, ≥ w) are scratch; ``image`` has five rows and columns or more.
    """
    h, w = image.shape
    n = w - 2
    s = np.float32(soft)
    vertical[:2] = 0.0
    horizontal[0] = 0.0
    horizontal[h - 1] = 0.0
    for first in range(1, h - 1, 3):
        top = min(first, h - 4)
        for r in range(3):
            dx, dy = gx[r, :n], gy[r, :n]
            gradient_row(image, top + r, 1, w - 1, dx, dy)
            for i in range(n):
                squares = dx[i] * dx[i] + dy[i] * dy[i] + np.float32(1e-6)
                m = np.sqrt(squares)
                share = np.float32(1.0) / (m * (m + s))
                dx[i] *= abs(dx[i]) * share
                dy[i] *= abs(dy[i]) * share
            above, here = vertical[top + r], vertical[top + r + 1]
            here[0] = here[w - 1] = 0.0
            for i in range(n):
                here[i + 1] = above[i + 1] + dx[i]
            horizontal[top + r, :2] = 0.0
        # each sum along a row waits for the one before it, but not for those of other rows
        a = b = c = np.float32(0.0)
        for i in range(n):
            a += gy[0, i]
            b += gy[1, i]
            c += gy[2, i]
            horizontal[top, i + 2] = a
            horizontal[top + 1, i + 2] = b
            horizontal[top + 2, i + 2] = c
        horizontal[top, w], horizontal[top + 1, w], horizontal[top + 2, w] = a, b, c
    for x in range(w):  # by element: the check of an array's shape takes seconds to compile
        vertical[h, x] = vertical[h - 1, x]


@cached_njit(nogil=True, error_model="numpy")
def _laid(
    centers: Array, m: float, across: Mask, places: Array, spans: Array, shifts: Array, limit: int, out: Indices
) -> None:
    """Where a model's segments lie along one axis, for each of the ``centers`` (N,) px it may have there.

    ``out`` (N, S, 3) receives the row or column of the segments that are ``across`` (S,) the axis, of the others where
    they begin and end inside 0 … ``limit``, and their whole length. ``m`` is in px per metre.
    """
    for i in range(len(centers)):
        for j in range(len(places)):
            if across[j]:
                out[i, j, 0] = int(np.floor(centers[i] + m * places[j] + shifts[j] + 0.5))
            else:
                a = int(np.floor(centers[i] + m * spans[j, 0] + 0.5))
                b = int(np.floor(centers[i] + m * spans[j, 1] + 0.5)) + 1
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = max(a, 0), min(b, limit), b - a


@cached_njit(nogil=True, error_model="numpy")
def _respond(
    vertical_sums: Floats, horizontal_sums: Floats, vertical: Mask, in_x: Indices, in_y: Indices, out: Array
) -> None:
    """`responses` for a model laid as rows of `_laid` say, ``in_x`` (S, 3) and ``in_y`` (S, 3)."""
    h, w = horizontal_sums.shape[0], vertical_sums.shape[1]
    for j in range(len(vertical)):
        out[j] = 0.0
        if vertical[j]:
            x, a, b, length = in_x[j, 0], in_y[j, 0], in_y[j, 1], in_y[j, 2]
            if 1 <= x < w - 1 and a < b:
                s = vertical_sums[b, x] - vertical_sums[a, x]
                s += 0.5 * (vertical_sums[b, x - 1] - vertical_sums[a, x - 1])
                s += 0.5 * (vertical_sums[b, x + 1] - vertical_sums[a, x + 1])
                out[j] = s / length
        else:
            y, a, b, length = in_y[j, 0], in_x[j, 0], in_x[j, 1], in_x[j, 2]
            if 1 <= y < h - 1 and a < b:
                s = horizontal_sums[y, b] - horizontal_sums[y, a]
                s += 0.5 * (horizontal_sums[y - 1, b] - horizontal_sums[y - 1, a])
                s += 0.5 * (horizontal_sums[y + 1, b] - horizontal_sums[y + 1, a])
                out[j] = s / length


@cached_njit(nogil=True, error_model="numpy")
def responses(
    vertical_sums: Floats,
    horizontal_sums: Floats,
    cx: float,
    cy: float,
    mx: float,
    my: float,
    vertical: Mask,
    places: Array,
    spans: Array,
    shifts: Array,
    out: Array,
) -> None:
    """``out`` (S,): mean evidence along every segment, the mean over one pixel to either side, for a model centred at
    cx, cy with mx, my pixels per metre; 0 where a segment is outside, and what is outside of a segment counts 0."""
    h, w = horizontal_sums.shape[0], vertical_sums.shape[1]
    in_x, in_y = np.empty((1, len(places), 3), np.int64), np.empty((1, len(places), 3), np.int64)
    _laid(np.full(1, cx), mx, vertical, places, spans, shifts, w, in_x)
    _laid(np.full(1, cy), my, ~vertical, places, spans, shifts, h, in_y)
    _respond(vertical_sums, horizontal_sums, vertical, in_x[0], in_y[0], out)


@cached_njit(nogil=True, error_model="numpy")
def likeness(found: Array, signed: Array, strength: Array, weights: Array) -> float:
    """How well the evidence ``found`` (S,) along a model agrees with what was learned: 1 for as strong as usual.

    No feature counts for more than it usually shows, so a strong edge in a wrong place cannot replace the others.
    """
    total = 0.0
    full = 0.0
    for j in range(len(found)):
        usual = strength[j]
        r = abs(found[j])
        if abs(signed[j]) > TOLD * usual:
            r = found[j] if signed[j] > 0 else -found[j]
        total += weights[j] * min(max(r, 0.0), 1.25 * usual)
        full += weights[j] * usual
    return total / full


@cached_njit(nogil=True, error_model="numpy")
def _strike(scores: Array, i: int, j: int, near: int) -> None:
    """Take the places up to ``near`` steps from column ``i`` and row ``j`` off the ``scores`` (ny, nx) of a scale."""
    scores[max(j - near, 0) : j + near + 1, max(i - near, 0) : i + near + 1] = -1.0


@cached_njit(nogil=True, error_model="numpy")
def loss(modesty: float, away: float, away_s: float) -> float:
    """What a place loses that is off the expected one by so many squared standard deviations, ``away`` in the image
    and ``away_s`` in scale: ``modesty`` for one. In the image this levels off, for a bump moves the whole of it, but
    never changes the scale."""
    return modesty * (away_s + away / (1.0 + away / 9.0))


@cached_njit(nogil=True, error_model="numpy")
def scan(
    vertical_sums: Floats,
    horizontal_sums: Floats,
    start: Array,
    expected: Array,
    reach: Indices,
    step: float,
    scales: Array,
    magnification: Array,
    vertical: Mask,
    places: Array,
    spans: Array,
    shifts: Array,
    signed: Array,
    strength: Array,
    weights: Array,
    doubt: Array,
    modesty: float,
    scores: Array,
    best: Array,
) -> int:
    """The highest of all locations about ``start`` (3,): cx, cy, scale.

    ``reach`` (2,) is how many steps of ``step`` px are tried to either side along x and y, ``scales`` (K,) are the
    scales tried. What is ``doubt`` (3,) away from ``expected`` (3,) loses ``modesty``, see `loss`. ``scores``
    (≥ K·(2rx+1)·(2ry+1),) is scratch. ``best`` (B, 4) receives locations and their scores, highest first, no two of
    them neighbours; returns how many.
    """
    nx, ny = 2 * reach[0] + 1, 2 * reach[1] + 1
    found = np.empty(len(places))
    xs, ys = start[0] + (np.arange(nx) - reach[0]) * step, start[1] + (np.arange(ny) - reach[1]) * step
    in_x, in_y = np.empty((nx, len(places), 3), np.int64), np.empty((ny, len(places), 3), np.int64)
    for k in range(len(scales)):
        away_s = ((scales[k] - expected[2]) / doubt[2]) ** 2
        m = scales[k] * magnification
        _laid(xs, m[0], vertical, places, spans, shifts, vertical_sums.shape[1], in_x)
        _laid(ys, m[1], ~vertical, places, spans, shifts, horizontal_sums.shape[0], in_y)
        for j in range(ny):
            away_y = ((ys[j] - expected[1]) / doubt[1]) ** 2
            for i in range(nx):
                away = away_y + ((xs[i] - expected[0]) / doubt[0]) ** 2
                _respond(vertical_sums, horizontal_sums, vertical, in_x[i], in_y[j], found)
                alike = likeness(found, signed, strength, weights)
                scores[(k * ny + j) * nx + i] = alike - loss(modesty, away, away_s)
    n = len(scales) * ny * nx
    count = 0
    while count < len(best):
        top = np.argmax(scores[:n])
        if scores[top] < 0.0:
            break
        i, j, k = top % nx, (top // nx) % ny, top // (nx * ny)
        best[count, 0], best[count, 1], best[count, 2], best[count, 3] = xs[i], ys[j], scales[k], scores[top]
        count += 1
        for kk in range(len(scales)):
            _strike(scores[kk * ny * nx : (kk + 1) * ny * nx].reshape(ny, nx), i, j, 3)
    return count


@cached_njit(nogil=True, error_model="numpy")
def shown(found: Array) -> float:
    """How much of a model of which nothing is learned yet the evidence ``found`` (S,) along it shows: its mean."""
    total = 0.0
    for r in found:
        total += min(abs(r), FULL)
    return total / len(found)


@cached_njit(nogil=True, error_model="numpy")
def survey(
    vertical_sums: Floats,
    horizontal_sums: Floats,
    start: Array,
    reach: Indices,
    step: float,
    scales: Array,
    rung: float,
    magnification: Array,
    vertical: Mask,
    places: Array,
    spans: Array,
    shifts: Array,
    apart: Array,
    scores: Array,
    best: Array,
) -> int:
    """The places that show most of a model of which nothing is learned yet, as rows of ``best`` (B, 4): cx, cy, scale
    and the mean evidence of the features, all of them alike; returns how many.

    ``start`` (2,), ``reach`` (2,), ``step`` and ``scales`` (K,) as in `scan`; the logarithms of these are ``rung``
    apart. Each place is the best within half a step of one of the grid; those of the grid are ``apart`` (2,) from each
    other: px in x and y, and in the logarithm of the scale. ``scores`` (≥ K·(2rx+1)·(2ry+1),) is scratch.
    """
    nx, ny = 2 * reach[0] + 1, 2 * reach[1] + 1
    found = np.empty(len(places))
    xs, ys = start[0] + (np.arange(nx) - reach[0]) * step, start[1] + (np.arange(ny) - reach[1]) * step
    in_x, in_y = np.empty((nx, len(places), 3), np.int64), np.empty((ny, len(places), 3), np.int64)
    for k in range(len(scales)):
        m = scales[k] * magnification
        _laid(xs, m[0], vertical, places, spans, shifts, vertical_sums.shape[1], in_x)
        _laid(ys, m[1], ~vertical, places, spans, shifts, horizontal_sums.shape[0], in_y)
        for j in range(ny):
            for i in range(nx):
                _respond(vertical_sums, horizontal_sums, vertical, in_x[i], in_y[j], found)
                scores[(k * ny + j) * nx + i] = shown(found)
    n = len(scales) * ny * nx
    near = int(np.ceil(apart[0] / step))
    count = 0
    while count < len(best):
        top = np.argmax(scores[:n])
        if scores[top] <= 0.0:
            break
        i, j, k = top % nx, (top // nx) % ny, top // (nx * ny)
        best[count, 3] = -1.0
        for q in range(27):
            x, y = xs[i] + 0.5 * step * (q % 3 - 1), ys[j] + 0.5 * step * (q // 3 % 3 - 1)
            scale = scales[k] * np.exp(0.5 * rung * (q // 9 - 1))
            mx, my = scale * magnification[0], scale * magnification[1]
            responses(vertical_sums, horizontal_sums, x, y, mx, my, vertical, places, spans, shifts, found)
            score = shown(found)
            if score > best[count, 3]:
                best[count] = x, y, scale, score
        count += 1
        for kk in range(len(scales)):
            if abs(np.log(scales[kk] / scales[k])) >= apart[1]:
                continue
            _strike(scores[kk * ny * nx : (kk + 1) * ny * nx].reshape(ny, nx), i, j, near)
    return count
