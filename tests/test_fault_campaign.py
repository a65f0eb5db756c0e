"""The campaign of faults: that it counts what it should, and a short run of it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import documents, processes, recordings
from faults.areas import Command, changes, mean_speed
from faults.cases import AREAS, Case, Disturbance, Fault, Visibility, draw_case
from faults.judgement import KINDS, Outcome, Reading, contents, judge
from faults.processes import Ended, run
from faults.recordings import Recording
from faults.sources import Truth, clockwise

ROOT = Path(__file__).parents[1]
FAULTS = (*recordings.FAULTS, *documents.FAULTS)
DONE = Ended(0, "", "", 1.0)
PLAIN = Case(1, "speed", (), Disturbance(), False)


def case_with(visibility: Visibility) -> Case:
    return replace(PLAIN, faults=(Fault("a fault", visibility, ("speed",), lambda r, rng: None),))


def kinds(outcome: Outcome, case: Case = PLAIN) -> list[str]:
    return [finding.kind for finding in judge(case, outcome)]


# --- judgement -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "half", "true", "wrong"),
    [
        (20.0, 0.5, 20.4, False),
        (20.0, 0.5, 20.7, False),  # outside by less than a half-width
        (20.0, 0.5, 21.1, True),
        (20.0, 0.5, 18.9, True),
        (20.0, 0.01, 20.1, False),  # outside by less than 0.5 % of the truth
        (20.0, 0.01, 20.2, True),
        (0.0, 0.02, 12.0, True),
    ],
)
def test_a_number_is_wrong_far_outside_its_interval(value: float, half: float, true: float, wrong: bool) -> None:
    assert Reading("speed", value, value - half, value + half, true).wrong == wrong


def test_a_wrong_number_counts_where_its_fault_can_be_seen() -> None:
    outcome = Outcome(DONE, (Reading("speed", 20.0, 19.9, 20.1, 25.0),), complete=True)
    for visibility in Visibility:
        expected = [] if visibility == Visibility.NOT_VISIBLE else ["wrong number"]
        assert kinds(outcome, case_with(visibility)) == expected
    worst = replace(PLAIN, faults=(case_with(Visibility.NOT_VISIBLE).faults + case_with(Visibility.HARMLESS).faults))
    assert worst.visibility == Visibility.NOT_VISIBLE and not worst.measurable


@pytest.mark.parametrize(
    ("ended", "disturbance", "expected"),
    [
        (DONE, "", []),
        (Ended(2, "", "paceline: clip.yaml: rate: expected a number\n", 1.0), "", []),
        (Ended(0, "", "note: a frame is missing\n", 1.0), "", []),
        (Ended(130, "", "paceline: interrupted\n", 1.0), "SIGINT", []),
        (Ended(143, "", "", 1.0), "SIGTERM", []),
        (Ended(130, "", "paceline: interrupted\n", 1.0), "SIGTERM", ["exit status"]),
        (Ended(143, "", "", 1.0), "", ["exit status"]),
        (Ended(3, "", "", 1.0), "", ["exit status"]),
        (Ended(2, "", "", 1.0), "", ["exit status"]),
        (Ended(2, "", "paceline: one\npaceline: two\n", 1.0), "", ["exit status"]),
        (Ended(0, "", "[h264 @ 0x1] error while decoding\n", 1.0), "", ["exit status"]),
        (Ended(1, "", "Traceback (most recent call last):\n  …\nKeyError: 'x'\n", 1.0), "", ["traceback"]),
        (Ended(0, "", "Exception ignored in: <function>\nKeyboardInterrupt\n", 1.0), "", ["traceback"]),
        (Ended(-11, "", "", 1.0), "", ["traceback"]),
        (Ended(-9, "", "", 75.0, hung=True), "", ["hang"]),
        (Ended(0, "", "", 1.0, survivors=1), "", ["left behind"]),
    ],
)
def test_an_end_outside_the_contract_counts(ended: Ended, disturbance: str, expected: list[str]) -> None:
    case = replace(PLAIN, disturbance=Disturbance(disturbance))
    assert kinds(Outcome(ended, complete=True), case) == expected
    assert set(expected) <= set(KINDS)


def test_status_0_without_all_of_the_output_counts() -> None:
    assert kinds(Outcome(DONE, complete=False)) == ["exit status"]


def test_what_is_left_and_what_is_lost_count(tmp_path: Path) -> None:
    for place in ("clip", "disk/out"):
        (tmp_path / place).mkdir(parents=True)
    (tmp_path / "clip" / "clip.yaml").write_text("rate: 5")
    (tmp_path / "disk" / "out" / "summary.json").write_text("earlier")
    command = Command(("speed",), frozenset({"summary.json"}), ("clip.yaml",), r"vehicle-.*\.png")

    def look() -> tuple[dict[str, str], dict[str, str]]:
        return contents(tmp_path / "clip"), contents(tmp_path / "disk")

    refused, before = Ended(2, "", "paceline: no\n", 1.0), look()
    assert changes(PLAIN, command, refused, before, look()) == ([], [])
    (tmp_path / "disk" / ".out.1234.partial").mkdir()
    (tmp_path / "disk" / "out" / "summary.json").write_text("later")
    (tmp_path / "clip" / "clip.yaml").write_text("rate: 6")
    (tmp_path / "clip" / "vehicle-v0.png").write_text("")
    after = look()
    new, changed = changes(PLAIN, command, refused, before, after)
    assert new == [".out.1234.partial", "clip/vehicle-v0.png"]
    assert changed == ["clip/clip.yaml", "out/summary.json"]
    assert changes(PLAIN, command, DONE, before, after) == ([".out.1234.partial"], [])
    left = Outcome(refused, new=tuple(new), changed=tuple(changed))
    assert kinds(left) == ["left behind", "left behind", "lost", "lost"]


# --- processes -----------------------------------------------------------------------------------------------------


def test_a_traceback_a_crash_and_a_status_are_seen(tmp_path: Path) -> None:
    assert run(lambda: print("said"), tmp_path).stdout == "said\n"
    assert run(lambda: sys.exit(2), tmp_path).status == 2
    failed = run(lambda: {}["absent"], tmp_path)  # type: ignore[misc]
    assert failed.status == 1 and kinds(Outcome(failed, complete=True)) == ["traceback"]
    assert run(lambda: os.kill(os.getpid(), 9), tmp_path).status == -9


def test_a_hang_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "SECONDS_ALLOWED", 0.2)
    ended = run(lambda: time.sleep(60), tmp_path)
    assert ended.hung and ended.seconds < 30 and kinds(Outcome(ended)) == ["hang"]


def test_a_process_that_is_left_is_seen_and_ended(tmp_path: Path) -> None:
    begun = time.monotonic()
    ended = run(lambda: print(subprocess.Popen(["sleep", "60"], stdout=subprocess.PIPE).pid), tmp_path)
    assert ended.survivors == 1
    state = Path(f"/proc/{int(ended.stdout)}/stat")
    while state.exists() and " Z " not in state.read_text():  # it is killed, but perhaps nobody has waited for it
        assert time.monotonic() - begun < 30


def test_limits_and_signals_reach_a_process(tmp_path: Path) -> None:
    full = run(lambda: Path("big").write_bytes(bytes(50_000)), tmp_path, Disturbance("file size", size=20_000))
    assert "File too large" in full.stderr
    no_memory = run(lambda: np.ones(10**8), tmp_path, Disturbance("memory", size=10**8))  # type: ignore[arg-type, return-value]
    assert "MemoryError" in no_memory.stderr

    def catching() -> None:
        import signal

        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(143))
        time.sleep(60)

    assert run(catching, tmp_path, Disturbance("SIGTERM", after=0.05)).status == 143


# --- cases ---------------------------------------------------------------------------------------------------------


def test_a_case_is_that_of_its_seed() -> None:
    cases = [draw_case(seed, area, FAULTS) for area in AREAS for seed in range(40)]
    assert cases == [draw_case(seed, area, FAULTS) for area in AREAS for seed in range(40)]
    assert {case.visibility for case in cases} == set(Visibility)
    assert all(case.area in fault.areas for case in cases for fault in case.faults)


def test_every_fault_has_a_name_of_its_own() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


def recording() -> Recording:
    rng = np.random.default_rng(1)
    views = [[rng.integers(0, 256, (64, 96), np.uint8) for _ in range(8)] for _ in range(2)]

    def draw(r: Recording) -> dict[str, Any]:
        rate = round(r.stated_rate) if r.stated_rate % 1 == 0 else r.stated_rate
        clip = {"left": "left", "right": "right", "rate": rate, "rig": "rig.yaml", "vehicles": [], "paths": {}}
        return {"clip.yaml": clip, "rig.yaml": {"translation": [0.5, 0.0, 0.0]}}

    return Recording(["left", "right"], views, 10.0, draw)


@pytest.mark.parametrize("fault", [f for f in FAULTS if set(f.areas) - {"follow"}], ids=lambda f: f.name)
def test_a_fault_can_be_put_to_a_recording(fault: Fault, tmp_path: Path) -> None:
    """With one of a few seeds at the latest: some documents hold nothing that a fault could change."""
    recording().write(tmp_path / "whole")
    different = []
    for seed in range(8):
        spoiled = recording()
        fault.apply(spoiled, np.random.default_rng(seed))
        spoiled.write(tmp_path / f"{seed}")
        different.append(contents(tmp_path / f"{seed}") != contents(tmp_path / "whole"))
        if different[-1]:
            break
    assert any(different)


def test_what_a_user_draws_follows_the_pixels() -> None:
    r = recording()
    r.warp(0, np.array([[-1.0, 0.0, 95.0], [0.0, 1.0, 0.0]]))
    corners = [[10.0, 20.0], [30.0, 20.0], [30.0, 40.0], [10.0, 40.0]]
    mirrored = clockwise(r.moved(0, 0, corners))
    assert mirrored.tolist() == [[65.0, 20.0], [85.0, 20.0], [85.0, 40.0], [65.0, 40.0]]
    assert r.views[0][0][20, 85] == recording().views[0][0][20, 10]


def test_the_true_speed_is_the_mean_over_what_was_tracked() -> None:
    truth = Truth(times=(0.0, 1.0, 2.0, 3.0), speeds=(10.0, 12.0, 14.0, float("nan")))
    assert mean_speed(truth, [0, 2]) == pytest.approx(12.0)
    assert mean_speed(truth, [1, 2]) == pytest.approx(13.0)


# --- the campaign --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_short_campaign_finds_nothing() -> None:
    command = [sys.executable, "-m", "tests.faults", "--n", "12", "--seed", "2782"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| all | 12 |" in done.stdout
