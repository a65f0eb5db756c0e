"""One camera's frames by time: files, videos, live sources, and what is said about those that are damaged."""

from __future__ import annotations

import os
import re
import signal
import socket
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tiny_chase

from paceline.cameras import Camera
from paceline.errors import UnusableInput
from paceline.recordings import monocular
from paceline.recordings.monocular import CameraRecording, open_camera
from paceline.recordings.odometry import read_odometry

WIDTH, HEIGHT = 64, 48


@dataclass
class Clip:
    video: str
    rate: float | None = None
    rate_override: bool = False
    bit_depth: int | None = None
    path: Path = Path("follow.yaml")
    camera: Camera = field(default_factory=lambda: Camera((WIDTH, HEIGHT), np.diag([50.0, 50.0, 1.0])))


def picture(k: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 256, size[::-1]).astype(np.uint8)


def images(folder: Path, numbers: list[int] | range) -> Path:
    folder.mkdir()
    for k, number in enumerate(numbers):
        cv2.imwrite(str(folder / f"{number:04d}.png"), picture(k))
    return folder


def video(path: Path, times: list[int] | range, spoilt: tuple[int, ...] = (), container: str | None = None) -> Path:
    """A lossless video, ``times`` in hundredths of a second; the packets of frames in ``spoilt`` are damaged."""
    with av.open(str(path), "w", format=container) as out:
        stream = out.add_stream("ffv1", rate=100)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
        stream.codec_context.gop_size = 1  # every picture stands for itself
        for k, stamp in enumerate(times):
            frame = av.VideoFrame.from_ndarray(picture(k), format="gray")
            frame.pts = stamp
            for packet in stream.encode(frame):
                out.mux(tiny_chase.damaged(packet, stream) if k in spoilt else packet)
        out.mux(stream.encode())
    return path


def refusal(clip: Clip) -> str:
    with pytest.raises(UnusableInput) as caught:
        list(open_camera(clip))
    return str(caught.value)


# --- files ---------------------------------------------------------------------------------------------------------


def test_images_are_read_in_order_with_their_rate(tmp_path: Path) -> None:
    recording = open_camera(Clip(str(images(tmp_path / "frames", range(12))), rate=10))
    assert (recording.total, recording.live, recording.notices) == (12, False, [])
    for again in range(2):
        frames = list(recording)
        assert [f.index for f in frames] == list(range(12)), again
        np.testing.assert_allclose([f.time for f in frames], np.arange(12) / 10)
        for k, frame in enumerate(frames):
            assert frame.image is not None and frame.image.dtype == np.uint8
            np.testing.assert_array_equal(frame.image, picture(k))
    assert [f.index for f in recording.frames(9)] == [9, 10, 11]


def test_numbers_that_skip_mean_dropped_frames(tmp_path: Path) -> None:
    recording = open_camera(Clip(str(images(tmp_path / "frames", [2, 4, 6, 8, 14, 16])), rate=10))
    np.testing.assert_allclose([f.time for f in recording], [0, 0.1, 0.2, 0.3, 0.6, 0.7])
    assert recording.notices == ["frames 3 and 4 lie 0.300 s apart instead of 0.100 s"]


def test_clock_readings_in_names_are_no_counters(tmp_path: Path) -> None:
    recording = open_camera(Clip(str(images(tmp_path / "frames", [100, 133, 167, 200])), rate=30))
    np.testing.assert_allclose([f.time for f in recording], np.arange(4) / 30)


def test_a_video_keeps_its_own_times(tmp_path: Path) -> None:
    times = [0, 7, 14, 20, 27, 95, 101]
    recording = open_camera(Clip(str(video(tmp_path / "v.mkv", times)), rate=15))
    np.testing.assert_allclose([f.time for f in recording], np.array(times) / 100, atol=1e-3)
    unused, jump = recording.notices
    assert "rate is not used" in unused
    assert jump == "frames 4 and 5 lie 0.680 s apart instead of 0.070 s"


