"""What a recording tells of its cameras: their rotations, the time between the views, the rig."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from selection import slow_after

from paceline.cameras import Camera, Quantity, RigUncertainty, StereoRig, perturbed_rig
from paceline.documents.assumed_calibration import with_assumed_uncertainty
from paceline.documents.loading import EXACTLY_ZERO, VehicleDocument, load_clip
from paceline.errors import UnusableInput
from paceline.geometry import epipolar_distance
from paceline.imaging import outline_motion, recorded_cameras
from paceline.imaging.camera_rotation import (
    CameraRotations,
    ReferenceView,
    expected_rotations,
    exposure_change,
    fit_rotation,
    rotation_jacobian,
)
from paceline.imaging.epipolar_fit import EpipolarFit, fit_epipolar_residuals, velocity_across
from paceline.imaging.feature_matches import NO_MATCHES, InstantFeatures, Matches, match_static, velocity_and_growth
from paceline.imaging.moving_features import moving_features
from paceline.imaging.outline_motion import match_template, place_between_views
from paceline.imaging.recorded_cameras import CLOCK_RATE_STD, expected_rate
from paceline.recordings.live_stereo import LiveStereo
from paceline.recordings.stereo import open_recording
from paceline.simulation.stereo.clip import render, write
from paceline.simulation.stereo.scene import Scene, Vehicle
from paceline.speed.geometry.initial_plane import plane_from_outlines
from paceline.speed.measurement import measure_clip
from paceline.speed.refinement.keyframes import Keyframe, exposures

UNKNOWN_OFFSET = Quantity(0.0, 0.1, "assumed")
ROTATION = st.tuples(*[st.floats(-2e-3, 2e-3)] * 3).map(np.array)
CAMERA = Camera((1024, 768), np.array([[2200.0, 0, 511.5], [0, 2210, 383.5], [0, 0, 1]]))
LENS = replace(CAMERA, distortion=np.array([-0.2, 0.05, 0.001, -0.0005]))


def random_pixels(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform([0, 0], CAMERA.image_size, (count, 2))


def turned_by_opencv(pixels, rotation):
    return CAMERA.project(CAMERA.rays(pixels) @ cv2.Rodrigues(rotation)[0].T)


# --- rotations ------------------------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(ROTATION)
def test_a_turned_camera_sees_points_where_rodrigues_formula_says(rotation):
    pixels = random_pixels(5)
    np.testing.assert_allclose(CAMERA.turned(pixels, rotation), turned_by_opencv(pixels, rotation), atol=1e-8)
    np.testing.assert_allclose(CAMERA.turned(CAMERA.turned(pixels, rotation), -rotation), pixels, atol=1e-8)


def test_the_jacobian_is_the_difference_of_small_rotations():
    pixels, step = random_pixels(6), 1e-6
    expected = [
        (CAMERA.turned(pixels, step * axis) - CAMERA.turned(pixels, -step * axis)) / (2 * step) for axis in np.eye(3)
    ]
    np.testing.assert_allclose(rotation_jacobian(CAMERA, pixels), np.moveaxis(expected, 0, -1), rtol=1e-6, atol=1e-3)


@settings(max_examples=10)
@given(ROTATION, st.integers(0, 100))
def test_a_rotation_is_found_among_points_of_vehicles_within_its_uncertainty(rotation, seed):
    rng, before = np.random.default_rng(seed), random_pixels(120, seed)
    after = turned_by_opencv(before, rotation) + rng.normal(0, 0.05, before.shape)
    after[:40] += [12.0, 3.0]  # a third of them moves by itself
    vector, covariance, weights = fit_rotation(CAMERA, before, after)
    error = vector - rotation
    assert error @ np.linalg.solve(covariance, error) < 21.1  # 1 in 10,000 of χ² with three degrees of freedom
    assert (weights[:40] == 0).all() and (weights[40:] > 0).mean() > 0.95


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_pictures_of_a_turned_camera_are_turned_back(camera):
    rng = np.random.default_rng(4)
    still = cv2.GaussianBlur(rng.uniform(0, 255, (768, 1024)).astype(np.float32), (0, 0), 3)
    still = 128 + 8 * (still - still.mean())
    rotation = np.array([4e-4, -7e-4, 1e-3])
    y, x = np.mgrid[:768, :1024].astype(np.float32)
    # what the camera's picture shows at a pixel: the ideal one there, turned back, on the still picture
    ideal = camera.undistort_points(np.stack([x, y], -1))
    source = camera.turned(ideal, -rotation).astype(np.float32)
    seen = cv2.remap(still, source[..., 0], source[..., 1], cv2.INTER_LANCZOS4)
    back = camera.undistort_image(seen, rotation=rotation)
    inside = slice(120, -120), slice(160, -160)
    assert np.abs(back[inside] - still[inside]).mean() < 0.03 * still.std()
    assert np.abs(seen[inside] - still[inside]).mean() > 0.2 * still.std()
    if camera is CAMERA:
        vector, covariance, share = ReferenceView(camera, still).rotation_in(seen)
        assert share > 0.8
        np.testing.assert_allclose(vector, rotation, atol=4 * np.sqrt(np.diag(covariance)).max())


@pytest.mark.parametrize("brighter", [0.94, 1.06])
def test_a_change_of_exposure_is_no_rotation(brighter):
    """Between a bright sky and a dark ground, whose edges darken all in one direction."""
    rng = np.random.default_rng(4)
    still = cv2.GaussianBlur(rng.uniform(-1, 1, (768, 1024)).astype(np.float32), (0, 0), 3)
    still = 150 + 30 * still / still.std() - 40 * np.linspace(0, 1, 1024, dtype=np.float32)
    vector = ReferenceView(CAMERA, still).rotation_in(brighter * still + 2.0)[0]
    assert np.abs(vector[:2] * CAMERA.K[0, 0]).max() < 0.003  # px


@given(st.floats(0.8, 1.25), st.floats(-10, 10), st.integers(0, 100))
def test_a_change_of_exposure_is_found_beside_what_moves(gain, level, seed):
    rng = np.random.default_rng(seed)
    before = rng.uniform(20, 200, 3000)
    after = gain * before + level + rng.normal(0, 1.0, 3000)
    after[:600] = rng.uniform(0, 255, 600)
    found = exposure_change(before, after)
    assert found == (pytest.approx(gain, abs=0.005), pytest.approx(level, abs=0.5))


@pytest.mark.parametrize("level", [0.0, 255.0])
def test_a_picture_that_shows_nothing_tells_no_rotation(level):
    still = cv2.GaussianBlur(np.random.default_rng(4).uniform(0, 255, (768, 1024)).astype(np.float32), (0, 0), 3)
    assert ReferenceView(CAMERA, still).rotation_in(np.full_like(still, level))[2] == 0.0


def rotations_of(vectors: np.ndarray, std: float) -> CameraRotations:
    covariance = np.broadcast_to(std**2 * np.eye(3), (*vectors.shape, 3))
    return CameraRotations(vectors, covariance, np.ones(vectors.shape[:2]))


def test_noise_alone_is_no_rotation_and_sway_is_hardly_shrunk():
    rng, std = np.random.default_rng(2), 5e-6
    noise = rng.normal(0, std, (30, 2, 3))
    assert (expected_rotations(rotations_of(noise, std)) == 0).all()
    sway = rng.normal(0, 20 * std, (30, 2, 3))
    np.testing.assert_allclose(expected_rotations(rotations_of(sway, std)), sway, rtol=0.02)
    unknown = rotations_of(sway, std)
    unknown.static_share[3] = 0.0
    covariance = unknown.covariance.copy()
    covariance[3] = np.eye(3)
    expected = expected_rotations(replace(unknown, covariance=covariance))
    np.testing.assert_allclose(expected[4:], sway[4:], rtol=0.02)
    assert np.abs(expected[3]).max() < 1e-3 * np.abs(sway[3]).max()


def test_frames_that_show_no_rotation_do_not_hide_that_of_the_others():
    rng, std = np.random.default_rng(4), 5e-6
    sway = rotations_of(rng.normal(0, 20 * std, (30, 2, 3)), std)
    sway.static_share[[3, 7], 1] = 0.0, 0.3
    sway.vectors[3, 1] = 0.0
    sway.vectors[7, 1] = 1.0  # of the corners on a lorry
    covariance = sway.covariance.copy()
    covariance[3, 1] = np.eye(3)
    expected = expected_rotations(replace(sway, covariance=covariance))
    assert (expected[[3, 7], 1] == 0).all()
    np.testing.assert_allclose(expected[:3], sway.vectors[:3], rtol=0.02)


# --- epipolar residuals ---------------------------------------------------------------------------------------------


def moving_points(
    rig: StereoRig, offset: float, readouts=(0.0, 0.0), count: int = 200, seed: int = 3, rate: float = 0.0
):
    """Matches of points that move at their own velocities within two minutes, the right ones seen ``offset`` s later,
    which grows by the ``rate``, and of static ones."""
    rng = np.random.default_rng(seed)
    P = rng.uniform([-4, -2, 20], [4, 2, 70], (count, 3))
    V = np.where(np.arange(count)[:, None] < count // 2, rng.uniform([-3, -1, -20], [3, 1, -8], (count, 3)), 0.0)
    below = [(p[:, 1] + 0.5) / 768 - 0.5 for p in rig.project(P)]
    seen = np.random.default_rng([seed, 1]).uniform(-60.0, 60.0, count)
    times = readouts[0] * below[0], offset + rate * seen + readouts[1] * below[1]
    left = rig.left.project(P + times[0][:, None] * V)
    right = rig.right.project(rig.to_right(P + times[1][:, None] * V))
    velocity = (rig.left.project(P + 1e-4 * V) - rig.left.project(P - 1e-4 * V)) / 2e-4
    noise = rng.normal(0, 0.05, right.shape)
    matches = Matches(left, right + noise, velocity, -V[:, 2] / (P[:, 2] + times[0] * V[:, 2]), seen)
    is_moving = np.arange(count) < count // 2
    return tuple(
        Matches(*(getattr(matches, field.name)[mask] for field in fields(Matches))) for mask in (~is_moving, is_moving)
    )


def test_the_velocity_across_the_epipolar_lines_is_that_in_the_right_view(rig):
    rng = np.random.default_rng(5)
    P, V, dt = rng.uniform([-3, -2, 20], [3, 2, 60], (9, 3)), rng.normal(0, 10, (9, 3)), 1e-5
    left, right = rig.project(P)
    velocity = (rig.left.project(P + dt * V) - left) / dt
    later = rig.project(P + dt * V)[1]
    np.testing.assert_allclose(
        velocity_across(rig, left, right, velocity), epipolar_distance(rig, left, later) / dt, rtol=1e-3, atol=0.05
    )


@pytest.mark.parametrize("offset", [-0.004, 0.0, 0.0083, 0.07])
@pytest.mark.parametrize("readouts", [(0.0, 0.0), (0.02, 0.02), (0.0, 0.01)])
def test_the_offset_is_found_within_its_uncertainty(rig, offset, readouts):
    fit = fit_epipolar_residuals(rig, *moving_points(rig, offset, readouts), UNKNOWN_OFFSET, 0.017)
    assert abs(fit.offset.value - offset) < 4 * fit.offset.std
    assert fit.offset.std < 0.003
    assert fit.rig is rig  # it is exact


@pytest.mark.parametrize("rate", [0.0, 40e-6, -100e-6])
def test_the_rate_by_which_the_offset_grows_is_found_within_its_uncertainty(rig, rate):
    fit = fit_epipolar_residuals(rig, *moving_points(rig, 0.004, rate=rate), UNKNOWN_OFFSET, 0.017, CLOCK_RATE_STD)
    assert abs(fit.offset.value - 0.004) < 4 * fit.offset.std
    assert abs(fit.rate.value - rate) < 3 * fit.rate.std and fit.rate.std < 3e-5
    stated = fit_epipolar_residuals(rig, *moving_points(rig, 0.004), UNKNOWN_OFFSET, 0.017)
    assert abs(stated.rate.value) < 1e-7 and stated.rate.std <= 1e-9


def test_one_clock_is_as_likely_as_two():
    assert expected_rate(None) == Quantity(0.0, CLOCK_RATE_STD, "assumed")
    assert expected_rate(Quantity(9e-6, 0.9 * CLOCK_RATE_STD, "estimated")) == expected_rate(None)
    small, large = (expected_rate(Quantity(value, 1e-6, "estimated")) for value in (1e-6, 40e-6))
    assert small.value < 0.1e-6 and small.std > 1e-6  # by half of all cases in which it is 0
    assert large.value == pytest.approx(40e-6) and large.std == pytest.approx(1e-6)
    assert expected_rate(Quantity(0.01, 1e-6, "estimated")).value == pytest.approx(0.01)


def test_points_are_moved_on_by_constant_velocities_in_space(rig):
    rng, dt = np.random.default_rng(8), 0.1
    P, V = rng.uniform([-4, -2, 20], [4, 2, 70], (50, 3)), rng.uniform([-3, -1, -20], [3, 1, 20], (50, 3))
    before, left, after = (rig.left.project(P + t * V) for t in (-dt, 0.0, dt))
    motion = velocity_and_growth(left - before, after - left, dt)
    later = Matches(left, left, *motion, np.zeros(50)).later(0.04)
    np.testing.assert_allclose(later.left, rig.left.project(P + 0.04 * V), atol=1e-9)
    np.testing.assert_allclose(later.growth, -V[:, 2] / (P + 0.04 * V)[:, 2], atol=1e-9)
    velocity = (rig.left.project(P + 0.0401 * V) - rig.left.project(P + 0.0399 * V)) / 2e-4
    np.testing.assert_allclose(later.velocity, velocity, rtol=1e-4)


@pytest.mark.parametrize("skew", [-0.05, 0.033])
def test_how_a_vehicle_moves_between_the_exposures_follows_from_its_left_outline(rig, skew):
    outline = np.array([[-0.9, -0.5, 30.0], [0.9, -0.5, 30.0], [0.9, 0.5, 30.0], [-0.9, 0.5, 30.0]])
    velocity = np.array([6.0, 0.4, -14.0])
    left, right = rig.left.project(outline), rig.project(outline + skew * velocity)[1]
    moved = outline_motion.displacement_between_exposures(rig, left, right, skew, velocity / 30.0)
    np.testing.assert_allclose(moved, skew * velocity, rtol=3e-3)
    vehicle = VehicleDocument("v0", None, 0, left, right, "free", None, moved)
    plane = plane_from_outlines(rig, vehicle, None, 0.5)
    np.testing.assert_allclose(plane.centre, outline.mean(0), rtol=3e-3, atol=1e-3)


def test_more_matches_of_the_same_places_do_not_tell_more_of_the_rig(rig):
    """What no model of the lens describes errs alike in all of them."""
    uncertain = replace(rig, uncertainty=RigUncertainty(2.0, 0.5, (2e-4, 5e-5, 5e-4), (2e-4, 2e-4, 2e-4)))
    static, moving = moving_points(rig, 0.0, count=1500)
    repeated = Matches(*(np.repeat(getattr(static, field.name), 8, axis=0) for field in fields(Matches)))
    once, often = (
        fit_epipolar_residuals(uncertain, matches, moving, UNKNOWN_OFFSET, 0.017).rig.uncertainty
        for matches in (static, repeated)
    )
    remaining = [np.sqrt(np.trace(u.covariance[8:11, 8:11])) for u in (once, often)]
    assert remaining[1] > 0.9 * remaining[0]


def test_where_little_moves_the_offset_is_unknown(rig):
    static, moving = moving_points(rig, 0.01)
    few = Matches(*(getattr(moving, field.name)[:5] for field in fields(Matches)))
    assert fit_epipolar_residuals(rig, static, few, UNKNOWN_OFFSET, 0.017).offset is None
    fit = fit_epipolar_residuals(rig, NO_MATCHES, NO_MATCHES, UNKNOWN_OFFSET, 0.017)
    assert fit.offset is None and fit.epipolar_px is None
    uncertain = replace(rig, uncertainty=RigUncertainty(2.0, 0.5, (2e-4, 5e-5, 5e-4), (2e-4, 2e-4, 2e-4)))
    fit = fit_epipolar_residuals(uncertain, NO_MATCHES, NO_MATCHES, UNKNOWN_OFFSET, 0.017)
    assert fit.offset is None and fit.rig_shift_sigma == 0.0


@pytest.mark.parametrize("slope", [0.0, 1e-5])
def test_what_moves_along_the_epipolar_lines_leaves_the_offset_unknown(slope):
    rig = StereoRig(CAMERA, CAMERA, np.eye(3), np.array([-0.5, 0, 0]))
    P, V = np.random.default_rng(6).uniform([-4, -2, 20], [4, 2, 70], (100, 3)), np.array([15.0, 15.0 * slope, 0.0])
    left, right = rig.project(P)
    velocity = (rig.left.project(P + 1e-4 * V) - left) / 1e-4
    right += np.random.default_rng(7).normal(0, 0.05, right.shape)
    moving = Matches(left, right, velocity, np.zeros(100), np.zeros(100))
    fit = fit_epipolar_residuals(rig, NO_MATCHES, moving, UNKNOWN_OFFSET, 0.017)
    assert abs(fit.offset.value) < 0.01 and fit.offset.std == pytest.approx(0.1, rel=0.01)


def test_static_points_correct_what_shows_of_a_wrong_calibration(rig):
    uncertain = replace(rig, uncertainty=RigUncertainty(2.0, 0.5, (2e-4, 5e-5, 5e-4), (2e-4, 2e-4, 2e-4)))
    static, moving = moving_points(rig, 0.004)
    move = np.zeros(14)
    move[8], move[10] = 3e-4, -6e-4  # about the horizontal axis, and rolled
    wrong = replace(perturbed_rig(uncertain, move), uncertainty=uncertain.uncertainty)
    fit = fit_epipolar_residuals(wrong, static, moving, UNKNOWN_OFFSET, 0.017)
    before = np.abs(epipolar_distance(wrong, static.left, static.right))
    after = np.abs(epipolar_distance(fit.rig, static.left, static.right))
    assert np.median(before) > 0.3 and np.median(after) < 0.08
    assert fit.epipolar_px.value == pytest.approx(np.sqrt((before**2).mean()), rel=0.15)
    assert residual_std(fit.rig, static) < 0.25 * residual_std(wrong, static)
    assert fit.rig.uncertainty.covariance[9, 9] == pytest.approx((5e-5) ** 2, rel=0.2)  # a turn along the baseline
    assert abs(fit.offset.value - 0.004) < 4 * fit.offset.std


@pytest.mark.parametrize("sigma", [0.0, 10.0])
def test_what_does_not_show_is_as_uncertain_as_what_shows_is_wrong(rig, sigma):
    """The scale is that of Student's distribution, for a shift in one of the directions that show."""
    stated = RigUncertainty(0.5, 0.1, (1e-4, 5e-5, 2e-4), (2e-4, 2e-4, 2e-4))
    move = np.zeros(14)
    move[8] = sigma * 1e-4
    wrong = replace(perturbed_rig(rig, move), uncertainty=stated)
    fit = fit_epipolar_residuals(wrong, *moving_points(rig, 0.0), UNKNOWN_OFFSET, 0.017)
    scale = float(np.sqrt(fit.rig.uncertainty.covariance[9, 9])) / 5e-5  # a turn along the baseline
    seen = 1.0 if sigma else 0.0
    assert scale == pytest.approx(max(1.0, np.sqrt((4.0 + seen * fit.rig_shift_sigma**2) / (4.0 + 2.5))), rel=0.25)
    assert abs(fit.offset.value) < 4 * fit.offset.std


