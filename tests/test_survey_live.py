"""Live surveys: two recordings played as streams, and how views are paired and dropped."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from run_command import assert_one_line_error, paceline
from selection import slow_after
from tiny_road import TWO, scene

from paceline.cameras import Camera
from paceline.detection.finder import DetectedVehicle
from paceline.detection.tracks import DetectionTrack
from paceline.documents.loading import load_clip
from paceline.recordings import live_stereo
from paceline.recordings.live_stereo import LiveCamera, RawPair, _pairs
from paceline.recordings.monocular import CameraFrame, CameraRecording
from paceline.simulation.camera_errors import StereoErrors
from paceline.simulation.stereo.clip import RenderedClip, Scene, Vehicle, World, render, write
from paceline.simulation.stereo.scenery import StaticBackground
from paceline.speed.configuration import BackgroundSettings, SpeedConfiguration
from paceline.speed.results import Measurement
from paceline.survey.live import last_outline, survey

pytestmark = pytest.mark.usefixtures("unrendered_plots")

SIZE = (64, 48)
RATE, PLAYED = 5.0, 2.0  # frames/s, as rendered and as played: slow enough for any machine to keep up
SPEEDS = [speed * PLAYED / RATE for speed in (13.0, 16.0, 19.0)]  # m/s
CONFIGURATION = SpeedConfiguration(background=BackgroundSettings(seconds=4.0))
LATER = (Vehicle("v0", 19.0, start_distance=68.0, lane=-1.85, texture_seed=12, relief=0.03),)


# --- two views -------------------------------------------------------------------------------------------------------


class Source:
    """A view whose frames come at ``times``, s of the computer's clock, dated by a clock that is ``ahead``."""

    name, notices = "camera", []  # noqa: RUF012

    def __init__(self, times: list[float], ahead: float = 0.0, value: int = 0) -> None:
        self.times, self.ahead, self.value = times, ahead, value

    def read(self, start: int) -> Iterator[CameraFrame]:
        begun = time.monotonic()
        for index, moment in enumerate(self.times):
            time.sleep(max(0.0, begun + moment - time.monotonic()))
            yield CameraFrame(index, moment + self.ahead, np.full(SIZE[::-1], self.value + index % 50, np.uint8))

    def label(self, frame: int) -> str:
        return f"frame {frame}"

    def stop(self) -> None:
        pass


def view(source: Source, total: int | None = None) -> LiveCamera:
    camera = Camera(SIZE, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]))
    return LiveCamera(CameraRecording(camera, source, total))


def begun(*views: LiveCamera) -> None:
    for v in views:
        v.begin(time.monotonic())


def test_frames_that_belong_together_are_paired_and_others_left_out() -> None:
    every = [0.05 * k for k in range(12)]
    left, right = view(Source(every)), view(Source([t + 0.004 for k, t in enumerate(every) if k not in (4, 5)]))
    begun(left, right)
    pairs = list(_pairs(left, right, 0.0))
    assert [p.index for p in pairs] == [k for k in range(12) if k not in (4, 5)]
    assert [p.right[0, 0] for p in pairs] == [*range(10)]


def test_cameras_with_clocks_of_their_own_are_paired_by_their_arrival() -> None:
    times = [0.05 * k for k in range(30)]
    left, right = view(Source(times)), view(Source(times, ahead=1234.5))
    begun(left, right)
    late = [v.delay_s() for v in (left, right)]
    assert late[0] - late[1] == pytest.approx(1234.5, abs=0.02)
    pairs = list(_pairs(left, right, late[0] - late[1]))
    assert len(pairs) >= 12 and all(p.left[0, 0] == p.right[0, 0] == p.index for p in pairs)
    assert all(p.skew == 0.0 for p in pairs)


def test_a_pause_loses_nothing() -> None:
    """As when the empty road is made of what was learned."""
    times = [0.02 * k for k in range(40)]
    left, right = view(Source(times)), view(Source(times))
    begun(left, right)
    indices = []
    for pair in _pairs(left, right, 0.0):
        if not indices:
            time.sleep(0.6)
        indices.append(pair.index)
    assert indices == [*range(40)] and left.dropped == 0


def test_once_stopped_nothing_that_waits_is_handed_out() -> None:
    times = [0.01 * k for k in range(40)]
    left, right = view(Source(times)), view(Source(times))
    begun(left, right)
    indices = []
    for pair in _pairs(left, right, 0.0):
        indices.append(pair.index)
        if pair.index == 1:
            time.sleep(0.2)  # many are waiting
            left.stop()
            right.stop()
    assert indices == [0, 1]


