"""Input that cannot be measured, through the command line: status 2, one plain line, nothing left behind."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import yaml
from damaged_inputs import Folder
from run_command import COMMAND, ENVIRONMENT, Done, assert_one_line_error, paceline
from selection import slow_after

from paceline.documents.loading import load_rig
from paceline.simulation.stereo.clip import Scene, Vehicle, render, write

pytestmark = pytest.mark.usefixtures("unrendered_plots")

Case = tuple[Callable[["Clip"], object], list[str]]
Command = Callable[..., Done]


class Clip(Folder):
    """A copy of a clip's folder that a case spoils."""

    def get(self, key: str) -> Any:
        place = yaml.safe_load((self.folder / "clip.yaml").read_text())
        for k in key.split("."):
            place = place[int(k) if k.isdecimal() else k]
        return place

    def replace(self, image: str, content: bytes) -> None:
        (self.folder / image).write_bytes(content)

    def image(self, name: str) -> np.ndarray:
        return np.asarray(cv2.imread(str(self.folder / name), cv2.IMREAD_UNCHANGED))

    def video(self, side: str, size: tuple[int, int] = (640, 480), times: tuple[int, ...] = (0, 1, 2, 3, 4)) -> Path:
        """A video of that side instead of its images."""
        path = self.folder / f"{side}.mkv"
        with av.open(path, "w") as container:
            stream = container.add_stream("ffv1", rate=5)
            stream.width, stream.height, stream.pix_fmt = *size, "gray"
            for k in times:
                image = cv2.resize(self.image(f"{side}/{k:04d}.png"), size)
                frame = av.VideoFrame.from_ndarray(image, format="gray")
                frame.pts = k
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        self.set("clip.yaml", side, path.name)
        return path


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    vehicle = Vehicle("v0", 18.0, start_distance=50.0)
    scene = Scene(31, (vehicle,), image_size=(640, 480), focal=1400.0, frames=5)
    return write(render(scene), tmp_path_factory.mktemp("clip")).parent


@pytest.fixture
def clip(original: Path, tmp_path: Path) -> Clip:
    return Clip.copied(original, tmp_path / "clip")


@pytest.fixture
def command(tmp_path: Path) -> Command:
    """`paceline speed CLIP -o OUT`."""
    return lambda clip, out=tmp_path / "out": paceline("speed", clip, "-o", out)


@pytest.fixture
def refused(command: Command, tmp_path: Path) -> Callable[..., str]:
    """Runs the command on a clip that it has to refuse; gives the line that it says."""

    def run(clip: Path, **options: Path) -> str:
        before = set(tmp_path.rglob("*"))
        done = command(clip, **options)
        assert_one_line_error(done)
        assert set(tmp_path.rglob("*")) == before, "something is left behind"
        return done.stderr

    return run


# --- images --------------------------------------------------------------------------------------------------------


def cut(clip: Clip, image: str, share: float) -> None:
    content = (clip.folder / image).read_bytes()
    clip.replace(image, content[: int(share * len(content))])


def resized(clip: Clip, image: str) -> None:
    cv2.imwrite(str(clip.folder / image), cv2.resize(clip.image(image), (320, 240)))


def without(clip: Clip, folder: str) -> None:
    shutil.rmtree(clip.folder / folder)


def emptied(clip: Clip, folder: str) -> None:
    without(clip, folder)
    (clip.folder / folder).mkdir()


def unreadable(clip: Clip, image: str) -> None:
    """A link to itself; permissions do not bind everybody."""
    (clip.folder / image).unlink()
    (clip.folder / image).symlink_to(clip.folder / image)


def piped(clip: Clip, file: str) -> None:
    """A pipe that nobody writes to."""
    (clip.folder / file).unlink(missing_ok=True)
    os.mkfifo(clip.folder / file)


def linked(clip: Clip, file: str, to: str) -> None:
    (clip.folder / file).unlink()
    (clip.folder / file).symlink_to(to)


def unnumbered(clip: Clip) -> None:
    (clip.folder / "left/0002.png").unlink()
    for k, name in ((0, "a"), (1, "b"), (3, "c"), (4, "d")):
        (clip.folder / f"left/{k:04d}.png").rename(clip.folder / f"left/{name}.png")


def swapped(clip: Clip) -> None:
    left, right = clip.get("vehicles.0.left"), clip.get("vehicles.0.right")
    clip.set("clip.yaml", "vehicles.0.left", right)
    clip.set("clip.yaml", "vehicles.0.right", left)