def test_what_a_lens_leaves_of_its_distortion_is_not_taken_for_a_turn(rig):
    uncertain = replace(rig, uncertainty=RigUncertainty(2.0, 0.5, (2e-4, 5e-5, 5e-4), (2e-4, 2e-4, 2e-4)))
    static, moving = moving_points(uncertain, 0.004)
    x, y = (2 * static.left / np.array([1024, 768]) - 1).T
    curved = replace(static, right=static.right + np.column_stack([0 * x, 0.2 * x * y * (1 - x**2)]))
    fit = fit_epipolar_residuals(uncertain, curved, moving, UNKNOWN_OFFSET, 0.017)
    assert fit.rig_shift_sigma < 1.0
    assert abs(fit.offset.value - 0.004) < 4 * fit.offset.std


def test_a_keystone_may_be_the_lenses_or_a_turn(rig):
    """As both explain it, the disparity that a turn would change is uncertain by as much."""
    stated = RigUncertainty(2.0, 2.0, (2e-4, 3e-4, 5e-4), (2e-4, 2e-4, 2e-4))
    uncertain, apart = replace(rig, uncertainty=stated), np.array([[0.0, 0.0, 40.0]])
    static, moving = moving_points(uncertain, 0.004, count=1000)
    x, y = (2 * static.left / np.array([1024, 768]) - 1).T
    wrong = replace(static, right=static.right + np.column_stack([0 * x, 1.5 * x * y]))

    def disparity(of: StereoRig) -> float:
        left, right = of.project(apart)
        return float(left[0, 0] - right[0, 0])

    fit = fit_epipolar_residuals(uncertain, wrong, moving, UNKNOWN_OFFSET, 0.017)
    found = disparity(fit.rig)
    changes = [disparity(perturbed_rig(fit.rig, change)) - found for change in fit.rig.uncertainty.covariance_root]
    assert abs(found - disparity(rig)) < 2.0 * np.linalg.norm(changes)


