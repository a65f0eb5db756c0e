"""What is told of the features once they are measured: how much of a model shows, of what the image can show of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.follow import measuring_cpu

WIDTH, HEIGHT = 60, 40
ends = st.tuples(st.floats(-80, 80), st.floats(1, 90))


@settings(deadline=None)  # the first call loads what is compiled
@given(st.booleans(), st.floats(-20, 80), ends)
def test_the_share_of_a_feature_in_view_is_that_of_its_points(vertical, place, end):
    begin, length = end
    told = measuring_cpu.in_view(
        np.array([vertical]), np.array([place]), np.array([[begin, begin + length]]), WIDTH, HEIGHT
    )
    along = np.linspace(begin, begin + length, 2001)
    across, onward = (WIDTH, HEIGHT) if vertical else (HEIGHT, WIDTH)
    seen = (2 <= place <= across - 3) * ((along >= 0) & (along <= onward - 1)).mean()
    assert told[0] == pytest.approx(seen, abs=1e-3)


def told(shown, used):
    lengths = np.array([4.0, 3.0, 2.0, 1.0])
    used = np.array(used)
    return measuring_cpu.agreement(np.zeros(4), used, np.ones(4), np.where(used, 0.8, 0.0), lengths, np.array(shown))


def test_what_the_image_cannot_show_is_not_missed():
    whole = told([1.0, 1.0, 1.0, 1.0], [True, True, False, False])
    half = told([1.0, 1.0, 0.5, 0.0], [True, True, False, False])
    assert whole[2:4] == pytest.approx((0.4, 0.7))
    assert half[2:4] == pytest.approx((1.6 / 2.5, 7 / 8))


def test_of_a_line_that_is_partly_shown_that_part_agrees():
    assert told([1.0, 1.0, 0.5, 0.0], [True, False, True, False])[3] == pytest.approx(5 / 8)


def test_of_a_model_that_is_nearly_out_of_view_most_is_missed():
    _, _, match, support, agreeing = told([0.25, 0.0, 0.0, 0.0], [True, False, False, False])
    assert (match, support) == pytest.approx((0.8 / 2.4, 1.0 / 6.0))
    assert agreeing.tolist() == [True, False, False, False]


@given(st.lists(st.floats(0, 1), min_size=4, max_size=4), st.lists(st.booleans(), min_size=4, max_size=4))
def test_the_shares_are_at_most_one(shown, used):
    if any(used):
        assert max(told(shown, used)[2:4]) <= 1.0