def swapped_rig(clip: Clip) -> None:
    rig = yaml.safe_load((clip.folder / "rig.yaml").read_text())
    R, t = np.array(rig["rotation"]), np.array(rig["translation"])
    rig |= {"left": rig["right"], "right": rig["left"], "rotation": R.T.tolist(), "translation": (-R.T @ t).tolist()}
    (clip.folder / "rig.yaml").write_text(yaml.safe_dump(rig))


IMAGES: dict[str, Case] = {
    "missing folder": (lambda c: without(c, "left"), ["clip/left", "no such file or folder", "expected a folder"]),
    "empty folder": (lambda c: emptied(c, "right"), ["clip/right", "no images", "at least two"]),
    "a pattern of nothing": (lambda c: c.set("clip.yaml", "left", "left/x*.png"), ["left/x*.png", "no images"]),
    "one image only": (lambda c: c.set("clip.yaml", "left", "left/*3.png"), ["left/*3.png", "only one image"]),
    "one image less, unnumbered": (unnumbered, ["clip/left", "4 images", "5", "expected as many"]),
    "empty first image": (lambda c: c.replace("left/0000.png", b""), ["left/0000.png", "is empty"]),
    "empty later image": (lambda c: c.replace("right/0003.png", b""), ["right/0003.png", "is empty"]),
    "truncated first image": (lambda c: cut(c, "left/0000.png", 0.5), ["left/0000.png", "truncated"]),
    "truncated later image": (lambda c: cut(c, "left/0004.png", 0.95), ["left/0004.png", "truncated"]),
    "no image at all": (lambda c: c.replace("right/0002.png", b"hello\n" * 50), ["right/0002.png", "not an image"]),
    "a pipe for an image": (lambda c: piped(c, "left/0002.png"), ["left/0002.png", "is a pipe"]),
    "a device for an image": (lambda c: linked(c, "right/0001.png", "/dev/zero"), ["right/0001.png", "a device"]),
    "unreadable image": (lambda c: unreadable(c, "left/0003.png"), ["left/0003.png", "cannot be read"]),
    "first of another size": (lambda c: resized(c, "left/0000.png"), ["left/0000.png", "320 × 240", "640 × 480"]),
    "later of another size": (lambda c: resized(c, "right/0003.png"), ["right/0003.png", "320 × 240", "640 × 480"]),
    "rig of another size": (
        lambda c: c.set("rig.yaml", "right.image_size", [1280, 480]),
        ["right/0000.png", "640 × 480", "1280 × 480"],
    ),
    "floating point": (
        lambda c: [
            cv2.imwrite(str(c.folder / f"left/{k:04d}.tiff"), c.image(f"left/{k:04d}.png").astype(np.float32))
            and (c.folder / f"left/{k:04d}.png").unlink()
            for k in range(5)
        ],
        ["left/0000.tiff", "float32", "expected integers"],
    ),
    "values beyond the bit depth": (
        lambda c: [
            c.set("clip.yaml", "bit_depth", 12),
            cv2.imwrite(str(c.folder / "left/0002.png"), np.full((480, 640), 5000, np.uint16)),
        ],
        ["left/0002.png", "5000", "bit_depth 12"],
    ),
}

# --- videos --------------------------------------------------------------------------------------------------------


def videos(clip: Clip) -> Path:
    clip.set("clip.yaml", "rate", None)
    clip.video("right")
    return clip.video("left")


def video_cut(clip: Clip, share: float) -> None:
    path = videos(clip)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def video_of_another_size(clip: Clip) -> None:
    videos(clip)
    clip.video("left", (320, 240))


def videos_apart(clip: Clip) -> None:
    videos(clip)
    with av.open(clip.folder / "right.mkv") as source, av.open(clip.folder / "late.mkv", "w") as late:
        stream = late.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.pts is not None and packet.dts is not None:
                packet.stream, packet.pts, packet.dts = stream, packet.pts + 9000, packet.dts + 9000
                late.mux(packet)
    clip.set("clip.yaml", "right", "late.mkv")


VIDEOS: dict[str, Case] = {
    "a pipe": (lambda c: piped(c, videos(c).name), ["left.mkv", "is a pipe"]),
    "missing": (lambda c: videos(c).unlink(), ["left.mkv", "no such file"]),
    "empty": (lambda c: videos(c).write_bytes(b""), ["left.mkv", "cannot be read as a video"]),
    "no video": (lambda c: videos(c).write_bytes(b"no" * 999), ["left.mkv", "cannot be read as a video"]),
    "truncated to its head": (lambda c: video_cut(c, 0.02), ["left.mkv"]),
    "of another size": (video_of_another_size, ["left.mkv", "320 × 240", "640 × 480"]),
    "beside images": (lambda c: c.video("left"), ["clip.yaml", "right has no time stamps", "expected times"]),
    "at other times": (videos_apart, ["left", "right", "no two frames lie within"]),
}

