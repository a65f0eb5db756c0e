"""A vehicle's weighted particles on a GPU: what `filter.particle_set.Cloud` does, with nothing but estimates coming
back.

Particles, weights and everything in between stay on the device. What is to be done with them is noted as an order, see
`device`; what they come to is asked for all vehicles together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import motion_models
from paceline.speed.filter.cuda import memory_layout as at
from paceline.speed.filter.motion_models import FRAME, FreeMotion, PathMotion, State, kalman_gain, root
from paceline.speed.filter.particle_set import Cloud, Posterior
from paceline.speed.filter.random_numbers import CounterGenerator
from paceline.speed.filter.resampling import ROUGHENING, Weights, even_enough

# where second moments stand: see `memory_layout.PAIRS`
_CROSSING, _SPEED, _HEADING = (at.SPREADS.index(row) for row in (at.CROSSING_LEFT, at.SPEED, at.HEADING))
_CENTRE = len(at.SPREADS)


@dataclass(slots=True, eq=False)
class Found:
    """What a vehicle's weighted particles come to."""

    mean: Array  # (MOVING,) of all rows
    second: Array  # (pairs,) covariances of the pairs of `memory_layout.PAIRS`
    squares: float  # Σ W²
    reach: Array  # (2, 2, 4, 2) the least and the greatest place, for each coordinate, of both views' vertices
    shown: Array | None  # (4, M) the planes' projected centres in both views, if asked for; the vehicle's come first


class Device(Protocol):
    """What a cloud asks of `device.CudaDevice`, which says more of each."""

    orders: Array  # (slots, ORDER)

    def order(self, cloud: CudaCloud, what: int) -> None: ...

    def keep(self, noise: Array) -> int: ...

    def unweigh(self, cloud: CudaCloud) -> None: ...

    def survey(self, shown: bool) -> None: ...

    def fetched(self, cloud: CudaCloud) -> Array: ...


