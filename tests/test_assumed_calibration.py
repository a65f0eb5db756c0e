"""The uncertainty that is assumed where rig.yaml states none, and what is written of a rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from paceline.calibration.speed_sensitivity import speed_effects
from paceline.cameras import Camera, Quantity, RigUncertainty, StereoRig, perturbed_rig
from paceline.documents.assumed_calibration import assumed_uncertainty, with_assumed_uncertainty, without_statements
from paceline.documents.loading import load_rig
from paceline.documents.rig_yaml import rig_yaml
from paceline.geometry import triangulate

POINTS = np.array([[-3.0, 1.0, 20.0], [2.0, 0.5, 40.0], [0.0, 1.5, 60.0], [5.0, 1.0, 35.0]])  # m


def standard_deviations(rig: StereoRig) -> np.ndarray:
    uncertainty = assumed_uncertainty(rig)
    assert uncertainty.is_assumed and uncertainty.covariance is not None
    return np.asarray(np.sqrt(np.diag(uncertainty.covariance)))


def resized(rig: StereoRig, pixels: float, metres: float) -> StereoRig:
    """The same rig with other units of its pictures and of space."""
    scale = np.diag([pixels, pixels, 1.0])
    left, right = (
        Camera((int(pixels * c.image_size[0]), int(pixels * c.image_size[1])), scale @ c.K) for c in rig.cameras
    )
    return StereoRig(left, right, rig.R, metres * rig.t)


def test_each_parameter_is_as_unsure_as_documented(rig: StereoRig) -> None:
    s = standard_deviations(rig)
    focal = np.array([c.K[i, i] for c in rig.cameras for i in (0, 1)])
    np.testing.assert_allclose(s[[0, 1, 4, 5]], np.sqrt(3**2 + 10**2 + 0.5**2) * 1e-4 * focal)
    np.testing.assert_allclose(s[[2, 3, 6, 7]], 5e-4 * focal)
    np.testing.assert_allclose(s[11:13], 5e-4 * rig.baseline, rtol=0.01)
    assert s[13] == pytest.approx(np.sqrt(2) * 5e-4 * rig.baseline, rel=0.01)  # it turns with the left camera's axes
    assert (s[8:10] > 5e-4).all() and s[10] == pytest.approx(0.3 / (0.25 * 1024))


def test_parameters_err_together_as_calibrations_show(rig: StereoRig) -> None:
    covariance = assumed_uncertainty(rig).covariance
    assert covariance is not None
    s = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(s, s)
    assert np.linalg.eigvalsh(correlation).min() > 0
    assert correlation[0, 1] > 0.95 and correlation[4, 5] > 0.95  # the two focal lengths of a camera
    assert correlation[0, 4] == pytest.approx(0.08, abs=0.02)  # of both cameras
    assert correlation[2, 9] > 0.6 and correlation[6, 9] < -0.6  # principal points and the rotation, across
    assert correlation[3, 8] < -0.6 and correlation[7, 8] > 0.6  # and down


def test_a_principal_point_hardly_moves_anything(rig: StereoRig) -> None:
    """What is 1 px off in the picture, with the axes turned, moves the views against each other by far less."""
    covariance = assumed_uncertainty(rig).covariance
    assert covariance is not None
    net = np.zeros((2, 14))  # px by which the right picture is shifted against the left one
    net[0, [2, 6, 9]] = -rig.right.K[0, 0] / rig.left.K[0, 0], 1.0, rig.right.K[0, 0]
    net[1, [3, 7, 8]] = rig.right.K[1, 1] / rig.left.K[1, 1], -1.0, rig.right.K[1, 1]
    np.testing.assert_allclose(np.sqrt(np.diag(net @ covariance @ net.T)), [0.1, 0.3], rtol=1e-6)
    f = rig.left.K[0, 0]
    turn = np.array([0.0, 5e-4, 0.0])
    change = np.zeros(14)
    change[2], change[8:11], change[11:] = 5e-4 * f, turn, np.cross(rig.t, turn)
    together, alone = (
        np.linalg.norm(np.diff(triangulate(perturbed_rig(rig, c), *rig.project(POINTS)), axis=0), axis=1)
        / np.linalg.norm(np.diff(POINTS, axis=0), axis=1) - 1
        for c in (change, np.where(np.arange(14) < 8, change, 0.0))
    )  # fmt: skip
    assert np.abs(together).max() < 0.02 * np.abs(alone).max()


@pytest.mark.parametrize(("pixels", "metres"), [(2.0, 1.0), (1.0, 3.0), (0.5, 0.4)])
def test_shares_scale_with_the_rig(rig: StereoRig, pixels: float, metres: float) -> None:
    s, other = standard_deviations(rig), standard_deviations(resized(rig, pixels, metres))
    np.testing.assert_allclose(other[:8], pixels * s[:8])
    np.testing.assert_allclose(other[11:], metres * s[11:])
    assert other[10] == pytest.approx(s[10] / pixels)  # a tenth of a pixel, whatever a pixel is


def test_speeds_at_50_m_are_known_to_about_a_percent(rig: StereoRig) -> None:
    """As of a rig that `paceline calibrate` calls usable: a focal length of 2200 px and half a metre."""
    effect = next(e for e in speed_effects(with_assumed_uncertainty(rig)) if e.distance == 50.0)
    assert 0.006 < effect.along < 0.012


def test_a_vertical_rig_has_one_too(rig: StereoRig) -> None:
    assert np.isfinite(standard_deviations(replace(rig, t=np.array([0.01, -0.5, 0.0])))).all()


# --- written -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("readout", [None, Quantity(0.0), Quantity(-0.018), Quantity(0.018, 0.002)])
@pytest.mark.parametrize("stated", [None, RigUncertainty(1.0, 0.1, (1e-5, 2e-5, 3e-5), (1e-4, 2e-4, 3e-4))])
def test_a_rig_is_read_as_it_was_written(
    tmp_path: Path, rig: StereoRig, readout: Quantity | None, stated: RigUncertainty | None
) -> None:
    written = replace(rig, left=replace(rig.left, readout=readout), uncertainty=stated)
    (file := tmp_path / "rig.yaml").write_text(rig_yaml(written))
    read = load_rig(file)
    assert (read.left.readout, read.right.readout, read.uncertainty) == (readout, None, stated)


def test_what_is_assumed_is_not_written(tmp_path: Path, rig: StereoRig) -> None:
    ideal = replace(rig, left=replace(rig.left, readout=Quantity(0.0)))
    assumed = replace(ideal, right=replace(rig.right, readout=Quantity(0.0, 0.01, "assumed")))
    text = rig_yaml(with_assumed_uncertainty(assumed))
    assert text.count("shutter") == 1 and "readout" not in text and "uncertainty" not in text
    assert yaml.safe_load(rig_yaml(ideal))["uncertainty"] == "exact"
    bare = rig_yaml(without_statements(ideal))
    assert set(yaml.safe_load(bare)) == {"left", "right", "rotation", "translation"} and "shutter" not in bare
    (file := tmp_path / "rig.yaml").write_text(bare)
    assert (read := load_rig(file).uncertainty) is not None and read.is_assumed
