"""docs/results.md: every item can be run, every number comes from the committed ones, every picture is there."""

from __future__ import annotations

import importlib
import json
import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from paceline.simulation.stereo.clip import Scene, Vehicle, render, write

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "benchmarks"
SCRIPTS = sorted(
    f"{folder}.{file.stem}"
    for folder in ("zhu2012", "nist1993")
    for file in (BENCHMARKS / folder).glob("*.py")
    if "\nREPRODUCTION = " in file.read_text(encoding="utf-8")
)
RESULTS: dict[str, Any] = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
TEXT = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
LARGEST = 2.5e6  # bytes, of all pictures together


@pytest.fixture(scope="module", autouse=True)
def path() -> Iterator[None]:
    """The benchmarks can be imported, as `make results` has it."""
    sys.path.insert(0, str(BENCHMARKS))
    yield
    sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def writer() -> ModuleType:
    return importlib.import_module("zhu2012.document")


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_script_makes_an_item_and_can_be_run(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    item = importlib.import_module(name).REPRODUCTION
    assert item.script == name
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    monkeypatch.delitem(sys.modules, name)  # or it would be said to be run a second time
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(name, run_name="__main__")
    assert ended.value.code == 0
    assert " ".join(item.title.split()) in " ".join(capsys.readouterr().out.split())


def reproduce(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int | str | None:
    """The exit status of benchmarks/reproduce.py."""
    monkeypatch.setattr(sys, "argv", ["reproduce.py", *arguments])
    monkeypatch.delitem(sys.modules, arguments[0], raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(BENCHMARKS / "reproduce.py"), run_name="__main__")
    return ended.value.code


def test_an_item_is_reproduced_by_the_documented_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = r"^`\.venv/bin/python benchmarks/reproduce\.py (.+)` — [1-9]\d* processor seconds"
    commands = re.findall(command, TEXT, re.MULTILINE)
    assert sorted(commands) == SCRIPTS and "PYTHONPATH" not in TEXT
    assert reproduce(monkeypatch, "zhu2012.table_1a", "--help") == 0
    assert "Table I(a)" in capsys.readouterr().out


def test_without_the_extra_one_line_names_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert 'pip install -e ".[simulation]"' in TEXT
    importlib.import_module("zhu2012.table_1a")
    monkeypatch.setattr(sys.modules["zhu2012.reproductions"], "BUILD", tmp_path)
    monkeypatch.setattr("paceline.simulation.raytraced.stereo_clip.default_variant", lambda: "scalar_rgb")
    monkeypatch.setitem(sys.modules, "mitsuba", None)  # as where it is not installed
    assert reproduce(monkeypatch, "zhu2012.table_1a") == 2
    told = capsys.readouterr().err
    assert (
        told.count("\n") == 1
        and told.startswith("zhu2012.table_1a: rendering needs Mitsuba")
        and "`simulation`" in told
    )


def test_every_script_is_in_the_document(writer: ModuleType) -> None:
    assert sorted(item.script for item in writer.REPRODUCTIONS) == SCRIPTS
    assert len({item.name for item in writer.REPRODUCTIONS}) == len(writer.REPRODUCTIONS)
    for item in writer.REPRODUCTIONS:
        assert f"### {item.title}\n" in TEXT
        assert f"`{item.command}`" in TEXT


def test_the_document_is_what_the_committed_numbers_make(writer: ModuleType) -> None:
    assert writer.document(RESULTS) == TEXT


def test_the_committed_numbers_are_such_as_the_project_promises() -> None:
    """So that a document made anew does not tell of a failure that nobody has read."""
    shown = {name: item["shown"] for name, item in RESULTS["items"].items()}
    drive, failures = shown["nist-long"], shown["nist-failures"]
    assert drive["failed"] == [] and drive["frames"] == 15_300
    for scenario in (failures["strong shadows"], failures["parallel edges"]):
        assert scenario["all remedies"]["wrong"] == 0
        assert scenario["all remedies"]["lost"] < 0.1 * scenario["as published"]["lost"]
    for table in (shown["table-1a"], shown["table-2a"]):
        assert table["refined"]["measured"] == 5 and table["refined"]["max"] <= table["refined"]["half"]


def numbers(value: Any) -> Iterator[float]:
    if isinstance(value, dict):
        for key, inside in value.items():
            yield from numbers(inside)
            if re.fullmatch(r"[\d.]+", key):
                yield float(key)
    elif isinstance(value, list):
        for inside in value:
            yield from numbers(inside)
    elif isinstance(value, (int, float)):
        yield float(value)


def test_every_number_in_a_table_was_measured_or_printed_in_the_paper(writer: ModuleType) -> None:
    """Independently of how the text is made: each number of a table, to the digits shown, is one of the item's."""
    checked = 0
    for item in writer.REPRODUCTIONS:
        if item.name not in RESULTS["items"]:
            continue
        module = importlib.import_module(item.script)
        paper = np.ravel([v for r in getattr(module, "PAPER", ()) for v in r]).tolist()
        known = [*numbers(RESULTS["items"][item.name]["shown"]), *paper, *numbers(item.settings)]
        section = TEXT.split(f"### {item.title}\n")[1].split("\n##")[0]
        for line in section.splitlines():
            cells = [c.strip() for c in line.strip("|").split("|")] if line.startswith("| ") else []
            for cell in cells:
                if not re.fullmatch(r"[+-]?\d+(\.\d+)?", cell):
                    continue
                digits = len(cell.partition(".")[2])
                half = 0.5000001 * 10**-digits
                assert any(abs(float(cell) - v) <= half for v in known), (item.name, line, cell)
                checked += 1
    assert checked > 100


def test_the_pictures_are_there_and_small(writer: ModuleType) -> None:
    folder = writer.PICTURES
    expected = {name for item in writer.REPRODUCTIONS if item.name in RESULTS["items"] for name in item.pictures}
    assert {file.name for file in folder.iterdir()} == expected
    assert set(re.findall(r"\]\(images/results/([^)]+)\)", TEXT)) == expected
    assert sum(file.stat().st_size for file in folder.iterdir()) < LARGEST


def test_numbers_that_went_stale_are_computed_anew(writer: ModuleType, tmp_path: Path, monkeypatch: Any) -> None:
    items = importlib.import_module("zhu2012.reproductions")
    monkeypatch.setattr(items, "BUILD", tmp_path)
    calls: list[int] = []

    def compute() -> dict[str, Any]:
        calls.append(1)
        return {"shown": {"n": len(calls)}, "drawn": {}}

    def item(**settings: Any) -> Any:
        return items.Reproduction("one", "none", "none", compute, str, settings=settings, rooms=())

    assert item(a=1).up_to_date()["shown"] == {"n": 1}
    assert item(a=1).up_to_date()["shown"] == {"n": 1}
    assert item(a=2).up_to_date()["shown"] == {"n": 2}
    assert len(calls) == 2


def test_changed_words_leave_the_numbers_and_changed_settings_do_not(writer: ModuleType) -> None:
    """Of items whose parts are written once for several scripts: what only shows is no part of the key."""
    item = importlib.import_module("zhu2012.figures_5_6").REPRODUCTION
    computing = item._computing()
    assert "def compute(" in computing and "all_methods" in computing
    assert "def text(" not in computing and "def draw(" not in computing
    others = [importlib.import_module(f"zhu2012.{name}").REPRODUCTION for name in ("figures_8_9", "figures_10_11")]
    assert all(other.settings != item.settings for other in others)


def test_what_is_not_run_stays_as_committed(writer: ModuleType, tmp_path: Path, monkeypatch: Any) -> None:
    """A clone has no cached numbers; an item of other settings than those committed has none at all."""
    monkeypatch.setattr(importlib.import_module("zhu2012.reproductions"), "BUILD", tmp_path)
    monkeypatch.setattr(writer, "PICTURES", tmp_path)
    name, other = list(RESULTS["items"])[:2]
    changed = {"items": RESULTS["items"] | {name: RESULTS["items"][name] | {"settings": {"particles": 1}}}}
    found = writer.run([], True, changed)["items"]
    assert name not in found and found[other] == RESULTS["items"][other]
    assert set(found) == set(RESULTS["items"]) - {name}


def test_disparities_are_drawn_where_the_vehicle_is(writer: ModuleType, tmp_path: Path, monkeypatch: Any) -> None:
    """Middle grey is the disparity at the depth of the track: true ones leave the outline so, within half a pixel."""
    clips, figures = (importlib.import_module(f"zhu2012.{name}") for name in ("clips", "figures"))
    scene = Scene(31, (Vehicle("v0", 18.0, start_distance=40.0),), image_size=(640, 480), focal=1400.0, frames=3)
    write(render(scene), tmp_path)
    monkeypatch.setattr(clips, "clip_folder", lambda name: tmp_path)
    view, frames = clips.loaded("planar"), [0, 1, 2]
    truth = {"frame": frames, "left": view.true("v0", frames, "left").tolist()}
    Z = view.true("v0", frames, "position")[:, 2]
    run = {"frame": [0, 1], "left": truth["left"], "depth": Z.tolist()}
    pictures = figures.disparities("planar", run, truth, frames, "multimodal")
    half_pixel = 255 / (figures.NEAREST[1] - figures.NEAREST[0]) * 0.5 * Z / (1400.0 * scene.baseline)
    across, down = figures.VIEW
    for picture, slack in zip(pictures[:2], half_pixel, strict=False):
        inside = picture[down // 2 - 10 : down // 2 + 10, across // 2 - 20 : across // 2 + 20]
        assert np.median(inside) == pytest.approx(127.5, abs=slack)
    assert pictures[2][down // 2 :].max() == 0  # lost
