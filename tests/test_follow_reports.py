"""Reports of a following run: exact tables, a safe and complete page, memory that stays flat."""

from __future__ import annotations

import csv
import json
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_chase
from selection import slow_after
from test_reports import CHROMIUM, Page, browse

from paceline.documents.loading import FollowClip, load_follow
from paceline.follow.following import follow_recording
from paceline.follow.hindsight import at_once
from paceline.follow.history import History
from paceline.follow.results import FollowEstimate, ModelWidth
from paceline.recordings.monocular import CameraFrame, CameraRecording
from paceline.reports.follow import report as follow_report
from paceline.reports.follow.overlay import StillSelection, draw_frame
from paceline.reports.follow.page import format_percent
from paceline.reports.follow.plots import follow_plots
from paceline.reports.follow.report import follow_and_report

NAN = float("nan")
WIDTH = ModelWidth(2.0, 0.01, False)
FRAMES = 60
LOST = range(20, 30)


def estimate(k: int, status: str = "tracking", reason: str = "") -> FollowEstimate:
    x, y, z = position = tiny_chase.truth(k)
    scale = tiny_chase.F / z
    center = np.array([tiny_chase.CX + scale * x, tiny_chase.CY + scale * y])
    seen = status == "tracking"
    corners = np.array(list(tiny_chase.TARGET["corners"].values()))
    lines = center + scale * np.stack([corners[:4], np.roll(corners[:4], -1, axis=0)], axis=1)
    points = lines.mean(axis=1) if seen else np.zeros((0, 2))
    return FollowEstimate(
        frame=k, time=k / 15, center=center, scale=float(tiny_chase.NOMINAL / z),
        weights=np.array([5.0, 6.0, 70.0]) if seen else np.zeros(3), position=position,
        position_std=np.array([0.01, 0.02, 0.03]), bearing=float(np.arctan2(x, z)), steering=0.02, status=status,
        reason=reason, residual=0.25 if seen else NAN, lines=lines, points=points,
        owners=np.arange(len(points)), window=(20, 30, 200, 180), latency=0.0004 + 1e-6 * k,
    )  # fmt: skip


def run(k: int) -> FollowEstimate:
    if k not in LOST:
        return estimate(k)
    return estimate(k, "coasting" if k < 25 else "lost", "too few lines")


class Feed:
    """A recording of the small chase in memory, one frame of which is damaged."""

    name, notices = "memory", ["the lens is dirty"]

    def label(self, frame: int) -> str:
        return f"frame {frame}"

    def read(self, start: int) -> Iterator[CameraFrame]:
        for k in range(start, FRAMES):
            yield CameraFrame(k, k / 15, None if k == 22 else tiny_chase.picture(k))


@dataclass
class Prepared:
    """In place of the tracker: estimates made before."""

    def update(self, image: np.ndarray | None, time: float, frame: int, pose: object) -> FollowEstimate:
        return run(frame)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> FollowClip:
    return load_follow(tiny_chase.write(tmp_path_factory.mktemp("chase"), 2))


@pytest.fixture(scope="module")
def out(clip: FollowClip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report(clip, tmp_path_factory.mktemp("report") / "out")


def report(clip: FollowClip, out: Path) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("paceline.follow.following.tracker_for", lambda *_: Prepared())
        patch.setattr("paceline.follow.following.in_hindsight", at_once)
        patch.setattr(follow_report, "open_camera", lambda c: CameraRecording(c.camera, Feed(), FRAMES))
        follow_and_report(clip, out)
    return out


def test_an_estimate_prints_as_one_line() -> None:
    x, y, z = tiny_chase.truth(7)
    assert repr(estimate(7)) == str(estimate(7))
    assert repr(estimate(7)) == (
        f"<FollowEstimate frame 7, 0.467 s: tracking, x {x:.3f} ± 0.020, y {y:.3f} ± 0.039, z {z:.3f} ± 0.059 m, 95 %, "
        "steering +0.0200 rad>"
    )
    assert "frame 26, 1.733 s: lost (too few lines), x " in repr(run(26))


def test_files(out: Path) -> None:
    names = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file())
    plots = [f"plots/{name}.png" for name in ("bearing", "confidence", "latency", "range", "residual")]
    assert names == sorted(["track.csv", "summary.json", "report.html", "overlay.mp4", *plots])


