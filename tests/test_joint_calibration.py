"""Joint self-calibration: against one least-squares solution for all vehicles, and end to end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import binom, chi2, norm
from tiny_road import TWO, scene

from paceline.cameras import RigUncertainty, perturbed_rig
from paceline.documents.loading import Clip, load_clip
from paceline.simulation.stereo.clip import render, write
from paceline.speed.configuration import DEFAULTS, SpeedConfiguration
from paceline.speed.joint_calibration import (
    SAME_VEHICLE_M,
    CanonicalGaussian,
    calibrate_jointly,
    combine_consistent,
    corrected,
    moments,
    neighbours,
    rig_evidence,
    rig_prior,
    same_vehicle,
    shift_sigma,
    with_neighbours,
)
from paceline.speed.measurement import measure_clip
from paceline.speed.results import Measurement, RigInformation, Synchronisation, Track
from paceline.units import COVERAGE_95

NEIGHBOURS, WINDOW_S = DEFAULTS.joint_calibration.neighbours, DEFAULTS.joint_calibration.window_s
Array = NDArray[np.float64]
N, Q = 3, 4  # parameters of a motion and directions of the rig in the linear models here
USUAL = 1.959963984540054
FAST = 200.0  # m/s, so fast that no interval here is too wide


@dataclass(frozen=True)
class LinearImages:
    """Grey values that are linear in a motion (N,) and the rig (Q,), with noise of 1."""

    J: Array
    y: Array

    def alone(self, speed: float = FAST, time: float = 0.0, x: float = 0.0) -> Measurement:
        """Least squares of this vehicle alone, the rig under its prior; it passes at ``time`` s and ``x`` m. The
        mean speed is the sum of the motion's parameters, that of each of two frames is the first of them and the
        second."""
        A = self.J.T @ self.J + np.diag([*np.zeros(N), *np.ones(Q)])
        found, left = np.linalg.solve(A, self.J.T @ self.y), np.linalg.inv(A)
        motion = self.J[:, :N].T @ self.J[:, :N]
        response = -np.linalg.solve(motion, self.J[:, :N].T @ self.J[:, N:])
        given_rig, mean, frames = np.linalg.inv(motion), np.ones(N), np.eye(N)[:2]
        information = RigInformation(
            offset=np.asarray(found[N:], float),
            information=np.linalg.inv(left[N:, N:]) - np.eye(Q),
            mean_speed_gradient=mean @ response,
            mean_speed_std=float(np.sqrt(mean @ given_rig @ mean)),
            half_width=USUAL * float(np.sqrt(mean @ given_rig @ mean)),
            speed_jacobian=frames @ response,
            speed_stds=np.sqrt(np.diag(frames @ given_rig @ frames.T)),
        )
        std = float(np.sqrt(mean @ left[:N, :N] @ mean))
        speeds = speed + found[:2]
        stds = np.sqrt(np.diag(left)[:2])
        track = SimpleTrack(time + np.array([0.0, 0.5]), np.asarray(speeds, float), stds, np.full((2, 3), x))
        mean_speed = speed + float(found[:N].sum())
        return Measurement(
            "v",
            cast(Track, track),
            mean_speed,
            mean_speed - USUAL * std,
            mean_speed + USUAL * std,
            std,
            0.0,
            2,
            "measured",
            "",
            "constant acceleration",
            acceleration=float(np.diff(speeds)[0] / 0.5),
            rig_information=information,
        )


@dataclass(frozen=True)
class SimpleTrack:
    """A track of two frames."""

    time: Array
    refined_speed: Array
    refined_std: Array
    position: Array

    @property
    def frame(self) -> NDArray[np.int64]:
        return np.rint(10 * self.time).astype(np.int64)


def images(rng: np.random.Generator, rig: Array, pixels: int = 12) -> LinearImages:
    J = rng.standard_normal((pixels, N + Q)) * np.array([*np.ones(N), 2.0, 1.0, 0.3, 0.01])
    truth = np.concatenate([rng.standard_normal(N), rig])
    return LinearImages(J, J @ truth + rng.standard_normal(pixels))


def all_evidence(measurements: list[Measurement]) -> list[CanonicalGaussian]:
    return [rig_evidence(m.rig_information) for m in measurements if m.rig_information is not None]


def passing(vehicles: list[LinearImages]) -> list[Measurement]:
    """Each measured alone, passing one after the other."""
    return [v.alone(time=10.0 * k) for k, v in enumerate(vehicles)]


def several(seed: int, count: int) -> list[LinearImages]:
    rng = np.random.default_rng(seed)
    rig = rng.standard_normal(Q)
    return [images(rng, rig) for _ in range(count)]


@given(seed=st.integers(0, 10_000), count=st.integers(2, 6))
def test_it_equals_one_least_squares_solution_for_all(seed: int, count: int) -> None:
    """All motions and the rig in one least-squares problem."""
    vehicles = several(seed, count)
    J = np.zeros((sum(len(v.y) for v in vehicles), count * N + Q))
    row = 0
    for k, v in enumerate(vehicles):
        J[row : row + len(v.y), k * N : (k + 1) * N] = v.J[:, :N]
        J[row : row + len(v.y), count * N :] = v.J[:, N:]
        row += len(v.y)
    A = J.T @ J + np.diag([*np.zeros(count * N), *np.ones(Q)])
    joint, left = np.linalg.solve(A, J.T @ np.concatenate([v.y for v in vehicles])), np.linalg.inv(A)

    alone = passing(vehicles)
    evidence = all_evidence(alone)
    posterior = sum(evidence, rig_prior(Q))
    limit = DEFAULTS.limits.rig_shift_sigma
    if max(shift_sigma(posterior - t, t) for t in evidence) <= limit:  # but for one draw in 100,000
        agree_on, agree = combine_consistent(evidence)
        assert agree.all() and (agree_on.precision == posterior.precision).all()
    np.testing.assert_allclose(posterior.mean, joint[count * N :], atol=1e-8)
    np.testing.assert_allclose(posterior.covariance, left[count * N :, count * N :], atol=1e-8)
    for k, m in enumerate(corrected(m, posterior) for m in alone):
        part = slice(k * N, (k + 1) * N)
        assert m.speed == pytest.approx(FAST + joint[part].sum(), abs=1e-8)
        variance = left[part, part].sum()
        assert m.random_std**2 + m.systematic_std**2 == pytest.approx(variance, rel=1e-8)
        assert m.speed_hi - m.speed == pytest.approx(USUAL * np.sqrt(variance), rel=1e-8)
        np.testing.assert_allclose(m.track.refined_speed, FAST + joint[part][:2], atol=1e-8)
        np.testing.assert_allclose(m.track.refined_std, np.sqrt(np.diag(left)[part][:2]), rtol=1e-8)
        assert m.acceleration == pytest.approx((joint[part][1] - joint[part][0]) / 0.5, abs=1e-7)


def test_a_shift_is_in_standard_deviations_of_chance() -> None:
    """Over many draws the largest shift by a vehicle is distributed as the maximum of as many normal variates."""
    shifts, directions = [], []
    for seed in range(300):
        *others, one = all_evidence(passing(several(seed, 4)))
        posterior = sum(others, rig_prior(Q))
        shifts.append(shift_sigma(posterior, one))
        root = np.linalg.cholesky(posterior.covariance)
        information = np.linalg.eigvalsh(root.T @ one.precision @ root)
        directions.append((information / (1 + information) > 0.05).sum())
    assert min(directions) < Q  # one is hardly determined
    beyond = 2.0
    expected = 1.0 - 0.9545 ** np.array(directions)
    found = np.mean(np.array(shifts) > beyond)
    assert abs(found - expected.mean()) < 4 * np.sqrt(expected.mean() / len(shifts))


def with_moved_rig(v: LinearImages, by: float) -> LinearImages:
    """The same images with the rig moved in the direction that they determine best."""
    return replace(v, y=v.y + v.J[:, N:] @ np.array([by, 0.0, 0.0, 0.0]))


def contradicting(vehicles: list[LinearImages], k: int, wanted: float) -> list[Measurement]:
    """All vehicles, with the one at ``k`` contradicting the others by ``wanted`` standard deviations."""

    def made(by: float) -> tuple[float, list[Measurement]]:
        all_of_them = passing([with_moved_rig(v, by) if i == k else v for i, v in enumerate(vehicles)])
        evidence = all_evidence(all_of_them)
        return shift_sigma(sum(evidence, rig_prior(Q)) - evidence[k], evidence[k]) - wanted, all_of_them

    by = brentq(lambda by: made(by)[0], 0.0, 40.0)
    return made(float(by))[1]


@pytest.mark.parametrize(("wanted", "verdict"), [(4.9, "measured"), (5.1, "rejected")])
def test_the_one_that_contradicts_all_others_is_left_out_and_rejected(wanted: float, verdict: str) -> None:
    vehicles = several(5, 5)
    alone = contradicting(vehicles, 2, wanted)
    measured = calibrate_jointly(alone)
    bad, good = measured[2], [*measured[:2], *measured[3:]]
    assert bad.verdict == verdict and {m.verdict for m in good} == {"measured"}
    assert [m.calibrated_by for m in good] == [5 if verdict == "measured" else 4] * 4
    assert all(m.rig_information is None for m in measured)
    if verdict == "rejected":
        assert bad.reason.startswith("calibration: ") and bad.speed == alone[2].speed
        assert bad.reason_code == "calibration_differs_between_vehicles"
        for m, right in zip(good, calibrate_jointly([*alone[:2], *alone[3:]]), strict=True):
            assert m.speed == pytest.approx(right.speed, abs=1e-9)


def test_two_that_contradict_each_other_stay_as_they_are() -> None:
    two = contradicting(several(6, 2), 1, 6.0)
    assert calibrate_jointly(two) == two


@pytest.mark.parametrize(("off", "verdict"), [(2.0, "measured"), (9.0, "rejected")])
def test_all_vehicles_together_may_contradict_the_stated_rig(off: float, verdict: str) -> None:
    """A rig that is ``off`` standard uncertainties off, which no vehicle alone could show."""
    rng = np.random.default_rng(11)
    rig = np.array([off, 0.0, 0.0, 0.0])
    poor = []
    for _ in range(NEIGHBOURS + 1):
        v = images(rng, np.zeros(Q))
        J = v.J * np.array([*np.ones(N), 0.06, 0.5, 0.06, 0.005])  # little: its own shift stays small
        poor.append(LinearImages(J, v.y + J[:, N:] @ rig))
    alone = passing(poor)
    evidence = all_evidence(alone)
    assert max(shift_sigma(rig_prior(Q), t) for t in evidence) < DEFAULTS.limits.rig_shift_sigma
    assert combine_consistent(evidence)[1].all()
    measured = calibrate_jointly(alone)
    assert {m.verdict for m in measured} == {verdict}
    if verdict == "rejected":
        assert {m.reason_code for m in measured} == {"calibration_inconsistent_jointly"}
        assert all("of 9 vehicles together" in m.reason for m in measured)


def test_one_alone_and_those_without_information_stay_as_they_are() -> None:
    one, other = passing(several(7, 2))
    silent = replace(other, rig_information=None, verdict="rejected", reason="outline: it is another one")
    assert calibrate_jointly([]) == []
    assert calibrate_jointly([silent, one, silent]) == [silent, one, silent]
    assert with_neighbours(silent, [one]) is silent and with_neighbours(one, []) is one


def test_only_vehicles_of_about_the_same_time_are_combined() -> None:
    """The nearest in time, at most eight of them."""
    vehicles = several(9, 14)
    crowd = [v.alone(time=20.0 * k) for k, v in enumerate(vehicles)]
    middle = crowd[6]
    near = neighbours(middle, [m for m in crowd if m is not middle])
    assert {id(m) for m in near} == {id(m) for m in crowd[2:11] if m is not middle} and len(near) == NEIGHBOURS
    assert calibrate_jointly(crowd)[6].calibrated_by == NEIGHBOURS + 1
    late = vehicles[0].alone(time=20.0 * 6 + WINDOW_S + 1.0)
    assert neighbours(middle, [late]) == []
    assert neighbours(middle, [vehicles[0].alone(time=20.0 * 6 + WINDOW_S)]) != []


def test_a_vehicle_that_is_outlined_twice_counts_once() -> None:
    vehicles = several(10, 4)
    one, twice = vehicles[0].alone(time=0.0), vehicles[1].alone(time=0.0, x=0.5 * SAME_VEHICLE_M / np.sqrt(3.0))
    others = [v.alone(time=10.0 + 10.0 * k, x=5.0) for k, v in enumerate(vehicles[2:])]
    assert same_vehicle(one.track, twice.track) and not same_vehicle(one.track, others[0].track)
    assert not same_vehicle(one.track, vehicles[1].alone(time=0.0, x=1.1 * SAME_VEHICLE_M).track)
    assert [m.calibrated_by for m in calibrate_jointly([one, twice, *others])] == [3, 3, 3, 3]
    assert calibrate_jointly([one, twice]) == [one, twice]


@pytest.mark.parametrize("drifts", ["steady", "warms up and cools down"])
def test_intervals_hold_while_the_rig_drifts(drifts: str) -> None:
    """By one standard uncertainty in every direction, in a survey of 150 vehicles one after the other, each with those
    before it."""
    rng, seen, held = np.random.default_rng(3), [], []  # type: ignore[var-annotated]
    for k in range(150):
        rig = np.zeros(Q) if drifts == "steady" else np.full(Q, np.sin(2 * np.pi * k / 150))
        J = rng.standard_normal((40, N + Q)) * np.array([*np.ones(N), 1.0, 0.5, 0.3, 0.01])
        motion = rng.standard_normal(N)
        m = LinearImages(J, J @ np.concatenate([motion, rig]) + rng.standard_normal(40)).alone(time=20.0 * k)
        right = with_neighbours(m, seen[-NEIGHBOURS:])
        seen.append(m)
        held.append(abs(right.speed - FAST - motion.sum()) < (right.speed_hi - right.speed_lo) / 2)
    assert binom.cdf(np.sum(held), len(held), 0.95) > 0.001


def test_an_interval_too_wide_alone_may_be_accepted_jointly() -> None:
    alone = passing(several(8, 8))
    wide = replace(alone[0], verdict="rejected", reason="interval too wide: ± 9.0% of the speed")
    mended, *_ = calibrate_jointly([wide, *alone[1:]])
    assert (mended.verdict, mended.reason) == ("measured", "")
    assert wide.rig_information is not None
    random = replace(wide.rig_information, half_width=0.05 * FAST, mean_speed_std=0.025 * FAST)
    unsure = replace(wide, rig_information=random)
    still, *_ = calibrate_jointly([unsure, *alone[1:]])
    assert still.verdict == "rejected" and "without the calibration's part" in still.reason


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """A clip of two vehicles."""
    return load_clip(write(render(scene(*TWO)), tmp_path_factory.mktemp("two")))


KNOWN = RigUncertainty(1.0, 0.0, (4e-5, 4e-5, 4e-5), (3e-4, 3e-4, 3e-4))


def test_vehicles_of_one_clip_correct_each_others_rig(two: Clip) -> None:
    """End to end, with a rig error as stated."""
    move = np.random.default_rng(3).standard_normal(14) @ KNOWN.covariance_root
    clip = replace(two, rig=replace(perturbed_rig(two.rig, move), uncertainty=KNOWN))
    alone = [measure_clip(replace(clip, vehicles=[v])).measurements[0] for v in clip.vehicles]
    result = measure_clip(clip)
    assert [m.calibrated_by for m in result.measurements] == [2, 2] and result.notices == []
    z = []
    widths, widths_alone = ([m.speed_hi - m.speed_lo for m in measured] for measured in (result.measurements, alone))
    assert np.sum(widths) < 0.9 * np.sum(widths_alone)
    for one, m, vehicle in zip(alone, result.measurements, TWO, strict=True):
        assert one.verdict == m.verdict == "measured" and m.vehicle == vehicle.id
        assert m.speed_lo < m.speed < m.speed_hi
        z.append((m.speed - vehicle.speed) / np.hypot(m.random_std, m.systematic_std))
        rows = np.isfinite(m.track.refined_speed)
        np.testing.assert_array_equal(rows, np.isfinite(one.track.refined_speed))
        assert np.mean(m.track.refined_speed[rows]) == pytest.approx(m.speed, abs=1e-3)  # of frames at equal intervals
        std, std_alone = m.track.refined_std[rows], one.track.refined_std[rows]
        # two robust estimates, with the rig unknown and known, each by frames or by patches
        assert (std < 1.3 * std_alone).all()
    assert np.sum(np.square(z)) < chi2.ppf(0.999, len(z))


@pytest.mark.slow
def test_a_rejected_vehicle_is_not_combined_and_stays_rejected(two: Clip) -> None:
    """A third outline, whose right corners are not those of the left ones."""
    clip = replace(two, rig=replace(two.rig, uncertainty=KNOWN))
    wrong = replace(clip.vehicles[0], id="v2", right=clip.vehicles[0].right + [5.0, 0.0])
    *good, bad = measure_clip(replace(clip, vehicles=[*clip.vehicles, wrong])).measurements
    assert bad.verdict == "rejected" and bad.reason.startswith("outline") and bad.calibrated_by < 2
    for m, right in zip(good, measure_clip(clip).measurements, strict=True):
        assert (m.speed, m.speed_lo, m.calibrated_by) == (right.speed, right.speed_lo, 2)


@pytest.mark.slow
def test_the_rig_information_belongs_to_the_reported_speed(tmp_path: Path) -> None:
    """With the rig exactly at the vehicle's own estimate, the speed stays and has the uncertainty of a known rig."""
    clip = load_clip(write(render(scene(TWO[0])), tmp_path))
    (m,) = measure_clip(replace(clip, rig=replace(clip.rig, uncertainty=KNOWN))).measurements
    assert m.rig_information is not None
    precision = 1e12 * np.eye(len(m.rig_information.offset))
    right = corrected(m, CanonicalGaussian(precision, precision @ m.rig_information.offset))
    assert right.speed == pytest.approx(m.speed, abs=1e-9)
    assert right.systematic_std < 1e-4 and right.random_std < m.random_std
    assert m.rig_information.half_width > COVERAGE_95 * m.rig_information.mean_speed_std  # of few frames and patches
    assert right.speed_hi - right.speed == pytest.approx(m.rig_information.half_width, rel=1e-3)
    rows = np.isfinite(m.track.refined_std)
    assert (right.track.refined_std[rows] < m.track.refined_std[rows]).all()
    left = np.linalg.inv(np.eye(len(precision)) + m.rig_information.information)
    gradient = m.rig_information.mean_speed_gradient
    alone = np.hypot(m.rig_information.mean_speed_std, np.sqrt(gradient @ left @ gradient))
    assert alone == pytest.approx(np.hypot(m.random_std, m.systematic_std), rel=0.15)  # by another route