def test_what_is_not_used_in_time_is_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_stereo, "MAX_QUEUED_FRAMES", held := 3)
    times = [0.01 * k for k in range(40)]
    left, right = view(Source(times)), view(Source(times))
    begun(left, right)
    taken = 0
    for _ in _pairs(left, right, 0.0):
        taken += 1
        time.sleep(0.05)
    assert left.dropped >= 20 and taken + left.dropped <= 40
    assert taken + left.dropped >= 40 - held - 5  # the rest lost its partner


# --- a survey --------------------------------------------------------------------------------------------------------


def road(of: Scene, frames: int, seed: int) -> dict[str, list[NDArray[np.uint8]]]:
    """The same road without vehicles."""
    world, rng = World(of), np.random.default_rng(seed)
    stills = [StaticBackground(world.scene, world.road, world.scene.seed).draw(v) for v in world.views]
    return {
        side: [np.clip(still + rng.normal(0, 0.8, still.shape), 0, 255).astype(np.uint8) for _ in range(frames)]
        for side, still in zip(("left", "right"), stills, strict=True)
    }


@cache
def traffic(right_late: float = 0.0) -> RenderedClip:
    """An empty road, two vehicles, an empty road, one vehicle, an empty road; the right view so many s late."""
    first, second = (render(scene(*v, errors=StereoErrors(offset=right_late))) for v in (TWO, LATER))
    gaps = [road(scene(*TWO), frames, seed) for seed, frames in enumerate((10, 4, 4))]
    pictures = {
        side: [*gaps[0][side], *getattr(first, side), *gaps[1][side], *getattr(second, side), *gaps[2][side]]
        for side in ("left", "right")
    }
    times = np.arange(len(pictures["left"])) / PLAYED
    return replace(first, **pictures, times=times, right_times=times)


def survey_file(folder: Path, **keys: Any) -> Path:
    file = write(traffic(), folder)
    document = {**yaml.safe_load(file.read_text(encoding="utf-8")), "rate": PLAYED, **keys}
    for key in ("vehicles", "times"):
        document.pop(key, None)
    file.write_text(yaml.safe_dump(document), encoding="utf-8")
    return file


@dataclass
class Given:
    """Views that give these frames of the traffic, as fast as they are taken."""

    frames: list[int]
    right_late: float = 0.0  # s, as rendered
    interval: float = 1 / PLAYED

    def __iter__(self) -> Iterator[RawPair]:
        clip = traffic(self.right_late)
        for k in self.frames:
            yield RawPair(k, float(clip.times[k]), clip.left[k], clip.right[k], 0.0)


ALL = list(range(len(traffic().times)))
GAPS = [k for k in ALL if k not in (9, 10, 12, 13, 18, 21, 22, 23, 28, 34)]  # as a busy computer left them out


def surveyed(
    folder: Path,
    frames: list[int],
    on_frame: Callable[[RawPair, list[DetectionTrack]], None] = lambda pair, tracks: None,
) -> list[tuple[DetectedVehicle, Measurement]]:
    passed: list[tuple[DetectedVehicle, Measurement]] = []

    def on_result(found: DetectedVehicle, measurement: Measurement | None, reason: str) -> None:
        assert measurement is not None, reason
        passed.append((found, measurement))

    views: Any = Given(frames)
    survey(load_clip(survey_file(folder)), views, CONFIGURATION, on_result, on_frame=on_frame)
    return passed


@pytest.mark.parametrize("frames", slow_after(0, [(ALL,), (GAPS,)]), ids=["all frames", "frames missing"])
def test_every_vehicle_is_measured_once(tmp_path: Path, frames: list[int]) -> None:
    passed = surveyed(tmp_path / "clip", frames)
    assert [found.vehicle.id for found, _ in passed if found.vehicle] == ["v0", "v1", "v2"]
    assert [m.verdict for _, m in passed] == ["measured"] * 3
    speeds = [m.speed for _, m in passed]
    assert sorted(speeds[:2]) == pytest.approx(SPEEDS[:2], abs=0.1) and speeds[2] == pytest.approx(SPEEDS[2], abs=0.1)
    for found, m in passed:
        error = min(abs(speed - m.speed) for speed in SPEEDS)
        assert error < 2 * (m.speed_hi - m.speed)  # of three vehicles one may lie beyond its 95 %
        assert 4.0 <= found.times[0] < found.times[1] <= found.times[0] + 5.0  # never two vehicles as one


