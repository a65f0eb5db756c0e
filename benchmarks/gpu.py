"""A filter step on the CPU and on a GPU, side by side, and how near the GPU comes to what it could do.

python benchmarks/gpu.py [--seconds 480] [--seed 0]

Without a GPU it measures the CPU alone, and says so.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from common import head, machine, row
from likelihood import HEIGHT, WIDTH, Work

from paceline import SpeedConfiguration
from paceline.cameras import Camera, StereoRig
from paceline.recordings.stereo import StereoFrame
from paceline.speed.filter import likelihood, random_numbers
from paceline.speed.filter.device import DeviceFailure, open_device
from paceline.speed.filter.likelihood import ObservationModel, PartGrid, pack_views
from paceline.speed.filter.motion_models import PathMotion, State
from paceline.speed.filter.particle_set import CPU, ParticleSet
from paceline.speed.filter.resampling import Weights
from paceline.speed.geometry import paths

PARTICLES = [100, 400, 1_000, 10_000, 100_000, 1_000_000]
VEHICLES = [1, 4, 16, 64, 256]
CELL = 6.0  # s, that one cell may take
REPETITIONS = 15
BYTES = 2_100  # of device memory a particle takes at most, while the room for them grows
DT = 1e-4  # s: the particles stay where the images show the region
MAPS, OUT = 39 * 4, 8  # bytes a particle that the kernel must read and write at least
INSTRUCTIONS = 48  # of PTX for a sample: its place, the clamps, the interpolation, the sums


@dataclass
class Vehicle:
    """The filter of one vehicle, without registration."""

    configuration: SpeedConfiguration
    model: ObservationModel
    particle_set: Any
    rng: np.random.Generator


class Road:
    """``vehicles`` vehicles of ``particles`` particles each, spread over a pair of textured pictures."""

    def __init__(self, particles: int, vehicles: int, seed: int, device: Any) -> None:
        work = Work(1, seed)
        self.device = device
        self.frame = StereoFrame(0, 0.0, work.left, work.right, 0.0, False)
        K = np.array([[2200.0, 0, WIDTH / 2], [0, 2200.0, HEIGHT / 2], [0, 0, 1]])
        rig = StereoRig(Camera((WIDTH, HEIGHT), K), Camera((WIDTH, HEIGHT), K), np.eye(3), np.array([-0.5, 0, 0]))
        lane = paths.from_points("lane", "line", np.array([[0.0, 1.0, 80.0], [0.0, 1.0, 20.0]]))
        c = SpeedConfiguration(particles=particles)
        self.vehicles: list[Vehicle] = []
        for v in range(vehicles):
            rng = random_numbers.make_generator([seed, v], particles)
            centre = np.array([rng.uniform(-8, 8), rng.uniform(-6, 6), 60.0])
            corners = np.array([[-1.4, -0.6, 0], [1.4, -0.6, 0], [1.4, 0.6, 0], [-1.4, 0.6, 0]])
            at = centre + rng.normal(0.0, [0.05, 0.05, 0.5], (particles, 3))
            left, right = (q.reshape(-1, 4, 2) for q in rig.project((at[:, None] + corners).reshape(-1, 3)))
            zeros = np.zeros((particles, 3))
            normal = np.tile([0.0, 0.0, -1.0], (particles, 1))
            state = State(left, right, normal, -at[:, 2], zeros[:, 0] + 20, zeros[:, 0], zeros[:, :2], zeros, zeros)
            particle_set = ParticleSet(rig, PathMotion(rig, lane, c), state, Weights.equal(particles))
            model = ObservationModel(rig, PartGrid.for_region(c.parts, left[0]), c)
            model.initialize(pack_views(self.frame, [particle_set.image_bounds()]), state[np.zeros(1, np.int64)])
            self.vehicles.append(Vehicle(c, model, (device or CPU).particle_set(particle_set), rng))
        grid = self.vehicles[0].model.grid
        self.samples = 16 * c.parts * grid.samples[0] * grid.samples[1]

    def weight(self) -> None:
        """Update the weights by the likelihood of what the frame shows."""
        views = pack_views(self.frame, [vehicle.particle_set.image_bounds() for vehicle in self.vehicles])
        for vehicle in self.vehicles:
            vehicle.particle_set.weight(vehicle.model, views)

    def step(self) -> None:
        """One stereo frame as [Zhu] has it, without registration: predict, weight, estimate, resample."""
        for vehicle in self.vehicles:
            vehicle.particle_set.propagate(DT, vehicle.rng)
        self.weight()
        for vehicle in self.vehicles:
            vehicle.particle_set.posterior()
            vehicle.particle_set.resample(vehicle.configuration, vehicle.rng)


def milliseconds(work: Callable[[], object], until: float) -> float:
    """Median time of ``work``, after one time not counted, within the CELL and not beyond ``until``."""
    work()
    times: list[float] = []
    end = min(time.perf_counter() + CELL, until)
    while len(times) < REPETITIONS and (not times or time.perf_counter() < end):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times))


def steps(seed: int, device: Any, until: float) -> None:
    """The table of filter steps; what would take too long, or too much memory, is left out."""
    cores = os.cpu_count() or 1
    threads = sorted({1, 2, cores} & set(range(1, numba.config.NUMBA_NUM_THREADS + 1)))
    names = [*(f"CPU, {n} thread{'s' * (n > 1)}" for n in threads), "GPU"]
    print(head("vehicles", "particles each", *(f"{name}, ms" for name in names), "GPU, frames/s"))
    per_particle = dict.fromkeys(names, 0.0)  # ms, as last measured
    for vehicles in VEHICLES:
        for particles in PARTICLES:
            cells = dict.fromkeys(names, "")
            for name, n in zip(names, [*threads, 0], strict=True):
                is_gpu = name == "GPU"
                expected = 1e-3 * per_particle[name] * vehicles * particles
                if 2 * expected > CELL or time.perf_counter() + 2 * expected > until or (is_gpu and device is None):
                    continue
                if vehicles * particles > (device.free_memory() / BYTES if is_gpu else 300_000):
                    continue
                numba.set_num_threads(n or threads[-1])
                ms = milliseconds(Road(particles, vehicles, seed, device if is_gpu else None).step, until)
                per_particle[name] = ms / (vehicles * particles)
                cells[name] = f"{ms:.3g}"
            if any(cells.values()):
                rate = f"{1e3 / float(cells['GPU']):.0f}" if cells["GPU"] else ""
                print(row(vehicles, particles, *cells.values(), rate), flush=True)


def limits(seed: int, device: Any) -> None:
    """The likelihood's kernel beside what the device's memory could move and its schedulers could issue."""
    from numba import cuda

    gpu = cuda.get_current_device()
    bandwidth = _copied()
    issued = 4 * 32 * gpu.MULTIPROCESSOR_COUNT * gpu.CLOCK_RATE * 1e3
    clock, width = gpu.MEMORY_CLOCK_RATE * 1e3, gpu.GLOBAL_MEMORY_BUS_WIDTH / 8
    print(f"\nMemory: {2 * clock * width / 1e9:.0f} GB/s by clock and width, {bandwidth:.0f} GB/s in a copy.")
    print(f"Issue: {issued / 1e12:.1f}e12 threads' instructions a second by clock and number of schedulers.\n")
    columns = "particles", "kernel, ms", "samples, 1e9/s", "memory, GB/s", "of the copy", "instructions, 1e12/s"
    print(head(*columns, "of those issued at most"))
    for particles in (1_000, 10_000, 100_000, 1_000_000):
        if particles * BYTES > device.free_memory():
            continue
        road = Road(particles, 1, seed, device)
        (one,) = road.vehicles
        device.weight([one])  # sends what the kernel looks at, and compiles
        seconds = _timed(lambda parts=one.configuration.parts: device.compute_likelihood(parts))
        samples = particles * road.samples * (2 + 1 / likelihood.patch_features_cpu.CORRELATION_ROW_STEP)
        moved, done = particles * (MAPS + OUT) / seconds / 1e9, samples * INSTRUCTIONS / seconds
        cells = (
            f"{1e3 * seconds:.3g}",
            f"{samples / seconds / 1e9:.1f}",
            f"{moved:.1f}",
            f"{moved / bandwidth:.1%}",
            f"{done / 1e12:.1f}",
            f"{done / issued:.0%}",
        )
        print(row(particles, *cells), flush=True)


def _copied() -> float:
    """GB/s, read and written, of a copy within the device's memory."""
    from numba import cuda

    words = cuda.device_array(1 << 28, np.float64)  # 2 GiB, far more than any cache holds
    other = cuda.device_array_like(words)
    return 2e-9 * words.nbytes / _timed(lambda: other.copy_to_device(words))


def _timed(work: Callable[[], object]) -> float:
    """Seconds that ``work`` takes on the device, the best of several, by the device's own clock."""
    from numba import cuda

    best = np.inf
    for _ in range(REPETITIONS):
        start, end = cuda.event(), cuda.event()
        start.record()
        work()
        end.record()
        end.synchronize()
        best = min(best, 1e-3 * cuda.event_elapsed_time(start, end))
    return float(best)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=480.0, help="no cell is begun that would end later")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    until = time.perf_counter() + options.seconds
    print(machine())
    try:
        device = open_device("cuda")
    except DeviceFailure as failure:
        device = None
        print(f"No device was found ({failure.reason}): the CPU alone.\n")
    if device is not None:
        limits(options.seed, device)
        print()
    steps(options.seed, device, until)


if __name__ == "__main__":
    main()
