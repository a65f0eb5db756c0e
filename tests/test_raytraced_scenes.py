"""Scenes: what they may hold, the named ones, the varied ones, and the truth about them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from selection import slow_after
from tiny_scenes import tiny_follow, tiny_speed

from paceline.cameras import Quantity
from paceline.errors import UnusableInput
from paceline.simulation.operator import MIN_OUTLINE_WIDTH_PX, is_inside_image, visible_marking
from paceline.simulation.random_scenes.raytraced import (
    MAX_RAYTRACED_SPEED_MPS,
    MIN_RAYTRACED_SPEED_MPS,
    random_follow_scene,
    random_raytraced_bend,
    random_raytraced_straight,
    random_speed_scene,
)
from paceline.simulation.raytraced import named_scenes
from paceline.simulation.raytraced.scene import PlacedStereoScene, make_rigs
from paceline.simulation.raytraced.scene_yaml import FollowScene, SpeedScene, load_follow_scene, load_speed_scene
from paceline.simulation.raytraced.stereo_clip import write as write_stereo_clip
from paceline.simulation.vehicle_catalogue import RAYTRACED_KINDS
from paceline.units import MPS_PER_MPH


def place_scene(**changes: Any) -> PlacedStereoScene:
    return PlacedStereoScene(SpeedScene.model_validate(tiny_speed(**changes)))


varied = cache(random_speed_scene)


def frames_inside(placed: PlacedStereoScene, i: int) -> int:
    """Frames in which the ``i``-th vehicle's plane is wholly inside both pictures."""
    size, count = placed.rig.left.image_size, 0
    for t in placed.clocks[0].tolist():
        if placed.vehicles[i].is_there(t):
            corners = placed.vehicles[i].corners(t)
            ahead = all((view.to_camera(corners)[:, 2] > 1).all() for view in placed.views)
            count += ahead and all(is_inside_image(view.project(corners), size) for view in placed.views)
    return count


@pytest.mark.parametrize("name", [n for kind, n, _ in named_scenes.list_scenes() if kind == "speed"])
def test_named_vehicles_are_seen_for_long(name: str) -> None:
    scene = named_scenes.speed_scene(name)
    assert scene is not None
    placed = PlacedStereoScene(scene)
    for i in range(len(placed.vehicles)):
        assert frames_inside(placed, i) >= 8, placed.vehicles[i].model.id
        assert placed.vehicles[i].plane.end == "front"


def test_named_scenes_have_the_speeds_of_the_papers() -> None:
    speeds = {"straight-55": 55, "circle-36": 36, "recorded-straight-36": 36, "neil-28": 28, "lane-change-30": 30}
    for name, mph in speeds.items():
        scene = named_scenes.speed_scene(name)
        assert scene is not None and scene.vehicles[0].speed == pytest.approx(mph * 0.44704)
    circle = named_scenes.speed_scene("circle-36")
    assert circle is not None and circle.road.radius is not None
    assert np.degrees(circle.vehicles[0].speed / abs(circle.road.radius)) == pytest.approx(22.5, abs=0.01)


@pytest.mark.parametrize("name", [n for kind, n, _ in named_scenes.list_scenes() if kind == "follow"])
def test_named_chases_are_nists(name: str) -> None:
    scene = named_scenes.follow_scene(name)
    assert scene is not None
    assert (scene.chase.image_size, scene.rate, scene.lead.gap) == ([256, 242], 15, [5.0, 15.0])
    assert scene.chase.top_speed * 3.6 <= 35


@pytest.mark.parametrize("seed", slow_after(2, range(8)))
def test_varied_scenes_suit(seed: int) -> None:
    scene = varied(seed)
    assert scene == random_speed_scene(seed)
    assert MIN_RAYTRACED_SPEED_MPS <= scene.vehicles[0].speed <= MAX_RAYTRACED_SPEED_MPS
    assert frames_inside(PlacedStereoScene(scene), 0) >= 8
    assert random_follow_scene(seed) == random_follow_scene(seed)


@pytest.mark.slow
def test_suites_vary() -> None:
    scenes = [varied(seed) for seed in range(24)]
    cars = [scene.vehicles[0] for scene in scenes]
    assert len({car.kind for car in cars}) >= 4
    assert {car.oncoming for car in cars} == {True, False}
    assert len({scene.road.kind for scene in scenes}) == 3
    speeds = np.array([car.speed for car in cars]) * 3.6
    assert speeds.min() < 40 and speeds.max() > 100
    assert any(scene.rig.rig_error_std for scene in scenes) and any(scene.rig.rig_error_std is None for scene in scenes)


