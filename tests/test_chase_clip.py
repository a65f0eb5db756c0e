"""The chase-camera generator: pictures where the truth says, worlds that hold together, files that load."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selection import slow_after

from paceline.documents.loading import load_follow
from paceline.simulation.chase.clip import ChaseScene, ChaseTruth, Occlusion, render_frames, target_document, write
from paceline.simulation.chase.motion import VIBRATION_HZ, CameraVibration, road_pose, winding_road
from paceline.simulation.chase.projection import CameraPose, Sun, TextureAtlas, axis_ahead, draw_faces, place_faces
from paceline.simulation.chase.rasterizer import road_coordinates
from paceline.simulation.chase.renderer import exposure_times
from paceline.simulation.chase.script import ChaseScript
from paceline.simulation.chase.vehicles import AntialiasedCanvas, Face
from paceline.simulation.random_scenes.drawn import random_chase
from paceline.simulation.road import POLYGON_STEP_M, PolygonalAxis

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

QUIET = {
    "noise_sigma": 0.0,
    "shot_noise": 0.0,
    "vignetting": 0.0,
    "exposure_drift": 0.0,
    "shutter_s": 0.0,
    "exposure": 0.7,
}
# A lorry from straight behind and lower than its roof: nothing but its rear plane has its paint.
BEHIND = ChaseScene(
    seed=5,
    frames=40,
    image_size=(640, 480),
    focal=640.0,
    kind="lorry",
    gap=(9.0, 12.0),
    radius=1e5,
    weave=0.1,
    sun_azimuth=3.0,
    shadows=0.0,
    traffic=False,
    brakes=False,
    **QUIET,
)


def frames(scene: ChaseScene) -> tuple[list[Picture], list[ChaseTruth]]:
    images, truths = zip(*render_frames(scene), strict=True)
    return list(images), list(truths)


def centroid_within(outline: Array) -> Array:
    """Centroid (2,) of the area inside a closed polygon (N, 2)."""
    (x, y), (x2, y2) = outline.T, np.roll(outline, -1, axis=0).T
    cross = x * y2 - x2 * y
    return np.asarray(np.array([((x + x2) * cross).sum(), ((y + y2) * cross).sum()]) / (3 * cross.sum()))


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("yaw", [0.0, 0.15])
@pytest.mark.parametrize("distance", [5.0, 12.0, 60.0])
def test_a_plain_rectangle_is_drawn_at_its_projection(distance: float, yaw: float, n: int) -> None:
    K = np.array([[300.0, 0, 127.5], [0, 300, 120.5], [0, 0, 1]])
    R = np.asarray(cv2.Rodrigues(np.array([0.04, 0.0, 0.02]))[0], float)
    road, atlas = PolygonalAxis(np.zeros(401), 200.0), TextureAtlas()
    state = road_pose(road, 20 + distance, 0.31, 0.0)
    card = Face(AntialiasedCanvas(1.9, 1.4, 200.0, density=50).finish(), (-0.95, -1.9, 0.0), (1.9, 0, 0), (0, 1.4, 0))
    faces = place_faces((card,), atlas, road, replace(state, heading=state.heading + yaw))
    atlas.pack()
    origin = road_pose(road, 20.0, 0.0, 0.0)
    camera = CameraPose(K, R, 2.0, origin.x, origin.y, origin.heading)
    canvas = np.zeros((242 * n, 256 * n, 2), np.float32)
    to_canvas = np.array([[n, 0, 0.5 * n - 0.5], [0, n, 0.5 * n - 0.5], [0, 0, 1.0]])
    draw_faces(canvas, faces, atlas, camera, Sun(3.0, 0.8, 0.4), np.ones((64, 64), np.float32), to_canvas)
    coverage = cv2.resize(canvas[..., 1], (256, 242), interpolation=cv2.INTER_AREA).astype(float)
    flat = np.array([[-0.95, -1.9], [0.95, -1.9], [0.95, -0.5], [-0.95, -0.5]])
    right, ahead = 0.31 + flat[:, 0] * np.cos(yaw), distance + flat[:, 0] * np.sin(yaw)
    corners = (np.column_stack([right, flat[:, 1] + 2.0, ahead]) @ R.T) @ K.T
    v, u = np.mgrid[:242, :256]
    seen = np.array([(coverage * u).sum(), (coverage * v).sum()]) / coverage.sum()
    np.testing.assert_allclose(seen, centroid_within(corners[:, :2] / corners[:, 2:]), atol=0.01)
    x, y = (corners[:, :2] / corners[:, 2:]).T
    area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    assert coverage.sum() == pytest.approx(area, rel=0.002, abs=0.02)


def edge(profile: Array) -> float:
    """Where a profile steps from 0 to its plateau, in samples: the plateau is as wide as the area under it says."""
    plateau = profile[-4:].mean()
    return float(len(profile) - profile.sum() / plateau - 0.5)


@pytest.mark.slow
def test_the_leads_outline_has_the_true_corners() -> None:
    """Two paints, everything else the same: what differs is the rear plane, however varied its surroundings."""
    light, truths = frames(replace(BEHIND, object_density=0.0, paint=170.0))
    dark, _ = frames(replace(BEHIND, object_density=0.0, paint=80.0))
    errors = []
    for a, b, truth in zip(light, dark, truths, strict=True):
        difference, c = a.astype(float) - b, truth.corners
        for flip, sides in ((False, ((0, 3), (1, 2))), (True, ((0, 1), (3, 2)))):
            image = difference.T if flip else difference
            corners = c[:, ::-1] if flip else c
            for sign, (i, j) in zip((1, -1), sides, strict=True):
                (x0, y0), (x1, y1) = corners[[i, j]]
                off = []
                for row in range(int(y0 + 0.35 * (y1 - y0)), int(y0 + 0.65 * (y1 - y0))):
                    true = x0 + (row - y0) / (y1 - y0) * (x1 - x0)
                    start = int(round(true)) - 5 * sign
                    where = start + edge(image[row, start : start + 11 * sign : sign]) * sign
                    off.append(where - true)
                errors.append(np.mean(off) * sign)
    assert np.abs(np.mean(errors)) < 0.01
    assert np.std(errors) < 0.02


def test_a_rolling_shutter_exposes_each_row_at_its_own_time() -> None:
    """The sides of a vibrating camera's lead lie, row by row, where they are as the row is exposed."""
    scene = replace(BEHIND, object_density=0.0, vibration=6e-3, readout=0.02, frames=2)
    script, height = ChaseScript(scene), scene.image_size[1]
    light, dark = (frames(replace(scene, paint=paint)) for paint in (170.0, 80.0))
    errors, bends = [], []
    for a, b, truth in zip(light[0], dark[0], light[1], strict=True):
        difference, (top, bottom) = a.astype(float) - b, truth.corners[[0, 3], 1]
        for row in range(int(top + 0.35 * (bottom - top)), int(top + 0.65 * (bottom - top))):
            exposed = script.state_at(truth.time + scene.readout * (row / (height - 1) - 0.5)).corners
            for sign, side in ((1, (0, 3)), (-1, (1, 2))):
                true, together = (
                    float(np.interp(row, corners[side, 1], corners[side, 0])) for corners in (exposed, truth.corners)
                )
                start = int(round(true)) - 5 * sign
                errors.append(start + edge(difference[row, start : start + 11 * sign : sign]) * sign - true)
                bends.append(true - together)
    assert np.std(bends) > 0.2
    assert np.abs(np.mean(errors)) < 0.02
    assert np.std(errors) < 0.05


