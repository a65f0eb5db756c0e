"""The part of a vehicle's face that is measured, over all that was seen of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from painted_faces import CARD, FRAMES, face_with, texture_up_to
from small_road import scene
from test_vehicles_looking import frame, lit
from test_vehicles_looking import way as lane

from paceline.recordings import StereoFrame
from paceline.simulation.planar import Vehicle, World, render
from paceline.speed.paths import from_points
from paceline.vehicles.finding import ALIKE, first_speed
from paceline.vehicles.plane import face_of, likeness
from paceline.vehicles.sightings import Sighting
from paceline.vehicles.tracks import Track
from paceline.vehicles.ways import Way

HEIGHT, FOOT = 1.6, 0.62  # m, of all that is seen, and of a windscreen's lower edge


@pytest.mark.parametrize("seed", [2, 3])
@pytest.mark.parametrize(("lane", "width"), [(-1.85, 0.8), (-3.0, 0.8), (-3.0, 1.8)])
def test_a_face_is_where_it_is_though_the_vehicle_leaves_the_pictures_at_last(
    seed: int, lane: float, width: float
) -> None:
    """It is seen best when the pictures cut it off already, and what they repeat beyond their edges agrees anywhere."""
    of = scene(Vehicle("v0", 16.0, start_distance=60.0, lane=lane, texture_seed=seed, width=width), frames=17)
    clip, world = render(of), World(of)
    way = Way("lane0", world.rig, from_points("lane0", "line", world.road.point(np.array([80.0, 12.0]), lane)))
    track, true, whole = Track(), {}, {}
    for row in clip.truth:
        k, left = row["frame"], np.array(row["left"])
        if left[:, 0].max() > 20:  # px of it are left
            views = np.float32(clip.left[k]), np.float32(clip.right[k])
            pair = StereoFrame(k, float(clip.times[k]), *views, 0.0, duplicate=False)
            true[k], whole[k] = way.on_card(np.array(row["position"]))[0], row["inside"]
            x, y = (-0.5 * width, 0.5 * width), (0.2, HEIGHT)
            track.add(Sighting(k, pair.time, way, true[k], x, y, 1.5, 9.0, views, np.zeros((2, 2))))
    assert not whole[track.kept[-1].frame]
    face = face_of(track)
    assert face is not None
    found = {at.sighting.frame: at.s for at in face.aligned if whole[at.sighting.frame]}
    assert set(found) == {s.frame for s in track.kept if whole[s.frame]}
    assert all(abs(found[k] - true[k]) < 0.25 for k in found)  # m


@pytest.mark.parametrize("light", [2.0, 2.5])
def test_a_face_at_night_is_where_its_lamps_are_and_not_where_their_light_lies(light: float) -> None:
    """It was seen so many metres nearer, as far as the light on the road reaches."""
    track, true = Track(), 10.0 + 2.5 * np.arange(6)
    spots = [(0.0, x, 0.6, width, peak) for x in (-0.6, 0.6) for width, peak in ((0.1, 700.0), (0.7, 60.0))]
    for k, s in enumerate(true):
        views = lit(s, [*spots, (light, 0.0, 0.5, 0.9, 60.0)])
        at = frame(k)
        track.add(Sighting(k, at.time, lane(), s + light, (-1.2, 1.2), (0.2, 1.5), 1.5, 9.0, views, np.zeros((2, 2))))
    face = face_of(track)
    assert face is not None
    off = [(at.s - s) / at.sighting.error(0.0, 1.0) for at, s in zip(face.aligned, true, strict=True)]
    assert np.abs(off).max() < 0.3  # px of disparity


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("slope", [2.0, 3.5])
def test_a_face_is_not_taken_for_the_windscreen_above_it(seed: int, slope: float) -> None:
    """That has far more contrast, and leans back by so many metres a metre."""
    world, track, rng = World(scene(Vehicle("v0", 16.0, start_distance=60.0))), Track(), np.random.default_rng(seed)
    way = Way("lane0", world.rig, from_points("lane0", "line", world.road.point(np.array([80.0, 12.0]), 1.85)))
    texture, true = texture_up_to(CARD.top, seed) - 100.0, 34.0 + 4.0 * np.arange(FRAMES)
    texture[:, np.abs(CARD.x) > 0.85] = 0.0
    strips = [(0.0, 0.0, FOOT), *((slope * (y - FOOT), y, y + 0.06) for y in np.arange(FOOT, 1.3, 0.06))]
    for k, s in enumerate(true):
        pictures = [np.full(camera.image_size[::-1], 100.0) for camera in world.rig.cameras]
        for behind, low, high in strips:
            rows = (CARD.y >= low) & (CARD.y < high)
            card = np.where(rows[:, None], texture * (1.0 if low < FOOT else 3.0), 0.0)
            for picture, H in zip(pictures, way.homographies(s - behind), strict=True):
                picture += cv2.warpPerspective(card, H @ CARD.to_metres, picture.shape[::-1])
        views = [np.float32(cv2.GaussianBlur(p, (0, 0), 0.8) + rng.normal(0.0, 1.0, p.shape)) for p in pictures]
        pair = views[0], views[1]
        track.add(Sighting(k, 0.2 * k, way, s - slope / 4, (-0.85, 0.85), (0.2, 1.6), 1.5, 9.0, pair, np.zeros((2, 2))))
    found = face_of(track)
    assert found is not None
    off = [(at.s - s) / at.sighting.error(0.0, 1.0) for at, s in zip(found.aligned, true, strict=True)]
    assert np.abs(off).max() < 0.3  # px of disparity


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_face_that_is_partly_covered_looks_less_like_itself(seed: int, side: int) -> None:
    """By a third at its side, in some of the frames, by something with as much contrast."""
    texture, covered = texture_up_to(CARD.top, seed), 4
    other = np.where(side * CARD.x > 0.25, texture_up_to(CARD.top, seed + 10), texture).astype(np.float32)
    face = face_with(texture, seed, (other, covered))
    alike = likeness(face, face.aligned)
    assert alike.shape == (FRAMES,)
    assert alike[:covered].max() < ALIKE * np.median(alike) < alike[covered:].min()


def test_the_first_speed_is_that_of_the_first_half_if_it_moves() -> None:
    seen = face_with(texture_up_to(CARD.top, 1), 1).aligned
    assert first_speed(seen) == pytest.approx(20.0)  # 2 m in a tenth of a second
    assert first_speed(seen[:3]) is None
    standing = [replace(a, s=seen[0].s) for a in seen[:5]] + seen[5:]
    assert first_speed(standing) is None  # clip.yaml holds no speed of zero
