"""Compilation of GPU kernels: once, with a disk cache that is valid as long as no source they depend on changes."""

from __future__ import annotations

from types import FunctionType
from typing import Any

from numba import cuda

from paceline.numba_cache import with_source_digest


def kernel(function: FunctionType | None = None, **options: Any) -> Any:
    """`cuda.jit` as a decorator with a disk cache that is invalidated as in `numba_cache`."""
    if function is None:
        return lambda given: kernel(given, **options)
    return cuda.jit(cache=True, **options)(with_source_digest(function))
