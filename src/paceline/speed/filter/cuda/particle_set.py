"""The weighted particles of one vehicle on a GPU, with the interface of `filter.particle_set.ParticleSet`.

Particles, weights and intermediate results stay on the device. Methods enqueue commands, see `device`; moments are
reduced for all vehicles together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import motion_models
from paceline.speed.filter.cuda import memory_layout as layout
from paceline.speed.filter.likelihood import ObservationModel, Views
from paceline.speed.filter.motion_models import (
    ZHU_FRAME_INTERVAL_S,
    FreeMotion,
    PathMotion,
    State,
    cholesky_factor,
    kalman_gain,
)
from paceline.speed.filter.particle_set import ParticleSet, Posterior
from paceline.speed.filter.random_numbers import CounterGenerator
from paceline.speed.filter.resampling import JITTER_SCALE, Weights, ess_sufficient

# indices of second moments, see `memory_layout.MOMENT_PAIRS`
_CROSSING, _SPEED, _HEADING = (
    layout.VARIANCE_ROWS.index(row) for row in (layout.LEFT_CROSSING_ROW, layout.SPEED_ROW, layout.HEADING_ROW)
)
_PLACE = len(layout.VARIANCE_ROWS)


@dataclass(slots=True, eq=False)
class Moments:
    """Moments of a vehicle's weighted particles."""

    mean: Array  # (CARRIED_ROWS,) of all rows
    second: Array  # (pairs,) covariances of the pairs of `memory_layout.MOMENT_PAIRS`
    squares: float  # Σ W²
    bounds: Array  # (2, 2, 4, 2) least and greatest values of the coordinates of both views' vertices
    drawn: Array | None  # (4, M) the planes' projected centres in both views, if requested; the vehicle's come first


class Device(Protocol):
    """What a particle set needs of `device.CudaDevice`, which documents each."""

    commands: Array  # (slots, COMMAND_SIZE)

    def enqueue(self, particle_set: CudaParticleSet, command: int) -> None: ...

    def displace(self, particle_set: CudaParticleSet) -> None: ...

    def store_noise(self, noise: Array) -> int: ...

    def weight(self, particle_set: CudaParticleSet, model: ObservationModel, views: Views) -> None: ...

    def restore_weights(self, particle_set: CudaParticleSet) -> None: ...

    def reduce_moments(self, drawn: bool) -> None: ...

    def download(self, particle_set: CudaParticleSet) -> Array: ...


