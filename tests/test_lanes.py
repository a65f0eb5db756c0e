"""Lanes: background, geometry, and lanes found on a road painted pixel by pixel, on its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from painted_road import (
    AHEAD,
    DOWN,
    EDGES,
    HEADING,
    HEIGHT,
    SIZE,
    WIDTHS,
    make_rig,
    painted,
)
from printed_intervals import rows_with_intervals
from run_command import assert_one_line_error, paceline

from paceline.documents.loading import load_clip
from paceline.errors import UnusableInput
from paceline.lanes.lane_proposals import Lane
from paceline.lanes.road_alignment import Alignment
from paceline.lanes.road_surface import RoadSurface, plane_surface, viewing_rays
from paceline.lanes.site_yaml import lane_names, site_yaml, with_lanes
from paceline.number_format import format_uncertain
from paceline.recordings.background import estimate_background, shorth_background
from paceline.recordings.stereo import open_recording
from paceline.speed.geometry.path_reconstruction import path_from_document

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the painted road over which a dark lorry drives."""
    folder, rig = tmp_path_factory.mktemp("lanes"), make_rig()
    scenes = [painted(rig, side, np.random.default_rng(side)) for side in (0, 1)]
    for side, name in enumerate(("left", "right")):
        (folder / name).mkdir()
        for k in range(8):
            rng = np.random.default_rng([k, side])
            image = scenes[side] + rng.normal(0, 2.0, SIZE[::-1])
            image[250:420, 60 + 85 * k : 150 + 85 * k] = 30
            cv2.imwrite(str(folder / name / f"{k:03d}.png"), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    document = {"rotation": rig.R.tolist(), "translation": rig.t.tolist(), "uncertainty": "exact"}
    for name in ("left", "right"):
        document[name] = {"image_size": list(SIZE), "K": rig.left.K.tolist()}  # type: ignore[assignment]
    (folder / "rig.yaml").write_text(yaml.safe_dump(document))
    (folder / "clip.yaml").write_text("left: left  # kept\nright: right\nrate: 5\nrig: rig.yaml\n")
    return folder


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "paceline", "lanes", *map(str, arguments)], capture_output=True, text=True
    )


# --- end to end ----------------------------------------------------------------------------------------------------


def test_lanes_of_a_painted_road_become_paths_that_can_be_measured_along(clip: Path) -> None:
    done = run(clip, "--in-place")
    assert done.returncode == 0, done.stderr + done.stdout
    assert len(rows_with_intervals(done.stdout)) == 2
    text = (clip / "clip.yaml").read_text()
    assert text.startswith("left: left  # kept\nright: right\nrate: 5\nrig: rig.yaml\npaths:\n")
    found = load_clip(clip / "clip.yaml")
    assert list(found.paths) == ["lane1", "lane2"]
    stated = [line.split("between")[1] for line in text.splitlines() if "between" in line]
    rig = make_rig()
    for document, words, width, edges in zip(
        found.paths.values(), stated, WIDTHS, zip(EDGES, EDGES[1:], strict=False), strict=True
    ):
        value, half = (float(words.split(",")[1].split()[i]) for i in (0, 2))
        assert abs(value - width) < 1.5 * half + 0.005, words  # 3 standard deviations, and what rounding hides
        assert half < 0.25
        assert words.split(",")[1].split(" m wide")[0].strip() == format_uncertain(value, half)
        path = path_from_document(document, rig)
        near = path.points[(path.points[:, 2] > 12) & (path.points[:, 2] < 35)]
        right = near[:, 0] * np.cos(HEADING) - (near @ AHEAD) * np.sin(HEADING)
        assert np.abs(np.median(right) - np.mean(edges)) < 0.12
        assert np.abs(np.median(near @ DOWN) - HEIGHT) < 0.15
    for name in ("left", "right"):
        assert cv2.imread(str(clip / f"lanes-{name}.png")).shape == (*SIZE[::-1], 3)

    site = clip / "site.yaml"  # the same lanes by a site: none is added again
    site.write_text("rig: rig.yaml\n" + text[text.index("paths:") :])
    again = "left: left\nright: right\nrate: 5\nsite: site.yaml\n"
    (clip / "again.yaml").write_text(again)
    done = paceline("lanes", clip / "again.yaml", "--in-place")
    assert done.returncode == 0, done.stderr
    for k in (1, 2):
        assert (
            f"left out: the lane between lines {k} and {k + 1} is not added: path lane{k} runs along it" in done.stdout
        )
    assert "Nothing was added" in done.stdout and (clip / "again.yaml").read_text() == again


