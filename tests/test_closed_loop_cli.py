"""`paceline drive` as a person uses it: what it prints, what it writes, how it ends."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import yaml
from run_command import assert_one_line_error, paceline

from paceline.errors import UnusableInput
from paceline.reports.closed_loop.tables import DRIVE_COLUMNS
from paceline.simulation.closed_loop.drive_yaml import (
    AppearanceModel,
    CutInModel,
    DriveModel,
    LeadModel,
    RequirementsModel,
    RoadModel,
    drive_document,
    resolve_drive,
)
from paceline.simulation.closed_loop.named_scenes import NAMED_SCENES

DOCUMENT = Path(__file__).parents[1] / "docs" / "driving.md"
SHORT: dict[str, Any] = {
    "name": "short",
    "duration": 4.0,
    "road": {"pieces": [[60.0, 0.0], [60.0, 90.0]]},
    "lead": {"kind": "van", "speed": [[0.0, 8.0]]},
    "appearance": {"object_density": 0.3, "traffic": False},
}
FILES = {"drive.csv", "drive.yaml", "summary.json", "report.html", "overlay.mp4", "plots"}


def write(folder: Path, **changes: Any) -> Path:
    file = folder / "drive.yaml"
    file.write_text(yaml.safe_dump(SHORT | changes))
    return file


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The output of one drive, and what was printed."""
    folder = tmp_path_factory.mktemp("drive")
    done = paceline("drive", write(folder), "-o", folder / "out", "--seed", "3", "--latency", "0.2")
    assert done.returncode == 0, done.stderr
    return folder / "out", done.stdout


def test_everything_is_written_and_nothing_else(driven: tuple[Path, str]) -> None:
    out, printed = driven
    assert {p.name for p in out.iterdir()} == FILES
    assert "tracking at the end" in printed and "fails" not in printed
    assert printed.splitlines()[-1] == f"Report: {out / 'report.html'}"


def test_the_table_is_of_the_drive(driven: tuple[Path, str]) -> None:
    out, _ = driven
    rows = list(csv.DictReader((out / "drive.csv").open()))
    assert list(rows[0]) == DRIVE_COLUMNS
    assert [int(r["frame"]) for r in rows] == list(range(60))
    number = {name: np.array([float(r[name]) for r in rows]) for name in DRIVE_COLUMNS[:-2]}
    np.testing.assert_allclose(number["effect_time_s"] - number["time_s"], 0.2)
    step = np.hypot(np.diff(number["chase_x_m"]), np.diff(number["chase_y_m"])) * 15
    np.testing.assert_allclose(step, (number["chase_speed_mps"][1:] + number["chase_speed_mps"][:-1]) / 2, atol=0.02)
    tracking = np.array([r["status"] == "tracking" for r in rows])
    np.testing.assert_allclose(number["z_m"][tracking], number["true_z_m"][tracking], rtol=0.05)


def test_the_summary_lists_the_requirements_and_whether_they_hold(driven: tuple[Path, str]) -> None:
    out, printed = driven
    summary = json.loads((out / "summary.json").read_text())
    assert summary["holds"] is True and summary["latency_s"] == 0.2 and summary["seed"] == 3
    for r in summary["requirements"]:
        assert r["what"] in printed
        assert r["holds"] == (r["value"] >= r["least"] if "least" in r else r["value"] <= r["most"])
    rows = list(csv.DictReader((out / "drive.csv").open()))
    errors = np.array([float(r["path_error_m"]) for r in rows])
    assert summary["path_error_m"]["rms"] == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert summary["clearance_min_m"] == pytest.approx(min(float(r["clearance_m"]) for r in rows))


