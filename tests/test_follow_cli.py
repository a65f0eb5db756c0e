"""`paceline follow` as a person uses it: what it prints, what it writes, how it ends."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tiny_chase
import yaml
from run_command import COMMAND, ENVIRONMENT, Done, assert_one_line_error, paceline

from paceline.documents.models import CameraModel, FollowModel, StartModel, TargetModel
from paceline.reports.follow.tables import TRACK_COLUMNS

pytestmark = pytest.mark.usefixtures("unrendered_plots")

FRAMES = 30
SHARED = Path(__file__).parents[2] / "shared" / "data"
REQUIRED = "frame,time_s,cx,cy,scale,w_x,w_y,w_scale,x_m,y_m,z_m,steering_rad,status"
FILES = {"track.csv", "summary.json", "report.html", "overlay.mp4", "plots"}


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_chase.write(tmp_path_factory.mktemp("chase") / "clip", FRAMES).parent


@pytest.fixture
def clip(original: Path, tmp_path: Path) -> Path:
    """A copy of the recording's folder that a test may change."""
    return Path(shutil.copytree(original, tmp_path / "clip"))


@pytest.fixture(scope="module")
def followed(original: Path) -> Iterator[tuple[Done, Path]]:
    out = original.parent / "out"
    yield paceline("follow", original, "-o", out), out


def change(clip: Path, **keys: object) -> None:
    document = yaml.safe_load((clip / "follow.yaml").read_text()) | keys
    (clip / "follow.yaml").write_text(yaml.safe_dump({k: v for k, v in document.items() if v is not None}))


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "track.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def test_a_recording_is_followed(followed: tuple[Done, Path]) -> None:
    done, out = followed
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"small van: tracked in 100 % of {FRAMES} frames")
    assert done.stdout.rstrip().endswith(str(out / "report.html"))
    assert {p.name for p in out.iterdir()} == FILES
    assert not [p for p in out.parent.iterdir() if p.name.startswith(".")]


def test_the_track_is_right(followed: tuple[Done, Path]) -> None:
    track = rows(followed[1])
    assert ",".join(track[0]).startswith(REQUIRED)
    assert [int(r["frame"]) for r in track] == list(range(FRAMES))
    assert {r["status"] for r in track} == {"tracking"}
    np.testing.assert_allclose([float(r["time_s"]) for r in track], np.arange(FRAMES) / 15)
    found = np.array([[float(r[f"{axis}_m"]) for axis in "xyz"] for r in track])
    true = np.array([tiny_chase.truth(k) for k in range(FRAMES)])
    std = np.array([[float(r[f"{axis}_std_m"]) for axis in "xyz"] for r in track])
    assert np.sqrt(((found[:, 2] / true[:, 2] - 1) ** 2).mean()) < 0.005
    assert np.abs(found - true).max(axis=0)[:2].max() < 0.02
    assert (np.abs(found - true) < 1.96 * std).mean(axis=0).min() > 0.8
    x, y, z = tiny_chase.truth(7)
    row = {k: float(v) for k, v in track[7].items() if k not in ("status", "reason")}
    assert row["scale"] == pytest.approx(tiny_chase.NOMINAL / z, rel=0.005)
    assert row["cx"] == pytest.approx(tiny_chase.CX + tiny_chase.F * x / z, abs=0.3)
    assert row["cy"] == pytest.approx(tiny_chase.CY + tiny_chase.F * y / z, abs=0.3)
    assert min(row["w_x"], row["w_y"], row["w_scale"]) > 0
    assert row["bearing_rad"] == pytest.approx(np.arctan2(x, z), abs=0.002)
    assert 0 < row["latency_s"] < 0.5


def test_the_summary_is_right(followed: tuple[Done, Path]) -> None:
    found = summary(followed[1])
    assert (found["frames"], found["tracked_share"], found["target"]) == (FRAMES, 1.0, "small van")
    assert found["status"] == {"tracking": FRAMES, "coasting": 0, "lost": 0}
    ranges = [tiny_chase.truth(k)[2] for k in range(FRAMES)]
    for name, value in (("min", min(ranges)), ("mean", np.mean(ranges)), ("max", max(ranges))):
        assert found["range_m"][name] == pytest.approx(value, rel=0.01)
    assert 0 < found["latency_s"]["median"] <= found["latency_s"]["p99"] <= found["latency_s"]["max"]
    assert found["duration_s"] == pytest.approx((FRAMES - 1) / 15)
    assert found["configuration"]["wheelbase"] > 0 and "paceline" in found["versions"]