def test_too_few_frames_are_reported(clip: Path, tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        for k in range(3):
            (tmp_path / name / f"{k}.png").symlink_to(clip / name / f"{k:03d}.png")
    (tmp_path / "rig.yaml").symlink_to(clip / "rig.yaml")
    (tmp_path / "clip.yaml").write_text("left: left\nright: right\nrate: 5\nrig: rig.yaml\n")
    done = run(tmp_path, "-o", tmp_path / "site.yaml")
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("no lane found: only 3 frames")
    assert not (tmp_path / "site.yaml").exists()


@pytest.mark.slow
def test_the_width_of_a_lane_is_a_setting(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "settings.yaml").write_text("lanes: {width: [2.2, 3.0]}\n")
    done = run(clip, "--config", tmp_path / "settings.yaml")
    assert done.returncode == 1 and done.stdout.count("(limits 2.2 and 3)") == 2


def test_a_width_that_is_no_range_is_refused(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "settings.yaml").write_text("lanes: {width: [3.0, 2.2]}\n")
    done = run(clip, "--config", tmp_path / "settings.yaml")
    expected = "lanes.width: expected two numbers above 0, the smaller one first"
    assert done.returncode == 2 and done.stderr == f"paceline: {tmp_path / 'settings.yaml'}: {expected}\n"


def test_the_background_is_made_of_as_many_frames_as_asked(clip: Path) -> None:
    recording = open_recording(load_clip(clip / "clip.yaml"))
    assert [estimate_background(recording, most).frames for most in (5, 8, 31)] == [5, 8, 8]


def test_one_place_to_write_to(tmp_path: Path) -> None:
    done = run(tmp_path / "clip.yaml", "--in-place", "-o", tmp_path / "site.yaml")
    assert done.returncode == 2
    assert done.stderr.startswith("paceline: --in-place and --out exclude each other")


# --- parts ---------------------------------------------------------------------------------------------------------


def test_background_is_found_where_it_is_hidden_in_half_of_the_frames() -> None:
    rng = np.random.default_rng(3)
    truth = rng.uniform(20, 200, (70, 40))
    stack = truth + rng.normal(0, 1.5, (21, 70, 40))
    stack[:11, 20:40] = rng.uniform(0, 255, (11, 20, 40))  # another vehicle each time
    flicker = slice(60, 70)
    stack[:, flicker] = rng.uniform(0, 255, (21, 10, 40))
    image, settled = shorth_background(stack.astype(np.float16))
    assert np.abs(image - truth)[:60].max() < 6 * 1.5
    assert np.sqrt(np.mean((image - truth)[:20] ** 2)) < 1.5 * 1.5 / np.sqrt(21)
    assert settled[:20].mean() > 0.99
    assert settled[flicker].mean() < 0.2


def bent_surface(heights: list[float]) -> RoadSurface:
    flat = plane_surface(np.array([0.02, 1.0, 0.06]), 4.0, 30.0)
    return flat.with_heights(np.array(heights))


HEIGHTS = st.tuples(*(st.floats(-w, w) for w in (0.3, 1.0, 1.0, 2.0, 0.5, 0.5))).map(list)


@settings(max_examples=40, deadline=None)
@given(HEIGHTS, st.floats(-8, 8), st.floats(8, 50), st.sampled_from([0, 1]))
def test_rays_meet_the_surface_where_it_projects(heights: list[float], x: float, z: float, side: int) -> None:
    surface, rig = bent_surface(heights), make_rig()
    ground = np.array([x, z])
    pixel = rig.project(surface.points(ground))[side]
    centre, _ = viewing_rays(rig, side, pixel)
    away = ground - ((surface.axes.T @ (centre - surface.origin))[[0, 2]])
    above = (centre - surface.points(ground)) @ surface.axes[:, 1]
    if above + surface.slopes(ground) @ away < 0.8:
        return  # seen from behind a crest
    assert surface.ground_at(rig, side, pixel) == pytest.approx(ground, abs=1e-4)


@settings(max_examples=60, deadline=None)
@given(st.floats(-1.5, 1.5), st.floats(-0.025, 0.025), st.floats(-40, 40), st.floats(-12, 12), st.floats(-0.5, 0.5))
def test_road_coordinates_go_there_and_back(heading: float, curvature: float, s: float, d: float, bend: float) -> None:
    road = Alignment(np.array([2.0, 30.0]), heading, curvature, np.array([0.0, 0.0, bend, 0.1, 0.0]))
    back = road.from_ground(road.to_ground(np.array(s), d))
    assert np.array(back) == pytest.approx([s, d], abs=1e-8)


def test_an_arc_keeps_its_distance_from_its_centre() -> None:
    road = Alignment(np.array([1.0, 20.0]), 0.3, 1 / 50.0)
    centre = road.origin + 50.0 * road.axes[1]
    points = road.to_ground(np.linspace(-40, 40, 9), 3.0)
    assert np.linalg.norm(points - centre, axis=1) == pytest.approx(np.full(9, 47.0))


# --- files ---------------------------------------------------------------------------------------------------------

LANE = Lane(
    ("1", "2"), 3.5, 0.02, "line", np.array([[1.0, 2.0], [40.0, 90.0]]), np.array([[2.0, 3.0], [40.5, 90]]), None
)
HEAD = "left: a\n# a remark\nright: b  # another\nrig: rig.yaml\n"
OWN = "paths:\n    mine:   # drawn by hand\n        shape: line\n        points: [[0, 0, 1], [0, 0, 9]]\n"
TAIL = "\n# of the vehicles\nvehicles: []\n"


@pytest.mark.parametrize(
    "text", [HEAD, HEAD + "paths:  # none yet\n" + TAIL, HEAD + "paths: {}\n" + TAIL, HEAD + OWN + TAIL, HEAD + OWN]
)
def test_what_a_person_wrote_stays(text: str) -> None:
    before = yaml.safe_load(text)
    now = with_lanes(text, "clip.yaml", dict(zip(lane_names(2, before.get("paths") or ()), [LANE, LANE], strict=True)))
    after = yaml.safe_load(now)
    added = {name: after["paths"].pop(name) for name in ("lane1", "lane2")}
    assert after == before | {"paths": before.get("paths") or {}}
    assert added["lane1"]["left"] == [[1.0, 2.0], [40.0, 90.0]]
    kept = [line for line in text.splitlines() if not line.startswith("paths")]
    assert [line for line in now.splitlines() if line in kept] == kept
    assert all(comment in now for comment in ("# none yet", "# of the vehicles") if comment in text)


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "paths: {a: {shape: line, points: [[0, 0, 1], [0, 0, 9]]}}\n",
        HEAD + "paths: {\n}\n",
        HEAD + "paths:\n  null\n",
        HEAD + "...\n",
        "".join(f"  {line}\n" for line in HEAD.splitlines()),
    ],
)
def test_a_file_that_cannot_be_edited_is_refused_by_name_and_unchanged(text: str) -> None:
    yaml.safe_load(text)
    with pytest.raises(UnusableInput, match="clip.yaml: paths: is written in a way that cannot be added to"):
        with_lanes(text, "clip.yaml", {"lane1": LANE})


