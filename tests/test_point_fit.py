"""The second estimate of a speed: windows registered, the motion fitted to corners, and when it contradicts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import stdtrit
from scipy.stats import t as student

from paceline.simulation.stereo.clip import Scene, Vehicle, render, write
from paceline.speed.acceptance import MAX_DISAGREEMENT_CHANCE, check_second_estimate
from paceline.speed.measurement import measure_clip
from paceline.speed.refinement.corner_tracks import CornerTracks, _Windows
from paceline.speed.refinement.keyframes import Keyframe
from paceline.speed.refinement.model_selection import RefinedMotion
from paceline.speed.refinement.point_fit import ESTIMATE_CORRELATION, PointFit, SecondEstimate, second_estimate
from paceline.speed.refinement.trajectory import Prior, Trajectory
from paceline.speed.results import Measurement
from paceline.speed.run import VehicleMeasurement

Array = NDArray[np.float64]
SPEED = 14.0  # m/s
SCENE = Scene(
    5,
    (Vehicle("v0", SPEED, start_distance=48.0, texture_seed=3),),
    image_size=(640, 480),
    focal=1400.0,
    rate=5.0,
    frames=10,
)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[RefinedMotion, list[Keyframe], Measurement]:
    """A refined motion, what it was fitted to, and the measurement of its clip."""
    kept: dict[str, Any] = {}
    measure = VehicleMeasurement._measured

    def keep(run: VehicleMeasurement, refined: RefinedMotion) -> Measurement:
        kept.update(refined=refined, keyframes=run.keyframes)
        return measure(run, refined)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VehicleMeasurement, "_measured", keep)
        (m,) = measure_clip(write(render(SCENE), tmp_path_factory.mktemp("clip"))).measurements
    return kept["refined"], kept["keyframes"], m


def test_a_place_on_the_plane_is_seen_where_the_homographies_put_it(measured: Any) -> None:
    refined, _, _ = measured
    square = np.random.default_rng(0).uniform(0.0, 1.0, (7, 2))
    trajectory = replace(refined.trajectory, readouts=np.array([0.02, -0.01]))
    places = trajectory.places(refined.theta, square)
    seen = trajectory.projections(refined.theta) @ np.c_[places, np.ones(7)].T
    expected = trajectory.homographies(refined.theta)[0] @ np.c_[square, np.ones(7)].T
    for rays in (seen, expected):
        rays /= rays[..., 2:, :].copy()
    assert seen == pytest.approx(expected, abs=1e-6)


def pattern(x: Array, y: Array, blur: float) -> NDArray[np.float32]:
    """Grey values of a sum of waves, blurred by a Gaussian of ``blur`` px, which is exact for waves."""
    rng = np.random.default_rng(4)
    value = np.full(x.shape, 120.0)
    for kx, ky, phase in zip(*rng.uniform(-0.9, 0.9, (2, 12)), rng.uniform(0, 7, 12), strict=True):
        value += 12.0 * np.exp(-0.5 * blur**2 * (kx**2 + ky**2)) * np.sin(kx * x + ky * y + phase)
    return np.asarray(value, np.float32)


def test_a_window_is_registered_in_an_image_of_other_contrast_and_sharpness() -> None:
    x, y = np.meshgrid(np.arange(60.0), np.arange(50.0))
    template = pattern(x, y, 0.8)
    corners = np.array([[20.0, 18.0], [31.0, 25.0], [40.0, 30.0]])
    dx, dy = 0.37, -0.23
    image = np.asarray(0.8 * pattern(x - dx, y - dy, 1.0) + 15.0, np.float32)
    windows = _Windows(template, corners)
    found = windows.registered(image, windows.registered(image, corners))
    assert found - corners == pytest.approx(np.tile([dx, dy], (3, 1)), abs=0.02)


def tracks_of(refined: RefinedMotion, speed: float, others: int, noise: float) -> CornerTracks:
    """Tracks of 30 points of a vehicle that drives straight along its path, and of ``others`` that stand still."""
    rng = np.random.default_rng(8)
    trajectory, count = refined.trajectory, 30 + others
    square = rng.uniform(0.1, 0.9, (count, 2))
    _, _, normal, _ = trajectory.motion(refined.theta)
    places = trajectory.places(refined.theta, square) + rng.normal(0, 0.1, (count, 1)) * normal
    travel = trajectory.path.direction_near(places[0])
    velocity = speed * travel * (np.arange(count) < 30)[:, None]
    pixels = np.empty((count, 2 * len(trajectory.times), 2))
    for frame, times in enumerate(trajectory.times):
        for side in (0, 1):
            pixels[:, 2 * frame + side] = trajectory.rig.project(places + velocity * times[side])[side]
    pixels += rng.normal(0, noise, pixels.shape)
    identity = np.tile(np.eye(3), (*pixels.shape[:2], 1, 1))
    return CornerTracks(square, pixels, identity, np.ones(pixels.shape[:2]))


@pytest.mark.parametrize("others", [0, 8])
def test_the_speed_is_that_of_the_points_wherever_the_photometric_fit_is(measured: Any, others: int) -> None:
    refined, _, _ = measured
    for factor in (0.97, 1.0, 1.03):
        speed = factor * SPEED
        theta, covariance, _ = PointFit(refined, tracks_of(refined, speed, others, 0.05)).solution()
        gradient = refined.trajectory.mean_speed_gradient
        std = float(np.sqrt(gradient @ covariance @ gradient))
        assert std < 0.01 * SPEED
        assert abs(float(gradient @ theta) - speed) < 4 * std + 1e-3 * SPEED


def moved(refined: RefinedMotion, share: float) -> RefinedMotion:
    """``refined`` with another mean speed, and all parameters as the images change least by it."""
    gradient = refined.trajectory.mean_speed_gradient
    direction = refined.covariance @ gradient
    change = share * float(gradient @ refined.theta) / float(gradient @ direction)
    return replace(refined, theta=refined.theta + change * direction)


def test_a_wrong_speed_is_contradicted_and_a_right_one_is_not(measured: Any) -> None:
    refined, keyframes, m = measured
    half = (m.speed_hi - m.speed_lo) / 2
    assert m.verdict == "measured" and np.isfinite([m.corners_difference, m.corners_difference_std]).all()
    speeds = []
    for share, code in ((0.0, ""), (0.04, "methods_disagree"), (-0.04, "methods_disagree")):
        wrong = moved(refined, share)
        second = second_estimate(wrong, keyframes)
        assert second is not None and check_second_estimate(second, half).code == code
        speeds.append(second.speed)
    assert speeds == pytest.approx([SPEED] * 3, rel=0.005)


def test_a_view_that_does_not_show_the_vehicle_is_left_out(measured: Any) -> None:
    refined, keyframes, m = measured
    empty = np.zeros((0, 5), np.float32)
    last = replace(keyframes[-1], crops=(empty, empty))
    second = second_estimate(refined, [*keyframes[:-1], last])
    assert second is not None and second.speed == pytest.approx(SPEED, rel=0.01)


def test_nothing_is_said_where_no_corners_are_tracked(measured: Any) -> None:
    refined, keyframes, _ = measured
    plain = [replace(k, crops=tuple(np.full_like(crop, 90.0) for crop in k.crops)) for k in keyframes]
    assert second_estimate(refined, plain) is None


def test_a_difference_counts_beyond_the_interval_and_both_covariances() -> None:
    by_covariances = float(student.ppf(1 - MAX_DISAGREEMENT_CHANCE / 2, 9.0)) * 0.1

    def code(difference: float, half_width: float) -> str:
        return check_second_estimate(second(difference, 0.1, 0.05), half_width).code

    assert code(1.01 * by_covariances, 0.2) == code(-1.01 * by_covariances, 0.2) == "methods_disagree"
    assert code(0.99 * by_covariances, 0.2) == code(1.01 * by_covariances, 0.5) == code(float("nan"), 0.2) == ""


def second(difference: float, difference_std: float, std: float) -> SecondEstimate:
    """A second estimate of 20 m/s, the only parameter of its motion, by 9 degrees of freedom."""
    return SecondEstimate(np.array([20.0]), np.array([[std**2]]), 20.0, difference, difference_std, 9.0, 9.0)


def refined_motion(speed: float, std: float, matching_std: float = 0.0) -> RefinedMotion:
    """A refined motion of ``speed`` (m/s), its only parameter, with these standard deviations by 9 degrees of freedom
    and by what all matches share."""
    covariance, matching = (np.array([[s**2]]) for s in (std, matching_std))
    zeros, trajectory = np.zeros((1, 1)), cast(Trajectory, SimpleNamespace(mean_speed_gradient=np.ones(1)))
    images = 1.0, 10.0, 1.0, np.zeros((9, 2, 2)), np.ones((9, 2)), (), cast(Prior, None), 0.0, 9.0, np.inf, True
    return RefinedMotion(trajectory, np.zeros(1), np.array([speed]), covariance, matching, zeros, zeros, None, *images)


def combined(difference: float, stds: tuple[float, float]) -> tuple[float, float]:
    """The speed and its standard deviation of estimates of 20 m/s less the ``difference``, by the photometric fit, and
    of 20 m/s by corners, with these ``stds``."""
    fit = refined_motion(20.0 - difference, stds[0])
    result = second(difference, float(np.hypot(*stds)), stds[1]).combined_with(fit)
    return float(result.theta[0]), float(np.sqrt(result.covariance[0, 0]))


def test_equal_estimates_share_half_of_the_speed() -> None:
    speed, std = combined(0.05, (0.1, 0.1))
    assert speed == pytest.approx(19.975) and std == pytest.approx(0.1 * np.sqrt((1 + ESTIMATE_CORRELATION) / 2))


@pytest.mark.parametrize("ratio", [3.0, 10.0, 100.0])
def test_a_poor_second_estimate_spoils_nothing(ratio: float) -> None:
    speed, std = combined(0.1, (0.1, 0.1 * ratio))
    assert abs(speed - 19.9) < 0.1 / ratio and std < 0.12
    speed, std = combined(0.1, (0.1 * ratio, 0.1))
    assert abs(speed - 20.0) < 0.1 / ratio and std < 0.12


def test_estimates_that_differ_make_the_interval_wider() -> None:
    stds = [combined(difference, (0.1, 0.1))[1] for difference in (0.0, 0.09, 0.2, 0.4)]
    assert stds[0] == stds[1] < stds[2] < stds[3]
    assert stds[3] > 0.2  # half of the difference


def test_intervals_of_the_mean_hold_for_correlated_estimates() -> None:
    rng = np.random.default_rng(2)
    stds = 0.1, 0.06
    common = ESTIMATE_CORRELATION * stds[0] * stds[1]
    errors = rng.multivariate_normal([0.0, 0.0], [[stds[0] ** 2, common], [common, stds[1] ** 2]], 1000)
    found = np.array([combined(corners - photometric, stds) for photometric, corners in errors])
    z = (found[:, 0] - 20.0 + errors[:, 1]) / found[:, 1]
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.03  # Birge's ratio only widens


@pytest.mark.parametrize("matching_std", [0.0, 0.05, 0.2])
def test_intervals_by_estimated_variances_cover_95_percent(matching_std: float) -> None:
    """Student's distribution is of the variance that the images give, not of what is known."""
    rng = np.random.default_rng(5)
    noise, matching = 0.1 * rng.normal(size=4000), matching_std * rng.normal(size=4000)
    stds = 0.1 * np.sqrt(rng.chisquare(9, size=4000) / 9)
    halves = []
    for std in stds:
        fit = refined_motion(20.0, std, matching_std)
        halves.append(stdtrit(fit.noise_dof(fit.covariance), 0.975) * np.hypot(std, matching_std))
    assert 0.94 < np.mean(np.abs(noise + matching) < halves) < 0.96


def test_the_mean_of_two_estimates_is_of_more_degrees_of_freedom() -> None:
    def dof(stds: tuple[float, float]) -> float:
        return second(0.0, float(np.hypot(*stds)), stds[1]).combined_with(refined_motion(20.0, stds[0])).dof

    assert 18.0 <= dof((0.1, 0.1)) < 30.0 and dof((0.1, 5.0)) == pytest.approx(9.0, abs=0.5)
    assert dof((5.0, 0.1)) == pytest.approx(9.0, abs=0.5)


def test_what_is_reported_is_the_mean_of_both_estimates(measured: Any) -> None:
    refined, keyframes, m = measured
    estimate = second_estimate(refined, keyframes)
    assert estimate is not None
    photometric = refined.mean_speed()[0]
    assert min(photometric, estimate.speed) < m.speed < max(photometric, estimate.speed)
    assert m.corners_difference == pytest.approx(estimate.difference)
    assert estimate.combined_with(refined).mean_speed()[0] == pytest.approx(m.speed)