def test_without_odometry_it_is_said_that_the_lead_itself_is_steered_for(followed: tuple[Done, Path]) -> None:
    done, out = followed
    words = (
        "towards the lead itself and not along its path, so that it cuts the corner in bends; "
        "assumed: wheelbase 2.8 m, camera 1.5 m ahead of the rear axle"
    )
    assert f"steering: {words}\n" in done.stdout
    assert f"Steering angle:</strong> {words}." in (out / "report.html").read_text()
    assert (summary(out)["steering"], summary(out)["assumed"]) == ("lead", {"wheelbase": 2.8, "camera_ahead": 1.5})


def test_the_width_is_stated_first_and_is_part_of_every_interval(clip: Path, tmp_path: Path) -> None:
    target = {**tiny_chase.TARGET, "tolerance": 0.05, "width_assumed": True}
    (clip / "target.yaml").write_text(yaml.safe_dump(target))
    change(clip, start=tiny_chase.start(FRAMES - 4))
    done = paceline("follow", clip, "-o", tmp_path / "out", "--no-overlay")
    assert "the model is 2.000 ± 0.098 m wide (± assumed)" in done.stdout
    page = (tmp_path / "out" / "report.html").read_text()
    assert "The small van, 2.000 ± 0.098 m wide (± assumed), was tracked" in page
    assert "Its width alone makes each distance uncertain by ±&nbsp;4.9&nbsp;%." in page
    assert summary(tmp_path / "out")["width"] == {"value": 2.0, "std": 0.05, "assumed": True}
    for row in rows(tmp_path / "out"):
        assert float(row["z_std_m"]) > 0.025 * float(row["z_m"])


def test_no_steering_leaves_the_column_empty(clip: Path, tmp_path: Path) -> None:
    change(clip, start=tiny_chase.start(FRAMES - 4))
    done = paceline("follow", clip, "-o", tmp_path / "out", "--no-overlay", "--steering", "none")
    assert done.returncode == 0, done.stderr
    assert {row["steering_rad"] for row in rows(tmp_path / "out")} == {""}
    assert (summary(tmp_path / "out")["steering"], summary(tmp_path / "out")["assumed"]) == ("none", {})


def test_a_path_cannot_be_steered_along_without_odometry(clip: Path, tmp_path: Path) -> None:
    done = paceline("follow", clip, "-o", tmp_path / "out", "--steering", "path")
    assert_one_line_error(done, "follow.yaml: odometry: missing")
    assert not (tmp_path / "out").exists()


def test_the_overlay_plays_with_the_recordings_times(followed: tuple[Done, Path]) -> None:
    with av.open(str(followed[1] / "overlay.mp4")) as container:
        frames = list(container.decode(video=0))
    np.testing.assert_allclose([f.time for f in frames], np.arange(FRAMES) / 15, atol=1e-3)
    picture = frames[10].to_ndarray(format="rgb24").astype(int)
    assert picture.shape[1] >= 768
    green = (picture[..., 1] - picture[..., 0] > 60) & (picture[..., 1] - picture[..., 2] > 40)
    assert green.sum() > 500, "the model's lines are green"


def test_again_it_gives_the_same(clip: Path, followed: tuple[Done, Path], tmp_path: Path) -> None:
    done = paceline("follow", clip / "follow.yaml", "-o", tmp_path / "out", "--quiet", "--no-overlay")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES - {"overlay.mp4"}
    assert "overlay.mp4" not in (tmp_path / "out" / "report.html").read_text()
    timeless = [{k: v for k, v in row.items() if k != "latency_s"} for row in rows(tmp_path / "out")]
    assert timeless == [{k: v for k, v in row.items() if k != "latency_s"} for row in rows(followed[1])]


def test_it_begins_at_the_frame_of_the_start(clip: Path, tmp_path: Path) -> None:
    change(clip, start=tiny_chase.start(12))
    assert paceline("follow", clip, "-o", tmp_path / "out", "--no-overlay").returncode == 0
    track = rows(tmp_path / "out")
    assert [int(r["frame"]) for r in track] == list(range(12, FRAMES))
    assert float(track[0]["z_m"]) == pytest.approx(tiny_chase.truth(12)[2], rel=0.01)


