"""Random scenes that are ray-traced: before a stereo rig, and chases."""

from __future__ import annotations

from typing import Any

import numpy as np

from paceline.cameras import PosedCamera
from paceline.errors import UnusableInput
from paceline.simulation.operator import (
    MIN_OUTLINE_WIDTH_PX,
    is_inside_image,
)
from paceline.simulation.random_scenes.visibility import (
    MIN_VISIBLE_FRAMES,
)
from paceline.simulation.raytraced.scene import PlacedStereoScene
from paceline.simulation.raytraced.scene_yaml import FollowScene, SpeedScene
from paceline.simulation.vehicle_catalogue import MIN_RAYTRACED_GAP_M, RAYTRACED_KINDS, TRAFFIC_SHARES
from paceline.units import MPS_PER_KMH

MIN_RAYTRACED_SPEED_MPS, MAX_RAYTRACED_SPEED_MPS = 15 * MPS_PER_KMH, 130 * MPS_PER_KMH
MIN_RAYTRACED_DISTANCE_M, MAX_RAYTRACED_DISTANCE_M = 10.0, 90.0  # m from the cameras
RAYS_PER_PIXEL = 64  # rays per pixel of a vehicle; of 16 the noise on glossy paint is several times the sensor's
RAYTRACED_FRAME_RATES_HZ = (5.0, 7.5, 10.0, 15.0, 25.0)


def random_speed_scene(seed: int) -> SpeedScene:
    """A varied scene of one vehicle at 15–130 km/h, oncoming or receding, inside both images in at least
    `MIN_VISIBLE_FRAMES` frames.

    Seven of ten drive at a constant speed; the others accelerate, brake or change lane. One rig in four is
    miscalibrated.
    """
    rng = np.random.default_rng([seed, 5])
    speed = float(
        rng.uniform(MIN_RAYTRACED_SPEED_MPS, MAX_RAYTRACED_SPEED_MPS)
    )  # drawn once: no speed is likelier for suiting better
    for _ in range(400):
        scene = SpeedScene.model_validate(_draw_speed_scene(seed, speed, rng))
        if _is_suitable_raytraced(scene):
            return scene
    raise UnusableInput(f"seed {seed}: no scene suits; expected another seed")


def random_follow_scene(seed: int, frames: int = 300) -> FollowScene:
    """A varied chase of ``frames`` frames at 15 Hz."""
    rng = np.random.default_rng([seed, 7])
    kind = str(rng.choice(RAYTRACED_KINDS[:5]))
    lead = {
        "kind": kind,
        "seed": int(rng.integers(2**31)),
        "gap": [MIN_RAYTRACED_GAP_M[kind], float(rng.uniform(12, 18))],
        "weave": float(rng.uniform(0, 0.9)),
    }
    road = {"kind": "winding", "radius": float(rng.choice([-1, 1]) * rng.uniform(60, 200)), "length": 400.0}
    chase = {
        "height": float(rng.uniform(1.6, 2.3)),
        "tilt": float(rng.uniform(0.035, 0.08)),
        "shake_px": float(rng.uniform(1, 4)),
    }
    light, beside, sensor = _draw_light(rng), _draw_scenery(rng), _draw_sensor(rng)
    exposure = float(rng.uniform(0.001, 0.008))  # a short one moves nothing by more than a part of a pixel
    scene = {
        "kind": "follow",
        "seed": seed,
        "frames": frames,
        "rate": 15,
        "road": road,
        "light": light,
        "scenery": beside,
        "sensor": sensor | {"shutter_s": exposure, "steps": 1 if exposure < 0.004 else 2},
        "lead": lead,
        "chase": chase,
    }
    return FollowScene.model_validate(scene)


