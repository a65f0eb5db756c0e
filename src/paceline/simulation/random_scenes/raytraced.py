"""Random scenes that are ray-traced: before a stereo rig, and chases."""

from __future__ import annotations

from typing import Any

import numpy as np

from paceline.cameras import PosedCamera
from paceline.errors import UnusableInput
from paceline.simulation.operator import (
    MIN_OUTLINE_WIDTH_PX,
    is_inside_image,
    longest_visible_run,
    visible_marking,
)
from paceline.simulation.random_scenes.visibility import (
    MAX_BEND_DEPTH_M,
    MAX_BEND_OBLIQUITY_RAD,
    MIN_BEND_DEPTH_M,
    MIN_VISIBLE_FRAMES,
)
from paceline.simulation.raytraced.motion import MIN_TIME_S
from paceline.simulation.raytraced.scene import PlacedStereoScene
from paceline.simulation.raytraced.scene_yaml import FollowScene, RoadModel, SpeedScene
from paceline.simulation.vehicle_catalogue import MIN_RAYTRACED_GAP_M, RAYTRACED_KINDS, TRAFFIC_SHARES
from paceline.units import MPS_PER_KMH, MPS_PER_MPH

MIN_RAYTRACED_SPEED_MPS, MAX_RAYTRACED_SPEED_MPS = 15 * MPS_PER_KMH, 130 * MPS_PER_KMH
MIN_RAYTRACED_DISTANCE_M, MAX_RAYTRACED_DISTANCE_M = 10.0, 90.0  # m from the cameras
RAYS_PER_PIXEL = 64  # rays per pixel of a vehicle; of 16 the noise on glossy paint is several times the sensor's
RAYTRACED_FRAME_RATES_HZ = (5.0, 7.5, 10.0, 15.0, 25.0)

# of bends that cross the view, and of straights filmed alike
MAX_WATCHED_FRAMES = 12  # frames of a clip
WATCHED_RAYS_PER_PIXEL = 32  # rays per pixel of a vehicle; all but glints are less noisy than the sensor
MIN_LINE_LENGTH_PX = 100.0  # of the painted line beside the lane, in both images
MAX_ROAD_LENGTH_M = 260.0  # m
MAX_CIRCLE_SHARE = 0.97  # of a circle's circumference that is road: more would overlap itself


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


def random_raytraced_bend(seed: int, radius: float | None = None, rate: float = 5.0) -> SpeedScene:
    """A scene of one vehicle at 21–36 mph on a bend that comes towards the cameras and crosses their view, by cameras
    whose calibration is exact.

    ``radius`` (m, of the road's axis, drawn from 30–80 where None) bends to either side. The clip holds at most
    `MAX_WATCHED_FRAMES` of those in which the vehicle is inside both images, `MIN_BEND_DEPTH_M` to `MAX_BEND_DEPTH_M`
    away, and its front or rear is seen at less than `MAX_BEND_OBLIQUITY_RAD`. Nothing but houses stands beside the
    road, so that nothing hides it. Raises UnusableInput where nothing suits.
    """
    rng = np.random.default_rng([seed, 59])
    vehicle, radius = _draw_watched_vehicle(rng), radius or float(rng.uniform(30, 80))
    length = min(MAX_ROAD_LENGTH_M, MAX_CIRCLE_SHARE * 2 * np.pi * radius)
    for _ in range(400):
        road = {"kind": "circle", "radius": float(rng.choice([-1, 1])) * radius, "length": length}
        speed = float(rng.uniform(21, 36)) * MPS_PER_MPH
        if scene := _draw_watched_scene(seed, rng, road, vehicle | {"speed": speed}, rate):
            return scene
    raise UnusableInput(f"seed {seed}: no bend suits; expected another seed")


def random_raytraced_straight(seed: int, rate: float = 5.0) -> SpeedScene:
    """A scene like those of `random_raytraced_bend` on a straight road, of one vehicle at 29–65 mph."""
    rng = np.random.default_rng([seed, 61])
    vehicle, road = _draw_watched_vehicle(rng), {"kind": "straight", "length": MAX_ROAD_LENGTH_M}
    for _ in range(400):
        speed = float(rng.uniform(29, 65)) * MPS_PER_MPH
        if scene := _draw_watched_scene(seed, rng, road, vehicle | {"speed": speed}, rate):
            return scene
    raise UnusableInput(f"seed {seed}: no straight suits; expected another seed")


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


def _draw_watched_vehicle(rng: np.random.Generator) -> dict[str, Any]:
    """What of a vehicle is drawn once, as none is to be likelier for suiting better."""
    return {
        "id": "v0",
        "kind": str(rng.choice(RAYTRACED_KINDS)),
        "seed": int(rng.integers(2**31)),
        "oncoming": bool(rng.random() < 0.65),
    }


