"""Random scenes whose vehicles are textured faces: before a stereo rig, and chases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from paceline.arrays import Array, Mask
from paceline.cameras import PosedCamera
from paceline.simulation.chase.scene import CHASE_PRESETS, ChaseScene
from paceline.simulation.operator import is_inside_image, longest_visible_run
from paceline.simulation.random_scenes.visibility import (
    MAX_BEND_DEPTH_M,
    MAX_BEND_OBLIQUITY_RAD,
    MIN_BEND_DEPTH_M,
    MIN_VISIBLE_FRAMES,
)
from paceline.simulation.stereo.scene import Motion, PlacedRoad, Scene, Vehicle, make_rig, rig_views, visible_line
from paceline.simulation.vehicle_catalogue import MIN_RASTERIZED_GAP_M, RASTERIZED_KINDS
from paceline.units import MPS_PER_MPH

FRAME_RATES_HZ = (5.0, 7.5, 10.0, 12.5, 15.0, 20.0, 25.0, 30.0)
IMAGE_SIZES = ((1024, 768), (1280, 720), (1280, 960), (1440, 1080))


def random_scene(seed: int, *, vehicle: dict[str, Any] | None = None, **overrides: Any) -> Scene:
    """A varied scene of one vehicle at 5–130 mph, seen at about 15–80 m and inside both images for at least 8 frames.

    ``overrides`` fix fields of `Scene`, and ``vehicle`` fields of its `Vehicle`; the rest is drawn to suit them.
    Raises ValueError where nothing suits them.
    """
    return _draw_suitable_scene(seed, _propose_approach, MPS_PER_MPH * 5, MPS_PER_MPH * 130, vehicle or {}, overrides)


def random_crossing(seed: int, *, vehicle: dict[str, Any] | None = None, **overrides: Any) -> Scene:
    """A varied scene of one vehicle that crosses the view, its side towards the cameras, without a path.

    Overrides and errors as for `random_scene`.
    """
    return _draw_suitable_scene(seed, _propose_crossing, MPS_PER_MPH * 10, MPS_PER_MPH * 60, vehicle or {}, overrides)


def random_bend(seed: int, radius: float | None = None, rate: float = 5.0, **overrides: Any) -> Scene:
    """A scene of one vehicle at 21–36 mph on a bend that comes towards the cameras and crosses their view.

    Somewhere in view the road runs along the epipolar lines, and between two pictures a vehicle turns by up to 0.3 rad.
    It is shown as long as it is inside both images, `MIN_BEND_DEPTH_M` to `MAX_BEND_DEPTH_M` away, and its front or
    rear is seen at less than `MAX_BEND_OBLIQUITY_RAD`. ``radius`` (m, drawn from 30–80 where None) bends to either
    side; ``overrides`` as for `random_scene`. Raises ValueError where nothing suits.
    """
    rng = np.random.default_rng([seed, 53])
    for _ in range(400):
        bend = float(rng.choice([-1, 1])) * (radius or float(rng.uniform(30, 80)))
        scene = replace(_propose_bend(seed, rng, bend, rate), **overrides)
        if (shown := _shown_on_bend(scene)) is not None:
            return shown
    raise ValueError(f"no bend of seed {seed} suits {overrides}")


Proposal = Callable[[int, np.random.Generator, float, dict[str, Any]], Scene]


def _draw_suitable_scene(
    seed: int, propose: Proposal, slowest: float, fastest: float, vehicle: dict[str, Any], overrides: dict[str, Any]
) -> Scene:
    rng = np.random.default_rng([seed, 5])
    speed = vehicle.get("speed", rng.uniform(slowest, fastest))  # drawn once: no speed is likelier for suiting better
    for _ in range(400):
        scene = replace(propose(seed, rng, speed, vehicle), **overrides)
        if _is_suitable(scene):
            return scene
    raise ValueError(f"no scene of seed {seed} suits {overrides} {vehicle}")


def _propose_approach(seed: int, rng: np.random.Generator, speed: float, fixed: dict[str, Any]) -> Scene:
    frames, rate = _draw_frames_and_rate(rng, speed, 60.0)
    distance = speed * (frames - 1) / rate
    near = rng.uniform(15, max(16.0, 78 - distance))
    middle = near + distance / 2
    receding = bool(rng.random() < 0.35)
    height = rng.uniform(1.5, 6.0)
    vehicle = Vehicle(
        "v0",
        speed,
        acceleration=_draw_acceleration(rng, speed, frames / rate),
        start_distance=near if receding else near + distance,
        receding=receding,
        width=rng.uniform(1.6, 2.0),
        height=rng.uniform(0.55, 0.8),
        lateral=rng.normal(0, 0.15),
        texture_seed=int(rng.integers(2**31)),
        heading_error=rng.normal(0, 0.002),
        relief=float(rng.choice([0.0, 0.03, 0.06])),
        glare=bool(rng.random() < 0.2),
    )
    return Scene(
        seed,
        (replace(vehicle, **fixed),),
        image_size=IMAGE_SIZES[rng.integers(len(IMAGE_SIZES))],
        focal=rng.uniform(1200, 3000),
        baseline=rng.uniform(0.4, 0.7),
        camera_height=height,
        tilt=float(np.arctan2(height - 0.8, middle) + rng.normal(0, 0.012)),
        rate=rate,
        frames=frames,
        radius=float(rng.choice([-1, 1]) * rng.uniform(60, 400)) if rng.random() < 0.4 else None,
        road_direction=rng.normal(0, 0.05),
        road_offset=rng.uniform(-0.04, 0.04) * middle,
        road_depth=middle,
        line_offset=float(rng.choice([-1.85, 1.85])),
        **_draw_image_quality(rng, frames),
    )


def _propose_bend(seed: int, rng: np.random.Generator, radius: float, rate: float) -> Scene:
    receding, depth = bool(rng.random() < 0.35), rng.uniform(38, 50)
    vehicle = Vehicle(
        "v0",
        rng.uniform(21, 36) * MPS_PER_MPH,
        start_distance=depth + (-1 if receding else 1) * 40.0,
        receding=receding,
        width=rng.uniform(1.6, 2.0),
        height=rng.uniform(0.55, 0.8),
        lateral=rng.normal(0, 0.15),
        texture_seed=int(rng.integers(2**31)),
        relief=float(rng.choice([0.0, 0.03, 0.06])),
    )
    height = rng.uniform(1.5, 3.0)
    return Scene(
        seed,
        (vehicle,),
        focal=2200.0,
        baseline=0.5,
        camera_height=height,
        tilt=float(np.arctan2(height - 0.8, depth) + rng.normal(0, 0.012)),
        rate=rate,
        radius=radius,
        road_direction=rng.normal(0, 0.1),
        road_offset=rng.uniform(-4.0, 4.0),
        road_depth=depth,
        line_offset=float(rng.choice([-1.85, 1.85])),
        **{**_draw_image_quality(rng, 12), "dropped": (), "occluder": False},
    )


def _shown_on_bend(scene: Scene) -> Scene | None:
    """The part of a scene in which its vehicle is well seen; None if that is less than `MIN_VISIBLE_FRAMES`."""
    road, views = PlacedRoad(scene), rig_views(make_rig(scene))
    vehicle, duration = scene.vehicles[0], 80.0 / scene.vehicles[0].speed
    motion = Motion(road, vehicle, duration)
    ticks = np.arange(0.0, duration, 1 / scene.rate)
    poses = [motion.pose(t) for t in ticks.tolist()]
    corners = np.array([pose.corners(vehicle.width, vehicle.height) for pose in poses])
    sight = np.array([pose.centre / np.linalg.norm(pose.centre) for pose in poses])
    facing = (sight * np.array([pose.axes[:, 2] for pose in poses])).sum(1)
    well_seen = (corners[..., 2].min(1) > MIN_BEND_DEPTH_M) & (corners[..., 2].max(1) < MAX_BEND_DEPTH_M)
    well_seen &= facing > np.cos(MAX_BEND_OBLIQUITY_RAD)
    well_seen &= _inside_both(scene, [view.project(corners) for view in views])
    k = longest_visible_run(np.arange(len(ticks), dtype=float)[:, None], well_seen)[:, 0].astype(int)
    if len(k) < MIN_VISIBLE_FRAMES:
        return None
    if any(len(visible_line(scene, road, vehicle.lane, corners[k].mean(1), view)) < 10 for view in views):
        return None
    start = float(road.coordinates(poses[k[0]].centre[None])[0][0])
    return replace(scene, vehicles=(replace(vehicle, start_distance=start),), frames=len(k))


def _propose_crossing(seed: int, rng: np.random.Generator, speed: float, fixed: dict[str, Any]) -> Scene:
    frames, rate = _draw_frames_and_rate(rng, speed, 14.0)
    distance = speed * (frames - 1) / rate
    depth, height = rng.uniform(12, 25), rng.uniform(1.2, 3.0)
    receding = bool(rng.random() < 0.5)
    vehicle = Vehicle(
        "v0",
        speed,
        acceleration=_draw_acceleration(rng, speed, frames / rate),
        start_distance=depth + (-1 if receding else 1) * distance / 2,
        receding=receding,
        width=rng.uniform(2.6, 3.8),
        height=rng.uniform(0.55, 0.75),
        plane="side",
        texture_seed=int(rng.integers(2**31)),
        relief=float(rng.choice([0.0, 0.03])),
        glare=bool(rng.random() < 0.2),
    )
    return Scene(
        seed,
        (replace(vehicle, **fixed),),
        image_size=IMAGE_SIZES[rng.integers(len(IMAGE_SIZES))],
        focal=rng.uniform(700, 1500),
        baseline=rng.uniform(0.4, 0.7),
        camera_height=height,
        tilt=float(np.arctan2(height - 0.8, depth) + rng.normal(0, 0.03)),
        rate=rate,
        frames=frames,
        road_direction=np.pi / 2 + rng.normal(0, 0.08),
        road_depth=depth,
        draw_path=False,
        **_draw_image_quality(rng, frames),
    )


def _draw_frames_and_rate(rng: np.random.Generator, speed: float, longest: float) -> tuple[int, float]:
    """A number of frames and a rate at which a vehicle drives between 5 and ``longest`` metres."""
    frames = int(rng.integers(10, 18))
    rates = [r for r in FRAME_RATES_HZ if 5.0 <= speed * (frames - 1) / r <= longest]
    return frames, float(rng.choice(rates or [FRAME_RATES_HZ[0] if speed < 10 else FRAME_RATES_HZ[-1]]))


def _draw_acceleration(rng: np.random.Generator, speed: float, duration: float) -> float:
    """Now and then a change of speed, but none that nearly stops the vehicle."""
    return max(float(rng.normal(0, 0.8)), -0.4 * speed / duration) if rng.random() < 0.3 else 0.0


def _draw_image_quality(rng: np.random.Generator, frames: int) -> dict[str, Any]:
    """What the optics, the sensor, the light and the recorder do to a clip."""
    dropped = rng.choice(np.arange(2, frames - 1), int(rng.integers(1, 3)), replace=False)
    return {
        "noise_sigma": rng.uniform(0.5, 2.5),
        "shot_noise": rng.uniform(0, 0.02),
        "blur_sigma": rng.uniform(0.5, 0.9),
        "gain_drift": rng.uniform(0, 0.06),
        "occluder": bool(rng.random() < 0.15),
        "dropped": tuple(sorted(dropped.tolist())) if rng.random() < 0.25 else (),
    }


def _is_suitable(scene: Scene) -> bool:
    """Whether each vehicle is inside both images for 8 frames and most of its time, within 10–85 m, its picture large
    enough, and its line visible and well across the epipolar lines in both views."""
    road, rig = PlacedRoad(scene), make_rig(scene)
    views = rig_views(rig)
    ticks = [k / scene.rate for k in range(scene.frames) if k not in scene.dropped]
    for vehicle in scene.vehicles:
        motion = Motion(road, vehicle, scene.frames / scene.rate)
        corners = np.array([motion.pose(t).corners(vehicle.width, vehicle.height) for t in ticks])
        depths = corners[..., 2]
        if depths.min() < 10 or depths.max() > 85:
            return False
        pixels = [view.project(corners) for view in views]
        inside = _inside_both(scene, pixels)
        if inside.sum() < max(8, 0.7 * len(ticks)) or np.ptp(pixels[0][..., 0], axis=1).min() < 24:
            return False
        if scene.draw_path and not all(_is_line_usable(scene, road, vehicle, corners[inside], v) for v in views):
            return False
    return True


def _inside_both(scene: Scene, pixels: Sequence[Array]) -> Mask:
    """Whether corners are inside both images, (N,), from their ``pixels`` (N, 4, 2) in each."""
    return np.asarray(np.all([[is_inside_image(q, scene.image_size) for q in view] for view in pixels], axis=0))


def _is_line_usable(scene: Scene, road: PlacedRoad, vehicle: Vehicle, corners: Array, view: PosedCamera) -> bool:
    pixels = visible_line(scene, road, vehicle.lane, corners.mean(1), view)
    if len(pixels) < 10:
        return False
    span = np.abs(pixels[-1] - pixels[0])
    return bool(np.hypot(*span) > 100 and span[1] > 0.25 * span[0] and span[1] > 30)


def random_chase(seed: int, preset: str = "nist", **overrides: Any) -> ChaseScene:
    """A varied chase; ``overrides`` fix fields of `ChaseScene`, the rest is drawn.

    Raises KeyError for a preset that is not one of `CHASE_PRESETS`.
    """
    rng = np.random.default_rng([seed, 41])
    drawn = str(rng.choice(RASTERIZED_KINDS))
    kind = overrides.get("kind", drawn)
    fixed = dict(CHASE_PRESETS[preset])
    near, far = fixed.get("gap", ChaseScene.gap)
    fixed["gap"] = max(near, MIN_RASTERIZED_GAP_M[kind]), far
    light = rng.random() < 0.6
    scene = ChaseScene(
        seed,
        camera_height=rng.uniform(1.6, 2.3),
        tilt=rng.uniform(0.035, 0.08),
        kind=kind,
        paint=rng.uniform(110, 205) if light else rng.uniform(28, 60),
        weave=rng.uniform(0.3, 1.0),
        shake_px=rng.uniform(2.0, 5.0),
        object_density=rng.uniform(0.6, 1.5),
        parallel_share=float(rng.choice([0.0, 0.2, 0.5, 0.9])),
        shadows=float(rng.choice([0.0, 0.4, 0.8, 1.3])),
        ambient=rng.uniform(0.28, 0.65),
        sun_azimuth=rng.uniform(-np.pi, np.pi),
        sun_elevation=rng.uniform(0.5, 1.1),
        exposure=rng.uniform(0.8, 1.5),
        exposure_drift=rng.uniform(0.0, 0.25),
        vignetting=rng.uniform(0.0, 0.35),
        blur_sigma=rng.uniform(0.45, 0.9),
        shutter_s=rng.uniform(0.002, 0.012),
        noise_sigma=rng.uniform(0.8, 3.0),
        shot_noise=rng.uniform(0.0, 0.04),
    )
    return replace(scene, **(fixed | overrides))
