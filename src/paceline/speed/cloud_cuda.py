"""A vehicle's weighted particles on a GPU: what `cloud.Cloud` does, with nothing but estimates coming back.

Particles, weights and everything in between stay on the device. What goes there for a frame is the part of both
images that is looked at, once for all vehicles, and a few numbers; up to `randomness.MANY` particles, their random
numbers too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from paceline.cameras import StereoRig
from paceline.speed import motion_cuda, particles_cuda, pixels_cuda, randomness_cuda
from paceline.speed.cloud import KEPT, ROUGHENING, SHOWN, Cloud, Posterior, Views
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.likelihood import CONTRAST_FLOOR, PART_DISTANCE_CAP, Grid, Packed
from paceline.speed.motion import FRAME, FreeMotion, PathMotion, State, kalman_gain, root
from paceline.speed.motion_cuda import (
    CROSSING_LEFT,
    HEADING,
    MAPS,
    NORMAL,
    PLACE,
    ROWS,
    SPEED,
    STATE,
    VELOCITY,
)
from paceline.speed.particles import Weights
from paceline.speed.particles_cuda import THREADS
from paceline.speed.paths import Path
from paceline.speed.randomness import CounterGenerator

Array = NDArray[np.float64]
OnDevice = Any  # an array in the device's memory: Numba has no type for it

BLOCK = 128  # threads of a block, one a particle
MOST_BLOCKS = 64  # that add up one moment
AT_ONCE = 1 << 18  # particles of the search for a first speed that are weighed in one launch
MOST_NOISE = 6  # random numbers that a particle needs at once


class Follower(Protocol):
    """One who follows a vehicle: what its particles look at and are compared with."""

    rig: StereoRig
    configuration: SpeedConfiguration
    cloud: Cloud | CudaCloud
    views: Views
    grid: Grid
    reference: NDArray[np.float32]


class CudaDevice:
    """The current GPU, on which the particles of any number of vehicles are weighed together."""

    def __init__(self) -> None:
        cuda.current_context()  # type: ignore[no-untyped-call]
        self._rigs: dict[int, tuple[StereoRig, OnDevice]] = {}
        self.prepared: tuple[tuple[int, ...], OnDevice, OnDevice] = ((), None, None)  # sizes, owners, maps

    def free_memory(self) -> int:
        """Bytes."""
        return int(cuda.current_context().get_memory_info().free)  # type: ignore[no-untyped-call]

    def cloud(self, home: Cloud) -> CudaCloud:
        """``home`` copied to the device."""
        return CudaCloud(self, home)

    def rig(self, rig: StereoRig) -> OnDevice:
        """The numbers of ``rig``, uploaded once."""
        if id(rig) not in self._rigs:
            self._rigs[id(rig)] = (rig, cuda.to_device(_rig_numbers(rig)))
        return self._rigs[id(rig)][1]

    def weigh(self, trackers: Sequence[Follower]) -> None:
        """Update the weights of all clouds of ``trackers``, which look at the same views, in one launch."""
        clouds = [t.cloud for t in trackers if isinstance(t.cloud, CudaCloud)]
        sizes = tuple(len(cloud) for cloud in clouds)
        if self.prepared[0] != sizes:
            owner = np.repeat(np.arange(len(sizes)), sizes).astype(np.int32)
            self.prepared = sizes, cuda.to_device(owner), cuda.device_array((len(owner), MAPS), np.float32)
        _, owner, maps = self.prepared
        starts = np.concatenate([[0], np.cumsum(sizes)])
        for cloud, start in zip(clouds, starts, strict=False):
            motion_cuda.prepare[_grid(len(cloud)), BLOCK](cloud.rows, cloud.rig_numbers, maps, start)
        out = self.log_likelihoods(trackers, maps, owner)
        for cloud, start in zip(clouds, starts, strict=False):
            cloud.reweigh(out, start)

    def log_likelihood(self, tracker: Follower, state: State) -> Array:
        """log p(z | x) (N,) of particles that are in the computer's memory."""
        rig, found = self.rig(tracker.rig), []
        for first in range(0, len(state), AT_ONCE):
            rows = cuda.to_device(_rows_of(state[np.arange(first, min(first + AT_ONCE, len(state)))]))
            n = rows.shape[1]
            owner, maps = cuda.to_device(np.zeros(n, np.int32)), cuda.device_array((n, MAPS), np.float32)
            motion_cuda.prepare[_grid(n), BLOCK](rows, rig, maps, 0)
            found.append(self.log_likelihoods([tracker], maps, owner).copy_to_host())
        return np.concatenate(found)

    def log_likelihoods(self, trackers: Sequence[Follower], maps: OnDevice, owner: OnDevice) -> OnDevice:
        """(12), (13), (18) of all particles that have ``maps`` (M, MAPS), on the device."""
        c = trackers[0].configuration
        images = [part for packed in trackers[0].views for part in _uploaded(packed)]
        grids = np.array([(t.grid.across, t.grid.down, *t.grid.samples) for t in trackers], np.int32)
        references = np.stack([t.reference for t in trackers]).astype(np.float32)
        out = cuda.device_array(len(owner), np.float64)
        pixels_cuda.log_likelihood[len(owner), 16 * c.parts](
            *images,
            maps,
            owner,
            cuda.to_device(grids),
            cuda.to_device(references),
            np.float32(CONTRAST_FLOOR),
            np.float32(PART_DISTANCE_CAP),
            c.lambda_single,
            c.lambda_cross,
            out,
        )
        return out


