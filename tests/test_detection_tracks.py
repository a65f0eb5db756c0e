"""Tracks of vehicles over time: motions, association, duplicates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_detection_detector import detection, driven, outlined

from paceline.detection.finder import (
    DuplicateFilter,
    continued_by,
    is_vehicle,
    may_be_vehicle,
    outline,
    without_outline,
)
from paceline.detection.planar_face import with_visible_face
from paceline.detection.tracks import DetectionTrack, TrackAssociator, motion_residuals


@pytest.fixture(autouse=True, scope="module")
def drawn() -> None:
    """The background of all detections takes longer at first than Hypothesis allows."""
    detection(0.0, 5.0)


@given(st.integers(0, 2**16), st.floats(8, 35), st.floats(-4, 4), st.integers(6, 30))
def test_vehicle_is_steadier_than_two_swaying_objects(seed: int, v: float, a: float, n: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.sort(rng.choice(40, n, replace=False)) / 10
    driving = driven(times, 5.0 + v * times + 0.5 * a * times**2)
    assert driving.motion.unsteadiness < 1e-6
    change = rng.integers(1, n)
    swaying = driven(times, np.where(np.arange(n) < change, 29.0, 29.0 + v))
    assert swaying.motion.unsteadiness > 1e3


def test_two_bushes_in_the_wind_are_no_vehicle() -> None:
    """One is seen ten times and then another one eight metres on, each off by half a metre; a vehicle as far off."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        times, off = np.arange(16) / 10, rng.normal(0, 0.5, 16)
        assert not is_vehicle(driven(times, np.where(times < 1.0, 29.0, 37.0) + off))
        assert is_vehicle(driven(times, 29.0 + 8.0 * times + off))


@pytest.mark.parametrize(("metres", "off"), [(6.0, 0.2), (8.0, 0.25)])
def test_short_but_smooth_track_is_a_vehicle(metres: float, off: float) -> None:
    """In a second and a half, each place ``off`` by so many pixels of disparity: two places fit almost as well."""
    rng, t, found = np.random.default_rng(5), np.arange(16) / 10, 0
    pixel = driven(t[:3], 29.0 + t[:3]).kept[1].distance_error(0.0, 1.0)
    for _ in range(50):
        track = driven(t, 29.0 + metres / t[-1] * t + rng.normal(0, off * pixel, len(t)))
        assert track.motion.roughness_px == pytest.approx(off, abs=0.15)
        assert track.motion.unsteadiness < 1.1
        found += is_vehicle(track)
    assert found > 40


