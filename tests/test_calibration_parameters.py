"""The model of a calibration: against OpenCV's projection, and its derivatives against differences."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.calibration import parameters
from paceline.calibration.boards import parse_board
from paceline.calibration.parameters import LENS_MODELS, N_RIG, RIG_PARAMETER_NAMES, Observations, Poses, RigState
from paceline.calibration.projection import project
from paceline.simulation import boards

BOARD = parse_board("charuco:7x5:0.08:0.06:DICT_4X4_50")


def setup(seed: int) -> tuple[RigState, Poses, Observations]:
    rng = np.random.default_rng(seed)
    s = boards.random_setup(rng, BOARD, 3, distortion=5)
    s.rig.lenses[:, 4:] = rng.normal(0, [0.2, 0.1, 2e-3, 2e-3, 0.05], (2, 5))
    return s.rig, s.poses, boards.project_board(s.poses, s.rig, BOARD, (10000, 10000))


@pytest.mark.parametrize("seed", range(5))
def test_pixels_are_opencvs(seed: int) -> None:
    rig, poses, seen = setup(seed)
    pixels, _, _ = project(rig, poses, seen)
    stereo = rig.stereo([(1280, 960)] * 2)
    for side, camera in enumerate(stereo.cameras):
        mine = seen.side == side
        R, t = poses.R[seen.view[mine]], poses.t[seen.view[mine]]
        X = np.einsum("mij,mj->mi", R, seen.points[mine]) + t
        X = X if side == 0 else stereo.to_right(X)
        expected, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
        np.testing.assert_allclose(pixels[mine], expected[:, 0], atol=1e-8)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_derivatives_are_those_of_differences(seed: int) -> None:
    rig, poses, seen = setup(seed)
    _, by_rig, by_pose = project(rig, poses, seen)
    h = 1e-6
    for k in range(N_RIG):
        step = np.eye(N_RIG)[k] * h * (1000 if k % 9 < 4 and k < 18 else 1)
        ends = [project(rig.updated(s * step), poses, seen)[0] for s in (1, -1)]
        np.testing.assert_allclose(
            by_rig[..., k], (ends[0] - ends[1]) / (2 * step[k]), rtol=1e-4, atol=2e-3, err_msg=RIG_PARAMETER_NAMES[k]
        )
    for k in range(6):
        step = np.tile(np.eye(6)[k] * h, (len(poses.t), 1))
        ends = [project(rig, poses.updated(s * step), seen)[0] for s in (1, -1)]
        np.testing.assert_allclose(by_pose[..., k], (ends[0] - ends[1]) / (2 * h), rtol=1e-4, atol=2e-3)


@given(st.lists(st.floats(-0.3, 0.3), min_size=N_RIG, max_size=N_RIG), st.integers(0, 50))
@settings(max_examples=30, deadline=None)
def test_a_step_is_found_again_as_the_difference(step: list[float], seed: int) -> None:
    rig, _, _ = setup(seed)
    np.testing.assert_allclose(parameters.parameter_step(rig.updated(np.array(step)), rig), step, atol=1e-9)


def test_richer_lens_models_estimate_more() -> None:
    free = [set(parameters.free_parameters(name).tolist()) for name in LENS_MODELS]
    assert all(a < b for a, b in zip(free, free[1:], strict=False))
    assert [RIG_PARAMETER_NAMES[k] for k in parameters.free_parameters("none")] == [
        n for n in RIG_PARAMETER_NAMES if n.split()[1] not in ("k1", "k2", "p1", "p2", "k3")
    ]
    assert free[-1] == set(range(N_RIG))


def test_a_rig_of_cameras_is_the_same_rig() -> None:
    rig, _, _ = setup(3)
    again = parameters.rig_parameters(rig.stereo([(640, 480), (640, 480)]))
    np.testing.assert_array_equal(parameters.parameter_step(again, rig)[:18], 0)
    np.testing.assert_allclose(parameters.parameter_step(again, rig), 0, atol=1e-12)