class CudaCloud:
    """N weighted particles on ``device``, which move by ``motion``; made by `CudaDevice.cloud` of ``home``."""

    def __init__(self, device: Device, home: Cloud, slot: int, first: int) -> None:
        self.device = device
        self.slot, self.first = slot, first  # its place in the tables, and its first column in the pool
        self.rig: StereoRig = home.rig
        self.motion = home.motion
        self.free = isinstance(home.motion, FreeMotion)
        self.knots = knots_of(home.motion)
        self.found: Found | None = None
        self._N = len(home.state)

    def __len__(self) -> int:
        return self._N

    @property
    def _order(self) -> Array:
        """What is to be done (ORDER,), see `memory_layout`; where it lies may change as noise is put on the desk."""
        return np.asarray(self.device.orders[self.slot])

    def propagate(self, dt: float, rng: np.random.Generator) -> None:
        self.device.order(self, at.MOVED)
        for i, (sigma, k) in enumerate(self.motion.draws(dt)):
            self._draw(at.MOVING_NOISE + i, sigma, k, rng)
        order = self._order
        order[at.DT] = dt
        if isinstance(self.motion, PathMotion):
            order[at.DRIFT : at.DRIFT + 2] = self.motion.drift * np.sqrt(dt / FRAME)

    def correct(self, place: Array, covariance: Array, rng: np.random.Generator) -> None:
        gain = kalman_gain(self._moments().second[_CENTRE:].reshape(-1, 3), covariance)
        self.device.order(self, at.CORRECTED)
        self._draw(at.SEEN_NOISE, 1.0, 3, rng)
        self._order[at.STEP : at.STEP + 30] = np.concatenate([place[None], root(covariance), gain]).reshape(-1)

    def square(self, normal: Array) -> None:
        self.device.order(self, at.SQUARED)
        self._order[at.TOWARDS : at.TOWARDS + 3] = normal

    def resample(self, c: SpeedConfiguration, rng: np.random.Generator) -> None:
        assert c.particles == self._N
        found = self._moments()
        if even_enough(1.0 / found.squares, self._N, c.resample_below):
            return
        self.device.order(self, at.RESAMPLED)
        offset = rng.random()
        self._draw(at.STIRRING, ROUGHENING, 2, rng)
        order = self._order
        order[at.NOW], order[at.OFFSET] = 1 - order[at.BEFORE], offset
        order[at.SPREAD : at.SPREAD + 2] = np.sqrt(np.maximum(found.second[_HEADING : _HEADING + 2], 0.0))

    def _draw(self, draw: int, sigma: float, k: int, rng: np.random.Generator) -> None:
        """Notes normal numbers, ``k`` a particle, the same as ``rng`` gives the CPU."""
        if isinstance(rng, CounterGenerator):
            self._order[at.KEY : at.KEY + 4] = rng.words
            where = -1 - rng.calls
            rng.calls += 1
        else:
            where = self.device.keep(rng.normal(0.0, sigma, (self._N, k)))
        self._order[at.DRAWS + 2 * draw : at.DRAWS + 2 * draw + 2] = where, sigma

    def unweigh(self) -> None:
        self.device.unweigh(self)

    def _moments(self, shown: bool = False) -> Found:
        """What the particles come to. Raises FloatingPointError where every one has weight zero."""
        if self.found is None or (shown and self.found.shown is None):
            self.device.survey(shown)
        found = self.found
        assert found is not None
        if not np.isfinite(found.squares):
            raise FloatingPointError("all particle weights vanish")
        return found

    def mean(self) -> State:
        mean = self._moments().mean
        return State(*(mean[part].reshape(1, *shape) for part, shape in _FIELDS))

    def doubt(self) -> float:
        return float(np.sqrt(max(self._moments().second[_CROSSING : _CROSSING + 2].sum(), 0.0)))

    def centre(self) -> tuple[Array, Array]:
        found = self._moments()
        return found.mean[at.PLACE : at.PLACE + 3], found.second[_CENTRE : _CENTRE + 9].reshape(3, 3)

    def reach(self) -> tuple[Array, Array]:
        reach = self._moments().reach
        return reach[:, 0], reach[:, 1]

    def posterior(self) -> Posterior:
        found = self._moments(shown=True)
        assert found.shown is not None
        shown = found.shown[:, : -(-self._N // int(self.device.orders[self.slot, at.EVERY]))]
        return Posterior(
            mean=self.mean(),
            position=found.mean[at.PLACE : at.PLACE + 3],
            speed=float(found.mean[at.SPEED]),
            speed_std=float(np.sqrt(max(found.second[_SPEED], 0.0))),
            ess=1.0 / found.squares,
            particles_left=shown[:2].T.copy(),
            particles_right=shown[2:].T.copy(),
        )

    def at_home(self) -> Cloud:
        """A copy in the computer's memory."""
        return self.snapshot().at_home()

    def snapshot(self) -> Snapshot:
        return Snapshot(self.rig, self.motion, self.device.fetched(self))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A cloud as it was: ``rows`` (STATE + 1, N), its state and its log weights."""

    rig: StereoRig
    motion: PathMotion | FreeMotion
    rows: Array

    def at_home(self) -> Cloud:
        weights = Weights(self.rows[at.STATE].copy())
        return Cloud(self.rig, self.motion, state_of(self.rows[: at.STATE]), weights)


_FIELDS = tuple(  # rows and shape of each of a particle's fields
    (slice(first, end), shape)
    for first, end, shape in (
        (at.LEFT, at.RIGHT, (4, 2)),
        (at.RIGHT, at.NORMAL, (4, 2)),
        (at.NORMAL, at.DISTANCE, (3,)),
        (at.DISTANCE, at.SPEED, ()),
        (at.SPEED, at.S, ()),
        (at.S, at.HEADING, ()),
        (at.HEADING, at.VELOCITY, (2,)),
        (at.VELOCITY, at.TURNING, (3,)),
        (at.TURNING, at.STATE, (3,)),
    )
)


def rows_of(state: State) -> Array:
    """``state`` as rows (STATE, N)."""
    fields = (getattr(state, name) for name in State.__dataclass_fields__)
    return np.concatenate([field.reshape(len(state), -1).T for field in fields])


def all_rows_of(cloud: Cloud) -> Array:
    """The state of ``cloud``, what follows from it, and the weights, as rows (LIKELIHOOD, N)."""
    state, weights = cloud.state, cloud.weights
    rows = np.zeros((at.LIKELIHOOD, len(state)))
    rows[: at.STATE] = rows_of(state)
    rows[at.PLACE : at.PLACE + 3] = motion_models.centres(cloud.rig, state).T
    rows[at.CROSSING_LEFT : at.CROSSING_LEFT + 2] = motion_models.diagonal_crossings(state.left).T
    rows[at.CROSSING_RIGHT : at.CROSSING_RIGHT + 2] = motion_models.diagonal_crossings(state.right).T
    rows[at.LOG_WEIGHT], rows[at.WEIGHT] = weights.lw, weights.W
    return rows


def state_of(rows: Array) -> State:
    """The state of which `rows_of` made ``rows`` (STATE, N)."""
    n = rows.shape[1]
    return State(*(np.array(rows[part].T, order="C").reshape(n, *shape) for part, shape in _FIELDS))


def knots_of(motion: PathMotion | FreeMotion) -> Array:
    """The path as rows (K, KNOT): a straight one is a curve of one piece."""
    if isinstance(motion, FreeMotion):
        return np.zeros((0, at.KNOT))
    breaks, cubics, roll = motion.path.pieces()
    knots = np.zeros((len(breaks), at.KNOT))
    knots[:, 0], knots[:, 1], knots[:-1, 2:] = breaks, roll, cubics.reshape(len(cubics), -1)
    return knots
