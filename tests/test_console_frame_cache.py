"""Pictures in any order are those of reading the recording through, whatever holds them."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selection import slow_after
from tiny_clips import put_clip

from paceline.console.frames.frame_cache import FrameCache
from paceline.errors import UnusableInput

FRAMES, WIDTH, HEIGHT = 40, 160, 120
KINDS = {
    "b-frames.mp4": ("libx264", {"bf": "3", "g": "12", "x264-params": "scenecut=0"}),
    "open.mkv": ("libx264", {"bf": "2", "g": "10", "x264-params": "open-gop=1:scenecut=0"}),
    "open.ts": ("libx264", {"bf": "2", "g": "10", "x264-params": "open-gop=1:scenecut=0"}),
    "refresh.mp4": ("libx264", {"x264-params": "intra-refresh=1:keyint=10:scenecut=0"}),
    "old.avi": ("mpeg4", {"g": "12"}),
    "every.mkv": ("ffv1", {}),
}


def write_video(file: Path, codec: str, options: dict[str, str]) -> None:
    rng = np.random.default_rng(7)
    ground = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, 2 * WIDTH)).astype(np.float32), (0, 0), 3)
    ground = (ground - ground.min()) / np.ptp(ground) * 255
    with av.open(file, "w") as container:
        stream = container.add_stream(codec, rate=25, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray" if codec == "ffv1" else "yuv420p"
        for k in range(FRAMES):
            picture = av.VideoFrame.from_ndarray(ground[:, 3 * k : 3 * k + WIDTH].astype(np.uint8), format="gray")
            picture.pts, picture.time_base = k, Fraction(1, 25)
            container.mux(stream.encode(picture.reformat(format=stream.pix_fmt)))
        container.mux(stream.encode())


def put_videos(folder: Path, name: str) -> Path:
    clip = put_clip(folder)
    rig = (clip / "rig.yaml").read_text()
    (clip / "rig.yaml").write_text(rig.replace("640", str(WIDTH)).replace("480", str(HEIGHT)))
    write_video(clip / name, *KINDS[name])
    (clip / f"right-{name}").write_bytes((clip / name).read_bytes())
    (clip / "clip.yaml").write_text(f"left: {name}\nright: right-{name}\nrig: rig.yaml\n")
    return clip / "clip.yaml"


@pytest.mark.parametrize("name", slow_after(3, KINDS))
def test_any_order_shows_the_same_pictures(tmp_path: Path, name: str) -> None:
    file = put_videos(tmp_path.resolve(), name)
    pictures = FrameCache(tmp_path.resolve()).open(file)
    assert pictures.frames == list(range(FRAMES))
    through = [frame.left for frame in pictures.recording]
    rng = np.random.default_rng(1)
    order = [0, 1, 2, FRAMES - 1, 11, 12, 13, 9, 10, 20, 19, 0, *rng.integers(0, FRAMES, 12).tolist()]
    for frame in order:
        for view in (0, 1):
            assert np.array_equal(pictures.picture(view, frame), through[frame]), (frame, view)


def test_missing_frames_are_reported(tmp_path: Path) -> None:
    pictures = FrameCache(tmp_path.resolve()).open(put_clip(tmp_path.resolve()) / "clip.yaml")
    for frame in (-1, 5, 10**9):
        with pytest.raises(UnusableInput, match=f"frame {frame}: is not in the recording"):
            pictures.picture(0, frame)


def test_a_damaged_frame_is_reported_and_the_others_are_shown(tmp_path: Path) -> None:
    clip = put_clip(tmp_path.resolve())
    gallery = FrameCache(tmp_path.resolve())
    (clip / "right" / "0002.png").write_bytes(b"no picture")
    pictures = gallery.open(clip / "clip.yaml")
    for frame in (1, 2, 3, 2):
        if frame == 2:
            with pytest.raises(UnusableInput, match=r"right/0002.png: is truncated"):
                pictures.picture(1, frame)
        else:
            assert decoded(gallery.jpeg(clip / "clip.yaml", 1, frame)).shape == (480, 640)
    assert decoded(gallery.thumbnail(clip / "clip.yaml")).shape == (240, 320)


def test_files_that_change_on_disk_are_reloaded(tmp_path: Path) -> None:
    clip = put_clip(tmp_path.resolve())
    gallery = FrameCache(tmp_path.resolve())
    before = gallery.open(clip / "clip.yaml")
    assert gallery.open(clip / "clip.yaml") is before
    (clip / "rig.yaml").write_text((clip / "rig.yaml").read_text() + "\n")
    assert gallery.open(clip / "clip.yaml") is not before


def decoded(jpeg: bytes) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)