def residual_std(rig: StereoRig, matches: Matches) -> float:
    """RMS standard deviation (px) of the epipolar residuals by what is uncertain of the calibration."""
    at = epipolar_distance(rig, matches.left, matches.right)
    changes = [
        epipolar_distance(perturbed_rig(rig, change), matches.left, matches.right) - at
        for change in rig.uncertainty.covariance_root
    ]
    return float(np.sqrt((np.array(changes) ** 2).sum(0).mean()))


@given(st.floats(-0.05, 0.05), st.floats(1e-4, 5e-3))
def test_the_expected_offset_lies_between_none_and_the_estimate(value, std):
    expected = recorded_cameras.expected_offset(Quantity(value, std, "estimated"), 0.2)
    assert min(0.0, value) <= expected.value <= max(0.0, value)
    assert expected.std >= std and abs(value - expected.value) <= expected.std + 1e-12
    if abs(value) > 6 * std:
        assert expected.value == pytest.approx(value, rel=1e-2)


def test_where_nothing_tells_the_offset_may_be_half_an_interval():
    assert recorded_cameras.expected_offset(None, 0.2) == Quantity(0.0, 0.1, "assumed")


# --- exposures of the rows ------------------------------------------------------------------------------------------


def test_each_row_has_its_time():
    quads = np.array([[[100.0, y], [200, y], [200, y + 40], [100, y + 40]] for y in (80.0, 600.0)])
    keyframes = [
        Keyframe(k, (0.2 * k, 0.2 * k + 0.01), (np.zeros((1, 1)),) * 2, np.zeros((2, 2)), quads[[k, k]]) for k in (0, 1)
    ]
    left = replace(CAMERA, readout=Quantity(0.02))
    right = replace(CAMERA, readout=Quantity(0.0, 0.012, "assumed"))
    rig = StereoRig(left, right, np.eye(3), np.array([-0.5, 0, 0]))
    times, timing, readouts = exposures(keyframes, rig, Quantity(0.01, 0.002, "estimated"))
    rows = (np.array([100.0, 620.0]) + 0.5) / 768 - 0.5
    np.testing.assert_allclose(times, np.column_stack([[0.0, 0.2] + 0.02 * rows, [0.01, 0.21]]))
    assert timing.stds == {"offset": 0.002, "right readout": 0.012}
    np.testing.assert_allclose(timing.shift(np.array([1.0, 0.5])), np.outer(0.002 + 0.006 * rows, [0, 1]))
    np.testing.assert_allclose(readouts, [0.02, 0.0])
    # a row 10 px below the centre is read 0.02 · 10 / 768 s later, in which the vehicle moves on by 2600 px/s
    shear = timing.shear(readouts)
    moved = shear[1, 0] @ [150.0, 630.0, 1.0]
    np.testing.assert_allclose(moved, [150.0, 630.0 + 2600 * 0.02 * 10 / 768, 1.0])
    np.testing.assert_allclose(shear[:, 1], np.tile(np.eye(3), (2, 1, 1)))