def test_a_rate_that_overrides_is_used_in_place_of_a_videos_own_times(tmp_path: Path) -> None:
    recording = open_camera(Clip(str(video(tmp_path / "v.mkv", range(0, 60, 10))), rate=240, rate_override=True))
    np.testing.assert_allclose([f.time for f in recording], np.arange(6) / 240)
    (override,) = recording.notices
    assert override.endswith("v.mkv: timed by 240 frames/s in place of its own time stamps, which lie 0.1 s apart")


def test_a_rate_overrides_no_live_source() -> None:
    live = Clip("rtsp://camera/1", rate=25, rate_override=True)
    assert refusal(live) == "follow.yaml: rate.override: expected a file; a live source may lose frames unseen"


def test_a_damaged_image_is_passed_over(tmp_path: Path) -> None:
    folder = images(tmp_path / "frames", range(6))
    (folder / "0003.png").write_bytes((folder / "0003.png").read_bytes()[:400])
    recording = open_camera(Clip(str(folder), rate=10))
    frames = list(recording)
    assert [f.image is None for f in frames] == [False, False, False, True, False, False]
    assert frames[3].time == pytest.approx(0.3)
    (notice,) = recording.notices
    assert "0003.png" in notice and "cannot be decoded" in notice


def test_a_video_damaged_in_the_middle_is_read_to_its_end(tmp_path: Path) -> None:
    recording = open_camera(Clip(str(video(tmp_path / "v.mkv", range(0, 100, 10), spoilt=(4, 5)))))
    frames = list(recording)
    assert [f.index for f in frames if f.image is None] == [4, 5]
    assert len(frames) == 10 and frames[9].image is not None
    np.testing.assert_array_equal(frames[9].image, picture(9))
    assert [notice.split(":")[-2].strip() for notice in recording.notices] == ["frame 4", "frame 5"]


def test_long_lists_of_notices_are_cut_off(tmp_path: Path) -> None:
    recording = open_camera(Clip(str(video(tmp_path / "v.mkv", range(0, 300, 10), spoilt=tuple(range(5, 25))))))
    assert sum(f.image is None for f in recording) == 20
    assert len(recording.notices) == 8 and recording.notices[-1].startswith(f"{tmp_path / 'v.mkv'}: frame 12, and 12 ")


def test_another_size_is_refused_naming_the_frame(tmp_path: Path) -> None:
    folder = images(tmp_path / "frames", range(5))
    cv2.imwrite(str(folder / "0002.png"), picture(2, (32, 48)))
    assert refusal(Clip(str(folder), rate=10)) == (
        f"{folder / '0002.png'}: has 32 × 48 pixels, but the camera has 64 × 48"
    )


def test_images_need_a_rate(tmp_path: Path) -> None:
    assert "follow.yaml: rate: missing" in refusal(Clip(str(images(tmp_path / "frames", range(3)))))


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    assert "no such file or folder" in refusal(Clip(str(tmp_path / "absent")))


def test_it_can_be_stopped(tmp_path: Path) -> None:
    recording = open_camera(Clip(str(images(tmp_path / "frames", range(9))), rate=10))
    seen = []
    for frame in recording:
        seen.append(frame.index)
        if frame.index == 3:
            recording.stop()
    assert seen == [0, 1, 2, 3]


# --- live ----------------------------------------------------------------------------------------------------------


