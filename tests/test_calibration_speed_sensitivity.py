"""What a calibration's uncertainty does to speeds: by differences, by random draws through the whole lens model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from paceline.calibration import speed_sensitivity
from paceline.calibration.bundle_adjustment import adjust
from paceline.calibration.parameters import POSE_SLICE, RigState, free_parameters, lens_camera
from paceline.cameras import Camera, RigUncertainty, StereoRig, perturbed_rig, perturbed_rigs
from paceline.documents.loading import load_rig
from paceline.documents.rig_yaml import rig_yaml
from paceline.errors import UnusableInput
from paceline.geometry import triangulate
from paceline.simulation import boards

BOARD = boards.Board(9, 7, 0.06, 0.045, "DICT_5X5_100")
SIZES = ((1280, 960), (1280, 960))


def calibrated(seed: int) -> tuple[RigState, np.ndarray]:
    rng = np.random.default_rng(seed)
    setup = boards.random_setup(rng, BOARD, 15)
    exact = boards.project_board(setup.poses, setup.rig, BOARD, setup.size)
    found = adjust(setup.rig, setup.poses, boards.add_noise(rng, exact, 0.1), free_parameters("k1, k2"))
    return found.rig, found.covariance


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_speeds_vary_as_stated_when_the_whole_lens_varies(seed: int) -> None:
    """Draws of all 24 parameters, corners through the distorted lenses, against the 14 of rig.yaml to first order."""
    model, covariance = calibrated(seed)
    stereo = model.stereo(SIZES)
    pinhole = speed_sensitivity.pinhole_covariance(model, covariance, SIZES)
    rig = StereoRig(stereo.left, stereo.right, stereo.R, stereo.t, RigUncertainty(covariance=pinhole))
    effects = speed_sensitivity.speed_effects(rig)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))
    rng = np.random.default_rng(seed)
    for effect in effects:
        ends = effect.distance * rig.left.rays(rig.left.K[:2, 2]) + np.array([[0, 0, -5.0], [0, 0, 5.0]])
        raw = []
        for camera, X in zip(rig.cameras, (ends, rig.to_right(ends)), strict=True):
            raw.append(cv2.projectPoints(X, np.zeros(3), np.zeros(3), camera.K, camera.distortion)[0][:, 0])
        drawn = []
        for _ in range(200):
            other = model.updated(root @ rng.normal(size=24)).stereo(SIZES)
            seen = [camera.undistort_points(p) for camera, p in zip(other.cameras, raw, strict=True)]
            found = triangulate(other, *seen)
            drawn.append(np.linalg.norm(found[1] - found[0]) / 10 - 1)
        # 200 draws know a standard deviation to ± 5 % (one sigma); the pinhole is a fit, a little wide at the centre
        assert 0.85 < effect.along / np.std(drawn) < 1.4


@pytest.mark.parametrize("seed", [4, 5])
def test_the_nearest_pinhole_by_differences_is_that_of_large_changes(seed: int) -> None:
    model, _ = calibrated(seed)
    lens = model.lenses[0]
    D = speed_sensitivity.equivalent_pinhole(lens, SIZES[0])
    np.testing.assert_allclose(D[:, :4], np.eye(4), atol=0.05)  # a pinhole's own parameters are themselves, nearly
    changed = lens.copy()
    changed[4] += 0.004
    true, file = lens_camera(changed, SIZES[0]), lens_camera(lens, SIZES[0])
    u = 640 + np.linspace(-380, 380, 21)
    pixels = np.stack(np.meshgrid(u, u * 0.75), -1).reshape(-1, 2)
    rays = true.rays(true.undistort_points(pixels))
    ideal = file.undistort_points(pixels)
    slope, offset = np.polyfit(rays[:, 0], ideal[:, 0], 1)
    assert slope - lens[0] == pytest.approx(0.004 * D[0, 4], rel=0.15)
    assert offset - lens[2] == pytest.approx(0.004 * D[2, 4], abs=0.15 * abs(0.004 * D[0, 4]))


def test_the_four_keys_make_no_speed_surer_than_the_covariance() -> None:
    for seed in (6, 7):
        model, covariance = calibrated(seed)
        rig = model.stereo(SIZES)
        stated = speed_sensitivity.stated_uncertainty(
            rig, speed_sensitivity.pinhole_covariance(model, covariance, SIZES)
        )
        keys = RigUncertainty(
            stated.focal_length_px, stated.principal_point_px, stated.rotation_rad, stated.translation_m
        )
        for distance in speed_sensitivity.DISTANCES_M:
            for across in speed_sensitivity.LATERAL_SHARES:
                for way in speed_sensitivity._displacements(rig, distance, across):
                    exact, simple = (
                        np.linalg.norm(
                            [speed_sensitivity.relative_speed_change(rig, m, *way) for m in perturbed_rigs(rig, u)]
                        )
                        for u in (stated, keys)
                    )
                    assert simple > 0.999 * exact
        central = speed_sensitivity.speed_effects(StereoRig(rig.left, rig.right, rig.R, rig.t, keys))
        sharp = speed_sensitivity.speed_effects(StereoRig(rig.left, rig.right, rig.R, rig.t, stated))
        assert central[1].along < 4 * sharp[1].along  # nor uselessly unsure


def test_moves_are_a_root_of_the_covariance(rig: StereoRig) -> None:
    rng = np.random.default_rng(0)
    scale = np.array([1.0] * 8 + [1e-5] * 3 + [1e-4] * 3)
    root = rng.normal(size=(14, 14)) * scale[:, None]
    C = root @ root.T
    U = RigUncertainty(covariance=C).covariance_root
    np.testing.assert_allclose((U.T @ U) / np.outer(scale, scale), C / np.outer(scale, scale), rtol=1e-9, atol=1e-9)


def test_independent_uncertainties_move_one_parameter_each(rig: StereoRig) -> None:
    u = RigUncertainty(1.5, 0.4, (1e-5, 2e-5, 3e-5), (1e-4, 2e-4, 3e-4))
    moves = perturbed_rigs(rig, u)
    assert len(moves) == 14
    for side, first in (("left", 0), ("right", 4)):
        for k, (at, size) in enumerate((((0, 0), 1.5), ((1, 1), 1.5), ((0, 2), 0.4), ((1, 2), 0.4))):
            change = np.zeros((3, 3))
            change[at] = size
            moved, other = (getattr(moves[first + k], s) for s in (side, "left" if side == "right" else "right"))
            np.testing.assert_allclose(moved.K - getattr(rig, side).K, change, atol=1e-9)
            np.testing.assert_array_equal(other.K, getattr(rig, "left" if side == "right" else "right").K)
    for axis in range(3):
        turn = cv2.Rodrigues(np.eye(3)[axis] * u.rotation_rad[axis])[0]
        np.testing.assert_allclose(moves[8 + axis].R, turn @ rig.R, atol=1e-12)
        np.testing.assert_allclose(moves[8 + axis].t, turn @ rig.t, atol=1e-12)
        np.testing.assert_allclose(moves[11 + axis].t - rig.t, np.eye(3)[axis] * u.translation_m[axis], atol=1e-12)


def test_a_rotation_step_turns_the_right_camera_in_place(rig: StereoRig) -> None:
    move = np.zeros(14)
    move[8:11] = 1e-3, -2e-3, 5e-4
    other = perturbed_rig(rig, move)
    np.testing.assert_allclose(-other.t @ other.R, -rig.t @ rig.R, atol=1e-12)
    np.testing.assert_allclose(cv2.Rodrigues(other.R @ rig.R.T)[0].ravel(), move[8:11], atol=1e-12)


def test_a_wider_baseline_makes_speeds_surer() -> None:
    camera = Camera((1280, 960), np.array([[2000.0, 0, 640], [0, 2000, 480], [0, 0, 1]]))
    u = RigUncertainty(rotation_rad=(0, 2e-5, 0))
    narrow, wide = (
        speed_sensitivity.speed_effects(StereoRig(camera, camera, np.eye(3), np.array([-b, 0, 0]), u))
        for b in (0.4, 0.8)
    )
    for a, b in zip(narrow, wide, strict=True):
        assert a.along == pytest.approx(2 * b.along, rel=0.01)
        assert a.along == pytest.approx(2 * a.distance * 2e-5 / 0.4, rel=0.02)  # 2 Z δω / b


def test_the_pose_is_last() -> None:
    assert range(24)[POSE_SLICE] == range(18, 24)


# --- rig.yaml ------------------------------------------------------------------------------------------------------


def test_a_rig_is_read_as_it_was_written(rig: StereoRig, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    scale = np.array([1.0] * 8 + [1e-5] * 3 + [1e-4] * 3)
    root = rng.normal(size=(14, 14)) * scale[:, None]
    lens = Camera(rig.left.image_size, rig.left.K, np.array([-0.2, 0.1, 1e-7, -1e-12, 0]))
    stated = RigUncertainty(0.5, 0.0, (1e-5, 2e-5, 3e-5), (1e-4, 2e-4, 3e-4), root @ root.T)
    written = StereoRig(lens, rig.right, rig.R, rig.t, stated)
    (tmp_path / "rig.yaml").write_text(rig_yaml(written, ["a comment"]))
    found = load_rig(tmp_path / "rig.yaml")
    np.testing.assert_allclose(found.left.distortion, lens.distortion, rtol=1e-8)
    np.testing.assert_allclose(found.right.K, rig.right.K, rtol=1e-9)
    np.testing.assert_allclose(found.R, rig.R, atol=1e-10)
    assert found.uncertainty == stated
    assert found.uncertainty.covariance is not None
    np.testing.assert_allclose(found.uncertainty.covariance, stated.covariance, rtol=1e-8)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda C: C[:13], "expected 14 rows of 14 numbers"),
        (lambda C: [*C[:13], C[13][:13]], "expected 14 rows of 14 numbers"),
        (lambda C: [[-1.0, *C[0][1:]], *C[1:]], "symmetric matrix without negative variances"),
        (lambda C: [[C[0][0], 0.9, *C[0][2:]], *C[1:]], "symmetric matrix"),
        (lambda C: [[1.0, 2.0, *C[0][2:]], [2.0, 1.0, *C[1][2:]], *C[2:]], "a negative variance"),
        (lambda C: [["one", *C[0][1:]], *C[1:]], "expected finite numbers"),
    ],
)
def test_what_is_no_covariance_is_refused(
    rig: StereoRig, tmp_path: Path, spoil: Callable[[list[list[float]]], object], said: str
) -> None:
    document = yaml.safe_load(rig_yaml(rig))
    document["uncertainty"] = {"covariance": spoil(np.eye(14).tolist())}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(UnusableInput, match=said) as refused:
        load_rig(tmp_path / "rig.yaml")
    assert "uncertainty.covariance" in str(refused.value)
