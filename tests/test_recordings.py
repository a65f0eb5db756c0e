from __future__ import annotations

import dataclasses
import shutil
import struct
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.cameras import Camera, StereoRig
from paceline.documents.loading import Clip
from paceline.errors import UnusableInput
from paceline.recordings import image_sources
from paceline.recordings.image_sources import KeptImages, VideoFile, open_source, read_image_file
from paceline.recordings.stereo import open_recording, pair_by_time
from paceline.recordings.time_stamps import longest_increasing_subsequence
from paceline.simulation.video import write_h264

W, H = 64, 48
K = np.array([[100.0, 0, 31.5], [0, 100.0, 23.5], [0, 0, 1]])
RIG = StereoRig(Camera((W, H), K), Camera((W, H), K), np.eye(3), np.array([-0.5, 0, 0]))


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def picture(seed, dtype=np.uint8, channels=()):
    rng = np.random.default_rng(seed)
    return rng.integers(0, np.iinfo(dtype).max, (H, W, *channels), dtype, endpoint=True)


def write_folder(side, numbers, first_seed=0, name="{:04d}.png"):
    """Images whose content depends on their number, so that a pair can be recognised."""
    Path(side).mkdir(exist_ok=True)
    for number in numbers:
        cv2.imwrite(str(Path(side) / name.format(number)), picture(first_seed + number))


def write_video(path, pts, pictures, codec="ffv1", pixels="gray", time_base=Fraction(1, 1000), options=None):
    with av.open(str(path), "w", options=options or {}) as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = W, H, pixels
        stream.codec_context.time_base = time_base
        for t, image in zip(pts, pictures, strict=True):
            stored = "rgb24" if image.ndim == 3 else "gray" if image.dtype == np.uint8 else "gray16le"
            frame = av.VideoFrame.from_ndarray(image, format=stored)
            frame.pts, frame.time_base = t, time_base
            container.mux(stream.encode(frame.reformat(format=pixels)))
        container.mux(stream.encode(None))


def restamp(path, stamps):
    """Writes other time stamps (ms) of frames into a Matroska video, as a recorder with a bad clock does."""
    with av.open(path) as container:
        packets = [(packet.pts, bytes(packet)) for packet in container.demux(video=0) if packet.size]
    data = bytearray(Path(path).read_bytes())
    for frame, stamp in stamps.items():
        pts, content = packets[frame]
        assert data.count(content) == 1
        at = data.index(content) - 3  # a block's time in its cluster, before its flags
        (relative,) = struct.unpack_from(">h", data, at)
        struct.pack_into(">h", data, at, relative + stamp - pts)
    Path(path).write_bytes(data)


def clip(left="left", right="right", rate=5.0, **more):
    base = Clip(
        path=Path("clip.yaml"), left=Path(left), right=Path(right), rate=rate, times=None, tolerance=None,
        bit_depth=None, rig=RIG, paths={}, vehicles=[], addresses=(str(left), str(right)),
    )  # fmt: skip
    return dataclasses.replace(base, **more)


def refusal(work):
    with pytest.raises(UnusableInput) as caught:
        work()
    return str(caught.value)


def read(source, frames=(0,)):
    return list(open_source(Path(source)).read(list(frames)))


# --- folders -------------------------------------------------------------------------------------------------------


def test_a_pair_of_folders():
    write_folder("left", range(6))
    write_folder("right", range(6), first_seed=100)
    recording = open_recording(clip())
    assert len(recording) == 6 and recording.image_size == (W, H) and recording.notices == []
    np.testing.assert_allclose(recording.times, np.arange(6) / 5)
    np.testing.assert_array_equal(recording.skews, 0)
    for _ in range(2):  # as often as needed
        frames = list(recording)
        assert [f.index for f in frames] == list(range(6))
        assert [f.time for f in frames] == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])
        for f in frames:
            np.testing.assert_array_equal(f.left, picture(f.index))
            np.testing.assert_array_equal(f.right, picture(100 + f.index))
            assert f.left.dtype == np.float32 and not f.duplicate and f.skew == 0
    assert [f.index for f in recording.frames(2, 4)] == [2, 3]
    assert [f.index for f in recording.frames(4)] == [4, 5]
    assert list(recording.frames(9)) == []


def test_names_are_in_natural_order_and_other_files_are_passed_over():
    write_folder("left", range(8, 12), name="frame{}.png")
    Path("left/notes.txt").write_text("sunny")
    Path("left/._frame8.png").write_bytes(b"\0")
    write_folder("right", range(8, 12), name="frame{}.png")
    frames = list(open_recording(clip()))
    assert len(frames) == 4
    np.testing.assert_array_equal(frames[2].left, picture(10))