# --- the rig -------------------------------------------------------------------------------------------------------

RIG: dict[str, Case] = {
    "missing": (lambda c: (c.folder / "rig.yaml").unlink(), ["rig.yaml", "no such file"]),
    "a pipe": (lambda c: piped(c, "rig.yaml"), ["rig.yaml", "is a pipe"]),
    "empty": (lambda c: c.replace("rig.yaml", b""), ["rig.yaml", "expected the keys left, right"]),
    "no rotation": (lambda c: c.set("rig.yaml", "rotation.0.1", 0.4), ["rig.yaml", "rotation", "is not a rotation"]),
    "a reflection": (
        lambda c: c.set("rig.yaml", "rotation", np.diag([1.0, 1.0, -1.0]).tolist()),
        ["rig.yaml", "rotation", "reflection"],
    ),
    "negative focal length": (
        lambda c: c.set("rig.yaml", "left.K.0.0", -1400.0), ["rig.yaml", "left.K", "positive focal lengths", "-1400"],
    ),
    "not a number": (lambda c: c.set("rig.yaml", "right.K.1.2", float("nan")), ["rig.yaml", "right.K", "nan"]),
    "infinite": (lambda c: c.set("rig.yaml", "translation.2", float("inf")), ["rig.yaml", "translation", "inf"]),
    "no baseline": (lambda c: c.set("rig.yaml", "translation", [0, 0, 0]), ["rig.yaml", "translation", "same place"]),
    "both views the same": (
        lambda c: c.set("clip.yaml", "right", "left"), ["left and right", "the same picture in both", "two cameras"],
    ),
    "swapped cameras": (swapped_rig, ["rig.yaml", "translation", "left and right are swapped"]),
    "unknown key": (lambda c: c.set("rig.yaml", "left.distorsion", []), ["'distorsion'", "'distortion'"]),
    "negative uncertainty": (
        lambda c: c.set("rig.yaml", "uncertainty", {"focal_length_px": -1}),
        ["rig.yaml", "uncertainty.focal_length_px", "at least 0"],
    ),
}  # fmt: skip

# --- paths ---------------------------------------------------------------------------------------------------------


PATHS: dict[str, Case] = {
    "one view only": (lambda c: c.set("clip.yaml", "paths.lane0.right", None), ["paths.lane0", "left view only"]),
    "far beside the vehicle": (
        lambda c: c.set("clip.yaml", "paths.lane0.lateral_offset", -1850.0), ["lane0", "beside vehicle v0", "metres"],
    ),
    "no view": (lambda c: c.set("clip.yaml", "paths.lane0", {"shape": "line"}), ["paths.lane0", "not drawn"]),
    "two points for a curve": (
        lambda c: [c.set("clip.yaml", "paths.lane0.shape", "curve"),
                   c.set("clip.yaml", "paths.lane0.left", [[300, 400], [200, 460]])],
        ["paths.lane0.left", "at least four"],
    ),
    "all points the same": (
        lambda c: c.set("clip.yaml", "paths.lane0.left", [[300, 400]] * 3), ["paths.lane0.left", "same place"],
    ),
    "not a number": (
        lambda c: c.set("clip.yaml", "paths.lane0.left.1", [float("nan"), 3.0]), ["paths.lane0.left", "nan", "place 1"],
    ),
    "unknown path": (
        lambda c: c.set("clip.yaml", "vehicles.0.path", "lane1"), ["vehicles[0].path", "'lane1'", "'lane0'"],
    ),
    "wild offset": (
        lambda c: c.set("clip.yaml", "paths.lane0.lateral_offset", float("nan")), ["paths.lane0.lateral_offset", "nan"],
    ),
}  # fmt: skip

# --- vehicles ------------------------------------------------------------------------------------------------------


def corners(clip: Clip, change: Callable[[np.ndarray], np.ndarray], *sides: str) -> None:
    for side in sides:
        clip.set("clip.yaml", f"vehicles.0.{side}", change(np.array(clip.get(f"vehicles.0.{side}"))).tolist())


