"""The filter by itself, on rendered clips: it converges, stays, comes back, and says when it is over."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path as FilePath

import numpy as np
import pytest
from numpy.typing import NDArray
from selection import slow_after

from paceline.documents.loading import Clip, load_clip
from paceline.recordings.stereo import StereoFrame, open_recording
from paceline.simulation.random_scenes.drawn import random_bend
from paceline.simulation.random_scenes.raytraced import random_raytraced_bend
from paceline.simulation.raytraced import stereo_clip
from paceline.simulation.stereo.clip import Scene, Vehicle, World, render, write
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter.estimate import Estimate
from paceline.speed.filter.motion_models import CoordinatedTurn
from paceline.speed.filter.tracker import Tracker
from paceline.speed.geometry.path_reconstruction import path_from_document
from paceline.speed.geometry.paths import Path

Array = NDArray[np.float64]

MPH = 0.44704  # m/s
CONVERGED = 5  # frames after which the filter has found the speed
MAX_OCCLUDED_FRAMES = SpeedConfiguration().tracking.max_occluded_frames
FOLDERS: list[FilePath] = []


@pytest.fixture(scope="module", autouse=True)
def _folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    FOLDERS.append(tmp_path_factory.mktemp("clips"))


def scene(kind: str, speed: float, seed: int, **more: object) -> Scene:
    """One vehicle between 22 m and 70 m from the cameras, on a straight or a bent road."""
    receding = kind == "receding"
    start = 22.0 if receding else 24.0 + 9 * speed / 5
    vehicle = Vehicle("v0", speed, start_distance=start, receding=receding, texture_seed=seed)
    radius = {"left": -150.0, "right": 150.0}.get(kind)
    bent = {} if radius is None else {"radius": radius, "road_depth": 40.0}
    return replace(Scene(seed, (vehicle,), frames=10), **{**bent, **more})  # type: ignore[arg-type]


def small(kind: str, speed: float, seed: int, **more: object) -> Scene:
    """The same in pictures of half the size, quickly rendered and tracked; hands as steady in metres."""
    less = {"image_size": (640, 480), "focal": 1400.0, "click_sigma": 0.3, "line_sigma": 0.25}
    return scene(kind, speed, seed, **{**less, **more})


@cache
def clip_of(scene: Scene) -> tuple[Clip, list[StereoFrame], Path | None, float]:
    """The clip, its frames from the vehicle's first one on, its path and lateral offset."""
    clip = load_clip(write(render(scene), FOLDERS[-1] / f"{len(list(FOLDERS[-1].iterdir()))}"))
    frames = list(open_recording(clip).frames(clip.vehicles[0].frame))
    for drawn in clip.paths.values():
        return clip, frames, path_from_document(drawn, clip.rig), drawn.lateral_offset
    return clip, frames, None, 0.0


def track(
    scene: Scene, guess: float | None, frames: Sequence[StereoFrame] | None = None, **settings: object
) -> list[Estimate]:
    """The filter's estimates up to the end of the track; ``guess`` is a factor of the true speed."""
    clip, all_frames, path, offset = clip_of(scene)
    speed = None if guess is None else guess * scene.vehicles[0].speed
    vehicle = replace(clip.vehicles[0], speed=speed)
    tracker = Tracker(clip.rig, vehicle, path, offset, SpeedConfiguration.model_validate(settings))
    estimates = []
    for frame in all_frames if frames is None else frames:
        estimates.append(tracker.update(frame))
        if tracker.status != "tracking":
            with pytest.raises(RuntimeError, match=f"vehicle v0 is {tracker.status}"):
                tracker.update(frame)
            break
    return estimates


def errors(scene: Scene, estimates: list[Estimate]) -> Array:
    """Of the speed at every frame, mph."""
    v = scene.vehicles[0]
    return np.array([e.speed - v.speed - v.acceleration * e.time for e in estimates]) / MPH


def walled(frames: list[StereoFrame], hidden: Sequence[int]) -> list[StereoFrame]:
    """``frames`` with a wall that stands still before the vehicle in those at ``hidden``."""
    rng = np.random.default_rng(8)
    wall = np.clip(rng.normal(120, 40, frames[0].left.shape), 0, 255).astype(np.float32)
    return [replace(f, left=wall, right=wall[:, ::-1]) if i in hidden else f for i, f in enumerate(frames)]