@pytest.mark.parametrize("pattern", ["all/{}_*.png", "all/{}_%02d.png"])
def test_patterns(pattern):
    for side in ("l", "r"):
        write_folder("all", range(3), name=side + "_{:02d}.png")
    recording = open_recording(clip(pattern.format("l"), pattern.format("r")))
    np.testing.assert_array_equal(list(recording)[2].right, picture(2))


def test_numbers_missing_in_both_views_are_dropped_frames():
    numbers = [1, 2, 4, 5, 8]
    write_folder("left", numbers)
    write_folder("right", numbers)
    recording = open_recording(clip())
    np.testing.assert_allclose(recording.times, [0, 0.2, 0.6, 0.8, 1.4])
    assert recording.notices == [
        "3 dropped in 2 places, most between frames 3 and 4: 0.600 s lie between them instead of 0.200 s",
    ]


def test_images_of_one_view_only_are_left_out():
    write_folder("left", [0, 1, 2, 4, 5])
    write_folder("right", [0, 1, 2, 3, 5, 6])
    recording = open_recording(clip())
    assert recording.indices.tolist() == [0, 1, 2, 4]
    np.testing.assert_allclose(recording.times, [0, 0.2, 0.4, 1.0])
    assert recording.notices[:2] == [
        "left: frame 3 is left out, without a right frame of the same number",
        "right: frames 3, 5 are left out, without a left frame of the same number",
    ]
    frames = list(recording)
    np.testing.assert_array_equal(frames[3].left, frames[3].right)
    np.testing.assert_array_equal(frames[3].left, picture(5))
    assert [f.index for f in recording.frames(4)] == [4]


def test_equally_many_images_with_different_gaps_are_paired_by_number():
    write_folder("left", [0, 1, 2, 4])
    write_folder("right", [0, 1, 3, 4])
    recording = open_recording(clip())
    assert recording.indices.tolist() == [0, 1, 3]
    np.testing.assert_allclose(recording.times, [0, 0.2, 0.8])


def test_views_that_count_from_different_numbers_are_paired_in_order():
    write_folder("left", range(0, 4))
    write_folder("right", range(1, 5))
    recording = open_recording(clip())
    np.testing.assert_allclose(recording.times, np.arange(4) / 5)
    assert recording.notices == ["left images count from 0 and right ones from 1; paired in order"]


def test_every_tenth_frame_is_no_gap():
    write_folder("left", range(0, 50, 10))
    write_folder("right", [0, 10, 30, 40])
    recording = open_recording(clip())
    np.testing.assert_allclose(recording.times, [0, 0.2, 0.6, 0.8])


def test_clock_readings_in_names_are_no_frame_numbers():
    stamps = [1000, 1203, 1399, 1602]
    write_folder("left", stamps)
    write_folder("right", stamps)
    recording = open_recording(clip())
    np.testing.assert_allclose(recording.times, np.arange(4) / 5)
    assert recording.notices == ["left: the numbers in the names count no frames; a missing one cannot be noticed"]


def test_names_without_numbers_need_equal_counts():
    write_folder("left", range(3))
    for i, name in enumerate("abcd"):
        Path("right").mkdir(exist_ok=True)
        cv2.imwrite(f"right/{name}.png", picture(i))
    assert refusal(lambda: open_recording(clip())) == (
        "left has 3 images and right 4; expected as many, or frame numbers in their names that tell which belong "
        "together"
    )


def test_a_copied_image_is_noticed():
    write_folder("left", range(5))
    write_folder("right", range(5))
    shutil.copy("left/0002.png", "left/0003.png")
    recording = open_recording(clip())
    assert recording.notices == []
    assert [f.duplicate for f in recording] == [False, False, False, True, False]
    assert [f.duplicate for f in recording.frames(3)] == [True, False]
    assert recording.notices == ["left: frame 3 is a copy of the frame before"]


# --- pixels --------------------------------------------------------------------------------------------------------


def folder_of(image, name="0.png", **options):
    Path("one").mkdir(exist_ok=True)
    for i in range(2):
        assert cv2.imwrite(f"one/{i}{Path(name).suffix}", image, **options)
    return "one"


def test_sixteen_bits_are_scaled():
    image = picture(1, np.uint16)
    (grey,) = read(folder_of(image))
    np.testing.assert_allclose(grey, image * (255 / 65535), rtol=1e-6)


def test_twelve_bits_in_sixteen_cause_a_notice_and_are_scaled_on_request():
    image = picture(1, np.uint16) // 16
    source = open_source(Path(folder_of(image)))
    assert source.notices == ["one/0.png: looks like a 12-bit recording in 16-bit images; set bit_depth"]
    source = open_source(Path("one"), bit_depth=12)
    assert source.notices == []
    np.testing.assert_allclose(next(source.read([0])), image * (255 / 4095), rtol=1e-6)


