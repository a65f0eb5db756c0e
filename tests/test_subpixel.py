"""Tops of parabolas between samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from paceline.subpixel import parabola_peak, parabola_peak_at


@given(st.floats(-0.5, 0.5), st.floats(-5, -0.1), st.floats(-3, 3))
def test_the_top_of_a_parabola_is_where_it_was_put(at: float, bend: float, high: float) -> None:
    values = [0.5 * bend * (x - at) ** 2 + high for x in (-1.0, 0.0, 1.0)]
    assert parabola_peak(*values) == pytest.approx(at, abs=1e-9)
    curve = np.polynomial.Polynomial.fit([-1, 0, 1], values, 2)
    assert parabola_peak(*values) == pytest.approx(float(curve.deriv().roots()[0]), abs=1e-6)


@pytest.mark.parametrize(("before", "at", "behind", "sign"), [(0, 1, 5, 1), (5, 1, 0, -1), (1, 1, 1, 0), (0, 1, 2, 1)])
def test_a_peak_out_of_reach_is_clamped_towards_the_greater_side(before: int, at: int, behind: int, sign: int) -> None:
    assert parabola_peak(before, at, behind) == 0.5 * sign
    assert parabola_peak(before, at, behind, reach=2.0) == 2.0 * sign


@given(st.lists(st.floats(-3, 3), min_size=1, max_size=6), st.integers(0, 5))
def test_nothing_is_beyond_the_ends_of_the_samples(values: list[float], k: int) -> None:
    best = k % len(values)
    inside = 0 < best < len(values) - 1
    assert parabola_peak_at(np.array(values), best) == (parabola_peak(*values[best - 1 : best + 2]) if inside else 0.0)
