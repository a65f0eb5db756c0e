"""The baselines from clip to result: rendered clips, the outputs, and input that they must bear."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selection import slow_after

import paceline.baselines.registry  # noqa: F401  makes the baselines known
from paceline.baselines.multimodal import Multimodal, Particles
from paceline.documents.loading import Clip, load_clip
from paceline.errors import UnusableInput
from paceline.recordings.stereo import open_recording
from paceline.reports import write_report
from paceline.reports.common.formatting import format_verdict, interval_title
from paceline.reports.speed.tables import ESTIMATE_COLUMNS
from paceline.simulation.random_scenes.drawn import random_crossing
from paceline.simulation.stereo.clip import RenderedClip, Scene, Vehicle, render, write
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.resampling import Weights
from paceline.speed.methods import DEFAULT_METHOD, measure, method_names
from paceline.speed.results import ClipResult, Measurement

Image = NDArray[np.uint8]

SPEED = 17.0  # m/s
ALL = [name for name in method_names() if name not in (DEFAULT_METHOD, "zhu")]
# share of the speed by which the mean may be off: a few times what each method errs by on such clips
BOUND = {"sift": 0.04, "kalman": 0.6, "kalman-scatter": 0.05, "multimodal": 0.2, "lucas-kanade": 0.015}


def scene(**more: Any) -> Scene:
    vehicle = Vehicle("v0", SPEED, start_distance=50.0, texture_seed=21)
    small: dict[str, Any] = {"image_size": (640, 480), "focal": 1400.0, "frames": 10}
    return replace(Scene(21, (vehicle,), **small), **more)


@pytest.fixture(scope="module")
def rendered() -> RenderedClip:
    return render(scene())


@pytest.fixture(scope="module")
def clip(rendered: RenderedClip, tmp_path_factory: pytest.TempPathFactory) -> Clip:
    return load_clip(write(rendered, tmp_path_factory.mktemp("clip")))


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> tuple[float, Clip]:
    """The speed of a vehicle that shows its side, and its clip, without a path."""
    s = random_crossing(4, vehicle={"acceleration": 0.0}, image_size=(640, 480), focal=700.0, occluder=False)
    return s.vehicles[0].speed, load_clip(write(render(s), tmp_path_factory.mktemp("crossing")))


@pytest.fixture(scope="module")
def leaving(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    vehicle = Vehicle("v0", SPEED, start_distance=40.0, texture_seed=21, lateral=1.5)
    return load_clip(write(render(scene(vehicles=(vehicle,), frames=14)), tmp_path_factory.mktemp("leaving")))


@pytest.fixture(scope="module")
def gappy(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    return load_clip(write(render(scene(dropped=(3, 6))), tmp_path_factory.mktemp("gappy")))


@pytest.fixture(scope="module")
def curve(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    s = scene(radius=60.0, road_depth=35.0, line_offset=1.85)
    return load_clip(write(render(s), tmp_path_factory.mktemp("curve")))


def repainted(rendered: RenderedClip, folder: Path, paint: Callable[[int, int, Image], Image]) -> Clip:
    """The clip with each picture made anew: ``paint`` takes the view, the frame and the picture."""
    views = [
        [paint(v, k, i.copy()) for k, i in enumerate(images)]
        for v, images in enumerate((rendered.left, rendered.right))
    ]
    return load_clip(write(replace(rendered, left=views[0], right=views[1]), folder))


def result(clip: Clip, method: str, **settings: Any) -> ClipResult:
    return measure(clip, open_recording(clip), method, SpeedConfiguration(**settings))


def measured(clip: Clip, method: str, **settings: Any) -> Measurement:
    return result(clip, method, **settings).measurements[0]


def assert_right(m: Measurement, method: str, speed: float = SPEED) -> None:
    assert m.speed == pytest.approx(speed, rel=BOUND[method])
    assert abs(m.speed - speed) < 5 * m.random_std  # Student's t of few degrees of freedom
    assert m.speed_lo < m.speed < m.speed_hi


# --- right speeds ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ALL)
def test_an_approaching_vehicle(clip: Clip, rendered: RenderedClip, method: str) -> None:
    m = measured(clip, method)
    assert_right(m, method)
    assert m.frames == 10 and set(m.track.status) == {"tracking"}
    centres = np.array([row["left"] for row in rendered.truth]).mean(1)
    assert np.linalg.norm(m.track.left.mean(1) - centres, axis=1).max() < 0.3 * np.ptp(m.track.left[0, :, 0])


@pytest.mark.parametrize("method", slow_after(2, reversed(ALL)))
def test_a_crossing_vehicle_without_a_path(crossing: tuple[float, Clip], method: str) -> None:
    speed, clip = crossing
    assert_right(measured(clip, method), method, speed)


@pytest.mark.parametrize("method", slow_after(1, ["lucas-kanade", "sift"]))
def test_a_curve_is_measured_along_the_curve(curve: Clip, method: str) -> None:
    m = measured(curve, method)
    assert_right(m, method)
    assert m.model != "constant velocity"  # the chord alone would be 1.6 % short


def test_lucas_kanade_is_measured_and_has_smoothed_speeds(clip: Clip) -> None:
    m = measured(clip, "lucas-kanade")
    assert (m.verdict, m.reason) == ("measured", "")
    assert (np.abs(m.track.refined_speed - SPEED) < 5 * m.track.refined_std).all()
    assert m.track.refined_std.max() < 0.1 * SPEED


def test_the_same_seed_gives_the_same_result(clip: Clip) -> None:
    a, b, c = (measured(clip, "multimodal", particles=100, seed=s).speed for s in (1, 1, 2))
    assert a == b != c


@pytest.mark.slow
def test_a_first_guess_helps_the_particles(clip: Clip) -> None:
    guessed = replace(clip, vehicles=[replace(clip.vehicles[0], speed=SPEED)])
    m = measured(guessed, "multimodal")
    assert m.track.speed[1:] == pytest.approx(np.full(9, SPEED), rel=0.2)


# --- what recordings do ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", slow_after(2, ALL))
def test_a_vehicle_that_leaves_the_image(leaving: Clip, method: str) -> None:
    m = measured(leaving, method)
    assert m.track.status[-1] in ("ended", "lost")
    assert 4 <= m.frames < 13
    if method in ("sift", "lucas-kanade"):
        assert_right(m, method)


@pytest.mark.parametrize("method", slow_after(2, ALL))
def test_a_vehicle_hidden_for_two_frames(rendered: RenderedClip, tmp_path: Path, method: str) -> None:
    def hide(view: int, frame: int, image: Image) -> Image:
        if frame in (4, 5):
            image[:] = np.random.default_rng([view, frame]).integers(0, 255, image.shape)
        return image

    m = measured(repainted(rendered, tmp_path, hide), method)
    if method == "multimodal":  # a histogram of noise is like many things: the particles go on
        assert m.track.status[-1] == "tracking"
    else:
        assert [s for s in m.track.status[4:6]] == ["lost", "lost"]
        assert m.frames == 8
        assert np.isnan(m.track.speed[4:6]).all()
        assert_right(m, method)


@pytest.mark.parametrize("method", slow_after(1, reversed(ALL)))
def test_dropped_frames_are_longer_steps(gappy: Clip, method: str) -> None:
    m = measured(gappy, method)
    assert m.frames == 8
    assert_right(m, method)


@pytest.mark.parametrize("method", slow_after(2, reversed(ALL)))
def test_a_vehicle_that_vanishes(rendered: RenderedClip, tmp_path: Path, method: str) -> None:
    clip = repainted(
        rendered, tmp_path, lambda view, frame, image: image if frame < 2 else np.full_like(image, 9 + view)
    )
    m = measured(clip, method)
    assert m.verdict == "rejected"
    assert m.reason.startswith(("too few frames", "interval too wide", "residuals"))


@pytest.mark.parametrize("method", slow_after(2, ALL))
def test_without_texture_there_is_a_reason_and_no_fault(rendered: RenderedClip, tmp_path: Path, method: str) -> None:
    def blank(view: int, frame: int, image: Image) -> Image:
        outline = np.array(rendered.truth[frame]["right" if view else "left"])
        cv2.fillConvexPoly(image, np.rint(1.3 * outline - 0.3 * outline.mean(0)).astype(np.int32), (90,))
        return image

    m = measured(repainted(rendered, tmp_path, blank), method)
    assert m.verdict == "rejected"
    assert "texture" in m.reason and np.isnan(m.speed)


def test_repeated_pictures_are_passed_over(rendered: RenderedClip, tmp_path: Path) -> None:
    pictures = rendered.left, rendered.right
    clip = repainted(rendered, tmp_path, lambda view, frame, image: pictures[view][4] if frame == 5 else image)
    m = measured(clip, "lucas-kanade")
    assert 5 not in m.track.frame
    assert_right(m, "lucas-kanade")


# --- the outputs and what is refused ---------------------------------------------------------------------------------


@pytest.mark.parametrize("method", slow_after(1, ["lucas-kanade", "kalman"]))
def test_the_same_files_come_out(clip: Clip, tmp_path: Path, method: str) -> None:
    found = result(clip, method)
    write_report(found, open_recording(clip), tmp_path / "out")
    with (tmp_path / "out" / "estimates.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ESTIMATE_COLUMNS and len(rows) == 10
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["configuration"]["method"] == method
    assert summary["vehicles"][0]["speed_mps"] == pytest.approx(found.measurements[0].speed)
    assert (tmp_path / "out" / "report.html").exists() and (tmp_path / "out" / "overlay.mp4").exists()


def test_the_papers_filter_is_measured_as_printed(clip: Clip) -> None:
    found = result(clip, "zhu", particles=150, seed=2)
    settings = {"guided": False, "exact_path": True, "refine": False}
    expected = result(clip, DEFAULT_METHOD, particles=150, seed=2, **settings).measurements[0]
    (m,) = found.measurements
    assert m.speed == expected.speed == pytest.approx(SPEED, rel=0.1)
    assert found.configuration["method"] == "zhu" and found.configuration["particles"] == 150
    assert {key: found.configuration[key] for key in settings} == settings
    assert m.interval_from == "filter" and format_verdict(m) == "measured, interval from the filter's spread alone"


def test_the_interval_of_a_baseline_is_called_what_it_is(clip: Clip) -> None:
    m = measured(clip, "sift")
    assert (m.verdict, m.interval_from) == ("measured", "scatter")
    assert format_verdict(m) == "measured, interval from scatter alone"
    assert interval_title([m.interval_from, None]) == "interval"
    assert interval_title(["fit", None]) == interval_title([None]) == "95 % interval"


def test_progress_is_reported(clip: Clip) -> None:
    told: list[tuple[int, int]] = []
    measure(clip, open_recording(clip), "sift", SpeedConfiguration(), lambda *seen: told.append(seen))
    assert told == [(k, 10) for k in range(1, 11)]


def test_only_the_multimodal_tracker_draws_paths(clip: Clip) -> None:
    assert [p.name for p in result(clip, "multimodal", particles=50).paths] == ["lane0"]
    assert result(clip, "sift").paths == []
    assert result(clip, "multimodal", particles=50, motion="free").paths == []


def test_what_cannot_be_measured_is_refused(clip: Clip, rendered: RenderedClip, tmp_path: Path) -> None:
    with pytest.raises(UnusableInput, match="--method kalmann: unknown; expected one of .*sift, kalman"):
        result(clip, "kalmann")
    with pytest.raises(UnusableInput, match="vehicles: none is outlined"):
        result(replace(clip, vehicles=[]), "sift")
    with pytest.raises(UnusableInput, match="frame 99 is not in the recording"):
        result(replace(clip, vehicles=[replace(clip.vehicles[0], frame=99)]), "sift")
    same = load_clip(write(replace(rendered, right=rendered.left), tmp_path))
    with pytest.raises(UnusableInput, match="the same picture in both"):
        result(same, "sift")


# --- inside the multimodal tracker -----------------------------------------------------------------------------------


def test_kernel_smoothing_leaves_mean_and_covariance(clip: Clip) -> None:
    n = 20000
    run = Multimodal(clip.rig, clip.vehicles[0], None, SpeedConfiguration(particles=n))
    rng = np.random.default_rng(10)
    state = rng.normal(0, 1, (n, 6)) @ rng.normal(0, 1, (6, 6)) + rng.normal(0, 5, 6)
    weights = Weights(-0.5 * state[:, 0] ** 2 / state[:, 0].var())
    cloud = run._smooth(Particles(state[:, :3], state[:, 3:]), weights)
    smoothed = np.concatenate([cloud.places, cloud.velocities], axis=1)
    before = weights.covariance(state)
    assert np.abs(smoothed.mean(0) - weights.mean(state)) == pytest.approx(
        0, abs=5 * np.sqrt(before.diagonal().max() / n)
    )
    root = np.linalg.inv(np.linalg.cholesky(before))
    assert root @ np.cov(smoothed.T) @ root.T == pytest.approx(np.eye(6), abs=7 * np.sqrt(2 / weights.ESS))
