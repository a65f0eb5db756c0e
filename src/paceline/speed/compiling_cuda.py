"""How kernels are compiled: once, and kept on disk for as long as nothing changes of which they are made."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

from numba import cuda

HERE = Path(__file__).parent
SOURCES = [*sorted(HERE.glob("*_cuda.py")), HERE / "pixels.py", HERE / "regions.py", HERE / "cloud.py"]


def digest(sources: Iterable[Path]) -> str:
    """Of what the files ``sources`` contain."""
    found = hashlib.sha256()
    for source in sources:
        found.update(source.read_bytes())
    return found.hexdigest()


DIGEST = digest(SOURCES)


def kernel(function: FunctionType | None = None, **options: Any) -> Any:
    """`cuda.jit` with a cache, as a decorator.

    Numba looks only at the file and the code of the kernel itself, and at what its function closes over: constants and
    functions of other modules may change unseen, and a kernel would look for numbers where they no longer are. So the
    function closes over the digest of all SOURCES, without using it.
    """
    if function is None:
        return lambda given: kernel(given, **options)
    code = function.__code__.replace(co_freevars=("digest",))
    closed = FunctionType(code, function.__globals__, function.__name__, None, (CellType(DIGEST),))
    closed.__doc__, closed.__qualname__ = function.__doc__, function.__qualname__
    return cuda.jit(cache=True, **options)(closed)  # type: ignore[no-untyped-call]
