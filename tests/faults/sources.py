"""The scenes that the campaign spoils: small, random, rendered once, each with its truth."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import painted_road
import tiny_chase
import tiny_road
import yaml
from numpy.typing import NDArray

from paceline.calibration.boards import parse_board
from paceline.documents.assumed_calibration import without_statements
from paceline.documents.rig_yaml import rig_yaml
from paceline.simulation import boards
from paceline.simulation.chase.clip import camera_document, render_frames, start_document, target_document
from paceline.simulation.random_scenes.drawn import random_bend, random_chase, random_scene
from paceline.simulation.stereo.clip import RenderedClip, Scene, Vehicle, World, render
from paceline.simulation.stereo.scenery import StaticBackground

from .recordings import Array, Picture, Recording

SIZE = (640, 480)  # px
FOCAL, BASELINE = 1300.0, 0.5  # px, m
FRAMES = 10
KEPT_SCENES = 2  # of each kind, in memory
SCENE_TRIES, SEED_STEP = 300, 1000
BEND_SHARE = 0.35  # of the scenes
BOARD = "charuco:7x5:0.09:0.065:DICT_4X4_50"
BOARD_VIEWS = 8
CHASE_FRAMES = 40
LIVE_RATE = 10.0  # frames/s
LIVE_BACKGROUND_FRAMES = 14  # empty ones before the vehicles


@dataclass(frozen=True)
class Truth:
    """What is true of a scene: speeds and times by picture, or values by their names."""

    times: tuple[float, ...] = ()  # s, of the pictures
    speeds: tuple[float, ...] = ()  # m/s, of the vehicle in each picture
    ranges: tuple[float, ...] = ()  # m, of the vehicle ahead in each picture
    values: tuple[tuple[str, float], ...] = ()


Source = tuple[Recording, Truth]


def source(area: str, seed: int) -> Source:
    """A fresh copy of a recording for an ``area``, and its truth."""
    recording, truth = SOURCES[area](seed)
    return (
        replace(
            recording,
            views=[list(view) for view in recording.views],
            shown=[list(view) for view in recording.shown],
            transform=[list(view) for view in recording.transform],
            files=[],
        ),
        truth,
    )


def _suitable(make: Callable[[int], Scene], seed: int) -> RenderedClip:
    for k in range(SCENE_TRIES):
        try:
            return render(make(seed + SEED_STEP * k))
        except ValueError:
            continue
    raise ValueError(f"no scene suits seed {seed}")


@lru_cache(maxsize=KEPT_SCENES)
def stereo(seed: int) -> Source:
    """An outlined vehicle on a straight or a bend."""
    rng = np.random.default_rng([seed, 21])
    fixed: dict[str, Any] = {"image_size": SIZE, "focal": FOCAL, "baseline": BASELINE, "dropped": (), "occluder": False}
    if rng.random() < BEND_SHARE:
        clip = _suitable(lambda s: random_bend(s, None, 7.5, **fixed), seed)
    else:
        speed = float(rng.uniform(6, 30))
        vehicle = {"speed": speed, "glare": False}
        more = {**fixed, "radius": None, "frames": FRAMES}
        clip = _suitable(lambda s: random_scene(s, vehicle=vehicle, **more), seed)
    return _recording_of(clip, 1 / float(np.diff(clip.times).mean()))


@lru_cache(maxsize=KEPT_SCENES)
def detected(seed: int) -> Source:
    """A vehicle that nobody has outlined."""
    rng = np.random.default_rng([seed, 23])

    def make(s: int) -> Scene:
        receding = bool(rng.random() < 0.4)
        speed, texture = float(rng.uniform(11, 17)), int(rng.integers(2**31))
        start = float(rng.uniform(22, 28) if receding else rng.uniform(55, 64))
        lane = 1.85 if receding else -1.85
        vehicle = Vehicle(
            "v0", speed, start_distance=start, lane=lane, texture_seed=texture, relief=0.03, receding=receding
        )
        return tiny_road.scene(vehicle, seed=s)

    clip = _suitable(make, seed)
    return _recording_of(clip, clip_rate(clip), outlined=False)


@lru_cache(maxsize=KEPT_SCENES)
def live(seed: int) -> Source:
    """An empty road, two vehicles, an empty road: faster than it was rendered."""
    scene = tiny_road.scene(*tiny_road.TWO)
    clip = render(scene)
    before, after = (empty_road(scene, n, seed + n) for n in (LIVE_BACKGROUND_FRAMES, 5))
    views = [[*before[0], *clip.left, *after[0]], [*before[1], *clip.right, *after[1]]]
    faster = LIVE_RATE / clip_rate(clip)
    document = {"left": "left", "right": "right", "rig": "rig.yaml", "paths": clip.clip["paths"]}
    rig = yaml.safe_load(rig_yaml(without_statements(clip.rig)))

    def draw(r: Recording) -> dict[str, Any]:
        return {"clip.yaml": {**document, "rate": r.stated_rate}, "rig.yaml": deepcopy(rig)}

    values = tuple((v.id, faster * v.speed) for v in tiny_road.TWO)
    return Recording(["left", "right"], views, LIVE_RATE, draw, kept=-1), Truth(values=values)


def clip_rate(clip: RenderedClip) -> float:
    return 1 / float(np.diff(clip.times).mean())


def empty_road(scene: Scene, frames: int, seed: int) -> list[list[Picture]]:
    """Both views of a scene's road without its vehicles."""
    world, rng = World(scene), np.random.default_rng(seed)
    stills = [StaticBackground(scene, world.road, scene.seed).draw(view) for view in world.views]
    return [
        [np.clip(still + rng.normal(0, 0.8, still.shape), 0, 255).astype(np.uint8) for _ in range(frames)]
        for still in stills
    ]


