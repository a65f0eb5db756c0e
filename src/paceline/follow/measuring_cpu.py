"""Stages 2 and 3 of [NIST] for all features of a model, compiled as one, and what is told of them afterwards."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array, Bytes, Floats, Indices, Mask
from paceline.follow.association import associate
from paceline.follow.candidates import CANDIDATES, add_shares, candidate_lines, faint_lines
from paceline.follow.fitting import locate_features, robust_lines
from paceline.numba_cache import cached_njit

AGREEING = 1.5  # times what is allowed that a feature may be off to agree
BORDER = 2.0  # px of the image in which no edge is looked for
LEAST_SHOWN = 0.6  # share of the model to which what shows of it is related at least
SAMPLING = 0.2  # px: what the grid of pixels leaves uncertain of a line


@cached_njit(nogil=True, error_model="numpy")
def tolerances(
    location: Array,
    vertical: Mask,
    offsets: Array,
    horizon: float,
    magnification: float,
    nominal_range: float,
    model: float,
    relief: float,
) -> Array:
    """(S,) px²: the variance of each feature's true place about the model's, for a ``location`` (3,).

    The model is drawn as it looks from its nominal range z0. A horizontal line Y below the camera's axis, which is at
    ``horizon`` px, that stands δ nearer than the rear plane appears lower by Y·δ·(1/z − 1/z0) at the range z. ``model``
    and ``relief`` are the standard deviations of the lines' places and of δ, m; ``magnification`` is in px per metre
    at scale 1.
    """
    per_metre = magnification * location[2]
    out = np.empty(len(offsets))
    for j in range(len(offsets)):
        lower = 0.0
        if not vertical[j]:
            below = (location[1] + location[2] * offsets[j] - horizon) / per_metre
            lower = relief * below * (location[2] - 1.0) / nominal_range
        out[j] = (model * model + lower * lower) * per_metre**2 + SAMPLING**2
    return out


@cached_njit(nogil=True, error_model="numpy")
def mean_places(
    near_vertical: Floats,
    near_horizontal: Floats,
    owners: Indices,
    vertical: Mask,
    places: Array,
    spans: Array,
    lengths: Array,
    brighter: Indices,
    reach: float,
    minimum_share: float,
    variance_floor: float,
) -> tuple[Array, Array]:
    """The features' places (S,) px and confidences (S,) as in the paper: the means of the edge points that are nearest
    to each, (8)–(14). ``owners`` (2, ≥ N) receives whose each point is; the arguments are those of the stages."""
    n = len(places)
    gates = np.full(n, reach)
    found, weights = np.empty(n), np.empty(n)
    for k in range(2):
        points, upright = (near_vertical, True) if k == 0 else (near_horizontal, False)
        associate(points, upright, vertical, places, spans, gates, brighter, owners[k])
        locate_features(points, owners[k], upright, lengths, minimum_share, variance_floor, found, weights, vertical)
    return found, weights


@cached_njit(nogil=True, error_model="numpy")
def competing_places(
    image: Bytes,
    near_vertical: Floats,
    near_horizontal: Floats,
    owners: Indices,
    vertical: Mask,
    places: Array,
    spans: Array,
    lengths: Array,
    shifts: Array,
    brighter: Indices,
    reach: float,
    minimum_share: float,
    variance_floor: float,
    threshold: float,
    faint: bool,
    start: Array,
    doubt: Array,
    offsets: Array,
    tolerance: Array,
    breadth: float,
) -> tuple[Array, Array]:
    """The same of the lines that fit each other best, of those that compete for each feature: with ``faint`` also of
    lines that only the mean along a feature shows."""
    n = len(places)
    gates = np.full(n, reach)
    lines = np.zeros((n, CANDIDATES, 3))
    for k in range(2):
        points, upright = (near_vertical, True) if k == 0 else (near_horizontal, False)
        associate(points, upright, vertical, places, spans, gates, brighter, owners[k])
        candidate_lines(points, owners[k], upright, places, gates, breadth, vertical, lines)
    if faint:
        faint_lines(image, places, spans, reach, vertical, brighter, minimum_share, threshold, lines)
    for j in range(n):  # by element: the check of an array's shape takes seconds to compile
        for k in range(CANDIDATES):
            lines[j, k, 0] -= shifts[j]
    found, weights = robust_lines(
        lines, start, doubt, vertical, offsets, lengths, minimum_share, variance_floor, tolerance, breadth
    )
    return found + shifts, weights


@cached_njit(nogil=True, error_model="numpy")
def shares_found(
    near_vertical: Floats, near_horizontal: Floats, owners: Indices, places: Array, lengths: Array, breadth: float
) -> Array:
    """(S,): the share of each feature's length along which it has edge points of its own, at most 1."""
    shares = np.zeros(len(places))
    add_shares(near_vertical, owners[0], True, places, lengths, breadth, shares)
    add_shares(near_horizontal, owners[1], False, places, lengths, breadth, shares)
    return np.minimum(shares, 1.0)