def test_rows_drawn_apart_make_up_the_picture() -> None:
    scene = random_chase(6, frames=1, occlusions=(Occlusion(0.0),), object_density=0.3)
    whole, apart = (frames(replace(scene, readout=readout))[0][0] for readout in (0.0, 1e-12))
    np.testing.assert_allclose(whole.astype(int), apart, atol=1)
    assert (whole != apart).mean() < 1e-3
    rows, later = zip(*exposure_times(replace(scene, readout=0.02)), strict=True)
    assert [k for band in rows for k in range(band.start, band.stop)] == list(range(scene.image_size[1]))
    assert 0.019 < later[-1] - later[0] < 0.02 and abs(later[0] + later[-1]) < 1e-3


def test_a_camera_vibrates_by_its_rms_within_its_band() -> None:
    vibration, times = CameraVibration(np.random.default_rng(3), 3e-3), np.arange(0, 60, 0.002)
    turns = np.array([vibration(t) for t in times])
    np.testing.assert_allclose(turns.std(0), 3e-3, rtol=0.03)
    rates = np.array([vibration.rate(t) for t in times])
    np.testing.assert_allclose(np.gradient(turns, times, axis=0)[1:-1], rates[1:-1], atol=0.01)
    power, hertz = np.abs(np.fft.rfft(turns, axis=0)) ** 2, np.fft.rfftfreq(len(times), 0.002)
    within = (hertz > VIBRATION_HZ[0] - 0.5) & (hertz < VIBRATION_HZ[1] + 0.5)
    assert power[within].sum() > 0.99 * power.sum()