class CudaCloud:
    """N weighted particles on ``device``, which move by ``motion``; taken over from ``home``."""

    def __init__(self, device: CudaDevice, home: Cloud) -> None:
        self.device, self.motion = device, home.motion
        self.rig = home.rig
        N = len(home.state)
        self.rig_numbers = device.rig(self.rig)
        self.path = [cuda.to_device(part) for part in _path_numbers(home.motion)]
        self.free = isinstance(home.motion, FreeMotion)
        self.linear = np.array(
            [VELOCITY, VELOCITY + 1, VELOCITY + 2] if self.free else [SPEED, HEADING, HEADING + 1], np.int32
        )
        self._linear = cuda.to_device(self.linear)
        self.pairs = _pairs(self.linear)
        self._pairs = cuda.to_device(np.array(self.pairs, np.int32))
        self._heading_pairs = cuda.to_device(np.array([(HEADING, -1), (HEADING + 1, -1)], np.int32))
        self.rows, self._spare = cuda.to_device(_rows_of(home.state)), cuda.device_array((ROWS, N))
        self._lw, self._W = cuda.to_device(home.weights.lw), cuda.to_device(home.weights.W)
        self._noise, self._cumulative = cuda.device_array((MOST_NOISE, N)), cuda.device_array(N)
        blocks = min(-(-N // THREADS), MOST_BLOCKS)
        self._threads = min(THREADS, 1 << (N - 1).bit_length())
        self._partial = cuda.device_array((len(self.pairs), blocks + 1))
        self._heading_partial = cuda.device_array((2, blocks + 1))
        self._observed: tuple[OnDevice, int] = (None, 0)  # what the weights were last updated by
        self._told, self._extremes = cuda.to_device(np.zeros(2)), cuda.device_array((NORMAL, 2))
        self._every = -(-N // SHOWN)
        self._shown = cuda.device_array((4, -(-N // self._every)))
        self._moments: _Moments | None = None
        motion_cuda.derive[_grid(N), BLOCK](self.rows, self.rig_numbers)

    def __len__(self) -> int:
        return int(self.rows.shape[1])

    def propagate(self, dt: float, rng: np.random.Generator) -> None:
        first = 0
        for sigma, k in self.motion.draws(dt):
            self._draw(rng, sigma, first, k)
            first += k
        launch = _grid(len(self)), BLOCK
        if isinstance(self.motion, PathMotion):
            turns = self.motion.name != "line"
            drift = self.motion.drift * np.sqrt(dt / FRAME)
            motion_cuda.propagate_along_path[launch](
                self.rows, self._noise, self.rig_numbers, *self.path, turns, float(drift[0]), float(drift[1]), dt
            )
        else:
            motion_cuda.propagate_freely[launch](self.rows, self._noise, self.rig_numbers, dt)
        self._moments = None

    def _draw(self, rng: np.random.Generator, sigma: float, first: int, k: int) -> None:
        """Normal numbers into ``k`` rows of the noise, the same as ``rng`` gives the CPU."""
        noise, N = self._noise[first : first + k], len(self)
        if isinstance(rng, CounterGenerator):
            keys = cuda.to_device(randomness_cuda.round_keys(rng.key))
            randomness_cuda.normals[_grid(N), BLOCK](keys, rng.calls, sigma, noise)
            rng.calls += 1
        else:
            noise.copy_to_device(np.ascontiguousarray(rng.normal(0.0, sigma, (N, k)).T))

    def mean(self) -> State:
        return _state_of(self.moments().mean[:, None])

    def doubt(self) -> float:
        m = self.moments()
        return float(np.sqrt(max(m.covariance[CROSSING_LEFT] + m.covariance[CROSSING_LEFT + 1], 0.0)))

    def centre(self) -> tuple[Array, Array]:
        m = self.moments()
        return m.mean[PLACE : PLACE + 3], m.centre[:3]

    def correct(self, place: Array, covariance: Array, rng: np.random.Generator) -> None:
        gain = kalman_gain(self.moments().centre, covariance)
        self._draw(rng, 1.0, 0, 3)
        step = cuda.to_device(np.concatenate([place[None], root(covariance), gain]))
        motion_cuda.correct[_grid(len(self)), BLOCK](
            self.rows, self._noise, self.rig_numbers, step, self._linear, *self.path, self.free
        )
        self._moments = None

    def reach(self) -> tuple[Array, Array]:
        particles_cuda.extremes[NORMAL, self._threads](self.rows, self._extremes)
        corners = self._extremes.copy_to_host().reshape(2, 4, 2, 2)  # views, vertices, x and y, least and greatest
        return corners[0].swapaxes(-1, -2), corners[1].swapaxes(-1, -2)

    def reweigh(self, log_likelihood: OnDevice, first: int) -> None:
        """Update the weights by log p(z | x) of these particles, the ``first`` and the following of a batch."""
        self._observed = log_likelihood, first
        self._reweigh(1.0)

    def unweigh(self) -> None:
        self._reweigh(-1.0)

    def _reweigh(self, times: float) -> None:
        particles_cuda.reweigh[1, self._threads](self._lw, *self._observed, times, self._W, self._told)
        self._moments = None

    def posterior(self) -> Posterior:
        m = self.moments()
        particles_cuda.thin[_grid(self._shown.shape[1]), BLOCK](self.rows, CROSSING_LEFT, self._every, self._shown)
        shown = self._shown.copy_to_host()
        return Posterior(
            mean=self.mean(),
            position=m.mean[PLACE : PLACE + 3],
            speed=float(m.mean[SPEED]),
            speed_std=float(np.sqrt(max(m.covariance[SPEED], 0.0))),
            ess=m.ess,
            particles_left=shown[:2].T.copy(),
            particles_right=shown[2:].T.copy(),
        )

    def square(self, normal: Array) -> None:
        motion_cuda.square[_grid(len(self)), BLOCK](self.rows, cuda.to_device(np.asarray(normal, float)))
        self._moments = None

    def resample(self, c: SpeedConfiguration, rng: np.random.Generator) -> None:
        m, N = self.moments(), len(self)
        if c.resample_below * N < m.ess:
            return
        spread = np.sqrt(np.maximum([m.covariance[HEADING], m.covariance[HEADING + 1]], 0.0))
        launch = _grid(N), BLOCK
        particles_cuda.cumulate[1, self._threads](self._W, self._cumulative)
        particles_cuda.survive[launch](self.rows, self._cumulative, rng.random(), self._spare, self._lw, self._W)
        self.rows, self._spare = self._spare, self.rows
        self._draw(rng, ROUGHENING, 0, 2)
        blocks = self._heading_partial.shape[1] - 1
        particles_cuda.moments[(blocks, 2), self._threads](
            self.rows, self._W, self._heading_pairs, self._heading_partial
        )
        particles_cuda.stir[launch](
            self.rows, HEADING, self._heading_partial, KEPT, self._noise, float(spread[0]), float(spread[1])
        )
        self._moments = None

    def at_home(self) -> Cloud:
        """A copy in the computer's memory."""
        return Cloud(self.rig, self.motion, _state_of(self.rows.copy_to_host()), Weights(self._lw.copy_to_host()))

    def moments(self) -> _Moments:
        """What the weighted particles come to; fetched once for each step."""
        if self._moments is None:
            blocks = self._partial.shape[1] - 1
            particles_cuda.moments[(blocks, len(self.pairs)), self._threads](
                self.rows, self._W, self._pairs, self._partial
            )
            self._moments = _Moments(self._partial.copy_to_host(), self._told.copy_to_host(), self.pairs)
        return self._moments


class _Moments:
    """First and second moments of a cloud's rows, by the sums ``partial`` (pairs, blocks + 1) of `moments`.

    ``mean`` (ROWS,); ``covariance`` of some rows with themselves, by row; ``centre`` (3 + k, 3), the covariance of
    the planes' centre and the motion's linear rows with the centre; ``ess``. Raises FloatingPointError where every
    particle has weight zero.
    """

    def __init__(self, partial: Array, told: Array, pairs: list[tuple[int, int]]) -> None:
        if not np.isfinite(told).all():
            raise FloatingPointError("all particle weights vanish")
        about_first = partial[:, :-1].sum(1)
        self.mean = about_first[:ROWS] + partial[:ROWS, -1]
        second = {
            (i, j): about_first[at] - about_first[i] * about_first[j] for at, (i, j) in enumerate(pairs) if j >= 0
        }
        self.covariance = {i: value for (i, j), value in second.items() if i == j}
        self.centre = np.array([value for (_, j), value in second.items() if PLACE <= j < PLACE + 3]).reshape(-1, 3)
        self.ess = float(1.0 / told[1]) if told[1] > 0 else float("nan")


def _pairs(linear: NDArray[np.int32]) -> list[tuple[int, int]]:
    """The pairs of rows whose moments the filter asks for; those with the centre in their order."""
    places = [PLACE, PLACE + 1, PLACE + 2]
    singles = [(row, -1) for row in range(ROWS)]
    spreads = [(row, row) for row in (CROSSING_LEFT, CROSSING_LEFT + 1, SPEED, HEADING, HEADING + 1)]
    return singles + spreads + [(row, place) for row in (*places, *map(int, linear)) for place in places]


def _grid(n: int) -> int:
    return -(-n // BLOCK)


def _rows_of(state: State) -> Array:
    """``state`` as rows (ROWS, N), those that follow from it still empty."""
    rows = np.zeros((ROWS, len(state)))
    rows[:STATE] = np.concatenate([getattr(state, f).reshape(len(state), -1).T for f in State.__dataclass_fields__])
    return rows


def _state_of(rows: Array) -> State:
    """The state that `_rows_of` made ``rows`` (ROWS, N) of."""
    shapes, first, fields = [(4, 2), (4, 2), (3,), (), (), (), (2,), (3,), (3,)], 0, []
    for shape in shapes:
        k = int(np.prod(shape))
        fields.append(np.ascontiguousarray(rows[first : first + k].T).reshape(-1, *shape))
        first += k
    return State(*fields)


def _rig_numbers(rig: StereoRig) -> Array:
    """What the kernels of `motion_cuda` need of ``rig``: (7, 3, 3)."""
    shifts = np.stack([rig.t, rig.right.K @ rig.t, np.zeros(3)])
    across = rig.right.K @ rig.R @ rig.left.K_inv
    return np.stack([rig.left.K, rig.left.K_inv, rig.right.K, rig.right.K_inv, rig.R, across, shifts])


def _path_numbers(motion: PathMotion | FreeMotion) -> tuple[Array, Array, Array]:
    """Breaks (K,), cubics (K − 1, 3, 4) and roll (K,) of the path: a straight one is a curve of one piece."""
    if isinstance(motion, FreeMotion):
        return np.arange(2.0), np.zeros((1, 3, 4)), np.zeros(2)
    path: Path = motion.path
    return path.pieces()


def _uploaded(packed: Packed) -> tuple[OnDevice, OnDevice]:
    frame = np.array([*packed.words.shape, packed.left, packed.top], np.int32)
    return cuda.to_device(packed.words.reshape(-1)), cuda.to_device(frame)