@given(st.integers(0, 2**16), st.floats(-30, 30), st.integers(6, 30), st.booleans())
def test_motion_fits_most_positions(seed: int, speed: float, n: int, brakes: bool) -> None:
    """One in four far off, at either end too, moves nothing by more than the others are off."""
    rng = np.random.default_rng(seed)
    times, wrong = 7.0 + np.arange(n) / 10, np.zeros(n, bool)
    wrong[rng.choice([0, n // 2, n - 1], max(n // 8, 1), replace=n > 24)] = True
    s = 3.0 + speed * times - 0.5 * (2.0 if brakes else 0.0) * (times - 7.0) ** 2 + 12.0 * wrong
    off = motion_residuals(times, s, np.full(n, 2.0))
    assert np.abs(off[~wrong]).max() < 0.5
    assert np.abs(off[wrong]).min() > 4.0


def test_positions_are_weighted_by_their_errors() -> None:
    times, error = np.arange(9) / 5, np.where(np.arange(9) < 5, 15.0, 1.0)
    s = 4 + 20 * times + np.where(error > 1, 7.5, 0.0)  # far off half an error, near by none
    off = motion_residuals(times, s, error)
    assert np.abs(off[5:]).max() < 0.3
    np.testing.assert_allclose(motion_residuals(times[:2], s[:2], error[:2]), 0.0, atol=1e-6)


def test_each_vehicle_is_reported_once() -> None:
    """The left and the right lamp of one, followed one after the other, and a second vehicle 10 m behind it."""
    times = np.arange(10) / 10
    left, right = driven(times, 4 + 15 * times, (-0.9, -0.5)), driven(times + 1.2, 22 + 15 * times, (0.5, 0.9))
    behind, later = driven(times + 0.5, 1.5 + 15 * times, (-0.9, 0.9)), driven(times + 9.0, 4 + 15 * times)
    meeting = driven(times, 17.5 - 15 * times)  # at the same place at 0.45 s, in the other sense
    register = DuplicateFilter()
    assert register.is_new(left, replace(without_outline(left, ""), vehicle=outlined(2)))
    assert not register.is_new(right, replace(without_outline(right, ""), vehicle=outlined(13)))
    assert not register.is_new(right, without_outline(right, "too small"))
    for other in (behind, later, meeting):
        assert register.is_new(other, replace(without_outline(other, ""), vehicle=outlined(other.first.frame)))


@pytest.mark.parametrize(
    ("apart", "wide", "one"), [(2.8, 3.0, True), (2.8, 1.8, False), (3.25, 2.9, False), (3.5, 6.4, False)]
)
def test_what_overlaps_is_one_vehicle_and_what_lies_apart_are_two(apart: float, wide: float, one: bool) -> None:
    """A lorry seen with the bush beside it, and then with the one on its other side; two cars, or lorries, abreast."""
    times = np.arange(10) / 10
    left, right = (driven(times, 4 + 15 * times, (x - wide / 2, x + wide / 2)) for x in (-apart / 2, apart / 2))
    assert left.same_vehicle(right) == right.same_vehicle(left) == one


def test_what_begins_far_behind_where_a_vehicle_was_lost_is_another_one() -> None:
    """Far away their places are so uncertain that one slow motion would fit both; each drives faster than that."""
    times = np.arange(7) / 5
    lost, next_one = driven(times, 4 + 13 * times), driven(times + 2.2, 6 + 13 * times)
    continuation = driven(times + 2.2, 4 + 13 * (times + 2.2))
    for track in (lost, next_one, continuation):
        track.pixels = [7.0 / 1.5] * len(times)
    assert not lost.same_vehicle(next_one) and not next_one.same_vehicle(lost)
    assert lost.same_vehicle(continuation) and continuation.same_vehicle(lost)


def test_vehicle_that_is_followed_by_a_longer_track_has_not_passed() -> None:
    """Its halo was lost after five frames; the vehicle is in view. Neither is another one a reason to wait."""
    times = np.arange(12) / 10
    halo, lamps = driven(times[:5], 5.5 + 15 * times[:5]), driven(times, 4 + 15 * times)
    assert continued_by(halo, lamps) and not continued_by(lamps, halo)
    assert not continued_by(halo, driven(times, 20 + 15 * times))
    assert not continued_by(halo, driven(times[:5], 5.5 + 15 * times[:5]))


ENOUGH_OF_IT, TOO_LITTLE = [(0.36, 4), (0.26, 8), (0.18, 16)], [(0.36, 3), (0.26, 6), (0.17, 16), (0.17, 40)]


@pytest.mark.parametrize(("area", "count"), ENOUGH_OF_IT + TOO_LITTLE)
def test_small_face_needs_many_detections(area: float, count: int) -> None:
    times = np.arange(count) / 10
    track = driven(times, 4 + 25 * times)
    track.areas = [area] * count
    assert is_vehicle(track) == ((area, count) in ENOUGH_OF_IT)


def test_track_is_upright_by_its_median() -> None:
    """Two shadows one behind the other, as they were seen, and a van in rain; the most that a shadow had, and the least
    of a vehicle at night."""
    times = np.arange(5) / 10
    track = driven(times, 4 + 25 * times)
    seen = ([14.2, 1.7, 2.7, 1.7, 1.5], False), ([1.5, 4.4, 6.0, 2.6, 5.7], True), ([2.0] * 5, False), ([2.9] * 5, True)
    for upright, vehicle in seen:
        track.upright_ratios = upright
        assert is_vehicle(track) == vehicle


@pytest.mark.parametrize(("upright", "vehicle"), [(3.0, False), (8.0, False), (20.0, True)])
def test_low_track_is_a_shadow_unless_clearly_upright(upright: float, vehicle: bool) -> None:
    """At night a row of lamps is all that shows of a car: 34 times, 45 times better than if it lay on the road."""
    times, track = np.arange(10) / 10, DetectionTrack()
    for t in times.tolist():
        track.add(replace(detection(t, 4 + 15 * t), y=(0.2, 0.6)))
    track.upright_ratios = [upright] * 10
    assert is_vehicle(track) == vehicle


@pytest.mark.parametrize(("middles", "vehicle"), [((1.5, 2.6), True), ((-3.6, 0.0), True), ((2.3, 2.3), False)])
def test_vehicle_may_change_lanes(middles: tuple[float, float], vehicle: bool) -> None:
    """As a motorcycle was seen that left its lane; what stays two metres aside drives elsewhere."""
    times, track = np.arange(11) / 15, DetectionTrack()
    for t, middle in zip(times.tolist(), np.linspace(*middles, 11).tolist(), strict=True):
        track.add(replace(detection(t, 4 + 22 * t), x=(middle - 0.6, middle + 0.6)))
    assert is_vehicle(track) == vehicle


@pytest.mark.parametrize(("shown", "vehicle"), [(0, False), (1, False), (2, True), (10, True)])
def test_track_above_the_road_is_no_vehicle(shown: int, vehicle: bool) -> None:
    """A skyline, or the roof of a van that is hidden by the car before it, until its face comes into view."""
    times, track = np.arange(10) / 10, DetectionTrack()
    for k, t in enumerate(times.tolist()):
        at = detection(t, 4 + 15 * t)
        track.add(at if k >= 10 - shown else replace(at, y=(1.9, 2.5)))
    assert is_vehicle(track) == vehicle
    assert len(with_visible_face(track)) == shown


def test_passing_vehicle_is_not_associated_with_a_bush() -> None:
    """Both look alike, and both may be where something is seen; nor is the bush what is seen far ahead."""
    associator = TrackAssociator()
    for time in np.arange(6) / 5:
        associator.associate(float(time), [detection(float(time), 5 + 12 * float(time)), detection(float(time), 20.0)])
    vehicle, bush = associator.tracks
    assert vehicle.is_moving and not bush.is_moving
    associator.associate(1.2, [detection(1.2, 5 + 12 * 1.2)])
    assert vehicle.last is not None and vehicle.last.time == 1.2 and bush.frames_unseen == 1
    assert not driven(np.arange(3) / 10, np.full(3, 20.0)).in_gate(detection(0.9, 70.0))


def test_vehicle_without_outline_is_no_duplicate() -> None:
    times = np.arange(10) / 10
    track, register = driven(times, 4 + 15 * times), DuplicateFilter()
    assert register.is_new(track, without_outline(track, "too small"))
    assert register.is_new(track, replace(without_outline(track, ""), vehicle=outlined(2)))


def standing(times: NDArray[np.float64], drives_off: bool = False) -> NDArray[np.float64]:
    """Places of what drives up for 3 s and then stands 29 m along the lane, for 9 s or, if it ``drives_off``, for 6."""
    braking = 29.0 - 1.5 * np.maximum(3.0 - times, 0.0) ** 2
    return braking + drives_off * 1.2 * np.maximum(times - 9.0, 0.0) ** 2


@pytest.mark.parametrize("drives_off", [False, True])
def test_a_vehicle_that_stands_for_most_of_the_time_is_one(drives_off: bool) -> None:
    """Its places are told by the time in which it drives, which is all that is kept of it."""
    times, rng = np.arange(120) / 10, np.random.default_rng(2)
    s = standing(times, drives_off) + rng.normal(0.0, 0.1, len(times))
    track = driven(times, s)
    assert is_vehicle(track) and track.motion.stands() and track.motion.drives()
    assert all(d.time < 4.5 or d.time > 9.0 for d in track.kept)
    assert is_vehicle(driven(times, s[::-1]))  # as one that stood first


def test_what_may_be_a_shadow_is_listed_as_such() -> None:
    times = np.arange(12) / 5
    track = driven(times, 5.0 + 12.0 * times)
    track.upright_ratios = [1.6] * len(times)
    assert may_be_vehicle(track) and not is_vehicle(track)
    assert outline(track).reason.code == "may_be_shadow" and outline(track).vehicle is None


def test_what_only_sways_between_stands_is_no_vehicle() -> None:
    times, rng = np.arange(120) / 10, np.random.default_rng(3)
    for jump in (3.0, 9.0):
        s = np.where(times < 6.0, 29.0, 29.0 + jump) + rng.normal(0.0, 0.1, len(times))
        assert not is_vehicle(driven(times, s))


def test_a_vehicle_that_stood_until_it_was_background_is_the_one_that_drives_off() -> None:
    times = np.arange(40) / 10
    came, left, beside = driven(times, standing(times)), driven(times + 60, 29 + 1.2 * times**2), (1.8, 3.4)
    assert came.same_vehicle(left) and left.same_vehicle(came)
    assert not came.same_vehicle(driven(times + 60, 15 + 1.2 * times**2))  # the one behind it
    assert not came.same_vehicle(driven(times + 60, 29 + 8.0 * times))  # that would have driven through it
    assert not came.same_vehicle(driven(times + 60, 29 + 1.2 * times**2, beside))
