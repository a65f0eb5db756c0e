"""Live sources in the console: shown, never opened to be looked at, and measured by a run that a person stops."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tiny_chase
import yaml
from console_client import SAME, open_client
from run_command import ENVIRONMENT
from test_console_runs import wait
from test_survey_live import survey_file
from tiny_clips import put_clip

from paceline.commands.progress_output import small_jpegs
from paceline.console.confinement import NotFound
from paceline.console.document_references import is_live, live_views
from paceline.console.library import Library
from paceline.console.routes import result_address
from paceline.console.runs.inputs import copy_documents
from paceline.console.runs.kinds import FOLLOW_RUN, LIVE_RUN, command_arguments
from paceline.console.runs.options import (
    command_options,
    convert_tolerance,
    limit_hint,
    limit_problem,
    setting_hint,
    setting_problem,
)
from paceline.console.runs.results import (
    MAX_LIVE_SERIES,
    nothing_measured_reason,
    picture_name,
    read_series,
    read_summary,
    result_files,
)
from paceline.console.runs.run_progress import MAX_KEPT_FRAMES as KEPT_FRAMES
from paceline.console.runs.run_progress import RunProgress
from paceline.documents.loading import load_clip
from paceline.errors import UnusableInput
from paceline.progress import MAX_LINE_LENGTH, format_pictures, parse_estimate, parse_pictures, parse_progress

CAMERAS = ["rtsp://camera/left", "RTSPS://u:p@10.0.0.7:554/a?b=c", "http://camera/mjpg", "udp://0.0.0.0:5000",
           "srt://host:9", "/dev/video0", "/dev/video12"]  # fmt: skip
NO_CAMERAS = ["file:///etc/passwd", "concat://a|b", "subfile:,start,0://x", "ftp://host/x", "rtsp://", "async:file://x",
              "rtsp://host /x"]  # fmt: skip
FILES = ["left", "left.mp4", "/dev/null", "/dev/video", "/dev/videos", "left/%04d.png", "../left", "x" * 5000, "a\0b"]


@pytest.mark.parametrize("given", CAMERAS)
def test_cameras_and_streams_are_live(tmp_path: Path, given: str) -> None:
    assert is_live(tmp_path / "clip.yaml", given)


@pytest.mark.parametrize("given", NO_CAMERAS)
def test_addresses_of_other_things_are_refused(tmp_path: Path, given: str) -> None:
    with pytest.raises(UnusableInput, match="expected a file, or an rtsp"):
        is_live(tmp_path / "clip.yaml", given)


@pytest.mark.parametrize("given", FILES)
def test_files_are_not_live(tmp_path: Path, given: str) -> None:
    assert not is_live(tmp_path / "clip.yaml", given)


def change(file: Path, **values: object) -> None:
    given = yaml.safe_load(file.read_text())
    file.write_text(yaml.safe_dump({key: value for key, value in {**given, **values}.items() if value is not None}))


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Library]:
    """Over a clip with live cameras; to open anything that decodes is a failure."""
    root = tmp_path.resolve() / "clips"
    change(put_clip(root, "gate") / "clip.yaml", left="rtsp://user:secret@camera/left", right="/dev/video1", rate=None)
    change(tiny_chase.write(root / "drive", 2), video="rtsp://user:secret@car/rear", rate=None)
    os.mkfifo(put_clip(root, "pipe") / "fifo")
    change(root / "pipe" / "clip.yaml", left="fifo", right="rtsp://camera/right", rate=None)
    monkeypatch.setattr(av, "open", lambda *_, **__: pytest.fail("a live source was opened"))
    library = Library(root)
    yield library
    library.runs.close()


def test_live_clips_are_listed_and_not_opened(library: Library) -> None:
    found = {name: library.entry(name) for name in library.names()}
    assert {name: entry.state for name, entry in found.items()} == {"drive": "live", "gate": "live", "pipe": "live"}
    assert found["gate"].contents.live == ("rtsp://camera/left", "/dev/video1")
    assert found["gate"].reason == "rtsp://camera/left and /dev/video1: measured while they record"
    assert not any(entry.contents.pictures for entry in found.values())
    assert "secret" not in repr(found)
    assert live_views(library.file("pipe")) == ["fifo", "rtsp://camera/right"]


def test_frames_of_live_sources_are_not_fetched(library: Library) -> None:
    root = library.root
    library.runs.close()
    with open_client(root) as client:
        for clip in ("gate", "drive", "pipe"):
            for address in ("/api/thumbnail?", "/api/frame?view=0&frame=0&", "/api/setup?", "/api/target?"):
                answer = client.get(f"{address}clip={clip}", headers=SAME)
                assert answer.status_code in (404, 422) and "secret" not in answer.text
    library.runs = Library(root).runs  # for the fixture to close


def test_a_live_source_cannot_replace_a_file(tmp_path: Path) -> None:
    root = tmp_path.resolve() / "clips"
    clip = put_clip(root)
    os.mkfifo(tmp_path / "fifo")
    library = Library(root)
    for key, value, words in (
        ("left", "../../fifo", "leads out of"), ("left", "file:///etc/passwd", "expected a file, or an rtsp"),
        ("rig", "rtsp://camera/rig.yaml", "no such file"), ("right", "/dev/null", "leads out of"),
    ):  # fmt: skip
        put_clip(root)
        change(clip / "clip.yaml", **{key: value})
        entry = library.entry("road")
        assert entry.state == "unreadable" and words in entry.reason
    library.runs.close()


def test_a_run_starts_from_a_copy_without_vehicles(tmp_path: Path) -> None:
    root = tmp_path.resolve()
    clip = put_clip(root)
    change(clip / "clip.yaml", right="rtsp://camera/right", rate=None)
    copy_documents(root, clip / "clip.yaml", clip / "asked", vehicles=False)
    command = command_arguments(LIVE_RUN, "road/clip.yaml", clip)
    assert command == ["speed", "road/clip.yaml", "-o", str(clip / "out"), "--live"]
    copy = load_clip(clip / "asked" / "road" / "clip.yaml")
    assert copy.left == clip / "left" and copy.addresses == (str(clip / "left"), "rtsp://camera/right")
    assert copy.paths and not copy.vehicles
    change(clip / "clip.yaml", right="/dev/video1")
    copy_documents(root, clip / "clip.yaml", clip / "again", vehicles=False)
    assert load_clip(clip / "again" / "road" / "clip.yaml").addresses[1] == "/dev/video1"


def test_only_known_settings_reach_a_live_run() -> None:
    given = {"learn": 12.5, "particles": 99, "seed": None, "motion": "line", "units": "km/h", "overlay": False}
    assert command_options(LIVE_RUN, given) == [
        "--particles",
        "99",
        "--motion",
        "line",
        "--units",
        "km/h",
        "--background-seconds",
        "12.5",
    ]
    assert command_options(LIVE_RUN, {"tolerance": 0.5}) == ["--max-half-width", "0.5"]
    assert command_options(LIVE_RUN, {"limit": " 30 mph "}) == ["--limit", "30 mph"]
    with pytest.raises(UnusableInput, match="limit: expected a speed with its unit"):
        command_options(LIVE_RUN, {"limit": "30"})
    for tolerance in (0, -1, "1", float("nan")):
        with pytest.raises(UnusableInput):
            command_options(LIVE_RUN, {"tolerance": tolerance})
    assert (
        command_options(FOLLOW_RUN, given) == ["--no-overlay"] and command_options(FOLLOW_RUN, {"overlay": True}) == []
    )
    for learn in (-1, 1e9, "30", True, float("nan")):
        with pytest.raises(UnusableInput):
            command_options(LIVE_RUN, {"learn": learn})


def test_settings_state_default_and_range_and_what_is_wrong() -> None:
    assert setting_hint("particles") == "default: 400; at least 20, at most 1 000 000"
    assert setting_hint("tolerance", "km/h") == "default: none; above 0 km/h"
    assert setting_hint("learn", "s") == "default: 30 s; at least 0, at most 3 600 s"
    assert limit_hint("mph") == "default: that of the files, if any; above 0, at most 336 mph"
    for name, right, wrong in (("particles", 400.0, 5), ("seed", 0, 1.5), ("tolerance", 0.1, 0), ("learn", 0, 3601)):
        assert setting_problem(name, right) is None and setting_problem(name, None) is None
        assert (setting_problem(name, wrong) or "").startswith("expected")
    assert [limit_problem(text) for text in ("30 mph", " ", None)] == [None] * 3
    assert (limit_problem("30") or "").startswith("expected a speed with its unit")


def test_a_tolerance_is_converted_between_units() -> None:
    assert convert_tolerance(5.0, "mph", "km/h") == 8.05 and convert_tolerance(8.05, "km/h", "mph") == 5.0
    assert convert_tolerance(1.0, "m/s", "km/h") == 3.6


def test_results_of_a_killed_console_can_be_read(tmp_path: Path) -> None:
    """Its tables grow vehicle by vehicle, so that their being there does not say that the run had ended."""
    root = tmp_path.resolve()
    put_clip(root)
    out = root / "road" / "runs" / "0001" / "out"
    out.mkdir(parents=True)
    record = {"clip": "road", "number": 1, "kind": "live", "options": [], "state": "running", "created": 1.0}
    (out.parent / "run.json").write_text(json.dumps(record))
    (out / "summary.json").write_text('{"vehicles": [{"vehicle": "v0", "speed_mps": 20.0}], "notices": []}')
    header = "vehicle,time_s,speed_mps,speed_std_mps,refined_speed_mps,refined_std_mps\n"
    rows = [f"v{k // 10},{k},20,1,21,0.5\n" for k in range(100_000)]
    (out / "estimates.csv").write_text(header + "".join(rows) + "v10000,7,2")  # the last row is on its way
    library = Library(root)
    run = library.runs.get("road", 1)
    assert run is not None and run.state == "interrupted" and library.entry("road").state == "interrupted"
    assert read_summary(out)["vehicles"][0]["speed_mps"] == 20.0
    series = read_series(out, growing=True)
    assert series[-1].vehicle == "v9999" and series[-1].time == list(range(99_990, 100_000))
    assert len(series) == MAX_LIVE_SERIES and all(s.value == [21.0] * 10 for s in series)
    library.runs.close()


@pytest.mark.parametrize(
    ("summary", "why"),
    [
        ({"vehicles": [{"vehicle": "v0", "reason": ""}, {"vehicle": "v1", "reason": "too few"}]}, "v1: too few"),
        ({"vehicles": [], "notices": ["no vehicle was found: fog"]}, "no vehicle was found: fog"),
        ({"reasons": {"too few of its features are found": 9}}, "too few of its features are found"),
        ({"vehicles": [], "notices": []}, "no vehicle passed that could be measured"),
        ({"vehicles": [], "unmeasured": [{"reason": "fog"}], "notices": ["note"]}, "not measured: fog"),
        ([], ""),
    ],
)
def test_the_reason_why_nothing_was_measured_is_one_line(tmp_path: Path, summary: object, why: str) -> None:
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    assert nothing_measured_reason(tmp_path.resolve()) == why


def test_a_vehicle_is_followed_live_until_it_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Through a named pipe below the folder, which only the run opens."""
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    root = tmp_path.resolve() / "clips"
    file = tiny_chase.write(root / "drive", 2)
    change(file, video="pipe", rate=None)
    os.mkfifo(root / "drive" / "pipe")
    library = Library(root)
    run = library.runs.start("drive", FOLLOW_RUN, ["--no-overlay"])
    ended = threading.Event()

    def play() -> None:
        # opened by Python, not by PyAV, which would keep all other threads waiting until the pipe is read
        pipe = root / "drive" / "pipe"
        with suppress(OSError, av.FFmpegError), pipe.open("wb") as file, av.open(file, "w", format="nut") as container:
            stream = container.add_stream("ffv1", rate=15)
            stream.width, stream.height, stream.pix_fmt = *tiny_chase.SIZE, "gray"
            for k in range(10_000):
                picture = av.VideoFrame.from_ndarray(tiny_chase.picture(k), format="gray")
                picture.pts, picture.time_base = k, Fraction(1, 15)
                container.mux(stream.encode(picture))
                if ended.wait(1 / 15):
                    return

    player = threading.Thread(target=play)
    player.start()
    wait(lambda: library.runs.live_data(run)[1].get("frame", 0) >= 5)
    (series,), scene = library.runs.live_data(run)
    jpeg = np.frombuffer(library.runs.picture(run, scene["frame"], 0), np.uint8)
    assert cv2.imdecode(jpeg, cv2.IMREAD_UNCHANGED).shape == tiny_chase.SIZE[::-1] == tuple(scene["size"][::-1])
    assert [v["vehicle"] for v in scene["vehicles"]] == ["small van"] and scene["vehicles"][0]["outlines"][0]
    assert series.vehicle == "small van" and not library.runs.is_stopping(run)
    for time_s, value in zip(series.time, series.value, strict=True):
        assert value == pytest.approx(tiny_chase.truth(round(15 * time_s))[2], abs=0.35)
    library.runs.stop("drive", run.number)
    wait(lambda: (now := library.runs.get("drive", run.number)) is not None and not now.active)
    ended.set()
    player.join()
    now = library.runs.get("drive", run.number)
    assert now is not None and now.state == "measured", now
    assert {"report.html", "track.csv"} <= set(result_files(library.runs.output_folder(now)))
    library.runs.close()


