"""Machine code on disk is used for as long as nothing changes of which it is made."""

import importlib
import os
import pkgutil
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import paceline
from paceline import compiling

SOURCE = Path(paceline.__file__).parent
NEEDS_MORE = "paceline.console", "paceline.simulation.rendered", "paceline.speed.device_cuda"  # extras, or a driver

OF_NUMBA = "nopython", "boundscheck"  # options that it adds itself

USED = """
import numpy as np
from paceline.speed import motion_cpu as used
crossings = np.empty((1, 2))
used.cross_diagonals(np.array([[[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 2.0]]]), crossings)
hits, misses = (sum(used.cross_diagonals.stats[i].values()) for i in (1, 2))
print(*crossings[0], hits, misses)
"""


def _compiled() -> Iterator[tuple[str, Any]]:
    for found in pkgutil.walk_packages([str(SOURCE)], "paceline."):
        if found.name.endswith("_cuda") or found.name.startswith((*NEEDS_MORE, "paceline.__main__")):
            continue
        module = importlib.import_module(found.name)
        for name, value in vars(module).items():
            if isinstance(value, Dispatcher) and not isinstance(value._cache, NullCache):
                yield f"{found.name}.{name}", value


def test_every_function_that_is_kept_closes_over_what_it_is_made_of_and_knew_all_of_it_from_the_start() -> None:
    """A helper that is defined below its user would not be known yet when that closes over its digest."""
    known = dict(_compiled())
    assert {"paceline.speed.pixels_cpu.observe", "paceline.follow.measuring_cpu.believed"} < set(known)
    for name, function in known.items():
        options = {key: value for key, value in function.targetoptions.items() if key not in OF_NUMBA}
        cells = [cell.cell_contents for cell in function.py_func.__closure__ or ()]
        assert cells == [compiling.digest(function.py_func, options)], name


def _run(folder: Path) -> tuple[float, float, int, int]:
    env = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run([sys.executable, "-c", USED], env=env, capture_output=True, text=True, check=True)
    x, y, hits, misses = done.stdout.split()
    return float(x), float(y), int(hits), int(misses)


@pytest.mark.slow
def test_an_update_of_one_file_of_two_is_not_answered_by_the_old_machine_code(tmp_path: Path) -> None:
    """`motion_cpu` compiles functions of `regions` into its own; only the latter changes."""
    shutil.copytree(SOURCE, tmp_path / "paceline", ignore=shutil.ignore_patterns("__pycache__"))
    assert _run(tmp_path) == (2.0, 1.0, 0, 1)
    assert _run(tmp_path) == (2.0, 1.0, 1, 0)
    file = tmp_path / "paceline" / "speed" / "regions.py"
    text = file.read_text()
    head, body = text.split("def cross_diagonals(q, crossing):")
    changed = body.replace("crossing[0] = ", "crossing[0] = 100.0 + ", 1)
    assert changed != body
    file.write_text(f"{head}def cross_diagonals(q, crossing):{changed}")
    assert _run(tmp_path) == (102.0, 1.0, 0, 1)


def test_the_digest_is_of_functions_constants_and_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Through modules, by name, and through functions that functions use; the order of a set has no say."""
    monkeypatch.setattr(compiling, "HERE", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)

    def digest(**options: Any) -> str:
        for name in ("kept_a", "kept_b", "kept_c"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        compiling._digest_of_file.cache_clear()
        return compiling.digest(importlib.import_module("kept_a").f, options)

    def write(a: str = "SIZE", b: str = "1", c: str = "2") -> None:
        (tmp_path / "kept_a.py").write_text(f"from kept_b import {a} as S, g\ndef f():\n return S + g()\n")
        (tmp_path / "kept_b.py").write_text(f"import kept_c\nSIZE = {b}\nOTHER = 9\ndef g():\n return kept_c.h()\n")
        (tmp_path / "kept_c.py").write_text(f"def h():\n return {c}\n")

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    found = []
    for parts in ({}, {"a": "OTHER"}, {"b": "3"}, {"c": "4"}):
        write(**parts)
        found.append(digest())
        assert digest() == found[-1]
    write()
    found += [digest(nogil=True), digest(fastmath={"arcp", "nsz"})]
    assert digest(fastmath={"nsz", "arcp"}) == found[-1]
    assert len(set(found)) == 6
