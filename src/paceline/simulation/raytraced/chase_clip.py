"""Writing rendered chase-camera clips, as `paceline follow` reads them, with truth.json beside them."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from paceline.arrays import Array
from paceline.cameras import Camera, PosedCamera
from paceline.progress import Progress
from paceline.simulation.chase.motion import CameraShake, GapProfile, SmoothNoise
from paceline.simulation.operator import draw_start
from paceline.simulation.raytraced import clip_folder, road_surface
from paceline.simulation.raytraced.meshes import Placement, SceneMesh
from paceline.simulation.raytraced.mitsuba_variant import default_variant, load_mitsuba
from paceline.simulation.raytraced.renderer import Renderer
from paceline.simulation.raytraced.scene import (
    OFF_SCENE,
    make_light,
    make_road,
    make_sensor,
    make_shutter,
    place_body,
    rigid_groups,
    visible_share,
)
from paceline.simulation.raytraced.scene_yaml import FollowScene
from paceline.simulation.raytraced.scenery.placement import Scenery, build_scenery
from paceline.simulation.raytraced.sensor import expose, render_exposure
from paceline.simulation.raytraced.vehicles.build import build

RAYTRACED_NOMINAL_RANGE_M = 10.0  # m
CLIP_START_ARC_M = 15.0  # m of arc length


@dataclass(frozen=True)
class _PlanPose:
    """The camera's place in plan: x, y (m) and heading (rad)."""

    x: float
    y: float
    heading: float