@pytest.mark.slow
def test_late_views_of_which_nothing_is_stated_are_told_by_the_vehicles(tmp_path: Path) -> None:
    """The right one is 20 ms late as rendered. One vehicle alone hardly tells it, three do."""
    file, passed = survey_file(tmp_path / "clip"), list[Measurement]()
    document = yaml.safe_load(file.read_text(encoding="utf-8"))
    document.pop("synchronised")
    file.write_text(yaml.safe_dump(document), encoding="utf-8")

    def on_result(found: DetectedVehicle, measurement: Measurement | None, reason: str) -> None:
        assert measurement is not None, reason
        passed.append(measurement)

    views: Any = Given(ALL, 0.02)
    survey(load_clip(file), views, CONFIGURATION, on_result)
    assert [(m.verdict, m.calibrated_by) for m in passed] == [("measured", k) for k in (1, 2, 3)]
    for m in passed:
        assert min(abs(speed - m.speed) for speed in SPEEDS) < m.speed_hi - m.speed
    assert passed[2].speed_hi - passed[2].speed < 0.2


@pytest.mark.slow
def test_vehicles_are_calibrated_jointly(tmp_path: Path) -> None:
    """The first is measured alone, and each further one with the information on the rig from those before it."""
    stated = {"uncertainty": {"focal_length_px": 1.0, "rotation_rad": [4e-5] * 3, "translation_m": [3e-4] * 3}}
    rig = survey_file(tmp_path / "clip").parent / "rig.yaml"
    rig.write_text(yaml.safe_dump({**yaml.safe_load(rig.read_text()), **stated}))
    passed: list[Measurement] = []

    def on_result(found: DetectedVehicle, measurement: Measurement | None, reason: str) -> None:
        assert measurement is not None, reason
        passed.append(measurement)

    views: Any = Given(ALL)
    clip = load_clip(rig.parent / "clip.yaml")
    survey(clip, views, CONFIGURATION, on_result)
    assert [m.calibrated_by for m in passed] == [1, 2, 3]
    assert [m.verdict for m in passed] == ["measured"] * 3
    halves = [(m.speed_hi - m.speed_lo) / 2 for m in passed]
    for m, half in zip(passed, halves, strict=True):
        error = min(abs(speed - m.speed) for speed in SPEEDS)
        assert error < 4 * half and 0 < m.systematic_std < 0.1
    passed.clear()
    strict = CONFIGURATION.model_copy(update={"tolerance": float(np.median(halves))})
    survey(clip, views, strict, on_result)
    assert [m.verdict for m in passed] == ["measured" if half <= np.median(halves) else "rejected" for half in halves]


def covered(box: NDArray[np.float64], plane: NDArray[np.float64]) -> float:
    """The share of a quadrilateral's bounding box that lies in that of another, unless that is four times as large."""
    shared = np.prod(np.maximum(np.minimum(box.max(0), plane.max(0)) - np.maximum(box.min(0), plane.min(0)), 0))
    area = np.prod(np.ptp(plane, axis=0))
    return float(shared / area) if np.prod(np.ptp(box, axis=0)) < 4 * area else 0.0


@pytest.mark.slow
def test_last_outline_covers_the_vehicle(tmp_path: Path) -> None:
    """The whole face, of which the rendered plane is the lower part."""
    truth: dict[int, list[list[NDArray[np.float64]]]] = {}
    for first, vehicles in ((10, TWO), (23, LATER)):
        for row in World(scene(*vehicles)).truth:
            truth.setdefault(first + row["frame"], []).append([np.array(row[side]) for side in ("left", "right")])
    seen: list[int] = []
    alike: list[float] = []

    def on_frame(pair: RawPair, tracks: list[DetectionTrack]) -> None:
        seen.append(pair.index)
        for track in tracks:
            boxes = last_outline(track)
            alike.append(max(min(map(covered, boxes, planes)) for planes in truth[pair.index]))

    surveyed(tmp_path / "clip", ALL, on_frame)
    assert seen == ALL and len(alike) >= 16  # of 27 frames in which a vehicle is there, two to see that it moves
    assert min(alike) > 0.8, sorted(alike)


