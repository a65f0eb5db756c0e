"""Options that have been renamed: the old spelling works as the new one does, and help shows the new one only."""

from __future__ import annotations

from pathlib import Path

import pytest
from run_command import paceline

from paceline.speed.methods import current_name, method_named, method_names

RENAMED = [
    (["speed"], "--tolerance", "--max-half-width", ["c", "-o", "o", "OPTION", "0"]),
    (["speed"], "--tolerance", "--max-half-width", ["c", "-o", "o", "OPTION=0"]),
    (["speed"], "--parts", "--feature-parts", ["c", "-o", "o", "OPTION", "0"]),
    (["speed"], "--learn", "--background-seconds", ["c", "-o", "o", "OPTION", "5"]),
    (["lanes"], "--write", "--in-place", ["c", "OPTION", "-o", "site.yaml"]),
    (["vehicles"], "--write", "--in-place", ["no-such-clip.yaml", "OPTION"]),
    (["rig", "check"], "--refine", "--correct-rotation", ["c", "OPTION"]),
    (["rig", "import"], "--unit", "--translation-unit", ["a.yml", "-o", "rig.yaml", "OPTION", "furlong"]),
    (["simulate", "suite"], "-n", "--count", ["-o", "o", "OPTION", "0"]),
]


@pytest.mark.parametrize(("command", "old", "new", "arguments"), RENAMED)
def test_an_old_option_works_as_the_new_one(
    command: list[str], old: str, new: str, arguments: list[str], tmp_path: Path
) -> None:
    answers = [
        paceline(*command, *(a.replace("OPTION", option) for a in arguments), folder=tmp_path) for option in (old, new)
    ]
    assert answers[0].returncode == 2 and answers[0].stderr == answers[1].stderr
    assert "No such option" not in answers[0].stderr
    shown = paceline(*command, "--help").stdout.split()
    assert new in shown and (old not in shown or old == "-n")


def test_an_old_name_of_a_method_is_accepted_and_not_listed() -> None:
    import paceline.baselines.registry  # noqa: F401  makes the baselines known

    assert current_name("kalman-wander") == "kalman-scatter" and current_name("sift") == "sift"
    assert method_named("kalman-wander") is method_named("kalman-scatter")
    assert "kalman-wander" not in method_names()
