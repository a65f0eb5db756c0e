"""Stages 5 and 6 of [NIST]: a second-order motion model for each parameter of the location, by the square root
information filter with exponential decay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.follow.configuration import FollowConfiguration
from paceline.numba_cache import cached_njit

CYCLE = 1 / 15  # s, the paper's cycle: the unit of time in the motion models
LINEAR = 4.0  # cycles for which a motion is continued when nothing is seen; then the target is expected to stay there
CURVED = 1.5  # cycles for which its acceleration is
RECENT = 0.9  # memory of how well the models have predicted, per cycle
CALM = 0.006  # relative change of scale per cycle that cannot be foreseen: vehicles do not jump
STARTLED = 2  # measurements that are left to the motion of a scale that surprised
UNSURE = 8.0  # measurements after which a motion is about known
APPROACH = 0.02  # relative change of scale per cycle, standard deviation: 3 m/s at 10 m
BRAKING = 0.0013  # and per cycle², of its second-order coefficient: 6 m/s² at 10 m
SURPRISE = 2.0  # standard deviations of the scale beyond which it was not foreseen
WRONG = 3  # so many in a row and to the same side, and it is the motion that is wrong
FORGOTTEN = 0.3  # what is left of its weight where a motion was wrong
HONEST = 2.0  # cycles: a prediction farther ahead than that says nothing about the models


@cached_njit(nogil=True, error_model="numpy")
def triangularise(A: Array) -> None:
    """Make ``A`` (rows, columns) upper triangular in its place by Householder reflections: T of (22)–(25)."""
    rows, columns = A.shape
    for k in range(min(rows - 1, columns)):
        norm = 0.0
        for i in range(k, rows):
            norm += A[i, k] * A[i, k]
        norm = np.sqrt(norm)
        if norm == 0.0:
            continue
        if A[k, k] > 0:
            norm = -norm
        A[k, k] -= norm  # column k now holds the reflection's normal n, and n·n = −2·norm·n[0]
        for j in range(k + 1, columns):
            dot = 0.0
            for i in range(k, rows):
                dot += A[i, k] * A[i, j]
            dot /= norm * A[k, k]
            for i in range(k, rows):
                A[i, j] += dot * A[i, k]
        A[k, k] = norm
        for i in range(k + 1, rows):
            A[i, k] = 0.0


@cached_njit(nogil=True, error_model="numpy")
def aged(pair: Array, tau: float, decay: float) -> Array:
    """The least squares pair [U | z] (3, 4) ``tau`` cycles later: √(λ^τ)·[U V | z] of (29), with V of (30) for a
    shift by τ."""
    root = decay ** (0.5 * tau)
    out = np.empty((3, 4))
    for i in range(3):
        a, b, c = pair[i, 0], pair[i, 1], pair[i, 2]
        out[i, 0] = root * a
        out[i, 1] = root * (b - tau * a)
        out[i, 2] = root * (c - 2.0 * tau * b + tau * tau * a)
        out[i, 3] = root * pair[i, 3]
    return out


@cached_njit(nogil=True, error_model="numpy")
def updated(pair: Array, value: float, weight: float) -> Array:
    """The pair with a measurement at t = 0 added: the row w·[1 0 0 | c] over the old ones, made triangular again."""
    rows = np.empty((4, 4))
    rows[0, 0] = weight
    rows[0, 1] = 0.0
    rows[0, 2] = 0.0
    rows[0, 3] = weight * value
    for i in range(3):
        for j in range(4):
            rows[i + 1, j] = pair[i, j]
    triangularise(rows)
    return rows[:3].copy()


@cached_njit(nogil=True, error_model="numpy")
def solved(pair: Array) -> Array:
    """a0, a1, a2 of (2), by back substitution in z = U x (28)."""
    x = np.zeros(3)
    for i in (2, 1, 0):
        rest = pair[i, 3]
        for j in range(i + 1, 3):
            rest -= pair[i, j] * x[j]
        x[i] = rest / pair[i, i]
    return x


@cached_njit(nogil=True, error_model="numpy")
def at_rest(value: float, weights: Array) -> Array:
    """The pair of a parameter that is ``value`` and does not move, its coefficients known with ``weights`` (3,)."""
    pair = np.zeros((3, 4))
    for i in range(3):
        pair[i, i] = weights[i]
    pair[0, 3] = weights[0] * value
    return pair


@cached_njit(nogil=True, error_model="numpy")
def extrapolated(pair: Array, tau: float, moving: bool = True) -> float:
    """(34), ``tau`` cycles on; beyond a few cycles without a measurement the motion is not trusted to go on. Of what
    is not ``moving``, a0."""
    a = solved(pair)
    if not moving:
        return float(a[0])
    linear, curved = min(tau, LINEAR), min(tau, CURVED)
    return float(a[0] + a[1] * linear + a[2] * curved * curved)


@cached_njit(nogil=True, error_model="numpy")
def _predict(pairs: Array, errors: Array, tau: float, moving: NDArray[np.bool_], values: Array, stds: Array) -> None:
    """The models' predictions, each weighed by the inverse of its mean squared error of late."""
    for p in range(pairs.shape[0]):
        total, value, error = 0.0, 0.0, 0.0
        for m in range(pairs.shape[1]):
            w = 1.0 / errors[p, m] ** 2
            total += w
            value += w * extrapolated(pairs[p, m], tau, moving[m])
            error += w * errors[p, m]
        values[p] = value / total
        stds[p] = np.sqrt(error / total) * max(1.0, tau)


