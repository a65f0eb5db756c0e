"""Whole measurements: every output of the command, every kind of recording, and the Python API."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from selection import slow_after

import paceline
from paceline import cli
from paceline.imaging.recorded_cameras import estimate_cameras
from paceline.simulation.random_scenes.drawn import random_crossing
from paceline.simulation.stereo.clip import Scene, Vehicle, render, write
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.batch import TrackerBatch
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.run import VehicleMeasurement

Array = NDArray[np.float64]
Images = list[NDArray[Any]]

COLUMNS = (
    "vehicle,frame,time_s,speed_mps,speed_std_mps,x_m,y_m,z_m,yaw_rate_radps,"
    "left_x1,left_y1,left_x2,left_y2,left_x3,left_y3,left_x4,left_y4,"
    "right_x1,right_y1,right_x2,right_y2,right_x3,right_y3,right_x4,right_y4,"
    "ess,status,refined_speed_mps,refined_std_mps"
)
SPEED = 17.0  # m/s


@dataclass(frozen=True)
class Answer:
    status: int
    stdout: str
    stderr: str
    out: Path

    @property
    def vehicles(self) -> dict[str, dict[str, Any]]:
        summary = json.loads((self.out / "summary.json").read_text())
        return {v["vehicle"]: v for v in summary["vehicles"]}

    @property
    def configuration(self) -> dict[str, Any]:
        return dict(json.loads((self.out / "summary.json").read_text())["configuration"])

    @property
    def rows(self) -> list[dict[str, str]]:
        with (self.out / "estimates.csv").open(newline="") as stream:
            return list(csv.DictReader(stream))


Command = Callable[..., Answer]


@pytest.fixture
def command(whole_command: Command, unrendered_plots: None) -> Command:
    """`paceline speed CLIP -o OUT OPTIONS`, in this process, without plots."""
    return whole_command


@pytest.fixture
def whole_command(
    signals_as_before: None, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> Command:
    """The same with plots."""

    def run(clip: Path, *options: str, out: Path = tmp_path / "out") -> Answer:
        monkeypatch.setattr(sys, "argv", ["paceline", "speed", str(clip), "-o", str(out), *options])
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit:
            cli.main()
        return Answer(int(exit.value.code or 0), *capfd.readouterr(), out)

    return run


def scene(**more: Any) -> Scene:
    vehicle = Vehicle("v0", SPEED, start_distance=58.0, texture_seed=21)
    small: dict[str, Any] = {"image_size": (640, 480), "focal": 1400.0, "frames": 10}
    return replace(Scene(21, (vehicle,), **small), **more)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(render(scene()), tmp_path_factory.mktemp("clip"))


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Path]:
    """A vehicle that shows its side, without a path."""
    s = random_crossing(4, vehicle={"acceleration": 0.0}, image_size=(640, 480), focal=700.0, occluder=False)
    return s, write(render(s), tmp_path_factory.mktemp("crossing"))


def variant(clip: Path, folder: Path, images: Callable[[str], Images] | None = None, **keys: Any) -> Path:
    """The same clip in another ``folder``, with its pictures turned into others or given by other ``keys``."""
    folder.mkdir(exist_ok=True)
    document = yaml.safe_load(clip.read_text())
    for side in ("left", "right"):
        document[side] = str(clip.parent / side)
        if images is not None:
            document[side] = side
            (folder / side).mkdir()
            for k, image in enumerate(images(side)):
                cv2.imwrite(str(folder / side / f"{k:03d}.png"), image)
    (folder / "rig.yaml").write_text((clip.parent / "rig.yaml").read_text())
    document = {key: value for key, value in (document | keys).items() if value is not None}
    (folder / "clip.yaml").write_text(yaml.safe_dump(document))
    return folder / "clip.yaml"


def pictures(clip: Path, side: str) -> Images:
    files = sorted((clip.parent / side).iterdir())
    return [np.asarray(cv2.imread(str(f), cv2.IMREAD_UNCHANGED)) for f in files]


def assert_right(answer: Answer, vehicle: str = "v0", speed: float = SPEED, slack: float = 0.03) -> None:
    """Measured, the interval no further than ``slack`` m/s from the truth."""
    assert answer.status == 0, answer.stderr or answer.stdout
    v = answer.vehicles[vehicle]
    assert (v["verdict"], v["reason"]) == ("measured", "")
    assert v["speed_lo_mps"] - slack <= speed <= v["speed_hi_mps"] + slack, v
    assert v["speed_hi_mps"] - v["speed_lo_mps"] < 0.05 * speed


# --- the outputs ---------------------------------------------------------------------------------------------------


def test_two_vehicles_and_everything_that_comes_out(whole_command: Command, tmp_path: Path) -> None:
    fast = Vehicle("fast", 20.0, start_distance=75.0, lane=-3.4, texture_seed=1)
    slow = Vehicle("away", 12.0, start_distance=24.0, lane=3.4, receding=True, texture_seed=2)
    rendered = render(scene(vehicles=(fast, slow), frames=11))
    rendered.clip["vehicles"][1] |= {
        "frame": 3,
        **{
            side: next(r[side] for r in rendered.truth if r["vehicle"] == "away" and r["frame"] == 3)
            for side in ("left", "right")
        },
    }
    answer = whole_command(write(rendered, tmp_path / "clip"), "--units", "km/h")
    assert_right(answer, "fast", 20.0)
    assert_right(answer, "away", 12.0)

    text = (answer.out / "estimates.csv").read_text()
    assert text.splitlines()[0].startswith(COLUMNS)
    rows = answer.rows
    assert [(r["vehicle"], int(r["frame"])) for r in rows] == [
        *(("fast", k) for k in range(11)), *(("away", k) for k in range(3, 11))
    ]  # fmt: skip
    for row in rows:
        numbers = {k: float(v) for k, v in row.items() if v and k not in ("vehicle", "status")}
        first = row["frame"] == {"fast": "0", "away": "3"}[row["vehicle"]]
        empty = set(row) - set(numbers) - {"vehicle", "status"}
        assert empty <= ({"speed_mps", "speed_std_mps", "yaw_rate_radps"} if first else set())
        assert row["status"] == "tracking" and numbers["time_s"] == pytest.approx(numbers["frame"] / 5)
        assert numbers["refined_speed_mps"] == pytest.approx(answer.vehicles[row["vehicle"]]["speed_mps"], abs=0.5)
        assert 0 < numbers["refined_std_mps"] < 1 and 1 <= numbers["ess"] <= 400.001
        place = next(r for r in rendered.truth if (r["vehicle"], r["frame"]) == (row["vehicle"], numbers["frame"]))
        np.testing.assert_allclose([numbers[f"left_{a}3"] for a in "xy"], place["left"][2], atol=4)
        np.testing.assert_allclose([numbers[f"right_{a}1"] for a in "xy"], place["right"][0], atol=4)
        assert numbers["z_m"] == pytest.approx(place["position"][2], rel=0.03)

    for v in answer.vehicles.values():
        assert v.keys() >= {"vehicle", "speed_mps", "speed_lo_mps", "speed_hi_mps", "frames", "verdict", "reason"}
        assert v["speed_lo_mps"] < v["speed_mps"] < v["speed_hi_mps"]
    assert (answer.vehicles["fast"]["frames"], answer.vehicles["away"]["frames"]) == (11, 8)
    summary = json.loads((answer.out / "summary.json").read_text())
    assert summary["configuration"]["particles"] == 400 and summary["versions"]["paceline"] == paceline.__version__

    page = (answer.out / "report.html").read_text()
    assert "fast" in page and "away" in page and "km/h" in page and 'src="http' not in page
    with av.open(answer.out / "overlay.mp4") as video:
        frames = [f.to_ndarray(format="gray") for f in video.decode(video=0)]
    assert len(frames) == 11 and np.ptp(frames[5]) > 100
    assert list((answer.out / "plots").glob("*.png"))
    assert "fast" in answer.stdout and "km/h" in answer.stdout
    for speed in (72.0, 43.2):
        assert any(f"{v:.1f}" in answer.stdout for v in np.arange(speed - 0.4, speed + 0.45, 0.1)), answer.stdout


@pytest.mark.slow
def test_same_seed_same_file(command: Command, clip: Path, tmp_path: Path) -> None:
    tables = [
        (command(clip, "--seed", seed, "--quiet", out=tmp_path / name).out / "estimates.csv").read_bytes()
        for name, seed in (("a", "7"), ("b", "7"), ("c", "8"))
    ]
    assert tables[0] == tables[1] != tables[2]


@pytest.mark.parametrize(
    ("options", "expected"),
    slow_after(1, [
        (["--motion", "free"], {"motion": "free"}),
        (["--feature-parts", "4"], {"parts": 4}),
        (["--feature-parts", "16"], {"parts": 16}),
        (["--particles", "100"], {"particles": 100}),
        (["--motion", "line"], {"motion": "line"}),
        (["--motion", "curve"], {"motion": "curve"}),
    ]),
)  # fmt: skip
def test_options(command: Command, clip: Path, options: list[str], expected: dict[str, object]) -> None:
    answer = command(clip, *options)
    assert_right(answer, slack=0.15)
    assert answer.configuration.items() >= expected.items()


def test_without_refinement(command: Command, clip: Path) -> None:
    answer = command(clip, "--no-refine")
    assert_right(answer, slack=0.3)
    assert {(r["refined_speed_mps"], r["refined_std_mps"]) for r in answer.rows} == {("", "")}
    assert answer.vehicles["v0"]["model"] == "filter"
    assert "not refined" in answer.stderr


@pytest.mark.parametrize(("unit", "shown"), slow_after(1, [("km/h", 61.2), ("mph", 38.0), ("m/s", 17.0)]))
def test_units_are_for_people_only(command: Command, clip: Path, unit: str, shown: float) -> None:
    answer = command(clip, "--units", unit)
    assert_right(answer)
    line = next(line for line in answer.stdout.splitlines() if line.startswith("v0"))
    assert float(line.split()[1]) == pytest.approx(shown, abs=0.2)
    assert answer.vehicles["v0"]["speed_mps"] == pytest.approx(SPEED, abs=0.1)
    assert f"speed, {unit}" in answer.stdout and unit in (answer.out / "report.html").read_text()


@pytest.mark.slow
def test_a_tolerance_is_in_the_unit_that_people_are_shown(command: Command, clip: Path) -> None:
    v = command(clip).vehicles["v0"]
    half = (v["speed_hi_mps"] - v["speed_lo_mps"]) / 2
    in_kmh = 3.6 * half
    for factor, verdict in ((1.1, "measured"), (0.5, "rejected")):
        answer = command(clip, "--units", "km/h", "--max-half-width", f"{factor * in_kmh:.6f}")
        assert answer.configuration["tolerance"] == pytest.approx(factor * half, rel=1e-3)
        (found,) = answer.vehicles.values()
        assert found["verdict"] == verdict and found["speed_mps"] == v["speed_mps"]
        assert answer.status == int(verdict == "rejected")
    assert found["reason_code"] == "tolerance_exceeded"
    assert found["reason"].startswith("interval too wide: ") and "2.00 times the tolerance" in found["reason"]


def test_only_rejections_end_with_status_1_and_a_reason(command: Command, clip: Path, tmp_path: Path) -> None:
    """A picture in which nothing moves: what is outlined never appears again."""

    def emptied(side: str) -> Images:
        first, *rest = pictures(clip, side)
        rng = np.random.default_rng(3)
        wall = rng.integers(10, 240, first.shape, np.uint8)
        return [first, *(wall + rng.integers(0, 9, first.shape, np.uint8) for _ in rest)]

    answer = command(variant(clip, tmp_path / "wall", emptied))
    assert answer.status == 1
    v = answer.vehicles["v0"]
    assert v["verdict"] == "rejected" and v["reason"]
    assert v["reason"] in answer.stdout and v["reason"] in (answer.out / "report.html").read_text()
    assert [r["status"] for r in answer.rows] == ["tracking"] + ["lost"] * (len(answer.rows) - 1)
    with av.open(answer.out / "overlay.mp4") as video:
        assert len(list(video.decode(video=0))) >= 5


@pytest.mark.parametrize(("off", "verdict"), [(1.0, "measured"), (4.0, "rejected")])
def test_a_track_that_contradicts_the_outlines_is_not_measured(
    command: Command, clip: Path, tmp_path: Path, off: float, verdict: str
) -> None:
    """The right one lies so many pixels beside what the left one marks, as it does where something else is outlined."""
    (vehicle,) = yaml.safe_load(clip.read_text())["vehicles"]
    vehicle["right"] = [[x + off, y] for x, y in vehicle["right"]]
    v = command(variant(clip, tmp_path / "off", vehicles=[vehicle])).vehicles["v0"]
    assert v["verdict"] == verdict and v["reason"].startswith("outline: " if off > 2 else "")


def test_a_vehicle_that_leaves_ends_and_is_measured(command: Command, tmp_path: Path) -> None:
    leaving = Vehicle("v0", SPEED, start_distance=45.0, texture_seed=4)
    answer = command(write(render(scene(vehicles=(leaving,), frames=14)), tmp_path / "clip"))
    assert_right(answer)
    assert answer.rows[-1]["status"] == "ended" and len(answer.rows) < 14
    assert answer.vehicles["v0"]["frames"] == len(answer.rows) - 1


# --- what is outlined ----------------------------------------------------------------------------------------------


def test_a_crossing_vehicle_without_a_path(command: Command, crossing: tuple[Scene, Path]) -> None:
    s, clip = crossing
    assert_right(command(clip), speed=s.vehicles[0].speed, slack=0.1)


@pytest.mark.parametrize("receding", slow_after(0, [True, False]))
def test_an_approaching_or_receding_vehicle_without_a_path(command: Command, tmp_path: Path, receding: bool) -> None:
    vehicle = Vehicle("v0", SPEED, start_distance=24.0 if receding else 56.0, receding=receding, texture_seed=6)
    clip = write(render(scene(vehicles=(vehicle,), draw_path=False)), tmp_path / "clip")
    assert "path" not in yaml.safe_load(clip.read_text())["vehicles"][0]
    assert_right(command(clip), slack=0.1)


def test_a_path_given_in_metres(command: Command, clip: Path, tmp_path: Path) -> None:
    truth = json.loads((clip.parent / "truth.json").read_text())
    places = [row["position"] for row in truth]
    document = yaml.safe_load(clip.read_text())
    lane = {"shape": "line", "points": [places[0], places[-1]]}
    assert_right(command(variant(clip, tmp_path / "metres", paths={"lane0": lane}, vehicles=document["vehicles"])))


# --- what is recorded ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_colour(command: Command, clip: Path, tmp_path: Path) -> None:
    answer = command(variant(clip, tmp_path / "c", lambda side: [np.dstack([i] * 3) for i in pictures(clip, side)]))
    assert_right(answer)


def test_sixteen_bits(command: Command, clip: Path, tmp_path: Path) -> None:
    deep = variant(clip, tmp_path / "c", lambda s: [i.astype(np.uint16) * 16 for i in pictures(clip, s)], bit_depth=12)
    assert_right(command(deep))


def test_video_by_its_own_time_stamps(command: Command, clip: Path, tmp_path: Path) -> None:
    """Frames 2 and 6 are missing; only the time stamps know."""
    kept = [k for k in range(10) if k not in (2, 6)]
    (tmp_path / "v").mkdir()
    for side in ("left", "right"):
        with av.open(tmp_path / "v" / f"{side}.mkv", "w") as container:
            stream = container.add_stream("ffv1", rate=1000)
            stream.width, stream.height, stream.pix_fmt = 640, 480, "gray"
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
            images = pictures(clip, side)
            for k in kept:
                frame = av.VideoFrame.from_ndarray(images[k], format="gray")
                frame.pts, frame.time_base = 200 * k, Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    answer = command(variant(clip, tmp_path / "v", rate=None, left="left.mkv", right="right.mkv"))
    assert_right(answer)
    assert [float(r["time_s"]) for r in answer.rows] == pytest.approx([k / 5 for k in kept])
    assert "dropped" in answer.stderr


@pytest.mark.slow
def test_dropped_and_skewed_frames(command: Command, tmp_path: Path) -> None:
    answer = command(write(render(scene(dropped=(3, 4), skew_s=0.004)), tmp_path / "clip"))
    assert_right(answer)
    assert "dropped" in answer.stderr and "+4.0 ms" in answer.stderr


@pytest.mark.slow
def test_lenses_that_distort(command: Command, clip: Path, tmp_path: Path) -> None:
    """The pictures and all clicks as they would be through such a lens."""
    rig = yaml.safe_load((clip.parent / "rig.yaml").read_text())
    document = yaml.safe_load(clip.read_text())
    coefficients = {"left": [-0.25, 0.1, 0.001, -0.001, 0.0], "right": [-0.2, 0.05, 0.0, 0.002, 0.0]}

    def clicked(points: list[list[float]], side: str) -> list[list[float]]:
        K = np.array(rig[side]["K"])
        rays = np.column_stack([np.array(points), np.ones(len(points))]) @ np.linalg.inv(K).T
        seen = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array(coefficients[side]))[0]
        return [[float(x), float(y)] for x, y in seen.reshape(-1, 2)]

    def bent(side: str) -> Images:
        K = np.array(rig[side]["K"])
        y, x = np.mgrid[0:480, 0:640].astype(float)
        seen = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
        precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        ideal = cv2.undistortPoints(seen, K, np.array(coefficients[side]), P=K, criteria=precise)
        at = np.asarray(ideal, np.float32).reshape(480, 640, 2)
        return [cv2.remap(i, at, None, cv2.INTER_CUBIC) for i in pictures(clip, side)]

    for side in ("left", "right"):
        rig[side]["distortion"] = coefficients[side]
        document["paths"]["lane0"][side] = clicked(document["paths"]["lane0"][side], side)
        document["vehicles"][0][side] = clicked(document["vehicles"][0][side], side)
    moved = variant(clip, tmp_path / "lens", bent, paths=document["paths"], vehicles=document["vehicles"])
    (moved.parent / "rig.yaml").write_text(yaml.safe_dump(rig))
    assert_right(command(moved))


def test_a_filter_that_slid_off_is_put_right_by_the_pictures(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    update = paceline.Tracker.update

    def sliding(tracker: paceline.Tracker, frame: Any) -> Any:
        estimate = update(tracker, frame)
        slide = max(0, frame.index - 5) * np.array([3.0, 0.0])
        return replace(estimate, left=estimate.left + slide, right=estimate.right + slide)

    monkeypatch.setattr(paceline.Tracker, "update", sliding)
    m = paceline.measure(paceline.load_clip(clip), paceline.SpeedConfiguration()).measurements[0]
    assert m.verdict == "measured" and m.frames == 10
    assert m.speed_lo - 0.03 <= SPEED <= m.speed_hi + 0.03


def test_the_fit_of_all_frames_decides_about_the_direction(clip: Path) -> None:
    """Two frames may be too near to each other to tell the filter in which direction a vehicle drives."""
    loaded = paceline.load_clip(clip)
    (vehicle,) = loaded.vehicles
    drawn = {"lane0": path_from_document(loaded.paths["lane0"], loaded.rig)}
    run = VehicleMeasurement(loaded, vehicle, drawn, SpeedConfiguration(), TrackerBatch())
    for frame in paceline.open_recording(loaded).frames():
        run.process(frame)
    expected, driven = run.result(), run.tracker.path
    (run.tracker.path,) = (path for path in run.tracker.candidate_paths if path is not driven)
    found = run.result()
    assert found.verdict == "measured"
    assert found.speed == pytest.approx(expected.speed, abs=0.1 * expected.random_std)


def hoarding(clip: Path, side: str, frames: list[int]) -> Images:
    """The pictures of a ``side``, of which some ``frames`` show a board in front of everything."""
    images = pictures(clip, side)
    rng = np.random.default_rng(5)
    for k in frames:  # another board in each: a frame that repeats the one before is skipped
        images[k] = np.kron(rng.integers(40, 200, (120, 160)), np.ones((4, 4))).astype(np.uint8)
    return images


def stay_on(frames: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """A filter that in some ``frames`` believes to see the vehicle where it was last."""
    update = paceline.Tracker.update
    last: list[Any] = []

    def staying(tracker: paceline.Tracker, frame: Any) -> Any:
        if frame.index not in frames:
            last.append(update(tracker, frame))
        return replace(last[-1], frame=frame.index, time=frame.time, similarity=1.0)

    monkeypatch.setattr(paceline.Tracker, "update", staying)


def test_a_track_ends_where_something_hides_the_vehicle(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the filter follows what hides it."""
    hidden = [6, 7, 8, 9]
    stay_on(hidden, monkeypatch)
    changed = variant(clip, tmp_path / "hidden", lambda side: hoarding(clip, side, hidden))
    m = paceline.measure(paceline.load_clip(changed), paceline.SpeedConfiguration()).measurements[0]
    assert m.verdict == "measured" and m.frames == 6
    assert list(m.track.status) == 6 * ["tracking"] + 4 * ["lost"]
    assert "lost at frame 6" in m.notices
    assert m.speed_lo - 0.03 <= SPEED <= m.speed_hi + 0.03


