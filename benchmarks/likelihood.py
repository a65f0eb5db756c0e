"""Time of the likelihood of 400 particles, beside the same work with cv2.warpPerspective, and of a whole filter step.

python benchmarks/likelihood.py [--n 100] [--seed 0] [--particles 400]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from itertools import islice

import cv2
import numba
import numpy as np
from common import Array, head, machine, plain_scene, rendered, row

from paceline import SpeedConfiguration, Tracker, open_recording
from paceline.arrays import Floats
from paceline.documents.loading import Clip
from paceline.speed.filter import likelihood, patch_features_cpu
from paceline.speed.filter.likelihood import PackedImage, PartGrid
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.geometry.quadrilaterals_cpu import inward_edges, unit_square_to

WIDTH, HEIGHT = 1024, 768
REGION = np.array([[460.0, 380], [560, 380], [560, 420], [460, 420]])  # 10 parts of 16 blocks of 4 × 4: 2560 samples
DISPARITY = 14.0  # px
WARM_UP = 5  # repetitions not counted


class Work:
    """Random textured images, and particles that see a region of them."""

    def __init__(self, particles: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        noise = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH), np.float32), (0, 0), 2.0)
        self.left = np.clip(128 + 40 * noise / noise.std(), 0, 255)
        self.right = np.roll(self.left, -round(DISPARITY), axis=1)
        self.quads_left = REGION + rng.normal(0, 2, (particles, 1, 2)) + rng.normal(0, 0.5, (particles, 4, 2))
        self.quads_right = self.quads_left - [DISPARITY, 0] + rng.normal(0, 0.5, (particles, 4, 2))
        self.cross = np.tile([[1.0, 0, -DISPARITY], [0, 1, 0], [0, 0, 1]], (particles, 1, 1))
        self.cross[:, :2, 2] += rng.normal(0, 0.5, (particles, 2))
        self.grid = PartGrid.for_region(10, REGION)
        self.packed = likelihood.pack(self.left), likelihood.pack(self.right)
        H = unit_square_to(self.quads_left), unit_square_to(self.quads_right)
        self.H = np.stack([*H, self.cross @ H[0]], axis=1)  # (N, 3, 3, 3)
        self.edges = inward_edges(self.quads_right).astype(np.float32)
        self.kernel_H = self.H.reshape(particles, 3, 9).astype(np.float32)
        self.features = np.empty((particles, 2, self.grid.parts, 16), np.float32)
        self.ncc = np.empty(particles, np.float32)

    @property
    def samples(self) -> int:
        grid = self.grid
        return 16 * grid.parts * grid.samples[0] * grid.samples[1]

    def kernel(self) -> None:
        grid = self.grid
        patch_features_cpu.observe(
            *self.packed, self.kernel_H, self.edges, grid.across, grid.down, grid.samples, self.features, self.ncc
        )

    def whole(self) -> Array:
        """Homographies, kernel, normalisation and log-likelihood, as the filter calls them."""
        observation = likelihood.observe(*self.packed, self.quads_left, self.quads_right, self.cross, self.grid)
        return likelihood.log_likelihood(observation, observation.features[0], 15.0, 20.0)

    def pack(self) -> list[PackedImage]:
        return [likelihood.pack(image) for image in (self.left, self.right)]


class WithOpenCV:
    """The same work: cv2.warpPerspective for each particle, NumPy for all of them at once."""

    def __init__(self, work: Work) -> None:
        self.work, grid = work, work.grid
        self.size = x, y = grid.across * 4 * grid.samples[0], grid.down * 4 * grid.samples[1]
        to_unit = np.array([[1 / x, 0, 0.5 / x], [0, 1 / y, 0.5 / y], [0, 0, 1]])
        self.maps = work.H @ to_unit  # from samples to pixels

    def sample(self) -> Floats:
        """What each particle sees (N, 3, H, W): left and right region, and the left one carried into the right view."""
        images, flags = (self.work.left, self.work.right, self.work.right), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        samples = np.empty((len(self.maps), 3, self.size[1], self.size[0]), np.float32)
        for maps, out in zip(self.maps, samples, strict=True):
            for image, M, region in zip(images, maps, out, strict=True):
                cv2.warpPerspective(image, M, self.size, dst=region, flags=flags)
        return samples

    def whole(self) -> tuple[Floats, Floats]:
        """Wavelet coefficients (N, 2, parts, 16) and correlations (N,)."""
        samples = self.sample()
        rows = samples[:, :, :: patch_features_cpu.CORRELATION_ROW_STEP]
        return self._wavelets(samples[:, :2]), self._correlations(rows[:, 0], rows[:, 2])

    def _wavelets(self, samples: Floats) -> Floats:
        grid, (x, y) = self.work.grid, self.work.grid.samples
        blocks = samples.reshape(*samples.shape[:2], grid.down, 4, y, grid.across, 4, x).sum((4, 7))
        parts = blocks.swapaxes(3, 4).reshape(*samples.shape[:2], grid.parts, 4, 4)
        fine = _haar(parts)  # (4, N, 2, parts, 2, 2)
        coarse = np.moveaxis(_haar(fine[0])[..., 0, 0], 0, -1)
        details = np.moveaxis(fine[1:].reshape(3, *parts.shape[:3], 4), 0, -1)
        return np.concatenate([coarse, details.reshape(*parts.shape[:3], 12)], axis=-1)

    def _correlations(self, a: Floats, b: Floats) -> Floats:
        """Of (N, H, W) with (N, H, W), over the samples inside the right region."""
        x, y = np.meshgrid(np.arange(a.shape[2]), patch_features_cpu.CORRELATION_ROW_STEP * np.arange(a.shape[1]))
        samples = np.stack([x, y, np.ones_like(x)]).reshape(3, -1).astype(np.float32)
        lines = (self.work.edges @ self.maps[:, 2]).astype(np.float32)
        inside = ((lines @ samples) >= 0).all(1)
        a, b = a.reshape(inside.shape), b.reshape(inside.shape)
        a, b = (np.where(inside, v - v.mean(1, where=inside, keepdims=True), np.float32(0)) for v in (a, b))
        return np.asarray((a * b).sum(1) / np.sqrt((a * a).sum(1) * (b * b).sum(1)))


def _haar(f: Floats) -> Floats:
    """Average, left-right, up-down and diagonal (4, …, H/2, W/2) of every 2×2 square of ``f`` (…, H, W)."""
    a, b, c, d = f[..., ::2, ::2], f[..., ::2, 1::2], f[..., 1::2, ::2], f[..., 1::2, 1::2]
    return np.stack([a + b + c + d, a - b + c - d, a + b - c - d, a - b - c + d]) * np.float32(0.5)


def step_clock(clip: Clip, configuration: SpeedConfiguration) -> Iterator[float]:
    """Seconds that each filter step of the clip's vehicle takes, again and again, from its third frame on."""
    vehicle = clip.vehicles[0]
    drawn = clip.paths[vehicle.path or ""]
    path = path_from_document(drawn, clip.rig)
    frames = list(open_recording(clip).frames(vehicle.frame))
    while True:
        tracker = Tracker(clip.rig, vehicle, path, drawn.lateral_offset, configuration)
        for k, frame in enumerate(frames):
            start_time = time.perf_counter()
            status = tracker.update(frame).status
            if k >= 2:
                yield time.perf_counter() - start_time
            if status != "tracking":
                break