SPEEDS = {
    "line": (11.2, 23.2),
    "receding": (11.2, 23.2),
    "left": (11.2, 21.3, 17.5),
    "right": (11.2, 18.8, 21.3),
}
CASES = [
    (kind, speeds[k], seed) for k, seed in enumerate((3, 7, 5)) for kind, speeds in SPEEDS.items() if k < len(speeds)
]


@pytest.mark.parametrize("guess", slow_after(1, [0.85, 1.15]))
@pytest.mark.parametrize(("kind", "speed", "seed"), slow_after(2, CASES))
def test_the_filter_converges_and_stays(kind: str, speed: float, seed: int, guess: float) -> None:
    s = scene(kind, speed, seed)
    estimates = track(s, guess, seed=seed)
    assert [e.status for e in estimates] == ["tracking"] * s.frames
    assert np.abs(errors(s, estimates)[CONVERGED:]).max() < 1.0


@pytest.mark.parametrize("kind", slow_after(1, ["left", "line", "receding"]))
def test_without_a_guess(kind: str) -> None:
    s = small(kind, 15.0, seed=2)
    estimates = track(s, None)
    assert np.isnan(estimates[0].speed)
    assert np.abs(errors(s, estimates)[CONVERGED:]).max() < 1.0
    assert len(estimates[-1].particles_left) == 400


@pytest.mark.parametrize("seed", [2, 11, 16, 32, 35])
def test_the_second_frame_gives_the_speed_of_a_near_vehicle_that_leaves(seed: int) -> None:
    """The picture of a vehicle that leaves close by shrinks much, and from the mean of all speeds it is far."""
    rng = np.random.default_rng(seed)
    speed, start = float(rng.uniform(6, 28)), float(rng.uniform(13, 24))
    lane, width = float(rng.choice([-1.85, 1.85, 3.4])), float(rng.choice([0.8, 1.75, 2.4]))
    vehicle = Vehicle("v0", speed, start_distance=start, receding=True, lane=lane, texture_seed=seed, width=width)
    s = Scene(seed, (vehicle,), image_size=(640, 480), focal=float(rng.uniform(700, 1400)), frames=4)
    assert track(s, None, clip_of(s)[1][:2])[1].speed == pytest.approx(speed, rel=0.1)


@pytest.mark.parametrize(("rate", "speed"), slow_after(1, [(30.0, 3.0), (60.0, 9.0)]))
@pytest.mark.parametrize("guess", slow_after(0, [None, 1.0]))
def test_the_first_speeds_std_matches_its_error(rate: float, speed: float, guess: float | None) -> None:
    """In which a vehicle far off hardly moves by more than it is seen to by chance."""
    z = []
    for seed in range(8):
        s = small("line", speed, seed, rate=rate, frames=6)
        last = track(s, guess)[-1]
        z.append((last.speed - speed) / last.speed_std)
    assert np.sqrt(np.mean(np.square(z))) < 3.0  # 1.5 or less; 4 to 7 where that place is taken as sure


def test_the_same_seed_gives_the_same_bits() -> None:
    s = small("left", 15.0, seed=2)
    one, two, other = (track(s, 1.1, seed=seed) for seed in (4, 4, 5))
    for a, b in list(zip(one, two, strict=True))[1:]:
        assert (a.speed, a.speed_std, a.ess, a.similarity) == (b.speed, b.speed_std, b.ess, b.similarity)
        np.testing.assert_array_equal(a.left, b.left)
        np.testing.assert_array_equal(a.particles_right, b.particles_right)
    assert one[-1].speed != other[-1].speed


@pytest.mark.parametrize("resampling", ["systematic", "stratified", "residual", "multinomial"])
@pytest.mark.parametrize("resample_below", [1.0, 0.5])
def test_every_resampling_scheme(resampling: str, resample_below: float) -> None:
    s = small("line", 15.0, seed=2)
    estimates = track(s, 0.9, resampling=resampling, resample_below=resample_below)
    assert np.abs(errors(s, estimates)[CONVERGED:]).max() < 1.0
    assert all(1 <= e.ess <= 400.001 for e in estimates)


