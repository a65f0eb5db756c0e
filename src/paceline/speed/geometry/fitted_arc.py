"""The arc of a circle through a vehicle's places, where its road is not known or bends."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from paceline.arrays import Array
from paceline.speed.geometry.path_reconstruction import GRADIENT_STD
from paceline.speed.geometry.paths import PATH_SAMPLES, Path, resampled

CURVATURE_STD_PER_M = 0.03  # 1/m, of a turning vehicle's path: most turns are wider than 30 m
# m, of a car's centre line at full lock (AASHTO, A Policy on Geometric Design of Highways and Streets)
MIN_TURNING_RADIUS_M = 6.4
PLACE_STD_M = 0.2  # m, of a tracked place across the path
MARGIN_M = 5.0  # m, by which the arc runs on beyond the first and the last place


def fit_arc(name: str, places: Array, path: Path | None = None) -> tuple[Path, float]:
    """The arc through a vehicle's ``places`` (N, 3), in the direction of travel, and its curvature to the right, 1/m.

    It lies on a plane surface whose gradient has its prior as the arc's uncertainty. A ``path`` along which it drives
    gives the direction in which the fit begins, and in which it remains where the places are too near to each other.
    """
    level, offset = places[:, ::2], places[:, ::2].mean(0)
    direction = travel_along(places) if path is None else path.direction_near(places.mean(0))
    ahead = direction[::2]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12)
    right = np.array([ahead[1], -ahead[0]])
    along, across = (level - offset) @ ahead, (level - offset) @ right

    def residuals(x: Array) -> Array:
        return np.concatenate([_distance_from_arc(x, along, across) / PLACE_STD_M, x[1:] / [1.0, CURVATURE_STD_PER_M]])

    limits = np.array([np.inf, 1.0, 1.0 / MIN_TURNING_RADIUS_M])
    x = least_squares(residuals, np.zeros(3), bounds=(-limits, limits), loss="soft_l1").x
    s = _arc_length(x, along, across)
    s = np.linspace(s.min() - MARGIN_M, s.max() + MARGIN_M, PATH_SAMPLES)
    arc = offset + np.stack(_place_on_arc(x, s), axis=-1) @ np.stack([ahead, right])
    gradient_std = np.array(GRADIENT_STD)
    weighted = np.concatenate([(level - offset) / PLACE_STD_M, np.diag(1.0 / gradient_std)])
    height = np.concatenate([(places[:, 1] - places[:, 1].mean()) / PLACE_STD_M, np.zeros(2)])
    gradient = np.linalg.lstsq(weighted, height)[0]
    points = np.insert(arc, 1, places[:, 1].mean() + (arc - offset) @ gradient, axis=1)
    modes = np.zeros((2, PATH_SAMPLES, 3))
    modes[..., 1] = ((arc - offset) * gradient_std).T
    return resampled(name, "curve", points, modes), float(x[2])


def travel_along(places: Array) -> Array:
    """The direction (3,), of any length, in which ``places`` (N, 3) follow one another: their slope over the index."""
    return np.asarray((np.arange(len(places)) - 0.5 * (len(places) - 1)) @ places)


def _distance_from_arc(x: Array, along: Array, across: Array) -> Array:
    """Signed distances (N,), to the right, of places from the arc ``x``: its offset (m) to the right, its direction
    (rad) and its curvature (1/m), all at the origin."""
    offset, direction, curvature = x
    across = across - offset
    rightwards = across * np.cos(direction) - along * np.sin(direction)
    bent = curvature * (along**2 + across**2)
    root = np.sqrt(np.maximum(1.0 - 2.0 * curvature * rightwards + curvature * bent, 0.0))
    return np.asarray((2.0 * rightwards - bent) / (1.0 + root))


def _arc_length(x: Array, along: Array, across: Array) -> Array:
    """Lengths (N,) on the arc ``x`` from the origin to the points next to places."""
    offset, direction, curvature = x
    forwards = along * np.cos(direction) + (across - offset) * np.sin(direction)
    rightwards = (across - offset) * np.cos(direction) - along * np.sin(direction)
    if abs(curvature) < 1e-9:
        return np.asarray(forwards)
    return np.asarray(np.arctan2(curvature * forwards, 1.0 - curvature * rightwards) / curvature)


def _place_on_arc(x: Array, s: Array) -> tuple[Array, Array]:
    """Ahead and to the right (N,) of the origin, at the lengths ``s`` on the arc ``x``."""
    offset, direction, curvature = x
    half = 0.5 * curvature * s
    chord, turned = s * np.sinc(half / np.pi), direction + half
    return chord * np.cos(turned), offset + chord * np.sin(turned)
