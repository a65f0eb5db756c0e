"""What a run tells while it is under way: the filter's values as they stand in the tables later, and no more memory."""

from __future__ import annotations

import csv
import json
import math
import time
from pathlib import Path

import numpy as np
import pytest
import tiny_chase
from hypothesis import given
from hypothesis import strategies as st
from run_command import ENVIRONMENT, paceline
from tiny_clips import put_clip

from paceline.console.library import Library
from paceline.console.pages.layout import progress_text
from paceline.console.runs.kinds import LIVE_RUN, SPEED_RUN
from paceline.console.runs.run_progress import MAX_SERIES_VALUES, RunProgress
from paceline.console.runs.run_queue import STATE_RUNNING, Run
from paceline.progress import (
    MAX_LINE_LENGTH,
    MAX_PARTICLES,
    PROGRESS_VARIABLE,
    format_estimate,
    parse_estimate,
    parse_progress,
)

NAN = float("nan")
FINITE = st.floats(-1e6, 1e6)


@given(name=st.text(max_size=100), time_s=FINITE, value=FINITE, std=FINITE, count=st.integers(0, 2000))
def test_an_estimate_line_is_parsed_as_formatted(
    name: str, time_s: float, value: float, std: float, count: int
) -> None:
    corners, places = np.arange(8.0).reshape(4, 2), np.linspace(0, 99, 2 * count).reshape(-1, 2)
    line = format_estimate(name, 7, time_s, value, std, "tracking", [corners, corners], [places, places])
    assert "\n" not in line and len(line) < MAX_LINE_LENGTH and parse_progress(line) is None
    found = parse_estimate(line + "\n")
    assert found is not None and (found["vehicle"], found["frame"]) == (name, 7)
    for key, given_value in (("time_s", time_s), ("value", value), ("std", std)):
        assert found[key] == pytest.approx(given_value, abs=1e-4)
    assert found["outlines"] == [corners.tolist()] * 2
    shown = np.array(found["particles"][0]).reshape(-1, 2)
    assert min(count, MAX_PARTICLES // 2) <= len(shown) <= MAX_PARTICLES
    for place in shown:
        assert np.abs(places - place).max(axis=1).min() < 0.006


def test_unknown_values_are_null() -> None:
    found = parse_estimate(format_estimate("v", 0, 0.0, NAN, math.inf, "lost", [np.full((4, 2), 1e30)]))
    assert found is not None and found["value"] is None and found["std"] is None
    assert json.loads(json.dumps(found)) == found and np.isfinite(found["outlines"]).all()


@pytest.mark.parametrize(
    "line", ["", "estimate: ", "estimate: {", "estimate: []", 'estimate: {"vehicle": "v"}', "progress: measuring 1 2"]
)
def test_other_lines_are_no_estimates(line: str) -> None:
    assert parse_estimate(line) is None


def estimate(vehicle: str, frame: int, value: float | None) -> dict[str, object]:
    return {"vehicle": vehicle, "frame": frame, "time_s": frame / 5, "value": value, "std": None}


def test_a_frame_is_shown_once_all_its_estimates_are_added() -> None:
    progress = RunProgress()
    progress.finish_frame()
    assert progress.last_frame == {} and progress.series() == []
    progress.add_estimate(estimate("a", 3, None))
    progress.add_estimate(estimate("b", 3, 20.0))
    assert progress.last_frame == {}
    progress.finish_frame()
    progress.add_estimate(estimate("a", 4, 10.0))
    assert progress.last_frame["frame"] == 3 and [v["vehicle"] for v in progress.last_frame["vehicles"]] == ["a", "b"]
    progress.finish_frame()
    assert [v["vehicle"] for v in progress.last_frame["vehicles"]] == ["a"]
    assert {s.vehicle: (s.time, s.value) for s in progress.series()} == {"b": ([0.6], [20.0]), "a": ([0.8], [10.0])}


@pytest.mark.parametrize("count", [MAX_SERIES_VALUES, MAX_SERIES_VALUES + 1, 25_000])
def test_the_kept_values_do_not_grow_with_the_recording(count: int) -> None:
    progress = RunProgress()
    for frame in range(count):
        progress.add_estimate(estimate("a", frame, float(frame)))
        progress.finish_frame()
    (series,) = progress.series()
    steps = np.diff(series.value)
    assert MAX_SERIES_VALUES / 2 <= len(series.value) <= MAX_SERIES_VALUES and (steps == steps[0]).all()  # even in time
    assert series.value[0] == 0 and series.value[-1] > count - 1 - steps[0]


def lines_of(*arguments: object, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, object]]:
    monkeypatch.setenv(PROGRESS_VARIABLE, "lines")
    done = paceline(*arguments)
    assert done.returncode == 0, done.stderr
    return [found for line in done.stderr.splitlines() if (found := parse_estimate(line))]


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_the_estimate_lines_of_a_follower_match_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, out = tiny_chase.write(tmp_path / "chase", 8), tmp_path / "out"
    told_by = lines_of("follow", file, "-o", out, "--no-overlay", monkeypatch=monkeypatch)
    rows = rows_of(out / "track.csv")
    assert [t["frame"] for t in told_by] == [int(r["frame"]) for r in rows] == list(range(8))
    for found, row in zip(told_by, rows, strict=True):
        assert found["value"] == pytest.approx(float(row["z_m"]), abs=1e-4)
        assert found["std"] == pytest.approx(float(row["z_std_m"]), abs=1e-4)
        lines = np.array(found["outlines"])
        x, y, z = tiny_chase.truth(int(row["frame"]))  # the outermost lines are the body's
        body = tiny_chase.BOXES["body"][:4]
        edges = [tiny_chase.CX + tiny_chase.F * (x + body[i]) / z for i in (0, 2)]
        assert lines.shape == (1, 9, 2, 2)
        assert [lines[..., 0].min(), lines[..., 0].max()] == pytest.approx(edges, abs=0.6)


def test_an_active_run_is_monitored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every value of the filter comes, as it stands in the table later; afterwards nothing is kept of it."""
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    put_clip(tmp_path.resolve())
    library = Library(tmp_path.resolve())
    run = library.runs.start("road", "speed", ["--particles", "20"])
    seen: dict[int, dict[str, object]] = {}
    series = []
    end = time.monotonic() + 120
    while (now := library.runs.get("road", run.number)) is not None and now.active:
        assert time.monotonic() < end
        values, scene = library.runs.live_data(now)
        if scene:
            series, seen[scene["frame"]] = values, scene
        time.sleep(0.005)
    assert now is not None and now.state == "measured"
    assert library.runs.live_data(now) == ([], {})
    rows = rows_of(library.runs.output_folder(now) / "estimates.csv")
    assert set(seen) <= {int(row["frame"]) for row in rows} and len(seen) >= 2
    known = [float(row["speed_mps"]) for row in rows if row["speed_mps"]]
    assert series[0].vehicle == "v0" and series[0].value == pytest.approx(known, abs=1e-4)
    library.runs.close()


@pytest.mark.parametrize("kind", [SPEED_RUN, LIVE_RUN])
def test_a_run_that_compiles_says_so(kind: str) -> None:
    run = Run("road", 1, kind, (), STATE_RUNNING, created=0.0, started=0.0, doing="compiling", done=7)
    assert progress_text(run) == "compiling, once after an upgrade: 7 functions"