@pytest.mark.parametrize("own", ["", OWN, "paths: {}\n"])
def test_that_it_can_be_added_to_is_known_before_there_is_a_lane(own: str) -> None:
    with_lanes(HEAD + own, "clip.yaml", {})


@pytest.mark.parametrize("name", ["clip.yaml", "rig.yaml"])
def test_the_clip_and_its_rig_are_not_written_over(clip: Path, name: str) -> None:
    before = (clip / name).read_bytes()
    assert_one_line_error(paceline("lanes", clip, "-o", clip / name), "is the clip itself or its rig")
    assert (clip / name).read_bytes() == before


def test_a_read_only_clip_stays(clip: Path) -> None:
    (clip / "clip.yaml").chmod(0o444)
    try:
        assert_one_line_error(paceline("lanes", clip, "--in-place"), "clip.yaml: cannot be written (it is read-only)")
    finally:
        (clip / "clip.yaml").chmod(0o644)


def test_pictures_do_not_join_the_recording(clip: Path) -> None:
    left = load_clip(clip / "clip.yaml").left
    assert left.is_dir()
    assert_one_line_error(paceline("lanes", clip, "-o", left / "site.yaml"), "would be taken for a frame")
    assert_one_line_error(paceline("lanes", "x" * 300), "cannot be read")
    assert_one_line_error(paceline("lanes", clip, "-o", "x" * 300 + ".yaml"), "cannot be written")


