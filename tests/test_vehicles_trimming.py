"""The top of a face that is left away where it tells nothing of the motion."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from small_road import scene

from paceline.simulation.planar import Vehicle, World
from paceline.speed.paths import from_points
from paceline.vehicles.plane import Aligned, Face
from paceline.vehicles.sightings import Sighting
from paceline.vehicles.trimming import LOWER, LOWEST, trimmed
from paceline.vehicles.ways import Grid, Way

Image = NDArray[np.float32]

CARD = Grid(left=-1.2, top=1.6, bottom=0.0, cell=0.02)
X, BOTTOM, TOP = (-0.7, 0.7), 0.3, 1.2  # m, of the outline
SPEED, FRAMES = 2.0, 9  # m a frame
RIM = 0.1  # m: 2 px of the farthest view


def face_with(texture: Image, seed: int) -> Face:
    """A face that comes 2 m a frame, all of it as outlined, and on its card nothing but the ``texture`` (H, W)."""
    world, rng = World(scene(Vehicle("v0", 16.0, start_distance=60.0), frames=FRAMES)), np.random.default_rng(seed)
    way = Way("lane0", world.rig, from_points("lane0", "line", world.road.point(np.array([80.0, 12.0]), 1.85)))
    aligned = []
    for k in range(FRAMES):
        s, views = 35.0 + SPEED * k, []
        for H, camera in zip(way.homographies(s), world.rig.cameras, strict=True):
            view = cv2.warpPerspective(texture, H @ CARD.to_metres, camera.image_size, borderValue=100.0)
            view = cv2.GaussianBlur(view, (0, 0), 0.8) + rng.normal(0.0, 1.0, view.shape)
            views.append(np.float32(view))
        pair = views[0], views[1]
        sighting = Sighting(k, 0.1 * k, way, s, X, (BOTTOM, TOP), 1.5, 9.0, pair, np.zeros((2, 2)))
        aligned.append(Aligned(sighting, s, np.zeros(2), 1.0))
    return Face(X, (BOTTOM, TOP), aligned, 0.9)


def texture_up_to(height: float, seed: int) -> Image:
    """Blotches of a few centimetres from the road up to a ``height``, and flat grey above."""
    columns, rows = CARD.size
    blotches = cv2.GaussianBlur(np.random.default_rng(seed).normal(0.0, 1.0, (rows, columns)), (0, 0), 2.0)
    card = 100.0 + 30.0 * blotches / blotches.std()
    card[CARD.y > height] = 100.0
    return np.float32(card)


def clear(lower: Face) -> bool:
    return True


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("height", [0.75, 0.95])
def test_what_is_flat_at_the_top_of_a_face_is_left_away(height: float, seed: int) -> None:
    face = face_with(texture_up_to(height, seed), seed)
    lower = trimmed(face, face.aligned, clear)
    assert lower.x == face.x and lower.y[0] == BOTTOM and lower.aligned is face.aligned
    # what is flat goes but for a step, and the rim of an outline, which is not looked at; of what has texture no more
    # than a third, even if every row said as much
    assert BOTTOM + (height - BOTTOM) * 2 / 3 - LOWER < lower.y[1] < height + LOWER + RIM


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_a_face_with_texture_everywhere_most_stays(seed: int) -> None:
    face = face_with(texture_up_to(CARD.top, seed), seed)
    assert trimmed(face, face.aligned, clear).y[1] > BOTTOM + (TOP - BOTTOM) * 2 / 3 - LOWER


def test_a_low_face_and_one_seen_too_seldom_stay_as_they_are() -> None:
    face = face_with(texture_up_to(0.75, 1), 1)
    assert trimmed(face, face.aligned[:3], clear) is face
    low = Face(X, (BOTTOM, BOTTOM + LOWEST), face.aligned, 0.9)
    assert trimmed(low, low.aligned, clear) is low


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_face_without_any_texture_stays_as_it_is(seed: int) -> None:
    """Noise would choose its height."""
    flat = face_with(texture_up_to(0.0, seed), seed)
    assert trimmed(flat, flat.aligned, clear) is flat


def test_no_outline_is_taken_that_is_not_clear() -> None:
    face = face_with(texture_up_to(0.75, 1), 1)
    assert trimmed(face, face.aligned, lambda lower: False) is face
    assert trimmed(face, face.aligned, lambda lower: lower.y[1] > 1.1).y[1] == pytest.approx(TOP - LOWER)


def test_a_face_whose_pictures_hold_no_numbers_stays_as_it_is() -> None:
    face = face_with(texture_up_to(0.75, 1), 1)
    for a in face.aligned:
        a.sighting.crops[0][:] = np.nan
    assert trimmed(face, face.aligned, clear) is face
