"""Scenes drawn at random, varied enough to judge a measurement and its intervals by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from paceline.arrays import Array
from paceline.cameras import View
from paceline.simulation.operator import is_inside
from paceline.simulation.stereo.scene import Motion, Road, Scene, Vehicle, make_rig, views_of, visible_line

MILE_PER_HOUR = 0.44704
RATES = (5.0, 7.5, 10.0, 12.5, 15.0, 20.0, 25.0, 30.0)
IMAGE_SIZES = ((1024, 768), (1280, 720), (1280, 960), (1440, 1080))


def random_scene(seed: int, *, vehicle: dict[str, Any] | None = None, **overrides: Any) -> Scene:
    """A varied scene of one vehicle at 5–130 mph, seen at about 15–80 m and inside both images for at least 8 frames.

    ``overrides`` fix fields of `Scene`, and ``vehicle`` fields of its `Vehicle`; the rest is drawn to suit them.
    Raises ValueError where nothing suits them.
    """
    return _first_that_suits(seed, _along_the_view, MILE_PER_HOUR * 5, MILE_PER_HOUR * 130, vehicle or {}, overrides)


def random_crossing(seed: int, *, vehicle: dict[str, Any] | None = None, **overrides: Any) -> Scene:
    """A varied scene of one vehicle that crosses the view, its side towards the cameras, without a path.

    Overrides and errors as for `random_scene`.
    """
    return _first_that_suits(seed, _across_the_view, MILE_PER_HOUR * 10, MILE_PER_HOUR * 60, vehicle or {}, overrides)


Proposal = Callable[[int, np.random.Generator, float, dict[str, Any]], Scene]


def _first_that_suits(
    seed: int, propose: Proposal, slowest: float, fastest: float, vehicle: dict[str, Any], overrides: dict[str, Any]
) -> Scene:
    rng = np.random.default_rng([seed, 5])
    speed = vehicle.get("speed", rng.uniform(slowest, fastest))  # drawn once: no speed is likelier for suiting better
    for _ in range(400):
        scene = replace(propose(seed, rng, speed, vehicle), **overrides)
        if _suits(scene):
            return scene
    raise ValueError(f"no scene of seed {seed} suits {overrides} {vehicle}")


def _along_the_view(seed: int, rng: np.random.Generator, speed: float, fixed: dict[str, Any]) -> Scene:
    frames, rate = _clock(rng, speed, 60.0)
    way = speed * (frames - 1) / rate
    near = rng.uniform(15, max(16.0, 78 - way))
    middle = near + way / 2
    receding = bool(rng.random() < 0.35)
    height = rng.uniform(1.5, 6.0)
    vehicle = Vehicle(
        "v0",
        speed,
        acceleration=_acceleration(rng, speed, frames / rate),
        start_distance=near if receding else near + way,
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
        **_picture(rng, frames),
    )


def _across_the_view(seed: int, rng: np.random.Generator, speed: float, fixed: dict[str, Any]) -> Scene:
    frames, rate = _clock(rng, speed, 14.0)
    way = speed * (frames - 1) / rate
    depth, height = rng.uniform(12, 25), rng.uniform(1.2, 3.0)
    receding = bool(rng.random() < 0.5)
    vehicle = Vehicle(
        "v0",
        speed,
        acceleration=_acceleration(rng, speed, frames / rate),
        start_distance=depth + (-1 if receding else 1) * way / 2,
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
        **_picture(rng, frames),
    )


def _clock(rng: np.random.Generator, speed: float, longest: float) -> tuple[int, float]:
    """A number of frames and a rate at which a vehicle drives between 5 and ``longest`` metres."""
    frames = int(rng.integers(10, 18))
    suitable = [r for r in RATES if 5.0 <= speed * (frames - 1) / r <= longest]
    return frames, float(rng.choice(suitable or [RATES[0] if speed < 10 else RATES[-1]]))


def _acceleration(rng: np.random.Generator, speed: float, duration: float) -> float:
    """Now and then a change of speed, but none that nearly stops the vehicle."""
    return max(float(rng.normal(0, 0.8)), -0.4 * speed / duration) if rng.random() < 0.3 else 0.0


def _picture(rng: np.random.Generator, frames: int) -> dict[str, Any]:
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


def _suits(scene: Scene) -> bool:
    """Whether each vehicle is inside both images for 8 frames and most of its time, within 10–85 m, its picture large
    enough, and its line visible and well across the epipolar lines in both views."""
    road, rig = Road(scene), make_rig(scene)
    views = views_of(rig)
    ticks = [k / scene.rate for k in range(scene.frames) if k not in scene.dropped]
    for vehicle in scene.vehicles:
        motion = Motion(road, vehicle, scene.frames / scene.rate)
        corners = np.array([motion.pose(t).corners(vehicle.width, vehicle.height) for t in ticks])
        depths = corners[..., 2]
        if depths.min() < 10 or depths.max() > 85:
            return False
        pixels = [view.project(corners) for view in views]
        inside = np.all([[is_inside(q, scene.image_size) for q in p] for p in pixels], axis=0)
        if inside.sum() < max(8, 0.7 * len(ticks)) or np.ptp(pixels[0][..., 0], axis=1).min() < 24:
            return False
        if scene.draw_path and not all(_line_is_usable(scene, road, vehicle, corners[inside], v) for v in views):
            return False
    return True


def _line_is_usable(scene: Scene, road: Road, vehicle: Vehicle, corners: Array, view: View) -> bool:
    pixels = visible_line(scene, road, vehicle.lane, corners.mean(1), view)
    if len(pixels) < 10:
        return False
    span = np.abs(pixels[-1] - pixels[0])
    return bool(np.hypot(*span) > 100 and span[1] > 0.25 * span[0] and span[1] > 30)
