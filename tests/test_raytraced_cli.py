"""``paceline simulate`` as a person calls it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from run_command import paceline
from tiny_scenes import tiny_speed


def test_list_names_the_scenes() -> None:
    done = paceline("simulate", "list")
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert [line.split()[1] for line in lines if line.startswith("speed")] == [
        "straight-55",
        "circle-36",
        "recorded-straight-36",
        "neil-28",
        "oh315",
        "lane-change-35",
        "lane-change-30",
    ]
    assert sum(line.startswith("follow") for line in lines) == 3


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["speed", "strait-55"], "strait-55: no speed scene has this name; did you mean 'straight-55'?"),
        (["speed", "missing.yaml"], "missing.yaml: no such file"),
        (["follow", "straight-55"], "straight-55: no follow scene has this name"),
        (["suite", "-n", "0"], "-n"),
        (["speed", "straight-55", "--samples", "0"], "--samples"),
    ],
)
def test_wrong_calls_end_with_one_line(arguments: list[str], text: str, tmp_path: Path) -> None:
    done = paceline("simulate", *arguments, "-o", str(tmp_path / "out"))
    assert done.returncode == 2
    assert text in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_scene_file_becomes_a_clip(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(tiny_speed(frames=1)))
    out = tmp_path / "out"
    done = paceline("simulate", "speed", str(tmp_path / "scene.yaml"), "-o", str(out), "--samples", "1", "--seed", "5")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{out / 'clip.yaml'}\n"
    assert (out / "left" / "0000.png").exists() and (out / "truth.json").exists()
    again = yaml.safe_load((out / "scene.yaml").read_text())
    assert (again["samples"], again["seed"]) == (1, 5)
    refused = paceline("simulate", "speed", str(tmp_path / "scene.yaml"), "-o", str(out))
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"paceline: {out}: was begun with another scene")