class PlacedChaseScene:
    """A follow scene, placed: where camera and lead are is a function of the time."""

    def __init__(self, scene: FollowScene) -> None:
        self.scene, self.light, self.road = scene, make_light(scene), make_road(scene)
        chase, lead = scene.chase, scene.lead
        rng = np.random.default_rng([scene.seed, 31])
        self.body = build(lead.kind, lead.seed)
        self.plane = self.body.rear
        self.speed = SmoothNoise(rng, 8, 40)
        self.gap = GapProfile(rng, (lead.gap[0], lead.gap[1]))
        self.lead_weave, self.camera_drift = SmoothNoise(rng, 4.0, 12.0), SmoothNoise(rng, 8.0, 25.0)
        self.pitch_shake, self.yaw_shake = (CameraShake(rng, a * chase.shake_px / 300) for a in (2.4, 0.25))
        self.roll_shake, self.heave_shake = (CameraShake(rng, a * chase.shake_px / 4) for a in (0.004, 0.02))
        w, h = chase.image_size
        K = np.array([[chase.focal, 0, (w - 1) / 2], [0, chase.focal, (h - 1) / 2], [0, 0, 1.0]])
        self.camera = Camera((w, h), K)
        right = [m for m in self.road.lanes if m > 0]
        self.lane = min(right) if right else self.road.lanes[-1]

    def arc(self, t: float) -> float:
        """Of the camera, m."""
        return CLIP_START_ARC_M + self.scene.chase.top_speed * (0.75 * t + 0.25 * self.speed.integral(t))

    def foot(self, t: float) -> tuple[_PlanPose, Array, Array]:
        """The camera's place in plan, the point below it (3,) and the road's axes (3, 3) there."""
        origin, axes = self.road.frame(self.arc(t), self.lane + 0.35 * self.camera_drift(t))
        heading = float(np.arctan2(axes[1, 0], axes[0, 0])) + self.yaw_shake(t)
        return _PlanPose(float(origin[0]), float(origin[1]), heading), origin, axes

    def view(self, t: float) -> PosedCamera:
        """The camera at ``t`` s."""
        foot, origin, _ = self.foot(t)
        pitch, roll = self.scene.chase.tilt + self.pitch_shake(t), self.roll_shake(t)
        c, s = np.cos(foot.heading), np.sin(foot.heading)
        level = np.array([[s, -c, 0.0], [0.0, 0.0, -1.0], [c, s, 0.0]])  # right, down, ahead
        a, b = np.cos(pitch), np.sin(pitch)
        tilt = np.array([[1, 0, 0], [0, a, -b], [0, b, a]])
        d, e = np.cos(roll), np.sin(roll)
        R = np.array([[d, e, 0], [-e, d, 0], [0, 0, 1]]) @ tilt @ level
        eye = origin + np.array([0.0, 0.0, self.scene.chase.height + self.heave_shake(t)])
        return PosedCamera(self.camera, R, -R @ eye)

    def pose(self, t: float) -> Placement:
        """Of the lead's body at ``t`` s; its rear plane is the gap ahead of the camera."""
        gap, closing = self.gap(t)
        weave, v = self.scene.lead.weave, self.scene.chase.top_speed * (0.75 + 0.25 * self.speed(t)) + closing
        drift = np.arctan(weave * self.lead_weave.rate(t) / max(v, 1.0))
        origin, axes = self.road.frame(self.arc(t) + gap - self.plane.center[0], self.lane + weave * self.lead_weave(t))
        c, s = np.cos(-drift), np.sin(-drift)  # to the right is clockwise
        return axes @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), origin

    def placements(self, t: float) -> list[Placement]:
        return place_body(self.body, self.pose(t), self.arc(t) + self.gap(t)[0])

    def static_meshes(self) -> list[SceneMesh]:
        spec = Scenery(**self.scene.scenery.model_dump(), seed=self.scene.seed)
        return road_surface.road_meshes(self.road) + build_scenery(self.road, spec, 0.0, self.road.length)

    def moving_groups(self) -> list[Sequence[SceneMesh]]:
        return list(rigid_groups(self.body))

    @cached_property
    def times(self) -> list[float]:
        return [k / self.scene.rate for k in range(self.scene.frames)]

    def row(self, k: int, renderer: Renderer) -> dict[str, Any]:
        """The truth of one frame, its keys as `paceline.simulation.chase.clip` writes them; what may hide the lead is
        what stands still."""
        t = self.times[k]
        view, (R, origin), foot = self.view(t), self.pose(t), self.foot(t)[0]
        corners, center = self.plane.corners() @ R.T + origin, R @ self.plane.center + origin
        pixels = view.project(corners)
        return {
            "frame": k,
            "time_s": t,
            "position": view.to_camera(center).tolist(),
            "corners": pixels.tolist(),
            "center": view.project(center).tolist(),
            "width_px": float(np.linalg.norm(pixels[1] - pixels[0])),
            "visible": visible_share(renderer, view.centre, corners),
            "chase": {"x_m": foot.x, "y_m": foot.y, "heading_rad": foot.heading},
        }

    def target_document(self) -> dict[str, Any]:
        """The contents of target.yaml: the rear's strong edges as they appear from `RAYTRACED_NOMINAL_RANGE_M`."""
        ends = self.body.lines("rear") - self.plane.center
        shrink = RAYTRACED_NOMINAL_RANGE_M / (RAYTRACED_NOMINAL_RANGE_M + ends[..., 0])
        right, down = -ends[..., 1] * shrink, -ends[..., 2]
        below = self.scene.chase.height - self.plane.center[2]  # the plane's centre, under the camera
        down = (down + below) * shrink - below
        corners: dict[tuple[float, float], str] = {}
        segments = []
        for line in np.stack([right, down], -1):
            across = 0 if abs(line[1, 0] - line[0, 0]) < abs(line[1, 1] - line[0, 1]) else 1
            line[:, across] = line[:, across].mean()  # exactly horizontal or vertical, as target.yaml demands
            places = [(round(float(x), 4), round(float(y), 4)) for x, y in line]
            segments.append([corners.setdefault(p, f"c{len(corners)}") for p in places])
        return {
            "name": self.body.kind,
            "nominal_range": RAYTRACED_NOMINAL_RANGE_M,
            "corners": {name: list(place) for place, name in corners.items()},
            "segments": segments,
        }

    def start_document(self, first: dict[str, Any]) -> dict[str, Any]:
        """``start`` of follow.yaml, as an operator would set it on the first frame."""
        return draw_start(np.array(first["center"]), first["position"][2], RAYTRACED_NOMINAL_RANGE_M, self.scene.seed)


