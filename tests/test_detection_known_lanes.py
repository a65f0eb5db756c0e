"""Detected lanes along which a clip has a path already."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from painted_road import make_rig

from paceline.detection.known_lanes import runs_along, without_known
from paceline.documents.loading import Clip, PathDocument
from paceline.lanes.lane_proposals import Lane
from paceline.speed.geometry.paths import from_points

RIG = make_rig()
WIDTH_M = 3.5


def straight(x: float, near: float = 10.0, far: float = 60.0) -> np.ndarray:
    """Points (N, 3) along the road, ``x`` m to the right of the left camera."""
    z = np.linspace(near, far, 40)
    return np.column_stack([np.full_like(z, x), np.full_like(z, 3.0), z])


def lane(x: float) -> Lane:
    pixels = np.zeros((2, 2))
    return Lane(("1", "2"), WIDTH_M, 0.05, "line", pixels, pixels, from_points("lane", "line", straight(x)))


def clip(**paths: PathDocument) -> Clip:
    left = right = Path("left")
    return Clip(Path("clip.yaml"), left, right, 5.0, None, None, None, RIG, paths, [], ("left", "right"))


def surveyed(name: str, x: float, offset: float) -> PathDocument:
    return PathDocument(name, "line", None, None, offset, straight(x))


@pytest.mark.parametrize(
    ("x", "near", "far", "known"),
    [
        (0.0, 10, 60, True),
        (0.8, 10, 60, True),  # drawn by hand, not quite in the middle
        (0.0, 20, 40, True),  # a part of it
        (1.75, 10, 60, False),  # the line at its edge
        (3.5, 10, 60, False),  # the lane beside it
        (0.0, 90, 120, False),  # farther along the road
    ],
)
def test_a_path_runs_along_a_lane(x: float, near: float, far: float, known: bool) -> None:
    path = from_points("drawn", "line", straight(x, near, far))
    assert runs_along(lane(0.0), path) == known
    assert runs_along(lane(0.0), path.reversed()) == known


def test_lanes_with_a_path_are_left_out_and_named() -> None:
    """The line between the first two lanes is drawn: the vehicles on both of its sides are found by it."""
    lanes = [lane(-WIDTH_M), lane(0.0), lane(WIDTH_M)]
    level = np.array([[100.0, 300.0], [700.0, 300.0]])  # along the baseline: no path in space comes of it
    undetermined = PathDocument("level", "line", level, level, 0.0, None)
    middle = surveyed("middle", -WIDTH_M / 2, WIDTH_M / 2)
    added, remarks = without_known(lanes, clip(level=undetermined, middle=middle))
    assert added == lanes[2:]
    assert [remark.code for remark in remarks] == ["lane_known"] * 2 and "path middle runs along it" in remarks[0]
    assert without_known(lanes, clip()) == (lanes, [])


def test_a_lane_without_a_path_of_its_own_stays() -> None:
    unknown = replace(lane(0.0), path=None)
    assert without_known([unknown], clip(here=surveyed("here", 0.0, 0.0))) == ([unknown], [])