def check_watched(scene: SpeedScene) -> float:
    """The vehicle is seen from its first frame to its last; returns the sine of the least angle between the line
    and level."""
    placed = PlacedStereoScene(scene)
    car, left = placed.vehicles[0], placed.views[0]
    assert 8 <= scene.frames <= 12 and frames_inside(placed, 0) == scene.frames and scene.rig.rig_error_std is None
    for t in placed.clocks[0].tolist():
        sight = car.center(t) - left.centre
        outwards = car.motion.pose(t)[0][:, 0] * (1 if car.plane.end == "front" else -1)
        assert -outwards @ sight / np.linalg.norm(sight) > np.cos(np.radians(50.0))
        assert 15.0 < left.to_camera(car.corners(t))[:, 2].min() < 75.0
    assert all(np.ptp(view.project(car.corners(0.0))[:, 0]) > MIN_OUTLINE_WIDTH_PX for view in placed.views)
    driven = np.array([car.motion.position(t)[0] for t in placed.clocks[0].tolist()])
    _, lines = visible_marking(placed, car.model.lane, driven, lambda view, points: np.zeros(len(points), bool))
    steps = np.abs(np.diff(lines[0], axis=0))
    return float((steps[:, 1] / np.hypot(*steps.T)).min())


@pytest.mark.parametrize("radius", slow_after(0, [30.0, 45.0, 80.0]))
def test_varied_bends_turn_across_the_view(radius: float) -> None:
    slopes = []
    for seed in range(4):
        scene = random_raytraced_bend(seed, radius, 10.0)
        assert scene == random_raytraced_bend(seed, radius, 10.0) and scene.rate == 10.0
        assert abs(scene.road.radius or 0) == radius and 21 * MPS_PER_MPH < scene.vehicles[0].speed < 36 * MPS_PER_MPH
        slopes.append(check_watched(scene))
    assert radius == 80 or min(slopes) < 0.1  # there the line runs nearly along the epipolar lines


@pytest.mark.parametrize("seed", slow_after(2, range(12)))
def test_varied_straights_are_watched(seed: int) -> None:
    scene = random_raytraced_straight(seed)
    assert scene.road.kind == "straight" and 29 * MPS_PER_MPH < scene.vehicles[0].speed < 65 * MPS_PER_MPH
    check_watched(scene)


@pytest.mark.slow
def test_bends_vary() -> None:
    scenes = [random_raytraced_bend(seed) for seed in range(40)]
    cars = [scene.vehicles[0] for scene in scenes]
    assert {car.kind for car in cars} == set(RAYTRACED_KINDS) and {car.oncoming for car in cars} == {True, False}
    radii = np.array([scene.road.radius for scene in scenes])
    assert radii.min() < -60 and radii.max() > 60 and np.abs(radii).min() < 40
    assert np.mean([scene.light.clouds < 0.3 for scene in scenes]) > 0.6  # mostly in the sun


def test_the_planes_centre_swings_out_in_a_bend() -> None:
    """On a circle the plane, ahead of the rear axle by a, is faster than it by the root of 1 + (a / r)²."""
    placed = place_scene(road={"kind": "circle", "radius": -60.0, "length": 80.0})
    car = placed.vehicles[0]
    radius = 60.0 + placed.road.lanes[0]  # to the left of the axis lies the centre
    ahead = car.plane.center[0]
    assert car.speed(0.1) == pytest.approx(12.0 * np.sqrt(1 + (ahead / radius) ** 2), rel=2e-4)
    assert car.motion.speed(0.1) == 12.0


def test_a_receding_vehicle_shows_its_rear() -> None:
    car = {"id": "v0", "start": 20.0, "speed": 9.0, "lane": 1}
    assert place_scene(vehicles=[car]).vehicles[0].plane.end == "rear"


def test_a_vehicle_that_overtakes_the_cameras_shows_its_rear() -> None:
    """It begins behind them, where its front is the nearer end."""
    placed = place_scene(frames=10)
    eye = placed.road.locate(placed.views[0].centre, 0.0, 0.0)[0]
    car = {"id": "v0", "start": eye - 2.0, "speed": 20.0, "lane": 1}
    overtaking = place_scene(vehicles=[car], frames=10)
    depths = [overtaking.views[0].to_camera(overtaking.vehicles[0].motion.pose(t)[1])[2] for t in overtaking.times[0]]
    assert depths[0] < 0 < depths[-1]
    assert overtaking.vehicles[0].plane.end == "rear"