def _recording_of(clip: RenderedClip, rate: float, outlined: bool = True) -> Source:
    rate = round(rate, 6)
    rate = round(rate) if abs(rate - round(rate)) < 1e-3 else rate
    rig = yaml.safe_load(rig_yaml(without_statements(clip.rig)))
    rows = {row["frame"]: row for row in clip.truth}
    document = {key: clip.clip[key] for key in clip.clip if key not in ("synchronised", "times", "rate")}
    (vehicle,) = document.pop("vehicles")

    def draw(r: Recording) -> dict[str, Any]:
        drawn = {**deepcopy(document), "rate": r.stated_rate}
        flipped = bool(np.linalg.det(r.transform[0][0][:, :2]) < 0)
        for path in drawn["paths"].values():
            for view, side in enumerate(("left", "right")):
                path[side] = r.moved(view, 0, path[side]).tolist()
            path["lateral_offset"] *= -1 if flipped else 1
        if outlined:
            drawn["vehicles"] = [_outline(r, vehicle, rows)]
        if r.exchanged:
            for entry in [*drawn["paths"].values(), *drawn.get("vehicles", [])]:
                entry["left"], entry["right"] = entry["right"], entry["left"]
        return {"clip.yaml": drawn, "rig.yaml": deepcopy(rig)}

    times = tuple(float(t) for t in clip.times)
    speeds = tuple(float(rows[k]["speed_mps"]) if k in rows else float("nan") for k in range(len(times)))
    recording = Recording(["left", "right"], [clip.left, clip.right], rate, draw, kept=vehicle["frame"])
    return recording, Truth(times, speeds)


