"""The random numbers of a filter: a seed gives the same ones on the CPU and on a GPU."""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array

MAX_SEQUENTIAL_PARTICLES = (
    900  # with more, drawing numbers sequentially on the CPU would take longer than the GPU's step
)


def make_generator(seed: list[int], particles: int) -> np.random.Generator:
    """Random numbers for ``particles`` particles: sequential for few, counter-based for many."""
    if particles <= MAX_SEQUENTIAL_PARTICLES:
        return np.random.default_rng(seed)
    key = np.random.SeedSequence(seed).generate_state(2, np.uint64).astype(np.uint64)
    return CounterGenerator(np.random.PCG64(seed), key)


class CounterGenerator(np.random.Generator):
    """Normal numbers that depend on their index alone, so that any number of threads can generate them at once.

    The k numbers of particle p in the c-th call of `normal` come from Philox 4×64 under ``key`` (2,), at the counters
    (p·⌈k/4⌉ + 1 …, c, 0, 0), made uniform as by NumPy, and normal in pairs by Box and Muller. Everything else comes
    from ``bits``.
    """

    def __init__(self, bits: np.random.BitGenerator, key: NDArray[np.uint64], calls: int = 0) -> None:
        super().__init__(bits)
        self.key = key
        self.key_words = [int(word) >> shift & 0xFFFFFFFF for word in key for shift in (32, 0)]  # the key by 32 bits
        self.calls = calls

    def __deepcopy__(self, memo: dict[int, object]) -> CounterGenerator:
        return CounterGenerator(copy.deepcopy(self.bit_generator, memo), self.key, self.calls)

    def normal(self, loc: float = 0.0, scale: float = 1.0, size: int | tuple[int, int] = 1) -> Array:  # type: ignore[override]
        """Normal numbers (N,) or (N, k)."""
        n, k = size if isinstance(size, tuple) else (size, 1)
        bits = np.random.Philox(key=self.key, counter=np.array([0, self.calls, 0, 0], np.uint64))
        self.calls += 1
        u = np.random.Generator(bits).random((n, -(-k // 4), 2, 2))
        radius, angle = np.sqrt(-2.0 * np.log(1.0 - u[..., 0])), 2.0 * np.pi * u[..., 1]
        normal = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(n, -1)[:, :k]
        return np.asarray((loc + scale * normal).reshape(size))
