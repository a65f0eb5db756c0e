"""A GPU that moves, weights and resamples the particles of all vehicles together, in a few launches a frame.

A launch takes longer than the GPU needs for the particles of one vehicle. So the particle sets only enqueue commands;
the first that needs a result has those of all executed at once, and the results of all are downloaded at once. Uploaded
for a frame are the part of both images that the regions cover, the commands, and for up to
`filter.random_numbers.MAX_SEQUENTIAL_PARTICLES` particles their random numbers.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import cuda
from numba.cuda.cudadrv import driver
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.speed.filter.cuda import kernels, patch_features, weights
from paceline.speed.filter.cuda import memory_layout as layout
from paceline.speed.filter.cuda.particle_set import CudaParticleSet, Moments, derived_rows_of, rows_of
from paceline.speed.filter.cuda.weights import (
    MAX_THREADS_PER_BLOCK,
    PARTIAL_SUMS,
    QUANTITIES_PER_BLOCK,
    THREADS_PER_QUANTITY,
)
from paceline.speed.filter.likelihood import CONTRAST_FLOOR, PART_DISTANCE_CAP, ObservationModel, Views
from paceline.speed.filter.motion_models import NO_DISPLACEMENT, CoordinatedTurn, State
from paceline.speed.filter.particle_set import MAX_DRAWN_PARTICLES, ParticleSet

OnDevice = Any  # an array in the device's memory: Numba has no type for it

THREADS_PER_BLOCK = 128  # one for each particle
MIN_PARTICLES_PER_THREAD = 8  # that a thread adds up before another block shares the vehicle
MAX_BLOCKS_PER_VEHICLE = 64
MAX_PARTICLES_PER_LAUNCH = 1 << 18  # of `CudaDevice.log_likelihood`
SECOND_MOMENT_ROWS = layout.MOMENT_PAIRS[
    :, layout.CARRIED_ROW_COUNT :
]  # (2, pairs, 2) rows of second moments, by IS_FREE


class DeviceArray(cuda.In):  # type: ignore[misc]
    """An array in the device's memory that is passed to many launches.

    Numba prepares an array's descriptor anew for every launch, which takes three times as long as the rest of a launch;
    this one is prepared once.
    """

    def __init__(self, array: OnDevice) -> None:
        super().__init__(array)
        self._descriptor = super().to_device([])

    def to_device(self, retr: object, stream: object = 0) -> OnDevice:
        """The prepared descriptor, when Numba requests it for a launch."""
        return self._descriptor


@dataclass
class _TransferBuffer:
    """A page-locked array in the computer's memory, and its copy on the device."""

    host: NDArray[Any]
    device: DeviceArray

    @classmethod
    def of(cls, size: int, kind: type) -> _TransferBuffer:
        host = cuda.pinned_array(size, kind)
        host[:] = 0
        return cls(host, DeviceArray(cuda.device_array(size, kind)))

    def upload(self, size: int) -> None:
        """Copy the first ``size`` numbers to the device."""
        driver.host_to_device(self.device.value, self.host, size * self.host.itemsize)

    def download(self, size: int) -> NDArray[Any]:
        """Copy the first ``size`` numbers from the device; returns the whole array."""
        driver.device_to_host(self.host, self.device.value, size * self.host.itemsize)
        return self.host