def test_the_page_is_self_contained_and_the_video_plays(driven: tuple[Path, str]) -> None:
    out, _ = driven
    page = (out / "report.html").read_text()
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", page)
    for file in re.findall(r'href="([\w./]+)"', page):
        assert (out / file).exists(), file
    with av.open(str(out / "overlay.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 60


def test_the_scene_written_drives_again(driven: tuple[Path, str]) -> None:
    document = yaml.safe_load((driven[0] / "drive.yaml").read_text())
    assert DriveModel.model_validate(document) == DriveModel.model_validate(SHORT)


def test_a_failed_requirement_ends_with_1_and_is_listed(tmp_path: Path) -> None:
    file = write(tmp_path, duration=1.0, requirements={"clearance": 50.0})
    done = paceline("drive", file, "-o", tmp_path / "out", "--no-overlay")
    assert done.returncode == 1
    assert re.search(r"least distance to another vehicle .* at least 50.00 m +fails", done.stdout)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["holds"] is False
    assert not (tmp_path / "out" / "overlay.mp4").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"duration": -1.0}, ("duration", "at least 1")),
        ({"road": {"radius": 100.0, "pieces": [[10.0, 0.0]]}}, ("road", "one of radius and pieces")),
        ({"road": {"pieces": [[10.0, 5.0]]}}, ("road", "radius of 12 m")),
        ({"lead": {"speed": []}}, ("lead", "at least one")),
        ({"lead": {"speed": [[0.0, 5.0], [0.0, 6.0]]}}, ("lead", "times that increase")),
        ({"lead": {"speed": [[0.0, 0.0]]}}, ("a lead that moves",)),
        ({"lead": {"speed": [[0.0, 5.0]], "kind": "tank"}}, ("lead.kind", "tank")),
        ({"thrott1e": "gap"}, ("thrott1e", "throttle")),
        ({"requirements": {"stops_within": 5.0}}, ("requirements.stops_within", "vanishes")),
        ({"requirements": {"clearance": 0.0}}, ("requirements.clearance", "above 0")),
    ],
)
def test_a_scene_that_cannot_be_is_refused(tmp_path: Path, changes: dict[str, Any], words: tuple[str, ...]) -> None:
    file = write(tmp_path, **changes)
    with pytest.raises(UnusableInput) as refused:
        resolve_drive(str(file), 1)
    assert "\n" not in str(refused.value)
    for word in (str(file), *words):
        assert word in str(refused.value)


OLD_KEYS: dict[str, Any] = {
    "lead": {"kind": "van", "speed": [[0.0, 8.0]], "haste": 3.0, "bends": 1.2},
    "look": {"crowding": 0.5, "parallel": 0.7, "bounce": 2.0},
    "must": {"max_gap": 20.0},
}
NEW_KEYS: dict[str, Any] = {
    "lead": {"kind": "van", "speed": [[0.0, 8.0]], "max_acceleration": 3.0, "max_lateral_acceleration": 1.2},
    "appearance": {"object_density": 0.5, "parallel_share": 0.7, "shake_px": 2.0},
    "requirements": {"max_gap": 20.0},
}


def test_earlier_names_of_keys_are_accepted(tmp_path: Path) -> None:
    base = {key: value for key, value in SHORT.items() if key not in ("lead", "appearance")}
    (tmp_path / "old.yaml").write_text(yaml.safe_dump(base | OLD_KEYS))
    (tmp_path / "new.yaml").write_text(yaml.safe_dump(base | NEW_KEYS))
    old, new = (resolve_drive(str(tmp_path / name), 1) for name in ("old.yaml", "new.yaml"))
    assert old == new
    assert drive_document(old).items() >= NEW_KEYS.items()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"must": {"clearance": 0.0}}, ("must.clearance", "above 0")),
        ({"must": {}, "requirements": {}}, ("requirements and must", "expected one of them")),
        ({"requirement": {}}, ("unknown key 'requirement'", "'requirements'")),
    ],
)
def test_a_key_is_refused_by_the_name_in_the_file(
    tmp_path: Path, changes: dict[str, Any], words: tuple[str, ...]
) -> None:
    test_a_scene_that_cannot_be_is_refused(tmp_path, changes, words)


def test_what_cannot_be_driven_is_one_plain_line_and_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert_one_line_error(paceline("drive", write(tmp_path, duration=-1.0), "-o", out), "duration", "at least 1")
    assert_one_line_error(paceline("drive", "stops", "-o", out, "--latency", "-1"), "--latency")
    assert not out.exists()


def test_a_wrong_name_is_refused_with_the_right_one(tmp_path: Path) -> None:
    with pytest.raises(UnusableInput, match="brakes-hrad: no such scene; did you mean 'brakes-hard'"):
        resolve_drive("brakes-hrad", 1)
    with pytest.raises(UnusableInput, match="no such file"):
        resolve_drive(str(tmp_path / "no.yaml"), 1)


def test_every_scene_key_and_column_is_documented() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for name in NAMED_SCENES:
        assert f"`{name}`" in text, name
    for column in DRIVE_COLUMNS:
        assert f"`{column}`" in text, column
    for model in (DriveModel, RoadModel, LeadModel, CutInModel, AppearanceModel, RequirementsModel):
        for key in model.model_fields:
            assert f"`{key}`" in text, f"{model.__name__}: {key}"
