"""Which vehicle a measurement is of: the direction along its path as it was drawn, and as the cameras see it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_reports import measured

from paceline.documents.loading import load_clip
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.passage import direction_along, with_passage
from paceline.speed.results import PathDrawing

EXAMPLE = Path(__file__).parents[1] / "examples" / "straight" / "clip.yaml"


@pytest.mark.parametrize(("order", "direction"), [(1, "with"), (-1, "against")])
def test_the_direction_is_that_of_the_drawing(order: int, direction: str) -> None:
    """The example's lanes are drawn from afar, and its cars approach."""
    clip = load_clip(EXAMPLE)
    lane = clip.paths["lane0"]
    assert lane.left is not None and lane.right is not None
    lane = replace(lane, left=lane.left[::order], right=lane.right[::order], limit=12.0)
    path = path_from_document(lane, clip.rig)
    drawing = PathDrawing("lane0", path.points, *clip.rig.project(path.points))
    clip = replace(clip, paths={"lane0": lane})
    vehicle = with_passage(replace(measured("v0"), path=None, direction=None), clip, [drawing])
    assert (vehicle.path, vehicle.direction, vehicle.limit) == ("lane0", direction, 12.0)
    unreconstructed = with_passage(replace(measured("v0"), direction=None), clip, [])
    assert (unreconstructed.path, unreconstructed.direction) == ("lane0", None)


@pytest.mark.parametrize(
    ("step", "travel"),
    [
        ([0.1, 0, -1], "approaching"),
        ([-1, 0, 1.5], "receding"),
        ([-2, 0, 1.5], "to the left"),
        ([2, 0, 0], "to the right"),
        ([0.01, 0, 0.02], None),
        ([np.nan, 0, 1], None),
    ],
)
def test_how_the_cameras_see_it_drive(step: list[float], travel: str | None) -> None:
    vehicle = measured("v0")
    position = np.array([0.0, 1, 40]) + np.arange(len(vehicle.track.frame))[:, None] * np.array(step)
    assert replace(vehicle, track=replace(vehicle.track, position=position)).travel == travel


def test_a_vehicle_that_stands_has_no_direction() -> None:
    points = np.array([[0.0, 0, 10], [0, 0, 20], [0, 0, 30]])
    standing = np.full((3, 3), [0.0, 0, 18])
    assert direction_along(points, standing) is direction_along(points, standing[:1]) is None
    assert direction_along(points, standing + [[0, 0, 0], [0, 0, 1], [0, 0, 2]]) == "with"


def test_a_vehicle_that_was_never_tracked_was_not_seen() -> None:
    vehicle = measured("v0")
    lost = replace(vehicle, track=replace(vehicle.track, status=["lost"] * len(vehicle.track.frame)))
    assert lost.seen is None and lost.travel is None
    assert vehicle.seen == (3.0, pytest.approx(5.0))
