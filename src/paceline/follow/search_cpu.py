"""The loops of the search for the whole model, compiled by Numba."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from paceline.follow.edges_cpu import gradient_row

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

FULL = 1.1  # evidence along a clear line: none counts for more in a survey
TOLD = 0.3  # share of its own strength that a feature's learned evidence must keep to tell which side is brighter


@njit(cache=True, nogil=True)
def pool(image: Bytes, x0: int, y0: int, side: int, out: Bytes) -> None:
    """``out`` (h, w): means of ``side`` × ``side`` squares of ``image``, the first of which begins at x0, y0."""
    half = (side * side) // 2
    sums = np.empty(out.shape[1], np.uint32)
    for y in range(out.shape[0]):
        sums[:] = half
        for row in range(y0 + y * side, y0 + (y + 1) * side):
            source = image[row]
            for x in range(out.shape[1]):
                total = np.uint32(0)
                for column in range(x0 + x * side, x0 + (x + 1) * side):
                    total += np.uint32(source[column])
                sums[x] += total
        for x in range(out.shape[1]):
            out[y, x] = sums[x] // (side * side)


@njit(cache=True, nogil=True, fastmath=True)
def evidence(image: Bytes, soft: float, gx: Floats, gy: Floats, vertical: Floats, horizontal: Floats) -> None:
    """How much each pixel of ``image`` (h, w) looks like an edge, −1 to 1 by the sign of the step, in running sums.

    The evidence is the cosine squared of the edge's direction times m/(m + soft) of its magnitude m, so that a strong
    edge counts little more than a clear one. ``vertical`` (h + 1, w) sums it down the columns, ``horizontal``
    (h, w + 1) along the rows. ``gx``, ``gy`` (3, ≥ w) are scratch.
    """
    h, w = image.shape
    s = np.float32(soft)
    vertical[:2] = 0.0
    horizontal[:] = 0.0
    for y in range(1, h - 1):
        gradient_row(image, y, 1, w - 1, gx[0], gy[0])
        total = np.float32(0.0)
        vertical[y + 1, 0] = 0.0
        vertical[y + 1, w - 1] = 0.0
        for i in range(w - 2):
            dx, dy = gx[0, i], gy[0, i]
            mm = dx * dx + dy * dy + np.float32(1e-6)
            m = np.sqrt(mm)
            share = np.float32(1.0) / (m * (m + s))
            gx[0, i] = dx * abs(dx) * share
            gy[0, i] = dy * abs(dy) * share
        for i in range(w - 2):
            vertical[y + 1, i + 1] = vertical[y, i + 1] + gx[0, i]
        for i in range(w - 2):
            total += gy[0, i]
            horizontal[y, i + 2] = total
        horizontal[y, w] = total
    vertical[h] = vertical[h - 1]


@njit(cache=True, nogil=True)
def responses(
    vertical_sums: Floats,
    horizontal_sums: Floats,
    cx: float,
    cy: float,
    mx: float,
    my: float,
    vertical: NDArray[np.bool_],
    places: Array,
    spans: Array,
    shifts: Array,
    out: Array,
) -> None:
    """``out`` (S,): mean evidence along every segment, the mean over one pixel to either side, for a model centred at
    cx, cy with mx, my pixels per metre; 0 where a segment is outside, and what is outside of a segment counts 0."""
    h, w = horizontal_sums.shape[0], vertical_sums.shape[1]
    for j in range(len(places)):
        out[j] = 0.0
        if vertical[j]:
            x = int(np.floor(cx + mx * places[j] + shifts[j] + 0.5))
            a = int(np.floor(cy + my * spans[j, 0] + 0.5))
            b = int(np.floor(cy + my * spans[j, 1] + 0.5)) + 1
            length = b - a
            a, b = max(a, 0), min(b, h)
            if 1 <= x < w - 1 and a < b:
                s = vertical_sums[b, x] - vertical_sums[a, x]
                s += 0.5 * (vertical_sums[b, x - 1] - vertical_sums[a, x - 1])
                s += 0.5 * (vertical_sums[b, x + 1] - vertical_sums[a, x + 1])
                out[j] = s / length
        else:
            y = int(np.floor(cy + my * places[j] + shifts[j] + 0.5))
            a = int(np.floor(cx + mx * spans[j, 0] + 0.5))
            b = int(np.floor(cx + mx * spans[j, 1] + 0.5)) + 1
            length = b - a
            a, b = max(a, 0), min(b, w)
            if 1 <= y < h - 1 and a < b:
                s = horizontal_sums[y, b] - horizontal_sums[y, a]
                s += 0.5 * (horizontal_sums[y - 1, b] - horizontal_sums[y - 1, a])
                s += 0.5 * (horizontal_sums[y + 1, b] - horizontal_sums[y + 1, a])
                out[j] = s / length


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def scan(
    vertical_sums: Floats,
    horizontal_sums: Floats,
    start: Array,
    expected: Array,
    reach: Indices,
    step: float,
    scales: Array,
    magnification: Array,
    vertical: NDArray[np.bool_],
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
    scales tried. What is ``doubt`` (3,) away from ``expected`` (3,) loses ``modesty``, what is twice as far four times
    that; in x and y this levels off, for a bump moves the whole image, but never changes the scale. ``scores``
    (≥ K·(2rx+1)·(2ry+1),) is scratch. ``best`` (B, 4) receives locations and their scores, highest first, no two of
    them neighbours; returns how many.
    """
    nx, ny = 2 * reach[0] + 1, 2 * reach[1] + 1
    found = np.empty(len(places))
    for k in range(len(scales)):
        away_s = ((scales[k] - expected[2]) / doubt[2]) ** 2
        mx, my = scales[k] * magnification[0], scales[k] * magnification[1]
        for j in range(ny):
            cy = start[1] + (j - reach[1]) * step
            away_y = ((cy - expected[1]) / doubt[1]) ** 2
            for i in range(nx):
                cx = start[0] + (i - reach[0]) * step
                away = away_y + ((cx - expected[0]) / doubt[0]) ** 2
                responses(vertical_sums, horizontal_sums, cx, cy, mx, my, vertical, places, spans, shifts, found)
                loss = modesty * (away_s + away / (1.0 + away / 9.0))
                scores[(k * ny + j) * nx + i] = likeness(found, signed, strength, weights) - loss
    n = len(scales) * ny * nx
    count = 0
    while count < len(best):
        top = 0
        for q in range(n):
            if scores[q] > scores[top]:
                top = q
        if scores[top] < 0.0:
            break
        i, j, k = top % nx, (top // nx) % ny, top // (nx * ny)
        best[count, 0] = start[0] + (i - reach[0]) * step
        best[count, 1] = start[1] + (j - reach[1]) * step
        best[count, 2] = scales[k]
        best[count, 3] = scores[top]
        count += 1
        for kk in range(len(scales)):
            for jj in range(max(j - 3, 0), min(j + 4, ny)):
                for ii in range(max(i - 3, 0), min(i + 4, nx)):
                    scores[(kk * ny + jj) * nx + ii] = -1.0
    return count


@njit(cache=True, nogil=True)
def shown(found: Array) -> float:
    """How much of a model of which nothing is learned yet the evidence ``found`` (S,) along it shows: its mean."""
    total = 0.0
    for r in found:
        total += min(abs(r), FULL)
    return total / len(found)


@njit(cache=True, nogil=True)
def survey(
    vertical_sums: Floats,
    horizontal_sums: Floats,
    start: Array,
    reach: Indices,
    step: float,
    scales: Array,
    rung: float,
    magnification: Array,
    vertical: NDArray[np.bool_],
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
    for k in range(len(scales)):
        mx, my = scales[k] * magnification[0], scales[k] * magnification[1]
        for j in range(ny):
            cy = start[1] + (j - reach[1]) * step
            for i in range(nx):
                cx = start[0] + (i - reach[0]) * step
                responses(vertical_sums, horizontal_sums, cx, cy, mx, my, vertical, places, spans, shifts, found)
                scores[(k * ny + j) * nx + i] = shown(found)
    n = len(scales) * ny * nx
    near = int(np.ceil(apart[0] / step))
    count = 0
    while count < len(best):
        top = 0
        for q in range(n):
            if scores[q] > scores[top]:
                top = q
        if scores[top] <= 0.0:
            break
        i, j, k = top % nx, (top // nx) % ny, top // (nx * ny)
        cx, cy = start[0] + (i - reach[0]) * step, start[1] + (j - reach[1]) * step
        best[count, 3] = -1.0
        for q in range(27):
            x, y = cx + 0.5 * step * (q % 3 - 1), cy + 0.5 * step * (q // 3 % 3 - 1)
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
            for jj in range(max(j - near, 0), min(j + near + 1, ny)):
                for ii in range(max(i - near, 0), min(i + near + 1, nx)):
                    scores[(kk * ny + jj) * nx + ii] = -1.0
    return count
