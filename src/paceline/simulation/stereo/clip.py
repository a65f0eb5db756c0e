"""Stereo clips of vehicles made from textured planes, with exact truth.

A vehicle is a rectangle that moves along a road, with a few more rectangles around it, in front of a static scene.
``render(random_scene(seed))`` returns the images, the rig, the clip as a person would have drawn it, and the truth;
``write`` writes their files.
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.cameras import PosedCamera, StereoRig
from paceline.documents.assumed_calibration import without_statements
from paceline.documents.rig_yaml import rig_yaml
from paceline.simulation import textures
from paceline.simulation.operator import add_drawing_noise, draw_line, is_inside_image
from paceline.simulation.stereo.scene import (
    PLANE_CLEARANCE_M,
    Motion,
    PlacedRoad,
    Pose,
    Scene,
    Vehicle,
    make_rig,
    rig_views,
    visible_line,
)
from paceline.simulation.stereo.scenery import StaticBackground, make_occluder
from paceline.simulation.stereo.textured_planes import TexturedPlane, composite, draw_planes
from paceline.simulation.textures import FacePart, Texture

__all__ = [
    "RenderedClip",
    "Scene",
    "Vehicle",
    "World",
    "render",
    "write",
    "write_documents",
]


SCENE_SUBPIXELS_PER_SIDE = 4


@dataclass(frozen=True, eq=False)
class RenderedClip:
    """A rendered clip: pictures (H, W) uint8 of the left and the right camera, their times in seconds, the exact rig,
    the contents of clip.yaml and of truth.json."""

    left: list[NDArray[np.uint8]]
    right: list[NDArray[np.uint8]]
    times: Array  # (F,) s, of the left pictures
    right_times: Array  # (F,) s
    rig: StereoRig
    clip: dict[str, Any]
    truth: list[dict[str, Any]]


class World:
    """A scene with everything about it that is known before any picture is drawn.

    ``poses[view][vehicle][frame]`` are the vehicles' planes; ``rig``, ``clip`` and ``truth`` as in `RenderedClip`.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.road, self.rig = scene, PlacedRoad(scene), make_rig(scene)
        self.views = rig_views(self.rig)
        times = np.array([k for k in range(scene.frames) if k not in scene.dropped]) / scene.rate
        self.clocks = times, times + scene.skew_s
        duration = (scene.frames - 1) / scene.rate + abs(scene.skew_s)
        self.motions = [Motion(self.road, v, duration) for v in scene.vehicles]
        self.poses = [[[m.pose(float(t)) for t in clock] for m in self.motions] for clock in self.clocks]
        self.truth = [row for j in range(len(scene.vehicles)) for row in self._truth_of(j)]
        self.clip = self._draw_clip(np.random.default_rng([scene.seed, 13]))

    def _truth_of(self, j: int) -> list[dict[str, Any]]:
        vehicle, rows = self.scene.vehicles[j], []
        for k, t in enumerate(self.clocks[0].tolist()):
            corners = [self.poses[i][j][k].corners(vehicle.width, vehicle.height) for i in (0, 1)]
            if min(view.depth(c).min() for view, c in zip(self.views, corners, strict=True)) < 1.0:
                continue  # beside or behind the cameras
            left, right = (view.project(c) for view, c in zip(self.views, corners, strict=True))
            rows.append(
                {
                    "frame": k,
                    "time_s": t,
                    "vehicle": vehicle.id,
                    "speed_mps": self.motions[j].speed(t),
                    "position": self.poses[0][j][k].centre.tolist(),
                    "left": left.tolist(),
                    "right": right.tolist(),
                    "inside": is_inside_image(left, self.scene.image_size)
                    and is_inside_image(right, self.scene.image_size),
                }
            )
        return rows

    def _seen(self, vehicle: Vehicle) -> list[dict[str, Any]]:
        """The rows of truth in which ``vehicle`` is wholly inside both images."""
        rows = [r for r in self.truth if r["vehicle"] == vehicle.id and r["inside"]]
        if not rows:
            raise ValueError(f"vehicle {vehicle.id} is never wholly inside both images")
        return rows

    def _draw_clip(self, rng: np.random.Generator) -> dict[str, Any]:
        """The contents of clip.yaml, with drawn quadrilaterals and lines."""
        scene = self.scene
        needs_times = bool(scene.dropped or scene.skew_s)
        clip: dict[str, Any] = {"left": "left", "right": "right"}
        clip |= {"times": "times.csv"} if needs_times else {"rate": scene.rate}
        if not scene.skew_s:
            clip["synchronised"] = True
        clip["rig"] = "rig.yaml"
        lanes: dict[tuple[float, bool], str] = {}
        if scene.draw_path:
            for vehicle in scene.vehicles:
                lanes.setdefault((vehicle.lane, vehicle.receding), f"lane{len(lanes)}")
            clip["paths"] = {name: self._draw_path(*lane, rng) for lane, name in lanes.items()}
        clip["vehicles"] = []
        for vehicle in scene.vehicles:
            first = self._seen(vehicle)[0]
            entry: dict[str, Any] = {"id": vehicle.id}
            if scene.draw_path:
                entry["path"] = lanes[vehicle.lane, vehicle.receding]
            entry["frame"] = first["frame"]
            for side in ("left", "right"):
                entry[side] = add_drawing_noise(np.array(first[side]), scene.click_sigma, rng)
            if scene.draw_path and vehicle.plane == "side":
                entry["plane"] = "side"
            if vehicle.initial_speed is not None:
                entry["speed"] = vehicle.initial_speed
            clip["vehicles"].append(entry)
        return clip

    def _draw_path(self, lane: float, receding: bool, rng: np.random.Generator) -> dict[str, Any]:
        """The line beside a lane, drawn in each view over the stretch that its vehicles drive along."""
        users = [v for v in self.scene.vehicles if (v.lane, v.receding) == (lane, receding)]
        positions = np.array([row["position"] for v in users for row in self._seen(v)])
        path: dict[str, Any] = {"shape": "line" if self.scene.radius is None else "curve"}
        for side, view in zip(("left", "right"), self.views, strict=True):
            visible = visible_line(self.scene, self.road, lane, positions, view)[::-1]  # from far to near
            if len(visible) < 10:
                raise ValueError(f"the line beside vehicle {users[0].id} is not visible in the {side} view")
            path[side] = draw_line(visible, view.camera, self.scene.line_points, self.scene.line_sigma, rng)
        path["lateral_offset"] = -self.scene.line_offset if receding else self.scene.line_offset
        return path