def _draw_watched_scene(
    seed: int, rng: np.random.Generator, road: dict[str, Any], vehicle: dict[str, Any], rate: float
) -> SpeedScene | None:
    """A ``vehicle`` that drives towards the cameras or away from them in the middle of a ``road``, which they look
    along there; None where it is not seen for long enough."""
    lane, depth, width = (0 if vehicle["oncoming"] else 1), float(rng.uniform(38, 50)), RoadModel().lane_width
    lateral, edge = (lane - 0.5) * width, width + RoadModel().shoulder
    if road["kind"] == "circle":
        offset, angle = lateral + float(rng.uniform(-4, 4)), float(rng.normal(0, 0.1))
        eye = -depth * np.cos(angle), offset - depth * np.sin(angle)
    else:
        offset = lateral + float(rng.uniform(-2, 2))
        eye = -depth, float(rng.choice([-1, 1]) * (edge + rng.uniform(1, 4)))
    eye_along, eye_right = _beside_road(road, *eye)
    if abs(eye_right) < edge + 1:
        return None
    target_along, target_right = _beside_road(road, 0.0, offset)
    road = road | {"wear": float(rng.uniform(0, 0.6))}
    # A linear scale or a small full well would leave little but noise of dark fronts in the shade.
    well_exposed = {
        "gamma": 2.2,
        "full_well": float(rng.uniform(8000, 20000)),
        "read_noise": float(rng.uniform(4, 12)),
    }
    light = _draw_light(rng) | {"clouds": float(rng.uniform(0, 0.3) if rng.random() < 0.8 else rng.uniform(0.3, 1))}
    scene = {
        "kind": "speed",
        "seed": seed,
        "frames": 1,
        "rate": rate,
        "samples": WATCHED_RAYS_PER_PIXEL,
        "road": road,
        "light": light,
        "scenery": _draw_scenery(rng) | {"trees": 0.0, "poles": 0.0, "parapet": False},
        "sensor": _draw_sensor(rng) | well_exposed,
        "vehicles": [vehicle | {"lane": lane, "offset": float(rng.normal(0, 0.15)), "start": road["length"] / 2}],
        "rig": {
            "image_size": [1024, 768],
            "focal": 2200.0,
            "baseline": 0.5,
            "eye": {"along": eye_along, "right": eye_right, "height": float(rng.uniform(1.5, 3.0))},
            "target": {
                "along": target_along,
                "right": target_right,
                "height": 0.8 + depth * float(rng.normal(0, 0.012)),
            },
        },
    }
    return _watched_part(PlacedStereoScene(SpeedScene.model_validate(scene)), rng)


def _beside_road(road: dict[str, Any], ahead: float, right: float) -> tuple[float, float]:
    """Arc length and lateral position (m) of a place ``ahead`` of the middle of a ``road`` and to the ``right`` of its
    axis there, m."""
    middle = road["length"] / 2
    if road["kind"] == "straight":
        return middle + ahead, right
    radius = road["radius"]
    side = np.sign(radius)
    turned = np.arctan2(ahead, side * (radius - right))
    return float(middle + abs(radius) * turned), float(radius - side * np.hypot(ahead, radius - right))


def _watched_part(placed: PlacedStereoScene, rng: np.random.Generator) -> SpeedScene | None:
    """The scene, from when its vehicle is well seen, of at most `MAX_WATCHED_FRAMES`; None if it is well seen in less
    than `MIN_VISIBLE_FRAMES`."""
    car, scene = placed.vehicles[0], placed.scene
    duration = 0.5 * MAX_ROAD_LENGTH_M / car.model.speed
    ticks = np.arange(max(0.98 * MIN_TIME_S, -duration), duration, 1 / scene.rate)
    is_visible = np.array([car.is_there(t) and _is_well_seen(placed, t) for t in ticks.tolist()])
    times: list[float] = longest_visible_run(ticks[:, None], is_visible)[:, 0].tolist()
    starts = [k for k in range(len(times) - MIN_VISIBLE_FRAMES + 1) if _is_wide(placed, times[k])]
    if not starts:
        return None
    first = int(rng.choice([k for k in starts if k <= len(times) - MAX_WATCHED_FRAMES] or starts[:1]))
    driven = np.array([car.motion.position(t)[0] for t in times[first : first + MAX_WATCHED_FRAMES]])
    lines = visible_marking(placed, car.model.lane, driven, lambda view, points: np.zeros(len(points), bool))[1]
    if any(len(line) < 2 or np.linalg.norm(np.diff(line, axis=0), axis=1).sum() < MIN_LINE_LENGTH_PX for line in lines):
        return None
    vehicle = car.model.model_copy(update={"start": float(driven[0])})
    return scene.model_copy(update={"vehicles": [vehicle], "frames": len(driven)})


def _is_well_seen(placed: PlacedStereoScene, t: float) -> bool:
    """Whether the outlined plane of the vehicle is inside both images at ``t`` s, near and turned to them enough."""
    car, view = placed.vehicles[0], placed.views[0]
    corners, size = car.corners(t), placed.rig.left.image_size
    depth = view.to_camera(corners)[:, 2]
    if depth.min() < MIN_BEND_DEPTH_M or depth.max() > MAX_BEND_DEPTH_M:
        return False
    sight = car.center(t) - view.centre
    outwards = car.motion.pose(t)[0][:, 0] * (1 if car.plane.end == "front" else -1)
    if -outwards @ sight < np.cos(MAX_BEND_OBLIQUITY_RAD) * np.linalg.norm(sight):
        return False
    return all(is_inside_image(v.project(corners), size) for v in placed.views)


def _is_wide(placed: PlacedStereoScene, t: float) -> bool:
    """Whether the vehicle can be outlined at ``t`` s."""
    corners = placed.vehicles[0].corners(t)
    return bool(min(np.ptp(view.project(corners)[:, 0]) for view in placed.views) > 1.1 * MIN_OUTLINE_WIDTH_PX)


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