# --- clips ----------------------------------------------------------------------------------------------------------


LATE_SCENE = Scene(
    5, (Vehicle("v0", 15.0, start_distance=45.0),), camera_height=3.0, tilt=0.06, road_depth=35.0, rate=10.0, frames=14
)


def write_without_times(scene: Scene, folder: Path) -> Path:
    """The clip of a scene whose right camera is late, which no file says."""
    write(render(scene), folder)
    file = folder / "clip.yaml"
    document = yaml.safe_load(file.read_text())
    del document["times"]
    file.write_text(yaml.safe_dump(document | {"rate": scene.rate}))
    return file


@pytest.fixture(scope="module")
def late_clip(tmp_path_factory):
    """The right camera is 12 ms late."""
    return write_without_times(replace(LATE_SCENE, skew_s=0.012), tmp_path_factory.mktemp("late"))


def test_a_late_right_view_is_found_and_does_not_bias_the_speed(late_clip):
    result = measure_clip(late_clip)
    offset, measurement = result.cameras["offset_s"], result.measurements[0]
    assert offset["source"] == "estimated"
    assert abs(offset["value"] - 0.012) < 4 * offset["std"] and offset["std"] < 0.001
    assert measurement.verdict == "measured"
    assert measurement.speed_lo < 15.0 < measurement.speed_hi


