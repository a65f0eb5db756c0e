"""The report of many vehicles: a table that its reader sorts, their distribution, and each vehicle behind a click."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import CHROMIUM, browser
from test_reports import NAN, Page, Recording, clip_result, measured, rejected

from paceline.reports import write_report
from paceline.reports.common.formatting import recording_title
from paceline.reports.common.sortable_table import rank
from paceline.reports.speed.distribution import (
    LIMIT_QUANTILE,
    MANY_VEHICLES,
    MIN_UPPER_LIMIT_VEHICLES,
    describe_distribution,
    percentile_interval,
)
from paceline.speed.results import ClipResult

SPEEDS = [13.0, 15.5, 11.2, 14.1, 12.6, 16.3, 13.3, 12.1, 14.7]  # m/s


def many() -> ClipResult:
    """Nine measured vehicles on two lanes, and one that was rejected."""
    vehicles = [
        replace(measured(f"v{i}"), speed=speed, speed_lo=speed - 0.2, speed_hi=speed + 0.2, path=f"lane{i % 2}")
        for i, speed in enumerate(SPEEDS)
    ]
    vehicles = [replace(vehicle, limit=13.4112) for vehicle in vehicles]
    return replace(clip_result(), measurements=[*vehicles[:4], rejected("refused"), *vehicles[4:]])


@pytest.fixture
def page(tmp_path: Path, unrendered_plots: None) -> Path:
    write_report(many(), Recording(), tmp_path / "out", "mph", overlay="none")
    return tmp_path / "out" / "report.html"


def test_many_vehicles_are_a_table_with_their_distribution(page: Path) -> None:
    source = page.read_text(encoding="utf-8")
    found, text = Page(source), " ".join(html.unescape(re.sub(r"<[^>]*>", " ", source)).split())
    assert "Speeds of 9 vehicles" in text and "mean (± 95 %) 30.5 ± 2.8 mph" in text
    assert "85th percentile 34.3 mph" in text and "9 vehicles are a sample." in text
    assert "limit 30 mph" in text and "29.08 ± 0.45 28.63 to 29.53 within lane0 approaching 3.0 to 5.0" in text
    assert "refused refused" not in text and "too few frames (7 of at least 8)" in text
    assert found.tags.count("details") >= 10 and "script" not in found.tags and 'class="card' not in source


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_table_is_sorted_and_leads_to_each_vehicle(page: Path, tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as new:
        tab = new()
        tab.size(1280, 1200)
        tab.open(page.as_uri())
        tab.wait_for("Speeds of 9 vehicles")
        rows = (
            "[...document.querySelectorAll('.sortable tbody tr')].map((r) => [r.getBoundingClientRect().y,"
            " r.cells[0].innerText]).sort((a, b) => a[0] - b[0]).map((r) => r[1])"
        )
        names = [m.vehicle for m in many().measurements]
        assert tab.run(rows) == names
        by_speed = [f"v{i}" for i in np.argsort(SPEEDS)]
        for button, order in (("speed", [*by_speed, "refused"]), ("-speed", [*by_speed[::-1], "refused"])):
            tab.drag(tab.place(f"document.querySelector('input[value=\"{button}\"]')"))
            assert tab.run(rows) == order
        assert tab.run("document.documentElement.scrollWidth") <= 1280
        box = "document.querySelector('.sortable').parentElement"
        assert tab.run(f"{box}.scrollWidth <= {box}.clientWidth")
        section = "document.getElementById('vehicle-3').closest('details').open"
        assert not tab.run(section)
        tab.click("v3")
        tab.wait(section)
        assert tab.complaints() == []


def test_ranks_keep_the_order_of_equals_and_put_nothing_last() -> None:
    assert rank([3.0, None, 1.0, 3.0, NAN]) == [2, 4, 1, 3, 5]
    assert rank([3.0, None, 1.0, 3.0, NAN], downwards=True) == [1, 4, 3, 2, 5]
    assert rank(["b", "a", None]) == [2, 1, 3] and rank([]) == []


def test_a_handful_has_no_distribution() -> None:
    assert describe_distribution(np.array(SPEEDS[:MANY_VEHICLES]), "mph") is None


def test_the_percentiles_interval_holds_it_as_often_as_stated() -> None:
    samples = np.random.default_rng(1).uniform(0, 1, (2000, 60))
    ends = np.array([percentile_interval(sample, LIMIT_QUANTILE, 0.95) for sample in samples])
    share = float(((ends[:, 0] <= LIMIT_QUANTILE) & (ends[:, 1] >= LIMIT_QUANTILE)).mean())
    assert 0.94 < share < 0.99
    few = np.arange(float(MIN_UPPER_LIMIT_VEHICLES))
    assert np.isfinite(percentile_interval(few, LIMIT_QUANTILE, 0.95)).all()
    assert np.isnan(percentile_interval(few[1:], LIMIT_QUANTILE, 0.95)).tolist() == [False, True]


@pytest.mark.parametrize(
    ("clip", "title"), [("road/clip.yaml", "road"), ("road/north.yaml", "north"), ("clip.yaml", "here")]
)
def test_a_report_is_titled_by_its_recording(
    clip: str, title: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert recording_title(clip) == title
