"""The plane-sweep detector, its upright ratio, tracks over time, and the queue of measurements."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from synthetic_detections import flat
from tiny_road import TWO, scene

from paceline.detection.detector import (
    COARSE_GRID,
    COARSE_NCC_WINDOW,
    FINE_GRID,
    FINE_NCC_WINDOW,
    Detection,
    PlaneSweepDetector,
    _vehicle_mask,
    extent,
    largest_component,
    without_component,
)
from paceline.detection.finder import motion_inliers, outline, without_outline
from paceline.detection.lane_paths import LanePath, PlaneGrid, image_pyramid, warp_to_plane
from paceline.detection.photo_consistency import (
    MIN_CHANGE,
    LocalStatistics,
    local_ncc,
    photo_consistency,
    upright_ratio,
)
from paceline.detection.planar_face import AlignedDetection
from paceline.detection.plane_sweep import Pyramids, SweepPlane, plane_at
from paceline.detection.tracks import DetectionTrack, similarity
from paceline.documents.loading import VehicleDocument
from paceline.recordings.live_stereo import RawPair
from paceline.recordings.stereo import StereoFrame
from paceline.simulation.stereo.clip import RenderedClip, Vehicle, World, render
from paceline.simulation.stereo.scenery import StaticBackground
from paceline.speed.configuration import DEFAULTS, SpeedConfiguration
from paceline.speed.geometry.paths import from_points
from paceline.survey import live
from paceline.survey.live import MAX_PAIR_SPACING_S, subsample

MAX_PAIRS_PER_VEHICLE = DEFAULTS.live.pairs_per_vehicle

Image = NDArray[np.float32]


@cache
def clip() -> RenderedClip:
    return render(scene(*TWO))


@cache
def world() -> World:
    return World(scene(*TWO))


@cache
def lane_path(lane: float = -1.85) -> LanePath:
    """The middle of a lane as it is, no matter how it was drawn."""
    points = world().road.point(np.array([80.0, 12.0]), lane)
    return LanePath("lane0", world().rig, from_points("lane0", "line", points))


@cache
def empty() -> tuple[Image, Image]:
    left, right = (
        StaticBackground(world().scene, world().road, world().scene.seed).draw(view) for view in world().views
    )
    return left, right


def frame(index: int) -> StereoFrame:
    left, right = (np.asarray(pictures[index], np.float32) for pictures in (clip().left, clip().right))
    return StereoFrame(index, float(clip().times[index]), left, right, 0.0, duplicate=False)


# --- sweep planes ----------------------------------------------------------------------------------------------------


def expected_consistency(views: list[LocalStatistics], empty: list[LocalStatistics], least: float) -> Image:
    """The result of `SweepPlane.consistency_map`, computed on whole images."""
    left, right = views
    consistency = photo_consistency(left, right) * (np.minimum(left.std, right.std) > least)
    for now, before in zip(views, empty, strict=True):
        consistency *= local_ncc(now, before) < 1 - MIN_CHANGE
    return consistency


def textures(views: Pyramids, plane: SweepPlane) -> list[LocalStatistics]:
    """Both images warped to a plane by OpenCV."""
    grid, found = plane.grid, []
    for levels, cells in zip(views, plane.homographies, strict=True):
        H = np.diag([0.5**plane.level, 0.5**plane.level, 1.0]) @ cells
        flags, border = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
        laid = cv2.warpPerspective(levels[plane.level], H, grid.size, flags=flags, borderMode=border)
        found.append(LocalStatistics(np.asarray(laid, np.float32), plane.window))
    return found


def card_and_views(k: int, grid: PlaneGrid, window: int) -> tuple[SweepPlane, Pyramids, Pyramids]:
    """The ``k``-th sweep plane, a frame and its background, without the first 16 rows of the images."""
    plane = plane_at(lane_path().homographies(lane_path().sweep_positions()[k]), grid, window, 16)
    views, scenes = ([image_pyramid(i[16:]) for i in pair] for pair in ((frame(2).left, frame(2).right), empty()))
    return plane, views, scenes


@pytest.mark.parametrize(("grid", "window"), [(FINE_GRID, FINE_NCC_WINDOW), (COARSE_GRID, COARSE_NCC_WINDOW)])
@pytest.mark.parametrize("k", [3, 24, 50])
def test_consistency_of_a_plane_is_that_of_whole_images(grid: PlaneGrid, window: int, k: int) -> None:
    """But for OpenCV's rounding of places to 1/32 px."""
    plane, views, scenes = card_and_views(k, grid, window)
    now, before = textures(views, plane), textures(scenes, plane)
    alike, contrast = plane.correlation_map(views)
    np.testing.assert_allclose(alike, local_ncc(*now), atol=0.1)
    assert np.abs(alike - local_ncc(*now)).mean() < 0.005
    np.testing.assert_allclose(contrast, now[0].std, atol=0.5, rtol=0.1)
    expected = expected_consistency(now, before, 2.0)
    assert np.abs(plane.consistency_map(views, scenes, 2.0) - expected).mean() < 0.01
    assert expected.sum() == pytest.approx(plane.consistency_map(views, scenes, 2.0).sum(), rel=0.05, abs=2.0)