def test_both_directions_can_be_simulated_from_the_start() -> None:
    """One vehicle comes from far away; the other begins beside the cameras, out of their view, and drives away."""
    eye = place_scene().scene.rig.eye.along
    cars = [
        {"id": "v0", "start": 60.0, "speed": 12.0, "lane": 0, "oncoming": True},
        {"id": "v1", "start": eye, "speed": 12.0, "lane": 1},
    ]
    placed = place_scene(vehicles=cars, frames=25)
    assert [car.plane.end for car in placed.vehicles] == ["front", "rear"]
    placed.check_outlines()
    assert all(frames_inside(placed, i) >= 3 for i in (0, 1))


def test_the_face_is_the_one_that_is_first_in_view() -> None:
    """On a closed bend a vehicle comes nearer and then drives away: where it is farthest ahead it shows its rear."""
    rig = {
        "image_size": [1280, 960],
        "focal": 1000.0,
        "eye": {"along": 60.0, "right": -20.0, "height": 2.0},
        "target": {"along": 60.0, "right": 0.0, "height": 0.5},
    }
    car = {"id": "v0", "start": 15.0, "speed": 10.0, "lane": 1}
    placed = place_scene(road={"kind": "circle", "radius": 25.0, "length": 130.0}, rig=rig, vehicles=[car], frames=112)
    first, last = (placed.vehicles[0].motion.pose(t) for t in placed.times[0, [0, -1]])
    sides = [(placed.views[0].centre - origin) @ R[:, 0] for R, origin in (first, last)]
    assert sides[0] > 0 > sides[1]
    assert placed.vehicles[0].plane.end == "front"


def test_a_vehicle_out_of_view_is_refused_before_the_scene_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a mesh was built")

    monkeypatch.setattr(PlacedStereoScene, "static_meshes", refuse)
    away = {"id": "v9", "start": 79.0, "speed": 1.0, "oncoming": True}
    scene = SpeedScene.model_validate(tiny_speed(vehicles=[away], road={"length": 300.0}, frames=2))
    with pytest.raises(UnusableInput, match="vehicle v9: is never wholly visible and 24 px wide"):
        write_stereo_clip(scene, tmp_path / "clip")
    assert not (tmp_path / "clip").exists()


def test_wheels_roll_without_slipping() -> None:
    """The point of a wheel that touches the road stands still."""
    placed = place_scene()
    car, body = placed.vehicles[0], placed.vehicles[0].body
    wheel = body.wheels[0]
    R, at = car.placements(0.3)[1]
    bottom = R.T @ (car.motion.pose(0.3)[0] @ (wheel.center - [0, 0, wheel.radius]) + car.motion.pose(0.3)[1] - at)
    there = [car.placements(t)[1] for t in (0.2995, 0.3005)]
    speed = np.linalg.norm((there[1][0] @ bottom + there[1][1]) - (there[0][0] @ bottom + there[0][1])) / 1e-3
    assert speed < 0.02 * car.motion.speed(0.3)


def test_the_written_rig_is_the_true_one_by_default() -> None:
    true, same = make_rigs(SpeedScene.model_validate(tiny_speed()))
    assert same is true and true.uncertainty is None
    assert [camera.readout for camera in true.cameras] == [Quantity(0.0)] * 2
    written = {"focal_length_px": 2.0, "rotation_rad": [1e-4, 1e-4, 1e-4], "translation_m": [1e-3, 1e-3, 1e-3]}
    rig = tiny_speed()["rig"] | {"rig_error_std": written}
    deviations = []
    for seed in range(400):
        true, other = make_rigs(SpeedScene.model_validate(tiny_speed(seed=seed, rig=rig)))
        assert other.uncertainty is not None
        turn = cv2.Rodrigues(other.R @ true.R.T)[0].ravel() / 1e-4
        focal = (other.left.K[0, 0] - true.left.K[0, 0]) / 2.0
        deviations.append([*turn, *((other.t - true.t) / 1e-3), focal])
    n = 7 * 400
    assert np.std(deviations) == pytest.approx(1.0, abs=4 / np.sqrt(2 * n))
    assert abs(np.mean(deviations)) < 4 / np.sqrt(n)


def test_the_written_rig_states_only_what_is_true() -> None:
    rig = tiny_speed()["rig"] | {"rig_error_std": {"focal_length_px": 2.0}, "states_uncertainty": False}
    true, other = make_rigs(SpeedScene.model_validate(tiny_speed(rig=rig, sensor={"readout": 0.02, "bands": 4})))
    assert other.uncertainty is not None and other.uncertainty.is_assumed
    assert [camera.readout for camera in (*true.cameras, *other.cameras)] == [None] * 4


