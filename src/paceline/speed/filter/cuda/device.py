"""A GPU on which the particles of all vehicles are moved, weighed and resampled together, in a few launches a frame.

A launch takes longer than the GPU needs for the particles of a vehicle. So the clouds only note what is to be done
with their particles; the first to ask for a result has the orders of all of them carried out at once, and the results
of all come back at once. What goes to the GPU for a frame is the part of both images that is looked at, the orders,
and for up to `filter.random_numbers.MANY` particles their random numbers.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import cuda
from numba.cuda.cudadrv import driver
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.cuda import kernels, patch_features, weights
from paceline.speed.filter.cuda import memory_layout as at
from paceline.speed.filter.cuda.particle_set import CudaCloud, Found, all_rows_of, rows_of
from paceline.speed.filter.cuda.weights import SHARES, SIDE_BY_SIDE, SURVEYORS, THREADS
from paceline.speed.filter.likelihood import CONTRAST_FLOOR, PART_DISTANCE_CAP, Grid
from paceline.speed.filter.motion_models import State
from paceline.speed.filter.particle_set import SHOWN, Cloud, Views

OnDevice = Any  # an array in the device's memory: Numba has no type for it

BLOCK = 128  # threads of a block, one a particle
EACH = 8  # particles at least that a thread adds up, before another block takes a share in a vehicle
MOST_BLOCKS = 64  # that share one
AT_ONCE = 1 << 18  # particles of the search for a first speed that are weighed in one launch
SECOND = at.PAIRS[:, at.MOVING :]  # (2, pairs, 2) rows of second moments, by FREE


class Follower(Protocol):
    """One who follows a vehicle: what its particles look at and are compared with."""

    rig: StereoRig
    configuration: SpeedConfiguration
    cloud: Cloud | CudaCloud
    views: Views
    grid: Grid
    reference: NDArray[np.float32]


class Kept(cuda.In):  # type: ignore[misc, name-defined]
    """An array in the device's memory that is given to launch after launch.

    Numba describes an array to the driver anew for every launch, which takes it three times as long as all else in a
    launch; this one is described once.
    """

    def __init__(self, array: OnDevice) -> None:
        super().__init__(array)
        self._described = super().to_device([])

    def to_device(self, retr: object, stream: object = 0) -> OnDevice:
        """What the launch is told, as Numba asks for it."""
        return self._described


@dataclass
class _Shared:
    """An array in the computer's memory from which the device is fed, or to which it tells, and its copy there."""

    home: NDArray[Any]
    there: Kept

    @classmethod
    def of(cls, size: int, kind: type) -> _Shared:
        home = cuda.pinned_array(size, kind)
        home[:] = 0
        return cls(home, Kept(cuda.device_array(size, kind)))

    def send(self, size: int) -> None:
        """The first ``size`` numbers."""
        driver.host_to_device(self.there.value, self.home, size * self.home.itemsize)  # type: ignore[no-untyped-call]

    def fetch(self, size: int) -> NDArray[Any]:
        """Of all that is at home the first numbers, so many, anew."""
        driver.device_to_host(self.home, self.there.value, size * self.home.itemsize)  # type: ignore[no-untyped-call]
        return self.home


