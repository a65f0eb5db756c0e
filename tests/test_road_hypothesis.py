"""An outline that stands still: a vehicle is measured, the empty road is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from selection import slow_after

from paceline.documents.loading import Clip, load_clip
from paceline.simulation.stereo.clip import Scene, Vehicle, render, write
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.measurement import measure_clip

STANDING = 1e-9  # m/s
SCENE = Scene(
    5,
    (Vehicle("v0", STANDING, start_distance=32.0, texture_seed=3),),
    image_size=(640, 480),
    focal=1400.0,
    rate=5.0,
    frames=6,
)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    return load_clip(write(render(SCENE), tmp_path_factory.mktemp("clip")))


def on_the_road(clip: Clip, near: float, length: float, lateral: float) -> Clip:
    """``clip`` with its vehicle's outlines around 2 m of the road's width, from ``near`` m along the path on."""
    (vehicle,) = clip.vehicles
    assert vehicle.path is not None
    path = path_from_document(clip.paths[vehicle.path], clip.rig)
    start = path.nearest(np.zeros(3))
    ahead = np.sign(path.nearest(np.array([0.0, 0.0, 40.0])) - start)
    corners = []
    for distance, side in ((near + length, -1), (near + length, 1), (near, 1), (near, -1)):
        s = np.array(start + ahead * distance)
        across = ahead * path.frames(s)[:, 1]
        corners.append(path.at(s) + (lateral + side) * across)
    left, right = clip.rig.project(np.array(corners))
    return replace(clip, vehicles=[replace(vehicle, left=left, right=right)])


@pytest.mark.parametrize("near, length, lateral", slow_after(1, [(26.0, 4.0, -1.5), (19.0, 3.0, 1.5)]))
def test_the_empty_road_is_no_vehicle(clip: Clip, near: float, length: float, lateral: float) -> None:
    (m,) = measure_clip(on_the_road(clip, near, length, lateral)).measurements
    assert (m.verdict, m.reason_code) == ("rejected", "on_the_road_surface")


def test_a_vehicle_that_stands_is_measured(clip: Clip) -> None:
    (m,) = measure_clip(clip).measurements
    assert m.verdict == "measured", m.reason
    assert abs(m.speed) < 0.05


def test_an_outline_without_a_path_is_not_compared_with_a_road(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "paceline.speed.acceptance.log_likelihood_ratio_of_road", lambda *_: pytest.fail("it has been compared")
    )
    (vehicle,) = clip.vehicles
    (m,) = measure_clip(replace(clip, vehicles=[replace(vehicle, path=None)])).measurements
    assert m.reason_code != "on_the_road_surface"