def test_odometry_and_wheelbase_steer(clip: Path, tmp_path: Path) -> None:
    """The same lead seen from a vehicle that stands and from one that turns makes another path to pursue."""
    angles = []
    for turn in (0.0, 0.4):
        drive = [f"{k},{0.5 * k},0,{turn * k / 15}" for k in range(FRAMES)]
        (clip / "odometry.csv").write_text("\n".join(["frame,x_m,y_m,heading_rad", *drive]) + "\n")
        change(clip, odometry="odometry.csv", wheelbase=3.3, lookahead=1.0)
        assert paceline("follow", clip, "-o", tmp_path / "out", "--no-overlay").returncode == 0
        found = summary(tmp_path / "out")
        assert (found["configuration"]["wheelbase"], found["configuration"]["lookahead_time"]) == (3.3, 1.0)
        assert (found["steering"], found["assumed"]) == ("path", {"camera_ahead": 1.5})
        angles.append(np.array([float(r["steering_rad"]) for r in rows(tmp_path / "out")]))
    assert np.isfinite(angles).all()
    assert np.abs(angles[0] - angles[1]).max() > 0.01


def test_nothing_tracked_is_status_1_with_the_reason(clip: Path, tmp_path: Path) -> None:
    for path in (clip / "frames").iterdir():
        cv2.imwrite(str(path), np.zeros((242, 256), np.uint8))
    done = paceline("follow", clip, "-o", tmp_path / "out")
    assert done.returncode == 1, done.stderr
    assert f"tracked in 0 % of {FRAMES} frames" in done.stdout and "note: " in done.stderr
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES
    found = summary(tmp_path / "out")
    assert found["status"]["tracking"] == 0 and found["reasons"] and found["range_m"]["mean"] is None
    page = (tmp_path / "out" / "report.html").read_text()
    assert "tracked in none of" in page and "Advice:" in page and "nan" not in page