def test_what_is_hidden_for_most_of_its_track_is_measured_by_its_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, hidden = write(render(scene(rate=10.0, frames=20)), tmp_path / "whole"), list(range(7, 20))
    stay_on(hidden, monkeypatch)
    changed = variant(whole, tmp_path / "hidden", lambda side: hoarding(whole, side, hidden))
    m = paceline.measure(paceline.load_clip(changed), paceline.SpeedConfiguration()).measurements[0]
    assert m.verdict == "measured" and m.frames == 7 and list(m.track.status)[7:] == 13 * ["lost"]
    assert m.speed_lo - 0.03 <= SPEED <= m.speed_hi + 0.03


def test_what_hardly_shows_is_not_measured(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hidden = [2, 3, 5, 6, 8, 9]
    stay_on(hidden, monkeypatch)
    changed = variant(clip, tmp_path / "hidden", lambda side: hoarding(clip, side, hidden))
    m = paceline.measure(paceline.load_clip(changed), paceline.SpeedConfiguration()).measurements[0]
    assert m.verdict == "rejected" and m.reason.startswith("residuals: ")


def test_what_never_looks_like_the_region_is_not_measured(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever motion the refinement may find there."""
    update = paceline.Tracker.update

    def unlike(tracker: paceline.Tracker, frame: Any) -> Any:
        estimate = update(tracker, frame)
        return replace(estimate, similarity=0.5 if frame.index > 2 else estimate.similarity)

    monkeypatch.setattr(paceline.Tracker, "update", unlike)
    m = paceline.measure(paceline.load_clip(clip), paceline.SpeedConfiguration()).measurements[0]
    assert (m.verdict, m.reason_code) == ("rejected", "appearance_lost_from_start")
    assert m.reason.startswith("unlike itself: only 3 of 10 frames look like the outlined region")


@pytest.mark.slow
def test_the_mean_speed_of_a_long_track_counts_to_its_last_frame(tmp_path: Path) -> None:
    """Of 44 frames every second one is kept, and the last."""
    braking = Vehicle("v0", SPEED, start_distance=58.0, acceleration=-3.0, texture_seed=21)
    clip = write(render(scene(vehicles=(braking,), rate=20.0, frames=44)), tmp_path / "clip")
    m = paceline.measure(paceline.load_clip(clip), paceline.SpeedConfiguration()).measurements[0]
    kept = np.flatnonzero(np.isfinite(m.track.refined_speed))
    assert kept.tolist() == [*range(0, 43, 2), 43]
    assert m.verdict == "measured" and m.speed_lo <= SPEED - 1.5 * 43 / 20 <= m.speed_hi


# --- from Python ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_python_api_gives_the_same_result(command: Command, clip: Path, tmp_path: Path) -> None:
    document = paceline.load_clip(clip)
    progress: list[tuple[int, int]] = []
    result = paceline.measure(document, paceline.SpeedConfiguration(seed=3), lambda *at: progress.append(at))
    assert progress == [(k, 10) for k in range(1, 11)]
    paceline.write_report(result, paceline.open_recording(document), tmp_path / "api", "m/s")
    answer = command(clip, "--seed", "3", "--units", "m/s")
    api = (tmp_path / "api" / "estimates.csv").read_bytes()
    assert api == (answer.out / "estimates.csv").read_bytes()
    assert answer.vehicles["v0"]["speed_mps"] == result.measurements[0].speed
    assert {p.name for p in (tmp_path / "api").iterdir()} == {p.name for p in answer.out.iterdir()}


def test_a_loop_over_frames(clip: Path) -> None:
    """An estimate with every frame, the filter's own of the whole measurement."""
    cameras = estimate_cameras(paceline.load_clip(clip), paceline.open_recording(paceline.load_clip(clip)))
    document = cameras.clip
    vehicle, lane = document.vehicles[0], document.paths["lane0"]
    tracker = paceline.Tracker(document.rig, vehicle, path_from_document(lane, document.rig), lane.lateral_offset)

    def stream() -> Iterator[float]:
        for frame in cameras.recording.frames(vehicle.frame):
            yield tracker.update(frame).speed

    whole = paceline.measure(clip, paceline.SpeedConfiguration(refine=False)).measurements[0]
    np.testing.assert_array_equal(list(stream()), whole.track.speed)