@cached_njit(nogil=True, error_model="numpy")
def _observe(
    pairs: Array,
    errors: Array,
    tau: float,
    decays: Array,
    moving: NDArray[np.bool_],
    values: Array,
    weights: Array,
    floors: Array,
) -> None:
    memory = RECENT**tau
    for p in range(pairs.shape[0]):
        for m in range(pairs.shape[1]):
            if 0.0 < tau <= HONEST:
                e = values[p] - extrapolated(pairs[p, m], tau, moving[m])
                errors[p, m] = max(memory * errors[p, m] + (1.0 - memory) * e * e, floors[p] ** 2)
            pair = updated(aged(pairs[p, m], tau, decays[p, m]), values[p], weights[p])
            for i in range(pair.shape[0]):  # by element: the check of an array's shape takes seconds to compile
                for j in range(pair.shape[1]):
                    pairs[p, m, i, j] = pair[i, j]


class MotionModels:
    """The dynamic model (2): c_x, c_y and scale as polynomials of time.

    With an adaptive decay each parameter has three models, a quick and a slow one and one at rest, and the one that
    predicted better of late has the greater say: a bump's velocity does not last.
    ``start`` (3,) is where the operator sees the target at rest, ``doubt`` (3,) the standard
    deviation of the first prediction.
    """

    def __init__(self, start: Array, doubt: Array, configuration: FollowConfiguration) -> None:
        c = configuration
        place, scale = (c.decay, c.slow_decay), (c.scale_decay, c.slow_scale_decay)
        decays = np.array([[quick, slow, quick] for quick, slow in (place, place, scale)])
        n = 3 if c.adaptive_decay else 1
        self._decays, self._moving = np.ascontiguousarray(decays[:, :n]), np.array([True, True, False])[:n]
        self._pairs = np.zeros((3, n, 3, 4))
        self._errors = np.zeros((3, n))
        self._values, self._stds = np.zeros(3), np.zeros(3)
        self._doubt = doubt.copy()
        self.restart(start, np.ones(3))

    def restart(self, location: Array, weights: Array) -> None:
        """Forget all motion: the target is at ``location`` (3,) and at rest."""
        for p in range(3):
            known = np.full(3, weights[p])
            if p == 2 and self._decays.shape[1] > 1:
                known[1:] = 1.0 / (location[2] * np.array([APPROACH, BRAKING]))
            self._pairs[p, :] = at_rest(float(location[p]), known)
        self._errors[:] = (self._doubt**2)[:, None]
        self._count = 0
        self._surprises = np.zeros(WRONG)  # of the scale, in standard deviations, by what was observed last

    def predict(self, tau: float) -> tuple[Array, Array]:
        """The location (3,) ``tau`` cycles after the last measurement, and its standard deviation (3,)."""
        _predict(self._pairs, self._errors, tau, self._moving, self._values, self._stds)
        stds = self._stds.copy()
        stds[2] = min(stds[2], CALM * (1.0 + UNSURE / (1.0 + self._count)) * self._values[2] * max(1.0, tau))
        return self._values.copy(), stds

    def foregone(self, tau: float) -> Array:
        """(3,): how much farther each would be ``tau`` cycles after the last measurement at the speed that `predict`
        does not trust to last."""
        rates = np.array([[solved(pair)[1] for pair in pairs] for pairs in self._pairs]) * self._moving
        shares = 1.0 / self._errors**2
        return np.asarray((rates * shares).sum(1) / shares.sum(1) * max(tau - LINEAR, 0.0))

    def compare_scale(self, surprise: float) -> None:
        """The scale that is about to be observed is off the one foreseen, by so many standard deviations. Where it was
        not foreseen its motion may have changed, and the next one is as uncertain as early on; where that goes on to
        one side, it has."""
        self._surprises = np.append(self._surprises[1:], surprise)
        if abs(surprise) <= SURPRISE:
            return
        self._count = min(self._count, STARTLED)
        if (self._surprises[:-1] * surprise > SURPRISE**2).all():
            self.forget_scale()

    def forget_scale(self) -> None:
        """What is known of the motion of the scale counts much less against what is measured from now on."""
        self._pairs[2] *= FORGOTTEN

    def observe(self, location: Array, weights: Array, tau: float, floors: Array) -> None:
        """Add the measured ``location`` (3,), of confidence ``weights`` (3,), ``tau`` cycles after the last one; no
        prediction is ever taken to be better than ``floors`` (3,)."""
        self._count += 1
        _observe(self._pairs, self._errors, tau, self._decays, self._moving, location, weights, floors)