def write(
    scene: FollowScene, directory: Path | str, progress: Progress | None = None, variant: str | None = None
) -> Path:
    """Render ``scene`` into ``directory`` and return the path of its follow.yaml; as `stereo_clip.write`."""
    directory, variant = Path(directory), variant or default_variant()
    load_mitsuba(variant)  # is refused at once where it is not installed
    chase = PlacedChaseScene(_with_long_road(scene))
    renderer = Renderer(chase.static_meshes(), chase.moving_groups(), chase.light, variant)
    renderer.place([OFF_SCENE] * len(chase.moving_groups()))
    rows = [chase.row(k, renderer) for k in range(scene.frames)]
    clip_folder.open_folder(directory, scene, variant)
    white, suffix = chase.light.level_irradiance / np.pi, ".jpg" if scene.sensor.image_format == "jpeg" else ".png"
    paths = [directory / "frames" / f"{k:05d}{suffix}" for k in range(scene.frames)]
    video = directory / "frames.mp4"
    view = lru_cache(maxsize=4)(chase.view)
    for k, (path, t) in enumerate(zip(paths, chase.times, strict=True)):
        if not path.exists() and not video.exists():
            frame_seed = int(np.random.SeedSequence([scene.seed, 17, k]).generate_state(1)[0])
            light = render_exposure(renderer, chase.placements, view, t, make_shutter(scene), scene.samples, frame_seed)
            picture = expose(light, white, make_sensor(scene), np.random.default_rng([scene.seed, 19, k]))
            clip_folder.write_picture(path, picture, scene.sensor.quality)
        if progress:
            progress(k + 1, scene.frames)
    as_video = scene.sensor.image_format == "h264"
    if as_video and not video.exists():
        clip_folder.write_video(video, paths, chase.times, scene.sensor.quality)
    _write_documents(chase, rows, directory, as_video)
    if as_video and (directory / "frames").is_dir():
        clip_folder.remove_pictures(directory / "frames")
    return directory / "follow.yaml"


def _with_long_road(scene: FollowScene) -> FollowScene:
    """The scene with a road as long as the drive."""
    length = CLIP_START_ARC_M + scene.chase.top_speed * (scene.frames / scene.rate + 2) + scene.lead.gap[1] + 30
    if scene.road.length >= length:
        return scene
    return scene.model_copy(update={"road": scene.road.model_copy(update={"length": float(np.ceil(length))})})


def _write_documents(chase: PlacedChaseScene, rows: list[dict[str, Any]], directory: Path, as_video: bool) -> None:
    camera = {"image_size": list(chase.camera.image_size), "K": chase.camera.K.tolist()}
    camera |= {} if chase.scene.sensor.readout else {"shutter": "global"}
    follow: dict[str, Any] = {"video": "frames.mp4"} if as_video else {"video": "frames", "rate": chase.scene.rate}
    follow |= {"camera": "camera.yaml", "target": "target.yaml", "start": chase.start_document(rows[0])}
    documents = {
        "camera": camera,
        "target": chase.target_document(),
        "follow": follow | {"odometry": "odometry.csv"},
    }
    table = io.StringIO()
    odometry = [[r["frame"], *(round(r["chase"][k], 6) for k in ("x_m", "y_m", "heading_rad"))] for r in rows]
    csv.writer(table).writerows([["frame", "x_m", "y_m", "heading_rad"], *odometry])
    clip_folder.write_atomically(directory / "odometry.csv", table.getvalue().encode())
    clip_folder.write_atomically(directory / "truth.json", json.dumps(rows).encode())
    for name, document in documents.items():
        clip_folder.write_yaml(directory / f"{name}.yaml", document)