def test_images_of_short_recordings_are_decoded_once(monkeypatch):
    class Counting:
        name, notices, times, decoded = "left", [], None, 0

        def __len__(self):
            return 6

        def label(self, frame):
            return f"left/{frame}"

        def read(self, frames):
            for frame in frames:
                self.decoded += 1
                yield None if frame == 3 else np.full((4, 5), frame, np.float32)

    def reads():
        source = Counting()
        kept = KeptImages(source)
        for frames in (range(3), range(2), [1, 2]):
            assert [int(image[0, 0]) for image in kept.read(frames)] == list(frames)
        for image, frame in zip(kept.read(range(6)), range(6), strict=True):
            assert (image is None) == (frame == 3)
        return source.decoded

    assert reads() == 3 + 6
    monkeypatch.setattr(image_sources, "MAX_KEPT_BYTES", 6 * 80 - 1)
    assert reads() == 3 + 2 + 2 + 6


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_a_picture_is_turned_as_its_exif_says(tmp_path, orientation, turns):
    """As every program shows it, in which outlines are drawn."""
    image = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (48, 64), np.uint8), (0, 0), 3)
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    entry = struct.pack("<HHIHH", 0x112, 3, 1, orientation, 0)  # the tag, a short, one of it
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + bytes(4)
    path = tmp_path / "0000.jpg"
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    np.testing.assert_allclose(read_image_file(path), np.rot90(image, turns), atol=3)


def test_values_that_do_not_fit_the_bit_depth_are_refused():
    image = np.full((H, W), 5000, np.uint16)
    source = open_source(Path(folder_of(image)), bit_depth=12)
    assert refusal(lambda: next(source.read([0]))) == (
        "one/0.png: holds the value 5000, which does not fit in bit_depth 12"
    )


def test_a_bit_depth_for_8_bit_images_is_noticed():
    source = open_source(Path(folder_of(picture(0))), bit_depth=12)
    assert source.notices == ["one: bit_depth 12 does not apply, because the images have 8 bits"]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [3, 4])
def test_colour_becomes_luma_and_alpha_is_ignored(dtype, channels):
    image = picture(2, dtype, (channels,))
    (grey,) = read(folder_of(image))
    b, g, r = np.moveaxis(image[..., :3].astype(float), -1, 0)
    luma = (0.299 * r + 0.587 * g + 0.114 * b) * 255 / np.iinfo(dtype).max
    np.testing.assert_allclose(grey, luma, atol=1e-3)


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".bmp", ".pgm"])
def test_other_formats(suffix):
    smooth = cv2.GaussianBlur(picture(3), (0, 0), 4)
    (grey,) = read(folder_of(smooth, f"0{suffix}"))
    np.testing.assert_allclose(grey, smooth, atol=4 if suffix == ".jpg" else 0)


def test_float_images_are_refused():
    message = refusal(lambda: read(folder_of(picture(0).astype(np.float32), "0.tif")))
    assert message == "one/0.tif: holds float32 pixels; expected integers of 8 or 16 bits"


def test_frames_are_undistorted():
    write_folder("left", range(2))
    write_folder("right", range(2))
    bent = Camera((W, H), K, np.array([-0.3, 0.1, 0.0, 0.0]))
    rig = StereoRig(bent, RIG.right, RIG.R, RIG.t)
    frame = next(iter(open_recording(clip(rig=rig))))
    np.testing.assert_allclose(frame.left, bent.undistort_image(picture(0).astype(np.float32)))
    np.testing.assert_array_equal(frame.right, picture(0))
    assert np.abs(frame.left - frame.right).max() > 1


# --- bad images ----------------------------------------------------------------------------------------------------


def two_folders():
    write_folder("left", range(4))
    write_folder("right", range(4))


def test_missing_images_are_reported_before_any_work():
    write_folder("left", range(4))
    assert refusal(lambda: open_recording(clip())) == (
        "right: no such file or folder; expected a folder of images, a pattern or a video"
    )
    Path("right").mkdir()
    assert refusal(lambda: open_recording(clip())) == "right: no images; expected at least two"
    assert refusal(lambda: open_recording(clip(right="right/*.png"))) == "right/*.png: no images; expected at least two"
    write_folder("right", [0])
    assert refusal(lambda: open_recording(clip())) == "right: only one image; expected at least two"
    write_folder("right", range(4))
    assert refusal(lambda: open_recording(clip(rate=None))) == (
        "clip.yaml: rate: missing; folders of images need it, or times"
    )