@pytest.mark.slow
def test_a_tolerance_applies_after_joint_calibration(two: Clip) -> None:
    clip = replace(two, rig=replace(two.rig, uncertainty=KNOWN))
    halves = [(m.speed_hi - m.speed_lo) / 2 for m in measure_clip(clip).measurements]
    between = float(np.mean(halves))
    verdicts = [m.verdict for m in measure_clip(clip, SpeedConfiguration(tolerance=between)).measurements]
    assert verdicts == ["measured" if half <= between else "rejected" for half in halves]
    assert sorted(verdicts) == ["measured", "rejected"]


def test_the_moments_of_cameras_that_may_be_triggered_together_are_those_of_the_mixture():
    rng, C = np.random.default_rng(8), np.array([[0.5, 0.2, -0.1], [0.2, 0.4, 0.05], [-0.1, 0.05, 0.3]])
    mean, s = np.array([0.3, -0.4, 0.1]), Synchronisation(direction=1, value=0.2, density=0.35)
    precision = np.linalg.inv(C)
    found = moments(CanonicalGaussian(precision, precision @ mean), s)
    odds = norm.pdf(0.2, mean[1], np.sqrt(C[1, 1])) / 0.35
    count = 400_000
    free = rng.multivariate_normal(mean, C, count)
    # given the offset, the others follow by regression
    others = free - np.outer(free[:, 1] - 0.2, C[1] / C[1, 1])
    mixture = np.where(rng.random(count)[:, None] < odds / (1.0 + odds), others, free)
    np.testing.assert_allclose(found[0], mixture.mean(0), atol=5 * np.sqrt(0.5 / count))
    np.testing.assert_allclose(found[1], np.cov(mixture.T), atol=0.01)
    np.testing.assert_allclose(moments(CanonicalGaussian(precision, precision @ mean), None)[1], C)
