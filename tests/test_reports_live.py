"""What a live survey leaves behind, whatever ends it: tables, bounded pictures, and a report."""

from __future__ import annotations

import base64
import csv
import html
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_reports import measured, rejected

from paceline.detection.finder import DetectedVehicle
from paceline.documents.loading import VehicleDocument
from paceline.errors import UnusableInput
from paceline.reports.common.formatting import rejected_advice
from paceline.reports.common.output_folder import write_all_or_none
from paceline.reports.live import report as live_report
from paceline.reports.live.plots import MAX_DRAWN_INTERVALS, speeds_plot
from paceline.reports.live.report import LiveResults
from paceline.speed.results import Measurement
from paceline.verdicts import NO_REASON, advice_for, message

ABOUT: dict[str, object] = {"clip": "road/<i>clip</i>.yaml", "configuration": {"learn": 30.0}, "versions": {"p": "1"}}
DAY = "2026-05-04T10:{:02d}:00+02:00"


def found(k: int) -> DetectedVehicle:
    quad = np.array([[20.0, 30], [60, 30], [60, 50], [20, 50]]) + 100
    crop = np.random.default_rng(k).uniform(0, 255, (80, 90)).astype(np.float32)
    document = VehicleDocument(f"v{k}", "lane0", k, quad, quad + 3, "front", None)
    place, corners = np.array([-1.52, 2.1, 63.7]), np.array([[100.0, 100], [103, 103]])
    times, crops = (10.0 * k, 10.0 * k + 4), (crop, crop)
    return DetectedVehicle("lane0", times, 1.8, 1.5, place, document, NO_REASON, crops, corners)


def passed(k: int, result: Measurement | None = None) -> Measurement:
    return replace(result or measured("v"), vehicle=f"v{k}", track=measured(f"v{k}").track)


def test_the_live_report_lists_every_vehicle(tmp_path: Path) -> None:
    with LiveResults(tmp_path / "out", ABOUT, "mph") as results:
        results.begin()
        results.add(passed(0), found(0), DAY.format(3))
        results.add(passed(1, rejected("v")), found(1), DAY.format(4))
        results.add_unmeasured(found(2), DAY.format(5), message("input_unusable", problem="<b>too small</b>"))
        results.notices.append("3 frames were dropped")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    text = " ".join(html.unescape(re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.S)).split())
    words = ("1 of 2 vehicles measured", "1 more was seen, but could not be measured", "3 frames were dropped",
             "Seen: 2026-05-04, 10:03:00 to 10:05:00", "64 m ahead, 1.5 m left", "10.0 to 14.0",
             "road/<i>clip</i>.yaml", "not measured 64 m ahead",
             "<b>too small</b>. Correct what the message names.")  # fmt: skip
    for word in words:
        assert word in text, word
    first, second = passed(0), passed(1, rejected("v"))
    assert f"{first.speed / 0.44704:.2f} ± 0.22" in text and f"rejected 64 m ahead, 1.5 m left {second.reason}." in text
    assert "limit 40.3 mph" in text and "0 within the limit, 1 over it." in text
    assert "<b>" not in page and "<i>" not in page and "://" not in re.sub(r"data:[^\"]*", "", page)
    pictures = re.findall(r'data:image/jpeg;base64,([^"]+)"', page)
    assert [base64.b64decode(p) for p in pictures] == [
        (tmp_path / "out" / "pictures" / f"v{k}.jpg").read_bytes() for k in (1, 0)
    ]
    assert cv2.imread(str(tmp_path / "out" / "speeds.png")) is not None
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [v["first_seen_m"] for v in summary["vehicles"]] == [[-1.52, 63.7]] * 2
    assert summary["unmeasured"][0]["reason_code"] == "input_unusable"
    assert [v["reason_code"] for v in summary["vehicles"]] == ["", second.reason_code]
    assert rejected_advice(second.reason_code) in text and advice_for("input_unusable") in text
    with (tmp_path / "out" / "vehicles.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row, vehicle in zip(rows, summary["vehicles"], strict=True):
        scalars = {key: value for key, value in vehicle.items() if not isinstance(value, list)}
        assert row == {key: "" if value is None else str(value) for key, value in scalars.items()}
    assert (rows[0]["path"], rows[0]["travel"], rows[0]["picture"]) == ("lane0", "approaching", "pictures/v0.jpg")
    assert summary["unmeasured"][0]["seen_from_s"] == 20.0 and summary["notices"] == ["3 frames were dropped"]


@pytest.mark.parametrize("end", [SystemExit(143), KeyboardInterrupt(), OSError("the camera is gone")])
def test_a_report_is_written_however_a_survey_ends(tmp_path: Path, end: BaseException) -> None:
    with pytest.raises(type(end)), LiveResults(tmp_path, ABOUT, "km/h") as results:
        results.begin()
        results.add(passed(0), found(0), DAY.format(3))
        raise end
    assert "1 of 1 vehicle measured" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_survey_that_ends_before_the_background_is_estimated_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="gone"), LiveResults(tmp_path / "out", ABOUT, "mph"):
        raise OSError("gone")
    assert not (tmp_path / "out").exists()


