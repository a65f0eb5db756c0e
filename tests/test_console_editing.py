"""Set-ups in clip.yaml, and what the console proposes and says while one is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_clips import put_clip, rendered
from yaml.composer import Composer

from paceline.cameras import Camera, StereoRig
from paceline.console.editing.clip_document import (
    ClipSetup,
    FileChanged,
    read_clip_setup,
    read_site_paths,
    save_clip_setup,
    with_clip_setup,
)
from paceline.console.editing.edge_snapping import snap_point
from paceline.console.editing.geometry_checks import check_setup, epipolar_line, propose_in_other_view
from paceline.console.frames.frame_cache import FrameCache
from paceline.documents.loading import load_clip
from paceline.errors import UnusableInput
from paceline.geometry import epipolar_distance, triangulate

# --- clip.yaml -------------------------------------------------------------------------------------------------------

WRITTEN = """\
# the crossing in the north
left: left
right: right
rate: 5   # frames per second
rig: rig.yaml

# where they drive
paths:
  # the kerb
  lane0:  # painted twice
    shape: line
    left: [[100.0, 400.0], [300.0, 250.0]]
    right: [[80.0, 400.0], [290.0, 250.0]]
  lane1: {shape: line, left: [[10, 20], [30, 40]], right: [[11, 20], [31, 40]]}
# and what does
vehicles:
- id: v0  # the van
  frame: 0
  left: [[1, 1], [50, 1], [50, 30], [1, 30]]
  right: [[1, 1], [50, 1], [50, 30], [1, 30]]