def clock(job: Callable[[], object]) -> Iterator[float]:
    """Seconds that ``job`` takes, again and again."""
    while True:
        start_time = time.perf_counter()
        job()
        yield time.perf_counter() - start_time


def milliseconds(clock: Iterator[float], n: int, threads: int) -> str:
    """The median of ``n`` repetitions on so many threads, after a few that warm up."""
    numba.set_num_threads(threads)
    cv2.setNumThreads(threads)
    return f"{1e3 * np.median(list(islice(clock, WARM_UP, WARM_UP + n))):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Time of the likelihood and of a filter step.")
    parser.add_argument("--n", type=int, default=100, help="repetitions, of which the median is shown")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--particles", type=int, default=400)
    args = parser.parse_args()
    work = Work(args.particles, args.seed)
    opencv = WithOpenCV(work)
    jobs: dict[str, Callable[[], object]] = {
        "cv2.warpPerspective per particle: sampling alone": opencv.sample,
        "cv2.warpPerspective per particle: sampling, wavelets, correlation": opencv.whole,
        "kernel: sampling, wavelets, correlation": work.kernel,
        "likelihood: homographies, kernel, normalisation, weights": work.whole,
        "packing both images": work.pack,
    }
    print(f"{args.particles} particles, both views, {WIDTH} × {HEIGHT}; {work.samples} samples a region; ms, medians\n")
    threads = range(1, min(2, numba.get_num_threads()) + 1)
    print(head("work", *(f"{k} thread{'s'[: k > 1]}" for k in threads)), flush=True)
    for name, job in jobs.items():
        print(row(name, *(milliseconds(clock(job), args.n, k) for k in threads)), flush=True)
    with rendered(plain_scene(args.seed)) as (clip, _):
        for name, guided in (("filter step, guided (the default)", True), ("filter step as printed", False)):
            configuration = SpeedConfiguration(particles=args.particles, guided=guided)
            print(row(name, *(milliseconds(step_clock(clip, configuration), args.n, k) for k in threads)), flush=True)
    features, ncc = opencv.whole()
    work.kernel()
    differences = np.abs(features - work.features).max() / features.std(), np.abs(ncc - work.ncc).max()
    print(
        f"\nOpenCV and the kernel: coefficients agree to {differences[0]:.3f} of their spread, "
        f"correlations to {differences[1]:.4f}."
    )
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
