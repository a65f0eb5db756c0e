"""What the benchmarks paint on rendered traffic: at night a vehicle shines where it can be seen, and only there."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_road import scene

from paceline.simulation.stereo.clip import Vehicle, World

FRAME = 0


@pytest.fixture(scope="module")
def distractors() -> ModuleType:
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    try:
        return importlib.import_module("distractors")
    finally:
        sys.path.pop(0)


def vehicle(name: str, distance: float, lane: float = 0.0) -> Vehicle:
    """One that comes nearer, with its headlamps on."""
    return Vehicle(name, 10.0, start_distance=distance, lane=lane)


def light_of(distractors: ModuleType, *vehicles: Vehicle) -> NDArray[np.float32]:
    """What the lamps of ``vehicles`` add to the left view."""
    world = World(scene(*vehicles, camera_height=1.2, road_direction=0.0))
    image = np.zeros(world.views[0].camera.image_size[::-1], np.float32)
    distractors.night(image, world, 0, FRAME)
    return image


def test_lamps_behind_a_nearer_vehicle_do_not_shine(distractors: ModuleType) -> None:
    near, far, beside = vehicle("near", 34.0), vehicle("far", 40.0), vehicle("far", 40.0, lane=-3.7)
    alone = light_of(distractors, near)
    for order in ((near, far), (far, near)):
        assert (light_of(distractors, *order) - alone).max() < 0.05 * light_of(distractors, far).max()
    assert (light_of(distractors, near, beside) - alone).max() > 0.9 * light_of(distractors, beside).max()


def test_light_outside_the_picture_is_not_hidden(distractors: ModuleType) -> None:
    image = np.zeros((20, 30), np.float32)
    for at, hidden, share in (((15.0, 10.0), 0, 1.0), ((15.0, 10.0), 1, 0.0), ((-50.0, 10.0), 0, 1.0)):
        shown = distractors._glow(image, np.array(at), 2.0, 1.0, np.full(image.shape, hidden, np.uint8))
        assert shown == pytest.approx(share)
    assert image.max() == pytest.approx(1.0)  # the first one's


def test_what_is_too_near_to_shine_still_hides_what_is_behind_it(distractors: ModuleType) -> None:
    close, far = Vehicle("close", 10.0, start_distance=2.5, lane=0.0, receding=True), vehicle("far", 40.0)
    assert light_of(distractors, close).max() == 0.0
    assert light_of(distractors, close, far).max() < 0.5 * light_of(distractors, far).max()
