"""How loops are compiled: once, and kept on disk for as long as nothing changes of which their machine code is made.

Numba looks only at the file and the code of the function itself, and at what it closes over. What comes from other
modules, as functions that are compiled into it, constants and options, may change unseen, as when an update replaces
one file of two, and a program would go on with the old machine code. So a function closes over a digest of its module
and of all of this package that this imports, without using it.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterator
from functools import cache, update_wrapper
from types import CellType, FunctionType
from typing import Any, TypeVar

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = __name__.split(".", maxsplit=1)[0]
IMPORTS = re.compile(rf"^(?:from|import) ({PACKAGE}[\w.]*)(?: import (\([^)]*\)|.*))?", re.MULTILINE)


def compiled(**options: Any) -> Callable[[Function], Function]:
    """`numba.njit` with ``options`` and a cache, as a decorator."""

    def decorate(function: Function) -> Function:
        assert isinstance(function, FunctionType)
        made: Function = njit(cache=True, **options)(closing_over_sources(function))
        return made

    return decorate


def closing_over_sources(function: FunctionType) -> FunctionType:
    """``function``, of a module's top level, as one that closes over the digest of what its module is made of."""
    assert function.__closure__ is None, f"{function.__qualname__}: expected a function of a module's top level"
    code, cell = function.__code__.replace(co_freevars=("digest",)), CellType(digest(function.__module__))
    closed = FunctionType(code, function.__globals__, function.__name__, function.__defaults__, (cell,))
    update_wrapper(closed, function)
    del closed.__wrapped__  # type: ignore[attr-defined]
    return closed


@cache
def digest(module: str) -> str:
    """Of the sources of ``module`` and of all modules of this package that it imports, directly or not."""
    found: dict[str, str] = {}
    left = [module]
    while left:
        name = left.pop()
        if name not in found:
            found[name] = _source(name)
            left += _imported(found[name])
    return hashlib.sha256("\0".join(found[name] for name in sorted(found)).encode()).hexdigest()


def _source(module: str) -> str:
    spec = sys.modules[module].__spec__
    assert spec is not None, f"{module}: expected a module that was imported"
    loader: Any = spec.loader  # of files or of an archive
    return bytes(loader.get_data(spec.origin)).decode()


def _imported(source: str) -> Iterator[str]:
    """Modules of this package that a module with this ``source`` imports as it is imported itself."""
    for module, names in IMPORTS.findall(source):
        yield module
        yield from (full for name in re.findall(r"\w+", names) if (full := f"{module}.{name}") in sys.modules)