def render(scene: Scene) -> RenderedClip:
    """Render ``scene``; the same scene gives the same pictures.

    Raises ValueError where a vehicle is never wholly inside both images or stops moving forward, or where its line
    cannot be seen.
    """
    world = World(scene)
    left, right = _Renderer(world).render()
    return RenderedClip(left, right, *world.clocks, world.rig, world.clip, world.truth)


class _Renderer:
    """The pictures of a world: what the light and the sensor add to its geometry, drawn from the scene's seed."""

    def __init__(self, world: World) -> None:
        self.world, self.scene = world, world.scene
        rng = np.random.default_rng([self.scene.seed, 17])
        self.backdrop = StaticBackground(self.scene, world.road, self.scene.seed)
        pole = make_occluder(world.road, world.poses[0][0], rng) if self.scene.occluder else None
        self.pole = pole and replace(pole, texture=pole.texture.to_light(self.scene.gamma))
        self.phases = rng.uniform(0, 2 * np.pi, 2)
        self.glares = [_SpecularSpot(rng, len(world.clocks[0])) for _ in self.scene.vehicles]
        self.parts = [_make_vehicle_parts(v, self.scene.gamma) for v in self.scene.vehicles]
        self.shadow = _SHADOW_TEXTURE.to_light(self.scene.gamma)

    def render(self) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]:
        left, right = (self._render_view(i) for i in (0, 1))
        return left, right

    def _render_view(self, i: int) -> list[NDArray[np.uint8]]:
        scene, view, poses = self.scene, self.world.views[i], self.world.poses[i]
        static = textures.grey_to_light(self.backdrop.draw(view), scene.gamma)
        mask = draw_planes([self.pole], view, scene.blur_sigma, SCENE_SUBPIXELS_PER_SIDE) if self.pole else None
        sensor = np.random.default_rng([scene.seed, 19, i])
        images = []
        for k, t in enumerate(self.world.clocks[i]):
            image = static.copy()
            for j in np.argsort([-track[k].centre[2] for track in poses]):
                vehicle, pose = scene.vehicles[j], poses[j][k]
                composite(image, draw_planes([_shadow_plane(self.shadow, vehicle, pose)], view, scene.blur_sigma, 1))
                composite(
                    image,
                    draw_planes(
                        _place_vehicle_parts(self.parts[j], pose), view, scene.blur_sigma, SCENE_SUBPIXELS_PER_SIDE
                    ),
                )
                if vehicle.glare:
                    self.glares[j].add(image, vehicle, pose, view, k)
            composite(image, mask)
            sun = np.sin(1.3 * t + self.phases[0]) + 0.3 * np.sin(2.9 * t + self.phases[1] + i)
            light = image * np.float32(1 + scene.gain_drift * sun)
            images.append(_add_sensor_noise(textures.light_to_grey(light, scene.gamma), scene, sensor))
        return images


