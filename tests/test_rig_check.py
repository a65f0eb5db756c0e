"""Whether a rig stands as it was calibrated: from points that are known, and on pictures."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from printed_intervals import rows_with_intervals
from run_command import paceline
from selection import slow_after

from paceline.calibration import rig_check, scene_matches
from paceline.calibration.rig_check import (
    check_rig,
    clustered_covariance,
    correct_rotation,
    correction_refusal,
    has_enough_matches,
    rotated_rig,
)
from paceline.calibration.scene_matches import TILE_PX, SceneMatches, match_scene
from paceline.cameras import Camera, RigUncertainty, StereoRig, perturbed_rig
from paceline.documents.assumed_calibration import with_assumed_uncertainty
from paceline.documents.loading import load_clip_recording, load_rig
from paceline.recordings.stereo import open_recording

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "straight"
SHARED = ROOT.parent / "shared" / "data"
STATED = RigUncertainty(0.5, 0.0, (2e-5, 2e-5, 2e-5), (1e-4, 1e-4, 1e-4))


def with_uncertainty(rig: StereoRig, stated: RigUncertainty | None = STATED) -> StereoRig:
    return StereoRig(rig.left, rig.right, rig.R, rig.t, stated)


def scene(true: StereoRig, seed: int, count: int = 600, sigma: float = 0.3, mistakes: int = 40) -> SceneMatches:
    """Points at 8 to 100 m seen by the ``true`` rig with noise, some of them matched wrongly."""
    rng = np.random.default_rng(seed)
    width, height = true.left.image_size
    pixels = rng.uniform(0, 1, (4 * count, 2)) * [width, height]
    points = true.left.rays(pixels) * (1 / rng.uniform(1 / 100, 1 / 8, (4 * count, 1)))
    left, right = true.project(points)
    inside = ((right > 0) & (right < [width, height])).all(1)
    left, right = left[inside][:count], right[inside][:count]
    left, right = (p + rng.normal(0, sigma, p.shape) for p in (left, right))
    right[:mistakes] += rng.uniform(-20, 20, (mistakes, 2))
    x, y = (left // TILE_PX).astype(np.int64).T
    return SceneMatches(left, right, y * 100 + x, 1)


def random_rig(rig: StereoRig, seed: int) -> StereoRig:
    """A rig off the stated one by as much as that states."""
    return perturbed_rig(rig, STATED.covariance_root.T @ np.random.default_rng(seed).normal(size=14))


def test_an_unmoved_rig_is_seldom_reported_as_moved(rig: StereoRig) -> None:
    """At a chance of 1e-3 each, more than one of 40 has a chance of 8e-4."""
    said = [check_rig(with_uncertainty(rig), scene(random_rig(rig, s), s)) for s in range(40)]
    assert sum(found.moved for found in said) <= 1
    assert np.mean([found.p_value < 0.5 for found in said]) < 0.85


@pytest.mark.parametrize("degrees", slow_after(1, [((-0.02, 0.05, 0.08),), ((0.03, 0, 0),), ((0, 0, 0.1),)]))
def test_a_rig_that_was_knocked_is_found_and_set_right(rig: StereoRig, degrees: tuple[float, float, float]) -> None:
    knock = np.radians(degrees)
    file = with_uncertainty(rig)
    for seed in range(5):
        true = rotated_rig(random_rig(rig, seed), knock)
        found = check_rig(file, scene(true, seed))
        assert found.moved
        assert np.abs((found.rotation - knock)[[0, 2]] / found.std[[0, 2]]).max() < 4
        better = correct_rotation(file, found)
        np.testing.assert_allclose(better.rig.R, rotated_rig(file, better.rotation).R)
        off = np.abs(better.rotation - knock) / better.std
        assert off[[0, 2]].max() < 4
        assert off[1] < 4  # the pan, which the scene hardly shows, is stated to be as unsure as it is
        assert (better.scene_share[[0, 2]] > 0.8).all()
        assert better.std[1] > 5 * better.std[0]
        assert better.effects[1].along > 3 * rig_check.speed_effects(file)[1].along


@pytest.mark.slow
def test_the_turn_is_that_of_the_covariance(rig: StereoRig) -> None:
    z = []
    for seed in range(40):
        found = check_rig(with_uncertainty(rig, None), scene(rig, seed, mistakes=0))
        z.append(found.rotation[[0, 2]] / np.sqrt(np.diag(found.scene_covariance))[[0, 2]])
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.35  # 80 squares: 0.75 to 1.27 at a chance of 1e-3 on each side


def test_wrong_matches_are_left_out(rig: StereoRig) -> None:
    found = check_rig(with_uncertainty(rig), scene(rig, 3, mistakes=100))
    assert 80 <= found.outliers <= 130
    assert found.residual_px == pytest.approx(0.3 * np.sqrt(2), rel=0.15)  # both views' noise


def test_what_the_calibration_leaves_open_is_no_movement(rig: StereoRig) -> None:
    """The same difference is a movement or not by what the rig states about itself."""
    true = rotated_rig(rig, np.array([8e-5, 0, 0]))
    sure, unsure = (
        check_rig(with_uncertainty(rig, RigUncertainty(rotation_rad=(s, s, s))), scene(true, 1)) for s in (1e-6, 1e-4)
    )
    assert sure.moved
    assert not unsure.moved


def test_without_stated_uncertainty_an_ordinary_one_counts(rig: StereoRig) -> None:
    """KITTI's rectified cameras nod by 0.012° and roll by 0.02°: no movement, unless the file is exact."""
    width = rig.left.image_size[0]
    turn = np.array([0.15 / rig.right.K[1, 1], 0.0, 0.1 / (width / 4)])
    true = rotated_rig(rig, turn)
    exact, assumed = (check_rig(file, scene(true, 1)) for file in (rig, with_assumed_uncertainty(rig)))
    assert exact.states_uncertainty and exact.moved
    assert not assumed.states_uncertainty and not assumed.moved
    better = correct_rotation(with_assumed_uncertainty(rig), assumed)
    assert better.rig.uncertainty is not None and not better.rig.uncertainty.is_assumed
    assert (better.scene_share[[0, 2]] > 0.5).all() and better.scene_share[1] < 0.5
    assert (np.abs(better.rotation - turn)[[0, 2]] < 4 * better.std[[0, 2]]).all()


