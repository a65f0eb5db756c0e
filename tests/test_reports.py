"""Reports: exact data files, a safe and complete page, a video that plays, an output folder that is whole or absent."""

from __future__ import annotations

import base64
import csv
import errno
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
from selection import slow_after

from paceline.arrays import Indices
from paceline.errors import UnusableInput
from paceline.number_format import align_decimals, format_half_width, format_interval, format_uncertain
from paceline.recordings.stereo import StereoFrame
from paceline.reports import OutputFolder, write_report
from paceline.reports.common.formatting import (
    align_for_page,
    format_measurement,
    format_parts,
    rejected_advice,
    speed_at,
)
from paceline.reports.common.plots import VEHICLE_COLORS, lane_color
from paceline.reports.common.video import VideoWriter
from paceline.reports.speed.cameras import camera_rows
from paceline.reports.speed.overlay import format_label
from paceline.reports.speed.plots import plan_plot
from paceline.speed.results import ClipResult, Measurement, PathDrawing, Track
from paceline.units import COVERAGE_95
from paceline.verdicts import message

NAN = float("nan")
FRAMES = 12
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


class Recording:
    """A recording of smooth random pictures, 320×200 and 300×200, with uneven time stamps."""

    times = np.cumsum([0.0] + [0.2] * 5 + [0.4] + [0.2] * (FRAMES - 7)) + 3.0

    def __len__(self) -> int:
        return FRAMES

    @property
    def indices(self) -> Indices:
        return np.arange(FRAMES)

    def selected(self, indices: Indices) -> Iterator[StereoFrame]:
        return (frame for frame in self if frame.index in indices)

    def __iter__(self) -> Iterator[StereoFrame]:
        ramp = np.linspace(40, 200, 320, dtype=np.float32)
        for i in range(FRAMES):
            left = np.tile(ramp, (200, 1)) + np.random.default_rng(i).normal(0, 4, (200, 320)).astype(np.float32)
            yield StereoFrame(
                index=i, time=float(self.times[i]), left=left, right=left[:, 20:], skew=0.0, duplicate=i == 4
            )


def track(vehicle: str, first: int = 0, refined: bool = True) -> Track:
    n = FRAMES - first
    rng = np.random.default_rng(7)
    steps = np.arange(n, dtype=float)
    square = np.array([[-20.0, -12.0], [20.0, -12.0], [20.0, 12.0], [-20.0, 12.0]])
    left = 150 + square * (1 + steps[:, None, None] / 20)
    yaw_rate = rng.normal(0, 0.01, n)
    yaw_rate[0] = NAN
    return Track(
        vehicle=vehicle,
        frame=np.arange(first, FRAMES),
        time=Recording.times[first:],
        speed=20 + rng.normal(0, 0.2, n),
        speed_std=0.3 + np.exp(-steps),
        position=np.stack([np.full(n, -2.0), np.full(n, 1.1), 60 - 4 * steps], axis=1),
        yaw_rate=yaw_rate,
        left=left,
        right=left - [20, 0],
        ess=np.full(n, 123.0),
        status=["tracking"] * (n - 2) + ["lost", "ended"],
        particles_left=left.mean(axis=1)[:, None] + rng.normal(0, 2, (n, 30, 2)),
        particles_right=left.mean(axis=1)[:, None] + rng.normal(0, 2, (n, 30, 2)),
        refined_speed=np.full(n, 20.1 if refined else NAN),
        refined_std=np.full(n, 0.05 if refined else NAN),
        hidden=np.zeros(n, bool),
    )


def measured(vehicle: str) -> Measurement:
    return Measurement(
        vehicle, track(vehicle), speed=20.1, speed_lo=20.0, speed_hi=20.2, random_std=0.03, systematic_std=0.04,
        frames=10, verdict="measured", reason="", model="constant speed", residual_rms=3.2, path="lane0",
        direction="with", limit=18.0,
    )  # fmt: skip


def rejected(vehicle: str) -> Measurement:
    return Measurement(
        vehicle, track(vehicle, first=3, refined=False), speed=NAN, speed_lo=NAN, speed_hi=NAN, random_std=NAN,
        systematic_std=NAN, frames=7, verdict="rejected", reason="too few frames (7 of at least 8)", model="filter",
        reason_code="seen_briefly", notices=["left the picture at frame 11"],
    )  # fmt: skip