def test_consistency_below_the_minimum_area_is_zero() -> None:
    plane, views, scenes = card_and_views(24, COARSE_GRID, COARSE_NCC_WINDOW)
    consistency = plane.consistency_map(views, scenes, 2.0)
    area = float(consistency.sum()) * COARSE_GRID.cell**2
    assert area > 0
    np.testing.assert_array_equal(plane.consistency_map(views, scenes, 2.0, 0.99 * area), consistency)
    assert not plane.consistency_map(views, scenes, 2.0, 1.01 * area).any()


def test_masked_cells_are_cleared() -> None:
    plane, views, _ = card_and_views(24, FINE_GRID, FINE_NCC_WINDOW)
    explained = np.zeros(views[0][0].shape, np.uint8)
    explained[:, : explained.shape[1] // 3] = 1
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    expected = cv2.warpPerspective(explained, plane.homographies[0], FINE_GRID.size, flags=flags) == 0
    consistency = np.ones(FINE_GRID.size[::-1], np.float32)
    plane.clear_masked(consistency, explained)
    assert 0 < expected.mean() < 1 or explained.all()
    assert ((consistency > 0) != expected).mean() < 0.01  # on the edge


@pytest.mark.parametrize("height", [4.0, 4.5, 5.0])
def test_a_vehicle_is_detected_over_the_roof_of_the_one_before_it(height: float) -> None:
    """Nothing of its face is hidden; the one before reaches five metres back, not eighteen."""
    before = Vehicle("v0", 15.0, start_distance=27.0, lane=-1.85, texture_seed=6)
    behind = replace(before, id="v1", start_distance=46.0, texture_seed=9)
    of = scene(before, behind, camera_height=height, tilt=height / 45.0, frames=1)
    world, clip = World(of), render(of)
    points = world.road.point(np.array([80.0, 12.0]), -1.85)
    lane = LanePath("lane0", world.rig, from_points("lane0", "line", points))
    left, right = (StaticBackground(of, world.road, of.seed).draw(view) for view in world.views)
    pair = (np.asarray(pictures[0], np.float32) for pictures in (clip.left, clip.right))
    detections = PlaneSweepDetector([lane]).detect(StereoFrame(0, 0.0, *pair, 0.0, duplicate=False), (left, right))
    truth = sorted(lane.plane_coordinates(np.array(row["position"]))[0] for row in clip.truth)
    assert len(detections) == 2
    for detection, s in zip(sorted(detections, key=lambda at: at.s), truth, strict=True):
        assert abs(detection.s - s) < detection.distance_error(1.0, 1.0)
        assert detection.y[0] < 0.5  # its face is seen, not its roof alone


def test_rows_outside_the_visible_ones_are_not_used() -> None:
    """What is found is the same when the other rows are black."""
    detector, before = PlaneSweepDetector([lane_path()]), empty()
    height = len(before[0])
    assert 0 < detector.rows.start < detector.rows.stop <= height
    kept = np.zeros((height, 1), np.float32)
    kept[detector.rows] = 1.0
    whole, cut = frame(4), replace(frame(4), left=frame(4).left * kept, right=frame(4).right * kept)
    (a, b) = (detector.detect(f, e)[0] for f, e in ((whole, before), (cut, (before[0] * kept, before[1] * kept))))
    assert (a.s, a.x, a.y, a.area) == (b.s, b.x, b.y, b.area)
    np.testing.assert_array_equal(a.crops[0], b.crops[0])


def test_coarse_pass_misses_no_maximum_of_the_fine_planes() -> None:
    """The first detection lies on the plane with the largest consistent area on the fine grid."""
    detector, positions = PlaneSweepDetector([lane_path()]), lane_path().sweep_positions()
    for index in (0, 4, 8):
        detection = detector.detect(frame(index), empty())[0]
        views, scenes = (
            [image_pyramid(i) for i in pair] for pair in ((frame(index).left, frame(index).right), empty())
        )
        areas = []
        for s in positions:
            now, before = (
                [
                    LocalStatistics(warp_to_plane(v, H, FINE_GRID), FINE_NCC_WINDOW)
                    for v, H in zip(pair, lane_path().homographies(s), strict=True)
                ]
                for pair in (views, scenes)
            )
            areas.append(expected_consistency(now, before, 2.0).sum())
        best = int(np.argmax(areas))
        assert positions[best - 1] <= detection.s <= positions[best + 1]


def test_background_is_not_detected() -> None:
    detector = PlaneSweepDetector([lane_path()])
    assert detector.detect(frame(2), (frame(2).left, frame(2).right)) == []
    assert detector.detect(frame(2), empty())


# --- upright ratio ---------------------------------------------------------------------------------------------------


def painted(lying: bool, s: float) -> tuple[Image, Image]:
    """Both views of a blot at station ``s``: on the road 3 m behind it, or upright."""
    texture = cv2.GaussianBlur(np.random.default_rng(2).normal(0, 250, (60, 60)), (0, 0), 3.0).astype(np.float32)
    source = np.array([[0, 0], [59, 0], [59, 59], [0, 59]], np.float32)
    pictures = []
    for view, picture in enumerate(empty()):
        if lying:
            rectangle = ((7.0, -0.8), (7.0, 0.8), (3.0, 0.8), (3.0, -0.8))
            ends = [lane_path().point(s + away, x, 0.0) for away, x in rectangle]
            corners = lane_path().rig.project(np.array(ends))[view]
        else:
            corners = lane_path().pixels(s, np.array([[-0.8, 1.3], [0.8, 1.3], [0.8, 0.3], [-0.8, 0.3]]))[view]
        H = cv2.getPerspectiveTransform(source, corners.astype(np.float32))
        pictures.append(picture + cv2.warpPerspective(texture, H, picture.shape[::-1]))
    return pictures[0], pictures[1]


@pytest.mark.parametrize("lying", [False, True])
def test_texture_on_the_road_is_distinguished_from_an_upright_one(lying: bool) -> None:
    s = float(lane_path().sweep_positions()[40])
    pictures = painted(lying, s)
    views, scenes = ([image_pyramid(np.asarray(i, np.float32)) for i in pair] for pair in (pictures, empty()))
    left, right = lane_path().homographies(s)
    road = lane_path().road_homography(s) @ left
    seen, upright, flat = (
        LocalStatistics(warp_to_plane(views[side], H, FINE_GRID), FINE_NCC_WINDOW)
        for side, H in ((0, left), (1, right), (1, road))
    )
    warped = [warp_to_plane(v, H, FINE_GRID) for v, H in zip(scenes, (left, right), strict=True)]
    before = [LocalStatistics(image, FINE_NCC_WINDOW) for image in warped]
    consistency = expected_consistency([seen, upright], before, 1.0)
    assert consistency.sum() > 0
    assert (upright_ratio(consistency, local_ncc(seen, flat), seen.std) < 1.0) == lying
    pair = replace(frame(0), left=pictures[0], right=pictures[1])
    detections = PlaneSweepDetector([lane_path()]).detect(pair, empty())
    assert len(detections) == (0 if lying else 1)


def test_sharp_lamps_are_upright_in_spite_of_light_on_the_road() -> None:
    """The light matches better lying, over nine tenths of the plane, but with little contrast."""
    lamps = np.arange(20) < 2
    consistency, lying = np.where(lamps, 0.9, 0.5)[None], np.where(lamps, 0.4, 0.95)[None]
    faint, even = np.where(lamps, 80.0, 4.0)[None], np.ones((1, 20))
    assert upright_ratio(consistency, lying, faint) > 1.5 and upright_ratio(consistency, lying, even) < 1.0
    assert upright_ratio(consistency, lying, 3.0 * faint) == pytest.approx(upright_ratio(consistency, lying, faint))


Spot = tuple[float, float, float, float, float]  # m ahead, aside and up, and wide (one sigma); grey levels at its peak


def lit(s: float, spots: list[Spot]) -> tuple[Image, Image]:
    """Both views of the road by the light of ``spots`` about ``s``."""
    pictures = []
    for view, picture in enumerate(empty()):
        image, v, u = 0.07 * picture, *np.mgrid[: picture.shape[0], : picture.shape[1]]
        for ahead, x, y, sigma, peak in spots:
            centre, beside = (lane_path().pixels(s + ahead, np.array([x + d, y]))[view] for d in (0.0, sigma))
            width = np.linalg.norm(beside - centre)
            image += peak * np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * width**2))
        noise = np.random.default_rng(view).normal(0, 1.0, image.shape)
        pictures.append(np.clip(image + noise, 0, 255).astype(np.float32))
    return pictures[0], pictures[1]


