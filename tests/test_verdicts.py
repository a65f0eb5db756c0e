"""The table of verdicts and notices: complete, used, documented, and advice that belongs to the reason."""

from __future__ import annotations

import ast
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from string import Formatter

import pytest

from paceline.reports.common.formatting import GENERAL_ADVICE, rejected_advice
from paceline.verdicts import NO_REASON, VERDICTS_BY_CODE, Message, Severity, advice_for, message

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "src" / "paceline" / "verdicts.py"
SOURCE = {file: file.read_text(encoding="utf-8") for file in sorted((ROOT / "src").rglob("*.py")) if file != TABLE}
DOCUMENTED = {Severity.REJECTED, Severity.UNMEASURED, Severity.NOTHING}
# Words before the colon of a rejection's reason, which programs may rely on.
BEGINNINGS = {
    "no_motion_fits": "residuals",
    "image_residual_too_large": "residuals",
    "too_few_consistent_frames": "residuals",
    "first_frames_inconsistent": "residuals",
    "too_little_texture": "residuals",
    "views_disagree": "views disagree",
    "calibration_inconsistent": "calibration",
    "calibration_inconsistent_jointly": "calibration",
    "calibration_differs_between_vehicles": "calibration",
    "speed_implausible": "implausible",
    "motion_implausible": "implausible",
    "time_unclear": "time",
    "methods_disagree": "estimates disagree",
    "path_deviation_implausible": "implausible",
    "outline_inconsistent": "outline",
    "on_the_road_surface": "outline",
    "appearance_lost_from_start": "unlike itself",
    "left_image_early": "too few frames",
    "lost_early": "too few frames",
    "seen_briefly": "too few frames",
    "interval_too_wide": "interval too wide",
    "interval_too_wide_random": "interval too wide",
    "speed_unknown": "interval too wide",
    "tolerance_exceeded": "interval too wide",
}


def fields(code: str) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(VERDICTS_BY_CODE[code].message) if name}


def made(text: str) -> Iterator[tuple[str, set[str], int]]:
    """The code, the keywords and the line of every call of `message` in a module's ``text``."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "message":
            given = node.args[0]
            for one in [given.body, given.orelse] if isinstance(given, ast.IfExp) else [given]:
                assert isinstance(one, ast.Constant) and isinstance(one.value, str), ast.unparse(node)
                yield one.value, {keyword.arg or "**" for keyword in node.keywords}, node.lineno


def test_every_code_is_produced_and_none_is_misspelt() -> None:
    produced = set()
    for file, text in SOURCE.items():
        for code, given, line in made(text):
            assert code in VERDICTS_BY_CODE, f"{file}:{line}: there is no verdict {code}"
            assert given == fields(code), f"{file}:{line}: {code} has the fields {sorted(fields(code))}"
            produced.add(code)
    assert produced == {*VERDICTS_BY_CODE}


def test_codes_that_are_compared_are_in_the_table() -> None:
    """Where ``code`` or ``reason_code`` is compared with a string, or a collection of them."""
    for file, text in SOURCE.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Compare) and ast.unparse(node.left).endswith(".code"):
                for constant in (c for other in node.comparators for c in ast.walk(other)):
                    if isinstance(constant, ast.Constant) and isinstance(constant.value, str):
                        assert constant.value in VERDICTS_BY_CODE, f"{file}:{node.lineno}: {constant.value}"


@pytest.mark.parametrize("code", VERDICTS_BY_CODE)
def test_a_row_is_well_formed(code: str) -> None:
    verdict = VERDICTS_BY_CODE[code]
    assert re.fullmatch(r"[a-z0-9]+(_[a-z0-9]+)*", code)
    assert verdict.message == verdict.message.strip() != ""
    assert verdict.advice == "" or verdict.advice.endswith((".", "?")) and verdict.advice[0].isupper()
    if verdict.severity in DOCUMENTED:
        assert verdict.advice, f"{code} needs an advice"


def test_a_rejection_keeps_the_words_before_its_colon() -> None:
    rejections = {code: v for code, v in VERDICTS_BY_CODE.items() if v.severity is Severity.REJECTED}
    found = {code: v.message.partition(":")[0] for code, v in rejections.items()}
    assert found == BEGINNINGS


def test_a_message_is_its_text_and_keeps_its_code() -> None:
    reason = message("views_disagree", offset_px=1.44, max_offset_px=1.0)
    assert reason == "views disagree: they lie 1.4 px apart across the epipolar lines (limit 1)"
    assert reason.code == "views_disagree" and "rig check" in reason.advice
    for copy in (pickle.loads(pickle.dumps(reason)), reason.after("v0")):
        assert isinstance(copy, Message) and copy.code == reason.code and copy.endswith(reason)
    assert not NO_REASON and NO_REASON.code == "" == NO_REASON.advice


@pytest.mark.parametrize(
    ("code", "words", "not_words"),
    [
        ("too_little_texture", "grille, lamps and plate", "glare"),
        ("calibration_inconsistent", "paceline rig check", "overlay"),
        ("calibration_inconsistent_jointly", "paceline rig check", "overlay"),
        ("calibration_differs_between_vehicles", "this vehicle's outline", "overlay"),
        ("speed_implausible", "`rate`", "overlay"),
        ("path_deviation_implausible", "longer exposure", "overlay"),
        ("outline_inconsistent", "both outlines mark the same part", "overlay"),
    ],
)
def test_a_reason_gets_the_advice_that_belongs_to_it(code: str, words: str, not_words: str) -> None:
    """Chosen by words of the message these got general advice, or another reason's."""
    assert words in rejected_advice(code) and not_words not in rejected_advice(code)


def test_a_reason_without_a_code_gets_general_advice() -> None:
    """As a method from outside may give it."""
    assert rejected_advice("") == rejected_advice("something_else") == GENERAL_ADVICE
    assert advice_for("something_else") == ""


def rows() -> dict[str, list[str]]:
    """The cells of the tables of docs/troubleshooting.md whose first one is a code, by that code."""
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    found = {}
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if code := re.fullmatch(r"`([a-z0-9_]+)`", cells[0]):
            assert code[1] not in found, f"{code[1]} stands twice"
            found[code[1]] = cells[1:]
    return found


def test_every_verdict_is_documented_with_its_message_and_advice() -> None:
    found = rows()
    assert {*found} == {code for code, verdict in VERDICTS_BY_CODE.items() if verdict.severity in DOCUMENTED}
    for code, (text, advice) in found.items():
        assert text == re.sub(r"\{[^}]*\}", "…", VERDICTS_BY_CODE[code].message), code
        assert advice == VERDICTS_BY_CODE[code].advice, code
