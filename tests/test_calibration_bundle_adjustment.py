"""Bundle adjustment and what it states about itself: against truth, dense algebra and OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from paceline.calibration.boards import parse_board
from paceline.calibration.bundle_adjustment import adjust, rms_by_view
from paceline.calibration.initialization import initial_rig
from paceline.calibration.parameters import N_LENS, Observations, free_parameters, parameter_step
from paceline.calibration.projection import project
from paceline.simulation import boards
from paceline.simulation.boards import CalibrationSetup

BOARD = parse_board("charuco:9x7:0.06:0.045:DICT_5X5_100")
LENS = "k1, k2"
FREE = free_parameters(LENS)
SIGMA = 0.2  # px


def filmed(seed: int, views: int = 10) -> tuple[CalibrationSetup, Observations, Observations]:
    rng = np.random.default_rng(seed)
    setup = boards.random_setup(rng, BOARD, views)
    exact = boards.project_board(setup.poses, setup.rig, BOARD, setup.size)
    return setup, exact, boards.add_noise(rng, exact, SIGMA)


@pytest.mark.parametrize("seed", range(4))
def test_exact_corners_give_the_exact_rig_from_a_rough_start(seed: int) -> None:
    setup, exact, _ = filmed(seed)
    found = adjust(*initial_rig([setup.size] * 2, exact, 10), exact, free_parameters("none"), "redescending")
    found = adjust(found.rig, found.poses, exact, FREE)
    assert np.abs(parameter_step(found.rig, setup.rig)[:4]).max() < 1e-3  # px
    assert np.abs(parameter_step(found.rig, setup.rig)[18:]).max() < 1e-6
    assert np.abs(found.residuals).max() < 1e-4


def test_the_covariance_is_that_of_all_parameters_at_once() -> None:
    """The poses eliminated give the same as the inverse of the whole normal matrix."""
    setup, _, seen = filmed(5, 6)
    found = adjust(setup.rig, setup.poses, seen, FREE)
    _, J, Q = project(found.rig, found.poses, seen)
    P, V = len(FREE), 6
    dense = np.zeros((2 * len(seen.view), P + 6 * V))
    dense[:, :P] = J[..., FREE].reshape(-1, P)
    for m, v in enumerate(seen.view):
        dense[2 * m : 2 * m + 2, P + 6 * v : P + 6 * v + 6] = Q[m]
    w = np.repeat(found.weights, 2)[:, None]
    expected = np.linalg.inv((dense * w).T @ dense)[:P, :P] * max(found.sigma**2, found.cluster_variance)
    C = found.covariance[np.ix_(FREE, FREE)]
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(C / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6)
    held = np.setdiff1d(np.arange(24), FREE)
    assert not found.covariance[held].any()


def test_it_agrees_with_opencv() -> None:
    """cv2.stereoCalibrate minimises the same sum, where every corner counts alike."""
    setup, _, seen = filmed(7, 12)
    found = adjust(setup.rig, setup.poses, seen, FREE)
    ids = [{side: seen.select((seen.view == v) & (seen.side == side)) for side in (0, 1)} for v in range(12)]
    objects, left, right = [], [], []
    for pair in ids:  # OpenCV wants the same corners on both sides
        a, b = ([tuple(p) for p in pair[side].points] for side in (0, 1))
        common = [p for p in a if p in b]
        objects.append(np.array(common, np.float32))
        left.append(np.array([pair[0].pixels[a.index(p)] for p in common], np.float32))
        right.append(np.array([pair[1].pixels[b.index(p)] for p in common], np.float32))
    lenses = [lens.copy() for lens in setup.rig.lenses]
    K = [np.array([[f, 0, cx], [0, g, cy], [0, 0, 1]]) for f, g, cx, cy in (lens[:4] for lens in lenses)]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    D = [lens[4:].copy() for lens in lenses]
    _, K1, _, K2, _, R, t, *_ = cv2.stereoCalibrate(
        objects, left, right, K[0], D[0], K[1], D[1], setup.size, flags=flags, criteria=criteria
    )
    std = np.sqrt(np.diag(found.covariance))
    theirs = np.array([K1[0, 0], K1[1, 1], K1[0, 2], K1[1, 2]]), np.array([K2[0, 0], K2[1, 1], K2[0, 2], K2[1, 2]])
    for side in (0, 1):  # nearly the same corners, so the same up to a fraction of their uncertainty
        gap = (found.rig.lenses[side, :4] - theirs[side]) / std[N_LENS * side : N_LENS * side + 4]
        assert np.abs(gap).max() < 1.0
    assert np.abs(found.rig.t - t.ravel()).max() < std[21:].max()
    assert np.linalg.norm(cv2.Rodrigues(found.rig.R @ R.T)[0]) < np.linalg.norm(std[18:21])


def test_stated_uncertainties_are_those_that_errors_have() -> None:
    """Over many draws of the noise, each parameter's error has the size that the covariance says."""
    setup, exact, _ = filmed(11)
    z = []
    for seed in range(60):
        seen = boards.add_noise(np.random.default_rng(1000 + seed), exact, SIGMA)
        found = adjust(setup.rig, setup.poses, seen, FREE)
        z.append(parameter_step(found.rig, setup.rig)[FREE] / np.sqrt(np.diag(found.covariance))[FREE])
    spread = np.sqrt((np.array(z) ** 2).mean(0))
    # a sum of 60 squares: its root stays within 0.70 and 1.32 of 1 at a chance of 1e-4 on each side
    assert spread.max() < 1.32
    assert spread.min() > 0.65  # the wider of two estimates is a little wide
    covered = (np.abs(z) < 1.96).mean()
    assert covered > 0.93


