"""Machine code on disk is used for as long as nothing changes of which it is made."""

import importlib
import inspect
import json
import os
import pkgutil
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from numba import njit
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher
from selection import slow_after

import paceline
from paceline import numba_cache
from paceline.numba_cache import cached_njit, compilations, with_source_digest

SOURCE = Path(paceline.__file__).parent
NEEDS_MORE = "paceline.console", "paceline.simulation.raytraced", "paceline.__main__"  # extras

MODULES = [
    "speed.geometry.quadrilaterals_cpu",
    "speed.filter.patch_features_cpu",
    "follow.carrying_cpu",
    "path_following.pure_pursuit",
    "detection.background_model_cpu",
]
DIGESTS = f"""
import importlib, json, sys
from paceline.numba_cache import source_digest
names = {MODULES}
for name in reversed(names) if len(sys.argv) > 1 else names:
    importlib.import_module("paceline." + name)
print(json.dumps({{name: source_digest("paceline." + name) for name in names}}))
"""
USED = """
import numpy as np, paceline.speed.geometry.quadrilaterals_cpu as used
crossings = np.empty((1, 2))
used.cross_diagonals(np.array([[[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 2.0]]]), crossings)
hits, misses = (sum(used.cross_diagonals.stats[i].values()) for i in (1, 2))
print(*crossings[0], hits, misses)
"""


def _kept() -> Iterator[tuple[str, Any]]:
    """All functions of the package whose machine code is kept on disk."""
    for found in pkgutil.walk_packages([str(SOURCE)], "paceline."):
        if found.name.endswith("_cuda") or found.name.startswith(NEEDS_MORE):
            continue
        module = importlib.import_module(found.name)
        for name, value in vars(module).items():
            if isinstance(value, Dispatcher) and not isinstance(value._cache, NullCache):
                yield f"{found.name}.{name}", value


def _run(folder: Path, program: str, *arguments: str, **env: str) -> str:
    given = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder.parent / "cache"), **env}
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, env=given, capture_output=True, text=True, check=True).stdout


def _copied(folder: Path) -> Path:
    shutil.copytree(SOURCE, folder / "src" / "paceline", ignore=shutil.ignore_patterns("__pycache__", "static"))
    return folder / "src"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A folder with a copy of the package."""
    return _copied(tmp_path)


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A folder with a copy of the package that nothing changes, and the digests of MODULES there."""
    folder = _copied(tmp_path_factory.mktemp("unchanged"))
    return folder, json.loads(_run(folder, DIGESTS, PYTHONHASHSEED="1"))


def _edit(folder: Path, file: str, old: str, new: str) -> None:
    text = (folder / "paceline" / file).read_text()
    assert text.count(old) >= 1
    (folder / "paceline" / file).write_text(text.replace(old, new))


def test_every_function_that_is_kept_closes_over_what_it_is_made_of() -> None:
    kept = dict(_kept())
    assert {"paceline.speed.filter.patch_features_cpu.observe", "paceline.follow.measuring_cpu.believed"} < set(kept)
    for name, function in kept.items():
        cells = [cell.cell_contents for cell in function.py_func.__closure__ or ()]
        assert cells == [numba_cache.source_digest(function.py_func.__module__)], name


def test_digests_do_not_depend_on_the_order_of_imports(unchanged: tuple[Path, dict[str, str]]) -> None:
    folder, digests = unchanged
    assert json.loads(_run(folder, DIGESTS, "backwards", PYTHONHASHSEED="2")) == digests