def test_on_a_full_disk_the_tables_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(contents: dict[Path, bytes]) -> None:
        if any(path.suffix in (".html", ".jpg") for path in contents):
            raise UnusableInput("No space left on device")
        write_all_or_none(contents)

    monkeypatch.setattr(live_report, "write_all_or_none", write)
    with pytest.raises(UnusableInput, match="No space"), LiveResults(tmp_path, ABOUT, "mph") as results:
        results.begin()
        results.add(passed(0), found(0), DAY.format(3))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [v["vehicle"] for v in summary["vehicles"]] == ["v0"] and not (tmp_path / "report.html").exists()


def test_writing_the_summary_takes_a_limited_share_of_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many vehicles there are: one rewrite takes 0.2 s here, so there may be one every 20 s."""
    now, written = 100.0, []

    def write(contents: dict[Path, bytes]) -> None:
        nonlocal now
        write_all_or_none(contents)
        if tmp_path / "summary.json" in contents:
            now += 0.2
            written.append(now)

    monkeypatch.setattr(live_report, "write_all_or_none", write)
    monkeypatch.setattr(live_report.time, "monotonic", lambda: now)
    with LiveResults(tmp_path, ABOUT, "mph") as results:
        results.begin()
        for k in range(100):
            now += 1
            results.add(passed(0), found(k), DAY.format(3))
            results.save()
        assert len(written) == 6 and np.diff(written[1:]).min() >= 20
        stale = json.loads((tmp_path / "summary.json").read_text())
        now += 20
        results.save()
        kept = json.loads((tmp_path / "summary.json").read_text())
        assert len(stale["vehicles"]) < 100 == len(kept["vehicles"])
        now += 100
        results.save()
        assert len(written) == 7  # nothing has changed
        results.add_unmeasured(found(7), DAY.format(4), message("no_planar_face"))
        assert len(json.loads((tmp_path / "summary.json").read_text())["unmeasured"]) == 1
        results.add_unmeasured(found(8), DAY.format(4), message("no_planar_face"))
        assert len(written) == 8
    assert len(json.loads((tmp_path / "summary.json").read_text())["unmeasured"]) == 2


def test_a_survey_without_vehicles_has_a_report(tmp_path: Path) -> None:
    with LiveResults(tmp_path, ABOUT, "mph") as results:
        results.begin()
    assert "No vehicle was measured." in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_number_of_pictures_is_limited_and_reported(tmp_path: Path) -> None:
    with LiveResults(tmp_path, ABOUT, "mph", kept_pictures=3) as results:
        results.begin()
        for k in range(5):
            results.add(passed(k), found(k), DAY.format(k))
            assert len(list((tmp_path / "pictures").iterdir())) == min(k + 1, 3)
    assert sorted(p.name for p in (tmp_path / "pictures").iterdir()) == ["v2.jpg", "v3.jpg", "v4.jpg"]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Only those of the 3 latest vehicles are kept." in page and page.count("in both views") == 3
    assert all(f"<td>v{k}</td>" in page for k in range(5))


@pytest.mark.parametrize("count", [0, 1, MAX_DRAWN_INTERVALS + 1])
def test_any_number_of_vehicles_can_be_plotted(count: int) -> None:
    vehicles: list[dict[str, object]] = [
        {"verdict": "measured", "path": f"lane{k % 9}", "seen_from_s": 7.0 * k, "speed_mps": 20.0, "speed_lo_mps": 19.0,
         "speed_hi_mps": 22.0} for k in range(count)
    ]  # fmt: skip
    plot = speeds_plot(vehicles, "km/h")
    later = [{**v, "seen_from_s": float(str(v["seen_from_s"])) + 2.0**15} for v in vehicles]
    assert speeds_plot(later, "km/h").svg == plot.svg  # a device's clock counts from when the computer was switched on
    assert ("no vehicle was measured" in plot.svg) == (count == 0)
    assert ("minutes since" in plot.svg) == (count > 100) and "speed, km/h" in plot.svg
