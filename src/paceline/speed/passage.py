"""Which vehicle a measurement is of: its path, its direction along it, and the limit that is posted there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from paceline.arrays import Array
from paceline.documents.loading import Clip, PathDocument
from paceline.speed.results import Measurement, PathDrawing


def with_passage(measurement: Measurement, clip: Clip, paths: Sequence[PathDrawing]) -> Measurement:
    """The ``measurement`` of a vehicle of ``clip`` with its path, one of the reconstructed ``paths``, if any, its
    direction and its limit."""
    path = next((vehicle.path for vehicle in clip.vehicles if vehicle.id == measurement.vehicle), None)
    reconstructed = next((drawing for drawing in paths if drawing.name == path), None)
    direction = None
    if path is not None and reconstructed is not None:
        points = in_drawn_order(clip.paths[path], reconstructed)
        direction = direction_along(points, measurement.track.tracked_positions)
    return replace(measurement, path=path, direction=direction, limit=clip.limit_on(path))


def in_drawn_order(path: PathDocument, reconstructed: PathDrawing) -> Array:
    """The points (M, 3) of a ``reconstructed`` path in the order in which the ``path`` was drawn or surveyed."""
    drawn, along = (path.left, reconstructed.left) if path.points is None else (path.points, reconstructed.points)
    assert drawn is not None, "a path is drawn in both views or surveyed"
    first, last = (np.nanargmin(np.linalg.norm(along - end, axis=1)) for end in (drawn[0], drawn[-1]))
    return reconstructed.points if first <= last else reconstructed.points[::-1]


def direction_along(points: Array, positions: Array) -> str | None:
    """``with`` or ``against`` the order of the ``points`` (M, 3) of a path, for a vehicle at ``positions`` (N, 3), from
    the first to the last; None where it does not move."""
    if len(positions) < 2:
        return None
    nearest = int(np.argmin(np.linalg.norm(points - positions.mean(axis=0), axis=1)))
    ahead, behind = points[min(nearest + 1, len(points) - 1)], points[max(nearest - 1, 0)]
    along = float((ahead - behind) @ (positions[-1] - positions[0]))
    return "with" if along > 0 else "against" if along < 0 else None