def test_correcting_an_unmoved_rig_changes_it_within_its_uncertainty(rig: StereoRig) -> None:
    file = with_uncertainty(rig)
    found = check_rig(file, scene(random_rig(rig, 7), 7))
    better = correct_rotation(file, found)
    assert np.abs(better.rotation / np.array(STATED.rotation_rad)).max() < 4
    assert (better.std <= np.array(STATED.rotation_rad) * 1.001).all()


def enlarged(matches: SceneMatches, left: float, right: float, size: tuple[int, int] = (1024, 768)) -> SceneMatches:
    """The same points in pictures that are enlarged about their middle and cropped."""
    middle = (np.array(size) - 1) / 2
    pixels = [middle + s * (p - middle) for s, p in ((left, matches.left), (right, matches.right))]
    inside = [((p > 0) & (p < np.array(size) - 1)).all(1) for p in pixels]
    moved = replace(matches, left=pixels[0], right=pixels[1])
    return moved.select(inside[0] & inside[1])


def refused(rig: StereoRig, matches: SceneMatches) -> str:
    """The code of what is said of a correction."""
    found = check_rig(rig, matches)
    return correction_refusal(found, correct_rotation(rig, found)).code


@pytest.mark.parametrize("scale", slow_after(1, [1.1, 0.9, 1.03]))
def test_views_that_are_cropped_alike_are_no_rotation(rig: StereoRig, scale: float) -> None:
    """Of cameras that are tilted against each other it looks like a nod, and no scene tells the two apart."""
    tilted = StereoRig(rig.left, rig.left, cv2.Rodrigues(np.array([0.006, -0.007, 0.003]))[0], rig.t)
    file = with_uncertainty(tilted)
    assert {refused(file, enlarged(scene(tilted, seed), scale, scale)) for seed in range(3)} == {"rotation_ambiguous"}


