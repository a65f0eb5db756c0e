"""Runs of the console: real child processes that are queued, cancelled, killed and found again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from run_command import ENVIRONMENT, paceline
from tiny_clips import copy_of, put_clip

from paceline.console import library as library_module
from paceline.console.library import Library
from paceline.console.pages.layout import progress_text
from paceline.console.runs import run_queue as runs_module
from paceline.console.runs.inputs import copy_documents
from paceline.console.runs.results import compare_summaries, read_series, read_summary, vehicle_rows
from paceline.console.runs.run_queue import Run, RunQueue
from paceline.documents.loading import load_clip
from paceline.errors import UnusableInput
from paceline.progress import PROGRESS_VARIABLE, format_progress, parse_progress
from paceline.survey.recording import measure_clip

FAST = ["--particles", "20", "--motion", "line"]


@pytest.fixture(autouse=True)
def the_package_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])


@pytest.fixture
def library(tmp_path: Path) -> Iterator[Library]:
    put_clip(tmp_path.resolve())
    library = Library(tmp_path.resolve())
    yield library
    library.runs.close()


def wait(condition: Callable[[], object], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def ended(library: Library, number: int) -> Run:
    wait(lambda: (run := library.runs.get("road", number)) is not None and not run.active)
    run = library.runs.get("road", number)
    assert run is not None
    return run


def contents(clip: Path) -> dict[str, bytes]:
    return {str(p.relative_to(clip)): p.read_bytes() for p in clip.rglob("*") if p.is_file() and "runs" not in p.parts}


@contextmanager
def watched(library: Library, number: int) -> Iterator[set[str]]:
    """The states of a run that anybody sees who asks all the time."""
    seen: set[str] = set()
    stop = threading.Event()

    def look() -> None:
        while not stop.wait(0.001):
            run = library.runs.get("road", number)
            seen.add("none" if run is None else run.state)

    watcher = threading.Thread(target=look)
    watcher.start()
    yield seen
    stop.set()
    watcher.join()


def test_runs_are_queued_read_and_cancelled(library: Library) -> None:
    clip = library.folder("road")
    before = contents(clip)
    for _ in range(3):
        library.runs.start("road", "speed", FAST)
    assert [r.number for r in library.runs.active()] == [1, 2, 3]
    library.runs.cancel("road", 3)
    assert ended(library, 3).state == "cancelled"
    wait(lambda: (run := library.runs.get("road", 1)) is not None and run.state == "running" and run.done > 0)
    waiting = library.runs.get("road", 2)
    assert waiting is not None and waiting.state == "waiting" and library.entry("road").state == "running"
    with watched(library, 1) as seen:
        first = ended(library, 1)
        wait(lambda: (run := library.runs.get("road", 2)) is not None and run.state == "running")
    assert seen == {"running", "measured"}  # and never interrupted, or absent, in between
    library.runs.cancel("road", 2)
    second = ended(library, 2)
    assert (first.state, second.state) == ("measured", "cancelled") and library.entry("road").state == "measured"
    assert first.done == first.total == 1 and first.ended is not None
    assert second.started is not None and second.started >= first.ended
    assert [p.name for p in library.runs.folder(second).iterdir() if p.name.startswith(("out", "."))] == []

    out = library.runs.output_folder(first)
    assert {"report.html", "overlay.mp4", "estimates.csv", "summary.json"} <= {p.name for p in out.iterdir()}
    (vehicle,) = read_summary(out)["vehicles"]
    assert vehicle["speed_mps"] == pytest.approx(18.0, abs=0.5)
    (row,) = vehicle_rows([vehicle], "km/h")
    assert row["vehicle"] == "v0" and row["verdict"] == "measured" and row["speed"].startswith("6")
    (series,) = read_series(out)
    assert series.refined and series.time[0] == 0 and series.value[-1] == pytest.approx(18.0, abs=0.5)
    vehicle |= {"speed_lo_mps": vehicle["speed_mps"] - 0.1, "speed_hi_mps": vehicle["speed_mps"] + 0.1}
    faster = vehicle | {"speed_mps": vehicle["speed_mps"] + 0.25}
    assert [r["change"] for r in compare_summaries([vehicle], [faster], "m/s")] == ["+0.25"]
    assert [r["change"] for r in compare_summaries([faster], [vehicle], "km/h")] == ["−0.90"]
    nearly = vehicle | {"speed_mps": vehicle["speed_mps"] - 1e-6}
    assert [r["change"] for r in compare_summaries([vehicle], [nearly, {"vehicle": "other"}], "m/s")] == ["0.00"]
    assert contents(clip) == before
    asked, here = load_clip(library.runs.input_document(first)), load_clip(clip / "clip.yaml")
    assert asked.left == here.left and asked.vehicles[0].left.tolist() == here.vehicles[0].left.tolist()


@pytest.mark.slow
def test_each_run_measures_the_documents_as_saved_at_its_request(library: Library) -> None:
    """Not what is saved while it waits, in none of its documents; and its results name the clip, not the copy."""
    file, rig = library.file("road"), library.folder("road") / "rig.yaml"
    for name in ("v0", "later"):
        file.write_text(file.read_text().replace("id: v0", f"id: {name}"))
        library.runs.start("road", "speed", FAST)
    file.write_text("left: [")
    rig.write_text("left: [")
    for number, name in ((1, "v0"), (2, "later")):
        run = ended(library, number)
        assert run.state == "measured", run.reason
        summary = json.loads((library.runs.output_folder(run) / "summary.json").read_text())
        assert [v["vehicle"] for v in summary["vehicles"]] == [name] and summary["clip"] == "road/clip.yaml"
        assert "<h1>road/clip.yaml</h1>" in (library.runs.output_folder(run) / "report.html").read_text()


def test_copied_documents_have_the_content_of_the_originals(tmp_path: Path) -> None:
    """A site elsewhere that names a rig elsewhere, and names that go through a link."""
    root = tmp_path.resolve()
    road = put_clip(root)
    (root / "sites").mkdir()
    (road / "rig.yaml").rename(root / "sites" / "rig.yaml")
    (root / "linked").symlink_to(root / "sites")
    given = yaml.safe_load((road / "clip.yaml").read_text())
    (root / "sites" / "site.yaml").write_text(yaml.safe_dump({"rig": "rig.yaml", "paths": given.pop("paths")}))
    del given["rig"]
    (road / "clip.yaml").write_text(yaml.safe_dump({**given, "site": "../linked/site.yaml"}))
    copy_documents(root, road / "clip.yaml", road / "asked", vehicles=True)
    copy, here = (load_clip(road / file) for file in ("asked/road/clip.yaml", "clip.yaml"))
    assert (copy.left, copy.right, copy.rate) == (here.left, here.right, here.rate)
    assert copy.paths.keys() == here.paths.keys() and copy.vehicles[0].id == here.vehicles[0].id
    assert copy.rig.R.tolist() == here.rig.R.tolist()
    (root / "sites" / "rig.yaml").write_text("left: [")
    assert load_clip(road / "asked" / "road" / "clip.yaml").rig.t.tolist() == here.rig.t.tolist()


def test_a_run_whose_process_is_killed_is_interrupted(library: Library) -> None:
    before = contents(library.folder("road"))
    run = library.runs.start("road", "speed", FAST)
    wait(lambda: (now := library.runs.get("road", run.number)) is not None and now.done > 0)
    process = library.runs._process
    assert process is not None
    os.kill(process[1].pid, signal.SIGKILL)
    found = ended(library, run.number)
    assert found.state == "interrupted" and "killed (signal 9)" in found.reason
    assert [p.name for p in library.runs.folder(run).iterdir() if p.name.startswith(("out", "."))] == []
    assert contents(library.folder("road")) == before and library.entry("road").state == "interrupted"


def test_a_failed_run_has_a_reason(library: Library) -> None:
    file = library.file("road")
    file.write_text(file.read_text().replace("frame: 0", "frame: 99"))
    found = ended(library, library.runs.start("road", "speed", FAST).number)
    assert found.state == "failed"
    assert found.reason.startswith("road/clip.yaml: vehicles: v0: frame 99 is not in the recording")


SERVING = """
import sys, time
from pathlib import Path
from paceline.console.library import Library
from paceline.console.pages.layout import progress_text
library = Library(Path(sys.argv[1]))
library.runs.start("road", "speed", sys.argv[2:])
while not library.runs.get("road", 1).done:
    time.sleep(0.02)