class CudaDevice:
    """The current GPU, and the particle sets on it, which are freed when nothing refers to them."""

    resampling_schemes: Collection[str] = ("systematic",)

    def __init__(self) -> None:
        cuda.current_context()
        warnings.filterwarnings("ignore", "Grid size .* under-utilization")  # a vehicle's particles fill no GPU
        self._particle_sets: dict[int, weakref.ref[CudaParticleSet]] = {}  # by slot
        self._pool = DeviceArray(cuda.device_array((2, layout.ROW_COUNT, 1)))
        self._maps = DeviceArray(cuda.device_array((1, layout.SAMPLING_MAP), np.float32))
        self._pixels = _TransferBuffer.of(1, np.uint32)
        self._host_copy: Array | None = None  # all states and log weights, until they change
        self._new_slots: set[int] = set()  # slots that are not in the tables yet
        self._to_restore: list[CudaParticleSet] = []
        self._to_weight: list[tuple[CudaParticleSet, ObservationModel]] = []
        self._views: Views | None = None  # of those to weight
        self._parameters = 0, 0.0, 0.0  # of those to weight: parts, λ_D, λ_c
        self._pending = False
        self._are_displaced = False  # whether particle sets have other displacements than on the device
        self._noise = 0  # numbers of it in the command buffer
        self._build_tables({})

    def free_memory(self) -> int:
        """Free memory of the device, bytes."""
        return int(cuda.current_context().get_memory_info().free)

    # --- particle sets -----------------------------------------------------------------------------------------------

    def particle_set(self, host: ParticleSet) -> CudaParticleSet:
        """``host`` copied to the device."""
        if self._pending or self._to_weight:
            self.execute()
        occupied = self._occupied_slots()
        slot = next(i for i in range(len(occupied) + 1) if i not in occupied)
        N, first = len(host.state), 0
        for other in sorted(occupied.values(), key=lambda other: other.first):
            if first + N <= other.first:
                break
            first = other.first + len(other)
        self._grow(first + N)
        particle_set = CudaParticleSet(self, host, slot, first)
        rows = cuda.to_device(_one(derived_rows_of(host)))
        kernels.upload[(_grid(N), rows.shape[1]), THREADS_PER_BLOCK](rows, self._pool, first)
        self._particle_sets[slot] = weakref.ref(particle_set)
        self._new_slots.add(slot)
        return particle_set

    def _occupied_slots(self) -> dict[int, CudaParticleSet]:
        return {slot: particle_set for slot, ref in self._particle_sets.items() if (particle_set := ref()) is not None}

    def _grow(self, columns: int) -> None:
        """Enlarge the pool to at least so many columns."""
        before = self._pool.value.shape[2]
        if columns > before:
            old, old_maps = self._pool, self._maps
            capacity = max(columns, 2 * before)
            self._pool = DeviceArray(cuda.device_array((2, layout.ROW_COUNT, capacity)))
            self._maps = DeviceArray(cuda.device_array((capacity, layout.SAMPLING_MAP), np.float32))
            kernels.upload[(_grid(before), layout.ROW_COUNT), THREADS_PER_BLOCK](old, self._pool, 0)
            self._maps.value[:before].copy_to_device(old_maps.value)

    def _build_tables(self, particle_sets: dict[int, CudaParticleSet]) -> None:
        """Build the tables of all ``particle_sets`` particle sets, by slot; all earlier commands have been executed."""
        slots = max(particle_sets, default=-1) + 1
        commands = np.zeros((slots, layout.COMMAND_SIZE))
        knots, knot, total = [np.zeros((1, layout.KNOT_SIZE))], 1, 0
        for slot, particle_set in particle_sets.items():
            command, N = commands[slot], len(particle_set)
            is_new = slot in self._new_slots
            command[[layout.HALF_BEFORE, layout.HALF_AFTER]] = 0 if is_new else self.commands[slot, layout.HALF_AFTER]
            command[[layout.FIRST_COLUMN, layout.PARTICLE_COUNT, layout.DRAWN_STRIDE, layout.HOST_COLUMN]] = (
                particle_set.first,
                N,
                -(-N // MAX_DRAWN_PARTICLES),
                total,
            )
            command[[layout.IS_ACTIVE, layout.IS_FREE, layout.IS_CURVE, layout.IS_COORDINATED_TURN]] = (
                is_new,
                particle_set.free,
                particle_set.motion.name == "curve",
                isinstance(particle_set.motion, CoordinatedTurn),
            )
            command[[layout.KNOT_TABLE_INDEX, layout.KNOT_COUNT]] = knot, len(particle_set.knots)
            knots.append(particle_set.knots)
            knot += len(particle_set.knots)
            command[layout.RIG_INDEX] = slot
            total += N
        self._particle_sets = {slot: weakref.ref(particle_set) for slot, particle_set in particle_sets.items()}
        self._knots = DeviceArray(cuda.to_device(np.concatenate(knots)))
        self._upload_rigs(particle_sets)
        self._allocate_commands(commands, commands.size + 1)
        self._observations = _TransferBuffer.of(layout.HEADER_SIZE + slots * layout.OBSERVATION_SIZE, np.float64)
        counts = commands[:, layout.PARTICLE_COUNT]
        self._largest, self._total = int(counts.max(initial=1)), total
        self._blocks = min(
            -(-self._largest // (MIN_PARTICLES_PER_THREAD * THREADS_PER_QUANTITY)), MAX_BLOCKS_PER_VEHICLE
        )
        self._threads = min(MAX_THREADS_PER_BLOCK, 1 << (self._largest - 1).bit_length())
        sharing = min(-(-self._largest // (MIN_PARTICLES_PER_THREAD * MAX_THREADS_PER_BLOCK)), MAX_BLOCKS_PER_VEHICLE)
        self._shares = DeviceArray(cuda.device_array((max(slots, 1), sharing, PARTIAL_SUMS)))
        n_drawn = int(np.ceil(counts / np.maximum(commands[:, layout.DRAWN_STRIDE], 1)).max(initial=0))
        pairs = SECOND_MOMENT_ROWS[
            [int(particle_set.free) for particle_set in particle_sets.values()]
        ]  # (particle sets, pairs, 2)
        self._second = np.arange(len(pairs))[:, None], pairs[..., 0], pairs[..., 1]
        self._moments_size = slots * layout.QUANTITY_COUNT * self._blocks * 2
        self._results = _TransferBuffer.of(
            max(self._moments_size + slots * layout.DRAWN_ROW_COUNT * n_drawn, 1), np.float64
        )
        self._host_copy, self._pending = None, bool(particle_sets)
        self._new_slots.clear()

    def _allocate_commands(self, commands: Array, size: int) -> None:
        """Allocate a command buffer of ``size`` numbers that begins with ``commands`` (slots, COMMAND_SIZE)."""
        self._command_buffer = _TransferBuffer.of(size, np.float64)
        self.commands = self._command_buffer.host[: commands.size].reshape(commands.shape)
        self.commands[:] = commands

    def enqueue(self, particle_set: CudaParticleSet, command: int) -> None:
        """Enqueue the command ``command`` for ``particle_set``, after those already enqueued."""
        if (
            self._new_slots
            or self._to_weight
            or self.commands[particle_set.slot, command : layout.KALMAN_UPDATE + 1].any()
        ):
            self.execute()
        self.commands[particle_set.slot, command] = self.commands[particle_set.slot, layout.IS_ACTIVE] = 1
        self._pending, self._host_copy, particle_set.moments = True, None, None

    def displace(self, particle_set: CudaParticleSet) -> None:
        """Enqueue that ``particle_set`` has another displacement, after the commands already enqueued."""
        if self.commands[particle_set.slot, layout.IS_ACTIVE]:
            self.execute()
        self.commands[particle_set.slot, layout.IS_ACTIVE] = 1  # its maps follow from it
        self._pending = self._are_displaced = True

    def _upload_rigs(self, particle_sets: dict[int, CudaParticleSet]) -> None:
        rigs = np.zeros((max(particle_sets, default=0) + 1, 7, 3, 3))
        for slot, particle_set in particle_sets.items():
            rigs[slot] = rig_numbers(particle_set.rig, particle_set.displacement)
        self._rigs, self._are_displaced = DeviceArray(cuda.to_device(rigs)), False

    def store_noise(self, noise: Array) -> int:
        """Append ``noise`` to the command buffer; returns its index."""
        offset = self.commands.size + self._noise
        if offset + noise.size > self._command_buffer.host.size:
            before = self._command_buffer.host
            self._allocate_commands(self.commands, 2 * (offset + noise.size))
            self._command_buffer.host[:offset] = before[:offset]
        self._command_buffer.host[offset : offset + noise.size] = noise.reshape(-1)
        self._noise += noise.size
        return offset

    # --- launches ----------------------------------------------------------------------------------------------------

    def execute(self) -> None:
        """Execute everything that was enqueued: restored weights, then commands, then the update of weights."""
        if self._new_slots:
            self._build_tables(self._occupied_slots())
        if self._pending:
            self._execute_commands()
        if self._to_weight:
            self._weight()

    def _execute_commands(self) -> None:
        if self._to_restore:
            slots = [particle_set.slot for particle_set in self._to_restore]
            self._observation_table()[slots, layout.WEIGHT_UPDATE] = -1
            self._observations.upload(self._observations.host.size)
            self._update_weights(self._to_restore)
            self._to_restore = []
        commands = self.commands
        self._command_buffer.upload(commands.size + self._noise)
        if self._are_displaced:
            self._upload_rigs(self._occupied_slots())
        if commands[:, layout.RESAMPLE].any():
            self._cumulate()
        if commands[:, layout.IS_ACTIVE].any():
            kernels.execute[(_grid(self._largest), len(commands)), THREADS_PER_BLOCK](
                self._pool, self._command_buffer.device, self._rigs, self._knots, self._maps
            )
        commands[:, layout.HALF_BEFORE] = commands[:, layout.HALF_AFTER]
        commands[:, layout.RESAMPLE : layout.IS_ACTIVE + 1] = 0
        self._noise, self._pending = 0, False

    def weight(self, particle_set: CudaParticleSet, model: ObservationModel, views: Views) -> None:
        """Enqueue the update of the weights of ``particle_set`` by what ``views`` show.

        All that are enqueued with the same views before a result is requested are updated in the same launches.
        """
        parameters = model.grid.parts, model.lambda_single, model.lambda_cross
        if self._to_weight and (views is not self._views or parameters != self._parameters):
            self.execute()
        self._views, self._parameters = views, parameters
        self._to_weight.append((particle_set, model))
        self._host_copy, particle_set.moments = None, None

    def _weight(self) -> None:
        assert self._views is not None
        observations = self._observation_table()
        for particle_set, model in self._to_weight:
            _write_reference(observations[particle_set.slot], model)
            observations[particle_set.slot, layout.WEIGHT_UPDATE] = 1
        parts, *lambdas = self._parameters
        self._upload_views(self._views, lambdas, self._observations)
        self._observations.upload(self._observations.host.size)
        self.compute_likelihood(parts)
        self._update_weights([particle_set for particle_set, _ in self._to_weight])
        self._to_weight, self._views = [], None

    def compute_likelihood(self, parts: int) -> None:
        """Launch log p(z | x) by (12), (13), (18) for all particles to be weighted, from what was uploaded."""
        patch_features.log_likelihood[(self._largest, len(self.commands)), 16 * parts](
            self._pixels.device, self._maps, self._observations.device, self._pool
        )

    def restore_weights(self, particle_set: CudaParticleSet) -> None:
        """Enqueue that the weights of ``particle_set`` before their last update are restored."""
        if self._to_weight:
            self.execute()
        self._to_restore.append(particle_set)
        self._pending, self._host_copy, particle_set.moments = True, None, None

    def _observation_table(self) -> Array:
        """The table (slots, OBSERVATION_SIZE) of observations, with no weights to be updated yet."""
        observations = self._observations.host[layout.HEADER_SIZE :].reshape(-1, layout.OBSERVATION_SIZE)
        observations[:, : layout.WEIGHT_UPDATE] = self.commands[:, : layout.WEIGHT_UPDATE]
        observations[:, layout.WEIGHT_UPDATE] = 0
        return observations

    @property
    def _shared_grid(self) -> tuple[int, int]:
        """Blocks that share the weights of a vehicle, and slots."""
        return self._shares.value.shape[1], len(self.commands)

    def _cumulate(self) -> None:
        if self._shared_grid[0] > 1:
            weights.sum_weights[self._shared_grid, self._threads](self._pool, self._command_buffer.device, self._shares)
        weights.cumulate_weights[self._shared_grid, self._threads](
            self._pool, self._command_buffer.device, self._shares
        )
        if self._shared_grid[0] > 1:
            weights.average_headings[_grid(len(self.commands)), THREADS_PER_BLOCK](
                self._command_buffer.device, self._shares
            )

    def _update_weights(self, particle_sets: Sequence[CudaParticleSet]) -> None:
        weights.update_weights[self._shared_grid, self._threads](self._pool, self._observations.device, self._shares)
        if self._shared_grid[0] > 1:
            weights.normalise[self._shared_grid, self._threads](self._pool, self._observations.device, self._shares)
        self._host_copy = None
        for particle_set in particle_sets:
            particle_set.moments = None

    def _upload_views(self, views: Views, lambdas: Sequence[float], observations: _TransferBuffer) -> None:
        """Upload the pixels of both ``views``, and write the header of ``observations``."""
        sizes = [packed.words.size for packed in views]
        if sum(sizes) > self._pixels.host.size:
            self._pixels = _TransferBuffer.of(2 * sum(sizes), np.uint32)
        self._pixels.host[: sizes[0]] = views[0].words.reshape(-1)
        self._pixels.host[sizes[0] : sum(sizes)] = views[1].words.reshape(-1)
        self._pixels.upload(sum(sizes))
        frames = [(*packed.words.shape, packed.left, packed.top) for packed in views]
        constants = CONTRAST_FLOOR, PART_DISTANCE_CAP, *lambdas
        observations.host[: layout.HEADER_SIZE] = *frames[0], *frames[1], *sizes, *constants

    def log_likelihood(self, model: ObservationModel, views: Views, state: State) -> Array:
        """log p(z | x) (N,) of particles that are in the computer's memory."""
        values = []
        observations = _TransferBuffer.of(layout.HEADER_SIZE + layout.OBSERVATION_SIZE, np.float64)
        observation = observations.host[layout.HEADER_SIZE :]
        _write_reference(observation, model)
        self._upload_views(views, (model.lambda_single, model.lambda_cross), observations)
        rigs, knots = cuda.to_device(_one(rig_numbers(model.rig))), cuda.to_device(np.zeros((1, layout.KNOT_SIZE)))
        for first in range(0, len(state), MAX_PARTICLES_PER_LAUNCH):
            part = state[np.arange(first, min(first + MAX_PARTICLES_PER_LAUNCH, len(state)))]
            N = len(part)
            command = np.zeros(layout.COMMAND_SIZE)
            command[[layout.PARTICLE_COUNT, layout.IS_ACTIVE]] = N, 1
            observation[[layout.FIRST_COLUMN, layout.PARTICLE_COUNT, layout.HALF_BEFORE, layout.WEIGHT_UPDATE]] = (
                0,
                N,
                0,
                1,
            )
            observations.upload(observations.host.size)
            rows = np.zeros((1, layout.ROW_COUNT, N))
            rows[0, : layout.STATE_ROW_COUNT] = rows_of(part)
            pool, maps = cuda.to_device(rows), cuda.device_array((N, layout.SAMPLING_MAP), np.float32)
            kernels.execute[(_grid(N), 1), THREADS_PER_BLOCK](pool, cuda.to_device(command), rigs, knots, maps)
            patch_features.log_likelihood[(N, 1), 16 * model.grid.parts](
                self._pixels.device, maps, observations.device, pool
            )
            values.append(pool[0, layout.LIKELIHOOD_ROW].copy_to_host())
        return np.concatenate(values)

    # --- results -----------------------------------------------------------------------------------------------------

    def reduce_moments(self, drawn: bool) -> None:
        """Execute everything, and give all particle sets their moments, with ``drawn`` also the centres to draw."""
        self.execute()
        occupied = self._occupied_slots()
        if len(occupied) < len(self._particle_sets):
            self._build_tables(occupied)
            self.execute()
        blocks = (
            self._blocks,
            -(-(layout.QUANTITY_COUNT + layout.DRAWN_ROW_COUNT) // QUANTITIES_PER_BLOCK),
            len(self.commands),
        )
        threads = min(self._threads, THREADS_PER_QUANTITY), QUANTITIES_PER_BLOCK
        weights.reduce_moments[blocks, threads](self._pool, self._command_buffer.device, self._results.device)
        results = self._results.download(self._results.host.size if drawn else self._moments_size)
        places = (
            results[self._moments_size :].reshape(len(self.commands), layout.DRAWN_ROW_COUNT, -1) if drawn else None
        )
        parts = results[: self._moments_size].reshape(-1, layout.QUANTITY_COUNT, self._blocks, 2)[list(occupied)]
        sums, extremes = parts[:, : layout.FIRST_EXTREME, :, 0].sum(2), parts[:, layout.FIRST_EXTREME :]
        mean = sums[:, : layout.CARRIED_ROW_COUNT] + parts[:, : layout.CARRIED_ROW_COUNT, 0, 1]
        squares, (each, i, j) = sums[:, layout.SUM_OF_SQUARES].tolist(), self._second
        second = sums[:, layout.CARRIED_ROW_COUNT : layout.MOMENT_COUNT] - sums[each, i] * sums[each, j]
        bounds = np.stack([extremes[..., 0].min(2), extremes[..., 1].max(2)], axis=1).reshape(-1, 2, 2, 4, 2)
        for k, (slot, particle_set) in enumerate(occupied.items()):
            particle_set.moments = Moments(
                mean[k], second[k], squares[k], bounds[k], None if places is None else places[slot]
            )

    def download(self, particle_set: CudaParticleSet) -> Array:
        """State and log weights (STATE_ROW_COUNT + 1, N) of ``particle_set``; those of all are downloaded at once."""
        self.execute()
        if self._host_copy is None:
            host = cuda.device_array((layout.STATE_ROW_COUNT + 1, self._total))
            kernels.download[(_grid(self._largest), len(self.commands)), THREADS_PER_BLOCK](
                self._pool, self._command_buffer.device, host
            )
            self._host_copy = host.copy_to_host()
        first = int(self.commands[particle_set.slot, layout.HOST_COLUMN])
        return self._host_copy[:, first : first + len(particle_set)]


def _one(numbers: Array) -> Array:
    """``numbers`` with a leading axis of one; by indexing its stride would be 0, which Numba copies slowly."""
    return numbers.reshape(1, *numbers.shape)


def _grid(n: int) -> int:
    return -(-n // THREADS_PER_BLOCK)


def _write_reference(observation: Array, model: ObservationModel) -> None:
    """Writes the grid and the reference features of ``model`` into a vehicle's ``observation`` (OBSERVATION_SIZE,)."""
    grid, reference = model.grid, model.reference
    observation[layout.PART_GRID : layout.PART_GRID + 4] = grid.across, grid.down, *grid.samples
    observation[layout.REFERENCE_FEATURES : layout.REFERENCE_FEATURES + reference.size] = reference.reshape(-1)


def rig_numbers(rig: StereoRig, displacement: Array = NO_DISPLACEMENT) -> Array:
    """The matrices of ``rig`` for the kernels of `motion`, of planes that move by ``displacement`` (3,) m between the
    exposures: (7, 3, 3)."""
    apparent = rig.displaced(displacement).t
    shifts = np.stack([rig.t, rig.right.K @ apparent, apparent])
    across = rig.right.K @ rig.R @ rig.left.K_inv
    return np.stack([rig.left.K, rig.left.K_inv, rig.right.K, rig.right.K_inv, rig.R, across, shifts])
