"""``paceline compare``: errors, coverage, frame by frame, of results by any methods; and what cannot be compared."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import leave_out
from run_command import assert_one_line_error, paceline

from paceline.verification.comparison import vehicle_errors
from paceline.verification.saved_results import read_result
from paceline.verification.truth import TrueSpeeds, read_truth

MPS_PER_MPH = 0.44704


@pytest.fixture(scope="module")
def outs(small_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the results of two methods, as the command writes them, and the truth."""
    folder = tmp_path_factory.mktemp("compare")
    shutil.copyfile(small_clip.with_name("truth.json"), folder / "truth.json")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("matplotlib.figure.Figure.savefig", leave_out)
        for method in ("sift", "zhu"):
            config = folder / f"{method}.yaml"
            config.write_text(f"method: {method}\nreport: {{overlay: false}}\n")
            done = paceline("speed", small_clip, "-o", folder / method, "--config", config)
            assert done.returncode == 0, done.stderr
    return folder


def test_results_are_compared_with_the_truth(outs: Path) -> None:
    done = paceline("compare", "sift", "zhu", "--truth", "truth.json", "--units", "m/s", folder=outs)
    assert (done.returncode, done.stderr) == (0, "")
    vehicles, results = (block.splitlines() for block in done.stdout.split("\n\n"))
    heads = ["vehicle", "result", "speed, m/s", "true", "error", "inside", "frames: RMS", "worst", "refined: RMS"]
    assert vehicles[0].split() == " ".join(heads).split()
    assert [line.split()[:2] for line in vehicles[1:]] == [["v0", "sift"], ["v0", "zhu"]]
    assert [line.split()[1] for line in results[1:]] == ["sift", "zhu"]
    for method, line in zip(("sift", "zhu"), vehicles[1:], strict=True):
        (entry,) = json.loads((outs / method / "summary.json").read_text())["vehicles"]
        inside = entry["speed_lo_mps"] <= 12.0 <= entry["speed_hi_mps"]
        assert ("yes" if inside else "no") in line.split() and "12.0" in line
        with (outs / method / "estimates.csv").open(newline="") as stream:
            speeds = [float(row["speed_mps"]) for row in csv.DictReader(stream) if row["speed_mps"]]
        (error,) = vehicle_errors(read_result(outs / method), read_truth(outs / "truth.json"))
        assert error.error == pytest.approx(entry["speed_mps"] - 12.0) and error.inside == inside
        np.testing.assert_allclose(error.frame_errors, np.array(speeds) - 12.0)
        assert f"{np.sqrt(np.mean(error.frame_errors**2)):.2f}" in line


def test_without_a_truth_the_first_result_stands_for_it(outs: Path) -> None:
    done = paceline("compare", "zhu", "sift", folder=outs)
    assert done.returncode == 0
    assert "Errors are differences from zhu, in place of a truth." in done.stdout and "reference" in done.stdout
    given = paceline("compare", "sift", "--truth", "zhu", folder=outs)
    assert given.returncode == 0 and given.stdout.splitlines()[1].split() == done.stdout.splitlines()[1].split()


def test_where_no_vehicle_is_in_common_the_status_is_1(outs: Path, tmp_path: Path) -> None:
    rows = json.loads((outs / "truth.json").read_text())
    (tmp_path / "truth.json").write_text(json.dumps([row | {"vehicle": "other"} for row in rows]))
    done = paceline("compare", outs / "sift", "--truth", tmp_path / "truth.json")
    assert done.returncode == 1 and done.stdout.startswith("no vehicle is measured in a result and in ")


def test_a_true_mean_is_distance_by_time() -> None:
    true = TrueSpeeds(np.array([0, 1, 3]), np.array([0.0, 1.0, 3.0]), np.array([10.0, 12.0, 20.0]))
    assert true.mean_over(0, 3) == pytest.approx((11 * 1 + 16 * 2) / 3)
    assert true.mean_over(1, 1) == 12.0
    assert np.isnan([true.mean_over(0, 5), true.mean_over(4, 5)]).all()
    assert true.at(np.array([1, 2])).tolist()[0] == 12.0 and np.isnan(true.at(np.array([2]))).all()


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("truth.json", "[1, 2", ["truth.json: line 1: is not JSON"]),
        ("truth.json", '{"frame": 1}', ["truth.json: expected a list"]),
        ("truth.json", '[{"vehicle": "v0", "frame": 0, "time_s": 0}]', ["truth.json: [0].speed_mps: missing"]),
        (
            "truth.json",
            '[{"vehicle": "v0", "frame": -1, "time_s": 0, "speed_mps": 1}]',
            ["[0].frame: expected at least 0"],
        ),
        (
            "truth.json",
            '[{"vehicle": "v0", "frame": 0, "time_s": 0, "speed_mps": NaN}]',
            ["[0].speed_mps: expected a finite"],
        ),
        ("out/summary.json", "{}", ["summary.json: vehicles: missing"]),
        ("out/summary.json", '{"vehicles": [{"vehicle": "v0"}]}', ["summary.json: vehicles[0].verdict: missing"]),
        ("out/estimates.csv", "vehicle,frame\n", ["estimates.csv: status: there is no such column"]),
        (
            "out/estimates.csv",
            "vehicle,frame,time_s,speed_mps,status,refined_speed_mps\nv0,0,0.0,fast,tracking,\n",
            ["estimates.csv: line 2: speed_mps: expected a number, found 'fast'"],
        ),
    ],
)
def test_bad_input_is_one_line_that_names_file_and_key(
    outs: Path, tmp_path: Path, file: str, text: str, words: list[str]
) -> None:
    (tmp_path / "out").mkdir()
    for name in ("summary.json", "estimates.csv"):
        shutil.copyfile(outs / "sift" / name, tmp_path / "out" / name)
    shutil.copyfile(outs / "truth.json", tmp_path / "truth.json")
    (tmp_path / file).write_text(text)
    assert_one_line_error(paceline("compare", "out", "--truth", "truth.json", folder=tmp_path), *words)


def test_what_is_missing_is_named(outs: Path, tmp_path: Path) -> None:
    assert_one_line_error(
        paceline("compare", "nowhere", outs / "zhu", folder=tmp_path), "nowhere/summary.json: no such"
    )
    assert_one_line_error(paceline("compare", "sift", folder=outs), "sift: is the only result; expected another one")
    assert_one_line_error(paceline("compare", "sift", "--truth", "no.json", folder=outs), "no.json: no such file")
    assert_one_line_error(paceline("compare", "sift", "zhu", "--units", "knots", folder=outs), "--units", "knots")
