from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.units import SpeedUnit, convert, format_speed, parse_unit


def test_a_mile_is_1609_344_metres_and_an_hour_3600_seconds():
    assert convert(1609.344, "mph") == pytest.approx(3600.0, rel=1e-15)
    assert convert(1000.0, "km/h") == pytest.approx(3600.0, rel=1e-15)
    assert convert(12.5, SpeedUnit.MPS) == 12.5


def test_arrays_convert_element_by_element():
    np.testing.assert_allclose(convert(np.array([0.44704, 0.89408, np.nan]), "mph"), [1, 2, np.nan])


@pytest.mark.parametrize("text", ["mph", " MPH ", "km/h", "m/s"])
def test_units_are_known_by_name(text):
    assert parse_unit(text) == text.strip().lower()


def test_an_unknown_unit_is_refused_with_the_valid_ones():
    with pytest.raises(ValueError, match="unknown unit 'knots'; expected mph, km/h, m/s"):
        parse_unit("knots")


@pytest.mark.parametrize(
    ("speed", "plus_minus", "unit", "text"),
    [
        (44.9 * 0.44704, 0.1 * 0.44704, "mph", "44.9 ± 0.1 mph"),
        (20.0, 0.0123, "m/s", "20.00 ± 0.01 m/s"),
        (20.0, 0.096, "m/s", "20.0 ± 0.1 m/s"),
        (20.0, 3.2, "m/s", "20 ± 3 m/s"),
        (120.4, 23.0, "m/s", "120 ± 20 m/s"),
        (10.0, math.nan, "km/h", "36.0 ± ? km/h"),
        (10.0, math.inf, "km/h", "36.0 ± ? km/h"),
    ],
)
def test_digits_follow_the_uncertainty(speed, plus_minus, unit, text):
    assert format_speed(speed, plus_minus, unit) == text


@settings(deadline=None)
@given(st.floats(0, 100), st.floats(1e-4, 20), st.sampled_from(list(SpeedUnit)))
def test_rounding_never_hides_more_than_the_uncertainty(speed, plus_minus, unit):
    shown = format_speed(speed, plus_minus, unit).split()
    assert abs(float(shown[0]) - convert(speed, unit)) <= convert(plus_minus, unit)
    assert float(shown[2]) == pytest.approx(convert(plus_minus, unit), rel=0.5)