def test_odometry_does_not_tell_of_vibration() -> None:
    calm, shaken = (ChaseScript(replace(BEHIND, vibration=rms)).state_at(0.7) for rms in (0.0, 0.01))
    places = [(state.camera.x, state.camera.y, state.camera.heading) for state in (calm, shaken)]
    assert places[0] == places[1]
    assert 1e-3 < np.linalg.norm(calm.position - shaken.position) / calm.gap < 0.1
    assert np.linalg.norm(calm.position) == pytest.approx(np.linalg.norm(shaken.position))


def test_the_position_follows_from_the_corners() -> None:
    scene = replace(BEHIND, kind="van", yaw=0.1)
    script = ChaseScript(scene)
    x, y = script.world.body.width / 2, script.world.body.height / 2
    plane = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    for t in (0.0, 0.7, 2.1):
        state = script.state_at(t)
        _, _, found = cv2.solvePnP(plane, state.corners, scene.camera.K, None, flags=cv2.SOLVEPNP_ITERATIVE)
        np.testing.assert_allclose(found.ravel(), state.position, atol=1e-4)


def test_the_chase_vehicle_moves_where_it_heads_and_so_does_the_lead() -> None:
    """Odometry and positions, put together as a follower would, give two smooth paths along their headings."""
    scene = replace(BEHIND, radius=120.0, weave=0.7, shake_px=0.0, tilt=0.0, frames=150)
    script = ChaseScript(scene)
    moments = [script.state_at(k / 15) for k in range(150)]
    eyes = np.array([[m.camera.x, m.camera.y, m.camera.heading] for m in moments])
    ahead, right = (np.array([m.position[i] for m in moments]) for i in (2, 0))
    c, s = np.cos(eyes[:, 2]), np.sin(eyes[:, 2])
    lead = eyes[:, :2] + np.column_stack([c * ahead + s * right, s * ahead - c * right])
    headings = np.array([m.lead.heading for m in moments])
    for path, heading in ((eyes[:, :2], eyes[:, 2]), (lead, headings)):
        step = path[2:] - path[:-2]
        off = np.angle(np.exp(1j * (np.arctan2(step[:, 1], step[:, 0]) - heading[1:-1])))
        assert np.abs(off).max() < 0.02
        assert np.linalg.norm(step, axis=1).min() / 2 > 0.3 * 9.7 / 15
    distance = np.hypot(*(lead - eyes[:, :2]).T)
    assert 8.5 < distance.min() < distance.max() < 12.5


@pytest.mark.slow
@pytest.mark.parametrize("preset", slow_after(1, ["nist", "hd"]))
def test_vehicles_accelerate_as_vehicles_can(preset: str) -> None:
    for seed in range(4):
        scene = random_chase(seed, preset, object_density=0.0, traffic=False)
        script = ChaseScript(scene)
        gap = np.array([script.state_at(k / scene.rate).gap for k in range(scene.frames)])
        assert scene.gap[0] - 1 < gap.min() < gap.max() < scene.gap[1] + 1
        assert np.abs(np.diff(gap, 2)).max() * scene.rate**2 < 6.0


def test_road_and_things_lie_in_one_plan() -> None:
    road = winding_road(np.random.default_rng(3), 400.0, 110.0)
    for s0 in (20.0, 90.0, 200.0):
        origin = road_pose(road, s0, 0.4, 0.02)
        camera = CameraPose(np.eye(3), np.eye(3), 2.0, origin.x, origin.y, origin.heading)
        table = axis_ahead(road, s0, origin.x, origin.y, origin.heading, 120.0)
        for distance in (5.0, 15.0, 40.0, 70.0):
            for lateral in (-4.0, 0.0, 1.75):
                spot = road_pose(road, s0 + distance, lateral, 0.0)
                right, ahead = camera.to_level(spot.x, spot.y)
                found = road_coordinates(float(ahead), float(right), table, POLYGON_STEP_M)
                np.testing.assert_allclose(found, (distance, lateral), atol=0.03)