- {id: v1, frame: 1, left: [[1, 1], [50, 1], [50, 30], [1, 30]], right: [[1, 1], [50, 1], [50, 30], [1, 30]]}
# the end
"""


def drawn(text: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    found = yaml.safe_load(text)
    paths, vehicles = found.get("paths") or {}, found.get("vehicles") or []
    for entry in [*paths.values(), *vehicles]:
        for side in ("left", "right"):
            entry[side] = [[float(x), float(y)] for x, y in entry[side]]
    return paths, vehicles


def test_what_stays_the_same_keeps_every_line() -> None:
    assert with_clip_setup(WRITTEN, Path("clip.yaml"), *drawn(WRITTEN)) == WRITTEN


def test_a_change_touches_only_its_own_lines() -> None:
    paths, vehicles = drawn(WRITTEN)
    vehicles[1]["frame"] = 3
    paths["new: #"] = {"shape": "curve", "left": [[1.5, 2.0]] * 4, "right": [[1.0, 2.0]] * 4}
    new = with_clip_setup(WRITTEN, Path("clip.yaml"), paths, vehicles)
    assert drawn(new) == (paths, vehicles)
    gone = set(WRITTEN.splitlines()) - set(new.splitlines())
    assert len(gone) == 1 and next(iter(gone)).startswith("- {id: v1")
    assert new.index("'new: #'") < new.index("# and what does") < new.index("vehicles:")
    del paths["lane0"]
    removed = with_clip_setup(new, Path("clip.yaml"), paths, [])
    assert drawn(removed) == (paths, []) and "vehicles:" not in removed and "# the end" in removed
    assert "the kerb" not in removed and "# where they drive" in removed


HEADS = [
    "left: a\nright: b\n",
    "left: a\nright: b\npaths:\nvehicles:\n",
    "paths: {}\nleft: a\nvehicles: []\nright: b\n",
    "left: a\r\nright: b\r\n",
    "{left: a, right: b}\n",
    "left: a\nright: b\npaths: {x: {shape: line,\n  left: [[1, 2], [3, 9]],\n  right: [[1, 2], [3, 9]]}}\nrate: 3\n",
]


@pytest.mark.parametrize("head", HEADS)
def test_every_yaml_style_is_edited_or_refused(head: str) -> None:
    paths, vehicles = drawn(WRITTEN)
    try:
        new = with_clip_setup(head, Path("clip.yaml"), paths, vehicles)
    except UnusableInput as error:
        assert "clip.yaml: paths and vehicles: are written in a way" in str(error) and head.startswith("{")
        return
    assert drawn(new) == (paths, vehicles)
    assert {k: v for k, v in yaml.safe_load(new).items() if k in ("left", "right", "rate")}.items() <= yaml.safe_load(
        head
    ).items()


printable = st.characters(codec="utf-8", exclude_categories=["Cs", "Cc", "Zl", "Zp", "Cf", "Co", "Cn", "Zs"])
names = st.text(printable, min_size=1, max_size=12)
points = st.lists(st.tuples(st.integers(-999, 99999), st.integers(-999, 99999)), min_size=2, max_size=5).map(
    lambda found: [[x / 100, y / 100] for x, y in found]
)


@given(st.dictionaries(names, points, max_size=4), st.permutations(["lane0", "lane1"]), st.integers(0, 2))
@settings(deadline=None, max_examples=20)
def test_any_set_up_reads_back(added: dict[str, list[list[float]]], order: list[str], kept: int) -> None:
    before, vehicles = drawn(WRITTEN)
    paths = {name: before[name] for name in order[:kept]}
    paths |= {name: {"shape": "line", "left": p, "right": p} for name, p in added.items()}
    new = with_clip_setup(WRITTEN, Path("clip.yaml"), paths, vehicles[:kept])
    assert drawn(new) == (paths, vehicles[:kept])
    assert with_clip_setup(new, Path("clip.yaml"), paths, vehicles[:kept]) == new


def test_a_set_up_is_saved_whole_or_not_at_all(tmp_path: Path) -> None:
    file = put_clip(tmp_path) / "clip.yaml"
    setup, text = read_clip_setup(file), file.read_text()
    broken = {**setup.vehicles[0], "left": [[0, 0], [1, 0], [1, 1], [0, 1]]}
    with pytest.raises(UnusableInput, match=r"road/clip.yaml: vehicles\[0\].left: is too small"):
        save_clip_setup(file, ClipSetup(setup.paths, [broken], setup.revision))
    unknown = {**setup.vehicles[0], "colour": "red"}
    with pytest.raises(UnusableInput, match="colour"):
        save_clip_setup(file, ClipSetup(setup.paths, [unknown], setup.revision))
    assert file.read_text() == text
    file.chmod(0o664)  # colleagues may write it too
    saved = save_clip_setup(file, ClipSetup(setup.paths, [{**setup.vehicles[0], "id": "car"}], setup.revision))
    assert file.stat().st_mode & 0o777 == 0o664
    assert saved.vehicles[0]["id"] == "car" and [v.id for v in load_clip(file).vehicles] == ["car"]
    with pytest.raises(FileChanged):
        save_clip_setup(file, setup)
    assert sorted(p.name for p in file.parent.iterdir()) == ["clip.yaml", "left", "rig.yaml", "right"]


def test_many_vehicles_are_saved_by_reading_the_old_and_the_new_text_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = put_clip(tmp_path) / "clip.yaml"
    setup = read_clip_setup(file)
    many = [{**setup.vehicles[0], "id": f"v{k}"} for k in range(300)]
    read, compose = [], Composer.compose_document

    def counted(loader: Composer) -> yaml.Node | None:
        read.append(loader)
        return compose(loader)

    monkeypatch.setattr(Composer, "compose_document", counted)
    saved = save_clip_setup(file, ClipSetup(setup.paths, many, setup.revision))
    assert len(read) == 3, "these texts and the rig"
    assert saved == read_clip_setup(file) and saved.vehicles == many


def test_the_paths_of_a_site_are_kept_apart_and_may_be_driven_on(tmp_path: Path) -> None:
    clip = put_clip(tmp_path)
    file, site = clip / Path("clip.yaml"), tmp_path / "site.yaml"
    given = yaml.safe_load(file.read_text())
    site.write_text(yaml.safe_dump({"rig": "road/rig.yaml", "paths": given.pop("paths")}))
    del given["rig"]
    file.write_text(yaml.safe_dump(given | {"site": "../site.yaml"}))
    setup = read_clip_setup(file)
    assert setup.paths == {} and list(read_site_paths(file)) == ["lane0"]
    saved = save_clip_setup(file, ClipSetup({}, [{**setup.vehicles[0], "id": "car"}], setup.revision))
    assert saved.vehicles[0]["path"] == "lane0" and load_clip(file).vehicles[0].id == "car"


# --- in space --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bent() -> StereoRig:
    """A rig whose lenses distort."""
    K = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
    turn = cv2.Rodrigues(np.array([0.01, -0.03, 0.005]))[0]
    left, right = (Camera((640, 480), K, np.array(d)) for d in ([-0.25, 0.08, 1e-3, -5e-4, 0], [-0.2, 0.05, 0, 0, 0]))
    return StereoRig(left, right, turn, np.array([-0.4, 0.01, 0.02]))


@pytest.mark.parametrize("view", [0, 1])
def test_the_epipolar_line_passes_where_the_point_is_seen(bent: StereoRig, view: int) -> None:
    rng = np.random.default_rng(2)
    for depth in (5.0, 20.0, 80.0):
        point = np.array([*rng.uniform(-0.2, 0.2, 2) * depth, depth])
        seen = [c.distort_points(p) for c, p in zip(bent.cameras, bent.project(point), strict=True)]
        found = epipolar_line(bent, view, seen[view])
        line = np.array(found["line"])
        a, d = line[:-1], np.diff(line, axis=0)
        t = np.clip(((seen[1 - view] - a) * d).sum(1) / (d * d).sum(1), 0, 1)
        assert np.linalg.norm(a + t[:, None] * d - seen[1 - view], axis=1).min() < 0.1
        if view == 0:  # distances are those from the view that is pointed at
            mark = next(m for m in found["marks"] if m[0] == depth)
            assert np.linalg.norm(np.array(mark[1:]) - seen[1]) < 0.02


def test_the_facts_of_a_set_up_are_those_of_the_scene(tmp_path: Path) -> None:
    clip = rendered()
    entry = dict(clip.clip["vehicles"][0])
    row = next(r for r in clip.truth if r["frame"] == entry["frame"])
    for side in ("left", "right"):
        entry[side] = row[side]
    facts = check_setup(clip.rig, clip.clip["paths"], [entry])
    vehicle, path = facts["vehicles"][0], facts["paths"]["lane0"]
    assert vehicle["distance_m"] == pytest.approx(np.linalg.norm(row["position"]), rel=0.01)
    assert vehicle["width_m"] == pytest.approx(1.8, abs=0.15) and vehicle["height_m"] == pytest.approx(0.7, abs=0.3)
    assert vehicle["epipolar_px"] < 0.5 and "warning" not in vehicle and "problem" not in vehicle
    assert vehicle["beside_lane_centre_m"] < 0.4 and "lane_centres_m" not in vehicle and "nearer_path" not in vehicle
    assert path["near_m"] < 25 and path["far_m"] > 35 and "problem" not in path
    shifted = {**entry, "right": [[x, y + 8] for x, y in entry["right"]]}
    assert "epipolar line" in check_setup(clip.rig, {}, [shifted])["vehicles"][0]["warning"]
    beside = clip.clip["paths"] | {"again": clip.clip["paths"]["lane0"]}
    assert check_setup(clip.rig, beside, [])["paths"]["again"]["gap_m"] == pytest.approx(0, abs=1e-6)


def test_a_lane_centre_or_another_lane_is_offered_to_a_vehicle_beside_its_lane() -> None:
    """The centre for its direction of travel, and the lane that is nearer."""
    clip = rendered()
    path, (vehicle,) = clip.clip["paths"]["lane0"], clip.clip["vehicles"]
    centred = path["lateral_offset"]
    paths = {"lane0": {**path, "lateral_offset": 0.0}, "lane1": path, "lane2": {**path, "lateral_offset": 7.0}}
    (found,) = check_setup(clip.rig, paths, [vehicle])["vehicles"]
    assert found["beside_lane_centre_m"] == pytest.approx(abs(centred), abs=0.4) and found["nearer_path"] == "lane1"
    assert found["lane_centres_m"]["approaching"] == pytest.approx(centred, abs=0.4)  # it approaches
    assert found["lane_centres_m"]["receding"] == -found["lane_centres_m"]["approaching"]
    right = {**path, "lateral_offset": found["lane_centres_m"]["approaching"]}
    (corrected,) = check_setup(clip.rig, {"lane0": right}, [vehicle])["vehicles"]
    assert corrected["beside_lane_centre_m"] == pytest.approx(0, abs=1e-9) and "lane_centres_m" not in corrected
    (alone,) = check_setup(clip.rig, paths, [{**vehicle, "path": None}])["vehicles"]
    assert alone["nearer_path"] == "lane1" and "beside_lane_centre_m" not in alone
    (far,) = check_setup(clip.rig, {"lane2": paths["lane2"]}, [{**vehicle, "path": None}])["vehicles"]
    assert "nearer_path" not in far


def test_missing_parts_of_a_drawing_are_reported() -> None:
    rig = rendered().rig
    facts = check_setup(rig, {"a": {"shape": "line", "left": [[1, 2], [50, 60]]}}, [{"id": "v", "frame": 0}])
    assert facts["paths"]["a"]["problem"] == "draw the same line in the right view"
    assert facts["vehicles"][0]["problem"] == "outline the same part in the left view"


@pytest.mark.parametrize("view", [0, 1])
def test_an_outline_is_proposed_in_the_other_view(tmp_path: Path, view: int) -> None:
    clip = put_clip(tmp_path.resolve())
    pictures = FrameCache(tmp_path.resolve()).open(clip / "clip.yaml")
    given = rendered().clip["vehicles"][0]
    row = next(r for r in rendered().truth if r["frame"] == given["frame"])
    sides = ("left", "right")
    entry = {"id": "v0", "frame": given["frame"], "path": "lane0", sides[view]: row[sides[view]], sides[1 - view]: []}
    shown = pictures.picture(0, entry["frame"]), pictures.picture(1, entry["frame"])
    for path in (None, rendered().clip["paths"]["lane0"]):
        pixels, correlation = propose_in_other_view(rendered().rig, view, shown, entry, path)
        assert np.abs(pixels - row[sides[1 - view]]).max() < 0.8 and correlation > 0.9
    with pytest.raises(UnusableInput, match="nothing in the other view matches|several places|outside"):
        propose_in_other_view(rendered().rig, view, (shown[0], shown[0] * 0 + 90), entry, None)
    with pytest.raises(UnusableInput, match="outline"):
        propose_in_other_view(
            rendered().rig, view, shown, {**entry, sides[view]: [[1, 1], [2, 1], [2, 2], [1, 2]]}, None
        )


def test_a_road_line_is_proposed_along_its_epipolar_lines(tmp_path: Path) -> None:
    clip = put_clip(tmp_path.resolve())
    pictures = FrameCache(tmp_path.resolve()).open(clip / "clip.yaml")
    rig, given = rendered().rig, rendered().clip["paths"]["lane0"]
    shown = pictures.picture(0, 0), pictures.picture(1, 0)
    pixels, correlation = propose_in_other_view(rig, 0, shown, {**given, "right": []}, None)
    left = np.array(given["left"])
    assert np.abs(epipolar_distance(rig, left, pixels)).max() < 1e-6 and correlation > 0.6
    proposed = check_setup(rig, {"a": {**given, "right": pixels.tolist()}, "b": given}, [])["paths"]
    assert proposed["a"]["gap_m"] < 0.35, proposed
    with pytest.raises(UnusableInput, match="nothing in the other view matches"):
        propose_in_other_view(rig, 0, (shown[0], shown[0] * 0 + 90), {**given, "right": []}, None)


def test_triangulated_proposals_stand_upright_on_the_scene(tmp_path: Path) -> None:
    clip = put_clip(tmp_path.resolve())
    pictures = FrameCache(tmp_path.resolve()).open(clip / "clip.yaml")
    row = next(r for r in rendered().truth if r["frame"] == 2)
    entry = {"id": "v", "frame": 2, "left": row["left"], "right": []}
    pixels, _ = propose_in_other_view(rendered().rig, 0, (pictures.picture(0, 2), pictures.picture(1, 2)), entry, None)
    corners = triangulate(rendered().rig, np.array(row["left"]), pixels)
    assert corners.mean(axis=0) == pytest.approx(np.array(row["position"]), rel=0.02, abs=0.3)


# --- snapping --------------------------------------------------------------------------------------------------------


def square(x: float, y: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    """A bright quadrant whose corner lies at (x, y), rendered with 16 × 16 samples per pixel."""
    fine = (np.arange(60 * 16) + 0.5) / 16 - 0.5
    image = 40 + 150 * ((fine[None, :] > x) & (fine[:, None] > y)).astype(np.float32)
    small = image.reshape(60, 16, 60, 16).mean(axis=(1, 3))
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 0.8), np.float32)


@given(st.floats(28, 32), st.floats(28, 32), st.floats(-2, 2), st.floats(-2, 2))
@settings(deadline=None, max_examples=40)
def test_a_point_snaps_to_the_corner_nearby(x: float, y: float, dx: float, dy: float) -> None:
    found = snap_point(square(x, y), np.array([x + dx, y + dy]), 6)
    assert found == pytest.approx(np.array([x, y]), abs=0.5)


@given(st.floats(28, 32), st.floats(-3, 3))
@settings(deadline=None, max_examples=40)
def test_a_point_snaps_across_to_an_edge(x: float, dx: float) -> None:
    found = snap_point(square(x, -100), np.array([x + dx, 30.0]), 6)
    assert found[0] == pytest.approx(x, abs=0.3) and abs(found[1] - 30) < 1.1


@pytest.mark.parametrize("point", [[30.0, 30.0], [0.0, 0.0], [-5.0, 1e6], [59.0, 59.0]])
def test_a_point_is_not_moved_where_there_is_no_edge(point: list[float]) -> None:
    flat = np.random.default_rng(0).normal(90, 2, (60, 60)).astype(np.float32)
    assert snap_point(flat, np.array(point), 6).tolist() == point