def test_sizes_that_differ_from_the_rig():
    two_folders()
    cv2.imwrite("right/0002.png", np.zeros((H, W + 1), np.uint8))
    recording = open_recording(clip())
    assert refusal(lambda: list(recording)) == (
        "right/0002.png: has 65 × 48 pixels, but the rig's right camera has 64 × 48"
    )
    cv2.imwrite("left/0000.png", np.zeros((2 * H, 2 * W), np.uint8))
    assert refusal(lambda: open_recording(clip())) == (
        "left/0000.png: has 128 × 96 pixels, but the rig's left camera has 64 × 48"
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "left/0002.png: is empty; expected an image"),
        (b"hello there, this is text" * 9, "left/0002.png: is truncated, damaged or not an image"),
        (b"\x89PNG\r\n\x1a\n", "left/0002.png: is truncated or damaged; expected a whole image"),
        (None, "left/0002.png: cannot be read (No such file or directory)"),
    ],
)
def test_files_that_are_no_images(content, message, capfd):
    two_folders()
    recording = open_recording(clip())
    if content is None:
        Path("left/0002.png").unlink()
    else:
        Path("left/0002.png").write_bytes(content)
    frames = iter(recording)
    assert [next(frames).index, next(frames).index] == [0, 1]
    assert refusal(lambda: next(frames)) == message
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.9, -1])
def test_truncated_images_are_noticed(suffix, kept, capfd):
    path = Path(folder_of(picture(5), f"0{suffix}")) / f"1{suffix}"
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data)) if kept > 0 else kept])
    assert refusal(lambda: read("one", [1])).startswith(f"{path}: is truncated")
    assert capfd.readouterr().err == ""


def test_a_damaged_png_is_noticed():
    path = Path(folder_of(picture(5))) / "1.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert refusal(lambda: read("one", [1])) == "one/1.png: is truncated or damaged; expected a whole image"


# --- times.csv -----------------------------------------------------------------------------------------------------

HEADER = "frame,left_s,right_s\n"


def write_times(rows, header=HEADER):
    Path("times.csv").write_text(header + "".join(f"{','.join(map(str, row))}\n" for row in rows))


def timed(**more):
    return open_recording(clip(rate=None, times=Path("times.csv"), **more))


def test_times_of_each_frame():
    two_folders()
    write_times([(0, 10.0, 10.002), (1, 10.1, 10.102), (2, 10.2, 10.202), (3, 10.5, 10.502)])
    recording = timed()
    np.testing.assert_allclose(recording.times, [10.001, 10.101, 10.201, 10.501])
    np.testing.assert_allclose(recording.skews, 0.002)
    assert recording.notices == [
        "right frames are taken +2.0 ms from the left ones (median; at most 2.0 ms)",
        "2 dropped between frames 2 and 3: 0.300 s lie between them instead of 0.100 s",
    ]
    assert [f.skew for f in recording] == pytest.approx([0.002] * 4)


def test_frames_without_a_partner_in_time_are_left_out():
    two_folders()
    write_times([(0, 0.0, 0.1), (1, 0.1, 0.2), (2, 0.2, 0.24), (3, 0.3, 0.3)])
    recording = timed()
    assert recording.indices.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(next(iter(recording)).right, picture(0))
    assert recording.notices[:2] == [
        "left: frame 0 is left out, without a right frame within 25 ms",
        "right: frame 2 is left out, without a left frame within 25 ms",
    ]


@pytest.mark.parametrize("wrong", [0.2, 0.05, 7.0])
def test_a_time_that_repeats_or_is_out_of_order_costs_its_frame(wrong):
    for side in ("left", "right"):
        write_folder(side, range(8))
    write_times([(k, wrong if k == 3 else k / 10, k / 10) for k in range(8)])
    recording = timed()
    assert recording.indices.tolist() == [0, 1, 2, 4, 5, 6, 7]
    np.testing.assert_allclose(recording.times, np.array([0, 1, 2, 4, 5, 6, 7]) / 10)
    assert recording.notices == [
        "left: frame 3 left out, whose time stamps repeat or are out of order",
        "right: frame 3 is left out, without a left frame within 25 ms",
        "1 dropped between frames 2 and 4: 0.200 s lie between them instead of 0.100 s",
    ]


@given(st.lists(st.integers(0, 12), max_size=12))
def test_as_many_frames_as_possible_stay_in_order(times):
    mask = longest_increasing_subsequence(times)
    assert len(mask) == len(times) and all(np.diff(np.array(times)[mask]) > 0)
    longest = [0] * len(times)
    for k, time in enumerate(times):
        longest[k] = 1 + max((longest[i] for i in range(k) if times[i] < time), default=0)
    assert mask.sum() == max(longest, default=0)


