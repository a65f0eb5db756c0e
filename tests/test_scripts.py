"""Every script beside the package can be run: the examples' as they stand, the benchmarks' as far as their help."""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import paceline
from paceline.documents.loading import load_clip, load_follow
from paceline.recordings.stereo import open_recording
from paceline.simulation.chase.scene import ChaseScene
from paceline.simulation.random_scenes.drawn import random_chase

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
BENCHMARKS = sorted(
    str(file.relative_to(ROOT / "benchmarks"))
    for file in (ROOT / "benchmarks").rglob("*.py")
    if '__name__ == "__main__"' in file.read_text(encoding="utf-8")
)


@pytest.fixture(autouse=True)
def modules(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A script finds the modules beside it, and leaves none of them behind."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    before = dict(sys.modules)
    yield
    for name in set(sys.modules) - set(before):
        if Path(getattr(sys.modules[name], "__file__", None) or "/").is_relative_to(ROOT / "benchmarks"):
            del sys.modules[name]


def run(script: Path, *arguments: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments)])
    runpy.run_path(str(script), run_name="__main__")


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_states_its_command(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = ROOT / "benchmarks" / name
    monkeypatch.syspath_prepend(str(script.parent))
    with pytest.raises(SystemExit) as ended:
        run(script, "--help", monkeypatch=monkeypatch)
    assert ended.value.code in (None, 0)
    assert capsys.readouterr().out.startswith("usage: ")


def test_there_is_a_test_for_every_script_of_the_examples() -> None:
    assert {file.name for file in EXAMPLES.glob("*.py")} == {
        "follow_ros2.py",  # in test_follow_example.py
        "make_chase_clip.py",
        "make_demo_clip.py",
    }


@pytest.mark.slow
def test_the_demo_clip_is_what_its_script_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(EXAMPLES / "make_demo_clip.py", tmp_path, monkeypatch=monkeypatch)
    for name in ("clip.yaml", "truth.json"):
        assert (tmp_path / name).read_text() == (EXAMPLES / "straight" / name).read_text()
    made, bundled = (yaml.safe_load((folder / "rig.yaml").read_text()) for folder in (tmp_path, EXAMPLES / "straight"))
    assert made["uncertainty"] == bundled["uncertainty"]
    assert len(open_recording(load_clip(tmp_path / "clip.yaml"))) == 14


@pytest.mark.parametrize("frames", [6, pytest.param(180, marks=pytest.mark.slow)])
def test_the_chase_is_what_its_script_makes(frames: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its first frames in every run."""

    def shortened(*given: Any, **keys: Any) -> ChaseScene:
        return random_chase(*given, **{**keys, "frames": frames})

    monkeypatch.setattr(paceline, "random_chase_scene", shortened)
    run(EXAMPLES / "make_chase_clip.py", tmp_path, monkeypatch=monkeypatch)
    for name in ("camera.yaml", "follow.yaml", "target.yaml"):
        assert (tmp_path / name).read_text() == (EXAMPLES / "chase" / name).read_text()
    odometry, whole = ((folder / "odometry.csv").read_text().splitlines() for folder in (tmp_path, EXAMPLES / "chase"))
    assert odometry == whole[: frames + 1]
    made, bundled = (json.loads((folder / "truth.json").read_text()) for folder in (tmp_path, EXAMPLES / "chase"))
    assert [row["position"] for row in made] == [pytest.approx(row["position"]) for row in bundled[:frames]]
    assert load_follow(tmp_path / "follow.yaml").camera.image_size == (256, 242)
