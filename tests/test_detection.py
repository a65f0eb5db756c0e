"""Detection of vehicles: geometry of sweep planes, choice of a face, and whole clips with known truth."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from run_command import assert_one_line_error, paceline
from scipy.stats import theilslopes
from tiny_road import TWO, scene

from paceline.cameras import StereoRig
from paceline.detection.background_model import MAX_CHANGE_GREY_PER_S, RunningMedianBackground
from paceline.detection.clip_entries import with_vehicles
from paceline.detection.finder import DetectedVehicle, VehicleFinder
from paceline.detection.lane_paths import LanePath, PlaneGrid, image_pyramid, lane_paths_of, warp_to_plane
from paceline.detection.photo_consistency import LocalStatistics, local_ncc
from paceline.detection.planar_face import best_rectangle
from paceline.detection.search import SearchResult, find_recorded_vehicles, find_vehicles
from paceline.documents.loading import VehicleDocument, load_clip
from paceline.errors import UnusableInput
from paceline.geometry import epipolar_distance, triangulate
from paceline.recordings.background import shorth_background
from paceline.recordings.stereo import StereoFrame, open_recording
from paceline.robust_line import theil_sen_slope
from paceline.simulation.camera_errors import StereoErrors
from paceline.simulation.stereo.clip import RenderedClip, Vehicle, World, render, write
from paceline.simulation.stereo.scenery import StaticBackground
from paceline.speed.configuration import DEFAULTS, DetectionSettings, SpeedConfiguration
from paceline.speed.geometry.paths import from_points
from paceline.survey.recording import measure_clip

Array = NDArray[np.float64]
Image = NDArray[np.float32]

MPH = 0.44704  # m/s
WINDOW = 5


# --- sweep planes ----------------------------------------------------------------------------------------------------


@pytest.fixture
def lane(rig: StereoRig) -> LanePath:
    """A road that goes away to the right, 1.8 m below the cameras."""
    return LanePath("lane0", rig, from_points("lane0", "line", np.array([[-4.0, 1.8, 12.0], [3.0, 1.6, 70.0]])))


@given(s=st.floats(0, 58), x=st.floats(-3, 3), y=st.floats(0, 3), turned=st.booleans())
def test_points_of_a_sweep_plane_project_to_its_pixels(s: float, x: float, y: float, turned: bool) -> None:
    rig = make_rig()
    path = from_points("lane0", "line", np.array([[-4.0, 1.8, 12.0], [3.0, 1.6, 70.0]]))
    lane = LanePath("lane0", rig, path.reversed() if turned else path)
    world = lane.point(s, x, y)
    pixels = lane.pixels(s, np.array([x, y]))
    for seen, expected in zip(pixels, rig.project(world), strict=True):
        np.testing.assert_allclose(seen, expected, atol=1e-6)
    along = path.points[-1] - path.points[0]
    assert (world - lane.point(s, 0.0, 0.0)) @ along == pytest.approx(0.0, abs=1e-9)
    assert lane.point(s, 1.0, 0.0)[0] > lane.point(s, -1.0, 0.0)[0]  # right in the image, in either direction of travel
    assert lane.point(s, 0.0, 1.0)[1] < lane.point(s, 0.0, 0.0)[1]


@cache
def make_rig() -> StereoRig:
    return World(scene()).rig


def test_sweep_planes_lie_in_both_images_at_equal_disparity_steps(lane: LanePath) -> None:
    s = lane.sweep_positions()
    places = lane.path.at(s)
    assert (places[:, 2] > DEFAULTS.detection.near).all() and len(s) > 20
    within = lane.path.at(lane.sweep_positions(near=20.0, far=50.0))[:, 2]
    assert 20.0 < within.min() < 21.0 and 48.0 < within.max() < 50.0
    for pixels, camera in zip(lane.rig.project(places), lane.rig.cameras, strict=True):
        assert ((pixels >= 0) & (pixels <= np.array(camera.image_size) - 1)).all()
    steps = np.diff(lane.rig.left.K[0, 0] * lane.rig.baseline / places[:, 2])
    np.testing.assert_allclose(steps, np.median(steps), rtol=0.02)


def test_lane_paths_coincide_in_place_and_direction(rig: StereoRig) -> None:
    """Two lines give one lane path where they run alike, in the same direction."""
    path = from_points("", "line", np.array([[-2.0, 1.8, 12.0], [3.0, 1.6, 70.0]]))
    lane = LanePath("near", rig, path)
    assert lane.coincides_with(LanePath("far", rig, path.shifted(0.2)))
    assert not lane.coincides_with(LanePath("far", rig, path.shifted(3.5)))
    assert not lane.coincides_with(LanePath("far", rig, path.reversed()))


def test_an_image_is_warped_to_a_plane(lane: LanePath) -> None:
    """An image whose grey levels are a function of plane coordinates is that function on the plane."""
    grid, s = PlaneGrid(left=-1.0, top=1.5, bottom=0.5, cell=0.05), 40.0
    width, height = lane.rig.left.image_size
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    at = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(lane.homographies(s)[0]).T
    picture = (100 + 30 * at[..., 0] / at[..., 2] - 20 * at[..., 1] / at[..., 2]).astype(np.float32)
    expected = 100 + 30 * grid.x[None] - 20 * grid.y[:, None]
    warped = warp_to_plane(image_pyramid(picture), lane.homographies(s)[0], grid)
    np.testing.assert_allclose(warped, expected, atol=0.05)


def test_local_ncc_is_the_correlation_coefficient(rng: np.random.Generator) -> None:
    a, b = rng.normal(100, 10, (2, 20, 24)).astype(np.float32)
    b = 0.5 * b + 0.5 * a
    found = local_ncc(LocalStatistics(a, WINDOW), LocalStatistics(b, WINDOW))
    for row, column in ((5, 5), (9, 14), (15, 20)):
        part = np.s_[row - 2 : row + 3, column - 2 : column + 3]
        assert found[row, column] == pytest.approx(np.corrcoef(a[part].ravel(), b[part].ravel())[0, 1], abs=2e-3)
    assert local_ncc(LocalStatistics(a, WINDOW), LocalStatistics(np.full_like(a, 7.0), WINDOW)).max() == 0.0


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


# --- face, track, background -----------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    height=st.integers(1, 4),
    narrowest=st.integers(1, 4),
    more=st.integers(0, 5),
    column=st.integers(0, 8),
)
def test_best_rectangle_is_that_of_exhaustive_search(
    seed: int, height: int, narrowest: int, more: int, column: int
) -> None:
    votes = np.random.default_rng(seed).normal(-0.3, 1.0, (7, 9))
    sums = {
        (t, b, left, r): votes[t:b, left:r].sum()
        for t in range(7)
        for b in range(t + height, 8)
        for left in range(9)
        for r in range(left + narrowest, min(left + narrowest + more, 9) + 1)
        if left <= column < r
    }
    best = max(sums, key=lambda k: sums[k])
    found = best_rectangle(votes, height, (narrowest, narrowest + more), column)
    if sums[best] > 1e-9:
        assert found is not None and sums[found] == pytest.approx(sums[best])
    else:
        assert found is None


@given(seed=st.integers(0, 10**6), n=st.integers(2, 12))
def test_slope_is_that_of_scipy(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    t, s = np.cumsum(rng.uniform(0.05, 0.3, n)), rng.normal(0, 10, n)
    assert theil_sen_slope(t, s) == pytest.approx(float(theilslopes(s, t)[0]))
    assert np.isnan(theil_sen_slope(t[:1], s[:1]))


def still_frame(index: int, time: float, image: Image) -> StereoFrame:
    return StereoFrame(index, time, image, image.copy(), 0.0, duplicate=False)


def test_running_median_ignores_a_passing_vehicle_and_follows_the_light() -> None:
    road = np.full((20, 30), 80.0, np.float32)
    empty = RunningMedianBackground((road, road))
    passing = road.copy()
    passing[5:15, 5:20] = 250.0
    for k in range(100):  # 10 s, of which a vehicle is there for 1 s
        empty.update(still_frame(k, 0.1 * k, passing if 30 <= k < 40 else road))
    assert np.abs(empty.images[0] - 80.0).max() < 0.1
    for k in range(100, 200):
        empty.update(still_frame(k, 0.1 * k, road + np.float32(0.8 * MAX_CHANGE_GREY_PER_S * 0.1 * (k - 100))))
    assert np.abs(empty.images[1] - (80.0 + 0.8 * MAX_CHANGE_GREY_PER_S * 9.9)).max() < 2 * MAX_CHANGE_GREY_PER_S * 0.1
    assert (road == 80.0).all()  # what was handed in stays as it is


# --- whole clips -----------------------------------------------------------------------------------------------------


def unclicked(rendered: RenderedClip, folder: Path) -> Path:
    """The clip in files, without the operator's outlines."""
    file = write(rendered, folder)
    document = yaml.safe_load(file.read_text(encoding="utf-8"))
    file.write_text(yaml.safe_dump({k: v for k, v in document.items() if k != "vehicles"}), encoding="utf-8")
    return file