def test_the_track_is_exact(out: Path) -> None:
    with (out / "track.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert ",".join(rows[0]) == (
        "frame,time_s,cx,cy,scale,w_x,w_y,w_scale,x_m,y_m,z_m,steering_rad,status,"
        "reason,x_std_m,y_std_m,z_std_m,bearing_rad,residual_px,latency_s"
    )
    assert len(rows) == FRAMES
    expected, row = run(7), rows[7]
    assert (row["frame"], row["status"], row["reason"]) == ("7", "tracking", "")
    for column, value in {
        "time_s": 7 / 15, "cx": expected.center[0], "cy": expected.center[1], "scale": expected.scale, "w_x": 5.0,
        "w_y": 6.0, "w_scale": 70.0, "x_m": expected.position[0], "y_m": expected.position[1],
        "z_m": expected.position[2], "steering_rad": 0.02, "x_std_m": 0.01, "y_std_m": 0.02, "z_std_m": 0.03,
        "bearing_rad": expected.bearing, "residual_px": 0.25, "latency_s": expected.latency,
    }.items():  # fmt: skip
        assert float(row[column]) == value, column
    assert (rows[26]["status"], rows[26]["reason"], rows[26]["residual_px"]) == ("lost", "too few lines", "")
    assert "nan" not in (out / "track.csv").read_text()


def test_the_summary_is_exact(out: Path) -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    found = json.loads((out / "summary.json").read_text(), parse_constant=refuse)
    tracked = [k for k in range(FRAMES) if k not in LOST]
    ranges = [tiny_chase.truth(k)[2] for k in tracked]
    assert found["frames"] == FRAMES and found["tracked_share"] == len(tracked) / FRAMES
    assert found["status"] == {"tracking": 50, "coasting": 5, "lost": 5}
    assert found["reasons"] == {"too few lines": 10}
    assert found["episodes"] == [
        {"first_frame": 20, "last_frame": 29, "start_s": 20 / 15, "stop_s": 29 / 15, "status": "lost",
         "reason": "too few lines"}
    ]  # fmt: skip
    assert found["range_m"] == {
        "min": min(ranges), "mean": pytest.approx(np.mean(ranges)), "max": max(ranges), "typical_std": 0.03,
    }  # fmt: skip
    assert found["latency_s"]["max"] == run(FRAMES - 1).latency
    assert found["notices"] == ["the lens is dirty", "frame 22: cannot be decoded and left out"]


def test_the_page_is_complete_and_self_contained(out: Path) -> None:
    html = (out / "report.html").read_text()
    page = Page(html)
    text = " ".join(page.text.split())
    ranges = [tiny_chase.truth(k)[2] for k in range(FRAMES) if k not in LOST]
    span = f"{min(ranges):.1f} to {max(ranges):.1f} m ahead"
    assert (
        f"The small van, 2.000 ± 0.020 m wide (± assumed), was tracked in 83.3 % of 60 frames, over 3.9 s, {span}."
        in text
    )
    assert "50 tracking, 5 coasting, 5 lost" in text
    assert "<td>20 to 29</td><td>1.33</td><td>1.93</td><td>lost</td><td>too few lines</td>" in html
    assert "typically known within ± 0.059 m" in text  # 1.96 times 0.03
    for part in ("the lens is dirty", "Advice:", "Terms", "wheelbase", "paceline"):
        assert part in text
    assert {a for a in page.addresses if not a.startswith("data:")} == {"overlay.mp4", "track.csv", "summary.json"}
    assert "script" not in page.tags
    assert page.tags.count("img") == 5 + len([a for a in page.addresses if a.startswith("data:image/jpeg")])
    assert 2 < page.tags.count("img") - 5 <= 6


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_page_in_a_browser(out: Path, tmp_path: Path) -> None:
    text, shot, asked = browse(out / "report.html", tmp_path)
    assert "tracked in 83.3 %" in text
    assert "The small van, 2.000 ± 0.020 m wide (± assumed)" in text and "by ± 0.98 %." in text
    assert "Steering angle: towards the lead itself" in text and "indicates a tracking error" not in text
    assert cv2.imread(str(shot)).std() > 10
    assert not asked


