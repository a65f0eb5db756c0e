"""BLAS has one thread while Paceline computes, and what it had before afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from paceline.blas import on_one_blas_thread

ROOT = Path(__file__).parents[1]


def threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@on_one_blas_thread
def threads_within(error: Exception | None = None) -> set[int]:
    if error is not None:
        raise error
    return threads()


def test_the_limit_ends_with_the_function() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        assert threads_within() == {1} and threads() == {2}
        with pytest.raises(ValueError, match="as it was"):
            threads_within(ValueError("as it was"))
        assert threads() == {2}


MEASURES = """
import sys, numpy, scipy.linalg, paceline
from test_blas import threads
found = []
clip = paceline.load_clip(sys.argv[1])
few = paceline.SpeedConfiguration(particles=20, refine=False)
paceline.measure(clip, few, lambda done, total: found.append(threads()))
print(set.union(*found), len(threads()))
"""


def test_measuring_from_python_limits_it(small_clip: Path) -> None:
    """Though NumPy is loaded, as in a notebook, and may use two threads."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent), "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", MEASURES, small_clip],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.split()[0] == "{1}", done.stderr
