"""How loops are compiled: once, and kept on disk for as long as nothing changes of which their machine code is made.

Numba looks only at the file and the code of the function itself, and at what it closes over. What other modules give it
— functions that are compiled into it, constants — and the options it is compiled with may change unseen, as when an
update replaces one file of two, and a program would go on with the old machine code. So a function closes over a digest
of all that, without using it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, TypeVar

import numpy as np
from numba import njit

HERE = str(Path(__file__).parent)

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[Function], Function]:
    """`numba.njit` with ``options`` and a cache, as a decorator."""

    def decorate(function: Function) -> Function:
        assert isinstance(function, FunctionType)
        made: Function = njit(cache=True, **options)(closing_over(function, options))
        return made

    return decorate


def closing_over(function: FunctionType, options: dict[str, Any]) -> FunctionType:
    """``function``, which must close over nothing yet, as one that closes over the digest of what it is made of."""
    code = function.__code__.replace(co_freevars=("digest",))
    closed = FunctionType(
        code, function.__globals__, function.__name__, function.__defaults__, (CellType(digest(function, options)),)
    )
    closed.__doc__, closed.__qualname__ = function.__doc__, function.__qualname__
    return closed


def digest(function: FunctionType, options: dict[str, Any]) -> str:
    """Of the files and constants of this package that ``function`` is made of, and of the ``options``."""
    chosen = (f"{name}={sorted(value) if isinstance(value, set) else value!r}" for name, value in options.items())
    return hashlib.sha256("\n".join(sorted({*_parts(function, set()), *chosen})).encode()).hexdigest()


def _parts(function: FunctionType, seen: set[CodeType]) -> Iterator[str]:
    """The digests of files, and the constants, that the machine code of ``function`` may depend on."""
    if function.__code__ in seen or not function.__code__.co_filename.startswith(HERE):
        return
    seen.add(function.__code__)
    yield _digest_of_file(function.__code__.co_filename)
    for name in _names(function.__code__):
        value = function.__globals__.get(name)
        value = getattr(value, "py_func", value)  # of a function that Numba compiles
        if isinstance(value, FunctionType):
            yield from _parts(value, seen)
        elif isinstance(value, ModuleType) and str(getattr(value, "__file__", "")).startswith(HERE):
            yield _digest_of_file(str(value.__file__))
        elif isinstance(value, np.ndarray):
            yield f"{name} {value.dtype} {value.shape} {value.tobytes().hex()}"
        elif isinstance(value, (bool, int, float, str, tuple, np.generic)):
            yield f"{name} {value!r}"


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


@cache
def _digest_of_file(name: str) -> str:
    return hashlib.sha256(Path(name).read_bytes()).hexdigest()