class CudaParticleSet:
    """N weighted particles on ``device``, which move by ``motion``; made by `CudaDevice.particle_set` of ``host``."""

    def __init__(self, device: Device, host: ParticleSet, slot: int, first: int) -> None:
        self.device = device
        self.slot, self.first = slot, first  # its row of the tables, and its first column of the pool
        self.rig: StereoRig = host.rig
        self.motion, self.displacement = host.motion, host.displacement
        self.free = isinstance(host.motion, FreeMotion)
        self.knots = knots_of(host.motion)
        self.moments: Moments | None = None
        self._N = len(host.state)

    def __len__(self) -> int:
        return self._N

    @property
    def _command(self) -> Array:
        """The vehicle's command (COMMAND_SIZE,), see `memory_layout`; `Device.store_noise` may move it."""
        return np.asarray(self.device.commands[self.slot])

    def propagate(self, dt: float, rng: np.random.Generator) -> None:
        self.device.enqueue(self, layout.PROPAGATE)
        for i, (sigma, k) in enumerate(self.motion.noise_draws(dt)):
            self._draw(layout.PROCESS_NOISE_KIND + i, sigma, k, rng)
        command = self._command
        command[layout.TIME_STEP] = dt
        if isinstance(self.motion, PathMotion):
            command[layout.DRIFT_STD : layout.DRIFT_STD + 2] = self.motion.drift * np.sqrt(dt / ZHU_FRAME_INTERVAL_S)

    def displace(self, displacement: Array) -> None:
        self.displacement = displacement
        self.device.displace(self)

    def ensemble_kalman_update(self, place: Array, covariance: Array, rng: np.random.Generator) -> None:
        moments = self._moments().second[_PLACE:].reshape(-1, 3)
        step = np.concatenate([place[None], cholesky_factor(covariance), kalman_gain(moments, covariance)])
        self.device.enqueue(self, layout.KALMAN_UPDATE)
        self._draw(layout.MEASUREMENT_NOISE_KIND, 1.0, 3, rng)
        self._command[layout.KALMAN_STEP : layout.KALMAN_STEP + step.size] = step.reshape(-1)

    def set_plane_normal(self, normal: Array) -> None:
        self.device.enqueue(self, layout.SET_NORMAL)
        self._command[layout.TARGET_NORMAL : layout.TARGET_NORMAL + 3] = normal

    def resample(self, c: SpeedConfiguration, rng: np.random.Generator) -> None:
        assert c.particles == self._N
        moments = self._moments()
        if ess_sufficient(1.0 / moments.squares, self._N, c.resample_below):
            return
        self.device.enqueue(self, layout.RESAMPLE)
        offset = rng.random()
        self._draw(layout.JITTER_KIND, JITTER_SCALE, 2, rng)
        command = self._command
        command[layout.HALF_AFTER], command[layout.RESAMPLING_OFFSET] = 1 - command[layout.HALF_BEFORE], offset
        command[layout.HEADING_STD : layout.HEADING_STD + 2] = np.sqrt(
            np.maximum(moments.second[_HEADING : _HEADING + 2], 0.0)
        )

    def _draw(self, draw: int, sigma: float, k: int, rng: np.random.Generator) -> None:
        """Request normal numbers, ``k`` for each particle, the same as ``rng`` draws on the CPU."""
        if isinstance(rng, CounterGenerator):
            self._command[layout.GENERATOR_KEY : layout.GENERATOR_KEY + 4] = rng.key_words
            offset = -1 - rng.calls
            rng.calls += 1
        else:
            offset = self.device.store_noise(rng.normal(0.0, sigma, (self._N, k)))
        self._command[layout.NOISE_SOURCES + 2 * draw : layout.NOISE_SOURCES + 2 * draw + 2] = offset, sigma

    def weight(self, model: ObservationModel, views: Views) -> None:
        self.device.weight(self, model, views)

    def restore_weights(self) -> None:
        self.device.restore_weights(self)

    def _moments(self, drawn: bool = False) -> Moments:
        """The moments of the particles. Raises FloatingPointError where every one has weight zero."""
        if self.moments is None or (drawn and self.moments.drawn is None):
            self.device.reduce_moments(drawn)
        moments = self.moments
        assert moments is not None
        if not np.isfinite(moments.squares):
            raise FloatingPointError("all particle weights vanish")
        return moments

    def mean(self) -> State:
        mean = self._moments().mean
        return State(*(mean[part].reshape(1, *shape) for part, shape in _FIELDS))

    def image_spread_px(self) -> float:
        return float(np.sqrt(max(self._moments().second[_CROSSING : _CROSSING + 2].sum(), 0.0)))

    def centre(self) -> tuple[Array, Array]:
        moments = self._moments()
        covariance = moments.second[_PLACE:].reshape(-1, 3)[:3]
        return moments.mean[layout.CENTRE_ROW : layout.CENTRE_ROW + 3], covariance

    def image_bounds(self) -> tuple[Array, Array]:
        bounds = self._moments().bounds
        return bounds[:, 0], bounds[:, 1]

    def posterior(self) -> Posterior:
        moments = self._moments(drawn=True)
        assert moments.drawn is not None
        drawn = moments.drawn[:, : -(-self._N // int(self.device.commands[self.slot, layout.DRAWN_STRIDE]))]
        return Posterior(
            mean=self.mean(),
            position=moments.mean[layout.CENTRE_ROW : layout.CENTRE_ROW + 3],
            speed=float(moments.mean[layout.SPEED_ROW]),
            speed_std=float(np.sqrt(max(moments.second[_SPEED], 0.0))),
            ess=1.0 / moments.squares,
            particles_left=drawn[:2].T.copy(),
            particles_right=drawn[2:].T.copy(),
        )

    def to_host(self) -> ParticleSet:
        """A copy in the computer's memory."""
        return self.checkpoint().to_host()

    def checkpoint(self) -> ParticleCheckpoint:
        return ParticleCheckpoint(self.rig, self.motion, self.displacement, self.device.download(self))


@dataclass(frozen=True, eq=False)
class ParticleCheckpoint:
    """Particles as they were: ``rows`` (STATE_ROW_COUNT + 1, N), their state and log weights."""

    rig: StereoRig
    motion: PathMotion | FreeMotion
    displacement: Array
    rows: Array

    def to_host(self) -> ParticleSet:
        weights = Weights(self.rows[layout.STATE_ROW_COUNT].copy())
        state = state_of(self.rows[: layout.STATE_ROW_COUNT])
        return ParticleSet(self.rig, self.motion, state, weights, self.displacement)


_FIELDS = tuple(  # rows and shape of each of a particle's fields
    (slice(first, end), shape)
    for first, end, shape in (
        (layout.LEFT_REGION_ROW, layout.RIGHT_REGION_ROW, (4, 2)),
        (layout.RIGHT_REGION_ROW, layout.NORMAL_ROW, (4, 2)),
        (layout.NORMAL_ROW, layout.DISTANCE_ROW, (3,)),
        (layout.DISTANCE_ROW, layout.SPEED_ROW, ()),
        (layout.SPEED_ROW, layout.ARC_LENGTH_ROW, ()),
        (layout.ARC_LENGTH_ROW, layout.HEADING_ROW, ()),
        (layout.HEADING_ROW, layout.VELOCITY_ROW, (2,)),
        (layout.VELOCITY_ROW, layout.TURN_RATE_ROW, (3,)),
        (layout.TURN_RATE_ROW, layout.STATE_ROW_COUNT, (3,)),
    )
)


def rows_of(state: State) -> Array:
    """``state`` as rows (STATE_ROW_COUNT, N)."""
    fields = (getattr(state, name) for name in State.__dataclass_fields__)
    return np.concatenate([field.reshape(len(state), -1).T for field in fields])


def derived_rows_of(particle_set: ParticleSet) -> Array:
    """The state of ``particle_set``, its derived quantities and the weights, as rows (LIKELIHOOD_ROW, N)."""
    state, weights = particle_set.state, particle_set.weights
    rows = np.zeros((layout.LIKELIHOOD_ROW, len(state)))
    rows[: layout.STATE_ROW_COUNT] = rows_of(state)
    rows[layout.CENTRE_ROW : layout.CENTRE_ROW + 3] = motion_models.plane_centres(particle_set.rig, state).T
    rows[layout.LEFT_CROSSING_ROW : layout.LEFT_CROSSING_ROW + 2] = motion_models.diagonal_crossings(state.left).T
    rows[layout.RIGHT_CROSSING_ROW : layout.RIGHT_CROSSING_ROW + 2] = motion_models.diagonal_crossings(state.right).T
    rows[layout.LOG_WEIGHT_ROW], rows[layout.WEIGHT_ROW] = weights.lw, weights.W
    return rows


def state_of(rows: Array) -> State:
    """The state of which `rows_of` made ``rows`` (STATE_ROW_COUNT, N)."""
    n = rows.shape[1]
    return State(*(np.array(rows[part].T, order="C").reshape(n, *shape) for part, shape in _FIELDS))


def knots_of(motion: PathMotion | FreeMotion) -> Array:
    """The path as rows (K, KNOT_SIZE): a straight one is a curve of one piece."""
    if isinstance(motion, FreeMotion):
        return np.zeros((0, layout.KNOT_SIZE))
    breaks, cubics, roll = motion.path.pieces()
    knots = np.zeros((len(breaks), layout.KNOT_SIZE))
    knots[:, 0], knots[:, 1], knots[:-1, 2:] = breaks, roll, cubics.reshape(len(cubics), -1)
    return knots