VEHICLES: dict[str, Case] = {
    "crosses itself": (lambda c: corners(c, lambda q: q[[0, 2, 1, 3]], "left"), ["vehicles[0].left", "cross"]),
    "counter-clockwise": (lambda c: corners(c, lambda q: q[::-1], "right"), ["vehicles[0].right", "counter-clockwise"]),
    "outside": (lambda c: corners(c, lambda q: q + [400, 0], "left"), ["vehicles[0].left", "outside", "640 × 480"]),
    "tiny": (
        lambda c: corners(c, lambda q: q.mean(0) + 0.1 * (q - q.mean(0)), "left"), ["vehicles[0].left", "too small"],
    ),
    "behind the cameras": (
        lambda c: corners(c, lambda q: q + [80, 0], "right"), ["vehicles[0]", "behind the cameras", "swapped"],
    ),
    "at different heights": (
        lambda c: corners(c, lambda q: q + [0, 60], "right"), ["vehicles[0]", "views disagree"],
    ),
    "left and right swapped": (swapped, ["vehicles[0]", "swapped"]),
    "not a number": (
        lambda c: c.set("clip.yaml", "vehicles.0.left.2", [300.0, float("nan")]), ["vehicles[0].left", "nan"],
    ),
    "three corners": (lambda c: corners(c, lambda q: q[:3], "left"), ["vehicles[0].left", "four"]),
    "a frame beyond the clip": (
        lambda c: c.set("clip.yaml", "vehicles.0.frame", 5), ["clip.yaml", "v0", "frame 5", "0 to 4"],
    ),
    "a negative frame": (lambda c: c.set("clip.yaml", "vehicles.0.frame", -1), ["vehicles[0].frame", "at least 0"]),
    "a wild guess": (lambda c: c.set("clip.yaml", "vehicles.0.speed", 400), ["vehicles[0].speed", "at most 150"]),
    "unknown key": (lambda c: c.set("clip.yaml", "vehicles.0.framme", 1), ["'framme'", "did you mean 'frame'?"]),
    "two of one name": (
        lambda c: c.set("clip.yaml", "vehicles", c.get("vehicles") * 2), ["vehicles[1].id", "'v0' occurs twice"],
    ),
}  # fmt: skip

# --- times and keys ------------------------------------------------------------------------------------------------


def times(clip: Clip, *rows: str, header: str = "frame,left_s,right_s") -> None:
    clip.set("clip.yaml", "rate", None)
    clip.set("clip.yaml", "times", "times.csv")
    (clip.folder / "times.csv").write_text("\n".join([header, *rows]) + "\n")


def clock(*times: float) -> list[str]:
    return [f"{k},{t},{t}" for k, t in enumerate(times)]


CLOCK: dict[str, Case] = {
    "zero rate": (lambda c: c.set("clip.yaml", "rate", 0), ["clip.yaml", "rate", "at least 0.1", "found 0"]),
    "negative rate": (lambda c: c.set("clip.yaml", "rate", -5), ["clip.yaml", "rate", "found -5"]),
    "wild rate": (lambda c: c.set("clip.yaml", "rate", 1e6), ["clip.yaml", "rate", "at most 10000"]),
    "no number": (lambda c: c.set("clip.yaml", "rate", "fast"), ["clip.yaml", "rate", "expected a number", "'fast'"]),
    "not a number": (lambda c: c.set("clip.yaml", "rate", float("nan")), ["clip.yaml", "rate", "found nan"]),
    "neither rate nor times": (lambda c: c.set("clip.yaml", "rate", None), ["clip.yaml", "rate", "missing"]),
    "a pipe for times.csv": (lambda c: [times(c), piped(c, "times.csv")], ["times.csv", "is a pipe"]),
    "no times.csv": (lambda c: [times(c), (c.folder / "times.csv").unlink()], ["times.csv", "cannot be read"]),
    "backwards": (lambda c: times(c, *clock(0.8, 0.6, 0.4, 0.2, 0)), ["times.csv", "left_s", "do not increase"]),
    "standing still": (lambda c: times(c, *clock(*[0.2] * 5)), ["times.csv", "left_s", "do not increase"]),
    "too few": (lambda c: times(c, *clock(0, 0.2)), ["times.csv", "2 rows", "5 left"]),
    "no times": (lambda c: times(c, *clock(0, 0.2, 0.4, 0.6), "4,soon,0.8"), ["times.csv", "frame 4", "three numbers"]),
    "infinite": (lambda c: times(c, *clock(0, 0.2, 0.4, 0.6, np.inf)), ["times.csv", "frame 4", "finite"]),
    "milliseconds": (lambda c: times(c, *clock(0, 200, 400, 600, 800)), ["times.csv", "200 apart", "milliseconds?"]),
    "nanoseconds": (lambda c: times(c, *clock(*(1.7e18 + 2e8 * np.arange(5)))), ["times.csv", "are these nanosec"]),
    "another header": (lambda c: times(c, header="f,l,r"), ["times.csv", "'frame,left_s,right_s'"]),
    "unknown key": (lambda c: c.set("clip.yaml", "vehicels", []), ["'vehicels'", "did you mean 'vehicles'?"]),
    "a missing key": (lambda c: c.set("clip.yaml", "right", None), ["clip.yaml", "right", "missing"]),
    "no YAML": (lambda c: c.replace("clip.yaml", b"left: [1,\n"), ["clip.yaml", "line"]),
    "no text": (lambda c: c.replace("clip.yaml", b"\xff\xfe\x00"), ["clip.yaml", "not a text file"]),
}

