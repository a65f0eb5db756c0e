"""One rig, many vehicles: against one joint solution for all of them, and end to end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2
from small_road import TWO, scene

from paceline.cameras import RigUncertainty, moved_rig
from paceline.documents import load_clip
from paceline.simulation.planar import render, write
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.measurement import measure_clip
from paceline.speed.results import Measurement, RigTold, Track
from paceline.speed.shared_rig import (
    CONTRADICTED,
    UNTOLD,
    Belief,
    after,
    agreed,
    contradiction,
    put_right,
    stated,
    together,
)

Array = NDArray[np.float64]
N, Q = 3, 4  # parameters of a motion and moves of the rig, in the linear models here
USUAL = 1.959963984540054
FAST = 200.0  # m/s, about: of that no interval here is too wide


@dataclass(frozen=True)
class Pictures:
    """Pixels that depend linearly on a motion (N,) and on the rig (Q,), with noise of 1."""

    J: Array
    y: Array

    def alone(self, speed: float = FAST) -> Measurement:
        """The vehicle's own least squares, the rig under its prior. The mean speed is the sum of the motion's
        parameters, that of each of two frames is the first of them and the second."""
        A = self.J.T @ self.J + np.diag([*np.zeros(N), *np.ones(Q)])
        found, left = np.linalg.solve(A, self.J.T @ self.y), np.linalg.inv(A)
        motion = self.J[:, :N].T @ self.J[:, :N]
        response = -np.linalg.solve(motion, self.J[:, :N].T @ self.J[:, N:])
        given_rig, mean, frames = np.linalg.inv(motion), np.ones(N), np.eye(N)[:2]
        told = RigTold(
            moves=np.asarray(found[N:], float),
            information=np.linalg.inv(left[N:, N:]) - np.eye(Q),
            speed=mean @ response,
            std=float(np.sqrt(mean @ given_rig @ mean)),
            half=USUAL * float(np.sqrt(mean @ given_rig @ mean)),
            speeds=frames @ response,
            stds=np.sqrt(np.diag(frames @ given_rig @ frames.T)),
        )
        std = float(np.sqrt(mean @ left[:N, :N] @ mean))
        speeds = speed + found[:2]
        stds = np.sqrt(np.diag(left)[:2])
        track = SimpleTrack(np.array([0.0, 0.5]), np.asarray(speeds, float), stds)
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
            rig=told,
        )


@dataclass(frozen=True)
class SimpleTrack:
    time: Array
    refined_speed: Array
    refined_std: Array


def pictures(rng: np.random.Generator, rig: Array, pixels: int = 12) -> Pictures:
    J = rng.standard_normal((pixels, N + Q)) * np.array([*np.ones(N), 2.0, 1.0, 0.3, 0.01])
    truth = np.concatenate([rng.standard_normal(N), rig])
    return Pictures(J, J @ truth + rng.standard_normal(pixels))


def several(seed: int, count: int) -> list[Pictures]:
    rng = np.random.default_rng(seed)
    rig = rng.standard_normal(Q)
    return [pictures(rng, rig) for _ in range(count)]


@given(seed=st.integers(0, 10_000), count=st.integers(2, 6))
def test_it_is_what_one_solution_for_all_gives(seed: int, count: int) -> None:
    """All motions and the rig at once, in one least squares."""
    vehicles = several(seed, count)
    J = np.zeros((sum(len(v.y) for v in vehicles), count * N + Q))
    row = 0
    for k, v in enumerate(vehicles):
        J[row : row + len(v.y), k * N : (k + 1) * N] = v.J[:, :N]
        J[row : row + len(v.y), count * N :] = v.J[:, N:]
        row += len(v.y)
    A = J.T @ J + np.diag([*np.zeros(count * N), *np.ones(Q)])
    joint, left = np.linalg.solve(A, J.T @ np.concatenate([v.y for v in vehicles])), np.linalg.inv(A)

    alone = [v.alone() for v in vehicles]
    told = [m.rig for m in alone if m.rig is not None]
    belief = reduce(Belief.taking, told, stated(Q))
    if max(contradiction(t, belief.taking(t, -1.0)) for t in told) <= CONTRADICTED:  # but for one draw in 100,000
        agree_on, agree = agreed(told)
        assert agree.all() and (agree_on.precision == belief.precision).all()
    np.testing.assert_allclose(belief.mean, joint[count * N :], atol=1e-8)
    np.testing.assert_allclose(belief.covariance, left[count * N :, count * N :], atol=1e-8)
    for k, m in enumerate(put_right(m, belief) for m in alone):
        part = slice(k * N, (k + 1) * N)
        assert m.speed == pytest.approx(FAST + joint[part].sum(), abs=1e-8)
        variance = left[part, part].sum()
        assert m.random_std**2 + m.systematic_std**2 == pytest.approx(variance, rel=1e-8)
        assert m.speed_hi - m.speed == pytest.approx(USUAL * np.sqrt(variance), rel=1e-8)
        np.testing.assert_allclose(m.track.refined_speed, FAST + joint[part][:2], atol=1e-8)
        np.testing.assert_allclose(m.track.refined_std, np.sqrt(np.diag(left)[part][:2]), rtol=1e-8)
        assert m.acceleration == pytest.approx((joint[part][1] - joint[part][0]) / 0.5, abs=1e-7)


def test_a_contradiction_is_a_standard_deviation_of_what_chance_makes() -> None:
    """Over many draws of rig and pictures the largest of a vehicle's pulls is that of as many normal numbers."""
    pulls, directions = [], []
    for seed in range(300):
        *others, one = [v.alone().rig for v in several(seed, 4)]
        assert one is not None
        belief = reduce(Belief.taking, (other for other in others if other is not None), stated(Q))
        pulls.append(contradiction(one, belief))
        root = np.linalg.cholesky(belief.covariance)
        information = np.linalg.eigvalsh(root.T @ one.information @ root)
        directions.append((information / (1 + information) > UNTOLD).sum())
    beyond = 2.0
    expected = 1.0 - 0.9545 ** np.array(directions)
    found = np.mean(np.array(pulls) > beyond)
    assert abs(found - expected.mean()) < 4 * np.sqrt(expected.mean() / len(pulls))


