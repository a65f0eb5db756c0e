"""Settings from a file: strict, complete, documented; a summary's own configuration reproduces its result."""

from __future__ import annotations

import json
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args, get_origin

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic.fields import FieldInfo
from run_command import paceline as command

from paceline.errors import UnusableInput
from paceline.reports.speed.tables import write_summary
from paceline.speed.choices import resampling_schemes
from paceline.speed.configuration import (
    BackgroundSettings,
    DetectionSettings,
    Section,
    SpeedConfiguration,
    SpeedSettings,
    load_settings,
)
from paceline.speed.results import ClipResult
from paceline.speed.settings_table import section_of, settings_page
from paceline.units import SpeedUnit

pytestmark = pytest.mark.usefixtures("unrendered_plots")

ROOT = Path(__file__).parents[1]
STRAIGHT = ROOT / "examples" / "straight"


def written(folder: Path, text: str) -> Path:
    file = folder / "settings.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def test_every_field_can_be_set_in_a_file(tmp_path: Path) -> None:
    document = json.loads(SpeedSettings(method="sift", device="auto", detector="d.onnx", learn=4.0).model_dump_json())
    found = load_settings(written(tmp_path, yaml.safe_dump(document)))
    assert json.loads(found.model_dump_json()) == document
    assert found.configuration == SpeedConfiguration(background=BackgroundSettings(seconds=4.0))


def test_a_file_sets_what_it_names_and_leaves_the_rest(tmp_path: Path) -> None:
    text = "particles: 60\nlimits: {min_frames: 6}\nstart: {speed_range: [1, 40]}\njoint_calibration: {neighbours: 0}\n"
    c = load_settings(written(tmp_path, text)).configuration
    assert (c.particles, c.limits.min_frames, c.start.speed_range) == (60, 6, (1.0, 40.0))
    assert c.joint_calibration.neighbours == 0 and c.joint_calibration.window_s == 600.0
    assert c.limits.max_speed == 90.0 and c.seed == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("particels: 60", "unknown key 'particels'; did you mean 'particles'?"),
        ("limits: {min_frame: 6}", "limits: unknown key 'min_frame'; did you mean 'min_frames'?"),
        ("particles: 10", "particles: expected at least 20, found 10"),
        ("particles: '60'", "particles: expected a whole number, found '60'"),
        ("particles: 60.5", "particles: expected a whole number, found 60.5"),
        ("refine: 1", "refine: expected true or false, found 1"),
        ("motion: straight", "motion: expected 'auto', 'free', 'line' or 'curve', found 'straight'"),
        ("reference_memory: 1", "reference_memory: expected a number below 1, found 1"),
        ("tolerance: .inf", "tolerance: expected a finite number, found inf"),
        ("limits: 4", "limits: expected the keys min_frames, max_speed"),
        ("start: {speed_range: [40, 1]}", "start.speed_range: expected two numbers above 0, the smaller one first"),
        ("start: {speed_range: 3}", "start.speed_range: expected two numbers above 0"),
        ("detection: {min_size_px: [16, 0]}", "detection.min_size_px: expected two numbers above 0"),
        ("detection: {near: 20, far: 20}", "detection: expected near below far"),
        ("driver: {brake: 2}", "driver: unknown key 'brake'; did you mean 'braking'?"),
        ("model: {log_odds: 2}", "model: unknown key 'log_odds'; did you mean 'min_log_odds'?"),
        ("background: {second: 2}", "background: unknown key 'second'; did you mean 'seconds'?"),
        ("background: {frames: 4}", "background.frames: expected at least 5, found 4"),
        ("background: {seconds: 4}\nlearn: 5", "learn and background.seconds: one key under two names"),
        ("report: {units: knots}", "report.units: expected 'mph', 'km/h' or 'm/s', found 'knots'"),
        ("report: {unit: mph}", "report: unknown key 'unit'; did you mean 'units'?"),
        ("lanes: {widths: [2, 3]}", "lanes: unknown key 'widths'; did you mean 'width'?"),
        ("seed: 1\nseed: 2", "line 2, column 1: the key 'seed' occurs twice"),
        ("- 1", "expected the keys particles, seed"),
        ("", "expected the keys particles, seed"),
    ],
)
def test_invalid_settings_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(UnusableInput, match=re.escape(f"settings.yaml: {message}")):
        load_settings(written(tmp_path, text))


def test_learn_is_the_earlier_name_of_the_backgrounds_time(tmp_path: Path) -> None:
    for text in ("learn: 12", "background: {seconds: 12}", "learn: 12\nbackground: {seconds: 12, frames: 31}"):
        assert load_settings(written(tmp_path, text)).configuration.background == BackgroundSettings(seconds=12.0)


def test_the_command_names_the_file_and_the_key(tmp_path: Path) -> None:
    done = command("speed", STRAIGHT, "-o", tmp_path / "out", "--config", written(tmp_path, "partikles: 60"))
    assert done.returncode == 2 and not (tmp_path / "out").exists()
    expected = f"{tmp_path / 'settings.yaml'}: unknown key 'partikles'; did you mean 'particles'?"
    assert done.stderr == f"paceline: {expected}\n"