CASES = {
    f"{group}: {name}": case
    for group, cases in {
        "images": IMAGES, "video": VIDEOS, "rig": RIG, "path": PATHS, "vehicle": VEHICLES, "clip": CLOCK,
    }.items()
    for name, case in cases.items()
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "words"), CASES.values(), ids=CASES)
def test_it_is_refused_in_one_line(
    spoil: Callable[[Clip], object], words: list[str], clip: Clip, refused: Callable[..., str]
) -> None:
    spoil(clip)
    line = refused(clip.folder / "clip.yaml")
    for word in words:
        assert word in line


def test_unspoilt_it_is_measured(original: Path, command: Command) -> None:
    status, stdout, _ = command(original)
    assert status == 0 and "measured" in stdout


@pytest.mark.parametrize("shape", slow_after(1, ["line", "curve"]))
def test_a_path_along_the_epipolar_lines_is_left_out(shape: str, clip: Clip, command: Command, tmp_path: Path) -> None:
    """A line that runs sideways through both pictures: the vehicle is measured without it, unless it is insisted on."""
    rig, x = load_rig(clip.folder / "rig.yaml"), np.linspace(100, 600, 12)
    left = np.column_stack([x, {"line": 300 + 0 * x, "curve": 300 + 1e-5 * (x - 300) ** 2}[shape]])
    epipolar = np.column_stack([left, np.ones_like(x)]) @ rig.fundamental.T
    right = np.column_stack([x - 30, -(epipolar[:, 0] * (x - 30) + epipolar[:, 2]) / epipolar[:, 1]])
    clip.set("clip.yaml", "paths.lane0", {"shape": shape, "left": left.tolist(), "right": right.tolist()})
    done = paceline("speed", clip.folder, "-o", tmp_path / "out", "--motion", shape)
    assert_one_line_error(done)
    for word in ("clip.yaml", "path lane0", "parallel to the epipolar lines"):
        assert word in done.stderr
    status, stdout, _ = command(clip.folder)
    assert status == 0 and "measured" in stdout
    (notice,) = json.loads((tmp_path / "out" / "summary.json").read_text())["notices"]
    assert notice.startswith("path lane0: ") and notice.endswith("; its vehicles are measured without it")


@pytest.mark.parametrize("grey", [0, 255])
def test_blank_pictures_are_rejected_with_a_reason(grey: int, clip: Clip, command: Command) -> None:
    for file in clip.folder.glob("*/*.png"):
        cv2.imwrite(str(file), np.full((480, 640), grey, np.uint8))
    status, stdout, _ = command(clip.folder)
    assert status == 1 and "rejected: " in stdout


def test_cameras_one_behind_the_other_are_rejected_in_time(clip: Clip, command: Command) -> None:
    """Regions that fill the sky must not be smoothed for minutes."""
    clip.set("rig.yaml", "translation", [0.0, 0.0, -0.5])
    begun = time.monotonic()
    status, stdout, _ = command(clip.folder)
    assert status in (1, 2) and "measured" not in stdout
    assert time.monotonic() - begun < 60.0


@pytest.mark.parametrize("share", slow_after(1, [0.6, 0.9]))
def test_a_video_cut_short_is_measured_as_far_as_it_goes(share: float, clip: Clip, command: Command) -> None:
    video_cut(clip, share)
    status, stdout, stderr = command(clip.folder)
    assert status in (0, 1) and ("measured" in stdout or "rejected: " in stdout)
    assert "left.mkv: is cut short" in stderr