def test_an_estimate_fits_the_truth() -> None:
    s = small("line", 15.0, seed=2)
    truth = render(s).truth
    estimates = track(s, 1.05)
    for e, row in zip(estimates, truth, strict=True):
        assert (e.frame, e.time) == (row["frame"], pytest.approx(row["time_s"]))
        np.testing.assert_allclose(e.left, row["left"], atol=3.0)
        np.testing.assert_allclose(e.right, row["right"], atol=3.0)
        np.testing.assert_allclose(e.position[:2], row["position"][:2], atol=0.15)
        assert e.position[2] == pytest.approx(row["position"][2], rel=0.02)
        assert e.speed_std > 0 or e is estimates[0]
    assert np.isnan(estimates[0].yaw_rate) and all(abs(e.yaw_rate) < 0.02 for e in estimates[1:])


@pytest.mark.parametrize(("kind", "sign"), slow_after(0, [("left", 1), ("right", -1)]))
def test_the_yaw_rate_of_a_curve(kind: str, sign: int) -> None:
    """Towards growing arc length the road turns left; who comes along it the other way turns right."""
    rates = [e.yaw_rate for seed in (2, 3, 4) for e in track(small(kind, 15.0, seed=seed), 1.0)[3:]]
    assert np.mean(rates) == pytest.approx(sign * 15.0 / 150.0, rel=0.5)


def test_a_vehicle_that_leaves_the_image_ends() -> None:
    vehicle = Vehicle("v0", 16.0, start_distance=38.0, texture_seed=3)
    s = replace(small("line", 16.0, seed=3), vehicles=(vehicle,), frames=12)
    truth = render(s).truth
    last = max(row["frame"] for row in truth if row["inside"])
    estimates = track(s, 1.1)
    assert estimates[-1].status == "ended" and abs(estimates[-1].frame - last) <= 1
    assert {e.status for e in estimates[:-1]} == {"tracking"}


@pytest.mark.parametrize("kind", slow_after(1, ["right", "line", "receding"]))
def test_a_vehicle_occluded_for_good_is_lost(kind: str) -> None:
    """And until that is said, nothing wild is."""
    s = small(kind, 15.0, seed=2)
    frames = walled(clip_of(s)[1], range(5, 99))
    estimates = track(s, 1.05, frames)
    assert [e.status for e in estimates] == ["tracking"] * (4 + MAX_OCCLUDED_FRAMES) + ["lost"]
    assert np.abs(errors(s, estimates)[5:]).max() < 6.0


@pytest.mark.parametrize("kind", ["line", "left"])
@pytest.mark.parametrize("hidden", [(4,), (4, 5)])
def test_a_vehicle_occluded_for_a_moment_is_tracked_again(kind: str, hidden: tuple[int, ...]) -> None:
    s = small(kind, 15.0, seed=2)
    estimates = track(s, 0.95, walled(clip_of(s)[1], hidden))
    assert len(estimates) == s.frames and estimates[-1].status == "tracking"
    assert np.abs(errors(s, estimates)[-2:]).max() < 1.0
    assert all(estimates[i].similarity < 0.5 for i in hidden) and estimates[-1].similarity > 0.8


@pytest.mark.parametrize("kind", ["line", "left"])
def test_an_occluder_does_not_weight_the_particles(kind: str) -> None:
    """While it is hidden all of them count, and know less from frame to frame."""
    s, hidden = small(kind, 15.0, seed=2), (4, 5)
    for seed in range(4):
        estimates = track(s, 0.95, walled(clip_of(s)[1], hidden), seed=seed)
        assert all(estimates[i].ess == pytest.approx(400) for i in hidden)
        stds = [e.speed_std for e in estimates[3:6]]
        assert stds == sorted(stds)
        deviations = [x / e.speed_std for x, e in zip(errors(s, estimates)[6:] * MPH, estimates[6:], strict=True)]
        assert np.abs(deviations).max() < 4.0


