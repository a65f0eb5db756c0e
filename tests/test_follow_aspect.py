"""What a rolling shutter does to a target's height, told from its own lines over time."""

from dataclasses import replace

import numpy as np
import pytest

from paceline.cameras import Camera, Quantity
from paceline.follow import fitting
from paceline.follow.aspect import Aspect
from paceline.follow.readout import TURN_RATE, displacement_deviation, stretch_deviation

CAMERA = Camera((256, 242), np.array([[300.0, 0, 127.5], [0, 300, 120.5], [0, 0, 1]]), readout=Quantity(0.02))
VERTICAL = np.array([True, True, False, False, False])
OFFSETS = np.array([-30.0, 30.0, -20.0, 5.0, 20.0])
TRUTH = np.array([150.0, 90.0, 1.2])


def stretched_places(stretch):
    return np.where(VERTICAL, TRUTH[0] + TRUTH[2] * OFFSETS, TRUTH[1] + (1 + stretch) * TRUTH[2] * OFFSETS)


def test_the_deviation_is_that_of_rows_read_while_the_image_moves():
    by_hand = TURN_RATE * 300 * 0.02 / 241  # px/s times s, over the rows
    assert stretch_deviation(CAMERA) == pytest.approx(by_hand)
    assert stretch_deviation(replace(CAMERA, readout=Quantity(-0.02))) == pytest.approx(by_hand)
    assert stretch_deviation(replace(CAMERA, readout=Quantity(0.0))) == 0.0
    assert 0.0 < stretch_deviation(replace(CAMERA, readout=None)) < by_hand


def test_what_the_middle_row_shows_is_where_it_is():
    assert displacement_deviation(CAMERA, 120.5) == 0.0
    assert (
        displacement_deviation(CAMERA, 0.0) == displacement_deviation(CAMERA, 241.0) == pytest.approx(0.3 * 300 * 0.01)
    )
    assert displacement_deviation(replace(CAMERA, readout=Quantity(0.0)), 241.0) == 0.0


def test_height_over_width_is_what_independent_fits_give():
    rng = np.random.default_rng(2)
    places, weights = stretched_places(0.01) + rng.normal(0, 0.3, 5), rng.uniform(0.5, 3, 5)
    slopes = [np.polyfit(OFFSETS[side], places[side], 1, w=weights[side]) for side in (~VERTICAL, VERTICAL)]
    ratio, variance = fitting.height_over_width(places, weights, VERTICAL, OFFSETS)
    assert ratio == pytest.approx(slopes[0][0] / slopes[1][0], rel=1e-9)
    tries = [
        fitting.height_over_width(stretched_places(0.01) + rng.normal(0, 1, 5) / weights, weights, VERTICAL, OFFSETS)[0]
        for _ in range(4000)
    ]
    assert np.var(tries) == pytest.approx(variance, rel=0.1)
    assert fitting.height_over_width(places, weights * [1, 1, 1, 0, 0], VERTICAL, OFFSETS)[1] == np.inf
    assert fitting.height_over_width(places, weights * [0, 0, 1, 1, 1], VERTICAL, OFFSETS)[1] == np.inf


def test_what_lasts_is_the_targets_own_and_the_rest_the_readouts():
    rng, deviation, variance = np.random.default_rng(5), 0.0075, 0.004**2
    stretches = rng.normal(0, deviation, 300)
    ratios = 1.02 * (1 + stretches + rng.normal(0, (fitting.FRESH * variance) ** 0.5, 300))
    aspect, found = Aspect(), []
    for ratio in ratios:
        stretch, aspect = aspect.aged(1.0).learned(ratio, variance, deviation)
        found.append(stretch)
    assert found[0] == 0.0  # nothing is known yet
    assert aspect.log_ratio == pytest.approx(np.log(1.02), abs=0.005)
    assert np.sqrt(np.mean((found - stretches)[30:] ** 2)) < 0.6 * deviation


def test_a_ratio_that_no_readout_makes_counts_less():
    aspect = Aspect(0.0, 0.002**2)
    usual, one = aspect.learned(1.01, 1e-6, 0.0075)
    other, two = aspect.learned(1.2, 1e-6, 0.0075)
    assert 0.008 < usual < 0.01 and 0 < other < 0.03
    assert two.log_ratio < 0.01 and two.variance > one.variance


def test_without_a_height_or_a_readout_nothing_is_stretched():
    aspect = Aspect(0.0, 0.002**2)
    assert aspect.learned(0.0, np.inf, 0.0075) == (0.0, aspect)
    assert aspect.learned(1.01, 1e-6, 0.0)[0] == 0.0
