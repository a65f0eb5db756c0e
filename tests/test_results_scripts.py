"""docs/results.md: every item can be run, every number comes from the committed ones, every picture is there."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "benchmarks"
SHARED = {"items", "drawing", "clips", "repeats", "tables", "methods", "figures", "document", "words", "scenes"}
SCRIPTS = sorted(
    f"{folder}.{file.stem}"
    for folder in ("zhu2012", "nist1993")
    for file in (BENCHMARKS / folder).glob("*.py")
    if file.stem not in SHARED | {"__init__"}
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
def test_every_script_makes_an_item_and_can_be_run(name: str) -> None:
    module = importlib.import_module(name)
    assert module.ITEM.script == name
    assert callable(module.main)


def test_every_script_is_in_the_document(writer: ModuleType) -> None:
    assert sorted(item.script for item in writer.ITEMS) == SCRIPTS
    assert len({item.name for item in writer.ITEMS}) == len(writer.ITEMS)
    for item in writer.ITEMS:
        assert f"### {item.title}\n" in TEXT
        assert f"`{item.command}`" in TEXT


def test_the_document_is_what_the_committed_numbers_make(writer: ModuleType) -> None:
    assert writer.document(RESULTS) == TEXT


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
    for item in writer.ITEMS:
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
    expected = {name for item in writer.ITEMS if item.name in RESULTS["items"] for name in item.pictures}
    assert {file.name for file in folder.iterdir()} == expected
    assert set(re.findall(r"\]\(images/results/([^)]+)\)", TEXT)) == expected
    assert sum(file.stat().st_size for file in folder.iterdir()) < LARGEST


def test_numbers_that_went_stale_are_computed_anew(writer: ModuleType, tmp_path: Path, monkeypatch: Any) -> None:
    items = importlib.import_module("zhu2012.items")
    monkeypatch.setattr(items, "BUILD", tmp_path)
    calls: list[int] = []

    def compute() -> dict[str, Any]:
        calls.append(1)
        return {"shown": {"n": len(calls)}, "drawn": {}}

    def item(**settings: Any) -> Any:
        return items.Item("one", "none", "none", compute, str, settings=settings, rooms=())

    assert item(a=1).up_to_date()["shown"] == {"n": 1}
    assert item(a=1).up_to_date()["shown"] == {"n": 1}
    assert item(a=2).up_to_date()["shown"] == {"n": 2}
    assert len(calls) == 2
