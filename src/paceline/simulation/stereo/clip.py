"""Stereo clips of vehicles made from textured planes, with exact truth.

A vehicle is a rectangle that moves along a road, with a few more rectangles around it, in front of a static scene.
``render(random_scene(seed))`` returns the images, the rig, the clip as a person would have drawn it, and the truth;
``write`` writes their files.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
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
from paceline.simulation.camera_errors import MovingViews, RecordedLight, StereoErrors, row_bands
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
from paceline.simulation.video import write_h264

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
    """A rendered clip: pictures (H, W) uint8 of the left and the right camera, their times in seconds, the rig, the
    contents of clip.yaml and of truth.json. Times and rig are those stated, exact but for the cameras' ``errors``;
    pictures are uncompressed, and `write` keeps them as ``errors.crf`` says."""

    left: list[NDArray[np.uint8]]
    right: list[NDArray[np.uint8]]
    times: Array  # (F,) s, of the left pictures
    right_times: Array  # (F,) s
    rig: StereoRig
    clip: dict[str, Any]
    truth: list[dict[str, Any]]
    errors: StereoErrors = StereoErrors()


class World:
    """A scene with everything about it that is known before any picture is drawn.

    ``poses[view][vehicle][frame]`` are the vehicles' planes when each camera exposes; ``clocks`` are the stated times
    of the pictures and ``times`` the true ones (F,) s; ``views`` are the cameras at rest and ``moving`` the same as
    they move; ``rig``, ``clip`` and ``truth`` as in `RenderedClip`.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.road, self.rig = scene, PlacedRoad(scene), make_rig(scene)
        self.views = rig_views(scene.errors.true_rig(self.rig))
        self.moving = MovingViews(self.views, scene.errors, scene.rate, scene.seed)
        ticks = np.array([k for k in range(scene.frames) if k not in scene.dropped]) / scene.rate
        self.clocks = ticks, ticks + scene.skew_s
        self.times = scene.errors.exposure_times(self.clocks)
        duration = (scene.frames - 1) / scene.rate + abs(scene.skew_s)
        margin = 0.1 + float(np.abs(self.times[1] - self.clocks[1]).max())
        self.motions = [Motion(self.road, v, duration, margin) for v in scene.vehicles]
        self.poses = [[[m.pose(float(t)) for t in times] for m in self.motions] for times in self.times]
        self.truth = [row for j in range(len(scene.vehicles)) for row in self._truth_of(j)]
        self.clip = self._draw_clip(np.random.default_rng([scene.seed, 13]))

    def _truth_of(self, j: int) -> list[dict[str, Any]]:
        vehicle, rows = self.scene.vehicles[j], []
        for k, t in enumerate(self.times[0].tolist()):
            corners = [self.poses[i][j][k].corners(vehicle.width, vehicle.height) for i in (0, 1)]
            if min(view.depth(c).min() for view, c in zip(self.views, corners, strict=True)) < 1.0:
                continue  # beside or behind the cameras
            left, right = (self.corner_pixels(i, j, float(self.times[i][k])) for i in (0, 1))
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

    def corner_pixels(self, i: int, j: int, t: float) -> Array:
        """Where view ``i`` shows the corners (4, 2) of vehicle ``j`` in a frame of time ``t`` s."""
        v = self.scene.vehicles[j]
        return self.moving.project(i, t, lambda moment: self.motions[j].pose(moment).corners(v.width, v.height))

    def _seen(self, vehicle: Vehicle) -> list[dict[str, Any]]:
        """The rows of truth in which ``vehicle`` is wholly inside both images."""
        rows = [r for r in self.truth if r["vehicle"] == vehicle.id and r["inside"]]
        if not rows:
            raise ValueError(f"vehicle {vehicle.id} is never wholly inside both images")
        return rows

    def _draw_clip(self, rng: np.random.Generator) -> dict[str, Any]:
        """The contents of clip.yaml, with drawn quadrilaterals and lines."""
        scene, video = self.scene, self.scene.errors.crf is not None
        needs_times = bool(scene.dropped and not video or scene.skew_s)
        clip: dict[str, Any] = {side: f"{side}.mp4" if video else side for side in ("left", "right")}
        clip |= {"times": "times.csv"} if needs_times else {} if video else {"rate": scene.rate}
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
        """The line beside a lane, drawn in each view's first picture over the stretch that its vehicles drive along."""
        users = [v for v in self.scene.vehicles if (v.lane, v.receding) == (lane, receding)]
        positions = np.array([row["position"] for v in users for row in self._seen(v)])
        path: dict[str, Any] = {"shape": "line" if self.scene.radius is None else "curve"}
        for i, (side, view) in enumerate(zip(("left", "right"), self.views, strict=True)):
            visible = visible_line(self.scene, self.road, lane, positions, view, partial(self._first_pixels, i))
            visible = visible[::-1]  # from far to near
            if len(visible) < 10:
                raise ValueError(f"the line beside vehicle {users[0].id} is not visible in the {side} view")
            path[side] = draw_line(visible, view.camera, self.scene.line_points, self.scene.line_sigma, rng)
        path["lateral_offset"] = -self.scene.line_offset if receding else self.scene.line_offset
        return path

    def _first_pixels(self, i: int, points: Array) -> Array:
        """Where the first picture of view ``i`` shows ``points`` (N, 3) that stand still, (N, 2)."""
        return self.moving.project(i, float(self.times[i][0]), lambda _: points)