CAMERAS: dict[str, object] = {
    "offset_s": {"value": 0.008, "std": 0.0005, "source": "estimated", "speed_effect": 0.002},
    "left": {"readout_s": {"value": 0.0, "std": 0.005, "source": "assumed", "speed_effect": 0.001}, "sway_px_rms": 0.4},
    "right": {"sway_px_rms": 0.0},
    "epipolar_px": {"value": 0.3, "std": 0.05},
    "assumed": ["rig"],
}


def clip_result() -> ClipResult:
    line = np.stack([np.linspace(-4, -3, 9), np.full(9, 1.6), np.linspace(70, 20, 9)], axis=1)
    pixels = np.stack([np.linspace(150, 20, 9), np.linspace(90, 190, 9)], axis=1)
    pixels[0] = NAN  # a point behind the camera has no picture
    return ClipResult(
        clip="road/clip.yaml",
        measurements=[measured("v0"), replace(measured("v1"), limit=20.15), rejected("v2")],
        paths=[PathDrawing("lane0", line, pixels, pixels)],
        configuration={"particles": 400, "refine": True, "noise": {"speed": 0.5, "limit": float("inf")}},
        versions={"paceline": "0.1.0"},
        notices=["frame 4 repeats frame 3"],
        seconds=2.5,
        cameras=CAMERAS,
    )


@pytest.fixture
def result() -> ClipResult:
    return clip_result()


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report") / "out"
    write_report(clip_result(), Recording(), folder, "mph")
    return folder


def test_files(out: Path) -> None:
    names = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file())
    pictures = [f"{folder}/{v}.jpg" for folder in ("pictures", "outlines") for v in ("v0", "v1", "v2")]
    plots = [f"plots/{v}-{kind}.png" for v in ("v0", "v1", "v2") for kind in ("depth", "particles", "speed")]
    tables = ["estimates.csv", "vehicles.csv", "summary.json"]
    assert names == sorted([*tables, "report.html", "overlay.mp4", "plots/plan.png", *plots, *pictures])
    assert sorted(p.name for p in out.parent.iterdir()) == ["out"]
    outlines, middle = (cv2.imread(str(out / folder / "v0.jpg")) for folder in ("outlines", "pictures"))
    height, width, _ = middle.shape
    assert outlines.shape == (2 * height, 3 * width, 3)  # both views, three frames
    assert np.abs(outlines[:height, width : 2 * width].astype(float) - middle).mean() < 3


def test_estimates_are_exact(out: Path, result: ClipResult) -> None:
    with (out / "estimates.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert ",".join(rows[0]) == (
        "vehicle,frame,time_s,speed_mps,speed_std_mps,x_m,y_m,z_m,yaw_rate_radps,"
        "left_x1,left_y1,left_x2,left_y2,left_x3,left_y3,left_x4,left_y4,"
        "right_x1,right_y1,right_x2,right_y2,right_x3,right_y3,right_x4,right_y4,"
        "ess,status,refined_speed_mps,refined_std_mps"
    )
    assert len(rows) == sum(len(m.track.frame) for m in result.measurements)
    expected = result.measurements[0].track
    row = rows[5]
    assert (row["vehicle"], row["frame"], row["status"]) == ("v0", "5", "tracking")
    assert float(row["speed_mps"]) == expected.speed[5]
    assert float(row["z_m"]) == expected.position[5, 2]
    assert float(row["right_x3"]) == expected.right[5, 2, 0]
    assert float(row["left_y2"]) == expected.left[5, 1, 1]
    assert rows[0]["yaw_rate_radps"] == ""
    assert rows[-1]["refined_speed_mps"] == rows[-1]["refined_std_mps"] == ""
    assert rows[-1]["status"] == "ended"
    assert "nan" not in (out / "estimates.csv").read_text()