def _draw_speed_scene(seed: int, speed: float, rng: np.random.Generator) -> dict[str, Any]:
    frames = int(rng.integers(10, 16))
    rates = [r for r in RAYTRACED_FRAME_RATES_HZ if 5.0 <= speed * (frames - 1) / r <= 60.0]
    rate = float(rng.choice(rates or [RAYTRACED_FRAME_RATES_HZ[-1]]))
    distance = speed * (frames - 1) / rate
    near, oncoming = float(rng.uniform(17, max(18.0, 75 - distance))), bool(rng.random() < 0.65)
    kind = str(rng.choice(["straight", "straight", "circle", "clothoid"]))
    lanes = int(rng.choice([2, 2, 3]))
    road: dict[str, Any] = {"kind": kind, "lanes": lanes, "length": 260.0, "wear": float(rng.uniform(0, 0.6))}
    road |= {"grade": float(rng.normal(0, 0.015)), "bank": float(rng.normal(0, 0.015))}
    if kind != "straight":
        road["radius"] = float(rng.choice([-1, 1]) * rng.uniform(80, 400))
    along = 20.0
    side = float(rng.choice([-1, 1]))
    lane = 0 if oncoming else lanes - 1
    focal, height = float(rng.uniform(1400, 3000)), float(rng.uniform(1.6, 5.0))
    eye = {"along": along, "right": side * (1.8 * lanes + rng.uniform(2.5, 5.0)), "height": height}
    middle = along + near + distance / 2
    target = {"along": middle, "right": (lane + 0.5 - lanes / 2) * 3.6 * 0.6, "height": 0.8}
    car: dict[str, Any] = {
        "id": "v0",
        "kind": str(rng.choice(RAYTRACED_KINDS, p=TRAFFIC_SHARES)),
        "seed": int(rng.integers(2**31)),
        "lane": lane,
        "offset": float(rng.normal(0, 0.15)),
        "start": along + near + (distance if oncoming else 0.0) + (4.0 if oncoming else 0.0),
        "speed": speed,
        "oncoming": oncoming,
    }
    behaviour = rng.random()
    if behaviour < 0.2:
        car["acceleration"] = max(float(rng.normal(0, 1.2)), -0.4 * speed * rate / frames)
    elif behaviour < 0.3 and speed > 6:
        shift = 3.6 if lane == 0 else -3.6
        duration = float(rng.uniform(3, 5))
        car["lane_change"] = {"start": float(rng.uniform(-duration / 2, 0.5)), "duration": duration, "shift": shift}
    rig: dict[str, Any] = {
        "image_size": [[1024, 768], [1280, 960], [1280, 720]][rng.integers(3)],
        "focal": focal,
        "baseline": float(rng.uniform(0.4, 0.7)),
        "eye": eye,
        "target": target,
    }
    if rng.random() < 0.25:
        rig["rig_error_std"] = {
            "focal_length_px": float(rng.uniform(0.3, 2.0)),
            "rotation_rad": [float(rng.uniform(1e-5, 6e-5)) for _ in range(3)],
            "translation_m": [float(rng.uniform(1e-4, 4e-4)) for _ in range(3)],
        }
    return {
        "kind": "speed",
        "seed": seed,
        "frames": frames,
        "rate": rate,
        "samples": RAYS_PER_PIXEL,
        "road": road,
        "light": _draw_light(rng),
        "scenery": _draw_scenery(rng),
        "sensor": _draw_sensor(rng),
        "vehicles": [car],
        "rig": rig,
    }


def _draw_light(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "azimuth": float(rng.uniform(-np.pi, np.pi)),
        "elevation": float(rng.uniform(0.35, 1.1)),
        "clouds": float(rng.choice([rng.uniform(0, 0.3), rng.uniform(0.3, 0.8), 1.0], p=[0.55, 0.25, 0.2])),
    }


def _draw_scenery(rng: np.random.Generator) -> dict[str, Any]:
    densities = {
        name: float(rng.uniform(0, high)) for name, high in (("trees", 0.7), ("poles", 0.7), ("buildings", 0.5))
    }
    return densities | {"parapet": bool(rng.random() < 0.2)}


def _draw_sensor(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "exposure": float(rng.uniform(0.8, 1.5)),
        "full_well": float(rng.uniform(3000, 20000)),
        "read_noise": float(rng.uniform(4, 25)),
        "vignetting": float(rng.uniform(0, 0.3)),
        "blur_sigma": float(rng.uniform(0.45, 0.8)),
        "gamma": float(rng.choice([1.0, 2.2])),
        "image_format": str(rng.choice(["png", "jpeg"], p=[0.8, 0.2])),
        "quality": 92,
    }


def _is_suitable_raytraced(scene: SpeedScene) -> bool:
    """Whether the vehicle is inside both images and large enough to be outlined in `MIN_VISIBLE_FRAMES` frames."""
    try:
        placed = PlacedStereoScene(scene)
    except (UnusableInput, ValueError):
        return False
    car, size = placed.vehicles[0], placed.rig.left.image_size
    count = 0
    for t in placed.clocks[0].tolist():
        if not car.is_there(t):
            continue
        corners = car.corners(t)
        if min(view.to_camera(corners)[:, 2].min() for view in placed.views) < MIN_RAYTRACED_DISTANCE_M:
            continue
        pixels = [view.project(corners) for view in placed.views]
        wide = min(np.ptp(p[:, 0]) for p in pixels) > 1.1 * MIN_OUTLINE_WIDTH_PX
        distance = np.linalg.norm(car.center(t) - placed.views[0].centre)
        count += int(wide and distance < MAX_RAYTRACED_DISTANCE_M and all(is_inside_image(p, size) for p in pixels))
    return count >= max(MIN_VISIBLE_FRAMES, 0.7 * len(placed.clocks[0])) and all(
        _is_raytraced_line_usable(placed, v) for v in placed.views
    )


def _is_raytraced_line_usable(placed: PlacedStereoScene, view: PosedCamera) -> bool:
    """Whether a painted line beside the lane runs well across the epipolar lines, which are nearly level."""
    car, size = placed.vehicles[0], np.array(placed.rig.left.image_size)
    arcs = [car.motion.position(t)[0] for t in placed.clocks[0].tolist() if car.is_there(t)]
    beside = sorted(placed.road.markings, key=lambda m: abs(m - placed.road.lanes[car.model.lane]))[:2]
    for marking in beside:
        points = placed.road.line(marking, min(arcs) - 25, max(arcs))
        pixels = view.project(points[view.to_camera(points)[:, 2] > 2])
        pixels = pixels[((pixels > 8) & (pixels < size - 9)).all(1)]
        if len(pixels) < 10:
            return False
        across, down = np.abs(pixels[-1] - pixels[0])
        if np.hypot(across, down) < 100 or down < max(40, 0.35 * across):
            return False
    return True