def _add_sensor_noise(image: Image, scene: Scene, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture that a sensor makes of the grey levels ``image`` (H, W)."""
    if scene.noise_sigma > 0 or scene.shot_noise > 0:
        noise = rng.standard_normal(image.shape, np.float32)
        image = image + noise * np.sqrt(scene.noise_sigma**2 + scene.shot_noise * np.maximum(image, 0))
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


class _SpecularSpot:
    """A bright spot that wanders over a vehicle's plane for about half of its frames, differently in each view."""

    def __init__(self, rng: np.random.Generator, frames: int) -> None:
        self.start = rng.integers(0, max(1, frames // 2))
        self.length = max(3, frames // 2)
        self.path = rng.uniform(-0.4, 0.4, (2, 2))
        self.parallax = rng.uniform(0.02, 0.08)
        self.peak = rng.uniform(60, 140)

    def add(self, image: Image, vehicle: Vehicle, pose: Pose, view: PosedCamera, frame: int) -> None:
        phase = (frame - self.start) / self.length
        if not 0 <= phase <= 1:
            return
        spot = self.path[0] + phase * (self.path[1] - self.path[0])
        spot = spot * np.array([vehicle.width, vehicle.height])
        spot[0] += self.parallax * view.t[0]
        centre = pose.centre + pose.axes[:, :2] @ spot
        x, y = view.project(centre)
        sigma = 0.12 * vehicle.height * view.camera.K[0, 0] / float(view.depth(centre))
        v, u = np.ogrid[: image.shape[0], : image.shape[1]]
        wide, height = np.exp(-((u - x) ** 2) / (8 * sigma**2)), np.exp(-((v - y) ** 2) / (2 * sigma**2))
        image += (self.peak * wide * height).astype(np.float32)


def _make_vehicle_parts(vehicle: Vehicle, gamma: float) -> list[FacePart]:
    make = textures.front_parts if vehicle.plane == "front" else textures.side_parts
    parts = make(np.random.default_rng([vehicle.texture_seed, 7]), vehicle.width, vehicle.height, vehicle.relief)
    return [replace(part, texture=part.texture.to_light(gamma)) for part in parts]


def _place_vehicle_parts(parts: list[FacePart], pose: Pose) -> list[TexturedPlane]:
    def card(p: FacePart) -> TexturedPlane:
        corner = pose.centre + pose.axes @ np.array([p.x - p.width / 2, p.y - p.height / 2, p.depth])
        return TexturedPlane(p.texture, corner, pose.axes[:, 0] * p.width, pose.axes[:, 1] * p.height)

    return [card(p) for p in parts]


def _shadow_plane(texture: Texture, vehicle: Vehicle, pose: Pose) -> TexturedPlane:
    """The dark patch on the road under a vehicle."""
    length = 4.2 if vehicle.plane == "front" else 1.8
    corner = pose.centre + pose.axes @ np.array(
        [-0.53 * vehicle.width, vehicle.height / 2 + PLANE_CLEARANCE_M - 0.01, length]
    )
    return TexturedPlane(texture, corner, 1.06 * vehicle.width * pose.axes[:, 0], -(length + 0.1) * pose.axes[:, 2])


def _soft_shadow_texture() -> Texture:
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    alpha = 0.75 * np.clip((1 - np.abs(x)) / 0.12, 0, 1) * np.clip((1 - np.abs(y)) / 0.12, 0, 1)
    return Texture(np.full((64, 64), 10, np.float32), alpha.astype(np.float32))


_SHADOW_TEXTURE = _soft_shadow_texture()


def write(rendered: RenderedClip, directory: Path | str, states_cameras: bool = True) -> Path:
    """Write left/, right/, rig.yaml, clip.yaml, truth.json and, where the frames are not evenly timed, times.csv into
    ``directory``; returns the path of clip.yaml. Without ``states_cameras`` no file tells how ideal the cameras are."""
    directory = Path(directory)
    for side, images in (("left", rendered.left), ("right", rendered.right)):
        (directory / side).mkdir(parents=True, exist_ok=True)
        for k, image in enumerate(images):
            cv2.imwrite(str(directory / side / f"{k:04d}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_documents(rendered, directory, states_cameras)
    return directory / "clip.yaml"


def write_documents(rendered: RenderedClip, directory: Path, states_cameras: bool = True) -> None:
    """Everything of `write` but the pictures."""
    rig, clip = rendered.rig, rendered.clip
    if not states_cameras:
        rig, clip = without_statements(rig), {key: clip[key] for key in clip if key != "synchronised"}
    (directory / "rig.yaml").write_text(rig_yaml(rig))
    (directory / "clip.yaml").write_text(yaml.safe_dump(clip, sort_keys=False))
    (directory / "truth.json").write_text(json.dumps(rendered.truth))
    if "times" in rendered.clip:
        with (directory / rendered.clip["times"]).open("w", newline="") as f:
            writer = csv.writer(f)
            writer.writerow(["frame", "left_s", "right_s"])
            rows = zip(rendered.times.tolist(), rendered.right_times.tolist(), strict=True)
            writer.writerows([k, round(a, 6), round(b, 6)] for k, (a, b) in enumerate(rows))
