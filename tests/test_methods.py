"""The registry of measuring methods: built in, plugged in from outside, unknown."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from run_command import paceline as command

import paceline
import paceline.baselines.registry  # noqa: F401  makes the baselines known
from paceline.documents.loading import Clip
from paceline.errors import UnusableInput
from paceline.speed import methods
from paceline.speed.methods import Method, method_named, method_names, register
from paceline.speed.results import ClipResult

STRAIGHT = Path(__file__).parents[1] / "examples" / "straight"


def measure_nothing(clip: Clip, *more: object) -> ClipResult:
    return ClipResult(str(clip.path), [], [], {"particles": 400}, {}, ["measured by a plugged-in method"])


PLUGGED_IN = Method(measure_nothing)
NO_METHOD = 3


@pytest.fixture
def plugged_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three entry points of another package: a method, something else, and what cannot be imported."""
    points = [
        EntryPoint("constant", "test_methods:PLUGGED_IN", methods.ENTRY_POINT_GROUP),
        EntryPoint("wrong", "test_methods:NO_METHOD", methods.ENTRY_POINT_GROUP),
        EntryPoint("missing", "no_such_package:METHOD", methods.ENTRY_POINT_GROUP),
    ]
    monkeypatch.setattr(methods, "entry_points", lambda group: [p for p in points if p.group == group])


def test_the_methods_of_the_package_are_known() -> None:
    assert set(method_names()) >= {"paceline", "sift", "kalman", "multimodal", "lucas-kanade"}
    assert method_named("paceline").uses_gpu and not method_named("sift").uses_gpu


@pytest.mark.usefixtures("plugged_in")
def test_an_entry_point_adds_a_method(small_clip: Path, tmp_path: Path) -> None:
    assert method_names()[-3:] == ["constant", "missing", "wrong"]
    done = command("speed", small_clip, "-o", tmp_path / "out", "--method", "constant")
    assert done.returncode == 1 and "note: measured by a plugged-in method" in done.stderr
    result = paceline.measure(small_clip, method="constant")
    assert result.configuration == {"method": "constant", "particles": 400}


@pytest.mark.usefixtures("plugged_in")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wrong", "--method wrong: test_methods:NO_METHOD is no paceline.Method"),
        ("missing", "--method missing: no_such_package:METHOD cannot be loaded (No module named 'no_such_package')"),
    ],
)
def test_an_entry_point_that_is_no_method_is_refused(name: str, message: str) -> None:
    with pytest.raises(UnusableInput) as error:
        method_named(name)
    assert str(error.value) == message


def test_an_unknown_method_is_refused_with_those_that_are_known(tmp_path: Path) -> None:
    done = command("speed", STRAIGHT, "-o", tmp_path / "out", "--method", "kalmann")
    assert done.returncode == 2 and not (tmp_path / "out").exists()
    assert done.stderr == f"paceline: --method kalmann: unknown; expected one of {', '.join(method_names())}\n"


def test_a_name_is_registered_once() -> None:
    with pytest.raises(ValueError, match="'sift' is registered twice"):
        register("sift", PLUGGED_IN)