@pytest.mark.parametrize("stated", slow_after(1, [True, False]))
def test_a_time_between_the_views_that_time_stamps_tell_counts_once(late_clip, stated, tmp_path):
    """Where nothing more is stated a further offset may be; where it is none, the rig has nothing to explain."""
    stamps = np.arange(LATE_SCENE.frames) / LATE_SCENE.rate
    rows = [f"{k},{t:.6f},{t + 0.012:.6f}" for k, t in enumerate(stamps)]
    (tmp_path / "times.csv").write_text("\n".join(["frame,left_s,right_s", *rows]) + "\n")
    clip = replace(
        load_clip(late_clip), rate=None, times=tmp_path / "times.csv", offset=EXACTLY_ZERO if stated else None
    )
    clip = replace(clip, rig=with_assumed_uncertainty(clip.rig))
    cameras = recorded_cameras.estimate_cameras(clip, open_recording(clip))
    np.testing.assert_allclose(cameras.recording.skews, 0.012, atol=0.0 if stated else 0.002)
    assert cameras.fit.rig_shift_sigma < 1.0


@pytest.mark.parametrize("radius", slow_after(0, [-60.0, None]))
def test_a_vehicle_is_measured_where_it_moves_farther_than_the_baseline_between_the_exposures(radius, tmp_path):
    result = measure_clip(write_without_times(replace(LATE_SCENE, skew_s=0.04, radius=radius), tmp_path))
    measurement = result.measurements[0]
    assert abs(result.cameras["offset_s"]["value"] - 0.04) < 4 * result.cameras["offset_s"]["std"] < 0.008
    assert measurement.verdict == "measured", measurement.reason
    assert measurement.speed_lo < 15.0 < measurement.speed_hi and measurement.speed_hi - measurement.speed_lo < 0.4


