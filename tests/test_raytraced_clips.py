"""Clips written to files: readable, exact, the same for the same scene, whole after an interruption."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tiny_scenes import tiny_follow, tiny_speed

from paceline.cameras import Quantity
from paceline.documents.loading import load_clip, load_follow, load_rig
from paceline.errors import UnusableInput
from paceline.progress import Progress
from paceline.recordings.monocular import open_camera
from paceline.recordings.odometry import read_odometry
from paceline.recordings.stereo import open_recording
from paceline.simulation.raytraced import chase_clip, stereo_clip
from paceline.simulation.raytraced.mitsuba_variant import PORTABLE_VARIANT
from paceline.simulation.raytraced.scene_yaml import FollowScene, SpeedScene


def speed(**changes: Any) -> SpeedScene:
    return SpeedScene.model_validate(tiny_speed(**changes))


def write_speed(scene: SpeedScene, folder: Path, progress: Progress = None) -> Path:
    """As clips.write, by the renderer that compiles nothing: in pictures this small that takes longest."""
    return stereo_clip.write(scene, folder, progress, PORTABLE_VARIANT)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clip") / "clip"
    assert write_speed(speed(), folder) == folder / "clip.yaml"
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_clip_is_one_that_paceline_reads(written: Path) -> None:
    clip = load_clip(written / "clip.yaml")
    assert len(open_recording(clip)) == 3
    truth = json.loads((written / "truth.json").read_text())
    first = next(row for row in truth if row["frame"] == clip.vehicles[0].frame)
    for side in ("left", "right"):
        assert getattr(clip.vehicles[0], side) == pytest.approx(np.array(first[side]), abs=4 * 0.5)
    assert clip.paths["lane0"].lateral_offset in (-1.8, 1.8)
    assert (clip.offset, clip.rig.left.readout, clip.rig.uncertainty) == (Quantity(0.0), Quantity(0.0), None)


def test_truth_is_consistent(written: Path) -> None:
    rig, truth = load_rig(written / "rig.yaml"), json.loads((written / "truth.json").read_text())
    assert [row["frame"] for row in truth] == [0, 1, 2]
    for row in truth:
        left, right = rig.project(np.array(row["corners"]))
        assert left == pytest.approx(np.array(row["left"]), abs=1e-6)
        assert right == pytest.approx(np.array(row["right"]), abs=1e-6)
        assert row["position"] == pytest.approx(np.mean(row["corners"], axis=0), abs=1e-9)
        assert row["visible"] == 1.0
    ways = np.linalg.norm(np.diff([row["position"] for row in truth], axis=0), axis=1)
    assert ways == pytest.approx(0.1 * 12.0, rel=1e-6)
    assert [row["speed_mps"] for row in truth] == pytest.approx([12.0] * 3, rel=1e-6)


def test_the_rendered_vehicle_is_at_the_true_position(written: Path) -> None:
    """Pictures differ from frame to frame around the plane, and far from it by the sensor's noise only."""
    truth = json.loads((written / "truth.json").read_text())
    first, last = (cv2.imread(str(written / "left" / f"{k:04d}.png"), -1).astype(float) for k in (0, 2))
    x, y = np.mean(truth[2]["left"], axis=0).astype(int)
    near, far = (
        np.abs(last - first)[rows, columns].mean()
        for rows, columns in ((slice(y - 8, y + 8), slice(x - 10, x + 10)), (slice(0, 25), slice(0, 60)))
    )
    assert near > 3 * far


def test_the_lines_lie_on_paint(written: Path) -> None:
    clip = load_clip(written / "clip.yaml")
    picture = cv2.imread(str(written / "left" / "0000.png"), -1).astype(np.float32)
    line = clip.paths["lane0"].left
    assert line is not None

    def along(offset: float) -> float:
        points = (line + [offset, 0]).astype(np.float32).reshape(-1, 1, 2)
        return float(np.median(cv2.remap(picture, points, None, cv2.INTER_LINEAR)))

    assert along(0.0) > max(along(-12.0), along(12.0)) + 15


@pytest.mark.slow
def test_an_interrupted_clip_is_resumed(written: Path, tmp_path: Path) -> None:
    whole = contents(written)
    folder = tmp_path / "again"

    def stop(done: int, total: int | None) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_speed(speed(), folder, stop)
    assert not (folder / "clip.yaml").exists()
    assert len(list((folder / "left").glob("*.png"))) == 2
    kept = (folder / "left" / "0000.png").stat().st_mtime_ns
    write_speed(speed(), folder)
    assert (folder / "left" / "0000.png").stat().st_mtime_ns == kept
    assert contents(folder) == whole  # as if nothing had happened: the same bytes


@pytest.mark.slow
def test_another_scene_does_not_go_into_the_same_folder(written: Path, tmp_path: Path) -> None:
    before = contents(written)
    with pytest.raises(UnusableInput, match="was begun with another scene"):
        write_speed(speed(seed=4), written)
    assert contents(written) == before
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(UnusableInput, match="holds other files"):
        write_speed(speed(), tmp_path)
    with pytest.raises(UnusableInput, match="cannot be written here"):
        write_speed(speed(), tmp_path / "mine.txt")


@pytest.mark.slow
def test_videos_keep_their_times(tmp_path: Path) -> None:
    scene = speed(sensor={"image_format": "h264", "color": True, "quality": 95}, dropped=[1], frames=4, skew=0.004)
    clip = load_clip(write_speed(scene, tmp_path / "clip"))
    frames = list(open_recording(clip).frames(0))
    assert np.diff([f.time for f in frames]) == pytest.approx([0.2, 0.1], abs=1e-4)
    assert not (tmp_path / "clip" / "left").exists()


