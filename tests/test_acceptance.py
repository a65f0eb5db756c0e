"""Acceptance tests of a refined motion."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import f, norm

from paceline.speed.acceptance import (
    MAX_DEVIATION_SIGMA,
    MIN_TRACK_CONTRAST_GREY,
    apply_tolerance,
    check_interval,
    check_motion,
    check_outline,
    check_refined,
    check_residuals,
    consistent_frames,
    frames_before_occlusion,
    frames_to_refit,
)
from paceline.speed.configuration import DEFAULT_LIMITS
from paceline.speed.refinement.model_selection import RefinedMotion
from paceline.speed.refinement.trajectory import Prior, Trajectory
from paceline.speed.results import Measurement, Track

Array = NDArray[np.float64]
OUTLINE = np.array([[100.0, 100.0], [160.0, 100.0], [160.0, 130.0], [100.0, 130.0]])


def refined(explained: list[float], off: float = 0.0, converged: bool = True) -> RefinedMotion:
    """A motion with the ``explained`` share of each frame, all images ``off`` px to the right of it."""
    both = np.repeat(np.array(explained)[:, None], 2, axis=1)
    offsets = np.where(np.isnan(both)[..., None], np.nan, [off, 0.0])
    trajectory = cast(Trajectory, None)  # not used
    theta, covariances, shifts = np.zeros(1), [np.zeros((1, 1))] * 4, np.zeros(3)
    fit = 1.0, 10.0, 1.0, offsets, both, (), cast(Prior, None), 0.0, 9.0, np.inf, converged
    return RefinedMotion(trajectory, shifts, theta, *covariances, None, *fit)


def moving_with(right: Array) -> RefinedMotion:
    """A motion whose outline in the first right view is ``right`` (4, 2)."""
    moved = SimpleNamespace(quads=lambda theta: np.stack([[right - 30.0, right]]))
    return replace(refined([0.9] * 10), trajectory=cast(Trajectory, moved))


def test_a_frame_is_consistent_where_all_views_that_were_used_fit() -> None:
    enough = 1.0 - DEFAULT_LIMITS.unexplained_contrast**2
    r = refined([0.99, enough + 1e-6, enough - 1e-6, np.nan, 0.99])
    r.explained_share[4, 1] = 0.0  # one view shows something else
    r.explained_share[0, 0] = np.nan  # and one was not used
    assert consistent_frames(r).tolist() == [True, True, False, False, False]
    assert consistent_frames(refined([0.99] * 3, off=1.01 * DEFAULT_LIMITS.image_offset_px)).tolist() == [False] * 3


@pytest.mark.parametrize(
    ("consistent", "frames", "reason"),
    [(10, 10, ""), (5, 10, ""), (4, 10, "residuals: only 4 of 10 frames"), (3, 5, "residuals: only 3 of 5 frames")],
)
def test_half_of_the_frames_have_to_be_consistent_and_four_of_them(consistent: int, frames: int, reason: str) -> None:
    reason_found = check_residuals(refined([0.9] * consistent + [0.1] * (frames - consistent)))
    assert reason_found.startswith(reason) and bool(reason_found) == bool(reason)


def test_a_track_is_cut_at_an_occlusion_and_halved_where_no_motion_fits() -> None:
    seen, hidden = [0.9], [0.1]
    assert frames_to_refit(refined(20 * seen)) == 20
    assert frames_to_refit(refined(17 * seen + 3 * hidden)) == 17
    assert frames_to_refit(refined(5 * seen + 15 * hidden, converged=False)) == 5
    assert frames_to_refit(refined(20 * hidden)) == 10
    assert frames_to_refit(refined(20 * seen, converged=False)) == 10
    assert frames_to_refit(refined(3 * seen + 17 * hidden)) == 10  # too few to be measured by themselves
    assert DEFAULT_LIMITS.min_frames == 4


@pytest.mark.parametrize("click_noise", [0.5, 5.0])  # px
def test_a_right_motion_is_seldom_rejected_by_the_outline(click_noise: float) -> None:
    """A large click noise shows in the scatter of the corners: then it is an F test with 2 and 6 degrees of freedom."""
    drawn = OUTLINE + np.random.default_rng(1).normal(0, click_noise * np.sqrt(2.0), (20_000, 4, 2))  # of both outlines
    off = np.mean([check_outline(moving_with(OUTLINE), one, 0.5) != "" for one in drawn])
    chi2 = DEFAULT_LIMITS.outline_sigma**2
    expected = np.exp(-0.5 * chi2) if click_noise == 0.5 else f.sf(0.5 * chi2, 2, 6)
    assert off == pytest.approx(expected, abs=4 * np.sqrt(expected / len(drawn)) + 1e-4)


def test_a_motion_off_the_outline_in_the_other_view_is_rejected() -> None:
    assert check_outline(moving_with(OUTLINE), OUTLINE + [1.7, 0.0], 0.5) == ""
    reason = check_outline(moving_with(OUTLINE), OUTLINE + [0.0, -3.0], 0.5)
    assert reason == "outline: the tracked region lies 3.0 px off the right outline (limit 1.8)"
    assert reason.code == "outline_inconsistent"
    assert check_outline(moving_with(OUTLINE), OUTLINE + [3.0, 0.0], 1.0) == ""


@pytest.mark.parametrize(("hidden", "reason"), [(1, ""), (2, "residuals: none of the first 2 frames")])
def test_a_motion_inconsistent_in_the_first_frames_is_rejected(hidden: int, reason: str) -> None:
    """An occluder that was followed for longer than the vehicle."""
    r = refined([0.1] * hidden + [0.9] * 20)
    assert check_residuals(r).startswith(reason) and bool(check_residuals(r)) == bool(reason)
    assert frames_to_refit(r) == (10 + hidden // 2 if reason else 20 + hidden)


@given(along=st.floats(-20.0, 20.0), across=st.floats(0.0, 20.0), std=st.floats(0.01, 5.0), frame=st.integers(0, 8))
def test_a_motion_is_rejected_where_no_vehicle_makes_it_with_95_percent_certainty(
    along: float, across: float, std: float, frame: int
) -> None:
    mean = np.zeros((9, 2))
    mean[frame] = along, across
    moved = cast(RefinedMotion, SimpleNamespace(accelerations=lambda: (mean, np.full((9, 2), std))))
    beyond = [norm.cdf(v / std) for v in (-along - 9.0, along - 6.0, across - 9.81)]
    if abs(max(beyond) - 0.95) > 1e-3:
        assert (check_motion(moved).code == "motion_implausible") == (max(beyond) > 0.95)


def test_accelerations_have_the_uncertainty_of_the_parameters() -> None:
    """Of linear ones it is that of the parameters."""
    by_parameter = np.random.default_rng(5).normal(size=(2, 4, 2))
    linear = SimpleNamespace(steps=np.array([1e-3, 1e-4]), accelerations=lambda t: np.tensordot(t, by_parameter, 1))
    covariance = np.array([[0.2, 0.1], [0.1, 0.5]])
    r = replace(
        refined([0.9] * 5),
        trajectory=cast(Trajectory, linear),
        theta=np.array([3.0, -1.0]),
        covariance=covariance,
        model_covariance=np.zeros((2, 2)),
        systematic_covariance=np.full((2, 2), np.nan),
    )
    mean, std = r.accelerations()
    np.testing.assert_allclose(mean, 3.0 * by_parameter[0] - by_parameter[1])
    np.testing.assert_allclose(std**2, np.einsum("nfa,nm,mfa->fa", by_parameter, covariance, by_parameter))


@pytest.mark.parametrize(
    ("deviation_sigma", "contrast", "code"),
    [
        (6.4, 2.6, "path_deviation_implausible"),
        (MAX_DEVIATION_SIGMA, 2.6, ""),
        (6.4, MIN_TRACK_CONTRAST_GREY, ""),  # a crest or a tight turn, with enough contrast
    ],
)
def test_an_implausible_path_at_low_contrast_is_rejected(deviation_sigma: float, contrast: float, code: str) -> None:
    """A lorry front of 2.6 grey levels was followed pixels aside from where it was, and read 6 % too fast."""
    r = replace(refined([0.9] * 10), deviation_sigma=deviation_sigma, contrast=contrast, residual_rms=0.3)
    reason = check_refined(r, 7.0, 0.2)
    assert reason.code == code
    if reason:
        assert reason.startswith("implausible: ") and "6.4 σ" in reason and "(limit 3)" in reason
        assert "2.6 grey levels (at least 5 needed" in reason


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_frames_are_kept_as_long_as_most_are_consistent(consistent: list[bool]) -> None:
    kept = frames_before_occlusion(np.array(consistent))
    tails = [consistent[kept:end] for end in range(kept + 1, len(consistent) + 1)]
    assert all(sum(tail) < len(tail) / 2 for tail in tails)  # after it most frames are inconsistent
    heads = [consistent[start:kept] for start in range(1, kept)]
    assert all(sum(head) >= len(head) / 2 for head in heads)  # before it most are consistent


@pytest.mark.parametrize(
    ("speed", "half", "own", "reason"),
    [
        (20.0, 1.19, 0.79, ""),
        (20.0, 1.21, 0.0, "± 6.0% of the speed (limit 6.0%)"),
        (20.0, 1.0, 0.81, "± 4.0% of the speed without the calibration's part (limit 4.0%)"),
        (4.0, 0.27, 0.18, ""),
        (4.0, 0.28, 0.0, "± 7.0% of the speed (limit 6.9%)"),
        (4.0, 0.2, 0.19, "± 4.8% of the speed without the calibration's part (limit 4.6%)"),
        (0.1, 0.6, 0.0, "the speed is not known: ± 0.6 m/s about 0.1 m/s (limit 0.28 m/s)"),
    ],
)
def test_how_wide_an_interval_may_be(speed: float, half: float, own: float, reason: str) -> None:
    assert check_interval(speed, half, own) == (f"interval too wide: {reason}" if reason else "")


def test_a_tolerance_rejects_what_is_known_less_well_and_nothing_else() -> None:
    nan = float("nan")
    good = Measurement("v0", cast(Track, None), 20.0, 19.7, 20.3, 0.15, nan, 9, "measured", "", "constant speed")
    assert apply_tolerance(good, None) is good and apply_tolerance(good, 0.31) is good
    refused = apply_tolerance(good, 0.2)
    assert (refused.verdict, refused.reason_code) == ("rejected", "tolerance_exceeded")
    assert refused.reason == "interval too wide: ± 0.3 m/s, 1.50 times the tolerance (limit 0.2 m/s)"
    assert (refused.speed, refused.speed_lo, refused.speed_hi) == (20.0, 19.7, 20.3)
    bad = replace(good, speed=nan, speed_lo=nan, speed_hi=nan, verdict="rejected", reason="lost")
    assert apply_tolerance(bad, 0.2) is bad