def test_the_documents_loop_runs(
    clip: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The Python of docs/following.md, as it stands there."""
    text = (Path(__file__).parents[1] / "docs" / "following.md").read_text(encoding="utf-8")
    shortest, own, live = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(clip)
    exec(compile(shortest, "following.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == FRAMES and re.fullmatch(r"1\.93 s: [\d.]+ m ahead, tracking", lines[-1])
    start = tiny_chase.start(0)
    assert own.count("(597.28, 226.00, 1.0)") == 1  # that of the recording in the text
    own = own.replace("(597.28, 226.00, 1.0)", str((*start["center"], start["scale"])))
    exec(compile(own, "following.md", "exec"), {})
    assert capsys.readouterr().out.splitlines()[-1].startswith("<FollowEstimate frame 29, 1.933 s: tracking, x ")
    exec(compile(live, "following.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == FRAMES
    last = re.fullmatch(r"1\.93 s: ([\d.]+) ± [\d.]+ m ahead, [-+][\d.]+ m to the right, .* ms", lines[-1])
    assert float(last[1]) == pytest.approx(tiny_chase.truth(FRAMES - 1)[2], rel=0.01)


def test_every_key_and_column_is_documented() -> None:
    text = (Path(__file__).parents[1] / "docs" / "following.md").read_text(encoding="utf-8")
    for model in (FollowModel, StartModel, TargetModel, CameraModel):
        for key in model.model_fields:
            assert f"`{key}`" in text, key
    for column in TRACK_COLUMNS:
        assert f"`{column}`" in text, column


# --- live ----------------------------------------------------------------------------------------------------------


class Broadcast:
    """A camera that streams the small chase to whoever connects, until it is closed."""

    def __init__(self, folder: Path, frames: int, pause: float) -> None:
        path = folder / "stream.mkv"
        with av.open(str(path), "w") as out:
            stream = out.add_stream("ffv1", rate=15)
            stream.width, stream.height, stream.pix_fmt = *tiny_chase.SIZE, "gray"
            for k in range(frames):
                out.mux(stream.encode(av.VideoFrame.from_ndarray(tiny_chase.picture(k), format="gray")))
            out.mux(stream.encode())
        self._content, self._pause = path.read_bytes(), pause
        path.unlink()
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self.sent = 0
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        try:
            with self._server, self._server.accept()[0] as connection:
                for at in range(0, len(self._content), 1 << 16):
                    connection.sendall(self._content[at : at + (1 << 16)])
                    self.sent = at
                    time.sleep(self._pause)
        except OSError:  # whoever looked has gone
            return


def test_a_live_stream_is_followed_to_its_end(clip: Path, tmp_path: Path) -> None:
    change(clip, video=Broadcast(tmp_path, FRAMES, 0.0).address, rate=None)
    done = paceline("follow", clip, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert f"tracked in 100 % of {FRAMES} frames" in done.stdout
    assert [int(r["frame"]) for r in rows(tmp_path / "out")] == list(range(FRAMES))
    with av.open(str(tmp_path / "out" / "overlay.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == FRAMES


def interrupt(clip: Path, out: Path, ready: object, *options: str) -> tuple[int, str, str]:
    """Starts following, waits until ``ready()``, presses Ctrl-C."""
    command = [*COMMAND, "follow", str(clip), "-o", str(out), *options]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not ready() and process.poll() is None and time.monotonic() < deadline:  # type: ignore[operator]
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    return process.returncode, stdout, stderr


def written(folder: Path) -> int:
    """Bytes of track.csv so far, in the hidden folder."""
    return sum(p.stat().st_size for p in folder.glob(".*/track.csv"))


def test_ctrl_c_ends_a_live_stream_and_reports_it(clip: Path, tmp_path: Path) -> None:
    camera = Broadcast(tmp_path, 200, 0.05)
    change(clip, video=camera.address, rate=None)
    status, stdout, stderr = interrupt(clip, tmp_path / "out", lambda: written(tmp_path) > 4000, "--no-overlay")
    assert status == 0, stderr
    count = int(re.search(r"of (\d+) frames", stdout)[1])
    assert 3 <= count < 200 and len(rows(tmp_path / "out")) == count
    assert (tmp_path / "out" / "report.html").exists()


def test_ctrl_c_leaves_nothing_of_a_recording(tmp_path: Path) -> None:
    clip = tiny_chase.write(tmp_path / "clip", 5).parent
    for k in range(5, 3000):  # long enough for the interrupt to come in time
        os.link(clip / "frames" / "0004.png", clip / "frames" / f"{k:04d}.png")
    status, stdout, stderr = interrupt(clip, tmp_path / "out", lambda: written(tmp_path) > 0)
    assert (status, stdout, stderr) == (130, "", "paceline: interrupted\n")
    assert [p.name for p in tmp_path.iterdir()] == ["clip"]


# --- options -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["follow"], ["FOLLOW"]),
        (["follow", "f"], ["--out"]),
        (["follow", "absent.yaml", "-o", "o"], ["absent.yaml", "no such file"]),
        (["follow", ".", "-o", "o"], ["follow.yaml", "no such file"]),
        (["follow", "f", "-o", "o", "--unknown"], ["--unknown"]),
        (["target"], ["command"]),
        (["target", "learn"], ["IMAGE"]),
        (["target", "learn", "i", "--box", "1,2,3,4", "--camera", "c", "-o", "t.yaml"], ["--width"]),
        (["target", "learn", "i", "--box", "1,2,3,4", "--width", "wide", "--camera", "c", "-o", "t"], ["--width"]),
    ],
)
def test_wrong_options(arguments: list[str], words: list[str], tmp_path: Path) -> None:
    assert_one_line_error(paceline(*arguments, folder=tmp_path), *words)
    assert list(tmp_path.iterdir()) == []


def test_the_picture_learned_from_is_not_written_over(tmp_path: Path) -> None:
    picture = tmp_path / "target.png"
    picture.write_bytes(b"mine")
    learn = ("target", "learn", picture, "--box", "1,2,30,40", "--width", "2", "--camera", tmp_path / "camera.yaml")
    assert_one_line_error(paceline(*learn, "-o", tmp_path / "target.yaml"), "--out", "target.png", "another name")
    assert picture.read_bytes() == b"mine"


def test_help_names_what_there_is() -> None:
    assert "--no-overlay" in paceline("follow", "--help").stdout
    assert "--camera" in paceline("target", "learn", "--help").stdout
    overview = paceline("--help").stdout
    assert "follow" in overview and "target" in overview


@pytest.mark.skipif(not SHARED.exists(), reason="the shared recordings are not here")
def test_the_shared_recording_is_followed(tmp_path: Path) -> None:
    """No frame lost, 1.5 % of range at most."""
    folder = SHARED / "rendered" / "follow"
    done = paceline("follow", folder, "-o", tmp_path / "out", "--no-overlay")
    assert done.returncode == 0, done.stderr
    truth = {f["frame"]: f["position"] for f in json.loads((folder / "truth.json").read_text())}
    track = rows(tmp_path / "out")
    assert len(track) == len(truth) and not [r for r in track if r["status"] == "lost"]
    ratio = np.array([float(r["z_m"]) / truth[int(r["frame"])][2] for r in track if r["status"] == "tracking"])
    assert len(ratio) > 0.98 * len(truth)
    assert np.sqrt(((ratio - 1) ** 2).mean()) < 0.015 and np.abs(ratio - 1).max() < 0.05