def found_in(file: Path) -> list[DetectedVehicle]:
    clip = load_clip(file)
    return find_vehicles(clip, open_recording(clip)).detected


def outlines(found: list[DetectedVehicle]) -> list[VehicleDocument]:
    return [f.vehicle for f in found if f.vehicle is not None]


@cache
def two() -> RenderedClip:
    return render(scene(*TWO))


@pytest.fixture(scope="module")
def search(tmp_path_factory: pytest.TempPathFactory) -> SearchResult:
    """What is found in the clip of two vehicles."""
    clip = load_clip(unclicked(two(), tmp_path_factory.mktemp("two")))
    return find_vehicles(clip, open_recording(clip))


@pytest.mark.slow
def test_vehicles_in_both_directions_are_found_once_at_their_positions(search: SearchResult) -> None:
    clip = search.clip
    assert [v.id for v in search.clip.vehicles] == ["v0", "v1"] and not search.reason and not search.notices
    truth = [{row["vehicle"]: row for row in two().truth if row["frame"] == v.frame} for v in search.clip.vehicles]
    names = []
    for v, at in zip(search.clip.vehicles, truth, strict=True):
        place = triangulate(clip.rig, v.left.mean(0), v.right.mean(0))
        name = min(at, key=lambda k: float(np.linalg.norm(np.array(at[k]["position"]) - place)))
        names.append(name)
        # within the plane, and at its distance to half a pixel of disparity
        pixel = place[2] ** 2 / (clip.rig.left.K[0, 0] * clip.rig.baseline)
        assert abs(place[2] - at[name]["position"][2]) < 0.5 * pixel + 0.3
        assert v.speed == pytest.approx({"v0": 16.0, "v1": 13.0}[name], rel=0.15)  # as sure as a first guess has to be
        corners = np.array(at[name]["left"])
        around = 0.1 * np.ptp(corners[:, 0])  # a vehicle's bumper and the lower edge of its window may be part of it
        assert (v.left > corners.min(0) - around).all() and (v.left < corners.max(0) + around).all()
        assert np.abs(epipolar_distance(clip.rig, v.left, v.right)).max() < 1e-6
    assert sorted(names) == ["v0", "v1"]


