"""The middle of the vehicle where the outline is partly beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from selection import slow_after

from paceline.documents.loading import load_clip
from paceline.simulation.random_scenes.drawn import random_bend
from paceline.simulation.stereo.clip import render, write
from paceline.speed.measurement import measure_clip
from paceline.speed.refinement.reference_point import reference_point

MPH = 0.44704  # m/s


def variances(columns: int, left: int, right: int) -> tuple[np.ndarray, np.ndarray]:
    """Of images of a textured vehicle between ``left`` and ``right`` columns of something else, in two rows."""
    image, residual = np.full((2, columns), 100.0), np.full((2, columns), 0.5)
    for side in (slice(0, left), slice(columns - right, columns)):
        image[:, side], residual[:, side] = 6.0, 3.0
    return image, residual


def test_an_outline_of_the_vehicle_alone_has_its_middle() -> None:
    point = reference_point(*variances(5, 0, 0))
    assert (point.shift, point.std, point.beside) == (0.0, 0.0, (0.0, 0.0))


@given(columns=st.integers(4, 12), share=st.floats(0.15, 0.5), overlap=st.floats(0, 1), side=st.sampled_from([-1, 1]))
def test_the_middle_is_about_where_it_is_said_to_be(columns: int, share: float, overlap: float, side: int) -> None:
    """The vehicle reaches beyond the other side by any part of what the outline is beside it."""
    beside = int(columns * share)  # a column that the vehicle fills in part moves with it
    point = reference_point(*variances(columns, *((beside, 0) if side > 0 else (0, beside))))
    true = 0.5 * side * share * (1 + overlap) if beside else 0.0
    assert abs(point.shift - true) <= 3.5 * point.std or not beside
    assert point.std < share


def test_a_vehicle_within_the_outline_is_known_to_a_column() -> None:
    point = reference_point(*variances(8, 2, 1))
    assert point.shift == pytest.approx(0.5 / 8) and point.std == pytest.approx(1 / 8 / np.sqrt(24))


def test_the_corners_of_both_outlines_are_as_uncertain_as_they_were_drawn() -> None:
    rng, corners = np.random.default_rng(5), np.array([0.0, 1.0, 1.0, 0.0])
    drawn = corners + rng.normal(0.0, 0.02, (4000, 2, 4))  # across, by both views
    left, both = drawn[:, 0].mean(-1), drawn.mean((1, 2))
    shift = both - left  # from the middle of the left outline, which is at `left`
    points = [reference_point(*variances(5, 0, 0)).moved(value, 0.02) for value in shift]
    errors = left + [point.shift for point in points] - 0.5
    assert points[0].std == pytest.approx(errors.std(), rel=0.05)


def test_a_part_of_little_contrast_belongs_to_the_vehicle() -> None:
    """As in the dark, where noise hides it."""
    image, residual = np.full((1, 6), 2.5), np.full((1, 6), 0.1)
    image[0, 0], residual[0, 0] = 0.4, 0.1
    assert reference_point(image, residual).shift == 0.0


def test_a_plain_road_is_beside_the_vehicle() -> None:
    image, residual = variances(6, 2, 0)
    image[:, :2] = residual[:, :2] = 0.5  # noise
    assert reference_point(image, residual).beside == (2.5 / 6, 0.0)


def test_a_side_of_which_a_part_moves_with_the_vehicle_belongs_to_it() -> None:
    """As of a van whose dark pillar hides in the background above its bright sill."""
    image, residual = variances(5, 0, 1)
    assert reference_point(image, residual).beside == (0.0, 0.3)
    image[1, -1], residual[1, -1] = 28.0, 1.0
    assert reference_point(image, residual).beside == (0.0, 0.0)


def test_nothing_is_said_of_what_does_not_move_as_fitted() -> None:
    assert reference_point(np.full((1, 5), 3.0), np.full((1, 5), 2.0)).shift == 0.0


@pytest.mark.parametrize("seed, aside", slow_after(0, [(3, 0.3), (3, -0.3), (5, 0.35), (5, -0.35)]))
def test_an_outline_partly_beside_the_vehicle_gives_the_speed_of_its_middle(
    tmp_path: Path, seed: int, aside: float
) -> None:
    scene = random_bend(seed)
    clip = load_clip(write(render(scene), tmp_path / "clip"))
    (vehicle,) = clip.vehicles
    shift = np.array([aside * np.ptp(vehicle.left[:, 0]), 0.0])
    vehicle = replace(vehicle, left=vehicle.left + shift, right=vehicle.right + shift)
    (m,) = measure_clip(replace(clip, vehicles=[vehicle])).measurements
    assert m.verdict == "measured", m.reason
    half_width = 0.5 * (m.speed_hi - m.speed_lo)
    # a correct interval misses by as much once in 300
    assert abs(m.speed - scene.vehicles[0].speed) <= 1.5 * half_width
    assert half_width < 0.6 * MPH
    assert any(notice.startswith("about") and "of the outline's width" in notice for notice in m.notices)