@cached_njit(nogil=True, error_model="numpy")
def in_view(vertical: Mask, places: Array, spans: Array, width: int, height: int) -> Array:
    """(S,): the share of each feature's length that lies in an image of ``width`` × ``height`` px."""
    shares = np.zeros(len(places))
    for j in range(len(places)):
        across, along = (width, height) if vertical[j] else (height, width)
        if BORDER <= places[j] <= across - 1.0 - BORDER:
            seen = min(spans[j, 1], along - 1.0) - max(spans[j, 0], 0.0)
            shares[j] = max(seen, 0.0) / (spans[j, 1] - spans[j, 0])
    return shares


@cached_njit(nogil=True, error_model="numpy")
def agreement(
    offsets: Array, used: Mask, allowed: Array, shares: Array, lengths: Array, shown: Array
) -> tuple[float, float, float, float, Mask]:
    """How well the features lie where the model has them, from their ``offsets`` (S,) px, what each is ``allowed`` to
    be off with the model's own errors, (S,) px, how much of its length is found, ``shares`` (S,), their ``lengths``
    (S,) and how much of those the image can show, ``shown`` (S,).

    The rms of the offsets and of their ratios to what is allowed, over the features that are ``used`` (S,); how much
    of the model shows, 0 to 1: the mean of all features' shares, each the less the more it is off; the share of the
    lines' length that agrees; and which features agree (S,). Both shares are of what the image can show, and of
    `LEAST_SHOWN` of the model at least. A long line counts as a short one in the first: what only looks like the target
    has the long lines in common with it.
    """
    squares, ratios, match, agreed, full, most, visible, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
    agreeing = np.zeros(len(offsets), np.bool_)
    for j in range(len(offsets)):
        full += lengths[j]
        most += lengths[j] * shown[j]
        visible += shown[j]
        n += used[j]
        if used[j]:
            ratio = offsets[j] / allowed[j]
            squares += offsets[j] ** 2
            ratios += ratio * ratio
            match += shares[j] * np.exp(-0.5 * ratio * ratio)
            agreeing[j] = abs(ratio) < AGREEING
            agreed += lengths[j] * shown[j] * agreeing[j]
    match = min(match / max(visible, LEAST_SHOWN * len(offsets)), 1.0)
    support = agreed / max(most, LEAST_SHOWN * full)
    return np.sqrt(squares / n), np.sqrt(ratios / n), match, support, agreeing


@cached_njit(nogil=True, error_model="numpy")
def believed(near_vertical: Floats, near_horizontal: Floats, owners: Indices, used: Mask) -> tuple[Array, Indices]:
    """The edge points (M, 2) px of the features that are ``used`` (S,), and whose they are (M,)."""
    most = len(near_vertical) + len(near_horizontal)
    points, whose = np.empty((most, 2)), np.empty(most, np.int64)
    n = 0
    for k in range(2):
        edges = near_vertical if k == 0 else near_horizontal
        for i in range(len(edges)):
            j = owners[k, i]
            if j >= 0 and used[j]:
                points[n, 0], points[n, 1], whose[n] = edges[i, 0], edges[i, 1], j
                n += 1
    return points[:n], whose[:n]