def test_a_stated_tolerance_is_used():
    two_folders()
    write_times([(i, i / 10, i / 10 + 0.003) for i in range(4)])
    assert len(timed(tolerance=0.003)) == 4
    assert refusal(lambda: timed(tolerance=0.002)) == (
        "left and right: no two frames lie within 2 ms of each other (left 0.000 to 0.300 s, right 0.003 to 0.303 s)"
    )


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 3, 0), (1, 2, 1), (2, 1, 2), (3, 0, 3)], "left_s: the times do not increase"),
        ([(0, 0, 1), (1, 1, 1), (2, 2, 1), (3, 3, 1)], "right_s: the times do not increase"),
        ([(0, 0, 0), (1, "x", 1), (2, 2, 2), (3, 3, 3)], "frame 1: '1,x,1'; expected three numbers"),
        ([(0, 0, 0), (1, 1), (2, 2, 2), (3, 3, 3)], "frame 1: '1,1'; expected three numbers"),
        ([(0, 0, 0), (1, 1, "nan"), (2, 2, 2), (3, 3, 3)], "frame 1: '1,1,nan'; expected finite numbers"),
        ([(0, 0, 0), (1, 1, 1), (3, 3, 3), (4, 4, 4)], "frame 3 stands where frame 2 is expected"),
        ([(0, 0, 0), (1, 1, 1)], "has 2 rows, but there are 4 left and 4 right images; expected one each"),
    ],
)
def test_times_that_cannot_be(rows, message):
    two_folders()
    write_times(rows)
    assert refusal(timed) == f"times.csv: {message}"


def test_times_with_another_header_or_none():
    two_folders()
    write_times([], "time;left;right\n")
    assert refusal(timed) == "times.csv: the first line reads 'time;left;right'; expected 'frame,left_s,right_s'"
    Path("times.csv").write_bytes(b"\xff\xfe\x00\x80")
    assert refusal(timed) == "times.csv: is not a table of comma-separated text"
    Path("times.csv").unlink()
    assert refusal(timed) == "times.csv: cannot be read (No such file or directory)"


@settings(deadline=None)
@given(st.lists(st.floats(0.05, 0.2), min_size=3, max_size=30), st.floats(-0.01, 0.01), st.sets(st.integers(0, 29)))
def test_pairs_are_found_by_time_whatever_frames_the_right_view_lost(intervals, skew, lost):
    left = np.cumsum(intervals)
    kept = [i for i in range(len(left)) if i not in lost]
    if len(kept) < 2:
        return
    pairing = pair_by_time(left, left[kept] + skew, tolerance=0.012)
    assert pairing.left.tolist() == kept
    assert pairing.right.tolist() == list(range(len(kept)))
    np.testing.assert_allclose(pairing.skews, skew, atol=1e-12)
    np.testing.assert_allclose(pairing.times, left[kept] + skew / 2)


# --- videos --------------------------------------------------------------------------------------------------------

PTS = [0, 100, 200, 305, 400, 700, 800]


def test_lossless_video_with_variable_time_stamps():
    write_video("left.mkv", PTS, [picture(i) for i in range(7)])
    write_video("right.mkv", PTS, [picture(50 + i) for i in range(7)])
    recording = open_recording(clip("left.mkv", "right.mkv", rate=None))
    assert len(recording) == 7
    np.testing.assert_allclose(recording.times, np.array(PTS) / 1000, atol=1e-12)
    assert recording.notices == ["2 dropped between frames 4 and 5: 0.300 s lie between them instead of 0.100 s"]
    for _ in range(2):
        for f in recording:
            np.testing.assert_array_equal(f.left, picture(f.index))
            np.testing.assert_array_equal(f.right, picture(50 + f.index))
    assert [(f.index, f.time) for f in recording.frames(3, 5)] == [(3, pytest.approx(0.305)), (4, pytest.approx(0.4))]


@pytest.mark.parametrize(("start", "delay"), [(1400, "1.400 s after"), (-1400, "1.400 s before"), (100, None)])
def test_videos_whose_time_stamps_begin_apart(start, delay):
    write_video("left.mkv", range(2000, 5000, 100), [picture(i) for i in range(30)])
    write_video("right.mkv", range(2000 + start, 5000 + start, 100), [picture(i) for i in range(30)])
    recording = open_recording(clip("left.mkv", "right.mkv", rate=None))
    apart = [n for n in recording.notices if n.code == "views_start_apart"]
    assert apart == [f"right.mkv: its time stamps begin {delay} those of left.mkv"] * (delay is not None)
    assert apart[:1] == [n for n in recording.with_lag(-0.2).notices if n.code == "views_start_apart"]


def test_videos_that_lost_different_frames_are_matched_by_time():
    write_video("left.mkv", [0, 100, 200, 400, 500], [picture(i) for i in (0, 1, 2, 4, 5)])
    write_video("right.mkv", [0, 101, 300, 400, 500], [picture(i) for i in (0, 1, 3, 4, 5)])
    recording = open_recording(clip("left.mkv", "right.mkv"))
    assert recording.indices.tolist() == [0, 1, 3, 4]
    for f in recording:
        np.testing.assert_array_equal(f.left, f.right)
    assert recording.notices[:3] == [
        "clip.yaml: rate is not used, because the videos carry their own time stamps",
        "left: frame 2 is left out, without a right frame within 25 ms",
        "right: frame 2 is left out, without a left frame within 25 ms",
    ]


