"""The normal numbers of `randomness.CounterGenerator` on a GPU."""

from __future__ import annotations

import math

import numpy as np
from numba import cuda
from numpy.typing import NDArray

ROUNDS = 10
_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)  # Philox 4×64: multipliers
_W = (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)  # and what the key grows by in every round
_LOW, _HALF, _ZERO = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(0)
_UNUSED = np.uint64(11)  # bits of 64 that a double has no room for
_UNIT = 2.0**-53


def round_keys(key: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The key (2,) in each round: (ROUNDS, 2)."""
    return np.array([[(int(key[i]) + r * _W[i]) % 2**64 for i in (0, 1)] for r in range(ROUNDS)], np.uint64)


@cuda.jit(device=True)
def _product(a, b):
    """The upper and the lower 64 bits of a·b, by halves none of which overflows."""
    a0, a1, b0, b1 = a & _LOW, a >> _HALF, b & _LOW, b >> _HALF
    low, across, down, high = a0 * b0, a0 * b1, a1 * b0, a1 * b1
    middle = (low >> _HALF) + (across & _LOW) + (down & _LOW)
    high = high + (across >> _HALF) + (down >> _HALF) + (middle >> _HALF)
    return high, (low & _LOW) | (middle << _HALF)


@cuda.jit(cache=True)
def normals(keys, call, scale, out):
    """Normal numbers of standard deviation ``scale``, at most four a particle, into ``out`` (k, N): the ``call``-th
    that were drawn under the round ``keys``."""
    p = cuda.grid(1)
    if p >= out.shape[1]:
        return
    c0, c1, c2, c3 = np.uint64(p + 1), np.uint64(call), _ZERO, _ZERO
    for r in range(ROUNDS):
        high0, low0 = _product(_M0, c0)
        high1, low1 = _product(_M1, c2)
        c0, c1, c2, c3 = high1 ^ c1 ^ keys[r, 0], low1, high0 ^ c3 ^ keys[r, 1], low0
    for pair in range((out.shape[0] + 1) // 2):
        first, second = (c0, c1) if pair == 0 else (c2, c3)
        radius = math.sqrt(-2.0 * math.log(1.0 - float(first >> _UNUSED) * _UNIT)) * scale
        angle = 2.0 * math.pi * (float(second >> _UNUSED) * _UNIT)
        out[2 * pair, p] = radius * math.cos(angle)
        if 2 * pair + 1 < out.shape[0]:
            out[2 * pair + 1, p] = radius * math.sin(angle)