print(library.runs._process[1].pid, flush=True)
time.sleep(600)
"""


def test_a_killed_console_ends_its_run(tmp_path: Path) -> None:
    """Nobody reads what the command says of its progress any more: it ends, and its run is found interrupted."""
    root = tmp_path.resolve()
    clip = put_clip(root)
    before = contents(clip)
    command = [sys.executable, "-c", SERVING, str(root), *FAST, "--particles", "4000"]
    with subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as console:
        assert console.stdout is not None
        child = int(console.stdout.readline())
        with pytest.raises(UnusableInput, match="another console serves this folder already"):
            Library(root)
        console.kill()
        console.wait()
    wait(lambda: not _alive(child), 60)
    library = Library(root)
    (run,) = library.runs.runs_of("road")
    assert run.state == "interrupted" and "stopped while it ran" in run.reason
    assert contents(clip) == before and library.entry("road").state == "interrupted"
    library.runs.close()


def _alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False


def test_closing_ends_the_active_run(tmp_path: Path) -> None:
    put_clip(tmp_path.resolve())
    library = Library(tmp_path.resolve())
    library.runs.start("road", "speed", FAST)
    wait(lambda: library.runs._process is not None)
    library.runs.close()
    again = Library(tmp_path.resolve())
    (run,) = again.runs.runs_of("road")
    assert run.state == "interrupted" and run.reason == "the console was closed"
    again.runs.close()


# --- the list --------------------------------------------------------------------------------------------------------


def test_every_clip_has_a_state(library: Library) -> None:
    road = library.folder("road")
    without = {"no-rig": ["rig"], "no-vehicles": ["vehicles"], "no-paths": ["vehicles", "paths"]}
    for name, keys in without.items():
        file = copy_of(road, name) / "clip.yaml"
        given = yaml.safe_load(file.read_text())
        file.write_text(yaml.safe_dump({key: value for key, value in given.items() if key not in keys}))
    (copy_of(road, "broken") / "clip.yaml").write_text("left: [")
    (copy_of(road, "empty-picture") / "left" / "0000.png").write_bytes(b"")
    (road.parent / "deep" / "er").mkdir(parents=True)
    copy_of(road, "deep/er/clip")
    copy_of(road, "deep/er/.hidden/clip")
    (road.parent / "linked").symlink_to(road)
    states = {name: library.entry(name) for name in library.names()}
    assert {name: entry.state for name, entry in states.items()} == {
        "broken": "unreadable", "deep/er/clip": "ready", "empty-picture": "unreadable", "no-paths": "no paths",
        "no-rig": "no rig", "no-vehicles": "no vehicles", "road": "ready",
    }  # fmt: skip
    assert states["broken"].reason.startswith("broken/clip.yaml: line ")
    assert states["empty-picture"].reason == "empty-picture/left/0000.png: is empty; expected an image"


def test_the_folder_itself_may_be_a_clip(tmp_path: Path) -> None:
    clip = put_clip(tmp_path.resolve())
    library = Library(clip)
    assert library.names() == ["."] and library.entry(".").state == "ready"
    run = library.runs.start(".", "speed", [])
    copy = library.runs.input_document(run)
    assert (copy.parent.name, load_clip(copy).left) == (clip.name, clip / "left")  # a report is titled by its folder
    library.runs.cancel(".", run.number)
    library.runs.close()


def test_a_recording_is_opened_once_to_be_listed(library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []
    before = library_module.FrameCache.open
    monkeypatch.setattr(library_module.FrameCache, "open", lambda self, file: opened.append(file) or before(self, file))
    for _ in range(3):
        library.entry("road")
    assert len(opened) == 1
    rig = library.root / "shared.yaml"  # elsewhere: it counts as well
    file = library.file("road")
    rig.write_bytes((file.parent / "rig.yaml").read_bytes())
    file.write_text(file.read_text().replace("rig.yaml", "../shared.yaml"))
    assert library.entry("road").state == "ready" and len(opened) == 2
    rig.write_text("left:")
    assert library.entry("road").reason.startswith("road/../shared.yaml: ")
    rig.write_bytes((file.parent / "rig.yaml").read_bytes())
    assert library.entry("road").state == "ready" and len(opened) == 3
    (library.folder("road") / "left").rename(library.folder("road") / "gone")
    assert library.entry("road").state == "unreadable" and len(opened) == 4


def test_a_run_folder_that_cannot_be_created_is_reported(library: Library) -> None:
    (library.folder("road") / "runs").write_text("a file is in the way")
    with pytest.raises(UnusableInput, match="road/runs: cannot be written"):
        library.runs.start("road", "speed", FAST)
    assert library.runs.runs_of("road") == [] and library.runs.active() == []


def test_on_a_full_disk_no_run_starts_and_the_end_of_one_is_reported(
    library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = runs_module._write_run

    def full(folder: Path, run: Run) -> None:
        if run.active and run.number == 1:
            return write(folder, run)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(runs_module, "_write_run", full)
    library.runs.start("road", "speed", ["--particles", "0"])
    run = ended(library, 1)
    assert run.state == "failed" and "--particles 0" in run.reason
    with pytest.raises(UnusableInput, match="runs/0002: cannot be written .No space left"):
        library.runs.start("road", "speed", FAST)
    assert [p.name for p in (library.folder("road") / "runs").iterdir()] == ["0001"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"state": "running"}', '{"state": 5, "options": 3}',
                                  '{"kind": "speed", "options": [], "state": "measured", "created": "x"}'])  # fmt: skip
def test_a_damaged_record_is_no_run(library: Library, text: str) -> None:
    folder = library.folder("road") / "runs" / "0001"
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(text)
    assert library.runs.runs_of("road") == [] and library.entry("road").state == "ready"


def test_results_are_not_read_through_links(library: Library, tmp_path: Path) -> None:
    """Somebody may have put them there after the run."""
    folder = library.folder("road") / "runs" / "0001"
    elsewhere = tmp_path / "elsewhere"
    for made in (folder, elsewhere):
        made.mkdir(parents=True)
    (elsewhere / "summary.json").write_text('{"vehicles": [], "notices": ["secret"]}')
    (elsewhere / "estimates.csv").write_text("vehicle,time_s\n")
    out = folder / "out"
    out.symlink_to(elsewhere)
    for read in (read_summary, read_series):
        with pytest.raises(UnusableInput, match="is no "):
            read(out)


def test_the_remaining_time_is_extrapolated() -> None:
    run = Run("c", 1, "speed", (), "running", 0.0, done=3, total=11, first=20.0, first_done=1, latest=24.0)
    assert run.seconds_left(24.0) == pytest.approx(16.0)  # two frames took 4 s, eight are left
    assert run.seconds_left(30.0) == pytest.approx(10.0) and run.seconds_left(41.0) is None  # longer than expected
    assert replace(run, done=1).seconds_left(24.0) is None and replace(run, total=None).seconds_left(24.0) is None


def test_progress_lines_are_parsed_as_formatted() -> None:
    assert parse_progress(format_progress("measuring", 3, 12) + "\n") == ("measuring", 3, 12)
    assert parse_progress(format_progress("averaging", 3, None)) == ("averaging", 3, None)
    for line in ("", "note: measuring 3 of 12", "progress: measuring x 12", "progress: measuring 3 12 4"):
        assert parse_progress(line) is None


def test_a_run_goes_through_named_stages_each_with_its_share(
    small_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Down to the report: none of them ends long before the next one is named."""
    monkeypatch.setenv(PROGRESS_VARIABLE, "lines")
    done = paceline("speed", small_clip, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    lines = [found for line in done.stderr.splitlines() if (found := parse_progress(line)) is not None]
    stages = list(dict.fromkeys(activity for activity, *_ in lines))
    assert stages == ["estimating", "measuring", "refining", "drawing", "writing"]
    shares = {stage: [(count, total) for activity, count, total in lines if activity == stage] for stage in stages}
    assert shares["measuring"] == [(k, 7) for k in range(1, 8)]
    assert shares["refining"] == shares["writing"] == [(0, 1), (1, 1)]
    assert shares["drawing"] == [(k, 7) for k in range(8)]


def test_progress_is_described_by_its_stage() -> None:
    run = Run("c", 1, "speed", (), "running", 0.0)
    assert progress_text(run) == "starting"
    for activity, count, total, text in (
        ("measuring", 12, 50, "tracking vehicles: 12 of 50 frames"),
        ("refining", 1, 2, "refining the speeds: 1 of 2 vehicles"),
        ("following", 7, None, "following the vehicle: 7 frames"),
        ("writing", 0, None, "writing the report"),
        ("writing", 2, 3, "writing the report: 2 of 3 parts"),
    ):
        assert progress_text(replace(run, doing=activity, done=count, total=total, first_done=count)) == text
    timed = replace(run, doing="drawing", done=3, total=5, first=0.0, first_done=1, latest=time.time())
    assert progress_text(replace(timed, first=time.time() - 60)).endswith("3 of 5 frames, about 1 min 0 s left")
    live = replace(run, kind="live", doing="learning", done=12, total=30, first_done=12, started=time.time() - 5)
    assert progress_text(live) == "estimating background: 12 of 30 s"
    assert progress_text(replace(live, doing="measuring", done=0, total=None)) == "running for 5 s"


def test_a_callback_is_told_of_frames_alone(small_clip: Path) -> None:
    """Of those that are tracked, not of other stages."""
    calls: list[tuple[int, int | None]] = []
    measure_clip(small_clip, progress=lambda *call: calls.append(call))
    assert calls == [(k, 7) for k in range(1, 8)]


def test_the_command_writes_progress_lines_on_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PROGRESS_VARIABLE, "lines")
    done = paceline("lanes", put_clip(tmp_path), "-o", tmp_path / "site.yaml")
    assert done.returncode == 1 and done.stdout.startswith("no lane found: ")
    assert [parse_progress(line) for line in done.stderr.splitlines()][-1] == ("averaging", 5, 5)
    assert all(parse_progress(line) for line in done.stderr.splitlines())


def test_runs_are_numbered_on(library: Library) -> None:
    (library.folder("road") / "runs" / "0041").mkdir(parents=True)
    run = library.runs.start("road", "speed", FAST)
    assert run.number == 42 and isinstance(library.runs, RunQueue)
    library.runs.cancel("road", run.number)
    assert ended(library, 42).state == "cancelled"


def test_vehicles_are_detected_in_a_copy_of_the_clip(tmp_path: Path) -> None:
    """The command adds to the clip.yaml that it is given, which is one in the run's own folder."""
    root = tmp_path.resolve()
    clip = put_clip(root)
    copy_documents(root, clip / "clip.yaml", clip / "asked", vehicles=False)
    copy, here = load_clip(clip / "asked" / "road" / "clip.yaml"), load_clip(clip / "clip.yaml")
    assert [copy.left, copy.right] == [here.left, here.right]
    assert copy.paths.keys() == here.paths.keys() and copy.rate == here.rate
    assert here.vehicles and not copy.vehicles