def test_selected_frames_are_decoded_from_the_key_frames_before_them(monkeypatch):
    for side in ("left", "right"):
        pictures = [np.full((H, W), 10 + 2 * i, np.uint8) for i in range(60)]
        write_h264(Path(f"{side}.mp4"), pictures, [0.1 * i for i in range(60)], 20, streamed=True)
    recording = open_recording(clip("left.mp4", "right.mp4"))
    monkeypatch.setattr(image_sources, "MAX_KEPT_BYTES", 0)
    every = {f.index: f for f in recording.frames()}
    decoded, decode = [], VideoFile._decode

    def counted(self, start=None):
        for image in decode(self, start):
            decoded.append(image.pts)
            yield image

    monkeypatch.setattr(VideoFile, "_decode", counted)
    chosen = np.array([3, 4, 52])
    selected = list(recording.selected(chosen))
    assert [f.index for f in selected] == chosen.tolist()
    for f in selected:
        assert np.array_equal(f.left, every[f.index].left) and f.time == every[f.index].time and not f.duplicate
    with av.open("left.mp4") as container:
        keys = [n for n, packet in enumerate(container.demux(video=0)) if packet.is_keyframe and n <= 51]
    assert len(keys) > 2 and len(decoded) == 2 * (5 + 52 - keys[-1] + 1)


def test_a_selected_frame_that_repeats_the_one_before_is_noticed():
    for side in ("left", "right"):
        write_video(f"{side}.mkv", range(0, 600, 100), [picture(i) for i in (0, 1, 2, 2, 1, 5)])
    recording = open_recording(clip("left.mkv", "right.mkv"))
    assert [f.duplicate for f in recording.selected(np.array([1, 3, 4]))] == [False, True, False]


def test_sixteen_bit_and_colour_video():
    deep = [picture(i, np.uint16) for i in range(3)]
    write_video("deep.mkv", [0, 100, 200], deep, pixels="gray16le")
    np.testing.assert_allclose(read("deep.mkv", [2])[0], deep[2] * (255 / 65535), rtol=1e-6)
    colour = [picture(i, channels=(3,)) for i in range(3)]
    write_video("colour.mkv", [0, 100, 200], colour, pixels="bgr0")
    np.testing.assert_allclose(read("colour.mkv", [1])[0], colour[1] @ [0.299, 0.587, 0.114], atol=0.1)


@pytest.mark.parametrize("name", ["h264.mp4", "h264.mkv"])
def test_pictures_that_are_stored_out_of_order_come_in_order_of_time(name):
    levels = [40, 60, 80, 100, 120, 140, 160, 180]
    pts = [0, 100, 200, 300, 400, 600, 700, 800]
    write_video(name, pts, [np.full((H, W), g, np.uint8) for g in levels], "libx264", "yuv420p")
    source = open_source(Path(name))
    np.testing.assert_allclose(source.times, np.array(pts) / 1000, atol=1e-12)
    assert [float(i.mean()) for i in source.read(range(8))] == pytest.approx(levels, abs=1.5)
    assert [float(i.mean()) for i in source.read([2, 5])] == pytest.approx([80, 140], abs=1.5)
    assert source.notices == []


@pytest.mark.parametrize("kept", [0.5, 0.8, 0.97])
def test_a_truncated_video_is_used_as_far_as_it_goes(kept):
    write_video("left.mkv", range(0, 1000, 100), [picture(i) for i in range(10)])
    shutil.copy("left.mkv", "right.mkv")
    data = Path("left.mkv").read_bytes()
    Path("left.mkv").write_bytes(data[: int(kept * len(data))])
    recording = open_recording(clip("left.mkv", "right.mkv"))
    last = len(recording) - 1
    assert 2 <= last < 9
    assert f"left.mkv: is cut short; it ends after frame {last} at {last / 10:.3f} s" in recording.notices
    frames = list(recording)
    assert len(frames) == len(recording)
    np.testing.assert_array_equal(frames[-1].left, picture(last))


def test_a_frame_that_cannot_be_decoded_is_left_out_and_noticed():
    write_video("left.mkv", PTS, [picture(i) for i in range(7)], "mjpeg", "yuvj420p")
    shutil.copy("left.mkv", "right.mkv")
    with av.open("left.mkv") as container:
        packet = [bytes(p) for p in container.demux(video=0)][3]
    data = Path("left.mkv").read_bytes()
    assert data.count(packet) == 1
    Path("left.mkv").write_bytes(data.replace(packet, bytes(len(packet))))
    recording = open_recording(clip("left.mkv", "right.mkv", rate=None))
    assert len(recording) == 7
    for _ in range(2):
        assert [f.index for f in recording] == [0, 1, 2, 4, 5, 6]
    assert "left.mkv: frame 3: cannot be decoded and left out" in recording.notices


