"""Stages 3 and 4 of [NIST]: where each feature is, and from that where the whole model is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Floats, Indices, Mask
from paceline.follow.motion import solved, triangularise
from paceline.numba_cache import cached_njit

ROUNDS = 6  # of the robust fit
UNCHECKED = 1.5  # times its variance that a fit with one feature to spare may claim too little
FRESH = 0.1  # share of a fit's variance that is new in each image: the model errs alike in all of them
BEYOND = 2.0  # times its reach from where it should be, a line does not belong to the model
TURNED = 0.1  # rad, standard deviation of a target's angle to the camera, which makes it look narrower by 1 − cos
CONSISTENT = 0.1  # the residual (15) below which features agree as well as the pixel grid allows
SURELY = 1e9  # confidence of what is not in doubt
# in squares of that, the rms of 1 − cos, and what of it is likely: between the most likely, 0, and the mean, 0.5
RMS, LIKELY = 0.5 * 3.0**0.5, 0.125
UNKNOWN = np.array([[0.0, np.inf], [0.0, np.inf]])  # a centre of which nothing is known
SINGULAR = 1e-6  # of the greatest diagonal of U: a location with less than that is not determined


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the model is: ``location`` (3,) c_x, c_y (px) and scale, its ``covariance`` (3, 3), the confidences
    ``weights`` (3,) of (17), the residual J_l of (15), and which features it rests on, ``used`` (S,)."""

    location: Array
    covariance: Array
    weights: Array
    residual: float
    offsets: Array  # (S,) px: measured minus fitted place of each feature; NaN where there is none
    used: Mask


@cached_njit(nogil=True, error_model="numpy")
def locate_features(
    points: Floats,
    owners: Indices,
    upright: bool,
    lengths: Array,
    minimum_share: float,
    variance_floor: float,
    places: Array,
    weights: Array,
    vertical: Mask,
) -> None:
    """The mean place of each feature's points (12) into ``places`` (S,) px, and its confidence (13), (14) into
    ``weights`` (S,): 0 with fewer points than ``minimum_share`` of its predicted length in ``lengths`` (S,) px."""
    across = 0 if upright else 1
    count = np.zeros(len(lengths))
    total = np.zeros(len(lengths))
    squares = np.zeros(len(lengths))
    for i in range(len(points)):
        if owners[i] >= 0:
            count[owners[i]] += 1.0
            total[owners[i]] += points[i, across]
    for j in range(len(lengths)):
        if vertical[j] == upright:
            places[j] = total[j] / count[j] if count[j] else np.nan
    for i in range(len(points)):
        if owners[i] >= 0:
            squares[owners[i]] += (points[i, across] - places[owners[i]]) ** 2
    for j in range(len(lengths)):
        if vertical[j] == upright:
            enough = count[j] > 0 and count[j] >= minimum_share * lengths[j]
            weights[j] = 1.0 / np.sqrt(max(squares[j] / count[j], variance_floor)) if enough else 0.0


@cached_njit(nogil=True, error_model="numpy")
def _fill(places: Array, weights: Array, vertical: Mask, offsets: Array, rows: Array) -> None:
    """The weighted rows [A | b] of (16) into ``rows`` (≥ S, 4); features of no weight give rows of zeros."""
    for j in range(len(places)):
        w = weights[j]
        rows[j, 0] = w if vertical[j] else 0.0
        rows[j, 1] = 0.0 if vertical[j] else w
        rows[j, 2] = w * offsets[j]
        rows[j, 3] = w * places[j] if w > 0.0 else 0.0


@cached_njit(nogil=True, error_model="numpy")
def _determined(pair: Array) -> bool:
    a, b, c = abs(pair[0, 0]), abs(pair[1, 1]), abs(pair[2, 2])
    return bool(min(a, b) > 0.0 and c > SINGULAR * max(a, b))