def test_outlines_that_cannot_be_of_one_part_are_refused_once_the_offset_is_known(late_clip):
    clip = load_clip(late_clip)
    vehicle = replace(clip.vehicles[0], right=clip.vehicles[0].right + [0.0, 200.0])
    with pytest.raises(UnusableInput, match=r"vehicles\[0\]: the views disagree"):
        measure_clip(replace(clip, vehicles=[vehicle]))


@pytest.mark.slow
def test_a_stated_offset_is_taken_as_stated(late_clip):
    clip = replace(load_clip(late_clip), offset=Quantity(0.012))
    result = measure_clip(clip)
    assert result.cameras["offset_s"] == {"value": 0.012, "std": 0.0, "source": "stated", "speed_effect": 0.0}
    assert result.measurements[0].speed_lo < 15.0 < result.measurements[0].speed_hi


def test_a_stated_offset_counts_live_too(late_clip):
    pair = next(iter(LiveStereo(replace(load_clip(late_clip), offset=Quantity(0.012)))))
    assert (pair.index, pair.time, pair.skew) == (0, pytest.approx(0.006), pytest.approx(0.012))


def test_what_is_not_stated_of_live_exposures_is_assumed(late_clip):
    clip = load_clip(late_clip)
    unknown = replace(clip, rig=replace(clip.rig, left=replace(clip.rig.left, readout=None)))
    assumed = recorded_cameras.with_assumed_exposures(unknown, 0.1)
    assert assumed.offset == Quantity(0.0, 0.05, "assumed") and assumed.rig.left.readout.source == "assumed"
    stated = replace(
        clip, offset=Quantity(0.012), rig=replace(clip.rig, left=replace(clip.rig.left, readout=EXACTLY_ZERO))
    )
    kept = recorded_cameras.with_assumed_exposures(stated, 0.1)
    assert (kept.offset, kept.rig.left.readout) == (Quantity(0.012), EXACTLY_ZERO)


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({"drawn_on": 14}, "drawn_on: frame 14 cannot be used; expected one from 0 to 13 that is whole in both views"),
        ({"offset": Quantity(8.0)}, "offset: expected at most the 0.1 s between frames, .* found 8"),
    ],
)
def test_what_contradicts_the_recording_is_refused_by_name(late_clip, wrong, problem):
    with pytest.raises(UnusableInput, match=f"clip.yaml: {problem}$"):
        measure_clip(replace(load_clip(late_clip), **wrong))


