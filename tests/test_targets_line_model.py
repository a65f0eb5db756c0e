"""The target's line model: what it derives, and what it refuses."""

import numpy as np
import pytest

from paceline.cameras import Camera
from paceline.targets.line_model import Target

CORNERS = np.array([[-1.0, -0.5], [1.0, -0.5], [1.0, 0.5], [-1.0, 0.5]])
SEGMENTS = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])


def test_derives_directions_places_and_spans():
    target = Target("van", 10.0, CORNERS, SEGMENTS)
    assert target.vertical.tolist() == [False, True, False, True]
    assert target.places.tolist() == [-0.5, 1.0, 0.5, -1.0]
    assert target.spans.tolist() == [[-1, 1], [-0.5, 0.5], [-1, 1], [-0.5, 0.5]]
    assert target.size.tolist() == [2.0, 1.0]


def test_at_scale_1_the_lines_project_as_from_the_nominal_range():
    camera = Camera((640, 480), np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]]))
    target = Target("van", 8.0, CORNERS, SEGMENTS)
    seen = camera.project(np.column_stack([CORNERS, np.full(4, 8.0)]))
    lines = target.lines(np.array([320.0, 240.0]), 1.0, target.magnification(camera))
    np.testing.assert_allclose(lines, seen[SEGMENTS], atol=1e-9)
    half = target.lines(np.array([320.0, 240.0]), 0.5, target.magnification(camera))
    np.testing.assert_allclose(half - [320, 240], (seen[SEGMENTS] - [320, 240]) / 2, atol=1e-9)


@pytest.mark.parametrize(
    ("corners", "segments", "nominal", "message"),
    [
        (CORNERS, [[0, 1], [1, 4]], 10.0, r"segments\[1\]: names a corner"),
        (CORNERS, [[0, 1], [1, -1]], 10.0, r"segments\[1\]: names a corner"),
        (CORNERS, [[0, 1], [0, 2]], 10.0, r"segments\[1\]: is oblique"),
        (CORNERS, [[0, 0]], 10.0, r"segments\[0\]: its two corners"),
        (CORNERS, [[0, 1], [2, 3]], 10.0, "no vertical"),
        (CORNERS, [[1, 2], [3, 0]], 10.0, "no horizontal"),
        (CORNERS, SEGMENTS, 0.0, "nominal_range"),
        (CORNERS, SEGMENTS, float("nan"), "nominal_range"),
        (CORNERS * np.nan, SEGMENTS, 10.0, "corners: expected finite"),
    ],
)
def test_refuses_in_one_line(corners, segments, nominal, message):
    with pytest.raises(ValueError, match=message) as refused:
        Target("van", nominal, corners, np.array(segments))
    assert "\n" not in str(refused.value)


def test_a_line_may_lean_by_one_per_cent_of_its_length_and_no_more():
    leaning = CORNERS.copy()
    leaning[1, 1] += 0.019
    target = Target("van", 10.0, leaning, np.array([[0, 1], [3, 0]]))
    assert target.places[0] == pytest.approx(-0.5 + 0.0095)
    leaning[1, 1] += 0.002
    with pytest.raises(ValueError, match="oblique"):
        Target("van", 10.0, leaning, np.array([[0, 1], [3, 0]]))