def test_a_crop_is_no_rotation_though_an_unsure_calibration_may_be_as_wrong(rig: StereoRig) -> None:
    """By 10 % it shifts the views against each other by four standard deviations of an assumed calibration."""
    tilted = StereoRig(rig.left, rig.left, cv2.Rodrigues(np.array([0.006, -0.007, 0.003]))[0], rig.t)
    file, matches = with_assumed_uncertainty(tilted), enlarged(scene(tilted, 1), 1.1, 1.1)
    assert refused(file, matches) == "rotation_ambiguous"


def test_one_view_that_is_enlarged_is_no_rotation(rig: StereoRig) -> None:
    file = with_uncertainty(rig)
    assert {refused(file, enlarged(scene(rig, seed), 1.0, 1.01)) for seed in range(5)} == {"rotation_unexplained"}


@pytest.mark.parametrize(
    ("degrees", "code"),
    [((0.012, 0, 0.016), ""), ((-0.01, 0.005, -0.02), ""), ((0.05, 0.05, 0.08), "rotation_uncertain")],
)
def test_a_knock_is_corrected_unless_speeds_would_be_too_unsure(
    rig: StereoRig, degrees: tuple[float, float, float], code: str
) -> None:
    file = with_uncertainty(rig)
    assert {refused(file, scene(rotated_rig(rig, np.radians(degrees)), seed)) for seed in range(5)} == {code}


def test_an_exact_rig_that_stands_is_not_taken_for_a_crop(rig: StereoRig) -> None:
    """Its calibration allows no rotation at all, so any that the scene's noise makes would be far beyond it."""
    assert "rotation_ambiguous" not in {refused(rig, scene(rig, seed)) for seed in range(3)}


def test_a_keystone_is_no_pan(rig: StereoRig) -> None:
    """KITTI's rectified pictures differ by 0.13 px of height at (100, 100) px: a pan that made it would be 0.53°, and
    change all disparities by 6.6 px."""
    K = np.array([[707.0, 0, 601.9], [0, 707.0, 183.1], [0, 0, 1]])
    camera = Camera((1226, 370), K)
    parallel = with_assumed_uncertainty(StereoRig(camera, camera, np.eye(3), np.array([-0.537, 0, 0])))
    for seed in range(3):
        matches = scene(parallel, seed, count=2000)
        x, y = (matches.right - K[:2, 2]).T / 100
        matches = replace(matches, right=matches.right - np.column_stack([0 * x, 0.17 + 0.04 * x - 0.13 * x * y]))
        found = check_rig(parallel, matches)
        correction = correct_rotation(parallel, found)
        assert found.moved and correction_refusal(found, correction).code == "rotation_unexplained"
        nod, pan, roll = np.abs(np.degrees(correction.rotation))
        assert pan < 0.02 and nod == pytest.approx(0.014, abs=0.006) and roll == pytest.approx(0.023, abs=0.01)


def test_clusters_count_once() -> None:
    """A hundred copies of a residual know as much as one."""
    rng = np.random.default_rng(0)
    J, e = rng.normal(size=(200, 2)), rng.normal(size=200)
    once = clustered_covariance(J, e, np.arange(200))
    copied = clustered_covariance(np.repeat(J, 10, axis=0), np.repeat(e, 10), np.repeat(np.arange(200), 10))
    np.testing.assert_allclose(once, copied, rtol=0.02)
    bread = np.linalg.inv(J.T @ J)
    by_hand = bread @ (J.T * e**2 @ J) @ bread * 200 / 199 * 199 / 198
    np.testing.assert_allclose(once, by_hand)


def test_a_few_points_are_not_enough(rig: StereoRig) -> None:
    matches = scene(rig, 1)
    assert has_enough_matches(matches)
    assert not has_enough_matches(matches.select(np.arange(len(matches)) < 20))
    assert not has_enough_matches(SceneMatches(matches.left, matches.right, np.zeros(len(matches), np.int64), 1))