class CudaDevice:
    """The current GPU, and the clouds that live on it for as long as somebody holds them."""

    def __init__(self) -> None:
        cuda.current_context()  # type: ignore[no-untyped-call]
        warnings.filterwarnings("ignore", "Grid size .* under-utilization")  # a vehicle's particles fill no GPU
        self._clouds: dict[int, weakref.ref[CudaCloud]] = {}  # by slot
        self._pool = Kept(cuda.device_array((2, at.ROWS, 1)))
        self._maps = Kept(cuda.device_array((1, at.MAPS), np.float32))
        self._pixels = _Shared.of(1, np.uint32)
        self._home: Array | None = None  # all states and log weights, as long as they are as fetched
        self._joined: set[int] = set()  # slots of clouds that are not in the tables yet
        self._unweighed: list[CudaCloud] = []
        self._pending = False
        self._noise = 0  # numbers of it that are on the desk
        self._tabulate({})

    def free_memory(self) -> int:
        """Bytes."""
        return int(cuda.current_context().get_memory_info().free)  # type: ignore[no-untyped-call]

    # --- clouds ------------------------------------------------------------------------------------------------------

    def cloud(self, home: Cloud) -> CudaCloud:
        """``home`` copied to the device."""
        if self._pending:
            self.carry_out()
        living = self._living()
        slot = next(i for i in range(len(living) + 1) if i not in living)
        N, first = len(home.state), 0
        for other in sorted(living.values(), key=lambda other: other.first):
            if first + N <= other.first:
                break
            first = other.first + len(other)
        self._grow(first + N)
        cloud = CudaCloud(self, home, slot, first)
        rows = cuda.to_device(_one(all_rows_of(home)))
        kernels.settle[(_grid(N), rows.shape[1]), BLOCK](rows, self._pool, first)
        self._clouds[slot] = weakref.ref(cloud)
        self._joined.add(slot)
        return cloud

    def _living(self) -> dict[int, CudaCloud]:
        return {slot: cloud for slot, ref in self._clouds.items() if (cloud := ref()) is not None}

    def _grow(self, columns: int) -> None:
        """Room for so many in the pool, or more."""
        before = self._pool.value.shape[2]
        if columns > before:
            old, old_maps = self._pool, self._maps
            room = max(columns, 2 * before)
            self._pool = Kept(cuda.device_array((2, at.ROWS, room)))
            self._maps = Kept(cuda.device_array((room, at.MAPS), np.float32))
            kernels.settle[(_grid(before), at.ROWS), BLOCK](old, self._pool, 0)
            self._maps.value[:before].copy_to_device(old_maps.value)

    def _tabulate(self, living: dict[int, CudaCloud]) -> None:
        """The tables of all ``living`` clouds, by slot; what was ordered before has been carried out."""
        slots = max(living, default=-1) + 1
        orders = np.zeros((slots, at.ORDER))
        knots, rigs, knot, total = [np.zeros((1, at.KNOT))], [np.zeros((7, 3, 3))], 1, 0
        numbers: dict[int, int] = {}
        for slot, cloud in living.items():
            order, N = orders[slot], len(cloud)
            joins = slot in self._joined
            order[[at.BEFORE, at.NOW]] = 0 if joins else self.orders[slot, at.NOW]
            order[[at.FIRST, at.COUNT, at.EVERY, at.AT_HOME]] = cloud.first, N, -(-N // SHOWN), total
            order[[at.PREPARED, at.FREE, at.TURNS]] = joins, cloud.free, cloud.motion.name == "curve"
            order[[at.KNOTS, at.KNOT_COUNT]] = knot, len(cloud.knots)
            knots.append(cloud.knots)
            knot += len(cloud.knots)
            if id(cloud.rig) not in numbers:
                numbers[id(cloud.rig)] = len(rigs)
                rigs.append(rig_numbers(cloud.rig))
            order[at.RIG] = numbers[id(cloud.rig)]
            total += N
        self._clouds = {slot: weakref.ref(cloud) for slot, cloud in living.items()}
        self._knots, self._rigs = Kept(cuda.to_device(np.concatenate(knots))), Kept(cuda.to_device(np.stack(rigs)))
        self._lay(orders, orders.size + 1)
        self._sights = _Shared.of(at.HEADER + slots * at.SIGHT, np.float64)
        counts = orders[:, at.COUNT]
        self._largest, self._total = int(counts.max(initial=1)), total
        self._blocks = min(-(-self._largest // (EACH * SURVEYORS)), MOST_BLOCKS)
        self._threads = min(THREADS, 1 << (self._largest - 1).bit_length())
        sharing = min(-(-self._largest // (EACH * THREADS)), MOST_BLOCKS)
        self._shares = Kept(cuda.device_array((max(slots, 1), sharing, SHARES)))
        shown = int(np.ceil(counts / np.maximum(orders[:, at.EVERY], 1)).max(initial=0))
        pairs = SECOND[[int(cloud.free) for cloud in living.values()]]  # (clouds, pairs, 2)
        self._second = np.arange(len(pairs))[:, None], pairs[..., 0], pairs[..., 1]
        self._moments = slots * at.QUANTITIES * self._blocks * 2
        self._told = _Shared.of(max(self._moments + slots * at.SHOWN_ROWS * shown, 1), np.float64)
        self._home, self._pending = None, bool(living)
        self._joined.clear()

    def _lay(self, orders: Array, size: int) -> None:
        """A desk of so many numbers, with ``orders`` (slots, ORDER) on it."""
        self._desk = _Shared.of(size, np.float64)
        self.orders = self._desk.home[: orders.size].reshape(orders.shape)
        self.orders[:] = orders

    def order(self, cloud: CudaCloud, what: int) -> None:
        """Notes that ``what`` is to be done with ``cloud``, after what is already to be done."""
        if self._joined or self.orders[cloud.slot, what : at.CORRECTED + 1].any():
            self.carry_out()
        self.orders[cloud.slot, what] = self.orders[cloud.slot, at.PREPARED] = 1
        self._pending, self._home, cloud.found = True, None, None

    def keep(self, noise: Array) -> int:
        """Puts ``noise`` on the desk; returns where."""
        where = self.orders.size + self._noise
        if where + noise.size > self._desk.home.size:
            before = self._desk.home
            self._lay(self.orders, 2 * (where + noise.size))
            self._desk.home[:where] = before[:where]
        self._desk.home[where : where + noise.size] = noise.reshape(-1)
        self._noise += noise.size
        return where

    # --- launches ----------------------------------------------------------------------------------------------------

    def carry_out(self) -> None:
        """Does with all clouds what was ordered."""
        if self._joined:
            self._tabulate(self._living())
        if not self._pending:
            return
        if self._unweighed:
            self._table()[[cloud.slot for cloud in self._unweighed], at.TIMES] = -1
            self._sights.send(self._sights.home.size)
            self._reweigh(self._unweighed)
            self._unweighed = []
        orders = self.orders
        self._desk.send(orders.size + self._noise)
        if orders[:, at.RESAMPLED].any():
            self._cumulate()
        if orders[:, at.PREPARED].any():
            kernels.carry_out[(_grid(self._largest), len(orders)), BLOCK](
                self._pool, self._desk.there, self._rigs, self._knots, self._maps
            )
        orders[:, at.BEFORE] = orders[:, at.NOW]
        orders[:, at.RESAMPLED : at.PREPARED + 1] = 0
        self._noise, self._pending = 0, False

    def weigh(self, trackers: Sequence[Follower]) -> None:
        """Update the weights of all clouds of ``trackers``, which look at the same views."""
        self.carry_out()
        c, clouds = trackers[0].configuration, [t.cloud for t in trackers if isinstance(t.cloud, CudaCloud)]
        alike = {(t.configuration.parts, t.configuration.lambda_single, t.configuration.lambda_cross) for t in trackers}
        assert len(alike) == 1 and len(clouds) == len(trackers)
        sights = self._table()
        for tracker, cloud in zip(trackers, clouds, strict=True):
            _describe(sights[cloud.slot], tracker)
            sights[cloud.slot, at.TIMES] = 1
        self._show(trackers[0].views, c, self._sights)
        self._sights.send(self._sights.home.size)
        self.look(c.parts)
        self._reweigh(clouds)

    def look(self, parts: int) -> None:
        """log p(z | x) by (12), (13), (18) of all particles that are to be weighed, by what was sent."""
        patch_features.log_likelihood[(self._largest, len(self.orders)), 16 * parts](
            self._pixels.there, self._maps, self._sights.there, self._pool
        )

    def unweigh(self, cloud: CudaCloud) -> None:
        """Notes that the last update of the weights of ``cloud`` is to be taken back."""
        self._unweighed.append(cloud)
        self._pending, self._home, cloud.found = True, None, None

    def _table(self) -> Array:
        """The table (slots, SIGHT) of sights, in which nothing is to be weighed yet."""
        sights = self._sights.home[at.HEADER :].reshape(-1, at.SIGHT)
        sights[:, : at.TIMES] = self.orders[:, : at.TIMES]
        sights[:, at.TIMES] = 0
        return sights

    @property
    def _sharing(self) -> tuple[int, int]:
        """Blocks that share the weights of a vehicle, and slots."""
        return self._shares.value.shape[1], len(self.orders)

    def _cumulate(self) -> None:
        if self._sharing[0] > 1:
            weights.add_up[self._sharing, self._threads](self._pool, self._desk.there, self._shares)
        weights.cumulate[self._sharing, self._threads](self._pool, self._desk.there, self._shares)
        if self._sharing[0] > 1:
            weights.average[_grid(len(self.orders)), BLOCK](self._desk.there, self._shares)

    def _reweigh(self, clouds: Sequence[CudaCloud]) -> None:
        weights.reweigh[self._sharing, self._threads](self._pool, self._sights.there, self._shares)
        if self._sharing[0] > 1:
            weights.normalise[self._sharing, self._threads](self._pool, self._sights.there, self._shares)
        self._home = None
        for cloud in clouds:
            cloud.found = None

    def _show(self, views: Views, c: SpeedConfiguration, sights: _Shared) -> None:
        """Sends the pixels of both ``views``, and writes the header of ``sights``."""
        sizes = [packed.words.size for packed in views]
        if sum(sizes) > self._pixels.home.size:
            self._pixels = _Shared.of(2 * sum(sizes), np.uint32)
        self._pixels.home[: sizes[0]] = views[0].words.reshape(-1)
        self._pixels.home[sizes[0] : sum(sizes)] = views[1].words.reshape(-1)
        self._pixels.send(sum(sizes))
        frames = [(*packed.words.shape, packed.left, packed.top) for packed in views]
        constants = CONTRAST_FLOOR, PART_DISTANCE_CAP, c.lambda_single, c.lambda_cross
        sights.home[: at.HEADER] = *frames[0], *frames[1], *sizes, *constants

    def log_likelihood(self, tracker: Follower, state: State) -> Array:
        """log p(z | x) (N,) of particles that are in the computer's memory."""
        found = []
        sights = _Shared.of(at.HEADER + at.SIGHT, np.float64)
        sight = sights.home[at.HEADER :]
        _describe(sight, tracker)
        self._show(tracker.views, tracker.configuration, sights)
        rigs, knots = cuda.to_device(_one(rig_numbers(tracker.rig))), cuda.to_device(np.zeros((1, at.KNOT)))
        for first in range(0, len(state), AT_ONCE):
            part = state[np.arange(first, min(first + AT_ONCE, len(state)))]
            N = len(part)
            order = np.zeros(at.ORDER)
            order[[at.COUNT, at.PREPARED]] = N, 1
            sight[[at.FIRST, at.COUNT, at.BEFORE, at.TIMES]] = 0, N, 0, 1
            sights.send(sights.home.size)
            rows = np.zeros((1, at.ROWS, N))
            rows[0, : at.STATE] = rows_of(part)
            pool, maps = cuda.to_device(rows), cuda.device_array((N, at.MAPS), np.float32)
            kernels.carry_out[(_grid(N), 1), BLOCK](pool, cuda.to_device(order), rigs, knots, maps)
            patch_features.log_likelihood[(N, 1), 16 * tracker.configuration.parts](
                self._pixels.there, maps, sights.there, pool
            )
            found.append(pool[0, at.LIKELIHOOD].copy_to_host())
        return np.concatenate(found)

    # --- results -----------------------------------------------------------------------------------------------------

    def survey(self, shown: bool) -> None:
        """Has everything carried out, and tells all clouds what their particles come to, and the places ``shown`` if
        these are asked for."""
        self.carry_out()
        living = self._living()
        if len(living) < len(self._clouds):
            self._tabulate(living)
            self.carry_out()
        blocks = self._blocks, -(-(at.QUANTITIES + at.SHOWN_ROWS) // SIDE_BY_SIDE), len(self.orders)
        threads = min(self._threads, SURVEYORS), SIDE_BY_SIDE
        weights.survey[blocks, threads](self._pool, self._desk.there, self._told.there)
        told = self._told.fetch(self._told.home.size if shown else self._moments)
        places = told[self._moments :].reshape(len(self.orders), at.SHOWN_ROWS, -1) if shown else None
        parts = told[: self._moments].reshape(-1, at.QUANTITIES, self._blocks, 2)[list(living)]
        sums, extremes = parts[:, : at.EXTREMES, :, 0].sum(2), parts[:, at.EXTREMES :]
        mean = sums[:, : at.MOVING] + parts[:, : at.MOVING, 0, 1]
        squares, (each, i, j) = sums[:, at.SQUARES].tolist(), self._second
        second = sums[:, at.MOVING : at.MOMENTS] - sums[each, i] * sums[each, j]
        reach = np.stack([extremes[..., 0].min(2), extremes[..., 1].max(2)], axis=1).reshape(-1, 2, 2, 4, 2)
        for k, (slot, cloud) in enumerate(living.items()):
            cloud.found = Found(mean[k], second[k], squares[k], reach[k], None if places is None else places[slot])

    def fetched(self, cloud: CudaCloud) -> Array:
        """The state and the log weights (STATE + 1, N) of ``cloud``; those of all are fetched at once."""
        self.carry_out()
        if self._home is None:
            home = cuda.device_array((at.STATE + 1, self._total))
            kernels.collect[(_grid(self._largest), len(self.orders)), BLOCK](self._pool, self._desk.there, home)
            self._home = home.copy_to_host()
        first = int(self.orders[cloud.slot, at.AT_HOME])
        return self._home[:, first : first + len(cloud)]


def _one(numbers: Array) -> Array:
    """``numbers`` in an array of one; by indexing its stride would be 0, which Numba copies number by number."""
    return numbers.reshape(1, *numbers.shape)


def _grid(n: int) -> int:
    return -(-n // BLOCK)


def _describe(sight: Array, tracker: Follower) -> None:
    """What ``tracker`` compares its particles with, into its ``sight`` (SIGHT,)."""
    grid, reference = tracker.grid, tracker.reference
    sight[at.GRID : at.GRID + 4] = grid.across, grid.down, *grid.samples
    sight[at.REFERENCE : at.REFERENCE + reference.size] = reference.reshape(-1)


def rig_numbers(rig: StereoRig) -> Array:
    """What the kernels of `motion` need of ``rig``: (7, 3, 3)."""
    shifts = np.stack([rig.t, rig.right.K @ rig.t, np.zeros(3)])
    across = rig.right.K @ rig.R @ rig.left.K_inv
    return np.stack([rig.left.K, rig.left.K_inv, rig.right.K, rig.right.K_inv, rig.R, across, shifts])