def test_swaying_cameras_are_steadied_and_results_are_where_they_were_recorded(late_clip):
    recording = open_recording(load_clip(late_clip))
    vectors = np.zeros((len(recording), 2, 3))
    vectors[4:, :, 0] = 5e-4  # from the fifth frame on both look 1.1 px further down
    swaying = recording.corrected(0.0, -vectors)  # pictures turned by a rotation that is not there

    class Turned:
        """The swaying pictures as a recording that knows nothing of it."""

        def __getattr__(self, name):
            return getattr(recording, name)

        def __len__(self):
            return len(recording)

        def frames(self, *limits):
            return swaying.frames(*limits)

    rotations = recorded_cameras.estimate_rotations(Turned(), next(swaying.frames()))
    assert rotations.is_stationary
    np.testing.assert_allclose(rotations.vectors, vectors, atol=2e-5)
    cameras = recorded_cameras.RecordedCameras(
        load_clip(late_clip), recording.corrected(0.0, vectors), rotations, EpipolarFit(recording.rig, 0.0, None, None)
    )
    assert [n.code for n in cameras.notices] == ["knock"] * 2
    first, second = (float(recording.times[k]) for k in (3, 4))
    for view, knock in zip(("left", "right"), cameras.summary()["knocks"], strict=True):
        assert knock["view"] == view and first < knock["time_s"] < second
        assert knock["px"] == pytest.approx(5e-4 * recording.rig.left.K[0, 0], rel=0.05)
    rotations.static_share[6:8, 0] = 0.0
    cameras = replace(cameras)  # what was derived of the rotations is derived anew
    assert [n.code for n in cameras.notices] == ["rotation_unknown", "knock", "knock"]
    assert "left: " in cameras.notices[0]
    rotations.static_share[:8] = 0.0
    cameras = replace(cameras)
    assert [n.code for n in cameras.notices] == ["cameras_travel"] * 2
    seen = recorded_cameras.RecordedCameras(
        load_clip(late_clip), recording.corrected(0.0, vectors), rotations, fit=None
    )
    pixels = np.full((2, 4, 2), 300.0)
    left = recording.rig.left
    recorded = seen.as_recorded(np.array([0, 6]), pixels, 0)
    np.testing.assert_allclose(recorded[0], pixels[0])
    there = left.project(left.rays(pixels[1]) @ cv2.Rodrigues(vectors[6, 0])[0].T)
    np.testing.assert_allclose(recorded[1], there, atol=1e-6)