# --- the output folder ---------------------------------------------------------------------------------------------


def test_a_file_in_place_of_the_folder(original: Path, refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    line = refused(original)
    assert "out" in line and "is a file" in line
    assert (tmp_path / "out").read_text() == "mine"


def test_a_folder_in_place_of_a_file(original: Path, refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "out" / "report.html").mkdir(parents=True)
    assert "a folder is in the way" in refused(original)


def test_a_file_in_place_of_a_folder_inside(original: Path, refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "plots").write_text("mine")
    line = refused(original)
    assert "a file is in the way" in line and (tmp_path / "out" / "plots").read_text() == "mine"


def test_a_name_too_long(original: Path, refused: Callable[..., str], tmp_path: Path) -> None:
    assert "cannot be written" in refused(original, out=tmp_path / ("o" * 300))


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_a_folder_where_nothing_can_be_made(original: Path, refused: Callable[..., str]) -> None:
    line = refused(original, out=Path("/proc/paceline/out"))
    assert "/proc/paceline/out" in line and "cannot be written" in line


def test_a_full_disk(
    original: Path, refused: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full when the page is written, the last of all."""
    write_text = Path.write_text

    def full(self: Path, *arguments: Any, **keywords: Any) -> int:
        if self.suffix == ".html":
            raise OSError(28, "No space left on device", str(self))
        return write_text(self, *arguments, **keywords)

    monkeypatch.setattr(Path, "write_text", full)
    line = refused(original)
    assert str(tmp_path / "out") in line and "No space left on device" in line


def test_an_earlier_output_survives_a_later_failure(
    original: Path, clip: Clip, refused: Callable[..., str], tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "summary.json").write_text("earlier")
    cut(clip, "left/0004.png", 0.5)
    refused(clip.folder)
    assert (tmp_path / "out" / "summary.json").read_text() == "earlier"


@pytest.mark.parametrize(
    ("error", "status", "line"), [("KeyboardInterrupt", 130, "interrupted"), ("SystemExit", 143, "")]
)
def test_an_interrupt_inside_a_callback_comes_again(tmp_path: Path, error: str, status: int, line: str) -> None:
    """As where LLVM calls Python while Numba compiles: nothing can be raised there."""
    (tmp_path / "interrupted.py").write_text(
        "import ctypes, time\n"
        "from paceline import cli\n"
        "def callback():\n"
        f"    raise {error}\n"
        "def app(**options):\n"
        "    try:\n"
        "        ctypes.CFUNCTYPE(None)(callback)()\n"
        "        time.sleep(20)\n"
        "    except KeyboardInterrupt:\n"
        "        return cli.EXIT_INTERRUPTED\n"
        "cli.app = app\n"
        "cli.main()\n"
    )
    command = [sys.executable, "interrupted.py"]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (status, f"paceline: {line}\n" if line else "")


def test_an_interrupt_inside_an_exec_ends_with_its_status(tmp_path: Path) -> None:
    """As where dataclasses are made, while modules are imported: by ``python -m`` the signal itself would end it."""
    (tmp_path / "interrupted.py").write_text(
        "from paceline import cli\n"
        "def app(**options):\n"
        "    try:\n"
        "        exec('raise KeyboardInterrupt')\n"
        "    except KeyboardInterrupt:\n"
        "        return cli.EXIT_INTERRUPTED\n"
        "cli.app = app\n"
        "cli.main()\n"
    )
    command = [sys.executable, "-m", "interrupted"]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (130, "paceline: interrupted\n")


@pytest.mark.parametrize(("number", "moment"), slow_after(1, [(signal.SIGINT, 1.0), (signal.SIGTERM, 0.0)]))
def test_an_interrupt_leaves_all_or_nothing(original: Path, tmp_path: Path, number: int, moment: float) -> None:
    """At any moment after the work has begun; what stands in the folder is whole if it is there."""
    out = tmp_path / "work" / "out"
    out.parent.mkdir()
    command = [*COMMAND, "speed", str(original), "-o", str(out), "--particles", "20000"]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not list(out.parent.iterdir()) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(moment)
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=60)
    assert "Traceback" not in stderr
    assert not [p for p in out.parent.iterdir() if p != out]
    if out.exists():
        expected = {"estimates.csv", "summary.json", "report.html", "overlay.mp4", "plots"}
        assert {p.name for p in out.iterdir()} == expected
    else:
        assert process.returncode == 128 + number
        assert stderr == ("paceline: interrupted\n" if number == signal.SIGINT else "")
