"""The width of a vehicle as a person states it, and the documents that list usual ones."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from paceline.errors import UnusableInput
from paceline.targets.stated_width import ASSUMED_WIDTH_SHARE, USUAL_WIDTHS, checked_width, parse_width


@pytest.mark.parametrize("text", ["1.7±0.05", "1.7 ± 0.05", "1.7+-0.05", " 1.70 +/- 0.050 ", "1.7e0±5e-2"])
def test_a_width_with_its_uncertainty(text: str) -> None:
    width = parse_width(text)
    assert (width.metres, width.half_width, width.assumed) == (1.7, 0.05, False)
    assert width.std == pytest.approx(0.05 / 1.96, rel=1e-3)
    assert str(width) == "1.700 ± 0.050 m"


def test_an_uncertainty_that_nobody_states_is_assumed() -> None:
    assert parse_width("2").assumed and parse_width("2").half_width == 2 * ASSUMED_WIDTH_SHARE
    assert parse_width("2±0").half_width == 0 and not parse_width("2±0").assumed


@pytest.mark.parametrize("text", ["", "wide", "1.7±", "±0.05", "1.7±x", "1.7-0.05", "nan", "170", "0", "1.7±0.9"])
def test_what_is_no_width_is_refused(text: str) -> None:
    with pytest.raises(UnusableInput, match="^--width .*expected"):
        parse_width(text)


def test_usual_widths_are_documented() -> None:
    text = (Path(__file__).parents[1] / "docs" / "following.md").read_text(encoding="utf-8")
    rows = re.findall(r"^ *\| (.+) \| ([\d.]+) ± ([\d.]+) \|$", text, re.MULTILINE)
    assert {kind: (float(width), float(half)) for kind, width, half in rows} == USUAL_WIDTHS
    for width, half in USUAL_WIDTHS.values():
        checked_width(width, half)
