"""How good a model is: what its lines determine, their contrast, and whether they look like a vehicle's rear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from paceline.targets.image_lines import Line
from paceline.targets.model_quality import judge_model, line_contrast, mirrored_share
from paceline.targets.side_estimation import EDGE_SIDE_STD_PX

LEFT, RIGHT = Line(20.0, 10.0, 50.0, 1.0), Line(80.0, 10.0, 50.0, 1.0)
TOP, BOTTOM = Line(10.0, 20.0, 80.0, 1.0), Line(50.0, 20.0, 80.0, 1.0)
MIDDLE = np.array([50.0, 30.0])


def picture() -> np.ndarray:
    image = np.full((60, 100), 40.0, np.float32)
    image[10:51, 20:81] = 100.0
    return image


def test_the_spread_is_that_of_lines_with_errors() -> None:
    """Against the centre and scale fitted to lines that err independently."""
    quality = judge_model(picture(), [TOP, BOTTOM], [LEFT, RIGHT], MIDDLE)
    errors = np.random.default_rng(1).normal(0, EDGE_SIDE_STD_PX, (20_000, 4))
    rows = np.array([[1.0, 0, -30], [1.0, 0, 30], [0, 1.0, -20], [0, 1.0, 20]])
    fitted = np.linalg.lstsq(rows, errors.T, rcond=None)[0].std(axis=1)
    assert (quality.across_std, quality.down_std, quality.scale_std) == pytest.approx(tuple(fitted), rel=0.03)
    assert (quality.horizontal, quality.vertical) == (2, 2)
    assert quality.contrast == pytest.approx(60, abs=1) and quality.mirrored_share == 1


def test_the_contrast_is_that_of_both_sides() -> None:
    assert line_contrast(picture(), Line(19.5, 10.0, 50.0, 1.0)) == pytest.approx(60)
    assert line_contrast(picture(), Line(50.0, 10.0, 50.0, 1.0)) == pytest.approx(0)


def test_lines_are_mirrored_by_themselves_or_by_another() -> None:
    lamps = [Line(30.0, 22.0, 32.0, 1.0), Line(30.5, 68.0, 78.0, 1.0)]
    assert mirrored_share([TOP, *lamps], [LEFT, RIGHT], 50.0) == 1
    assert mirrored_share([TOP, lamps[0]], [LEFT, RIGHT], 50.0) == pytest.approx(140 / 150)
    assert mirrored_share([], [LEFT, Line(60.0, 10.0, 50.0, 1.0)], 50.0) == 0
    assert mirrored_share([], [LEFT, Line(80.0, 52.0, 90.0, 1.0)], 50.0) == 0  # one below the other


def test_a_poor_model_is_doubted() -> None:
    good = judge_model(picture(), [TOP, BOTTOM], [LEFT, RIGHT], MIDDLE)
    assert good.doubts() == ()
    poor = replace(good, mirrored_share=0.2, contrast=5.0, scale_std=0.03)
    assert [doubt.code for doubt in poor.doubts()] == ["target_not_symmetric", "target_faint", "target_scale_uncertain"]
    assert all(doubt.advice for doubt in poor.doubts())