# --- pictures ---------------------------------------------------------------------------------------------------------


def test_pictures_lines_are_parsed_as_formatted() -> None:
    """Even those that are all noise, which JPEG cannot make small."""
    noise = np.random.default_rng(1).integers(0, 2, (2, 1200, 1600)).astype(np.uint8) * 255
    small = small_jpegs(*noise)
    line = format_pictures(7, 1.25, (1600, 1200), small) + "\n"
    assert len(line) < MAX_LINE_LENGTH and parse_progress(line) is None and parse_estimate(line) is None
    found = parse_pictures(line)
    assert found == {"frame": 7, "time_s": 1.25, "size": [1600, 1200], "pictures": small}
    assert cv2.imdecode(np.frombuffer(small[1], np.uint8), cv2.IMREAD_UNCHANGED).shape == (360, 480)
    (tiny,) = small_jpegs(noise[0, :48, :64])
    assert cv2.imdecode(np.frombuffer(tiny, np.uint8), cv2.IMREAD_UNCHANGED).shape == (48, 64)


@pytest.mark.parametrize(
    "rest", ["", "[]", "{}", '{"frame":1,"time_s":2,"size":[1],"pictures":[]}', '{"frame":1,"time_s":0,"size":[4,4],'
             '"pictures":["no base64!"]}'],
)  # fmt: skip
def test_other_lines_are_no_pictures(rest: str) -> None:
    assert parse_pictures(f"pictures: {rest}") is None