# --- on pictures ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_points_matched_in_the_example_lie_on_their_lines() -> None:
    clip = load_clip_recording(EXAMPLE / "clip.yaml")
    matches = match_scene(open_recording(clip))
    assert has_enough_matches(matches)
    found = check_rig(clip.rig, matches)
    assert found.matches > 500
    assert found.rotation_error_px < 0.1
    assert not found.moved


def test_the_command_notices_a_knock_and_sets_the_rig_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    matched: list[SceneMatches] = []

    def match_once(*given: Any) -> SceneMatches:
        """Both calls have the same rig and the same pictures."""
        if not matched:
            matched.append(match_scene(*given))
        return matched[0]

    monkeypatch.setattr(scene_matches, "match_scene", match_once)
    shutil.copytree(EXAMPLE, tmp_path / "clip")
    document = yaml.safe_load((EXAMPLE / "rig.yaml").read_text())
    knock = np.radians([0.02, 0.0, -0.02])
    true = load_rig(EXAMPLE / "rig.yaml")
    knocked = rotated_rig(true, -knock)
    document["rotation"], document["translation"] = knocked.R.tolist(), knocked.t.tolist()
    (tmp_path / "clip" / "rig.yaml").write_text(yaml.safe_dump(document))
    moved = paceline("rig", "check", tmp_path / "clip")
    assert moved.returncode == 1
    assert "the rig has moved" in moved.stdout

    out = tmp_path / "refined.yaml"
    refined = paceline("rig", "check", tmp_path / "clip", "--correct-rotation", "-o", out)
    assert refined.returncode == 0, refined.stderr
    assert "the scene does not determine it" in refined.stdout
    assert len(rows_with_intervals(refined.stdout)) == 3
    better = load_rig(out)
    left_over = np.degrees(np.ravel(cv2.Rodrigues(better.R @ true.R.T)[0]))
    assert np.abs(left_over[[0, 2]]).max() < 0.006
    assert better.uncertainty is not None
    assert better.uncertainty.covariance is not None
    assert better.uncertainty.rotation_rad[1] > 2e-4
    clip = tmp_path / "clip" / "clip.yaml"
    (notice,) = open_recording(load_clip_recording(clip, out)).notices
    assert notice.startswith(f"the rig's rotation was corrected by {better.scene_points} points of a scene")


@pytest.mark.slow
def test_the_command_does_not_correct_what_may_be_a_crop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Corrected, 45 and 38 mph were measured as 40.8 ± 0.1 and 34.5 ± 0.1."""

    def match_enlarged(*given: Any) -> SceneMatches:
        return enlarged(match_scene(*given), 1.1, 1.1)

    monkeypatch.setattr(scene_matches, "match_scene", match_enlarged)
    out = tmp_path / "corrected.yaml"
    done = paceline("rig", "check", EXAMPLE, "--correct-rotation", "-o", out)
    assert done.returncode == 1 and not out.exists()
    assert "the rig has moved" in done.stdout and "--correct-rotation" not in done.stdout
    (line,) = done.stderr.splitlines()
    assert line.startswith("note: no correction: a change of all focal lengths together explains this about as well")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--correct-rotation"], "--correct-rotation and --out belong together"),
        (["-o", "rig.yaml"], "--correct-rotation and --out belong together"),
        (["--rig", "nowhere.yaml"], "nowhere.yaml: no such file"),
        (["--correct-rotation", "-o", "rig.csv"], "expected the name of a YAML file"),
    ],
)
def test_wrong_options_are_one_plain_line(arguments: list[str], said: str) -> None:
    done = paceline("rig", "check", EXAMPLE, *arguments)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert said in done.stderr


@pytest.mark.slow
def test_the_shared_rendered_rig_has_not_moved() -> None:
    folder = SHARED / "rendered" / "straight"
    if not folder.exists():
        pytest.skip(f"{folder} is absent")
    clip = load_clip_recording(folder / "clip.yaml")
    found = check_rig(clip.rig, match_scene(open_recording(clip)))
    assert not found.moved
    assert np.degrees(found.std[0]) < 0.01