def test_the_page_escapes_what_comes_from_files(clip: FollowClip, tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    report(replace(clip, path=Path(evil), target=replace(clip.target, name=evil)), tmp_path / "out")
    page = Page((tmp_path / "out" / "report.html").read_text())
    assert "script" not in page.tags and page.text.count(evil) >= 2


@pytest.mark.parametrize(("share", "words"), [(1.0, "100 %"), (0.99999, "99.9 %"), (0.5, "50.0 %"), (0.0, "0 %")])
def test_a_share_is_never_rounded_up_to_all(share: float, words: str) -> None:
    assert format_percent(share) == words


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("status", ["tracking", "lost"])
@pytest.mark.parametrize("count", slow_after(1, [1, 2]))
def test_plots_of_short_runs(status: str, count: int) -> None:
    history = History()
    for k in range(count):
        history.add(estimate(k, status))
    plots = follow_plots(history.result("c", "t", WIDTH, "lead", {}, {}, {}, [], 1.0))
    assert [p.name for p in plots] == ["range", "bearing", "confidence", "residual", "latency"]
    assert all(p.png and "mathdefault" not in p.svg for p in plots)


@pytest.mark.slow
def test_plots_count_from_the_first_frame() -> None:
    """A device's clock counts from when the computer was switched on."""
    begun = 2.0**15  # s, so that nothing is rounded
    early, late = History(), History()
    for k in range(0, 60, 15):
        early.add(run(k))
        late.add(replace(run(k), time=run(k).time + begun))
    plots = [follow_plots(history.result("c", "t", WIDTH, "lead", {}, {}, {}, [], 1.0)) for history in (early, late)]
    assert [a.svg for a in plots[0]] == [b.svg for b in plots[1]]


def test_a_picture_shows_what_was_found() -> None:
    image = tiny_chase.picture(5)
    frame = CameraFrame(5, 5 / 15, image)
    plain = draw_frame(frame, image, replace(estimate(5, "lost"), lines=np.full((4, 2, 2), NAN)))
    drawn = draw_frame(frame, image, estimate(5))
    assert plain.shape == drawn.shape == (766, 768, 3)
    changed = np.abs(plain.astype(int) - drawn).max(axis=2) > 40
    left, top, _, _ = tiny_chase.BOXES["body"][:4]
    x, y, z = tiny_chase.truth(5)
    u, v = (3 * (c + tiny_chase.F * (p + side) / z + 0.5) for c, p, side in (
        (tiny_chase.CX, x, left), (tiny_chase.CY, y, top)))  # fmt: skip
    assert changed[40 + int(v) + 20 : 40 + int(v) + 60, int(u) - 2 : int(u) + 2].any(axis=1).all()


def test_large_pictures_are_reduced() -> None:
    image = np.zeros((1080, 2560), np.uint8)
    assert draw_frame(CameraFrame(0, 0.0, image), image, estimate(0)).shape == (850, 1920, 3)


# --- memory --------------------------------------------------------------------------------------------------------


def test_long_runs_are_thinned_evenly() -> None:
    history = History(keep=16)
    for k in range(100):
        history.add(estimate(k))
    frames = history.result("c", "t", WIDTH, "lead", {}, {}, {}, [], 1.0).frame
    assert history.every == 8
    np.testing.assert_array_equal(frames, np.arange(0, 100, 8))
    assert history.tally.frames == 100


def test_everything_is_kept_where_that_is_wanted() -> None:
    history = History(keep=None)
    for k in range(3000):
        history.add(estimate(k % 60))
    assert len(history.result("c", "t", WIDTH, "lead", {}, {}, {}, [], 1.0).frame) == 3000


def test_stills_are_spread_over_the_run() -> None:
    stills = StillSelection()
    image = tiny_chase.picture(0)
    for k in range(500):
        stills.add(image, estimate(k))
    frames = [s.frame for s in stills.selected]
    assert frames[0] == 0 and 3 <= len(frames) <= 6 and len(set(np.diff(frames))) == 1 and frames[-1] >= 250


def test_stills_show_where_the_target_was_left() -> None:
    stills = StillSelection()
    for k in range(500):
        stills.add(tiny_chase.picture(0), estimate(k, "coasting" if 321 <= k < 330 else "tracking"))
    assert [s.caption for s in stills.selected if s.frame == 321] == ["coasting"]


def test_memory_is_flat() -> None:
    """Ten times as many frames, each with a reason of its own, take no more."""
    history, stills = History(keep=200), StillSelection()
    image = tiny_chase.picture(0)

    def add(start: int, stop: int) -> int:
        for k in range(start, stop):
            e = estimate(k % 60, ("tracking", "coasting")[k % 2], f"the time jumps by {k} s")
            history.add(e)
            if k % 50 == 0:
                stills.add(image, e)
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = add(0, 2000)
        after = add(2000, 12000)
    finally:
        tracemalloc.stop()
    assert after - before < 50_000  # bytes; every second frame alone would be a megabyte of rows
    assert sum(history.tally.reasons.values()) == 12000


def test_the_result_as_arrays(tmp_path: Path) -> None:
    """The Python API without files."""
    result = follow_recording(tiny_chase.write(tmp_path / "clip", 12))
    true = np.array([tiny_chase.truth(k) for k in range(12)])
    np.testing.assert_array_equal(result.frame, np.arange(12))
    assert result.status == ["tracking"] * 12
    np.testing.assert_allclose(result.position[:, 2], true[:, 2], rtol=0.01)
