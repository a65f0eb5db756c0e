"""The normal numbers of `filter.random_numbers.CounterGenerator` on a GPU."""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

PHILOX_ROUNDS = 10
_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)  # Philox 4×64: multipliers
_W0, _W1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)  # and what the key grows by in every round
_LOW, _HALF, _ZERO = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(0)
_UNUSED = np.uint64(11)  # bits of 64 that a double has no room for
_UNIT = 2.0**-53


@cuda.jit(device=True)
def _product(a, b):
    """The upper and the lower 64 bits of a·b, by halves none of which overflows."""
    a0, a1, b0, b1 = a & _LOW, a >> _HALF, b & _LOW, b >> _HALF
    low, across, down, high = a0 * b0, a0 * b1, a1 * b0, a1 * b1
    middle = (low >> _HALF) + (across & _LOW) + (down & _LOW)
    high = high + (across >> _HALF) + (down >> _HALF) + (middle >> _HALF)
    return high, (low & _LOW) | (middle << _HALF)


@cuda.jit(device=True)
def _sum(a, b):
    """The lower 64 bits of a + b, likewise."""
    low = (a & _LOW) + (b & _LOW)
    high = ((a >> _HALF) + (b >> _HALF) + (low >> _HALF)) & _LOW
    return (high << _HALF) | (low & _LOW)


@cuda.jit(device=True)
def counter_normals(key, call, scale, p, k, out, first):
    """The ``k`` ≤ 4 normal numbers of standard deviation ``scale`` that particle ``p`` has in the ``call``-th drawing,
    into ``out`` from the ``first`` on. ``key`` (4,) is the generator's, by 32 bits."""
    key0 = (np.uint64(key[0]) << _HALF) | np.uint64(key[1])
    key1 = (np.uint64(key[2]) << _HALF) | np.uint64(key[3])
    c0, c1, c2, c3 = np.uint64(p + 1), np.uint64(call), _ZERO, _ZERO
    for _ in range(PHILOX_ROUNDS):
        high0, low0 = _product(_M0, c0)
        high1, low1 = _product(_M1, c2)
        c0, c1, c2, c3 = high1 ^ c1 ^ key0, low1, high0 ^ c3 ^ key1, low0
        key0, key1 = _sum(key0, _W0), _sum(key1, _W1)
    for pair in range((k + 1) // 2):
        u, v = (c0, c1) if pair == 0 else (c2, c3)
        radius = math.sqrt(-2.0 * math.log(1.0 - float(u >> _UNUSED) * _UNIT)) * scale
        angle = 2.0 * math.pi * (float(v >> _UNUSED) * _UNIT)
        out[first + 2 * pair] = radius * math.cos(angle)
        if 2 * pair + 1 < k:
            out[first + 2 * pair + 1] = radius * math.sin(angle)
