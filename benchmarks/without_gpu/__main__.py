"""The GPU's side of Paceline on a computer without one: its kernels as they are compiled, run on the CPU, and the time
that the computer itself needs for a step, whatever a GPU does meanwhile.

PYTHONPATH=benchmarks:tests python -m without_gpu parity [--backwards]
PYTHONPATH=benchmarks python -m without_gpu host [--repetitions 200]

Needs Linux, gcc and the extra cuda: Numba compiles the kernels for an H100 (sm_90) as it would with one, by `driver.c`.
``parity`` then runs tests/cuda_parity.py with every kernel's PTX turned to C. ``host`` times a filter step while a
launch does nothing, and counts what it asks of the driver.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from without_gpu import ptx

HERE = Path(__file__).parent
PARITY = HERE.parents[1] / "tests" / "cuda_parity.py"
STEPS = [(400, 1), (400, 4), (1_000, 16), (1_000, 64), (1_000, 256)]
LAUNCH = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)
FAILED = 719  # what CUDA calls a launch that failed


def driver(folder: Path) -> ctypes.CDLL:
    """`driver.c`, loaded before Numba asks for a driver by the same name."""
    library = folder / "libcuda.so.1"
    command = ["gcc", "-O1", "-shared", "-fPIC", f"-Wl,-soname,{library.name}", "-o", str(library), "driver.c", "-ldl"]
    subprocess.run(command, check=True, cwd=HERE)
    return ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)


def parity(folder: Path, library: ctypes.CDLL, backwards: bool) -> int:
    """pytest's exit status."""
    import pytest
    from numba.cuda import dispatcher

    kernels: dict[str, Any] = {}

    @LAUNCH
    def launch(name: bytes, blocks: int, threads: int, arguments: int) -> int:
        run = kernels.get(name.decode())
        if run is None:
            return FAILED
        diverged = run(ctypes.c_void_p(blocks), ctypes.c_void_p(threads), ctypes.c_void_p(arguments), backwards)
        return FAILED if diverged else 0

    bind = dispatcher._Kernel.bind

    def bound(kernel: Any) -> None:
        bind(kernel)
        name, run = ptx.compiled(kernel.inspect_asm((9, 0)), folder)
        kernels[name] = run

    dispatcher._Kernel.bind = bound
    dispatcher.CUDADispatcher.enable_caching = lambda _: None  # a kernel from a cache is not compiled
    library.launch_by(launch)
    command = "not command"  # a process of its own would not know of this driver
    return int(pytest.main(["-q", "-p", "no:cacheprovider", "-W", "ignore", "-k", command, str(PARITY)]))


def host(library: ctypes.CDLL, repetitions: int) -> None:
    """Prints a table; every figure of the particles is as good as another."""
    from common import head, machine, row
    from gpu import Road

    from paceline.speed import device_cuda
    from paceline.speed.devices import open_device

    fetch = device_cuda._Shared.fetch

    def fetched(shared: Any, size: int) -> Any:
        fetch(shared, size)[:] = 0.01
        return shared.home

    device_cuda._Shared.fetch = fetched  # type: ignore[method-assign]
    device = open_device("cuda")
    counts = (ctypes.c_long * 3)()
    print(machine())
    print(head("particles", "vehicles", "a step, ms", "launches", "uploads", "downloads", "all join, ms"))
    for particles, vehicles in STEPS:
        road, times = Road(particles, vehicles, 0, device), []
        for _ in range(max(5, repetitions // vehicles)):
            library.take_counts(counts)
            start = time.perf_counter()
            road.step()
            times.append(1e3 * (time.perf_counter() - start))
        library.take_counts(counts)  # of the last step
        homes = [one.cloud for one in Road(particles, vehicles, 0, None).followed]
        start = time.perf_counter()
        joined = [device.cloud(home) for home in homes]
        device.carry_out()
        join = 1e3 * (time.perf_counter() - start)
        print(row(particles, vehicles, f"{np.median(times):.3g}", *counts, f"{join:.3g}"), flush=True)
        del road, joined


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["parity", "host"])
    parser.add_argument("--backwards", action="store_true", help="the threads of a block take turns from the last on")
    parser.add_argument("--repetitions", type=int, default=200)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        library = driver(Path(name))
        if options.what == "parity":
            return parity(Path(name), library, options.backwards)
        host(library, options.repetitions)
    return 0


if __name__ == "__main__":
    sys.exit(main())