def test_names_that_are_taken_are_passed_over() -> None:
    assert lane_names(3, ["lane2", "mine"]) == ["lane1", "lane3", "lane4"]


def test_a_clip_takes_rig_and_paths_from_its_site(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "sites").mkdir()
    (tmp_path / "rig.yaml").symlink_to(clip / "rig.yaml")
    (tmp_path / "sites" / "site.yaml").write_text(site_yaml("../rig.yaml", {"lane1": LANE}))
    file = tmp_path / "clip.yaml"
    file.write_text("left: a\nright: b\nsite: sites/site.yaml\n" + OWN)
    found = load_clip(file)
    assert list(found.paths) == ["mine", "lane1"]
    assert found.rig.baseline == pytest.approx(make_rig().baseline)
    assert (found.limit, found.limit_on("mine")) == (None, None)
    for text, complaint in [
        ("left: a\nright: b\nrig: rig.yaml\nsite: sites/site.yaml\n", "rig and site: expected one of them"),
        ("left: a\nright: b\n", "rig: missing"),
        ("left: a\nright: b\nsite: sites/site.yaml\n" + OWN.replace("mine", "lane1"), "paths.lane1: "),
        ("left: a\nright: b\nsite: nowhere.yaml\n", "nowhere.yaml: no such file"),
    ]:
        file.write_text(text)
        with pytest.raises(UnusableInput, match=complaint):
            load_clip(file)


def test_the_limit_of_the_command_wins_over_a_paths_and_that_over_the_clips_and_the_sites(
    clip: Path, tmp_path: Path
) -> None:
    (tmp_path / "rig.yaml").symlink_to(clip / "rig.yaml")
    lane = site_yaml("rig.yaml", {"lane1": LANE, "lane2": LANE})
    (tmp_path / "site.yaml").write_text(f"limit: 10 m/s\n{lane}    limit: 20 m/s\n")
    file = tmp_path / "clip.yaml"
    file.write_text("left: a\nright: b\nsite: site.yaml\n" + OWN)
    limits = [load_clip(file).limit_on(path) for path in ("mine", "lane1", "lane2", None)]
    assert limits == [10.0, 10.0, 20.0, 10.0]
    file.write_text("left: a\nright: b\nlimit: 54 km/h\nsite: site.yaml\n" + OWN)
    limits = [load_clip(file).limit_on(path) for path in ("mine", "lane1", "lane2", None)]
    assert limits == [15.0, 15.0, 20.0, 15.0]
    limits = [load_clip(file).with_limit(25.0).limit_on(path) for path in ("mine", "lane2", None)]
    assert limits == [25.0, 25.0, 25.0]