def test_rows_read_late_show_vehicles_later() -> None:
    slow = place_scene(sensor={"readout": 0.05, "bands": 4})
    at_once, car, view = place_scene(), slow.vehicles[0], slow.views[0]
    seen = slow.project_plane(0, car, 0.1)
    for corner, pixel in zip(range(4), seen, strict=True):
        delay = float(slow.shutters[0].row_delay(pixel[1], 144))
        assert pixel == pytest.approx(view.project(car.corners(0.1 + delay))[corner], abs=1e-4)
    assert np.abs(seen - at_once.project_plane(0, car, 0.1)).max() > 0.05


WRONG = [
    ({"frames": 0}, "frames: expected at least 1"),
    ({"colour": 1}, "unknown key 'colour'"),
    ({"kind": "follow"}, "kind: expected 'speed'"),
    ({"vehicles": []}, "vehicles: expected 1 values"),
    ({"vehicles": [{"id": "a", "start": 36.0, "speed": 9.0, "lane": 2}]}, "vehicles[0].lane: expected one of 0 to 1"),
    ({"vehicles": [{"id": "a", "start": 36.0, "speed": 9.0, "kind": "tank"}]}, "vehicles[0].kind: expected 'saloon'"),
    ({"vehicles": [{"id": "a", "start": 36.0, "speed": 9.0}] * 2}, "'a' occurs twice"),
    ({"light": {"clouds": 1.5}}, "light.clouds: expected at most 1"),
]


@pytest.mark.parametrize(("change", "text"), WRONG, ids=[text for _, text in WRONG])
def test_wrong_scenes_are_refused_in_one_line(tmp_path: Path, change: dict[str, Any], text: str) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump(tiny_speed(**change)))
    with pytest.raises(UnusableInput) as refused:
        load_speed_scene(file)
    assert text in str(refused.value) and str(refused.value).startswith(str(file))
    assert "\n" not in str(refused.value)


def test_earlier_names_of_keys_are_accepted() -> None:
    car = {"id": "a", "start": 36.0, "speed": 9.0, "acceleration": 1.0}
    rig, sensor = tiny_speed()["rig"], {"quality": 80}
    old = tiny_speed(
        vehicles=[car | {"towards": True, "guess": 8.0, "after": 0.5, "lasting": 1.0}],
        rig=rig | {"written": {"focal_length_px": 1.0}, "stated": False},
        sensor=sensor | {"open_for": 0.002, "keep": "jpeg"},
        clicks={"corner": 1.0},
    )
    times = {"acceleration_start": 0.5, "acceleration_duration": 1.0}
    new = tiny_speed(
        vehicles=[car | {"oncoming": True, "initial_speed": 8.0} | times],
        rig=rig | {"rig_error_std": {"focal_length_px": 1.0}, "states_uncertainty": False},
        sensor=sensor | {"shutter_s": 0.002, "image_format": "jpeg"},
        operator_noise={"corner": 1.0},
    )
    assert SpeedScene.model_validate(old) == SpeedScene.model_validate(new)
    assert SpeedScene.model_validate(SpeedScene.model_validate(old).model_dump()) == SpeedScene.model_validate(new)
    chases = (FollowScene.model_validate(tiny_follow(chase={key: 2.0})) for key in ("bounce", "shake_px"))
    assert next(chases) == next(chases)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"sensor": {"keep": "bmp"}}, "sensor.keep: expected 'png'"),
        ({"sensor": {"keep": "png", "image_format": "png"}}, "image_format and keep: one key under two names"),
        ({"sensor": {"image_formt": "png"}}, "unknown key 'image_formt'; did you mean 'image_format'"),
    ],
)
def test_a_key_is_refused_by_the_name_in_the_file(tmp_path: Path, change: dict[str, Any], text: str) -> None:
    test_wrong_scenes_are_refused_in_one_line(tmp_path, change, text)


def test_gaps_are_in_order(tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump(tiny_follow(lead={"gap": [9.0, 5.0]})))
    with pytest.raises(UnusableInput, match="expected a smaller and a larger distance"):
        load_follow_scene(file)
    assert FollowScene.model_validate(tiny_follow()).lead.kind == "van"


def test_roads_that_contradict_themselves_are_refused() -> None:
    with pytest.raises(UnusableInput, match="radius"):
        place_scene(road={"kind": "circle", "length": 80.0})
    with pytest.raises(UnusableInput, match=r"vehicles\[0\]: start 500 m"):
        place_scene(vehicles=[{"id": "a", "start": 500.0, "speed": 9.0}])