def unlit() -> tuple[Image, Image]:
    """Both views of the road without them."""
    left, right = (np.asarray(0.07 * picture, np.float32) for picture in empty())
    return left, right


def dark() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The same as it is kept."""
    left, right = (np.rint(picture).astype(np.uint8) for picture in unlit())
    return left, right


def off(s: float, spots: list[Spot]) -> float:
    """How far from ``s`` the first vehicle is seen, px of disparity."""
    left, right = lit(s, spots)
    first, *_ = PlaneSweepDetector([lane_path()]).detect(replace(frame(0), left=left, right=right), unlit(), 1.0)
    return abs(first.s - s) / first.distance_error(0.0, 1.0)


@pytest.mark.parametrize("k", [24, 36, 48])
def test_lamps_are_located_at_themselves_and_not_at_their_light_on_the_road(k: int) -> None:
    """It lies four metres behind them in one piece."""
    spots = [(0.0, -0.7, 0.6, 0.1, 700.0), (0.0, 0.7, 0.6, 0.1, 700.0), (4.0, 0.0, 0.5, 0.9, 60.0)]
    assert off(float(lane_path().sweep_positions()[k]), spots) < 0.25


@pytest.mark.parametrize("s", [2.0, 2.25, 3.0, 3.5])
@pytest.mark.parametrize("x", [0.25, 0.3])
def test_near_lamps_are_not_located_by_the_glow_about_them(s: float, x: float) -> None:
    """As much of it counts at stations that are many pixels of disparity apart."""
    lamps = ((0.0, 0.3, 0.12, 700.0), (0.0, 0.3, 0.6, 35.0), (-4.0, -0.3, 0.84, 21.0))
    assert off(s, [(ahead, side * x, *lamp) for side in (-1, 1) for ahead, *lamp in lamps]) < 0.25


@pytest.mark.parametrize("side", [-1, 1])
def test_crop_of_one_detected_lamp_contains_the_other(side: int) -> None:
    left, right = lit(20.0, [(0.0, 0.9 * side, 0.6, 0.1, 700.0)])
    seen, *_ = PlaneSweepDetector([lane_path()]).detect(replace(frame(0), left=left, right=right), unlit(), 1.0)
    assert np.abs(seen.x).max() < 1.5
    for crop, corner, lamp in zip(
        seen.crops, seen.crop_origins, lane_path().pixels(20.0, np.array([[-0.95 * side, 0.6]])), strict=True
    ):
        assert (lamp - corner > 0).all() and (lamp - corner < crop.shape[::-1]).all()


def test_detection_keeps_a_copy_of_its_background() -> None:
    """Of which the scene may later be changed."""
    now, scene = frame(0), tuple(view.copy() for view in empty())
    seen, *_ = PlaneSweepDetector([lane_path()]).detect(now, scene)
    for view in scene:
        view[:] = 0.0
    for crop, before, corner, view, behind in zip(
        seen.crops, seen.background, seen.crop_origins.astype(int), (now.left, now.right), empty(), strict=True
    ):
        part = np.s_[corner[1] : corner[1] + crop.shape[0], corner[0] : corner[0] + crop.shape[1]]
        np.testing.assert_array_equal(crop, view[part])
        np.testing.assert_array_equal(before, np.rint(behind[part]))
        assert np.abs(crop - before).max() > 30


# --- over time -------------------------------------------------------------------------------------------------------


def detection(time: float, s: float, x: tuple[float, float] = (-0.9, 0.9), of: StereoFrame | None = None) -> Detection:
    crops = (empty() if of is None else (of.left, of.right), flat(empty()), np.zeros((2, 2)))
    return Detection(round(10 * time), time, lane_path(), s, x, (0.2, 1.5), 1.5, 9.0, *crops)


def test_the_tallest_vehicles_hide_what_is_behind_them() -> None:
    lorry, shape = replace(detection(0.0, 30.0), y=(0.2, 2.5)), world().scene.image_size[::-1]
    low, high = (_vehicle_mask(lorry, np.zeros((1, 3)), shape, 0, max_height).face for max_height in (3.0, 4.5))
    assert (high >= low).all() and high.sum() > 1.3 * low.sum()


def test_outlier_at_the_start_is_left_out() -> None:
    times = np.arange(8) / 5
    aligned = [AlignedDetection(detection(t, 5 + 14 * t), 5 + 14 * t, np.zeros(2), 0.8) for t in times]
    assert motion_inliers(aligned) == aligned
    wrong = [replace(aligned[0], s=9.0), *aligned[1:]]
    assert motion_inliers(wrong) == aligned[1:]
    assert motion_inliers(aligned[:2]) == aligned[:2]


@pytest.mark.parametrize("off", [-12.0, -9.0, 9.0, 12.0])
def test_outlier_at_the_start_does_not_bend_the_motion(off: float) -> None:
    """A vehicle that goes was seen once, and again from a second later on: places far away, which may be off by more,
    would give way."""
    times = np.array([0.0, *(1.1 + 0.5 * np.arange(7))])
    aligned = [AlignedDetection(detection(t, 8 + 13 * (t - 1.1)), 8 + 13 * (t - 1.1), np.zeros(2), 0.8) for t in times]
    assert motion_inliers(aligned) == aligned
    assert motion_inliers([replace(aligned[0], s=aligned[0].s + off), *aligned[1:]]) == aligned[1:]


@given(speed=st.floats(-30, 30), n=st.integers(4, 30), seed=st.integers(0, 1000))
def test_travel_is_the_distance_driven(speed: float, n: int, seed: int) -> None:
    noise = np.random.default_rng(seed).normal(0, 0.02, n)
    track = DetectionTrack(arc_lengths=(speed * 0.1 * np.arange(n) + noise).tolist())
    assert track.motion.travel == pytest.approx(speed * 0.1 * (n - 1), abs=0.2 + 0.05 * abs(speed))


def test_origin_of_a_face_on_the_planes_of_another_lane() -> None:
    other = lane_path(1.85)
    at = AlignedDetection(detection(0.0, 20.0), 20.0, np.array([0.4, 0.1]), 0.8)
    place = lane_path().point(20.0, *at.origin)
    moved = at.origin_on(other)
    assert at.origin_on(lane_path()) is at.origin
    np.testing.assert_allclose(other.point(other.path.nearest(place), *moved), place, atol=1e-3)
    assert moved[0] == pytest.approx(0.4 - 3.7, abs=0.1)


def test_frames_without_a_detection_are_counted_only_between_detections() -> None:
    track = DetectionTrack()
    for time, unseen in ((0.0, 0), (0.3, 2), (0.4, 0)):
        track.frames_unseen = unseen
        track.add(detection(time, 10 + time))
    track.frames_unseen = 5
    assert track.frames_missed == 2


def test_face_is_matched_within_a_wider_detection() -> None:
    at = next(r for r in clip().truth if r["vehicle"] == "v0" and r["frame"] == 3)
    s = lane_path().path.nearest(np.array(at["position"]))
    narrow = detection(0.6, s, (-0.9, 0.9), frame(3))
    wide = detection(0.6, s, (-0.9, 2.9), frame(3))
    assert similarity(narrow, wide) > 0.95 and similarity(wide, narrow) > 0.95
    assert similarity(narrow, detection(0.6, s + 12.0, (-0.9, 0.9), frame(3))) < 0.6


@given(n=st.integers(1, 400), rate=st.floats(2.0, 60.0))
def test_pairs_are_subsampled_up_to_the_maximum_spacing(n: int, rate: float) -> None:
    blank = np.zeros((1, 1), np.uint8)
    pairs = [RawPair(k, k / rate, blank, blank, 0.0) for k in range(n)]
    chosen = subsample(pairs, MAX_PAIRS_PER_VEHICLE)
    apart = np.diff([pair.time for pair in chosen])
    assert chosen[0] is pairs[0]
    assert (apart <= max(1.1 * MAX_PAIR_SPACING_S, 1 / rate) + 1e-9).all()
    assert len(chosen) <= MAX_PAIRS_PER_VEHICLE or np.allclose(apart, apart[0])
    if n <= MAX_PAIRS_PER_VEHICLE:
        assert chosen == pairs


def test_grid_size_is_its_number_of_cells() -> None:
    grid = PlaneGrid(left=-1.0, top=2.0, bottom=0.5, cell=0.25)
    assert grid.size == (len(grid.x), len(grid.y)) == (9, 7)
    assert (grid.x[0], grid.x[-1], grid.y[0], grid.y[-1]) == (-1.0, 1.0, 2.0, 0.5)


# --- the queue -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OneClip:
    """What the queue changes of a clip."""

    vehicles: list[VehicleDocument]


class Seen(NamedTuple):
    """A measurement that knows its frames, without information on the rig."""

    vehicle: str
    frames: list[int]
    verdict: str = "rejected"
    rig_information: None = None


class Slow:
    """A measuring process that answers only when asked to: outlines as given, and a measurement for each clip."""

    def __init__(self, outlines: dict[int, VehicleDocument | None]) -> None:
        self.outlines = outlines
        self.jobs: list[Any] = []

    def submit(self, job: Any, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.jobs.append((future, job, arguments))
        return future

    def work(self) -> None:
        jobs, self.jobs = self.jobs, []
        for future, job, arguments in jobs:
            if job is outline:
                track = arguments[0]
                vehicle = self.outlines[track.first.frame]
                future.set_result(replace(without_outline(track, "" if vehicle else "smooth"), vehicle=vehicle))
            else:
                seen = Seen(arguments[0].vehicles[0].id, [pair.index for pair in arguments[1]])
                future.set_result(seen)


def seen_at(index: int) -> DetectionTrack:
    """Of vehicles side by side."""
    return driven(0.1 * index + np.arange(4) / 10, 10.0 + np.arange(4), (3.7 * index - 0.9, 3.7 * index + 0.9))


def driven(times: NDArray[np.float64], s: NDArray[np.float64], x: tuple[float, float] = (-0.9, 0.9)) -> DetectionTrack:
    track = DetectionTrack()
    for t, at in zip(times, s, strict=True):
        track.add(detection(float(t), float(at), x))
    return track


@pytest.mark.parametrize(("wide", "top"), [(0.4, 1.5), (1.4, 2.3)])
def test_thin_part_above_a_face_is_left_out_of_its_extent(wide: float, top: float) -> None:
    """Of the next vehicle's roof, whose level edges agree at any distance; a wide one is the vehicle's own. The same
    holds for a mirror beside it."""
    x, y = FINE_GRID.x[None], FINE_GRID.y[:, None]
    face, above = (np.abs(x) < 0.9) & (y < 1.5), (np.abs(x - 0.1) < wide / 2) & (y < 2.3)
    mirror = (x > 0) & (x < 1.2) & (np.abs(y - 1.0) < 0.1)
    np.testing.assert_allclose(extent(face | above | mirror), ((-0.9, 0.9), (0.2, top)), atol=1.01 * FINE_GRID.cell)


def test_a_motorcycle_is_as_tall_as_its_rider_beside_something_low_and_wide() -> None:
    x, y = FINE_GRID.x[None], FINE_GRID.y[:, None]
    piece = (np.abs(x) < 0.35) & (y < 1.7) | (np.abs(x) < 1.2) & (y < 0.5)
    np.testing.assert_allclose(extent(piece), ((-0.35, 0.35), (0.2, 1.7)), atol=1.01 * FINE_GRID.cell)


def test_component_of_one_row_has_an_extent() -> None:
    row = (np.abs(FINE_GRID.x) < 0.5) & (np.arange(len(FINE_GRID.y)) == 20)[:, None]
    x, y = extent(row)
    assert y == (FINE_GRID.y[20], FINE_GRID.y[20]) and np.allclose(x, (-0.5, 0.5), atol=1.01 * FINE_GRID.cell)


@given(st.integers(0, 2**16), st.floats(0.5, 4.0), st.floats(0.0, 1.5))
def test_removing_component_after_component_ends(seed: int, grain: float, sparse: float) -> None:
    """Each takes something away, also a ring's empty middle."""
    noise = np.random.default_rng(seed).standard_normal(FINE_GRID.size[::-1]).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), grain)
    consistency = np.clip(smooth / smooth.std() - sparse, 0, 1).astype(np.float32)
    while consistency.any():
        piece = largest_component(consistency)
        left = without_component(piece, consistency)
        assert left.sum() < consistency.sum()
        assert not left[piece].any()
        assert ((left == consistency) | (left == 0)).all()
        consistency = left


