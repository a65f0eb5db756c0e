"""The planar-texture generator: pictures exact to a few thousandths of a pixel, truth and files that agree."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from paceline.cameras import Quantity
from paceline.documents.loading import load_clip
from paceline.simulation.lane_change import LaneChange
from paceline.simulation.random_scenes.drawn import random_bend, random_crossing, random_scene
from paceline.simulation.stereo.clip import SCENE_SUBPIXELS_PER_SIDE, Scene, Vehicle, World, render, write
from paceline.simulation.stereo.scene import Motion, PlacedRoad, Pose, make_rig, rig_views
from paceline.simulation.stereo.textured_planes import TexturedPlane, composite, draw_planes
from paceline.simulation.textures import Texture

Array = NDArray[np.float64]

CAR = Vehicle("v0", 20.0, start_distance=60.0)
SMALL = Scene(seed=4, vehicles=(CAR,), image_size=(640, 480), focal=1400.0, frames=6)
CURVE = replace(SMALL, radius=-150.0, road_depth=45.0, vehicles=(replace(CAR, acceleration=1.5, lateral=0.3),))


def disc_card(pose: Pose, centre: tuple[float, float], radius: float) -> TexturedPlane:
    """A dark 1.8 × 0.64 m card with a bright disc, given in metres from its top-left corner."""
    rows, columns, width, height = 352, 992, 1.8, 0.64
    x, y = np.meshgrid((np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows)
    bright = np.clip((radius - np.hypot(x - centre[0], y - centre[1])) * rows / height + 0.5, 0, 1)
    texture = Texture((20 + 200 * bright).astype(np.float32), np.ones((rows, columns), np.float32))
    q = pose.corners(width, height)
    return TexturedPlane(texture, q[0], q[1] - q[0], q[3] - q[0])


def centroid_within(outline: Array) -> Array:
    """Centroid (2,) of the area inside a closed polygon (N, 2)."""
    (x, y), (x2, y2) = outline.T, np.roll(outline, -1, axis=0).T
    cross = x * y2 - x2 * y
    return np.asarray(np.array([((x + x2) * cross).sum(), ((y + y2) * cross).sum()]) / (3 * cross.sum()))


@pytest.mark.parametrize("distance", [15.0, 30.0, 80.0])
@pytest.mark.parametrize("yaw", [-0.3, 0.02])
def test_a_disc_is_drawn_at_its_projection(distance: float, yaw: float) -> None:
    scene = replace(SMALL, focal=2200.0, road_direction=yaw, road_depth=distance, camera_height=1.2, tilt=0.01)
    vehicle = Vehicle("v0", 10.0, start_distance=distance, lane=0.0137 * distance)
    card = disc_card(Motion(PlacedRoad(scene), vehicle, 1.0).pose(0.013), (0.71, 0.35), 0.2)
    angles = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    rim = np.array([0.71, 0.35]) + 0.2 * np.column_stack([np.cos(angles), np.sin(angles)])
    world = card.corner + rim / np.array([1.8, 0.64]) @ np.stack([card.across, card.down])
    v, u = np.mgrid[:480, :640]
    for view in rig_views(make_rig(scene)):
        image = np.full((480, 640), 20, np.float32)
        composite(image, draw_planes([card], view, 0.6, SCENE_SUBPIXELS_PER_SIDE))
        weight = image.astype(float) - 20
        seen = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
        np.testing.assert_allclose(seen, centroid_within(view.project(world)), atol=0.008)


def test_the_picture_moves_as_the_truth_moves() -> None:
    """A whole vehicle crosses square to the view: its picture is shifted by what the truth says."""
    crossing = replace(SMALL, noise_sigma=0.0, rate=100.0, frames=4, road_direction=np.pi / 2, road_depth=20.0)
    vehicle = Vehicle("v0", 5.0, start_distance=20.0, width=2.5, plane="side")
    clip = render(replace(crossing, vehicles=(vehicle,), draw_path=False, tilt=0.0))
    first = np.array(clip.truth[0]["left"])
    (x, y), (x2, y2) = first.min(0).astype(int) + 8, first.max(0).astype(int) - 7
    for image, row in zip(clip.left[1:], clip.truth[1:], strict=True):
        moved = (np.array(row["left"]) - first).mean(0)
        # The later picture, read where the truth says, is the first one again.
        M = np.array([[1, 0, moved[0]], [0, 1, moved[1]]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        back = cv2.warpAffine(image.astype(np.float32), M, image.shape[::-1], flags=flags)[y:y2, x:x2]
        a = clip.left[0].astype(np.float64)
        dx = (np.roll(a, -1, 1) - np.roll(a, 1, 1))[y:y2, x:x2] / 2
        error = ((back - a[y:y2, x:x2]) * dx).sum() / (dx**2).sum()
        assert abs(error) < 0.01


@pytest.mark.parametrize("scene", [SMALL, replace(CURVE, skew_s=0.003)])
def test_truth_is_the_projection_of_the_plane(scene: Scene) -> None:
    world = World(scene)
    vehicle = scene.vehicles[0]
    motion = Motion(PlacedRoad(scene), vehicle, 2.0)
    for row in world.truth:
        pose, later = motion.pose(row["time_s"]), motion.pose(row["time_s"] + scene.skew_s)
        left, _ = world.rig.project(pose.corners(vehicle.width, vehicle.height))
        _, right = world.rig.project(later.corners(vehicle.width, vehicle.height))
        np.testing.assert_allclose(row["left"], left, atol=1e-6)
        np.testing.assert_allclose(row["right"], right, atol=1e-6)
        np.testing.assert_allclose(row["position"], pose.centre, atol=1e-9)
        assert left[0, 0] < left[1, 0] and left[0, 1] < left[3, 1]  # top-left first, then top-right


@pytest.mark.parametrize(
    "vehicle",
    [
        CAR,
        replace(CAR, acceleration=-2.0, heading_error=0.02),
        replace(CAR, receding=True, start_distance=20.0, lane_change=LaneChange(5.0, 40.0, 3.0)),
        replace(CAR, plane="side", lateral=-1.0),
    ],
)
@pytest.mark.parametrize("radius", [None, 90.0, -90.0])
def test_the_centre_moves_at_the_stated_speed(vehicle: Vehicle, radius: float | None) -> None:
    motion = Motion(PlacedRoad(replace(SMALL, radius=radius, tilt=0.05, road_direction=0.1)), vehicle, 3.0)
    h = 1e-3
    for t in np.linspace(0, 3, 13):
        before, now, after = (motion.pose(float(t + dt)) for dt in (-h, 0, h))
        velocity = (after.centre - before.centre) / (2 * h)
        assert np.linalg.norm(velocity) == pytest.approx(vehicle.speed + vehicle.acceleration * t, rel=1e-5)
        travel = velocity / np.linalg.norm(velocity)
        normal = now.axes[:, 2]
        assert abs(travel @ normal) == pytest.approx(1 if vehicle.plane == "front" else 0, abs=1e-4)
        np.testing.assert_allclose(now.axes.T @ now.axes, np.eye(3), atol=1e-9)
        assert np.linalg.det(now.axes) == pytest.approx(1)


@pytest.mark.parametrize("receding", [False, True])
def test_the_lateral_offset_leads_from_the_line_to_the_vehicle(receding: bool) -> None:
    scene = replace(SMALL, vehicles=(replace(CAR, receding=receding, start_distance=40.0),))
    world = World(scene)
    a, b = (np.array(row["position"]) for row in world.truth[:2])
    travel = (b - a) / np.linalg.norm(b - a)
    right_of_travel = np.cross(world.road.down, travel)
    line = world.road.point(np.array(40.0), scene.line_offset)
    assert (a - line) @ right_of_travel == pytest.approx(world.clip["paths"]["lane0"]["lateral_offset"])


def test_clicks_and_lines_scatter_as_stated() -> None:
    clicks, misses = [], []
    for seed in range(60):
        world = World(replace(SMALL, seed=seed, click_sigma=0.5, line_sigma=0.4))
        entry = world.clip["vehicles"][0]
        row = world.truth[entry["frame"]]
        clicks += [np.array(entry[side]) - row[side] for side in ("left", "right")]
        path = world.clip["paths"]["lane0"]
        ends = world.road.point(np.array([10.0, 70.0]), SMALL.line_offset)
        for side, view in zip(("left", "right"), world.views, strict=True):
            p, q = view.project(ends)
            across = np.array([-(q - p)[1], (q - p)[0]]) / np.linalg.norm(q - p)
            misses.append((np.array(path[side]) - p) @ across)
        assert path["left"][0] != path["right"][0]
    assert np.std(clicks) == pytest.approx(0.5, rel=0.1)
    assert np.std(np.concatenate(misses)) == pytest.approx(0.4, rel=0.1)
    assert abs(np.mean(np.concatenate(misses))) < 0.05


def test_the_same_scene_gives_the_same_pictures() -> None:
    glaring = replace(SMALL, frames=2, occluder=True, vehicles=(replace(CAR, glare=True),), gain_drift=0.1)
    one, two, other = render(glaring), render(glaring), render(replace(glaring, seed=5))
    np.testing.assert_array_equal(one.left + one.right, two.left + two.right)
    assert one.clip == two.clip
    assert not np.array_equal(one.left[0], other.left[0])


def test_noise_has_the_stated_spread() -> None:
    quiet, noisy = (render(replace(SMALL, frames=1, noise_sigma=s)).left[0].astype(float) for s in (0.0, 2.0))
    assert np.std(noisy - quiet) == pytest.approx(2.0, rel=0.06)


def test_a_written_clip_reads_back(tmp_path: Path) -> None:
    rendered = render(replace(CURVE, dropped=(2,)))
    clip = yaml.safe_load(write(rendered, tmp_path).read_text())
    assert clip == rendered.clip
    assert list(clip) == ["left", "right", "times", "synchronised", "rig", "paths", "vehicles"]
    assert set(clip["paths"]["lane0"]) == {"shape", "left", "right", "lateral_offset"}
    assert clip["paths"]["lane0"]["shape"] == "curve"
    rig = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    assert set(rig) == {"left", "right", "rotation", "translation", "uncertainty"}
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert [row["frame"] for row in truth] == list(range(5))
    table = (tmp_path / "times.csv").read_text().split()
    assert table[0] == "frame,left_s,right_s" and len(table) == 6
    assert float(table[3].split(",")[1]) == pytest.approx(0.6)  # the picture at 0.4 s is missing
    for side, images in (("left", rendered.left), ("right", rendered.right)):
        names = sorted((tmp_path / side).iterdir())
        np.testing.assert_array_equal([cv2.imread(str(n), cv2.IMREAD_UNCHANGED) for n in names], images)


def test_random_scenes_are_varied_and_watchable() -> None:
    scenes = [random_scene(seed) for seed in range(40)]
    speeds = np.array([s.vehicles[0].speed for s in scenes]) / 0.44704
    assert speeds.min() < 15 and speeds.max() > 110
    assert {s.radius is None for s in scenes} == {s.vehicles[0].receding for s in scenes} == {True, False}
    for scene in scenes[:15] + [random_crossing(seed) for seed in range(10)]:
        assert sum(row["inside"] for row in World(scene).truth) >= 8


@pytest.mark.parametrize("radius", [20.0, 45.0, 80.0])
def test_random_bends_are_watchable_and_turn_across_the_view(radius: float) -> None:
    for seed in range(6):
        scene = random_bend(seed, radius, 10.0)
        world = World(scene)
        assert abs(scene.radius or 0) == radius and all(row["inside"] for row in world.truth) and scene.frames >= 8
        left = np.array(world.clip["paths"]["lane0"]["left"])
        slopes = np.abs(np.diff(left[:, 1])) / np.abs(np.diff(left[:, 0]))
        assert radius == 80 or slopes.min() < 0.35  # there it runs nearly along the epipolar lines


def test_overrides_of_a_random_scene_hold() -> None:
    scene = random_scene(3, radius=-120.0, dropped=(), vehicle={"speed": 20.0, "receding": True})
    assert (scene.radius, scene.dropped) == (-120.0, ())
    assert (scene.vehicles[0].speed, scene.vehicles[0].receding) == (20.0, True)


def test_scenes_without_a_clip_are_refused() -> None:
    with pytest.raises(ValueError, match="v0 is never wholly inside both images"):
        World(replace(SMALL, road_offset=300.0))
    with pytest.raises(ValueError, match="v0 does not move forward"):
        World(replace(SMALL, vehicles=(replace(CAR, acceleration=-30.0),)))


def test_files_state_that_the_cameras_are_ideal_unless_asked_not_to(tmp_path: Path) -> None:
    scene = replace(SMALL, frames=2)
    ideal = load_clip(write(render(scene), tmp_path / "ideal"))
    assert (ideal.offset, ideal.rig.left.readout, ideal.rig.right.readout) == (Quantity(0.0),) * 3
    assert ideal.rig.uncertainty is None
    silent = load_clip(write(render(scene), tmp_path / "silent", states_cameras=False))
    assert (silent.offset, silent.rig.left.readout, silent.rig.right.readout) == (None,) * 3
    assert silent.rig.uncertainty is not None and silent.rig.uncertainty.is_assumed
    skewed = write(render(replace(scene, skew_s=0.004)), tmp_path / "skewed")
    assert "synchronised" not in yaml.safe_load(skewed.read_text())