@cached_njit(nogil=True, error_model="numpy")
def robust_lines(
    lines: Array,
    start: Array,
    doubt: Array,
    vertical: Mask,
    offsets: Array,
    lengths: Array,
    minimum_share: float,
    variance_floor: float,
    tolerance: Array,
    finest: float,
) -> tuple[Array, Array]:
    """The place and the confidence (S,) of each feature: of its competing ``lines`` the one that fits the others.

    From ``start`` (3,), known to within ``doubt`` (3,), the reach of the robust weights narrows to ``finest`` px. The
    variance of a line is that of its points over their number and ``tolerance`` (S,) px² for the model's own errors.
    """
    n = len(vertical)
    places, weights = np.empty(n), np.empty(n)
    x = start.copy()
    rows = np.empty((n + 3, 4))
    widest = 0.0
    for j in range(n):
        d = doubt[0] if vertical[j] else doubt[1]
        widest = max(widest, np.sqrt(d * d + (offsets[j] * doubt[2]) ** 2))
    reach = max(2.0 * widest, finest)
    shrink = (finest / reach) ** (1.0 / (ROUNDS - 1))
    reaches = np.empty(n)
    for r in range(ROUNDS):
        for j in range(n):
            reaches[j] = np.sqrt(reach * reach + tolerance[j])
            expected = (x[0] if vertical[j] else x[1]) + x[2] * offsets[j]
            chosen, most = -1, 0.0
            for c in range(lines.shape[1]):
                if lines[j, c, 1] < minimum_share * lengths[j] or lines[j, c, 1] < 2.0:
                    continue
                away = (lines[j, c, 0] - expected) / reaches[j]
                support = lines[j, c, 1] / lengths[j] * np.exp(-0.5 * away * away)
                if support > most:
                    chosen, most = c, support
            weights[j] = 0.0
            places[j] = np.nan
            if chosen >= 0:
                away = (lines[j, chosen, 0] - expected) / reaches[j]
                if abs(away) < BEYOND:
                    variance = max(lines[j, chosen, 2], variance_floor) / lines[j, chosen, 1] + tolerance[j]
                    places[j] = lines[j, chosen, 0]
                    weights[j] = 1.0 / (np.sqrt(variance) * (1.0 + away * away))
        if r == ROUNDS - 1:
            break
        _fill(places, weights, vertical, offsets, rows)
        for p in range(3):  # what is not seen stays where it is expected
            rows[n + p] = 0.0
            rows[n + p, p] = 1.0 / doubt[p]
            rows[n + p, 3] = start[p] / doubt[p]
        triangularise(rows)
        x = solved(rows[:3])
        reach *= shrink
    return places, weights


@cached_njit(nogil=True, error_model="numpy")
def _locate(
    places: Array, weights: Array, vertical: Mask, offsets: Array, scale: float, turned: float, center: Array
) -> tuple[bool, Array, Array, Array, float, Array]:
    n = len(places)
    rows = np.zeros((max(n, 3) + 3, 5))
    for j in range(n):
        rows[j, 0] = -weights[j] * scale * offsets[j] if vertical[j] else 0.0
    _fill(places, weights, vertical, offsets, rows[:, 1:])
    elsewhere = np.zeros(2)  # confidence of what is known of the centre where no line tells it
    for p in range(2):
        told = False
        for j in range(n):
            told = told or (weights[j] > 0.0 and vertical[j] == (p == 0))
        elsewhere[p] = 0.0 if told else 1.0 / center[p, 1]
        rows[-2 - p, 1 + p] = elsewhere[p]
        rows[-2 - p, 4] = elsewhere[p] * center[p, 0]
    # A target turned by ψ looks narrower by κ = 1 − cos ψ. κ is the first unknown; made triangular, the rows below the
    # first hold the location whatever κ is.
    rows[-1] = 0.0
    rows[-1, 0] = SURELY if turned == 0.0 else 1.0 / (RMS * turned * turned)
    rows[-1, 4] = rows[-1, 0] * LIKELY * turned * turned
    triangularise(rows)
    pair = rows[1:4, 1:].copy()
    inverse, confidences, residuals = np.zeros((3, 3)), np.zeros(3), np.full(n, np.nan)
    if not _determined(pair):
        return False, np.zeros(3), inverse, confidences, 0.0, residuals
    x = solved(pair)
    narrower = (rows[0, 4] - rows[0, 1] * x[0] - rows[0, 2] * x[1] - rows[0, 3] * x[2]) / rows[0, 0]
    for p in range(3):  # U⁻¹, a column at a time
        column = pair.copy()
        column[:, 3] = 0.0
        column[p, 3] = 1.0
        inverse[:, p] = solved(column)
    J, freedom = 0.0, -3
    for j in range(n):
        if weights[j] > 0.0:
            seen = places[j] + (narrower * scale * offsets[j] if vertical[j] else 0.0)
            residuals[j] = seen - (x[0] if vertical[j] else x[1]) - x[2] * offsets[j]
            J += (weights[j] * residuals[j]) ** 2
            freedom += 1
            confidences[0 if vertical[j] else 1] += weights[j] ** 2
    confidences[2] = confidences[0] + confidences[1]
    confidences[:2] += elsewhere**2
    for confidence in elsewhere:
        if confidence > 0.0:
            freedom += 1
    # few features more than unknowns hardly check each other
    inflation = max(1.0, J / freedom) * (1.0 + UNCHECKED / freedom) if freedom > 0 else 1.0 + 2.0 * UNCHECKED
    return True, x, inverse @ inverse.T * inflation, np.sqrt(confidences / max(J, CONSISTENT)), J, residuals


