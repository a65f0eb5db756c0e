"""Two vehicles abreast in one lane, and what looks like them: painted on an empty road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from test_detection_detector import empty, lane_path

from paceline.detection.abreast import gap_of, separated
from paceline.detection.detector import Detection
from paceline.detection.finder import DuplicateFilter, vehicles_of, without_outline
from paceline.detection.lane_paths import LanePath
from paceline.detection.tracks import DetectionTrack
from paceline.verdicts import NO_REASON

Image = NDArray[np.float32]

NOISE = 1.0  # grey levels, standard deviation
PLACES = 22.0 + 3.0 * np.arange(8)  # m along the lane, farther and farther, in frames 0.2 s apart


@dataclass(frozen=True)
class Surface:
    """An upright rectangle: between ``x`` m across at its ends ``ahead`` (2,) m along the lane from the detection,
    up to ``top`` m. ``grey`` levels above those of the road, with blotches of ``contrast`` grey levels."""

    x: tuple[float, float]
    ahead: tuple[float, float] = (0.0, 0.0)
    top: float = 1.6
    grey: float = -40.0
    contrast: float = 15.0


def painted(lane: LanePath, s: float, surfaces: Sequence[Surface], rng: np.random.Generator) -> tuple[Image, Image]:
    """Both views of ``surfaces`` about ``s`` of a ``lane``, the farthest first."""
    views = [view + 0.0 for view in empty()]
    for number, surface in enumerate(surfaces):
        random = np.random.default_rng(number)
        blotches = cv2.GaussianBlur(random.normal(0.0, 1.0, (80, 80)), (0, 0), 2.0)
        texture = np.float32(surface.grey + surface.contrast * blotches / blotches.std())
        (left, right), (first, last) = surface.x, surface.ahead
        ends = [(first, left, surface.top), (last, right, surface.top), (last, right, 0.0), (first, left, 0.0)]
        corners = lane.rig.project(np.array([lane.point(s + a, x, y) for a, x, y in ends]))
        for view, scene, quad in zip(views, empty(), corners, strict=True):
            H = cv2.getPerspectiveTransform(np.float32([[0, 0], [80, 0], [80, 80], [0, 80]]), np.float32(quad))
            covered = cv2.warpPerspective(np.ones((80, 80), np.float32), H, view.shape[::-1])
            view += covered * (scene + cv2.warpPerspective(texture, H, view.shape[::-1]) - view)
    left_view, right_view = (np.float32(view + rng.normal(0.0, NOISE, view.shape)) for view in views)
    return left_view, right_view


def track_of(surfaces: Sequence[Surface], x: tuple[float, float], lane_offset: float = -1.85) -> DetectionTrack:
    """What the detector makes of ``surfaces``: one face between ``x`` m across."""
    rng, track, lane = np.random.default_rng(4), DetectionTrack(), lane_path(lane_offset)
    scene = tuple(np.rint(view).astype(np.uint8) for view in empty())
    for k, s in enumerate(PLACES.tolist()):
        views = painted(lane, s, surfaces, rng)
        crops = views, (scene[0], scene[1]), np.zeros((2, 2))
        track.add(Detection(k, 0.2 * k, lane, s, x, (0.2, 1.6), 2.0, 9.0, *crops, NOISE))
    return track


CAR = Surface((-1.3, 0.5))


@pytest.mark.parametrize("ahead", [-2.0, 0.0, 2.0])
def test_motorcycle_beside_a_car_is_another_vehicle(ahead: float) -> None:
    """Each on its own plane, where it is; each is new, though they drive alike and a lane's width holds both."""
    motorcycle = Surface((1.0, 1.7), (ahead, ahead), 1.7, -60.0)
    track = track_of(sorted((CAR, motorcycle), key=lambda face: -face.ahead[0]), (-1.5, 1.9))
    car, beside = vehicles_of(track)
    assert len(car.times) == len(beside.times) == len(PLACES)
    for found, true, farther in ((car, CAR.x, 0.0), (beside, motorcycle.x, ahead)):
        assert np.abs(np.array(found.arc_lengths) - PLACES - farther).max() < 1.0
        assert np.median([d.x for d in found.kept], axis=0) == pytest.approx(true, abs=0.12)
    assert not car.same_vehicle(beside) and not beside.same_vehicle(car)
    register = DuplicateFilter()
    assert all(register.is_new(one, without_outline(one, NO_REASON)) for one in (car, beside))


def test_two_that_show_a_gap_too_seldom_are_said_not_to_be_told_apart() -> None:
    """In two detections of eight, as where one of them is hidden for most of the time."""
    motorcycle = Surface((1.0, 1.7), (0.0, 0.0), 1.7, -60.0)
    both, alone = (track_of(surfaces, (-1.5, 1.9)) for surfaces in ([CAR, motorcycle], [CAR]))
    track = DetectionTrack()
    for k, (together, single) in enumerate(zip(both.kept, alone.kept, strict=True)):
        track.add(together if k < 2 else single)
    assert vehicles_of(track) == [track] and track.may_be_two
    assert [notice.code for notice in without_outline(track, NO_REASON).notices] == ["vehicles_not_told_apart"]
    assert vehicles_of(alone) == [alone] and without_outline(alone, NO_REASON).notices == ()


def test_a_face_with_a_strip_as_grey_as_the_road_is_one_vehicle() -> None:
    """Both sides together are no wider than one."""
    sides = Surface((-1.2, -0.3)), Surface((0.0, 1.2))
    track = track_of(sides, (-1.4, 1.4))
    assert all(gap_of(d) is not None for d in track.kept)
    assert separated(track) == [track]


def test_the_side_of_a_bus_is_not_a_vehicle_beside_it() -> None:
    """Seen at an angle, it lies beside the rear on its plane, here behind a corner as grey as the road."""
    side = Surface((1.25, 1.25), (12.0, 1.5))
    rear = Surface((-1.25, 1.2))
    track = track_of((side, rear), (-1.4, 2.6), -7.0)
    assert sum(gap_of(d) is not None for d in track.kept) >= 4
    assert separated(track) == [track]


def test_a_vehicle_as_grey_as_the_road_shows_no_gap() -> None:
    pieces = [Surface((x, x + 0.45)) for x in (-1.7, -1.0, -0.3, 0.4, 1.1)]
    track = track_of(pieces, (-1.8, 1.8))
    assert all(gap_of(d) is None for d in track.kept)
    assert separated(track) == [track]


def test_a_car_alone_is_one_vehicle() -> None:
    track = track_of([CAR], (-1.5, 0.7))
    assert vehicles_of(track) == [track]
