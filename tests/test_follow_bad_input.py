"""Recordings that cannot be followed, and pictures that show nothing for a while, through the command line."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tiny_chase
from damaged_inputs import Folder
from run_command import Done, assert_one_line_error, paceline

pytestmark = pytest.mark.usefixtures("unrendered_plots")

FRAMES = 40
FIRST, LAST = 18, 22  # of the frames that show nothing


class Clip(Folder):
    """A copy of a recording's folder that a case spoils."""

    def picture(self, frame: int) -> Path:
        return self.folder / "frames" / f"{frame:04d}.png"

    def video(self, times: list[int] | None = None, spoilt: range = range(0), codec: str = "ffv1") -> None:
        """A video instead of the images, in fifteenths of a second; the packets of ``spoilt`` frames are damaged."""
        with av.open(str(self.folder / "video.mkv"), "w") as out:
            stream = out.add_stream(codec, rate=15)
            stream.width, stream.height = tiny_chase.SIZE
            stream.pix_fmt = "gray" if codec == "ffv1" else "yuv420p"
            stream.codec_context.gop_size = 1
            for k, time in enumerate(times or range(FRAMES)):
                image = av.VideoFrame.from_ndarray(tiny_chase.picture(time), format="gray")
                image.pts = time
                for packet in stream.encode(image):
                    out.mux(tiny_chase.damaged(packet, stream) if k in spoilt else packet)
            out.mux(stream.encode())
        self.set("follow.yaml", "video", "video.mkv")
        self.set("follow.yaml", "rate", None)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_chase.write(tmp_path_factory.mktemp("chase") / "clip", FRAMES).parent


@pytest.fixture
def clip(original: Path, tmp_path: Path) -> Clip:
    return Clip.copied(original, tmp_path / "clip")


Command = Callable[[], Done]


@pytest.fixture
def command(clip: Clip, tmp_path: Path) -> Command:
    """`paceline follow CLIP -o OUT --no-overlay`."""
    return lambda: paceline("follow", clip.folder, "-o", tmp_path / "out", "--no-overlay")


# --- refused -------------------------------------------------------------------------------------------------------

Case = tuple[Callable[[Clip], object], list[str]]


def resized(clip: Clip, frame: int) -> None:
    cv2.imwrite(str(clip.picture(frame)), cv2.resize(tiny_chase.picture(frame), (128, 121)))


def odometry(clip: Clip, *rows: str) -> None:
    clip.set("follow.yaml", "odometry", "odometry.csv")
    (clip.folder / "odometry.csv").write_text("\n".join(["frame,x_m,y_m,heading_rad", *rows]) + "\n")


REFUSED: dict[str, Case] = {
    "no horizontal lines": (
        lambda c: c.set("target.yaml", "segments", [["b", "c"], ["f", "g"]]),
        ["target.yaml", "segments", "no horizontal line"],
    ),
    "no vertical lines": (
        lambda c: c.set("target.yaml", "segments", [["a", "b"], ["e", "f"]]),
        ["target.yaml", "segments", "no vertical line"],
    ),
    "no such corner": (
        lambda c: c.set("target.yaml", "segments.2", ["c", "y2"]),
        ["target.yaml", "segments[2]", "no corner is called 'y2'"],
    ),
    "an oblique line": (
        lambda c: c.set("target.yaml", "segments.2", ["e", "c"]), ["target.yaml", "segments[2]", "oblique"],
    ),
    "a start outside": (
        lambda c: c.set("follow.yaml", "start.center", [300, 100]), ["follow.yaml", "start.center", "256 × 242"],
    ),
    "zero scale": (lambda c: c.set("follow.yaml", "start.scale", 0), ["follow.yaml", "start.scale", "above 0"]),
    "a start beyond the end": (
        lambda c: c.set("follow.yaml", "start.frame", FRAMES), ["follow.yaml", "start.frame", f"0 to {FRAMES - 1}"],
    ),
    "a start that cannot be decoded": (
        lambda c: [c.set("follow.yaml", "start.frame", 1), c.picture(1).write_bytes(b"no picture")],
        ["follow.yaml", "start.frame", "frame 1 cannot be decoded"],
    ),
    "another size later": (lambda c: resized(c, 9), ["0009.png", "128 × 121", "256 × 242"]),
    "another size at once": (lambda c: resized(c, 0), ["0000.png", "128 × 121", "256 × 242"]),
    "another camera": (
        lambda c: c.set("camera.yaml", "image_size", [640, 480]), ["0000.png", "256 × 242", "640 × 480"],
    ),
    "no video": (lambda c: c.set("follow.yaml", "video", "absent"), ["absent", "no such file or folder"]),
    "an empty folder": (
        lambda c: [(c.folder / "none").mkdir(), c.set("follow.yaml", "video", "none")], ["none", "no images"],
    ),
    "no rate": (lambda c: c.set("follow.yaml", "rate", None), ["follow.yaml", "rate", "missing"]),
    "a video of noise": (
        lambda c: [(c.folder / "v.mp4").write_bytes(b"noise" * 99), c.set("follow.yaml", "video", "v.mp4")],
        ["v.mp4", "cannot be read as a video"],
    ),
    "no odometry": (
        lambda c: c.set("follow.yaml", "odometry", "absent.csv"), ["absent.csv", "cannot be read"],
    ),
    "odometry with a gap": (
        lambda c: odometry(c, *(f"{k},0,0,0" for k in range(FRAMES) if k != 7)), ["odometry.csv", "no row for frame 7"],
    ),
    "no such camera": (
        lambda c: c.set("follow.yaml", "video", "tcp://127.0.0.1:9"), ["tcp://127.0.0.1:9", "cannot be opened"],
    ),
    "an unknown key": (lambda c: c.set("follow.yaml", "vidio", 1), ["'vidio'", "'video'"]),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "words"), REFUSED.values(), ids=REFUSED)