def test_a_truncated_mp4_without_its_index_is_refused():
    write_video("left.mp4", range(0, 1000, 100), [picture(i) for i in range(10)], "libx264", "yuv420p")
    data = Path("left.mp4").read_bytes()
    Path("left.mp4").write_bytes(data[: len(data) // 2])
    assert refusal(lambda: open_source(Path("left.mp4"))) == (
        "left.mp4: cannot be read as a video (Invalid data found when processing input)"
    )


def test_a_truncated_avi_and_a_fast_start_mp4():
    for name, codec, options in (("a.avi", "libx264", {}), ("a.mp4", "libx264", {"movflags": "+faststart"})):
        pts = range(10)
        base = Fraction(1, 10)
        write_video(name, pts, [picture(i) for i in pts], codec, "yuv420p", base, options)
        whole = open_source(Path(name))
        assert len(whole) == 10 and whole.notices == []
        data = Path(name).read_bytes()
        Path(name).write_bytes(data[: int(0.6 * len(data))])
        cut = open_source(Path(name))
        assert 2 <= len(cut) < 9
        assert len(cut.notices) == 1 and cut.notices[0].startswith(f"{name}: is cut short; it ends after frame")
        assert all(image is not None for image in cut.read(range(len(cut))))


@pytest.mark.parametrize(("name", "content"), [("v.mp4", b""), ("v.mkv", b"hello\n" * 99), ("v.txt", b"hello\n" * 99)])
def test_files_that_are_no_video(name, content):
    Path(name).write_bytes(content)
    message = refusal(lambda: open_source(Path(name)))
    assert message in (
        f"{name}: cannot be read as a video (Invalid data found when processing input)",
        f"{name}: holds no video",
    )


def test_a_frame_whose_time_stamp_is_that_of_the_one_before_is_left_out():
    write_video("v.mkv", [0, 100, 200, 200, 300], [picture(i) for i in range(5)])
    source = open_source(Path("v.mkv"))
    assert source.times.tolist() == [0.0, 0.1, 0.2, 0.3]
    assert [n.code for n in source.notices] == ["frames_restamped"] and "1 frame left out" in source.notices[0]
    for image, i in zip(source.read(range(4)), (0, 1, 2, 4), strict=True):
        np.testing.assert_array_equal(image, picture(i))


@pytest.mark.parametrize("codec", ["ffv1", "mjpeg"])
@pytest.mark.parametrize(
    ("stamps", "left_out"),
    [
        ({5: 420}, []),
        ({5: 300}, [5]),
        ({5: 120}, [5]),
        ({5: 390}, [5]),
        ({5: 620}, [5]),
        ({5: 5000}, [5]),
        ({2: 3000, 6: 0}, [2, 6]),
    ],
)
def test_wrong_time_stamps_cost_only_their_own_frames(codec, stamps, left_out):
    """Be they too early or too late."""
    write_video(
        "v.mkv",
        range(0, 1000, 100),
        [picture(i) for i in range(10)],
        codec,
        pixels="gray" if codec == "ffv1" else "yuvj420p",
    )
    restamp("v.mkv", stamps)
    source = open_source(Path("v.mkv"))
    frames = [i for i in range(10) if i not in left_out]
    assert source.times.tolist() == [stamps.get(i, 100 * i) / 1000 for i in frames]
    assert [n.code for n in source.notices] == ["frames_restamped"] * bool(left_out)
    for first in (0, 4):
        for image, i in zip(source.read(range(first, len(frames))), frames[first:], strict=True):
            assert np.corrcoef(image.ravel(), picture(i).ravel())[0, 1] > 0.7


def test_an_mp4_whose_time_stamps_repeat():
    write_video("v.mp4", [0, 100, 200, 250, 350, 450], [picture(i) for i in range(6)], "mpeg4", "yuv420p")
    data = bytearray(Path("v.mp4").read_bytes())
    at = data.index(b"stts") + 8  # the number of entries: how many frames, and how long each is shown
    (count,) = struct.unpack_from(">I", data, at)
    entries = [struct.unpack_from(">2I", data, at + 4 + 8 * k) for k in range(count)]
    (short,) = (k for k, (_, duration) in enumerate(entries) if 2 * duration == entries[0][1])
    struct.pack_into(">I", data, at + 8 + 8 * short, 0)
    Path("v.mp4").write_bytes(data)
    source = open_source(Path("v.mp4"))
    assert len(source) == 5 and [n.code for n in source.notices] == ["frames_restamped"]
    for image, i in zip(source.read(range(5)), (0, 1, 2, 4, 5), strict=True):
        assert np.corrcoef(image.ravel(), picture(i).ravel())[0, 1] > 0.7


@pytest.mark.parametrize("counts", [(10, 4), (4, 10), (10, 10)])
def test_recordings_that_were_joined_are_read_once(counts):
    """Each picture has its own time stamp, wherever reading begins, and all are of the longer recording."""
    first, second = (range(start, start + n) for start, n in zip((0, 50), counts, strict=True))
    for name, numbers in (("first.ts", first), ("second.ts", second)):
        write_video(name, range(0, 100 * len(numbers), 100), [picture(i) for i in numbers], "libx264", "yuv420p")
    Path("both.ts").write_bytes(Path("first.ts").read_bytes() + Path("second.ts").read_bytes())
    source = open_source(Path("both.ts"))
    frames = first if len(first) >= len(second) else second[len(first) :]  # others have stamps of the first one, too
    assert len(source) == len(frames) and [n.code for n in source.notices] == ["frames_restamped"]
    np.testing.assert_allclose(np.diff(source.times), 0.1)
    for start in (0, 3):
        for image, i in zip(source.read(range(start, len(frames))), frames[start:], strict=True):
            assert np.corrcoef(image.ravel(), picture(i).ravel())[0, 1] > 0.7


def test_of_recordings_that_were_joined_the_first_one_counts():
    write_video("once.ts", range(0, 1000, 100), [picture(i) for i in range(10)], "libx264", "yuv420p")
    Path("twice.ts").write_bytes(2 * Path("once.ts").read_bytes())
    source = open_source(Path("twice.ts"))
    assert len(source) == 10 and "10 frames left out" in source.notices[0]
    assert len(list(source.read(range(10)))) == 10


@pytest.mark.parametrize(
    ("name", "codec", "pixels"), [("raw.h264", "libx264", "yuv420p"), ("raw.mjpeg", "mjpeg", "yuvj420p")]
)
def test_a_video_without_time_stamps_needs_a_rate(name, codec, pixels):
    """FFmpeg invents 25 frames/s for raw MJPEG."""
    write_video(name, range(5), [picture(20 * i) for i in range(5)], codec, pixels, Fraction(1, 25))
    assert (
        refusal(lambda: open_recording(clip(name, name, None)))
        == f"clip.yaml: rate: missing; {name} has no time stamps, or times"
    )
    recording = open_recording(clip(name, name, 10.0))
    np.testing.assert_allclose(recording.times, np.arange(5) / 10)
    for frame, i in zip(recording, range(5), strict=True):
        assert np.corrcoef(frame.left.ravel(), picture(20 * i).ravel())[0, 1] > 0.9


@pytest.mark.parametrize("stamps", [{}, {5: 400}, {5: 390}, {5: 5000}])
def test_a_rate_that_overrides_counts_every_frame(stamps):
    """Whatever their time stamps are, and whichever frame is read first."""
    write_video("v.mkv", range(0, 1000, 100), [picture(i) for i in range(10)], "mjpeg", "yuvj420p")
    restamp("v.mkv", stamps)
    recording = open_recording(clip("v.mkv", "v.mkv", 240.0, rate_override=True))
    np.testing.assert_allclose(recording.times, np.arange(10) / 240)
    assert {n.code for n in recording.notices} <= {"rate_overrides"}
    for i in (0, 7, 3):
        frame = next(recording.frames(i))
        assert frame.index == i and np.corrcoef(frame.left.ravel(), picture(i).ravel())[0, 1] > 0.9


def test_a_raw_stream_of_which_a_picture_is_lost_is_refused():
    write_video("raw.mjpeg", range(6), [picture(i) for i in range(6)], "mjpeg", "yuvj420p", Fraction(1, 25))
    content = bytearray(Path("raw.mjpeg").read_bytes())
    third = [k for k in range(len(content) - 1) if content[k : k + 2] == b"\xff\xd8"][2]
    content[third + 2 : third + 40] = bytes(38)  # its tables are lost
    Path("damaged.mjpeg").write_bytes(bytes(content))
    assert refusal(lambda: open_recording(clip("raw.mjpeg", "damaged.mjpeg", 10.0))).startswith(
        "raw.mjpeg has 6 images and damaged.mjpeg 5"
    )


def test_a_video_of_one_frame_or_of_another_size_is_refused():
    write_video("one.mkv", [0], [picture(0)])
    assert refusal(lambda: open_source(Path("one.mkv"))) == "one.mkv: fewer than two frames can be decoded"
    write_video("left.mkv", PTS, [picture(i) for i in range(7)])
    rig = StereoRig(Camera((640, 480), K), RIG.right, RIG.R, RIG.t)
    assert refusal(lambda: open_recording(clip("left.mkv", "left.mkv", rig=rig))) == (
        "left.mkv: frame 0: has 64 × 48 pixels, but the rig's left camera has 640 × 480"
    )


def test_a_video_beside_a_folder_needs_times():
    write_video("left.mkv", PTS, [picture(i) for i in range(7)])
    write_folder("right", range(7))
    assert refusal(lambda: open_recording(clip("left.mkv"))) == (
        "clip.yaml: right has no time stamps, the other view has; expected times for both"
    )
    write_times([(i, i / 10, i / 10) for i in range(7)])
    np.testing.assert_allclose(timed(left=Path("left.mkv")).times, np.arange(7) / 10)