@pytest.mark.slow
def test_a_seed_gives_the_same_clip_and_another_seed_another() -> None:
    a, b, c = (frames(random_chase(seed, frames=4)) for seed in (3, 3, 4))
    assert all(np.array_equal(x, y) for x, y in zip(a[0], b[0], strict=True))
    assert not np.array_equal(a[0][0], c[0][0])
    longer = next(render_frames(random_chase(3, frames=400)))[0]
    np.testing.assert_array_equal(longer, a[0][0])
    np.testing.assert_array_equal([t.corners for t in a[1]], [t.corners for t in b[1]])


@pytest.mark.parametrize("kind", ["van", "saloon", "lorry", "bus"])
def test_targets_follow_the_vehicle(kind: str) -> None:
    """From the nominal range the model's lines fall on strong edges of the picture."""
    scene = replace(
        BEHIND, kind=kind, object_density=0.0, paint=160.0, camera_height=2.2, gap=(9.99, 10.01), frames=1, shake_px=0.0
    )
    (image,), (truth,) = frames(scene)
    target = target_document(scene)
    gradient = np.stack([cv2.Sobel(image, cv2.CV_64F, 1, 0) / 8, cv2.Sobel(image, cv2.CV_64F, 0, 1) / 8])
    strengths = []
    for a, b in target["segments"]:
        ends = np.array([target["corners"][a], target["corners"][b]]) * scene.focal / truth.position[2] + truth.center
        along = np.ptp(ends, axis=0)
        assert along.min() <= 1e-9 * along.max() + 1e-3
        across = int(along[0] > along[1])
        points = ends[0] + np.linspace(0.15, 0.85, 30)[:, None] * (ends[1] - ends[0])
        x, y = np.round(points).astype(int).T
        ridge = np.array([np.abs(gradient[across][y + d * across, x + d * (1 - across)]).mean() for d in range(-4, 5)])
        strengths.append(ridge.max())
        # There is a ridge within a pixel of the line, and it is not much weaker than its neighbours.
        assert ridge[3:6].max() > max(0.4 * ridge.max(), 3.0), (a, b, ridge)
    assert len(strengths) >= 8
    assert np.median(strengths) > 8
    with_error = target_document(replace(scene, model_error=0.01))
    moved = np.array(list(with_error["corners"].values())).std() - np.array(list(target["corners"].values())).std()
    assert 0 < abs(moved) < 0.05


@pytest.mark.slow
def test_an_occlusion_hides_the_lead_and_passes() -> None:
    for kind, least in (("vehicle", 0.4), ("post", 0.9)):
        crossed = replace(BEHIND, occlusions=(Occlusion(1.3, 0.8, kind),))
        visible = np.array([t.visible for t in frames(crossed)[1]])
        assert visible[0] > 0.97 and visible[-1] > 0.97
        assert visible[19:21].min() < least
        assert 5 <= (visible < 0.97).sum() <= 20


@pytest.mark.slow
def test_shadows_and_brake_lamps_show() -> None:
    lit, _ = frames(replace(BEHIND, seed=8))
    shaded, _ = frames(replace(BEHIND, seed=8, shadows=1.5))
    assert np.mean([np.mean(b < 0.8 * a.astype(float)) for a, b in zip(lit, shaded, strict=True)]) > 0.05
    scene = replace(BEHIND, brakes=True, gap=(8.0, 25.0), frames=300)
    script = ChaseScript(scene)
    braking = [script.state_at(k / 15).braking for k in range(300)]
    assert 0.05 < np.mean(braking) < 0.95


def test_a_clip_is_written_and_loads(tmp_path: Path) -> None:
    scene = random_chase(6, frames=5)
    clip = load_follow(write(scene, tmp_path))
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert [row["frame"] for row in truth] == list(range(5))
    images, truths = frames(scene)
    for k, row in enumerate(truth):
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "frames" / f"{k:05d}.png"), 0), images[k])
        np.testing.assert_allclose(row["position"], truths[k].position)
        assert row["width_px"] == pytest.approx(np.linalg.norm(truths[k].corners[1] - truths[k].corners[0]))
    np.testing.assert_allclose(clip.center, truths[0].center, atol=2.0)
    assert clip.scale == pytest.approx(10 / truths[0].position[2], rel=0.04)
    assert clip.target.name == scene.kind
    assert clip.odometry is not None


@pytest.mark.slow
def test_long_runs_need_no_more_memory() -> None:
    scene = random_chase(2, frames=330, image_size=(64, 60), focal=75.0, occlusions=(Occlusion(3.0),))
    tracemalloc.start()
    held = [tracemalloc.get_traced_memory()[0] for _ in render_frames(scene)]
    tracemalloc.stop()
    assert abs(held[-1] - held[30]) < 200_000