def test_a_wall_from_the_second_frame_on_is_no_vehicle() -> None:
    s = small("line", 15.0, seed=2)
    estimates = track(s, 1.0, walled(clip_of(s)[1], range(1, 99)))
    assert estimates[-1].status == "lost" and len(estimates) == 1 + MAX_OCCLUDED_FRAMES


def test_every_frame_has_its_own_time_step() -> None:
    s = small("line", 15.0, seed=2, dropped=(3, 6, 7))
    estimates = track(s, 0.9)
    np.testing.assert_allclose([e.time for e in estimates], [0.0, 0.2, 0.4, 0.8, 1.0, 1.6, 1.8])
    assert np.abs(errors(s, estimates)[3:]).max() < 1.0


def test_braking_is_followed() -> None:
    s = small("line", 15.0, seed=2)
    s = replace(s, vehicles=(replace(s.vehicles[0], acceleration=-2.0),))
    assert np.abs(errors(s, track(s, 1.1))[CONVERGED:]).max() < 1.5


@pytest.mark.parametrize("motion", ["as printed", "exact", "printed and exact"])
def test_the_method_as_printed(motion: str) -> None:
    """Proposals without registration and the path as a hard constraint run too, less accurately."""
    s = small("line", 15.0, seed=2)
    settings = {"guided": "printed" not in motion, "exact_path": "exact" in motion}
    estimates = track(s, 1.05, speed_noise=0.15, particles=1000, **settings)
    assert len(estimates) == s.frames and estimates[-1].status == "tracking"
    assert np.abs(errors(s, estimates)[CONVERGED:]).max() < 4.0


def test_free_motion_needs_no_path() -> None:
    s = small("receding", 15.0, seed=2, draw_path=False)
    estimates = track(s, 1.0)
    assert len(estimates) == s.frames and estimates[-1].status == "tracking"
    assert np.abs(errors(s, estimates)[CONVERGED:]).max() < 3.0


@pytest.mark.slow
def test_a_bend_is_followed_without_a_path() -> None:
    """The vehicle turns by 4° from frame to frame."""
    s = replace(random_bend(102, 45.0, draw_path=False), frames=10)
    clip, frames, _, _ = clip_of(s)
    tracker = Tracker(clip.rig, clip.vehicles[0])
    estimates = [tracker.update(frame) for frame in frames]
    motion = World(s).motions[0]
    places = np.array([motion.pose(e.time).centre for e in estimates])
    assert estimates[-1].status == "tracking"
    assert np.linalg.norm([e.position for e in estimates] - places, axis=1).max() < 0.5
    assert np.abs(errors(s, estimates)[CONVERGED:]).max() < 1.0
    directions = np.array([motion.pose(e.time).axes[:, 2] for e in estimates])
    turn = float(np.cross(directions[-2], directions[-1])[1] / 0.2)
    assert abs(estimates[-1].yaw_rate - turn) < 0.15


@pytest.mark.slow
def test_a_motorcycle_on_a_bend_is_followed_though_it_is_not_flat(tmp_path: FilePath) -> None:
    """Its parts lie a metre behind each other: the outlined face seems to turn by far more than it does."""
    scene = random_raytraced_bend(9868)
    assert scene.vehicles[0].kind == "motorcycle"
    clip = load_clip(stereo_clip.write(scene, tmp_path / "clip"))
    (vehicle,), truth = clip.vehicles, json.loads((tmp_path / "clip" / "truth.json").read_text())
    tracker = Tracker(clip.rig, vehicle)
    estimates = [tracker.update(frame) for frame in open_recording(clip).frames(vehicle.frame)]
    assert estimates[-1].status == "tracking" and len(estimates) == len(truth)
    distances = [np.linalg.norm(e.position - row["position"]) for e, row in zip(estimates, truth, strict=True)]
    assert max(distances) < 1.0


def test_as_in_the_paper_free_motion_keeps_its_velocity() -> None:
    s = small("receding", 15.0, seed=2, draw_path=False)
    clip, frames, _, _ = clip_of(s)
    for guided in (True, False):
        tracker = Tracker(clip.rig, clip.vehicles[0], configuration=SpeedConfiguration(guided=guided))
        for frame in frames[:2]:
            tracker.update(frame)
        assert isinstance(tracker.particle_set.motion, CoordinatedTurn) == guided
