"""Where the sides of a vehicle are: a hand's box and the edges beside it, weighed by what each can tell."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from paceline.documents.loading import load_camera
from paceline.targets.learning import LearnedTarget, learn_target
from paceline.targets.side_estimation import (
    BOX_SIDE_STD_PX,
    EDGE_SIDE_STD_PX,
    Side,
    SideEdge,
    estimate_side,
    side_edges,
    width_std,
)
from paceline.targets.stated_width import StatedWidth
from paceline.units import COVERAGE_95

CHASE_DARK = Path(__file__).parents[2] / "shared" / "data" / "chase_dark"


def edge_points(x: float, rows: range, gradient: float = 20.0) -> np.ndarray:
    return np.array([[x, y, gradient] for y in rows])


def test_without_an_edge_the_side_is_where_the_box_has_it() -> None:
    assert estimate_side(50.0, []) == Side(50.0, BOX_SIDE_STD_PX, 0.0)


def test_a_clear_edge_is_the_side() -> None:
    side = estimate_side(50.0, [SideEdge(51.0, 0.95)])
    assert side.position == pytest.approx(51.0, abs=0.03)
    assert side.total_std < 1.3 * EDGE_SIDE_STD_PX


def test_of_two_edges_alike_the_one_nearer_to_the_box_counts_more_and_the_doubt_is_stated() -> None:
    side = estimate_side(50.0, [SideEdge(48.0, 0.7), SideEdge(51.0, 0.7)])
    assert 50.0 < side.position < 51.0
    assert side.association_std > 0.7


def test_a_short_edge_moves_the_side_little() -> None:
    """As that of a wheel, which takes up a fifth of the rows."""
    side = estimate_side(50.0, [SideEdge(48.0, 0.2)])
    assert side.position == pytest.approx(50.0, abs=0.4)
    assert side.total_std == pytest.approx(BOX_SIDE_STD_PX, rel=0.25)


def test_an_edge_beyond_reach_is_none() -> None:
    assert side_edges(edge_points(55.0, range(10, 30)), 50.0, (10.0, 29.0)) == []


def test_edges_of_both_signs_in_different_rows_are_one() -> None:
    """A body before a bright road above and a dark wheel below: its side is the edge in all of the rows."""
    points = np.concatenate([edge_points(50.2, range(10, 18)), edge_points(50.4, range(18, 30)),
                             edge_points(47.9, range(18, 30))])  # fmt: skip
    first, second = side_edges(points, 50.0, (10.0, 29.0))
    assert first.position == pytest.approx(50.32, abs=0.01) and first.share == 1.0
    assert second.position == pytest.approx(47.9, abs=0.01) and second.share == pytest.approx(0.6)


def test_two_points_in_one_row_count_once() -> None:
    points = np.concatenate([edge_points(50.0, range(10, 20)), edge_points(50.3, range(10, 20))])
    (edge,) = side_edges(points, 50.0, (10.0, 29.0))
    assert edge.share == 0.5


def test_edges_that_are_mistaken_on_both_sides_add_up() -> None:
    left, right = Side(0.0, 0.6, 0.8), Side(80.0, 0.8, 0.2)
    assert width_std(left, right) == pytest.approx(np.sqrt(0.6**2 + 0.8**2 + 1.0**2))


def test_the_stated_uncertainty_is_that_of_the_sides() -> None:
    """Sides, boxes and edges drawn as the model has it: errors are as large as stated."""
    rng, z, errors = np.random.default_rng(5), [], []
    for _ in range(600):
        drawn = rng.normal(0.0, BOX_SIDE_STD_PX)
        edges = [SideEdge(rng.uniform(-4, 4), rng.uniform(0.1, 0.4)) for _ in range(rng.poisson(1.6))]
        if rng.random() < 0.9:
            edges.append(SideEdge(rng.normal(0.0, EDGE_SIDE_STD_PX), rng.uniform(0.4, 1.0)))
        side = estimate_side(drawn, edges)
        z.append(side.position / side.total_std)
        errors.append(side.position)
    assert np.sqrt(np.mean(np.square(errors))) < 0.6
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.15
    assert np.mean(np.abs(z) < COVERAGE_95) > 0.92


def learn_dark(frame: int, rng: np.random.Generator | None) -> tuple[LearnedTarget, float]:
    """The saloon of chase_dark learned from a box about the truth, or from its README's; and the true range, m."""
    truth = json.loads((CHASE_DARK / "truth.json").read_text())
    row = truth["truth"][frame]
    corners = np.array(row["corners"])
    box = (corners[[0, 0, 1, 2], [0, 1, 0, 1]] + rng.normal(0, 1, 4)) if rng else [214.1, 194.2, 295.2, 220.3]
    picture = cv2.imread(str(CHASE_DARK / "frames" / f"{frame:05d}.jpg"), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    camera = load_camera(CHASE_DARK / "camera.yaml")
    x0, y0, x1, y1 = (float(v) for v in box)
    return learn_target(picture, (x0, y0, x1, y1), StatedWidth(truth["width_m"]), camera, "saloon"), row["position"][2]


@pytest.mark.skipif(not CHASE_DARK.exists(), reason="the shared recordings are not here")
def test_wheels_beside_a_dark_body_are_not_its_sides() -> None:
    """Their edges are the only long lines beside the box, 85.5 px apart; the sides are 80.0 px apart."""
    learned, true_range = learn_dark(0, None)
    error = learned.target.nominal_range / true_range - 1
    assert abs(error) < 0.01
    assert abs(error) < COVERAGE_95 * learned.relative_std < 0.06
    (notice,) = learned.notices
    assert notice.code == "lines_beyond_sides" and "80." in notice and notice.advice