@pytest.mark.slow
def test_what_is_looked_for_is_a_setting(tmp_path: Path) -> None:
    """Vehicles that are too small in the images have no outline; there is none where nobody looks."""
    clip = load_clip(unclicked(two(), tmp_path))
    for looked_for, count, reason in (
        (DetectionSettings(min_size_px=(500.0, 6.0)), 2, "face_never_clear"),
        (DetectionSettings(near=140.0), 0, None),
    ):
        configuration = SpeedConfiguration(detection=looked_for)
        search = find_vehicles(clip, open_recording(clip), configuration=configuration)
        assert [f.reason.code for f in search.detected] == [reason] * count
        assert search.reason and not search.clip.vehicles


@pytest.mark.slow
def test_detected_vehicles_are_measured(tmp_path: Path) -> None:
    result = measure_clip(unclicked(two(), tmp_path))
    measured = sorted(m.speed for m in result.measurements)
    assert [m.verdict for m in result.measurements] == ["measured"] * 2
    assert measured == pytest.approx([13.0, 16.0], abs=0.2)
    for m in result.measurements:
        assert m.speed_lo < min((13.0, 16.0), key=lambda v: abs(v - m.speed)) < m.speed_hi


def test_three_vehicles_of_which_two_share_a_lane_are_separated(tmp_path: Path) -> None:
    behind = replace(TWO[0], id="v1", start_distance=62.0, speed=14.0, texture_seed=7)
    opposite = Vehicle("v2", 15.0, start_distance=20.0, lane=1.85, texture_seed=8, relief=0.03, receding=True)
    first = replace(TWO[0], start_distance=40.0, speed=15.0)
    rendered = render(scene(first, behind, opposite))
    file = unclicked(rendered, tmp_path)
    rig, names = load_clip(file).rig, []
    for v in outlines(found_in(file)):
        place = triangulate(rig, v.left.mean(0), v.right.mean(0))
        apart = {
            row["vehicle"]: float(np.linalg.norm(np.array(row["position"]) - place))
            for row in rendered.truth
            if row["frame"] == v.frame
        }
        names.append(min(apart, key=lambda k: apart[k]))
        assert apart[names[-1]] < 2.5  # m; half a pixel of disparity 60 m away
    assert sorted(names) == ["v0", "v1", "v2"]


