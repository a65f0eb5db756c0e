from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtri

from paceline.units import COVERAGE_95, SpeedUnit, convert, parse_speed, parse_unit


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


@pytest.mark.parametrize(("text", "speed"), [("30 mph", 13.4112), (" 50KM/H", 50 / 3.6), ("8.5  m/s", 8.5)])
def test_a_speed_is_stated_with_its_unit(text, speed):
    assert parse_speed(text) == pytest.approx(speed, rel=1e-15)


@pytest.mark.parametrize(
    "text", ["", "30", "mph", "-30 mph", "0 mph", "1e3 mph", "30 mph or so", "30 knots", "400 mph"]
)
def test_what_is_no_speed_is_refused(text):
    with pytest.raises(ValueError, match=r"expected (a speed|mph, km/h, m/s)"):
        parse_speed(text)


def test_half_of_a_95_percent_interval_is_exact():
    assert ndtri(0.975) == COVERAGE_95
