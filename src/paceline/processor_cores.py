"""How many processor cores a run uses, with all processes that it starts.

Libraries read it from the environment as they are imported, video decoders and encoders as they are opened.
"""

from __future__ import annotations

import os

CORES_VARIABLE = "PACELINE_CORES"
LIBRARY_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def limit_cores(count: int) -> None:
    """Limits this process, and those that it starts, to ``count`` cores; before anything that computes is imported."""
    for name in (CORES_VARIABLE, *LIBRARY_VARIABLES):
        os.environ[name] = str(min(count, os.cpu_count() or count))


def max_threads(default: int = 0) -> int:
    """The threads that something may start, at most ``default`` unless that is 0; 0: as many as it likes."""
    limit = int(os.environ.get(CORES_VARIABLE, 0))
    return min(limit, default) if limit and default else limit or default