def render(scene: Scene) -> RenderedClip:
    """Render ``scene``; the same scene gives the same pictures.

    Raises ValueError where a vehicle is never wholly inside both images or stops moving forward, or where its line
    cannot be seen.
    """
    world = World(scene)
    left, right = _Renderer(world).render()
    return RenderedClip(left, right, *world.clocks, world.rig, world.clip, world.truth, scene.errors)


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
        scene, moving, poses = self.scene, self.world.moving, self.world.poses[i]
        static = self._static(i, 0.0)
        recorded = RecordedLight(scene.errors.cameras[i], scene.image_size, scene.seed, i)
        sensor = np.random.default_rng([scene.seed, 19, i])
        images = []
        for k, t in enumerate(self.world.times[i].tolist()):
            image = self._static(i, t) if moving.moves(i) else static.copy()
            for j in np.argsort([-track[k].centre[2] for track in poses]):
                for within, moment in self._vehicle_bands(i, j, t):
                    self._add_vehicle(image, j, moment, moving.view(i, moment), within)
                if scene.vehicles[j].glare:
                    self.glares[j].add(image, scene.vehicles[j], poses[j][k], moving.view(i, t), k)
            if self.pole:
                for within, _, view in moving.static_bands(i, t):
                    composite(image, draw_planes([self.pole], view, scene.blur_sigma, SCENE_SUBPIXELS_PER_SIDE, within))
            sun = np.sin(1.3 * t + self.phases[0]) + 0.3 * np.sin(2.9 * t + self.phases[1] + i)
            light = image * np.float32(1 + scene.gain_drift * sun)
            grey = textures.light_to_grey(recorded(light, k), scene.gamma)
            images.append(_add_sensor_noise(grey, scene, sensor))
        return images

    def _static(self, i: int, t: float) -> Image:
        """The light (H, W) of what stands still in view ``i`` in a frame of time ``t``."""
        bands = [self.backdrop.draw(view, within) for within, _, view in self.world.moving.static_bands(i, t)]
        return textures.grey_to_light(np.concatenate(bands), self.scene.gamma)

    def _add_vehicle(self, image: Image, j: int, t: float, view: PosedCamera, within: slice) -> None:
        """Draws vehicle ``j`` as it is at ``t`` s, in the rows ``within`` of the light ``image`` (H, W)."""
        vehicle, blur, pose = self.scene.vehicles[j], self.scene.blur_sigma, self.world.motions[j].pose(t)
        composite(image, draw_planes([_shadow_plane(self.shadow, vehicle, pose)], view, blur, 1, within))
        parts = _place_vehicle_parts(self.parts[j], pose)
        composite(image, draw_planes(parts, view, blur, SCENE_SUBPIXELS_PER_SIDE, within))

    def _vehicle_bands(self, i: int, j: int, t: float) -> Iterator[tuple[slice, float]]:
        """Rows that hold all of vehicle ``j`` in view ``i`` in a frame of time ``t``, with the time of each."""
        height, readout = self.scene.image_size[1], self.scene.errors.cameras[i].readout
        if not readout:
            yield slice(0, height), t
            return
        first, middle, last = (self._vehicle_outline(i, j, t + s * readout) for s in (-0.5, 0.0, 0.5))
        if not len(first) == len(middle) == len(last) > 0:
            return  # beside the camera, where it is not drawn either
        rows, pad = np.concatenate([first, middle, last])[:, 1], 4 + 4 * self.scene.blur_sigma
        top, bottom = (int(np.clip(y, 0, height)) for y in (rows.min() - pad, rows.max() + pad + 1))
        motion = float(np.linalg.norm(last - first, axis=1).max())
        for within, delay in row_bands(top, bottom, motion, readout, height) if top < bottom else ():
            yield within, t + delay

    def _vehicle_outline(self, i: int, j: int, t: float) -> Array:
        """Pixels (N, 2) around all that is drawn of vehicle ``j`` where it is at ``t`` s."""
        pose, view = self.world.motions[j].pose(t), self.world.moving.view(i, t)
        shadow = _shadow_plane(self.shadow, self.scene.vehicles[j], pose)
        corners = np.array([p.corners() for p in (shadow, *_place_vehicle_parts(self.parts[j], pose))])
        return view.project(corners[(view.depth(corners) > 0.5).all(1)].reshape(-1, 3))


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
    """Write left/ and right/ or left.mp4 and right.mp4, rig.yaml, clip.yaml, truth.json and, where the frames are not
    evenly timed, times.csv into ``directory``; returns the path of clip.yaml.

    Without ``states_cameras``, and of cameras with errors, no file tells how ideal the cameras are.
    """
    directory = Path(directory)
    times = rendered.times, rendered.right_times
    for side, images, clock in zip(("left", "right"), (rendered.left, rendered.right), times, strict=True):
        if rendered.errors.crf is not None:
            directory.mkdir(parents=True, exist_ok=True)
            write_h264(directory / f"{side}.mp4", images, clock.tolist(), rendered.errors.crf, streamed=True)
            continue
        (directory / side).mkdir(parents=True, exist_ok=True)
        for k, image in enumerate(images):
            cv2.imwrite(str(directory / side / f"{k:04d}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_documents(rendered, directory, states_cameras)
    return directory / "clip.yaml"


def write_documents(rendered: RenderedClip, directory: Path, states_cameras: bool = True) -> None:
    """Everything of `write` but the pictures."""
    rig, clip = rendered.rig, rendered.clip
    if not states_cameras or rendered.errors != StereoErrors():
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