def empty_road(world: World, frames: int) -> list[StereoFrame]:
    """An empty road over which shadows of a cloud and of a bird drive, in wind, rain and changing light."""
    rng = np.random.default_rng(8)
    stills = [StaticBackground(world.scene, world.road, world.scene.seed).draw(view) for view in world.views]
    (width, height), pictures = world.scene.image_size, []
    for k in range(frames):
        views = []
        for view, still in zip(world.views, stills, strict=True):
            image = still * np.float32(1 + 0.1 * np.sin(0.9 * k))
            for arc, long, wide in ((62.0 - 3.0 * k, 7.0, 3.0), (22.0 + 2.0 * k, 1.5, 1.2)):
                ends = np.array([arc, arc + long])
                left, right = (world.road.point(ends, -1.85 + side * wide / 2) for side in (-1, 1))
                corners = view.project(np.stack([left[1], right[1], right[0], left[0]]))
                shade = np.ones_like(image)
                cv2.fillConvexPoly(shade, corners.round().astype(np.int32), 0.5)
                image = image * cv2.GaussianBlur(shade, (0, 0), 2.0)
            rows, columns = rng.integers(0, [[height // 3], [width]], (2, 300))  # leaves that flutter
            image[rows, columns] += 60
            for x, y in rng.integers(0, [width, height - 12], (120, 2)):  # drops, which each view sees elsewhere
                image[y : y + 10, x] += 25
            views.append(np.asarray(image + rng.normal(0, 0.8, image.shape), np.float32))
        pictures.append(StereoFrame(k, 0.2 * k, views[0], views[1], 0.0, duplicate=False))
    return pictures


def test_nothing_is_found_on_an_empty_road(tmp_path: Path) -> None:
    world, clip = World(scene()), load_clip(unclicked(render(scene()), tmp_path))
    frames = empty_road(world, 12)
    background = [
        shorth_background(np.stack([f.__dict__[side] for f in frames]).astype(np.float16))[0]
        for side in ("left", "right")
    ]
    finder = VehicleFinder(lane_paths_of(clip), RunningMedianBackground((background[0], background[1])))
    assert [found for frame in frames for found in finder.process(frame)] + finder.finish() == []


def test_a_recording_without_motion_is_reported(tmp_path: Path) -> None:
    rendered = render(scene())
    still = replace(rendered, left=[rendered.left[-1]] * 9, right=[rendered.right[-1]] * 9)
    noise = np.random.default_rng(3)
    still = replace(
        still, **{s: [np.clip(i + noise.integers(0, 3, i.shape), 0, 255).astype(np.uint8) for i in getattr(still, s)]
                  for s in ("left", "right")}
    )  # fmt: skip
    file = unclicked(still, tmp_path)
    done = paceline("vehicles", file)
    assert done.returncode == 1
    assert done.stdout == "no vehicle was found: nothing that could be measured drives along the paths\n"
    done = paceline("speed", file, "-o", tmp_path / "out")
    assert done.returncode == 1, done.stderr
    assert "no vehicle was found" in done.stdout and "drives along the paths" in done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["vehicles"] == [] and any("drives along the paths" in notice for notice in summary["notices"])


def test_too_few_frames_are_refused(tmp_path: Path) -> None:
    rendered = render(scene())
    short = replace(rendered, left=rendered.left[:3], right=rendered.right[:3], times=rendered.times[:3])
    done = paceline("vehicles", unclicked(short, tmp_path))
    assert done.returncode == 1 and "only 3 frames" in done.stdout


def test_the_command_writes_what_speed_reads(search: SearchResult, tmp_path: Path) -> None:
    file = unclicked(two(), tmp_path)
    file.write_text("# a survey\n" + file.read_text(encoding="utf-8"), encoding="utf-8")
    done = paceline("vehicles", file, "--in-place")
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()[:3]] == ["vehicle", "v0", "v1"]
    assert file.read_text(encoding="utf-8").startswith("# a survey\n")
    written, found = load_clip(file).vehicles, outlines(search.detected)
    for a, b in zip(written, found, strict=True):
        assert (a.id, a.path, a.frame, a.plane, a.speed) == (b.id, b.path, b.frame, b.plane, b.speed)
        np.testing.assert_allclose([a.left, a.right], [b.left, b.right], atol=0.006)
    for name in ("v0", "v1"):
        picture = cv2.imread(str(tmp_path / f"vehicle-{name}.png"))
        assert picture is not None and len(np.unique(picture)) > 50
    assert_one_line_error(paceline("vehicles", file, "--in-place"), "clip.yaml", "vehicles", "outlined already")


def test_vehicles_of_swaying_cameras_are_outlined_where_their_pictures_show_them(tmp_path: Path) -> None:
    """By pixels that differ from those of cameras that stand still, in which they were found."""
    rendered = render(scene(TWO[0], errors=StereoErrors(sway=2e-3)))
    clip = replace(load_clip(unclicked(rendered, tmp_path)), drawn_on=8)  # to which the others are turned
    (found,) = find_recorded_vehicles(clip, open_recording(clip)).detected
    assert found.vehicle is not None and found.recorded is not None
    (row,) = (row for row in rendered.truth if row["frame"] == found.recorded.frame)
    for side in ("left", "right"):
        recorded, steady, true = getattr(found.recorded, side), getattr(found.vehicle, side), np.array(row[side])
        assert (recorded > true.min(0) - 2.0).all() and (recorded < true.max(0) + 2.0).all()
        assert np.abs(recorded - steady).max() > 0.3
    written = with_vehicles((tmp_path / "clip.yaml").read_text(encoding="utf-8"), "clip.yaml", clip.rig, [found])
    (entry,) = yaml.safe_load(written)["vehicles"]
    np.testing.assert_allclose(entry["left"], clip.rig.left.distort_points(found.recorded.left), atol=0.01)


def test_without_paths_nothing_is_written(tmp_path: Path) -> None:
    file = unclicked(two(), tmp_path)
    document = yaml.safe_load(file.read_text(encoding="utf-8"))
    del document["paths"]
    file.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert_one_line_error(paceline("vehicles", file, "--in-place"), "clip.yaml", "paths", "paceline lanes --in-place")


def test_one_view_shown_twice_is_refused(tmp_path: Path) -> None:
    rendered = two()
    file = unclicked(replace(rendered, right=rendered.left), tmp_path)
    assert_one_line_error(paceline("vehicles", file), "left and right", "the same picture in both")


@pytest.mark.parametrize("before", ["", "vehicles:\n", "vehicles: []  # none yet\n"])
@pytest.mark.parametrize("speed", [None, 16.3])
def test_vehicles_are_added_and_nothing_else_changes(before: str, speed: float | None) -> None:
    quad = np.array([[1.0, 2], [9, 2], [9, 7], [1, 7]])
    vehicle = VehicleDocument("v0", "lane: 0", 3, quad, quad + 0.25, "front", speed)
    found = DetectedVehicle(
        "lane: 0", (0.6, 2.0), 1.8, 1.5, np.ones(3), vehicle, "", (np.zeros((1, 1), np.float32),) * 2, quad[:2]
    )
    text = f"left: a  # camera 1\n{before}rate: 5\n"
    added = with_vehicles(text, "clip.yaml", make_rig(), [found])
    (entry,) = yaml.safe_load(added)["vehicles"]
    assert entry["id"] == "v0" and entry["path"] == "lane: 0" and entry["frame"] == 3
    assert entry["right"] == (quad + 0.25).tolist() and entry.get("speed") == speed
    assert (
        "left: a  # camera 1\n" in added
        and "rate: 5\n" in added
        and ("# none yet" in before) == ("# none yet" in added)
    )
    with pytest.raises(UnusableInput, match="outlined already"):
        with_vehicles(added, "clip.yaml", make_rig(), [found])