def outlined(index: int) -> VehicleDocument:
    quad = np.zeros((4, 2))
    return VehicleDocument("", "lane0", index, quad, quad, "front", None)


def test_results_come_in_order_and_only_outlined_vehicles_are_numbered() -> None:
    blank = np.zeros((1, 1), np.uint8)
    results: list[Any] = []
    recent = [RawPair(k, 0.1 * k, blank, blank, 0.0) for k in range(5, 15)]
    process = Slow({6: outlined(7), 8: None, 9: outlined(9), 2: outlined(2)})
    queue = live.MeasurementQueue(OneClip([]), SpeedConfiguration(), process, lambda *said: results.append(said))  # type: ignore[arg-type]
    for index in (6, 8, 9, 2):
        queue.submit(seen_at(index), recent)
    queue.publish()
    assert results == []  # nothing is known yet, and nobody has waited for it
    for _ in range(2):
        process.work()
        queue.publish()
    names = [found.vehicle and found.vehicle.id for found, _, _ in results]
    assert names == ["v0", None, "v1", "v2"]
    assert [measurement for _, measurement, _ in results] == [
        Seen("v0", list(range(7, 15))),
        None,
        Seen("v1", list(range(9, 15))),
        None,
    ]
    assert [reason for _, _, reason in results][:3] == ["", "smooth", ""] and results[3][2].code == "frames_expired"


def test_vehicles_beyond_the_queue_are_reported_without_a_measurement() -> None:
    blank = np.zeros((1, 1), np.uint8)
    results: list[Any] = []
    recent = [RawPair(k, 0.1 * k, blank, blank, 0.0) for k in range(20)]
    process = Slow({3: None})
    queue = live.MeasurementQueue(None, SpeedConfiguration(), process, lambda *said: results.append(said))  # type: ignore[arg-type]
    for _ in range(DEFAULTS.live.queue + 2):
        queue.submit(seen_at(3), recent)
    process.work()
    queue.publish()
    reasons = [reason for _, _, reason in results]
    assert reasons[: DEFAULTS.live.queue] == ["smooth"] * DEFAULTS.live.queue
    assert [reason.code for reason in reasons[DEFAULTS.live.queue :]] == ["queue_full"] * 2