def test_it_is_refused_in_one_line(
    spoil: Callable[[Clip], object], words: list[str], clip: Clip, command: Command, tmp_path: Path
) -> None:
    spoil(clip)
    before = set(tmp_path.rglob("*"))
    assert_one_line_error(command(), *words)
    assert set(tmp_path.rglob("*")) == before, "something is left behind"


# --- coasted through -----------------------------------------------------------------------------------------------


def track(tmp_path: Path) -> list[dict[str, str]]:
    with (tmp_path / "out" / "track.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def filled(clip: Clip, grey: int) -> None:
    for frame in range(FIRST, LAST + 1):
        cv2.imwrite(str(clip.picture(frame)), np.full((242, 256), grey, np.uint8))


def frozen(clip: Clip) -> None:
    for frame in range(FIRST, LAST + 1):
        shutil.copy(clip.picture(FIRST - 1), clip.picture(frame))


def cut(clip: Clip) -> None:
    for frame in range(FIRST, LAST + 1):
        content = clip.picture(frame).read_bytes()
        clip.picture(frame).write_bytes(content[: len(content) // 2])


BLIND: dict[str, Callable[[Clip], object]] = {
    "black": lambda c: filled(c, 0),
    "white": lambda c: filled(c, 255),
    "frozen": frozen,
    "damaged images": cut,
    "damaged video": lambda c: c.video(spoilt=range(FIRST, LAST + 1)),
}


@pytest.mark.parametrize("spoil", BLIND.values(), ids=BLIND)
def test_it_coasts_and_goes_on(spoil: Callable[[Clip], object], clip: Clip, command: Command, tmp_path: Path) -> None:
    """A third of a second without a picture: never reported as tracking, with a reason, and found again."""
    spoil(clip)
    status, stdout, stderr = command()
    assert status == 0, stderr
    rows = track(tmp_path)
    assert [int(r["frame"]) for r in rows] == list(range(FRAMES))
    blind = rows[FIRST : LAST + 1]
    assert {r["status"] for r in blind} == {"coasting"}
    assert all(r["reason"] for r in blind)
    assert {r["status"] for r in rows[:FIRST]} == {"tracking"}
    assert {r["status"] for r in rows[LAST + 3 :]} == {"tracking"}
    for row in (rows[FIRST - 1], rows[-1]):
        assert float(row["z_m"]) == pytest.approx(tiny_chase.truth(int(row["frame"]))[2], rel=0.01)
    (episode,) = json.loads((tmp_path / "out" / "summary.json").read_text())["episodes"]
    assert episode["first_frame"] == FIRST and LAST <= episode["last_frame"] <= LAST + 2
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Frames that were not tracked" in page and episode["reason"] in page


def test_damage_is_named(clip: Clip, command: Command) -> None:
    cut(clip)
    _, _, stderr = command()
    assert f"{FIRST:04d}.png: cannot be decoded and left out" in stderr


def test_times_that_jump_are_named(clip: Clip, command: Command, tmp_path: Path) -> None:
    """Four frames dropped on the way."""
    times = [k for k in range(FRAMES + 4) if not FIRST <= k < FIRST + 4]
    clip.video(times)
    status, _, stderr = command()
    assert status == 0
    assert re.search(rf"frames {FIRST - 1} and {FIRST} lie 0\.33\d s apart instead of 0\.06\d s", stderr)
    rows = track(tmp_path)
    last = tiny_chase.truth(times[-1])[2]
    assert rows[-1]["status"] == "tracking" and float(rows[-1]["z_m"]) == pytest.approx(last, rel=0.01)


def test_a_video_cut_short_is_followed_as_far_as_it_goes(clip: Clip, command: Command, tmp_path: Path) -> None:
    clip.video()
    path = clip.folder / "video.mkv"
    path.write_bytes(path.read_bytes()[: int(0.7 * path.stat().st_size)])
    status, _, stderr = command()
    assert status == 0 and "video.mkv: is cut short" in stderr
    assert 0.5 * FRAMES < len(track(tmp_path)) < 0.8 * FRAMES
