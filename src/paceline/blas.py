"""Limits NumPy's and SciPy's BLAS to one thread while Paceline computes."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")


def on_one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """``function`` with BLAS limited to one thread while it runs; afterwards the limit is what it was.

    The matrices here have some tens of rows. More threads gain nothing, but their busy waiting takes the cores from
    Numba's threads: a measurement takes three to ten times as long. Environment variables work only before NumPy is
    imported.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