def wants_elsewhere(v: Pictures, by: float) -> Pictures:
    """The same pictures, of a rig that is elsewhere in the direction of which they tell most."""
    return replace(v, y=v.y + v.J[:, N:] @ np.array([by, 0.0, 0.0, 0.0]))


def test_the_one_that_contradicts_all_others_is_left_out_and_rejected() -> None:
    vehicles = several(5, 5)
    good = [v.alone() for v in vehicles]
    bad = wants_elsewhere(vehicles[2], 20.0).alone()
    measured, expected = together([*good[:2], bad, *good[3:]]), together([*good[:2], *good[3:]])
    assert [m.calibrated_by for m in measured] == [4, 4, 1, 4, 4]
    assert [m.verdict for m in measured] == ["measured", "measured", "rejected", "measured", "measured"]
    assert measured[2].reason.startswith("calibration") and measured[2].speed == bad.speed
    for m, right in zip([*measured[:2], *measured[3:]], expected, strict=True):
        assert m.speed == pytest.approx(right.speed, abs=1e-9)
    told = [m.rig for m in good[:2] + good[3:] if m.rig is not None]
    assert after(bad, told).verdict == "rejected"
    assert after(good[2], told).verdict == "measured"


def test_of_two_that_contradict_each_other_nobody_says_which_is_right() -> None:
    vehicles = several(6, 2)
    two = [vehicles[0].alone(), wants_elsewhere(vehicles[1], 20.0).alone()]
    told = [m.rig for m in two if m.rig is not None]
    assert contradiction(told[0], stated(Q).taking(told[1])) > CONTRADICTED
    assert together(two) == two
    assert after(two[1], told[:1]) is two[1]


def test_one_alone_and_those_that_tell_nothing_stay_as_they_are() -> None:
    one = several(7, 1)[0].alone()
    silent = replace(one, rig=None)
    assert together([]) == []
    assert together([silent, one, silent]) == [silent, one, silent]
    assert after(silent, [one.rig] if one.rig else []) is silent and after(one, []) is one


def test_what_was_too_wide_alone_may_be_known_well_enough_together() -> None:
    alone = [v.alone() for v in several(8, 8)]
    wide = replace(alone[0], verdict="rejected", reason="interval too wide: ± 9.0% of the speed")
    mended, *_ = together([wide, *alone[1:]])
    assert (mended.verdict, mended.reason) == ("measured", "")
    assert wide.rig is not None
    unsure = replace(wide, rig=replace(wide.rig, half=0.05 * FAST, std=0.025 * FAST))
    still, *_ = together([unsure, *alone[1:]])
    assert still.verdict == "rejected" and "without the calibration's part" in still.reason


KNOWN = RigUncertainty(1.0, 0.0, (4e-5, 4e-5, 4e-5), (3e-4, 3e-4, 3e-4))


def test_vehicles_of_one_clip_put_each_other_right(tmp_path: Path) -> None:
    """End to end, with a rig that is off by what it states."""
    clip = load_clip(write(render(scene(*TWO)), tmp_path))
    move = np.random.default_rng(3).standard_normal(14) @ KNOWN.moves
    clip = replace(clip, rig=replace(moved_rig(clip.rig, move), uncertainty=KNOWN))
    alone = [measure_clip(replace(clip, vehicles=[v])).measurements[0] for v in clip.vehicles]
    result = measure_clip(clip)
    assert [m.calibrated_by for m in result.measurements] == [2, 2] and result.notices == []
    z = []
    for one, m, vehicle in zip(alone, result.measurements, TWO, strict=True):
        assert one.verdict == m.verdict == "measured" and m.vehicle == vehicle.id
        assert m.speed_hi - m.speed_lo < one.speed_hi - one.speed_lo
        assert m.speed_lo < m.speed < m.speed_hi
        z.append((m.speed - vehicle.speed) / np.hypot(m.random_std, m.systematic_std))
        rows = np.isfinite(m.track.refined_speed)
        np.testing.assert_array_equal(rows, np.isfinite(one.track.refined_speed))
        assert np.mean(m.track.refined_speed[rows]) == pytest.approx(m.speed, abs=1e-3)  # of frames at equal intervals
        assert (m.track.refined_std[rows] <= one.track.refined_std[rows]).all()
    assert np.sum(np.square(z)) < chi2.ppf(0.999, len(z))


def test_a_tolerance_is_asked_of_what_was_put_right(tmp_path: Path) -> None:
    clip = load_clip(write(render(scene(*TWO)), tmp_path))
    clip = replace(clip, rig=replace(clip.rig, uncertainty=KNOWN))
    halves = [(m.speed_hi - m.speed_lo) / 2 for m in measure_clip(clip).measurements]
    between = float(np.mean(halves))
    verdicts = [m.verdict for m in measure_clip(clip, SpeedConfiguration(tolerance=between)).measurements]
    assert verdicts == ["measured" if half <= between else "rejected" for half in halves]
    assert sorted(verdicts) == ["measured", "rejected"]