@pytest.mark.parametrize(
    ("file", "old", "new", "changed"),
    [
        (
            "speed/geometry/quadrilaterals.py",
            "share * ac_x",
            "share * ac_x + 100.0",
            ["speed.geometry.quadrilaterals_cpu"],
        ),
        (
            "speed/filter/patch_features.py",
            "MIN_OVERLAP = 0.25",
            "MIN_OVERLAP = 0.5",
            ["speed.filter.patch_features_cpu"],
        ),
        ("follow/picture_cpu.py", "SUMS = {", 'SUMS = {"nsz", ', ["follow.carrying_cpu"]),  # an option of its helpers
        ("follow/motion.py", "def ", "def  ", ["follow.carrying_cpu"]),  # which `picture_cpu` imports
        ("numba_cache.py", "cache=True", "cache=True, boundscheck=True", MODULES),
        ("speed/filter/tracker.py", "def ", "def  ", []),
    ],
)
def test_what_is_made_of_a_changed_file_is_compiled_anew_and_nothing_else(
    copy: Path, unchanged: tuple[Path, dict[str, str]], file: str, old: str, new: str, changed: list[str]
) -> None:
    _, before = unchanged
    _edit(copy, file, old, new)
    after = json.loads(_run(copy, DIGESTS))
    assert [name for name in MODULES if after[name] != before[name]] == changed


@pytest.mark.parametrize("kind", slow_after(0, ["folder", "folder named otherwise", "zip"]))
def test_an_update_of_one_file_of_two_is_not_answered_by_the_old_machine_code(copy: Path, kind: str) -> None:
    """`quadrilaterals_cpu` compiles functions of `quadrilaterals` into its own; only the latter changes."""
    source, program = copy, USED
    if kind == "folder named otherwise":
        program = f"import sys; sys.path.insert(0, {str(copy.parent)!r} + '/./src')\n{USED}"
        source = copy.parent
    elif kind == "zip":
        source = copy.parent / "paceline.zip"

    def run() -> tuple[float, ...]:
        if kind == "zip":
            with zipfile.ZipFile(source, "w") as archive:
                for file in copy.rglob("*.*"):
                    archive.write(file, file.relative_to(copy))
        return tuple(map(float, _run(source, program).split()))

    assert run() == (2.0, 1.0, 0, 1)
    if kind != "zip":  # which is a new one each time
        assert run() == (2.0, 1.0, 1, 0)
    _edit(copy, "speed/geometry/quadrilaterals.py", "share * ac_x", "share * ac_x + 100.0")
    assert run() == (102.0, 1.0, 0, 1)


def _twice(x: float, times: float = 2.0) -> float:
    """``x``, ``times``."""
    return times * x


def test_a_compiled_function_keeps_its_looks() -> None:
    made = cached_njit(nogil=True)(_twice)
    assert made(3.0) == 6.0
    assert inspect.signature(made) == inspect.signature(_twice)
    assert (made.__doc__, made.__name__, made.__module__) == (_twice.__doc__, "_twice", __name__)


def test_a_function_that_closes_over_something_is_refused() -> None:
    factor = 2.0

    def inside(x: float) -> float:
        return factor * x

    with pytest.raises(AssertionError, match=r"inside: expected a function of a module's top level"):
        with_source_digest(inside)


UNCACHED_PROGRAM = """
import numba.core.caching
numba.core.caching.CacheImpl._locator_classes = []  # none of its folders can be written
import numpy, warnings
from paceline.speed.geometry.quadrilaterals_cpu import unit_square_to
from paceline.speed.refinement import trajectory_cpu
print((unit_square_to(numpy.array([[[0.0, 0], [2, 0], [2, 2], [0, 2]]])) + 0.0).tolist())
"""


def test_without_a_folder_for_the_cache_all_is_compiled_anew() -> None:
    """As where the package may only be read and the user has no home. It is said once."""
    command = [sys.executable, "-c", UNCACHED_PROGRAM]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(SOURCE.parent)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[[[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]]\n"
    assert done.stderr.count("compiled code cannot be kept") == 1


def test_functions_are_counted_as_they_are_compiled() -> None:
    """Those that others need are not counted apart, and what is compiled already is not compiled again."""
    inner = njit(lambda x: x + 1)
    outer = njit(lambda x: 2 * inner(x))
    reports: list[int] = []
    with compilations(reports.append) as compiled:
        assert [outer(1), outer(2), outer(1.0)] == [4, 6, 4.0]
    assert reports == [0, 1] and compiled.count == 2
    njit(lambda x: x)(1)
    assert compiled.count == 2