def test_errors_common_to_a_view_widen_the_covariance() -> None:
    setup, exact, _ = filmed(13, 14)
    rng = np.random.default_rng(0)
    # each view's corners drawn towards one side of it, as by a board that is bent
    stretch = rng.normal(0, 0.002, (14, 2, 2))[exact.view, exact.side]
    middle = np.stack([exact.pixels[(exact.view == v) & (exact.side == s)].mean(0) for v in range(14) for s in (0, 1)])
    from_middle = exact.pixels - middle[2 * exact.view + exact.side]
    bent = Observations(exact.view, exact.side, exact.points, exact.pixels + stretch * from_middle)
    found = adjust(setup.rig, setup.poses, boards.add_noise(rng, bent, 0.05), FREE)
    assert found.cluster_variance > 2 * found.sigma**2
    even = adjust(setup.rig, setup.poses, boards.add_noise(rng, exact, 0.05), FREE)
    assert even.cluster_variance < 2 * even.sigma**2


def test_sigma_is_the_noise() -> None:
    _, _, seen = filmed(17, 14)
    setup, _, _ = filmed(17, 14)
    found = adjust(setup.rig, setup.poses, seen, FREE)
    assert found.sigma == pytest.approx(SIGMA, rel=4 / np.sqrt(2 * 2 * len(seen.view)) + 0.02)


def test_single_gross_corners_hardly_matter() -> None:
    setup, _, seen = filmed(19)
    clean = adjust(setup.rig, setup.poses, seen, FREE)
    pixels = seen.pixels.copy()
    pixels[::97] += 15
    found = adjust(setup.rig, setup.poses, Observations(seen.view, seen.side, seen.points, pixels), FREE)
    std = np.sqrt(np.diag(clean.covariance))[FREE]
    assert np.abs(parameter_step(found.rig, clean.rig)[FREE] / std).max() < 2.5


def test_with_no_free_parameters_only_the_poses_move() -> None:
    setup, exact, _ = filmed(23)
    rng = np.random.default_rng(1)
    away = setup.poses.updated(rng.normal(0, 0.01, (10, 6)))
    found = adjust(setup.rig, away, exact, np.empty(0, np.int64))
    np.testing.assert_allclose(found.poses.t, setup.poses.t, atol=1e-6)
    np.testing.assert_allclose(parameter_step(found.rig, setup.rig), 0, atol=1e-12)


def test_errors_by_view() -> None:
    residuals = np.array([[3.0, 4.0], [0.0, 0.0], [1.0, 1.0]])
    np.testing.assert_allclose(rms_by_view(residuals, np.array([0, 0, 2]), 3), [2.5, np.nan, 1.0])