def test_the_latest_pictures_are_kept_with_what_is_in_them() -> None:
    progress = RunProgress()
    for frame in range(100):
        told_of = {"frame": frame, "time_s": frame / 2, "value": 9.0, "std": None}
        if frame % 2:
            progress.add_estimate({"vehicle": "lane0", **told_of})
        progress.add_pictures(
            {"frame": frame, "time_s": frame / 2, "size": [64, 48], "pictures": [bytes([frame]), b"right"]}
        )
        assert progress.last_frame["frame"] == frame and len(progress.last_frame["vehicles"]) == frame % 2
    assert list(progress.pictures) == list(range(100 - KEPT_FRAMES, 100)) and progress.pictures[99][0] == bytes([99])


@pytest.mark.slow
def test_a_live_run_is_monitored_and_has_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    root = tmp_path.resolve() / "clips"
    survey_file(root / "road")
    library = Library(root)
    run = library.runs.start("road", LIVE_RUN, ["--background-seconds", "4"])
    frames, doing = set(), set()
    end = time.monotonic() + 180
    while (now := library.runs.get("road", 1)) is not None and now.active:
        assert time.monotonic() < end
        doing.add(now.doing)
        _, scene = library.runs.live_data(now)
        if scene and scene["frame"] not in frames:
            frames.add(scene["frame"])
            jpeg = np.frombuffer(library.runs.picture(now, scene["frame"], 1), np.uint8)
            assert scene["size"] == [640, 480] and cv2.imdecode(jpeg, cv2.IMREAD_UNCHANGED).shape == (360, 480)
        time.sleep(0.02)
    assert now is not None and now.state == "measured", now
    assert doing >= {"learning", "measuring"} and len(frames) >= 8
    assert "report.html" in result_files(library.runs.output_folder(now))
    with pytest.raises(NotFound):
        library.runs.picture(now, max(frames), 0)  # nothing is kept of it in memory
    vehicle = read_summary(library.runs.output_folder(now))["vehicles"][0]["vehicle"]
    library.runs.close()
    with open_client(root) as client:
        address = result_address("road", run.number, picture_name(vehicle))
        assert client.get(address, headers=SAME).headers["content-type"] == "image/jpeg"
        for name in ("..%2Fsummary", "v99", ".v0", "x" * 999):
            assert client.get(address.replace(vehicle, name), headers=SAME).status_code == 404


@pytest.mark.slow
def test_a_killed_live_run_does_not_block_the_console(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its measuring is a process of its own, and has the same standard error."""
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    root = tmp_path.resolve() / "clips"
    survey_file(root / "road")
    library = Library(root)
    run = library.runs.start("road", LIVE_RUN, ["--background-seconds", "4"])
    out = library.runs.output_folder(run)
    until(lambda: (out / "summary.json").is_file() and bool(read_summary(out)["vehicles"]))
    process = library.runs._process
    assert process is not None
    os.kill(process[1].pid, signal.SIGKILL)
    until(lambda: not library.runs.active())
    found = library.runs.get("road", run.number)
    assert found is not None and found.state == "interrupted" and "killed (signal 9)" in found.reason
    assert read_summary(out)["vehicles"]
    library.runs.close()


def until(is_so: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.05)