def test_matches_of_a_clip_lie_on_their_epipolar_lines_where_nothing_moves(late_clip):
    recording = open_recording(load_clip(late_clip))
    static, moving = match_static(recording), InstantFeatures(recording).matches()
    assert len(static.left) > 20 and len(moving.left) > 20
    assert np.median(np.abs(epipolar_distance(recording.rig, static.left, static.right))) < 0.1


def test_features_that_pass_by_give_the_matches_that_detection_gives(late_clip):
    recording = open_recording(load_clip(late_clip))
    passed = InstantFeatures(recording)
    frames = [frame.index for frame, _ in passed.passing(moving_features(recording.rig, recording.frames()))]
    assert frames == recording.indices.tolist()
    detected = InstantFeatures(recording).matches()
    np.testing.assert_allclose(passed.matches().left, detected.left)
    np.testing.assert_allclose(passed.matches().velocity, detected.velocity)


@pytest.mark.parametrize("side", [18, 60])
def test_a_template_is_found_at_its_place_and_scale(side):
    picture = cv2.GaussianBlur(np.random.default_rng(2).uniform(0, 255, (300, 400)).astype(np.float32), (0, 0), 2.5)
    scale, shift = 1.1, np.array([23.0, -9.0])
    quad = np.array([[0, 0], [side, 0], [side, side], [0, side]]) + np.array([150.0, 120.0])
    middle = quad.mean(0)
    affine = np.column_stack([scale * np.eye(2), middle + shift - scale * middle])
    found, growth = match_template(picture, cv2.warpAffine(picture, affine, (400, 300)), quad, 40.0)
    np.testing.assert_allclose(found, shift, atol=1.5)
    assert growth == pytest.approx(scale, abs=0.05)


def test_a_place_is_found_between_the_views_by_what_the_outline_shows():
    """A picture at 30 m, seen by both cameras: the right one shows it shifted by its disparity."""
    camera = Camera((400, 300), np.array([[900.0, 0.0, 200.0], [0.0, 900.0, 150.0], [0.0, 0.0, 1.0]]))
    rig = StereoRig(camera, camera, np.eye(3), np.array([-0.5, 0.0, 0.0]))
    picture = cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 255, (300, 400)).astype(np.float32), (0, 0), 2.0)
    disparity = 900.0 * 0.5 / 30.0
    shifted = cv2.warpAffine(picture, np.array([[1.0, 0.0, -disparity - 0.3], [0.0, 1.0, 0.0]]), (400, 300))
    outline = np.array([[0, 0], [40, 0], [40, 30], [0, 30]]) + np.array([180.3, 120.6])
    place = place_between_views(rig, outline, (picture, shifted), np.array([24.0, 40.0]))
    assert place is not None
    np.testing.assert_allclose(rig.left.project(place), outline.mean(0))
    assert place[2] == pytest.approx(900.0 * 0.5 / (disparity + 0.3), rel=0.01)
    assert place_between_views(rig, outline - [175.0, 0.0], (picture, shifted), np.array([24.0, 40.0])) is None
    assert place_between_views(rig, outline, (picture, shifted[:150]), np.array([24.0, 40.0])) is None  # a smaller view
    blank = place_between_views(rig, outline, (0 * picture, 0 * shifted), np.array([24.0, 40.0]))
    assert blank is not None and np.isfinite(blank).all()