def test_a_detector_that_a_file_names_lies_beside_it(tmp_path: Path) -> None:
    text = "detector: none.onnx (SHA-256 0123456789ab…)"  # as a summary names it
    clip = tmp_path / "clip.yaml"
    document = yaml.safe_load((STRAIGHT / "clip.yaml").read_text(encoding="utf-8"))
    for key in ("left", "right", "rig"):
        document[key] = str(STRAIGHT / document[key])
    clip.write_text(yaml.safe_dump(document | {"vehicles": []}), encoding="utf-8")
    done = command("speed", clip, "-o", tmp_path / "out", "--config", written(tmp_path, text))
    assert done.returncode == 2
    assert str(tmp_path / "none.onnx") in done.stderr and done.stderr.count("\n") == 1
    (tmp_path / "none.onnx").write_bytes(b"another network")
    done = command("speed", clip, "-o", tmp_path / "out", "--config", tmp_path / "settings.yaml")
    assert done.returncode == 2 and "settings.yaml: detector: expected none.onnx (SHA-256 0123456789ab…)" in done.stderr


def test_a_summarys_configuration_reproduces_the_result(small_clip: Path, tmp_path: Path) -> None:
    """Options win over the file, and a file over the defaults."""
    text = "method: sift\nparticles: 77\nseed: 3\nlimits: {max_half_width: 0.5}\nreport: {overlay: false}\n"
    file = written(tmp_path, text)
    options = ["--quiet", "--config"]
    first = command("speed", small_clip, "-o", tmp_path / "first", "--seed", "5", *options, file)
    assert first.returncode == 0, first.stderr
    summary = summary_of(tmp_path / "first")
    c = summary["configuration"]
    assert (c["method"], c["particles"], c["seed"], c["limits"]["max_half_width"]) == ("sift", 77, 5, 0.5)
    again = written(tmp_path, json.dumps(c))
    assert command("speed", small_clip, "-o", tmp_path / "again", *options, again).returncode == 0
    assert summary_of(tmp_path / "again") == summary
    tables = [(tmp_path / name / "estimates.csv").read_text() for name in ("first", "again")]
    assert tables[0] == tables[1]


def values_of(field: FieldInfo) -> st.SearchStrategy[Any]:
    """Any value that a field may hold."""
    limits = {name: getattr(m, name) for m in field.metadata for name in ("gt", "ge", "lt", "le") if hasattr(m, name)}
    kind = field.annotation
    if (section := section_of(field)) is not None:
        return configurations(section)
    if get_origin(kind) is Literal:
        return st.sampled_from(get_args(kind))
    if kind is SpeedUnit:
        return st.sampled_from(SpeedUnit)
    if kind is bool:
        return st.booleans()
    if kind is str:
        return st.sampled_from(resampling_schemes())
    if kind is int:
        return st.integers(limits["ge"], limits.get("le"))
    low, high = limits.get("gt", limits.get("ge", 0.0)), limits.get("lt", limits.get("le"))
    numbers = st.floats(low, high, exclude_min="gt" in limits, exclude_max="lt" in limits, allow_infinity=False)
    if get_origin(kind) is tuple:
        return st.tuples(st.floats(1e-3, 1.0), st.floats(1.5, 1e6))
    return numbers if kind is float else st.none() | numbers


def configurations(section: type[Section]) -> st.SearchStrategy[Any]:
    keys = section.model_fields
    if section is DetectionSettings:
        keys = {name: field for name, field in keys.items() if name not in ("near", "far")}
    return st.builds(section, **{name: values_of(field) for name, field in keys.items()})


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(configurations(SpeedConfiguration))
def test_a_configuration_stands_in_the_summary_as_it_is(c: SpeedConfiguration) -> None:
    with TemporaryDirectory() as folder:
        out = Path(folder)
        write_summary(ClipResult("clip.yaml", [], [], c.model_dump(), {}, [], 0.0), [], out / "summary.json")
        assert load_settings(written(out, json.dumps(summary_of(out)["configuration"]))).configuration == c


def test_units_and_overlay_are_settings_and_options_win(small_clip: Path, tmp_path: Path) -> None:
    text = "method: sift\nreport: {units: m/s, overlay: false}\n"
    done = command("speed", small_clip, "-o", tmp_path / "out", "--config", written(tmp_path, text))
    assert "speed, m/s" in done.stdout
    assert not (tmp_path / "out" / "overlay.mp4").exists() and (tmp_path / "out" / "report.html").exists()
    assert summary_of(tmp_path / "out")["configuration"]["report"] == {"units": "m/s", "overlay": "none"}
    options = ["--overlay", "all", "--units", "km/h", "--max-half-width", "3.6"]
    done = command("speed", small_clip, "-o", tmp_path / "again", *options, "--config", tmp_path / "settings.yaml")
    c = summary_of(tmp_path / "again")["configuration"]
    assert (tmp_path / "again" / "overlay.mp4").exists()
    assert "speed, km/h" in done.stdout and c["report"]["units"] == "km/h" and c["tolerance"] == 1.0


def summary_of(folder: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return {key: value for key, value in summary.items() if key != "seconds"}


def test_the_page_of_all_settings_is_current() -> None:
    page = ROOT / "docs" / "configuration.md"
    assert page.read_text(encoding="utf-8") == settings_page(), "run: python -m paceline.speed.settings_table"