def test_summary_is_exact(out: Path) -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    summary = json.loads((out / "summary.json").read_text(), parse_constant=refuse)
    first, _, last = summary["vehicles"]
    assert first == {
        "vehicle": "v0", "speed_mps": 20.1, "speed_lo_mps": 20.0, "speed_hi_mps": 20.2, "frames": 10,
        "verdict": "measured", "reason": "", "reason_code": "", "random_std_mps": 0.03, "systematic_std_mps": 0.04,
        "calibrated_by": 0, "model": "constant speed", "acceleration_mps2": None, "residual_rms": 3.2,
        "outline_offset_px": None, "corners_difference_mps": None, "corners_difference_std_mps": None,
        "interval_from": "fit", "path": "lane0", "direction": "with", "travel": "approaching", "seen_from_s": 3.0,
        "seen_to_s": pytest.approx(5.0), "limit_mps": 18.0,
        "compliance": "over", "notices": [], "picture": "pictures/v0.jpg",
    }  # fmt: skip
    assert last["verdict"] == "rejected" and last["reason"].startswith("too few frames")
    assert last["reason_code"] == "seen_briefly" and last["compliance"] is None
    assert last["speed_mps"] is None and last["speed_lo_mps"] is None
    assert summary["configuration"] == {"particles": 400, "refine": True, "noise": {"speed": 0.5, "limit": None}}
    assert summary["versions"] == {"paceline": "0.1.0"}
    assert summary["notices"] == ["frame 4 repeats frame 3"]
    with (out / "vehicles.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row, vehicle in zip(rows, summary["vehicles"], strict=True):
        assert row == {k: "" if v is None else str(v) for k, v in vehicle.items() if k != "notices"}


def test_random_and_systematic_parts_add_up() -> None:
    text = format_measurement(measured("v"), "m/s")
    assert (str(text), text.ends) == ("20.10 ± 0.10", "20.00 to 20.20")
    # 0.03 and 0.04 make 0.05; the interval's half width of 0.1 is twice that.
    assert format_parts(measured("v"), "m/s") == ("0.06", "0.08")
    assert format_parts(replace(measured("v"), systematic_std=NAN), "mph")[1] == "–"


@pytest.mark.parametrize(
    ("value", "half", "shown", "ends"),
    [
        (31.124, 0.134, "31.12 ± 0.13", "30.99 to 31.25"),  # the upper end alone would be 31.26
        (45.0, 0.0412, "45.000 ± 0.041", "44.959 to 45.041"),
        (44.95, 0.0996, "44.95 ± 0.10", "44.85 to 45.05"),
        (8.04, 1.26, "8.0 ± 1.3", "6.7 to 9.3"),
        (72.4, 12.4, "72 ± 12", "60 to 84"),
        (-0.02, 0.4, "−0.02 ± 0.40", "−0.42 to 0.38"),
        (20.123, NAN, "20.1 ± –", "–"),
        (NAN, NAN, "–", "–"),
    ],
)
def test_numbers_have_the_decimals_of_their_uncertainty_and_add_up(
    value: float, half: float, shown: str, ends: str
) -> None:
    text = format_interval(value, value - half, value + half)
    assert (str(text), text.ends) == (shown, ends)
    assert format_uncertain(value, half) == shown


def test_an_interval_that_is_not_symmetric_keeps_its_ends() -> None:
    text = format_interval(20.0, 19.4, 21.0)
    assert (str(text), text.ends) == ("20.00 ± 0.80", "19.40 to 21.00")


def test_a_half_width_alone_has_two_digits_and_zero_no_sign() -> None:
    assert [format_half_width(half) for half in (0.1355, 3.7, 12.4, 0.0009961, NAN)] == [
        "0.14", "3.7", "12", "0.0010", "–",
    ]  # fmt: skip
    assert format_uncertain(-0.00001, 0.002) == "0.0000 ± 0.0020"


def test_columns_are_aligned_at_the_decimal_point() -> None:
    assert align_decimals(["44.985 ± 0.086", "–", "8.0 ± 1.3", "104 ± 12"]) == [
        " 44.985 ±  0.086",
        "  –    ",
        "  8.0   ±  1.3  ",
        "104     ± 12    ",
    ]
    assert align_for_page(["1.5", "12"]) == ["\u20071.5", "12\u2008\u2007"]
    assert align_decimals([]) == []


@pytest.mark.parametrize(
    ("limit", "compliance", "shown"),
    [
        (20.2, "within", "v0  44.96 ± 0.22 mph, within 45.2 mph"),
        (20.1999, "undecided", "v0  44.96 ± 0.22 mph, undecided at 45.2 mph"),
        (20.0, "undecided", "v0  44.96 ± 0.22 mph, undecided at 44.7 mph"),
        (30 * 0.44704, "over", "v0  44.96 ± 0.22 mph, over 30 mph"),
        (None, None, "v0  44.96 ± 0.22 mph"),
    ],
)
def test_a_limit_is_kept_exceeded_or_neither_is_sure(limit: float | None, compliance: str | None, shown: str) -> None:
    vehicle = replace(measured("v0"), limit=limit)
    assert vehicle.compliance == compliance
    assert format_label(vehicle, "tracking", "mph") == shown
    assert format_label(vehicle, "lost", "mph") == "v0  lost"
    unknown = replace(rejected("v2"), limit=limit)
    assert unknown.compliance is None and format_label(unknown, "tracking", "mph") == "v2  rejected"


def test_the_speed_of_a_frame_has_the_coverage_factor_of_the_mean() -> None:
    wide = replace(measured("v"), speed_lo=19.0, speed_hi=21.2)  # 1.1 where 0.05 is one standard uncertainty: 22
    assert speed_at(wide, 0) == pytest.approx((20.1, 22 * 0.05))
    assert speed_at(rejected("v"), 2)[1] == pytest.approx(COVERAGE_95 * rejected("v").track.speed_std[2])
    assert "longer" in rejected_advice(rejected("v").reason_code)


def test_without_an_overlay_the_report_has_its_stills_and_no_link(out: Path, tmp_path: Path) -> None:
    write_report(clip_result(), Recording(), tmp_path / "out", "mph", overlay="none")
    assert not (tmp_path / "out" / "overlay.mp4").exists()
    page, with_video = ((folder / "report.html").read_text(encoding="utf-8") for folder in (tmp_path / "out", out))
    assert "overlay.mp4" in with_video and "overlay.mp4" not in page and "overlay video" not in page
    assert page.count('src="data:image/jpeg') == with_video.count('src="data:image/jpeg') > 0
    jpeg = base64.b64encode((out / "pictures" / "v1.jpg").read_bytes()).decode()
    assert page.count(jpeg) >= 2  # on the card and among the stills


def test_lanes_have_the_same_colours_in_the_plan_the_overlay_and_the_text(tmp_path: Path) -> None:
    """Each its own, and none that of a vehicle."""
    result = clip_result()
    (path,) = result.paths
    lower = replace(path, name="lane1", left=path.left + [0, 30], right=path.right + [0, 30])
    result = replace(result, paths=[path, lower], measurements=result.measurements[:1])
    write_report(result, Recording(), tmp_path / "out", "mph")
    page = (tmp_path / "out" / "report.html").read_text()
    plan = plan_plot(result, {"v0": VEHICLE_COLORS[0]})
    with av.open(str(tmp_path / "out" / "overlay.mp4")) as container:
        picture = next(container.decode(video=0)).to_ndarray(format="bgr24").astype(float)
    for i, lane in enumerate(result.paths):
        color = lane_color(i)
        assert color not in VEHICLE_COLORS and color in plan.svg
        assert f'style="background: {color}"></span>Path {lane.name}' in page
        bgr = [int(color[k : k + 2], 16) for k in (5, 3, 1)]
        assert (np.abs(picture - bgr).max(axis=2) < 60).sum() > 20, lane.name
    assert lane_color(0) != lane_color(1)


def test_overlay_plays_with_the_recordings_times(out: Path) -> None:
    with av.open(str(out / "overlay.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height) == (620, 240)
        frames = list(container.decode(stream))
    times = [float(frame.pts * frame.time_base) for frame in frames]
    np.testing.assert_allclose(times, Recording.times - Recording.times[0], atol=1e-4)
    picture = frames[6].to_ndarray(format="rgb24").astype(int)
    blue = (picture[..., 2] - picture[..., 0] > 60).sum()
    assert blue > 100, "the first vehicle's outline is blue"


@pytest.mark.usefixtures("unrendered_plots")
def test_the_overlay_can_show_the_rejected_vehicles_only(result: ClipResult, out: Path, tmp_path: Path) -> None:
    """Their frames follow each other without those in between."""
    late, frames = rejected("late"), [1, 2, 6, 7]
    arrays = {f.name: v[frames] for f in fields(Track) if isinstance(v := getattr(track("late"), f.name), np.ndarray)}
    few = replace(late, track=replace(track("late"), status=["tracking"] * len(frames), **arrays))
    some = replace(result, measurements=[measured("v0"), few])
    write_report(some, Recording(), tmp_path / "some", overlay="rejected")
    with av.open(str(tmp_path / "some" / "overlay.mp4")) as container:
        times = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
    np.testing.assert_allclose(times, [0.0, 0.2, 0.4, 0.6], atol=1e-4)
    pictures = [(folder / "pictures" / "v0.jpg").read_bytes() for folder in (tmp_path / "some", out)]
    assert pictures[0] == pictures[1]
    write_report(replace(some, measurements=[measured("v0")]), Recording(), tmp_path / "none", overlay="rejected")
    assert not (tmp_path / "none" / "overlay.mp4").exists()


@pytest.mark.usefixtures("unrendered_plots")
def test_a_long_recording_has_an_overlay_on_request_only(result: ClipResult, tmp_path: Path) -> None:
    class Long(Recording):
        times = 100.0 * Recording.times

    write_report(result, Long(), tmp_path / "none")
    write_report(result, Long(), tmp_path / "all", overlay="all")
    assert [(tmp_path / name / "overlay.mp4").exists() for name in ("none", "all")] == [False, True]
    page = (tmp_path / "none" / "report.html").read_text(encoding="utf-8")
    assert "--overlay all" in page and page.count('src="data:image/jpeg') > 0


@pytest.mark.slow
def test_wide_pictures_are_scaled(result: ClipResult, tmp_path: Path) -> None:
    class Wide(Recording):
        def __iter__(self) -> Iterator[StereoFrame]:
            for frame in super().__iter__():
                yield replace(frame, left=np.tile(frame.left, (1, 5)), right=np.tile(frame.left, (1, 5)))

    write_report(result, Wide(), tmp_path / "out")
    with av.open(str(tmp_path / "out" / "overlay.mp4")) as container:
        assert container.streams.video[0].width == 1920


@pytest.mark.usefixtures("unrendered_plots")
def test_a_missing_encoder_is_reported(result: ClipResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("paceline.reports.common.video.H264_CODECS", ["no-such-encoder"])
    written = write_report(result, Recording(), tmp_path / "out")
    assert any("no H.264 encoder" in notice for notice in written.notices)
    assert "no H.264 encoder" in (tmp_path / "out" / "report.html").read_text()


def test_nothing_found(tmp_path: Path) -> None:
    """No vehicle: the outputs still say so."""
    empty = ClipResult("c", [], [], {}, {}, ["no vehicle was found"])
    write_report(empty, Recording(), tmp_path / "out")
    assert "No vehicle was detected" in (tmp_path / "out" / "report.html").read_text()
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["vehicles"] == []


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("frames", [0, 1, 5])
def test_tracks_that_are_empty_short_or_unknown(result: ClipResult, tmp_path: Path, frames: int) -> None:
    """A vehicle may be rejected before anything is known of it."""
    blank = {
        "frame": np.arange(frames), "time": np.arange(frames) + 3.0, "status": ["lost"] * frames,
        **{name: np.full(frames, NAN) for name in ("speed", "speed_std", "yaw_rate", "ess")},
        **{name: np.full(frames, NAN) for name in ("refined_speed", "refined_std")},
        **{name: np.full((frames, 4, 2), NAN) for name in ("left", "right")},
        **{name: np.full((frames, 30, 2), NAN) for name in ("particles_left", "particles_right")},
        "position": np.full((frames, 3), NAN), "hidden": np.zeros(frames, bool),
    }  # fmt: skip
    unknown = rejected("v0")
    unknown = replace(unknown, track=replace(unknown.track, **blank), frames=0)
    write_report(replace(result, measurements=[unknown]), Recording(), tmp_path / "out")
    page = Page((tmp_path / "out" / "report.html").read_text())
    assert "Rejected: too few frames" in page.text and "nan" not in page.text


class Page(HTMLParser):
    """The visible text and the addresses of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text, self.tags, self.addresses = "", [], []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_frames_in_which_the_vehicle_is_hidden_do_not_count_and_are_marked(result: ClipResult, tmp_path: Path) -> None:
    hidden = np.isin(np.arange(FRAMES), [0, 4, 5])
    m = measured("v0")
    m = replace(m, frames=7, outline_offset=0.031, track=replace(m.track, hidden=hidden))
    some = replace(result, measurements=[m])
    write_report(some, Recording(), tmp_path / "out", "mph", overlay="none")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "7, over" in page and "; hidden in 3 more frames" in page and "is 0.03 px (RMS) from" in page
    assert page.count("<td>hidden</td>") == 3 and "left image, frame 1" in page and "left image, frame 0" not in page
    assert format_label(m, "hidden", "mph") == "v0  hidden"
    m = replace(m, outline_offset=NAN)
    write_report(replace(result, measurements=[m]), Recording(), tmp_path / "out", "mph", overlay="none")
    assert "look whether it does" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_page_is_complete_and_self_contained(out: Path) -> None:
    page = Page((out / "report.html").read_text())
    text = " ".join(page.text.split())
    assert page.text.strip().startswith("Speeds in road") and "Paceline speed report road road/clip.yaml" in text
    assert "lane0, approaching, 3.0 to 5.0 s" in text and "approaching, 3.6 to 5.0 s" in text
    assert "44.96 ± 0.22 mph, 95 % interval 44.74 to 45.18 mph" in text
    assert "Rejected: too few frames (7 of at least 8)" in text
    assert "Advice:" in text and "for longer" in text
    for part in ("± 0.13 random ± 0.18 systematic", "frame 4 repeats frame 3", "left the picture at frame 11"):
        assert part in text
    assert "0 within the limit, 1 over it, 1 undecided, as the limit lies inside the 95 % interval." in text
    assert "over 40.3 mph" in text and "undecided at 45.1 mph" in text
    for part in ("How it was measured", "What the interval means", "noise.speed", "paceline 0.1.0", "Path lane0"):
        assert part in text
    for cells in camera_rows(CAMERAS):
        assert "".join(cells) in text
    local = {"overlay.mp4", "vehicles.csv", "estimates.csv", "summary.json"}
    assert {a for a in page.addresses if not a.startswith("data:")} == local
    assert "script" not in page.tags
    assert page.tags.count("img") == 3 * (1 + 3 * 2 + 3) + 1  # card, stills and plots of three vehicles, and the plan


@pytest.mark.usefixtures("unrendered_plots")
def test_the_report_of_a_baseline_claims_no_95_percent(result: ClipResult, tmp_path: Path) -> None:
    of_baseline = replace(measured("v0"), systematic_std=NAN, notices=[message("baseline_interval")])
    configuration = {"method": "sift"}
    write_report(
        replace(result, measurements=[of_baseline], configuration=configuration), Recording(), tmp_path / "out"
    )
    text = " ".join(Page((tmp_path / "out" / "report.html").read_text()).text.split())
    assert "44.96 ± 0.22 mph, interval from scatter alone 44.74 to 45.18 mph" in text
    assert "This is an interval from scatter alone" in text and "is no 95 % interval of the true speed" in text
    assert "95 % interval" not in text.replace("no 95 % interval", "").replace("inside the 95 % interval", "")
    assert "was measured by “sift”" in text and "particle filter" not in text
    (vehicle,) = json.loads((tmp_path / "out" / "summary.json").read_text())["vehicles"]
    assert (vehicle["verdict"], vehicle["interval_from"]) == ("measured", "scatter")


def test_the_cameras_are_told_with_their_uncertainty_and_what_it_does_to_a_speed() -> None:
    assert camera_rows(CAMERAS) == [
        ("the right camera exposes later by", "8.00 ± 0.98 ms", "estimated", "0.39 %"),
        ("the left camera reads its rows within", "0.0 ± 9.8 ms", "assumed", "0.20 %"),
        ("the left camera turns, RMS", "0.40 px", "estimated", "–"),
        ("static points are off their epipolar lines, RMS", "0.300 ± 0.098 px", "estimated", "–"),
        ("the calibration’s uncertainty", "–", "assumed", "the systematic part of each speed"),
    ]
    assert camera_rows({}) == camera_rows({"epipolar_px": None, "assumed": []}) == []


@pytest.mark.slow
def test_page_tells_what_the_systematic_part_rests_on(result: ClipResult, tmp_path: Path) -> None:
    assumed = replace(measured("v0"), notices=[message("rig_uncertainty_missing", rig="rig.yaml")])
    for name, m, said in (
        ("stated", measured("v0"), "the systematic part is the uncertainty of the cameras’ calibration that remains"),
        ("assumed", assumed, "the systematic part is the assumed uncertainty of the cameras’ calibration that remains"),
        (
            "exact",
            replace(measured("v0"), systematic_std=NAN),
            "There is no systematic part: the interval is valid only",
        ),
    ):
        write_report(replace(result, measurements=[m]), Recording(), tmp_path / name, overlay="none")
        assert said in " ".join(Page((tmp_path / name / "report.html").read_text()).text.split())


def test_page_escapes_what_comes_from_files(result: ClipResult, tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    others = [replace(rejected("../../<b>"), reason=evil, notices=[evil]), measured(r"$\mathematics{")]
    path = replace(result.paths[0], name=evil)
    nasty = replace(
        result, clip=evil, measurements=[measured(evil), *others], paths=[path], notices=[evil],
        configuration={evil: evil}, versions={evil: evil},
    )  # fmt: skip
    write_report(nasty, Recording(), tmp_path / "out")
    page = Page((tmp_path / "out" / "report.html").read_text())
    assert "script" not in page.tags and "b" not in page.tags
    assert page.text.count(evil) >= 8
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]
    svgs = [a for a in page.addresses if a.startswith("data:image/svg")]
    assert svgs and not any(b"<script" in base64.b64decode(a.split(",")[1]) for a in svgs)


@pytest.mark.slow
def test_vehicle_names_that_clash_keep_their_plots(result: ClipResult, tmp_path: Path) -> None:
    write_report(replace(result, measurements=[measured("a/b"), measured("a b")]), Recording(), tmp_path / "out")
    names = {p.name for p in (tmp_path / "out" / "plots").iterdir()}
    assert {"a_b-speed.png", "a_b_2-speed.png"} < names


def browse(page: Path, folder: Path, width: int = 1280) -> tuple[str, Path, set[str]]:
    """The text that Chromium shows of ``page``, its screenshot, and the addresses that the page asked for."""
    shot, log = folder / "page.png", folder / "net.json"
    # The host rule keeps everything from the network; the log still shows what was asked for.
    quiet = ["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
             "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={folder / 'profile'}"]  # fmt: skip
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", *quiet]
    look = [f"--window-size={width},1400", f"--screenshot={shot}", f"--log-net-log={log}"]
    subprocess.run([*command, *look, page.as_uri()], check=True, capture_output=True, timeout=90)
    dump = [*command, "--dump-dom", page.as_uri()]
    dom = subprocess.run(dump, check=True, capture_output=True, timeout=90, text=True).stdout
    # A browser has requests of its own; those of the page carry its site.
    asked = re.findall(r'"SiteForCookies: {site=file://[^}]*}","url":"(https?:[^"]*)"', log.read_text())
    return " ".join(Page(dom).text.split()), shot, set(asked)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("width", slow_after(1, [820, 1280]))
def test_page_in_a_browser(out: Path, tmp_path: Path, width: int) -> None:
    """The page renders, shows its numbers and asks the network for nothing."""
    text, shot, asked = browse(out / "report.html", tmp_path, width)
    assert "44.96 ± 0.22 mph" in text and "44.74 to 45.18" in text and "over 40.3 mph" in text
    pixels = cv2.imread(str(shot))
    assert pixels is not None and pixels.shape == (1400, width, 3) and pixels.std() > 10
    assert not asked


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_browser_test_detects_requests(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text('<img src="http://example.invalid/x.png">')
    assert browse(tmp_path / "page.html", tmp_path)[2] == {"http://example.invalid/x.png"}


def test_output_folder_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    with OutputFolder(out) as folder:
        (folder / "file").write_text("x")
        assert not out.exists()
    assert (out / "file").read_text() == "x"
    assert os.listdir(tmp_path / "a") == ["b"]


@pytest.mark.parametrize("error", [ValueError("broken"), KeyboardInterrupt()])
def test_output_folder_leaves_nothing_behind(tmp_path: Path, error: BaseException) -> None:
    with pytest.raises(type(error)), OutputFolder(tmp_path / "a" / "b") as folder:
        (folder / "file").write_text("x")
        raise error
    assert os.listdir(tmp_path) == []


def test_output_folder_removes_what_a_killed_process_left(tmp_path: Path) -> None:
    """Nobody locks it; that of a process at work is locked, and one that has just begun may not be locked yet."""
    killed, at_work, begun = (tmp_path / f".out.{name}.partial" for name in ("killed", "at_work", "begun"))
    for folder in (killed, at_work, begun, tmp_path / ".other.killed.partial"):
        folder.mkdir()
        (folder / "report.html").write_text("x")
        if folder != begun:
            os.utime(folder, (0, 0))
    lock = os.open(at_work, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    with OutputFolder(tmp_path / "out") as new, OutputFolder(tmp_path / "out"):
        os.utime(new, (0, 0))
        with OutputFolder(tmp_path / "out"):
            assert new.is_dir()
    os.close(lock)
    assert not killed.exists() and at_work.is_dir() and begun.is_dir() and (tmp_path / ".other.killed.partial").is_dir()


def test_output_folder_replaces_only_its_own_files(tmp_path: Path) -> None:
    (tmp_path / "out" / "plots").mkdir(parents=True)
    (tmp_path / "out" / "mine.txt").write_text("keep")
    (tmp_path / "out" / "report.html").write_text("old")
    with OutputFolder(tmp_path / "out") as folder:
        (folder / "plots").mkdir()
        (folder / "plots" / "v0.png").write_text("new")
        (folder / "report.html").write_text("new")
        assert (tmp_path / "out" / "report.html").read_text() == "old"
    found = {str(p.relative_to(tmp_path)): p.read_text() for p in tmp_path.rglob("*") if p.is_file()}
    assert found == {"out/mine.txt": "keep", "out/report.html": "new", "out/plots/v0.png": "new"}


def test_output_folder_finds_obstacles_before_it_replaces(tmp_path: Path) -> None:
    (tmp_path / "out" / "b").mkdir(parents=True)
    (tmp_path / "out" / "a").write_text("old")
    with pytest.raises(UnusableInput, match="a folder is in the way"), OutputFolder(tmp_path / "out") as folder:
        (folder / "a").write_text("new")
        (folder / "b").write_text("new")
    assert (tmp_path / "out" / "a").read_text() == "old"
    assert sorted(os.listdir(tmp_path / "out")) == ["a", "b"]


def test_output_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("x")
    with pytest.raises(UnusableInput, match="is a file; expected a folder"), OutputFolder(tmp_path / "out"):
        pass
    with pytest.raises(UnusableInput, match="cannot be written"), OutputFolder(tmp_path / "out" / "below"):
        pass


def test_full_disk_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UnusableInput, match="cannot be written here"), OutputFolder(tmp_path / "out") as folder:
        (folder / "file").write_text("x")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert os.listdir(tmp_path) == []


def test_an_input_that_cannot_be_read_is_not_blamed_on_the_output(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), OutputFolder(tmp_path / "out"):
        (tmp_path / "absent.png").read_bytes()


def test_interrupt_while_files_change_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C between two replacements is held back until all are done."""
    (tmp_path / "out").mkdir()
    replace_file = os.replace

    def interrupted(source: Path, target: Path) -> None:
        signal.raise_signal(signal.SIGINT)
        replace_file(source, target)

    monkeypatch.setattr("paceline.reports.common.output_folder.os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt), OutputFolder(tmp_path / "out") as folder:
        (folder / "a").write_text("new")
        (folder / "b").write_text("new")
    assert sorted(os.listdir(tmp_path / "out")) == ["a", "b"]


def test_an_interrupt_just_after_the_folder_is_made_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = Path.mkdir

    def interrupted(folder: Path, *args: object) -> None:
        make(folder)
        if folder.name.endswith(".partial"):
            raise KeyboardInterrupt

    monkeypatch.setattr(Path, "mkdir", interrupted)
    with pytest.raises(KeyboardInterrupt), OutputFolder(tmp_path / "new" / "out"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_an_encoder_that_has_no_memory_to_start_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def encode(picture: object) -> None:
        raise av.error.ExternalError(542398533, "Generic error in an external library")

    monkeypatch.setattr(VideoWriter, "_add_stream", lambda self, picture: SimpleNamespace(encode=encode))
    refused = pytest.raises(UnusableInput, match="^overlay.mp4: the encoder .* failed; expected more memory")
    with refused, VideoWriter(tmp_path / "overlay.mp4", 0.2) as video:
        video.add(np.zeros((48, 64, 3), np.uint8), 0.0)
