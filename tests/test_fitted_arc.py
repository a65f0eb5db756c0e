"""The arc through a vehicle's places."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from paceline.speed.geometry.fitted_arc import PLACE_STD_M, _distance_from_arc, _place_on_arc, fit_arc
from paceline.speed.geometry.paths import from_points

CURVATURES = [-1 / 25, -1 / 80, 0.0, 1 / 300, 1 / 40]


def places_on_arc(curvature: float, direction: float = 0.3, fall: float = 0.04, n: int = 12) -> np.ndarray:
    """Places (n, 3) on 28 m of an arc on a surface that falls to the right by ``fall``."""
    s = np.linspace(0.0, 28.0, n)
    half = 0.5 * curvature * s
    chord = s * np.sinc(half / np.pi)
    x, z = 3.0 + chord * np.sin(direction + half), 40.0 + chord * np.cos(direction + half)
    return np.column_stack([x, 1.2 + fall * x + 0.01 * z, z])


@pytest.mark.parametrize("curvature", CURVATURES)
@pytest.mark.parametrize("direction", [0.3, 2.8])
def test_the_arc_passes_through_places_in_the_direction_of_travel(curvature: float, direction: float) -> None:
    places = places_on_arc(curvature, direction)
    arc, fitted = fit_arc("v0", places)
    assert fitted == pytest.approx(curvature, abs=1e-3)
    s = np.array([arc.nearest(place) for place in places])
    assert np.linalg.norm(arc.at(s) - places, axis=1).max() < 0.3 * PLACE_STD_M
    assert (np.diff(s) > 2.0).all()


def test_places_on_half_a_circle() -> None:
    places = places_on_arc(1 / 9)
    arc, fitted = fit_arc("v0", places)
    assert fitted == pytest.approx(1 / 9, rel=0.05)
    assert (np.diff([arc.nearest(place) for place in places]) > 1.5).all()


def test_the_curvatures_error_is_that_of_a_circle_fitted_by_algebra() -> None:
    rng, errors, by_algebra = np.random.default_rng(5), [], []
    for _ in range(40):
        places = places_on_arc(1 / 50) + rng.normal(0.0, 0.1, (12, 3))
        errors.append(fit_arc("v0", places)[1] - 1 / 50)
        x, z = places[:, 0], places[:, 2]
        a, b, c = np.linalg.lstsq(np.column_stack([x, z, np.ones(12)]), x**2 + z**2)[0]
        by_algebra.append(1 / np.sqrt(c + 0.25 * (a**2 + b**2)) - 1 / 50)
    assert np.sqrt(np.mean(np.square(errors))) < 1.2 * np.sqrt(np.mean(np.square(by_algebra)))


def test_a_standing_vehicle_is_on_an_arc_in_the_direction_of_its_path() -> None:
    path = from_points("lane", "line", np.array([[0.0, 1.5, 10.0], [6.0, 1.5, 70.0]]))
    places = np.array([3.0, 1.5, 40.0]) + np.random.default_rng(2).normal(0.0, 0.02, (12, 3))
    arc, _ = fit_arc("v0", places, path)
    tangent = arc.frames(np.array(arc.nearest(places[0])))[:, 0]
    assert tangent @ path.frames(np.array(0.0))[:, 0] > np.cos(np.radians(3.0))


@given(
    offset=st.floats(-3, 3),
    direction=st.floats(-1, 1),
    curvature=st.floats(-0.05, 0.05),
    along=st.floats(-15, 15),
    across=st.floats(-4, 4),
)
def test_the_distance_from_an_arc_is_that_to_its_nearest_place(
    offset: float, direction: float, curvature: float, along: float, across: float
) -> None:
    x = np.array([offset, direction, curvature])
    on_arc = np.hypot(
        *(a - b for a, b in zip(_place_on_arc(x, np.linspace(-40, 40, 80001)), (along, across), strict=True))
    )
    distance = _distance_from_arc(x, np.array([along]), np.array([across]))[0]
    assert abs(distance) == pytest.approx(on_arc.min(), abs=1e-3)
