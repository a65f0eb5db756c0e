"""Numba's CUDA simulator, with the threads of a block one after another from barrier to barrier.

Numba's own lets all run at once and polls them, which takes most of the time, and each exchanges the name ``cuda`` in
modules that the others are using.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import cuda, types
from numba.cuda.simulator import kernel, kernelapi
from numba.np import numpy_support

_workers: list[_Thread] = []  # started when first needed, and used again for every block
_call_kernel: Callable[..., Any] = kernel.FakeCUDAKernel.__call__


class _Thread(threading.Thread):
    """A thread of the block that runs; those that have not ended are linked in a ring, each waiting for its turn."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._turn = threading.Semaphore(0)

    def begin(self, function: Callable[[], None], finished: threading.Semaphore, block: object, place: object) -> None:
        """Run ``function`` at the next turn, and release ``finished`` if that ends the block."""
        self._function, self._finished, self.blockIdx, self.threadIdx = function, finished, block, place
        self.exception: Exception | None = None

    def link(self, following: _Thread) -> None:
        self._following, following._preceding = following, self

    def go(self) -> None:
        self._turn.release()

    def run(self) -> None:
        while True:
            self._turn.acquire()
            try:
                self._function()
            except Exception as error:
                self.exception = error
            if self._following is self:
                self._finished.release()
            else:
                self._preceding.link(self._following)
                self._following.go()

    def syncthreads(self) -> None:
        """The next turn comes when all others have come to the barrier, or have ended."""
        self._following.go()
        self._turn.acquire()


def _run_block(manager: Any, block: tuple[int, int, int], *arguments: Any) -> None:
    """In place of `kernel.BlockManager.run`."""
    places = list(np.ndindex(*manager._block_dim))
    while len(_workers) < len(places):
        _workers.append(_Thread())
        _workers[-1].start()
    threads, finished = _workers[: len(places)], threading.Semaphore(0)
    for i, (thread, place) in enumerate(zip(threads, places, strict=True)):
        thread.begin(lambda: manager._f(*arguments), finished, kernelapi.Dim3(*block), kernelapi.Dim3(*place))
        threads[i - 1].link(thread)
    threads[0].go()
    finished.acquire()
    for thread in threads:
        if thread.exception:
            raise thread.exception


def _call(called: Any, *arguments: Any) -> Any:
    """In place of `kernel.FakeCUDAKernel.__call__`, which exchanges ``cuda`` for every call of a device function."""
    if not called._device:
        return _call_kernel(called, *arguments)
    names = called.fn.__globals__
    if names.get("cuda") is not cuda:
        return called.fn(*arguments)
    names["cuda"] = kernel._get_kernel_context()
    try:
        return called.fn(*arguments)
    finally:
        names["cuda"] = cuda


def _shared_array(shared: Any, shape: int | tuple[int, ...], dtype: Any) -> Any:
    """In place of `kernelapi.FakeCUDAShared.array`, which reads the source of all callers from disk."""
    caller = sys._getframe(1)
    key = caller.f_code, caller.f_lineno
    if key not in shared._allocations:
        shared._allocations[key] = np.empty(
            shape, numpy_support.as_dtype(dtype) if isinstance(dtype, types.Type) else dtype
        )
    return shared._allocations[key]


def install() -> None:
    """From here on kernels are simulated so."""
    kernel.BlockManager.run = _run_block
    kernel.FakeCUDAKernel.__call__ = _call
    kernelapi.FakeCUDAShared.array = _shared_array