def _outline(r: Recording, vehicle: dict[str, Any], rows: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """The vehicle as a user outlines it in both views of what is now the frame of picture ``r.kept``."""
    frame = r.shown[0].index(r.kept) if r.kept in r.shown[0] else 0
    entry = {**vehicle, "frame": frame}
    for view, side in enumerate(("left", "right")):
        k = min(frame, len(r.shown[view]) - 1)
        place = rows.get(r.shown[view][k], rows[r.kept])
        corners = np.array(place[side]) + np.array(vehicle[side]) - np.array(rows[r.kept][side])
        entry[side] = clockwise(r.moved(view, k, corners)).round(2).tolist()
    return entry


def clockwise(corners: Array) -> Array:
    """Corners (4, 2) from the top left one on, as seen in the image."""
    order = [0, 1, 2, 3]
    if corners[:2, 0].sum() > corners[1:3, 0].sum() and corners[0, 0] > corners[1, 0]:
        order = [1, 0, 3, 2]
    if corners[0, 1] > corners[3, 1]:
        order = [order[3], order[2], order[1], order[0]]
    return np.asarray(corners[order])


@lru_cache(maxsize=KEPT_SCENES)
def chase(seed: int) -> Source:
    """A vehicle ahead, drawn or rasterized."""
    if seed % 2:
        first = int(np.random.default_rng([seed, 25]).integers(0, 60))
        pictures = [tiny_chase.picture(first + k, seed) for k in range(CHASE_FRAMES)]
        positions = [tiny_chase.truth(first + k) for k in range(CHASE_FRAMES)]
        camera, target, rate = tiny_chase.CAMERA, tiny_chase.TARGET, 15.0
        start = tiny_chase.start(first)
        centre: Array = np.array(start["center"])
    else:
        scene = random_chase(seed, frames=CHASE_FRAMES)
        rendered = list(render_frames(scene))
        pictures, positions = [p for p, _ in rendered], [t.position for _, t in rendered]
        camera, target, rate = camera_document(scene), target_document(scene), scene.rate
        start = start_document(scene, rendered[0][1])
        centre = np.array(start["center"])

    def draw(r: Recording) -> dict[str, Any]:
        K = np.array(camera["K"])
        at = positions[r.shown[0][0]]
        matrix = r.transform[0][0]
        drawn = centre + (K @ (at / at[2]) - K @ (positions[0] / positions[0][2]))[:2]
        scale = start["scale"] * positions[0][2] / at[2] * np.sqrt(abs(np.linalg.det(matrix[:, :2])))
        placed = {"frame": 0, "center": r.moved(0, 0, [drawn])[0].tolist(), "scale": float(scale)}
        follow = {"video": "frames", "rate": r.stated_rate, "camera": "camera.yaml", "target": "target.yaml"}
        return {"follow.yaml": {**follow, "start": placed}, "camera.yaml": camera, "target.yaml": target}

    recording = Recording(["frames"], [pictures], rate, draw, kept=0)
    return recording, Truth(ranges=tuple(float(p[2]) for p in positions))


@lru_cache(maxsize=KEPT_SCENES)
def board(seed: int) -> Source:
    """A calibration board before both cameras."""
    rng = np.random.default_rng([seed, 27])
    setup = boards.random_setup(rng, parse_board(BOARD), BOARD_VIEWS, SIZE)
    pairs = [boards.render(setup, k, rng) for k in range(BOARD_VIEWS)]
    values = (("baseline, m", float(np.linalg.norm(setup.rig.t))),)
    views = [[pair[view] for pair in pairs] for view in (0, 1)]
    return Recording(["left", "right"], views, 1.0, lambda r: {}, kept=-1), Truth(values=values)


@lru_cache(maxsize=KEPT_SCENES)
def lanes(seed: int) -> Source:
    """A painted road over which a dark lorry drives."""
    rig = painted_road.make_rig()
    scenes = [painted_road.painted(rig, side, np.random.default_rng([seed, side])) for side in (0, 1)]
    views: list[list[Picture]] = [[], []]
    for side in (0, 1):
        for k in range(8):
            rng = np.random.default_rng([seed, k, side])
            image: NDArray[Any] = scenes[side] + rng.normal(0, 2.0, painted_road.SIZE[::-1])
            image[250:420, 60 + 85 * k : 150 + 85 * k] = 30
            views[side].append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    rig_document: dict[str, Any] = {"rotation": rig.R.tolist(), "translation": rig.t.tolist(), "uncertainty": "exact"}
    for name in ("left", "right"):
        rig_document[name] = {"image_size": list(painted_road.SIZE), "K": rig.left.K.tolist()}
    clip = {"left": "left", "right": "right", "rig": "rig.yaml"}

    def draw(r: Recording) -> dict[str, Any]:
        return {"clip.yaml": {**clip, "rate": r.stated_rate}, "rig.yaml": deepcopy(rig_document)}

    values = tuple(("lane width", width) for width in painted_road.WIDTHS)
    return Recording(["left", "right"], views, 5.0, draw, kept=-1), Truth(values=values)


SOURCES: dict[str, Callable[[int], Source]] = {
    "speed": stereo,
    "follow": chase,
    "calibrate": board,
    "lanes": lanes,
    "vehicles": detected,
    "live": live,
}
