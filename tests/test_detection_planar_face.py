"""The part of a vehicle's face that is measured, over all that was seen of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selection import slow_after
from synthetic_detections import FRAMES, PLANE_GRID, face_with, flat, painted_on, texture_up_to
from test_detection_detector import dark, frame, lane_path, lit
from tiny_road import scene

from paceline.detection.detector import Detection
from paceline.detection.finder import MIN_SIMILARITY_RATIO, initial_speed, outline
from paceline.detection.lane_paths import LanePath
from paceline.detection.planar_face import find_face, similarity, with_visible_face
from paceline.detection.tracks import DetectionTrack
from paceline.documents.loading import VehicleDocument
from paceline.geometry import triangulate
from paceline.recordings.stereo import StereoFrame
from paceline.simulation.stereo.clip import Vehicle, World, render
from paceline.speed.geometry.paths import from_points

Array = NDArray[np.float64]

HEIGHT, FOOT = 1.6, 0.75  # m, of all that is seen, and of a windscreen's lower edge
MIRRORED_AT = 34.0 + 2.0 * np.arange(FRAMES)  # m along its way


@pytest.mark.parametrize("seed", slow_after(1, [2, 3]))
@pytest.mark.parametrize(("lane", "width"), slow_after(1, [(-3.0, 1.8), (-1.85, 0.8), (-3.0, 0.8)]))
def test_face_is_located_though_the_vehicle_leaves_the_images(seed: int, lane: float, width: float) -> None:
    """It is seen best when the pictures cut it off already, and what they repeat beyond their edges agrees anywhere."""
    of = scene(Vehicle("v0", 16.0, start_distance=60.0, lane=lane, texture_seed=seed, width=width), frames=17)
    clip, world = render(of), World(of)
    path = LanePath("lane0", world.rig, from_points("lane0", "line", world.road.point(np.array([80.0, 12.0]), lane)))
    track, true, whole = DetectionTrack(), {}, {}
    for row in clip.truth:
        k, left = row["frame"], np.array(row["left"])
        if left[:, 0].max() > 20:  # px of it are left
            views = np.float32(clip.left[k]), np.float32(clip.right[k])
            pair = StereoFrame(k, float(clip.times[k]), *views, 0.0, duplicate=False)
            true[k], whole[k] = path.plane_coordinates(np.array(row["position"]))[0], row["inside"]
            x, y = (-0.5 * width, 0.5 * width), (0.2, HEIGHT)
            track.add(Detection(k, pair.time, path, true[k], x, y, 1.5, 9.0, views, flat(views), np.zeros((2, 2))))
    assert not whole[track.kept[-1].frame]
    face = find_face(with_visible_face(track))
    assert face is not None
    found = {at.detection.frame: at.s for at in face.aligned if whole[at.detection.frame]}
    assert set(found) == {s.frame for s in track.kept if whole[s.frame]}
    assert all(abs(found[k] - true[k]) < 0.25 for k in found)  # m


def below_a_mirror(seed: int, contrast: float, alike: int) -> DetectionTrack:
    """A face, and above it so many times its contrast, the same in the last ``alike`` frames only, which are the
    nearest."""
    world, track, rng = (
        World(scene(Vehicle("v0", 16.0, start_distance=60.0))),
        DetectionTrack(),
        np.random.default_rng(seed),
    )
    lane = LanePath("lane0", world.rig, from_points("lane0", "line", world.road.point(np.array([80.0, 12.0]), 1.85)))
    own, above = texture_up_to(PLANE_GRID.top, seed), (PLANE_GRID.y > FOOT)[:, None]
    for k, s in enumerate(MIRRORED_AT):
        mirrored = 100.0 + contrast * (texture_up_to(PLANE_GRID.top, 100 * seed + min(k, FRAMES - alike)) - 100.0)
        pair = painted_on(lane, s, np.where(above, mirrored, own), rng)
        seen = s + rng.uniform(-1.5, 1.5)
        x, y = (-0.85, 0.85), (0.2, 1.6)
        track.add(Detection(k, 0.1 * k, lane, seen, x, y, 1.5, 9.0, pair, flat(pair), np.zeros((2, 2))))
    return track


def lamps_seen(true: Array, ahead: float) -> DetectionTrack:
    """Two lamps at night at the ``true`` arc lengths, and the light that they throw on the road, by which the vehicle
    was seen so many metres ``ahead`` of them."""
    track = DetectionTrack()
    spots = [(0.0, x, 0.6, width, peak) for x in (-0.6, 0.6) for width, peak in ((0.1, 700.0), (0.7, 60.0))]
    for k, s in enumerate(true):
        views, at = lit(s, [*spots, (ahead, 0.0, 0.5, 0.9, 60.0)]), frame(k)
        x, y = (-1.2, 1.2), (0.2, 1.5)
        track.add(Detection(k, at.time, lane_path(), s + ahead, x, y, 1.5, 9.0, views, dark(), np.zeros((2, 2))))
    return track


@pytest.mark.parametrize("start", [10.0, 25.0])
@pytest.mark.parametrize("ahead", slow_after(2, [-2.5, 2.0, -2.0, 2.5]))
def test_face_at_night_is_located_at_its_lamps_and_not_at_their_light(start: float, ahead: float) -> None:
    true = start + 2.5 * np.arange(6)
    face = find_face(with_visible_face(lamps_seen(true, ahead)))
    assert face is not None
    off = [(at.s - s) / at.detection.distance_error(0.0, 1.0) for at, s in zip(face.aligned, true, strict=True)]
    assert np.abs(off).max() < 0.3  # px of disparity


def rear_lamps_seen(apart: float, x: tuple[float, float], whole: int) -> DetectionTrack:
    """Of two lamps so far apart, m, the left one, from ``x`` to ``x`` on the plane; the other one shows in as many
    frames as it is ``whole``, the nearest."""
    track, rng = DetectionTrack(), np.random.default_rng(1)
    for k, s in enumerate(30.0 + 3.0 * np.arange(10)):
        spots = [(0.0, side * 0.5 * apart, 0.6, 0.1, 60.0) for side in ((-1, 1) if k < whole else (-1,))]
        left, right = (view + 0.5 * rng.standard_normal(view.shape, np.float32) for view in lit(s, spots))
        of = (0.2, 1.5), 1.5, 9.0, (left, right), dark(), np.zeros((2, 2))
        track.add(Detection(k, 0.1 * k, lane_path(), s, x, *of))
    return track


def narrow_beside_a_wall(width: float, x: tuple[float, float], contrast: float, light: float) -> DetectionTrack:
    """What is as wide as ``width`` m in the middle of its way and was seen from ``x`` to ``x``; a wall with edges along
    the road, which was seen in ``light`` times as much light before, stands 1.6 m beside it."""
    track, rng, lane = DetectionTrack(), np.random.default_rng(2), lane_path()
    stripes = np.float32(100.0 + contrast * np.tile(rng.normal(0.0, 1.0, (8, 1)).repeat(5, 0), 2))
    texture = texture_up_to(1.2, 1)
    shown = np.float32((np.abs(PLANE_GRID.x) < 0.5 * width) & (PLANE_GRID.y[:, None] < 1.2))
    for k, s in enumerate(30.0 + 2.0 * np.arange(8)):
        views, before = [], []
        for side, (H, camera) in enumerate(zip(lane.homographies(s), lane.rig.cameras, strict=True)):
            ends = [lane.pixels(at, np.array([[-1.6, 1.2], [-1.6, 0.0]]))[side] for at in (70.0, 4.0)]
            cells = np.float32([[0, 0], [0, 39], [1, 0], [1, 39]])
            wall = cv2.getPerspectiveTransform(cells, np.concatenate(ends).astype(np.float32))
            scene = cv2.warpPerspective(stripes, wall, camera.image_size, borderValue=100.0)
            cover = cv2.warpPerspective(shown, H @ PLANE_GRID.to_metres, camera.image_size)
            view = cv2.warpPerspective(texture, H @ PLANE_GRID.to_metres, camera.image_size, borderValue=100.0)
            before.append(np.uint8(np.rint(light * cv2.GaussianBlur(scene, (0, 0), 0.8))))
            view = cv2.GaussianBlur(scene + cover * (view - scene), (0, 0), 0.8)
            views.append(np.float32(view + rng.normal(0.0, 1.0, view.shape)))
        of = (0.2, 1.4), 1.0, 9.0, (views[0], views[1]), (before[0], before[1]), np.zeros((2, 2))
        track.add(Detection(k, 0.1 * k, lane, s, x, *of))
    return track


@pytest.mark.parametrize(("width", "x"), [(0.8, (-0.4, 0.4)), (1.8, (-0.9, -0.1))])
@pytest.mark.parametrize(
    ("contrast", "light"), slow_after(1, [(8.0, 0.7), (25.0, 1.5), (25.0, 0.3), (8.0, 1.0), (25.0, 1.0)])
)
def test_a_wall_beside_a_narrow_or_partly_visible_vehicle_is_not_part_of_it(
    width: float, x: tuple[float, float], contrast: float, light: float
) -> None:
    """Its picture is the same in all frames, and in both views at any distance."""
    found = outline(narrow_beside_a_wall(width, x, contrast, light))
    assert found.vehicle is not None
    corners = triangulate(lane_path().rig, found.vehicle.left, found.vehicle.right)
    s, across, _ = lane_path().plane_coordinates(corners.mean(0))
    assert abs(across) + 0.5 * width_of(found.vehicle) < 0.5 * width + 0.2
    assert abs(s - 30.0 - 2.0 * found.vehicle.frame) < 0.25


def width_of(vehicle: VehicleDocument) -> float:
    """m."""
    corners = triangulate(lane_path().rig, vehicle.left, vehicle.right)
    return float(np.linalg.norm(corners[1] - corners[0]))


@pytest.mark.parametrize("x", [(-1.2, -0.6), (-0.9, -0.9)])
def test_the_outline_of_a_lorry_with_one_visible_lamp_includes_the_other(x: tuple[float, float]) -> None:
    found = outline(rear_lamps_seen(1.8, x, 10))
    assert found.vehicle is not None and width_of(found.vehicle) > 1.8


def test_a_vehicle_that_another_one_hides_farther_away_is_outlined_as_it_was_nearer() -> None:
    found = outline(rear_lamps_seen(1.2, (-0.9, -0.3), 4))
    assert found.vehicle is not None and found.vehicle.frame < 4 and width_of(found.vehicle) > 1.2


@pytest.mark.parametrize("ahead", slow_after(2, [-3.4, 3.4, -3.8, 3.8]))
def test_face_beyond_the_search_range_is_not_found(ahead: float) -> None:
    """It looks more and more like one towards the end of the search range."""
    assert find_face(with_visible_face(lamps_seen(25.0 + 2.5 * np.arange(6), ahead))) is None


def test_search_range_grows_with_distance() -> None:
    """By a pixel of disparity, which is more than three metres there."""
    true = np.array([46.0, 48.0, 50.0, 52.0])
    track = lamps_seen(true, -3.5)
    face = find_face(with_visible_face(track))
    assert face is not None
    assert np.abs([at.s - s for at, s in zip(face.aligned, true, strict=True)]).max() < 1.0


@pytest.mark.filterwarnings("error")
def test_what_hangs_above_the_road_in_all_frames_has_no_outline() -> None:
    track = lamps_seen(25.0 + 2.5 * np.arange(6), 0.0)
    track.kept[:] = [replace(seen, y=(1.9, 2.5)) for seen in track.kept]
    assert outline(track).vehicle is None


@pytest.mark.filterwarnings("error")
def test_pictures_without_any_contrast_show_no_face() -> None:
    seen, track = face_with(np.full_like(texture_up_to(PLANE_GRID.top, 1), 100.0), 1).aligned, DetectionTrack()
    for at in seen:
        left, right = (np.full_like(crop, 100.0) for crop in at.detection.crops)
        track.add(replace(at.detection, crops=(left, right)))
    assert find_face(with_visible_face(track)) is None


@pytest.mark.parametrize(
    "odd", slow_after(2, [{0, 4, FRAMES - 1}, {0, 1}, {FRAMES - 2, FRAMES - 1}, {0, 1, FRAMES - 1}])
)
def test_similarity_is_to_the_median_image(odd: set[int]) -> None:
    """In the odd ones another thing, and more of it, was seen in its place."""
    own = face_with(texture_up_to(PLANE_GRID.top, 1), 1).aligned
    other = face_with(texture_up_to(PLANE_GRID.top, 2), 2).aligned
    track = DetectionTrack()
    for k, (at, instead) in enumerate(zip(own, other, strict=True)):
        track.add(replace(instead.detection, area=4.0) if k in odd else at.detection)
    face = find_face(with_visible_face(track))
    assert face is not None and {at.detection.frame for at in face.aligned} == set(range(FRAMES)) - odd


@pytest.mark.parametrize("seed", [1, 2])
def test_face_of_all_frames_is_preferred_to_a_larger_one_of_few(seed: int) -> None:
    """A windscreen mirrors the same in the two nearest ones, and another thing in each of the others."""
    track = below_a_mirror(seed, 4.0, 2)
    face = find_face(with_visible_face(track))
    assert face is not None and len(face.aligned) == FRAMES


@pytest.mark.parametrize("seed", slow_after(1, [1, 2, 3]))
@pytest.mark.parametrize("contrast", [2.0, 4.0])
def test_face_is_found_below_changing_reflections(seed: int, contrast: float) -> None:
    """Where each frame has it is not known but by the face."""
    face = find_face(with_visible_face(below_a_mirror(seed, contrast, 1)))
    assert face is not None and len(face.aligned) == FRAMES and face.y[1] < FOOT + 0.1
    off = [(at.s - s) / at.detection.distance_error(0.0, 1.0) for at, s in zip(face.aligned, MIRRORED_AT, strict=True)]
    assert np.abs(off).max() < 0.3  # px of disparity


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("seed", slow_after(1, [1, 2, 3]))
def test_partly_covered_face_is_less_similar(seed: int, side: int) -> None:
    """By a third at its side, in some of the frames, by something with as much contrast."""
    texture, covered = texture_up_to(PLANE_GRID.top, seed), 4
    other = np.where(side * PLANE_GRID.x > 0.25, texture_up_to(PLANE_GRID.top, seed + 10), texture).astype(np.float32)
    face = face_with(texture, seed, (other, covered))
    alike = similarity(face, face.aligned)
    assert alike.shape == (FRAMES,)
    assert alike[:covered].max() < MIN_SIMILARITY_RATIO * np.median(alike) < alike[covered:].min()


def test_the_first_speed_is_that_of_the_first_half_if_it_moves() -> None:
    seen = face_with(texture_up_to(PLANE_GRID.top, 1), 1).aligned
    assert initial_speed(seen) == pytest.approx(20.0)  # 2 m in a tenth of a second
    assert initial_speed(seen[:3]) is None
    standing = [replace(a, s=seen[0].s) for a in seen[:5]] + seen[5:]
    assert initial_speed(standing) is None  # clip.yaml holds no speed of zero
