"""Simulated cameras that are not ideal: where, when and how pictures show what stands still and what drives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from tiny_scenes import tiny_speed

from paceline.documents.loading import load_clip
from paceline.recordings.stereo import open_recording
from paceline.simulation.camera_errors import (
    MAX_MOTION_IN_BAND_PX,
    CameraErrors,
    MovingViews,
    RecordedLight,
    StereoErrors,
    row_bands,
    row_delay,
)
from paceline.simulation.raytraced.scene import PlacedStereoScene
from paceline.simulation.raytraced.scene_yaml import SpeedScene, StereoErrorsModel
from paceline.simulation.stereo.clip import Scene, Vehicle, World, render, write
from paceline.simulation.stereo.scene import make_rig, rig_views
from paceline.simulation.stereo.scenery import StaticBackground

Array = NDArray[np.float64]

CAR = Vehicle("v0", 18.0, start_distance=40.0)
SMALL = Scene(4, (CAR,), image_size=(320, 240), focal=700.0, frames=3, rate=10.0)
CROSSING = replace(
    SMALL,
    vehicles=(Vehicle("v0", 10.0, start_distance=12.0, width=2.0, plane="side"),),
    road_direction=np.pi / 2,
    road_depth=12.0,
    draw_path=False,
    noise_sigma=0.0,
)
ALL = StereoErrors(
    CameraErrors(0.02, 0.001, (1e-4, 2e-4, 3e-4), (0.1, -0.2), (1.0, 2.0), 1, 0.05, 0.03, 0.2, 1),
    CameraErrors(-0.01, -0.002, (4e-4, 0.0, 0.0), (0.0, 0.3)),
    0.008,
    100.0,
    4e-4,
    26,
)


def moving(errors: StereoErrors, scene: Scene = SMALL) -> MovingViews:
    return MovingViews(rig_views(make_rig(scene)), errors, scene.rate, scene.seed)


def test_without_errors_nothing_changes() -> None:
    rig, clocks, views = make_rig(SMALL), (np.arange(3.0), np.arange(3.0)), moving(StereoErrors())
    assert StereoErrors().true_rig(rig) is rig
    assert all(a is b for a, b in zip(StereoErrors().exposure_times(clocks), clocks, strict=True))
    points = np.array([[1.0, 0.5, 20.0], [-2.0, 1.0, 35.0]])
    for i, view in enumerate(views.views):
        assert views.view(i, 0.7) is view
        assert [rows for rows, _, _ in views.static_bands(i, 0.7)] == [slice(0, 240)]
        np.testing.assert_array_equal(views.project(i, 0.7, lambda _: points), view.project(points))
    light = np.ones((240, 320), np.float32)
    assert RecordedLight(CameraErrors(), (320, 240), 4, 0)(light, 3) is light


def test_a_rotating_view_moves_what_stands_still_by_its_homography() -> None:
    views = moving(StereoErrors(CameraErrors(drift=(0.3, -0.2), knock=(2.0, 1.0), knock_frame=4), sway=2e-3))
    points = np.array([[1.0, 0.5, 20.0], [-2.0, 1.0, 35.0], [0.3, -1.0, 90.0]])
    for i, t in ((0, 0.2), (1, 0.2), (0, 0.6)):
        rest = views.views[i]
        K, R = rest.camera.K, views.rotation(i, t)
        homogeneous = np.column_stack([rest.project(points), np.ones(3)]) @ (K @ R @ np.linalg.inv(K)).T
        expected = homogeneous[:, :2] / homogeneous[:, 2:]
        np.testing.assert_allclose(views.project(i, t, lambda _: points), expected, atol=1e-9)
        assert np.abs(expected - rest.project(points)).max() > 0.3
        np.testing.assert_allclose(views.view(i, t).centre, rest.centre, atol=1e-12)


def test_drift_and_knock_move_the_picture_by_their_pixels() -> None:
    errors = StereoErrors(right=CameraErrors(drift=(0.3, -0.2), knock=(2.0, 1.0), knock_frame=4))
    views, point = moving(errors), np.array([[-0.25, 0.0, 1e4]])
    rest = views.views[1].project(point)
    for frame, expected in ((1, (0.3, -0.2)), (3, (0.9, -0.6)), (5, (3.5, 0.0))):
        seen = views.project(1, frame / SMALL.rate, lambda _: point)
        assert (seen - rest)[0] == pytest.approx(expected, abs=0.01)
        assert views.view(0, frame / SMALL.rate) is views.views[0]


def test_sway_is_slow_and_as_large_as_it_says() -> None:
    views = moving(StereoErrors(sway=4e-4))
    assert views.sway(0.0) == pytest.approx(np.zeros(3))
    t = np.arange(0.0, 200.0, 0.01)
    swing = np.array([views.sway(s) for s in t.tolist()])
    assert swing.std(0) == pytest.approx(np.full(3, 4e-4), rel=0.05)
    power = np.abs(np.fft.rfft(swing - swing.mean(0), axis=0)) ** 2
    hertz = np.fft.rfftfreq(len(t), 0.01)
    assert (power[(hertz > 0.8) & (hertz < 1.3)].sum(0) > 0.75 * power.sum(0)).all()
    assert (power[hertz > 5.5].sum(0) < 0.01 * power.sum(0)).all()


def test_zoom_and_turn_are_of_the_cameras_and_not_of_the_file() -> None:
    world = World(replace(SMALL, errors=StereoErrors(right=CameraErrors(zoom=0.01, turn=(0.0, 1e-3, 0.0)))))
    stated = rig_views(world.rig)
    np.testing.assert_array_equal(world.rig.right.K, World(SMALL).rig.right.K)
    assert world.views[1].camera.K[0, 0] == pytest.approx(1.01 * world.rig.right.K[0, 0])
    np.testing.assert_allclose(world.views[1].centre, stated[1].centre, atol=1e-12)
    point = np.array([[0.0, 0.0, 50.0]])
    moved = world.views[1].to_camera(point) - stated[1].to_camera(point)
    assert moved[0] == pytest.approx([0.05, 0.0, 0.0], abs=1e-3)  # turned to the left, so that things move to the right


def test_what_the_right_camera_exposes_later_is_farther_on() -> None:
    """By one frame interval, here, so that each picture is the next one of a camera that is in time."""
    late, in_time = (render(replace(CROSSING, errors=StereoErrors(offset=d))) for d in (0.1, 0.0))
    for a, b in zip(late.right[:-1], in_time.right[1:], strict=True):
        assert np.abs(a.astype(int) - b).max() <= 1
    assert all((a == b).all() for a, b in zip(late.left, in_time.left, strict=True))
    assert late.clip["rate"] == 10.0 and "times" not in late.clip
    moved = np.array(late.truth[0]["right"]) - np.array(in_time.truth[0]["right"])
    assert np.abs(moved[:, 0]).mean() == pytest.approx(10.0 * 0.1 * 700 / 12, rel=0.05)
    assert [row["speed_mps"] for row in late.truth] == [10.0] * len(late.truth)


@pytest.mark.parametrize("readout", [0.05, -0.02])
def test_a_row_is_drawn_as_it_is_when_it_is_read(readout: float) -> None:
    sway = StereoErrors(sway=2e-3)
    scene = replace(CROSSING, frames=1, errors=replace(sway, right=CameraErrors(readout=readout)))
    world = World(scene)
    corners = np.array(world.truth[0]["right"])
    row, t = int(corners[:, 1].mean()), float(world.times[1][0])
    late = replace(sway, offset=float(row_delay(row, readout, 240)))
    shown, at_once, undelayed = (
        render(replace(scene, errors=errors)).right[0][row].astype(float) for errors in (scene.errors, late, sway)
    )
    assert np.abs(shown - at_once).mean() < 0.15 * np.abs(undelayed - at_once).mean()
    for c, pixel in enumerate(corners):
        moment = t + float(row_delay(pixel[1], readout, 240))
        exact = world.moving.view(1, moment).project(world.motions[0].pose(moment).corners(2.0, CAR.height))[c]
        assert pixel == pytest.approx(exact, abs=5e-3)


def test_bands_hold_every_row_once_and_none_moves_far() -> None:
    bands = row_bands(30, 130, 24.0, 0.025, 240)
    assert [r for rows, _ in bands for r in range(rows.start, rows.stop)] == list(range(30, 130))
    for rows, delay in bands:
        off = [float(row_delay(r, 0.025, 240)) - delay for r in (rows.start, rows.stop - 1)]
        assert np.abs(off).max() * 24.0 / 0.025 <= MAX_MOTION_IN_BAND_PX / 2 + 1e-9
    assert len(row_bands(0, 240, 24.0, 0.0, 240)) == 1


def test_a_band_of_the_background_is_that_of_the_whole() -> None:
    world = World(SMALL)
    background = StaticBackground(SMALL, world.road, SMALL.seed)
    whole = background.draw(world.views[0])
    for rows in (slice(0, 50), slice(117, 119), slice(200, 240)):
        np.testing.assert_allclose(background.draw(world.views[0], rows), whole[rows], atol=0.01)


def test_videos_have_the_times_of_their_own_clocks(tmp_path: Path) -> None:
    rendered = render(replace(SMALL, errors=StereoErrors(offset=0.03, crf=12)))
    path = write(rendered, tmp_path / "clip")
    assert "rate" not in (document := yaml.safe_load(path.read_text())) and document["right"] == "right.mp4"
    frames = list(open_recording(load_clip(path)).frames(0))
    assert [f.time for f in frames] == pytest.approx([0.0, 0.1, 0.2], abs=1e-4)
    assert [f.skew for f in frames] == pytest.approx([0.0] * 3, abs=1e-4)
    for k, frame in enumerate(frames):
        assert np.abs(frame.right - rendered.right[k]).mean() < 2.0
        assert abs((frame.right - rendered.right[k]).mean()) < 0.5  # no other black and white


def test_what_is_drawn_is_where_the_pictures_show_it() -> None:
    world = World(replace(SMALL, click_sigma=0.0, errors=ALL))
    vehicle = world.clip["vehicles"][0]
    row = world.truth[vehicle["frame"]]
    for side in ("left", "right"):
        np.testing.assert_allclose(vehicle[side], row[side], atol=0.01)
    assert np.abs(np.array(row["right"]) - World(SMALL).truth[vehicle["frame"]]["right"]).max() > 0.1


def test_dirt_hides_its_share() -> None:
    light = np.ones((240, 320, 3), np.float32)
    passed = RecordedLight(CameraErrors(dirt=0.1), (320, 240), 4, 0)(light, 0)
    assert 0.1 <= (passed < 1).mean() < 0.2 and 0.0 < passed.min() < 0.9


def test_drops_blur_what_is_behind_them() -> None:
    edge = np.repeat(np.float32([0.0, 1.0]), 160)[None].repeat(240, axis=0)
    seen = RecordedLight(CameraErrors(rain=0.3), (320, 240), 4, 1)(edge, 0)
    assert (np.abs(seen - edge) > 0.05).mean() < 0.2 and (seen[:, 157] > 0.05).any() and (seen[:, 162] < 0.95).any()
    assert (seen[:, :80] == 0.0).all() and seen.mean() == pytest.approx(0.5, abs=0.02)


def test_an_automatic_exposure_changes_within_a_few_frames() -> None:
    recorded = RecordedLight(CameraErrors(exposure_step=0.4, exposure_frame=3), (32, 24), 4, 0)
    exposures = [recorded.exposure(frame) for frame in range(12)]
    assert (
        exposures[:3] == [1.0] * 3
        and np.all(np.diff(exposures[2:]) > 0)
        and exposures[-1] == pytest.approx(1.4, abs=0.01)
    )
    light = np.full((24, 32), 0.5, np.float32)
    np.testing.assert_allclose(recorded(light, 11), 0.5 * exposures[11], rtol=1e-6)


def test_ray_traced_scenes_hold_the_same_errors() -> None:
    assert StereoErrorsModel.of(ALL).errors(0.0) == ALL
    assert StereoErrorsModel().errors(0.03).cameras == (CameraErrors(readout=0.03),) * 2
    late, in_time = (
        PlacedStereoScene(SpeedScene.model_validate(tiny_speed(camera_errors=e))) for e in ({"offset": 0.1}, {})
    )
    np.testing.assert_allclose(
        late.project_plane(1, late.vehicles[0], float(late.times[1, 0])),
        in_time.project_plane(1, in_time.vehicles[0], float(in_time.times[1, 1])),
        atol=1e-9,
    )
    np.testing.assert_array_equal(late.clocks, in_time.clocks)