def test_cameras_that_are_not_ideal_look_beside_the_same_scene(written: Path, tmp_path: Path) -> None:
    """The picture of each is that of an ideal one, moved as the truth says."""
    rolling = {"readout": 0.02, "drift": [3.0, 0.0]}
    errors = {"offset": 0.03, "sway": 1e-3, "crf": 4, "left": rolling, "right": rolling | {"dirt": 0.05}}
    folder = write_speed(speed(camera_errors=errors), tmp_path / "clip").parent
    frames = list(open_recording(load_clip(folder / "clip.yaml")).frames(0))
    assert [f.time for f in frames] == pytest.approx([0.0, 0.1, 0.2], abs=1e-4)
    assert [f.skew for f in frames] == pytest.approx([0.0] * 3, abs=1e-4)
    rows, ideal = (json.loads((of / "truth.json").read_text()) for of in (folder, written))
    assert rows[2]["speed_mps"] == ideal[2]["speed_mps"]
    corners, before = (np.array(of[2]["left"]) for of in (rows, ideal))
    M = np.array([[1, 0, 0], [0, 1, 0.0]])
    M[:, 2] = moved = (corners - before).mean(0)
    assert moved[0] == pytest.approx(6.0, abs=1.0)
    picture = cv2.imread(str(written / "left" / "0002.png"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
    (x0, y0), (x1, y1) = corners.min(0).astype(int) - 2, corners.max(0).astype(int) + 3
    shown = cv2.GaussianBlur(frames[2].left, (0, 0), 1.0)[y0:y1, x0:x1].ravel()
    aligned, unmoved = (
        np.corrcoef(shown, cv2.warpAffine(picture, m, (192, 144))[y0:y1, x0:x1].ravel())[0, 1]
        for m in (M, np.eye(2, 3))
    )
    assert aligned > unmoved + 0.2
    assert not (folder / "left").exists()


@pytest.mark.slow
def test_dropped_frames_and_skew_are_in_the_times(tmp_path: Path) -> None:
    occluder = {"id": "near", "kind": "bus", "start": 19.0, "speed": 0.0, "measured": False, "seed": 1}
    vehicles = [*tiny_speed()["vehicles"], occluder | {"lane": 1}]
    rig = tiny_speed()["rig"] | {"distortion": [-0.1, 0.02, 0.0, 0.0, 0.0]}
    scene = speed(sensor={"image_format": "jpeg", "quality": 80}, dropped=[1], skew=0.01, vehicles=vehicles, rig=rig)
    folder = write_speed(scene, tmp_path / "clip").parent
    assert (folder / "times.csv").read_text().splitlines()[1:] == ["0,0.000000,0.010000", "1,0.200000,0.210000"]
    assert [p.name for p in sorted((folder / "right").iterdir())] == ["0000.jpg", "0001.jpg"]
    clip = load_clip(folder / "clip.yaml")
    truth = json.loads((folder / "truth.json").read_text())
    assert clip.rig.left.has_distortion
    first = next(r for r in truth if r["vehicle"] == "v0" and r["frame"] == clip.vehicles[0].frame)
    assert clip.vehicles[0].left == pytest.approx(np.array(first["left"]), abs=4 * 0.5)
    assert [v.id for v in clip.vehicles] == ["v0"]
    assert {row["vehicle"] for row in truth} == {"v0", "near"}
    assert clip.offset == Quantity(0.0) and "synchronised" not in (folder / "clip.yaml").read_text()


@pytest.mark.slow
def test_a_clip_may_state_nothing_about_its_cameras(tmp_path: Path) -> None:
    clip = load_clip(
        stereo_clip.write(speed(frames=2), tmp_path / "clip", variant=PORTABLE_VARIANT, states_cameras=False)
    )
    assert (clip.offset, clip.rig.left.readout, clip.rig.right.readout) == (None, None, None)
    assert clip.rig.uncertainty is not None and clip.rig.uncertainty.is_assumed


@pytest.mark.slow
def test_a_chase_is_one_that_paceline_reads(tmp_path: Path) -> None:
    scene = FollowScene.model_validate(tiny_follow())
    folder = chase_clip.write(scene, tmp_path / "chase", variant=PORTABLE_VARIANT).parent
    document = load_follow(folder / "follow.yaml")
    assert len(list(open_camera(document).frames())) == 2
    truth = json.loads((folder / "truth.json").read_text())
    for row in truth:
        assert document.camera.project(np.array(row["position"])) == pytest.approx(row["center"], abs=1e-9)
        assert 4.5 < row["position"][2] < 16
        assert np.mean(row["corners"], axis=0) == pytest.approx(row["center"], abs=0.5)
    assert document.center == pytest.approx(truth[0]["center"], abs=4 * 0.4 + 0.05)
    assert document.scale == pytest.approx(10 / truth[0]["position"][2], rel=5 * 0.008)
    assert document.odometry is not None
    assert document.camera.readout == Quantity(0.0)
    odometry = read_odometry(document.odometry)
    assert odometry.pose[1] == pytest.approx([truth[1]["chase"][k] for k in ("x_m", "y_m", "heading_rad")], abs=1e-5)
    again = chase_clip.write(scene, tmp_path / "again", variant=PORTABLE_VARIANT).parent
    assert contents(again) == contents(folder)