@cached_njit(nogil=True, error_model="numpy")
def height_over_width(places: Array, weights: Array, vertical: Mask, offsets: Array) -> tuple[float, float]:
    """The target's height over its width, over the model's, by its features as in `locate`, and the variance of that; 0
    with an infinite variance where they do not tell both."""
    ratio, variance = 1.0, 0.0
    for upright in (True, False):
        total, middle, place = 0.0, 0.0, 0.0
        for j in range(len(places)):
            if vertical[j] == upright and weights[j] > 0.0:
                w = weights[j] ** 2
                total += w
                middle += w * offsets[j]
                place += w * places[j]
        along, spread = 0.0, 0.0
        for j in range(len(places)):
            if vertical[j] == upright and weights[j] > 0.0:
                w, off = weights[j] ** 2, offsets[j] - middle / total
                along += w * off * (places[j] - place / total)
                spread += w * off * off
        if spread <= 0.0 or along <= 0.0:
            return 0.0, np.inf
        scale = along / spread
        ratio = ratio / scale if upright else ratio * scale
        variance += 1.0 / (spread * scale * scale)
    return ratio, variance


def locate(
    places: Array,
    weights: Array,
    vertical: Mask,
    offsets: Array,
    scale: float = 1.0,
    turned: float = 0.0,
    center: Array = UNKNOWN,
) -> Fit | None:
    """The location that fits the features best, (15)–(17); None where they do not determine one.

    ``places`` (S,) px are the features' places, ``weights`` (S,) their confidences, ``offsets`` (S,) px their u or v
    at scale 1. The covariance is (AᵀWA)⁻¹, enlarged where the residual shows that the features' confidences claim too
    much. The target's angle to the camera has the standard deviation ``turned``, rad: by as much its width, at a
    ``scale`` of about that, is in doubt. At 0 it is seen squarely, as in the paper. Where no upright line shows, or no
    level one, that coordinate of the centre is the one of ``center`` (2, 2): each with its standard deviation, px.
    """
    good, x, covariance, confidences, J, residuals = _locate(places, weights, vertical, offsets, scale, turned, center)
    return Fit(x, covariance, confidences, J, residuals, weights > 0.0) if good else None


def fused(fit: Fit, expected: Array, doubt: Array) -> Fit:
    """A fit whose scale was also ``expected`` (3,), to within ``doubt`` (3,).

    Only the scale: a bump moves the image, but not the vehicle. Its covariance stays: what the expected scale rests on
    are measurements that shared this one's errors of the model.
    """
    fresh = FRESH * fit.covariance[2, 2]
    share = fresh / (fresh + doubt[2] ** 2)
    return scaled(fit, fit.location[2] + share * (expected[2] - fit.location[2]))


def combined(fit: Fit, place: Array, doubt: Array, lasting: Array | float = 0.0) -> Fit:
    """A fit and a ``place`` (3,) that is known to within ``doubt`` (3,) from elsewhere: what either errs by, the other
    does not. What the place errs by in all images alike, ``lasting`` (3,), has no say in how they are weighed, but
    comes to the covariance by the weight of the place, for it does not average out."""
    gain = np.linalg.solve(fit.covariance + np.diag(doubt**2), fit.covariance).T
    location = fit.location + gain @ (place - fit.location)
    covariance = fit.covariance - gain @ fit.covariance + (gain * np.square(lasting)) @ gain.T
    return Fit(location, 0.5 * (covariance + covariance.T), fit.weights, fit.residual, fit.offsets, fit.used)


def scaled(fit: Fit, scale: float) -> Fit:
    """A fit whose ``scale`` is known better from elsewhere; its covariance stays, as in `fused`."""
    location = fit.location + fit.covariance[:, 2] / fit.covariance[2, 2] * (scale - fit.location[2])
    return Fit(location, fit.covariance, fit.weights, fit.residual, fit.offsets, fit.used)
