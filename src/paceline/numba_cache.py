"""Numba functions with a disk cache that is invalidated when any source they depend on changes.

Numba's own cache compares the file and the code of the function and its closure. Functions, constants and options from
other modules, which are compiled into it, may change without notice, for instance when an update replaces one file of
two, and the old machine code would be used. So each function closes over a digest of its module and of all modules of
this package that this one imports, without using it.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, update_wrapper
from types import CellType, FunctionType
from typing import Any, TypeVar
from warnings import warn

from numba import njit
from numba.core.event import Event, Listener, install_listener

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE_NAME = __name__.split(".", maxsplit=1)[0]
UNCACHED = (
    "compiled code cannot be kept, as no folder for it can be written, so each run compiles anew, for half a minute; "
    "expected one named by NUMBA_CACHE_DIR"
)
IMPORT_PATTERN = re.compile(rf"^(?:from|import) ({PACKAGE_NAME}[\w.]*)(?: import (\([^)]*\)|.*))?", re.MULTILINE)


def cached_njit(**options: Any) -> Callable[[Function], Function]:
    """`numba.njit` with ``options`` and a cache, as a decorator."""

    def decorate(function: Function) -> Function:
        assert isinstance(function, FunctionType)
        digested = with_source_digest(function)
        compiled: Function
        try:
            compiled = njit(cache=True, **options)(digested)
        except RuntimeError as error:  # neither the package nor the user has a folder that can be written
            if "no locator available" not in str(error):
                raise
            warn(UNCACHED, RuntimeWarning, stacklevel=1)
            compiled = njit(**options)(digested)
        return compiled

    return decorate


@dataclass
class Compilations(Listener):  # type: ignore[misc]
    """Counts the functions that are compiled, not loaded from the cache; ``report`` is called with how many have been,
    each time another one begins. Those that one needs itself are not counted apart."""

    report: Callable[[int], None]
    count: int = 0
    _depth: int = 0

    def on_start(self, event: Event) -> None:
        if self._depth == 0:
            self.report(self.count)
        self._depth += 1

    def on_end(self, event: Event) -> None:
        self._depth -= 1
        self.count += self._depth == 0


@contextmanager
def compilations(report: Callable[[int], None] = lambda count: None) -> Iterator[Compilations]:
    """The `Compilations` within the context."""
    listener = Compilations(report)
    with install_listener("numba:compile", listener):
        yield listener


def with_source_digest(function: FunctionType) -> FunctionType:
    """``function``, defined at a module's top level, with the digest of its module's sources in its closure."""
    assert function.__closure__ is None, f"{function.__qualname__}: expected a function of a module's top level"
    code, cell = function.__code__.replace(co_freevars=("digest",)), CellType(source_digest(function.__module__))
    closed = FunctionType(code, function.__globals__, function.__name__, function.__defaults__, (cell,))
    update_wrapper(closed, function)
    del closed.__wrapped__  # type: ignore[attr-defined]
    return closed


@cache
def source_digest(module: str) -> str:
    """SHA-256 of the sources of ``module`` and of all modules of this package that it imports, directly or not."""
    digests: dict[str, str] = {}
    left = [module]
    while left:
        name = left.pop()
        if name not in digests:
            digests[name] = _source(name)
            left += _imported(digests[name])
    return hashlib.sha256("\0".join(digests[name] for name in sorted(digests)).encode()).hexdigest()


def _source(module: str) -> str:
    spec = sys.modules[module].__spec__
    assert spec is not None, f"{module}: expected a module that was imported"
    loader: Any = spec.loader  # of files or of an archive
    return bytes(loader.get_data(spec.origin)).decode()


def _imported(source: str) -> Iterator[str]:
    """Modules of this package that a module with this ``source`` imports as it is imported itself."""
    for module, names in IMPORT_PATTERN.findall(source):
        yield module
        yield from (full for name in re.findall(r"\w+", names) if (full := f"{module}.{name}") in sys.modules)