def served(content: bytes, silent: float = 0.0) -> str:
    """The address at which ``content`` can be had once; then the line stays open and ``silent`` for so many seconds."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with server, server.accept()[0] as connection:
            connection.sendall(content)
            time.sleep(silent)

    threading.Thread(target=serve, daemon=True).start()
    return f"tcp://127.0.0.1:{server.getsockname()[1]}"


def live(content: bytes, **options: object) -> CameraRecording:
    return open_camera(Clip(served(content), **options))  # type: ignore[arg-type]


def test_a_stream_is_read_as_it_comes(tmp_path: Path) -> None:
    times = [0, 5, 10, 15, 60, 65]
    recording = live(video(tmp_path / "v.mkv", times).read_bytes())
    assert (recording.total, recording.live) == (None, True)
    frames = list(recording)
    assert [f.index for f in frames] == list(range(6))
    np.testing.assert_allclose([f.time for f in frames], np.array(times) / 100, atol=1e-3)
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, picture(k))
    assert "frames 3 and 4 lie 0.450 s apart instead of 0.050 s" in recording.notices


def test_a_stream_begins_at_the_requested_frame(tmp_path: Path) -> None:
    recording = live(video(tmp_path / "v.mkv", range(0, 60, 10)).read_bytes())
    assert [f.index for f in recording.frames(4)] == [4, 5]


def test_a_damaged_picture_of_a_stream_is_passed_over(tmp_path: Path) -> None:
    recording = live(video(tmp_path / "v.mkv", range(0, 60, 10), spoilt=(2,)).read_bytes())
    assert [f.image is None for f in recording] == [False, False, True, False, False, False]


def test_times_that_go_back_are_counted_on(tmp_path: Path) -> None:
    """A camera whose clock starts again, as a stream of two recordings one after the other."""
    first, second = (video(tmp_path / f"{k}.mkv", range(0, 50, 10)).read_bytes() for k in range(2))
    recording = live(first + second)
    np.testing.assert_allclose([f.time for f in recording], np.arange(10) / 10, atol=1e-3)
    assert any("times go back by 0.400 s at frame 5" in notice for notice in recording.notices)


def test_the_end_of_the_source_is_reported(tmp_path: Path) -> None:
    recording = live(video(tmp_path / "v.mkv", range(0, 60, 10)).read_bytes())
    list(recording)
    assert recording.notices == [f"{recording.name}: the source ended"]


def test_whoever_reads_slowly_gets_every_frame(tmp_path: Path) -> None:
    """More of them than wait in between."""
    frames = []
    for frame in live(video(tmp_path / "v.mkv", range(0, 300, 10)).read_bytes()):
        time.sleep(0.01)
        frames.append(frame)
    assert [f.index for f in frames] == list(range(30))
    np.testing.assert_array_equal(frames[29].image, picture(29))


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no alarm signal here")
def test_a_signal_ends_it_while_nothing_comes(tmp_path: Path) -> None:
    """FFmpeg itself waits on until its time is up."""
    content = video(tmp_path / "v.mkv", range(0, 600, 10)).read_bytes()
    recording = open_camera(Clip(served(content, silent=30.0)))
    before = signal.signal(signal.SIGALRM, lambda number, frame: recording.stop())
    signal.setitimer(signal.ITIMER_REAL, 1.5)
    begun = time.monotonic()
    try:
        frames = list(recording)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert 1.4 < time.monotonic() - begun < monocular.SILENCE_TIMEOUT_S / 2
    assert len(frames) > 50


def test_a_source_that_falls_silent_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(monocular, "SILENCE_TIMEOUT_S", 1.0)
    recording = open_camera(Clip(served(video(tmp_path / "v.mkv", range(0, 600, 10)).read_bytes(), silent=30.0)))
    assert len(list(recording)) > 50
    assert recording.notices == [f"{recording.name}: the source ended (nothing came for 1 s)"]


@pytest.mark.parametrize("slow", [0.0, 0.3], ids=["read at once", "read late"])
def test_a_stream_without_times_is_dated_by_arrival(slow: float) -> None:
    """Bare JPEG pictures, one after the other, as many cameras send them; FFmpeg would call it 25 frames/s."""
    pictures = [bytes(cv2.imencode(".jpg", picture(k))[1]) for k in range(8)]
    server = socket.create_server(("127.0.0.1", 0))
    sent: list[float] = []

    def serve() -> None:
        with server, server.accept()[0] as connection:
            head = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n"
            connection.recv(4096)
            connection.sendall(head)
            for jpeg in pictures:
                sent.append(time.monotonic())
                part = b"--next\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n" % (len(jpeg), jpeg)
                connection.sendall(part)
                time.sleep(0.12)

    threading.Thread(target=serve, daemon=True).start()
    recording = open_camera(Clip(f"http://127.0.0.1:{server.getsockname()[1]}/"))
    times = []
    for frame in recording:
        times.append(frame.time)
        time.sleep(slow if frame.index == 3 else 0.0)
    assert any("dated by their arrival" in notice for notice in recording.notices)
    assert len(times) == 8
    assert np.median(np.abs(np.diff(times[2:]) - np.diff(sent[2:]))) < 0.04  # single ones are late on a busy machine


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_named_pipe_is_live(tmp_path: Path) -> None:
    content = video(tmp_path / "v.mkv", range(0, 50, 10)).read_bytes()
    os.mkfifo(tmp_path / "pipe")
    threading.Thread(target=lambda: (tmp_path / "pipe").write_bytes(content), daemon=True).start()
    recording = open_camera(Clip(str(tmp_path / "pipe")))
    assert recording.live and len(list(recording)) == 5


def test_nobody_answers() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    message = refusal(Clip(f"tcp://somebody:secret@127.0.0.1:{port}"))
    assert message.startswith(f"tcp://127.0.0.1:{port}: cannot be opened as a live video")
    assert "secret" not in message and "somebody" not in message


@pytest.mark.skipif(not Path("/dev/null").is_char_device(), reason="needs /dev")
def test_a_device_that_is_no_camera() -> None:
    assert re.match(r"/dev/null: cannot be opened as a live video \(.+\)$", refusal(Clip("/dev/null")))


def test_a_stream_without_video() -> None:
    assert "cannot be opened" in refusal(Clip(served(b"hello" * 999)))


# --- odometry ------------------------------------------------------------------------------------------------------

HEADER = "frame,x_m,y_m,heading_rad"


def odometry(tmp_path: Path, *rows: str, header: str = HEADER) -> Path:
    (tmp_path / "odometry.csv").write_text("\n".join([header, *rows]) + "\n")
    return tmp_path / "odometry.csv"


def test_odometry_is_found_by_frame(tmp_path: Path) -> None:
    found = read_odometry(odometry(tmp_path, "0,0,0,0", "2,1.5,-0.25,0.1", "5,3,0,0.2"))
    np.testing.assert_array_equal(found.at(2), [1.5, -0.25, 0.1])
    np.testing.assert_array_equal(found.at(5), [3, 0, 0.2])
    assert found.at(1) is None and found.at(6) is None and found.at(-1) is None


@pytest.mark.parametrize(
    ("rows", "header", "words"),
    [
        (["0,0,0,0"], "f,x,y,h", ["first line", HEADER]),
        ([], HEADER, ["no rows"]),
        (["0,0,0,0", "1,0,0"], HEADER, ["line 3", "three finite numbers"]),
        (["0,0,0,0", "1,0,nan,0"], HEADER, ["line 3", "finite"]),
        (["0,0,0,0", "0.5,0,0,0"], HEADER, ["line 3", "expected a frame"]),
        (["0,0,0,0", "0,0,0,0"], HEADER, ["line 3", "frame 0 follows frame 0"]),
    ],
)
def test_odometry_that_cannot_be(rows: list[str], header: str, words: list[str], tmp_path: Path) -> None:
    with pytest.raises(UnusableInput) as caught:
        read_odometry(odometry(tmp_path, *rows, header=header))
    for word in ["odometry.csv", *words]:
        assert word in str(caught.value)


def test_odometry_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UnusableInput, match="cannot be read"):
        read_odometry(tmp_path / "absent.csv")
