"""Cameras behind Video4Linux2, as `/dev/video0`: FFmpeg asks a stand-in for the driver, `v4l2_device.c`."""

from __future__ import annotations

import csv
import errno
import json
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import tiny_chase
import yaml
from run_command import COMMAND, ENVIRONMENT, Done, assert_one_line_error, paceline

from paceline.cameras import Camera
from paceline.recordings.live_stereo import CLOCK_OFFSET_FRAMES, MAX_QUEUED_FRAMES, LiveCamera, _pairs
from paceline.recordings.monocular import CameraFrame, CameraRecording

SIZE = WIDTH, HEIGHT = 64, 48
DAMAGED = 0x40  # V4L2_BUF_FLAG_ERROR
TIMES = [0.0, 0.02, 0.04, 0.06, 0.11, 0.13, 0.15, 0.17]

OPENS = """
import json, signal, sys, time
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from paceline.recordings import monocular
from paceline.cameras import Camera, StereoRig

monocular.OPEN_TIMEOUT_S = 1.0
camera = Camera((64, 48), np.array([[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1.0]]))

@dataclass
class Clip:
    video: str = ""
    addresses: tuple = ()
    rate = bit_depth = offset = None
    rate_override = False
    path = Path("a.yaml")
    camera = camera
    rig = StereoRig(camera, camera, np.eye(3), np.array([-1.0, 0, 0]))
"""
READS = """
said = []
for video in sys.argv[2:]:
    begun = time.monotonic()
    try:
        recording = monocular.open_camera(Clip(video))
        frames = list(recording)
        for frame in frames:
            if frame.image is not None:
                frame.image.tofile(f"{video}.{frame.index}")
        times = [frame.time for frame in frames]
        said.append([[begun, time.monotonic()], times, [f.image is not None for f in frames], recording.notices])
    except monocular.UnusableInput as error:
        said.append(str(error))
Path(sys.argv[1]).write_text(json.dumps(said))
"""
WAITS = """
def interrupt(number, frame):
    raise KeyboardInterrupt
signal.signal(signal.SIGALRM, interrupt)
signal.setitimer(signal.ITIMER_REAL, 0.3)
begun = time.monotonic()
monocular.OPEN_TIMEOUT_S = 20.0
try:
    monocular.open_camera(Clip(sys.argv[2]))
except KeyboardInterrupt:
    Path(sys.argv[1]).write_text(json.dumps(time.monotonic() - begun))
"""
PAIRS = """
from paceline.recordings.live_stereo import LiveStereo
views = LiveStereo(Clip(addresses=sys.argv[2:]))
time.sleep(0.3)
pairs = [[pair.time, pair.skew, int(pair.left[0, 0]), int(pair.right[0, 0])] for pair in views]
Path(sys.argv[1]).write_text(json.dumps([pairs, views.notices]))
"""


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stand-in, compiled."""
    if not sys.platform.startswith("linux"):
        pytest.skip("Video4Linux2 is of Linux")
    if (compiler := shutil.which("cc")) is None:
        pytest.skip("needs a C compiler, cc, to make the stand-in for a camera's driver")
    library = tmp_path_factory.mktemp("driver") / "device.so"
    source = Path(__file__).with_name("v4l2_device.c")
    command = [compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl", "-lpthread"]
    done = subprocess.run(command, capture_output=True, text=True)
    if "linux/videodev2.h" in done.stderr:
        pytest.skip("needs linux/videodev2.h to make the stand-in for a camera's driver")
    assert done.returncode == 0, done.stderr
    return library


def picture(k: int) -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(k).integers(16, 236, SIZE[::-1]).astype(np.uint8), (0, 0), 2.0)


def coded(image: np.ndarray, fourcc: str) -> bytes:
    if fourcc == "MJPG":
        return bytes(cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), [cv2.IMWRITE_JPEG_QUALITY, 98])[1])
    return image.tobytes() if fourcc == "GREY" else np.dstack([image, np.full_like(image, 128)]).tobytes()


def plug_in(
    path: Path,
    fourcc: str = "GREY",
    images: Sequence[np.ndarray] = (),
    times: Sequence[float] = TIMES,
    flags: Mapping[int, int] | None = None,
    size: tuple[int, int] = SIZE,
    more: Sequence[str] = (),
) -> Path:
    """A camera at ``path`` that shows ``images`` at ``times``, in seconds, and of which the driver says ``more``."""
    path.symlink_to("/dev/null")  # a device, as cameras are
    with path.with_suffix(".shown").open("wb") as file:
        for k, (image, moment) in enumerate(zip(images, times, strict=False)):
            data = coded(image, fourcc)
            file.write(struct.pack("=dII", moment, (flags or {}).get(k, 0), len(data)) + data)
    lines = [*more, "offers {} {} {} {}".format(fourcc, *size, path.with_suffix(".shown"))]
    path.with_suffix(".camera").write_text("\n".join(lines) + "\n")
    return path


def with_driver(driver: Path, command: Sequence[object]) -> Done:
    environment = {**ENVIRONMENT, "LD_PRELOAD": str(driver)}
    done = subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True, timeout=120)
    return Done(done.returncode, done.stdout, done.stderr)


def answer(driver: Path, script: str, *videos: Path) -> Any:
    """What a ``script`` that opens these devices writes down."""
    said = videos[0].with_suffix(".said")
    done = with_driver(driver, [sys.executable, "-c", OPENS + script, said, *videos])
    assert done == Done(0, "", "")
    return json.loads(said.read_text())


@pytest.mark.parametrize(("fourcc", "off"), [("GREY", 0), ("YUYV", 1), ("MJPG", 4)])
def test_pictures_and_times_are_those_of_the_device(driver: Path, tmp_path: Path, fourcc: str, off: int) -> None:
    """Pictures outlive the device, in whose memory those of a grey camera lie. YUYV is of narrow range, 16 to 235."""
    images = [picture(k) for k in range(8)]
    video = plug_in(tmp_path / "video0", fourcc, images, more=["rate 50"])
    [[[begun, ended], times, seen, notices]] = answer(driver, READS, video)
    assert len(times) == 8 and all(seen)
    np.testing.assert_allclose(np.diff(times), np.diff(TIMES), atol=2e-6)
    assert begun < times[0] and times[-1] < ended  # the clock of this computer
    assert "frames 3 and 4 lie 0.050 s apart instead of 0.020 s" in notices
    assert f"{video}: the source ended (No such device)" in notices and len(notices) == 2
    for k, image in enumerate(images):
        shown = np.fromfile(f"{video}.{k}", np.uint8).reshape(image.shape)
        expected = (image - 16.0) * 255 / 219 if fourcc == "YUYV" else image.astype(float)
        assert np.abs(shown - np.clip(expected, 0, 255)).max() <= off


def test_a_camera_that_cannot_be_had_is_refused_by_name(driver: Path, tmp_path: Path) -> None:
    unanswered = "no answer within 1 s"
    refused = {
        "open EACCES": "Permission denied",
        "S_FMT EBUSY": "it is in use already",
        "STREAMON EBUSY": "it is in use already",
        "STREAMON ENOSPC": "its USB bus has no bandwidth left",
        "G_INPUT ENOTTY": "it is no camera that FFmpeg can read",
        "open ENODEV": "it is no camera that FFmpeg can read",
        "S_FMT EINVAL": "it offers no format that FFmpeg can read",
    }
    videos = []
    for k, failure in enumerate(refused):
        call, name = failure.split()
        videos.append(plug_in(tmp_path / f"video{k}", more=[f"fails {call} {getattr(errno, name)}"]))
    videos.append(plug_in(tmp_path / "silent", more=["silent"]))
    said = answer(driver, READS, *videos)
    for video, message, words in zip(videos, said, [*refused.values(), unanswered], strict=True):
        assert message.startswith(f"{video}: cannot be opened as a live video ({words}")


def test_waiting_for_a_first_picture_can_be_interrupted(driver: Path, tmp_path: Path) -> None:
    assert answer(driver, WAITS, plug_in(tmp_path / "video0", more=["silent"])) < 5.0


def test_another_size_is_refused_unless_the_camera_has_it_as_jpeg(driver: Path, tmp_path: Path) -> None:
    small = ["offers YUYV 32 24"]
    images = [picture(k) for k in range(4)]
    other = plug_in(tmp_path / "video0", "YUYV", size=(80, 48), more=small)
    jpeg = plug_in(tmp_path / "video1", "MJPG", images, more=small)
    refused, [_, times, seen, _] = answer(driver, READS, other, jpeg)
    assert refused.startswith(f"{other}: offers 80 × 48 pixels where 64 × 48 are asked for; expected the image_size")
    assert len(times) == 4 and all(seen)


def test_damaged_pictures_are_passed_over_and_none_begins(driver: Path, tmp_path: Path) -> None:
    video = plug_in(tmp_path / "video0", "YUYV", [picture(k) for k in range(8)], flags={0: DAMAGED, 5: DAMAGED})
    [[_, times, seen, notices]] = answer(driver, READS, video)
    assert seen == [True] * 4 + [False] + [True] * 2
    np.testing.assert_allclose(np.diff(times), np.diff(TIMES[1:]), atol=2e-6)
    assert f"{video}: frame 4: cannot be decoded and left out" in notices


def test_two_devices_are_paired_by_their_common_clock(driver: Path, tmp_path: Path) -> None:
    """One is opened long before the other, so that many of its frames wait, and it is exposed earlier."""
    images = [np.full(SIZE[::-1], 4 * k, np.uint8) for k in range(60)]
    times = 0.05 * np.arange(60)
    left = plug_in(tmp_path / "video0", images=images, times=times, more=["rate 20", "starts 0.05"])
    right = plug_in(tmp_path / "video1", images=images, times=times + 0.01, more=["rate 20", "starts 0.6"])
    pairs, notices = answer(driver, PAIRS, left, right)
    assert len(pairs) > 3 and all(a == b for _, _, a, b in pairs)
    np.testing.assert_allclose([skew for _, skew, _, _ in pairs], 0.01, atol=2e-6)
    moments, _, numbers, _ = np.array(pairs).T
    np.testing.assert_allclose(moments - moments[0], 0.05 * (numbers - numbers[0]) / 4, atol=4e-6)
    assert "left and right frames are taken up to 10.0 ms apart, which is allowed for" in notices
    assert not any("common clock" in notice for notice in notices)


class Taken:
    """A view whose frames have all come, dated by ``times``."""

    interval, recording = 1 / 30, SimpleNamespace(live=True)

    def __init__(self, times: np.ndarray) -> None:
        self.waiting = [CameraFrame(k, float(t), np.zeros((2, 2), np.uint8)) for k, t in enumerate(times)]

    def peek(self) -> CameraFrame | None:
        return self.waiting[0] if self.waiting else None

    def pop(self, frame: CameraFrame) -> None:
        assert self.waiting.pop(0) is frame


@pytest.mark.parametrize("skew", [-0.4, -0.2, 0.0, 0.3, 0.4])
def test_jitter_breaks_no_pairs_up(skew: float) -> None:
    """Of 2 ms, about a skew of almost half an interval between two devices that share a clock."""
    rng, times = np.random.default_rng(1), np.arange(400) / 30
    left, right = (Taken(times + off / 30 + rng.normal(0, 0.002, 400)) for off in (0.0, skew))
    pairs = list(_pairs(left, right, 0.0))  # type: ignore[arg-type]
    assert len(pairs) > 380
    assert np.mean([pair.skew for pair in pairs]) == pytest.approx(skew / 30, abs=0.001)


class Backlog:
    """A view whose first frames were taken before anyone read, 0.02 s apart, and come at once."""

    name, notices = "camera", []  # noqa: RUF012

    def __init__(self, waited: int) -> None:
        self.waited = waited

    def read(self, start: int) -> Iterator[CameraFrame]:
        begun = time.monotonic()
        for k in range(self.waited + 3 * CLOCK_OFFSET_FRAMES):
            moment = 0.02 * (k - self.waited)
            time.sleep(max(0.0, begun + moment - time.monotonic()))
            yield CameraFrame(k, moment, np.zeros(SIZE[::-1], np.uint8))

    def label(self, frame: int) -> str:
        return f"frame {frame}"

    def stop(self) -> None:
        pass


def test_clocks_are_compared_once_nothing_waits_any_more() -> None:
    camera = Camera(SIZE, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]))
    views = [LiveCamera(CameraRecording(camera, Backlog(waited), None)) for waited in (0, MAX_QUEUED_FRAMES // 2)]
    begun = time.monotonic()
    for view in views:
        view.begin(begun)
    late = [view.delay_s() for view in views]
    assert late == pytest.approx([begun, begun], abs=0.1)  # half of what waits is 0.3 s old


def test_following_by_a_device_is_following_the_recording(driver: Path, tmp_path: Path) -> None:
    count = 20
    follow = tiny_chase.write(tmp_path / "clip", count)
    video = plug_in(
        tmp_path / "video0",
        images=[tiny_chase.picture(k) for k in range(count)],
        times=np.arange(count) / 15,
        size=tiny_chase.SIZE,
        more=["rate 15"],
    )
    assert paceline("follow", follow, "-o", tmp_path / "files", "--no-overlay").returncode == 0
    document = yaml.safe_load(follow.read_text())
    del document["rate"]
    follow.write_text(yaml.safe_dump(document | {"video": str(video)}))
    done = with_driver(driver, [*COMMAND, "follow", follow, "-o", tmp_path / "live", "--no-overlay"])
    assert done.returncode == 0, done.stderr
    assert done.stderr == f"note: {video}: the source ended (No such device)\n"
    files, live = (list(csv.DictReader((tmp_path / out / "track.csv").open(newline=""))) for out in ("files", "live"))
    assert [row["status"] for row in files] == [row["status"] for row in live] == ["tracking"] * count
    for name in ("x_m", "y_m", "z_m"):
        np.testing.assert_allclose(*([float(row[name]) for row in rows] for rows in (files, live)), atol=1e-5)
    steps = [np.diff([float(row["time_s"]) for row in rows]) for rows in (files, live)]
    np.testing.assert_allclose(*steps, atol=2e-6)


def test_the_command_ends_in_one_line_without_a_camera(driver: Path, tmp_path: Path) -> None:
    follow = tiny_chase.write(tmp_path / "clip", 1)
    video = plug_in(tmp_path / "video0", more=[f"fails S_FMT {errno.EBUSY}"])
    follow.write_text(yaml.safe_dump(yaml.safe_load(follow.read_text()) | {"video": str(video)}))
    done = with_driver(driver, [*COMMAND, "follow", follow, "-o", tmp_path / "out"])
    assert_one_line_error(done, str(video), "in use")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip", "video0", "video0.camera", "video0.shown"]