def test_tables_hold_every_vehicle_that_passed(tmp_path: Path) -> None:
    """The streams play in real time: on a busy computer frames are left out, and what suffers is rejected by name."""
    file, out, begun = survey_file(tmp_path / "clip", limit="1 m/s"), tmp_path / "out", datetime.now().astimezone()
    done = paceline("speed", file, "-o", out, "--live", "--background-seconds", "4")
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    vehicles = summary["vehicles"]
    dropped = any("dropped" in notice for notice in summary["notices"])
    assert dropped or [v["verdict"] for v in vehicles] == ["measured"] * 3
    assert [v["vehicle"] for v in vehicles] == [f"v{k}" for k in range(len(vehicles))]
    for v in vehicles:
        assert v["seen_to_s"] > v["seen_from_s"] >= 4.0
        assert v["reason"] or min(abs(speed - v["speed_mps"]) for speed in SPEEDS) < 0.2
        assert v["compliance"] == (None if v["reason"] else "over") and v["direction"] in ("with", "against")
    with (out / "estimates.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {r["vehicle"] for r in rows} == {v["vehicle"] for v in vehicles}
    assert all(v["path"] in ("lane0", "lane1") and 20 < v["first_seen_m"][1] < 90 for v in vehicles)
    page = (out / "report.html").read_text(encoding="utf-8")
    for v in vehicles:
        height, width = cv2.imread(str(out / "pictures" / f"{v['vehicle']}.jpg")).shape[:2]
        assert (height, width > height) == (240, True) and f"{v['vehicle']} in both views" in page
        at = datetime.fromisoformat(v["seen_at"])
        assert begun < at < datetime.now().astimezone() and at.strftime("%H:%M:%S") in page
    measured = sum(v["verdict"] == "measured" for v in vehicles)
    assert f"{measured} of {len(vehicles)} vehicles measured" in " ".join(page.split())
    assert sum(line.rstrip().endswith("measured") for line in done.stdout.splitlines()) >= measured > 0


@pytest.mark.slow
def test_what_was_measured_stays_when_it_is_ended(tmp_path: Path) -> None:
    """Ctrl-C, which reaches every process at a terminal, ends a survey; what has passed by then is in the tables."""
    file, out = survey_file(tmp_path / "clip"), tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "paceline",
        "speed",
        str(file),
        "-o",
        str(out),
        "--live",
        "--background-seconds",
        "4",
    ]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, start_new_session=True, **pipes) as running:  # type: ignore[call-overload]
        assert running.stdout is not None
        for line in running.stdout:
            if line.rstrip().endswith("measured"):
                os.killpg(running.pid, signal.SIGINT)
                break
        rest, errors = running.communicate(timeout=120)
    assert running.returncode == 0, errors
    assert "Traceback" not in errors
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["vehicles"] and all(v["verdict"] == "measured" for v in summary["vehicles"])
    assert f"{len(summary['vehicles'])} of {len(summary['vehicles'])} vehicles measured" in rest
    assert "v0 in both views" in (out / "report.html").read_text(encoding="utf-8")


MEASURES = """
import os, time
from paceline.survey.live import worker_process
if __name__ == "__main__":
    with worker_process() as measuring:
        print(measuring.submit(os.getpid).result(), flush=True)
        time.sleep(600)
"""


def test_a_killed_survey_leaves_no_measuring_process(tmp_path: Path) -> None:
    (tmp_path / "measures.py").write_text(MEASURES, encoding="utf-8")
    command = [sys.executable, str(tmp_path / "measures.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        assert int(running.stdout.readline()) != running.pid
        running.kill()
        running.communicate(timeout=60)  # which waits until nobody has the pipe open any more


@pytest.mark.parametrize(
    ("arguments", "keys", "words"),
    [
        (["--live", "--method", "sift"], {}, ["--live", "--method"]),
        (["--background-seconds", "3"], {}, ["--background-seconds", "--live"]),
        (["--live", "--quiet", "--background-seconds", "60"], {}, ["clip.yaml", "ended within the 60 s"]),
        (["--live"], {"left": "nowhere.mp4"}, ["nowhere.mp4"]),
        (["--live", "--quiet"], {"right": "left"}, ["left and right", "same picture"]),
        (["--live"], {"right": "rtsp://127.0.0.1:9/none"}, ["rtsp://127.0.0.1:9/none", "cannot be opened"]),
        (["--live"], {"rate": None}, ["clip.yaml", "rate"]),
    ],
)
def test_bad_input_is_one_plain_line(
    tmp_path: Path, arguments: list[str], keys: dict[str, Any], words: list[str]
) -> None:
    short = replace(traffic(), **{s: getattr(traffic(), s)[:6] for s in ("left", "right", "times", "right_times")})
    file = write(short, tmp_path / "clip")
    document = {**yaml.safe_load(file.read_text(encoding="utf-8")), "rate": PLAYED, **keys}
    file.write_text(
        yaml.safe_dump({k: v for k, v in document.items() if k not in ("vehicles", "times")}), encoding="utf-8"
    )
    done = paceline("speed", file, "-o", tmp_path / "out", *arguments)
    assert_one_line_error(done, *words)
    assert not (tmp_path / "out").exists()


def test_tables_of_another_survey_are_not_written_over(tmp_path: Path) -> None:
    file, out = survey_file(tmp_path / "clip"), tmp_path / "out"
    out.mkdir()
    (out / "estimates.csv").write_text("mine\n")
    done = paceline("speed", file, "-o", out, "--live")
    assert_one_line_error(done, "estimates.csv", "is there already")
    assert (out / "estimates.csv").read_text() == "mine\n"
