"""Writing rendered stereo clips, as `paceline speed` reads them, with truth.json beside them.

The static scene is rendered once for each camera that does not move, and each frame only near vehicles and their
shadows. Far from them a vehicle changes a pixel only by the light that it scatters, which is neglected.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from paceline.arrays import Array, Mask
from paceline.cameras import PosedCamera, StereoRig
from paceline.documents.assumed_calibration import without_statements
from paceline.documents.rig_yaml import rig_yaml
from paceline.progress import Progress
from paceline.simulation.camera_errors import MAX_MOTION_IN_BAND_PX, RecordedLight
from paceline.simulation.operator import clip_document
from paceline.simulation.raytraced import clip_folder
from paceline.simulation.raytraced.light import Light
from paceline.simulation.raytraced.mitsuba_variant import default_variant, load_mitsuba
from paceline.simulation.raytraced.renderer import Radiance, Renderer, Window
from paceline.simulation.raytraced.scene import PlacedStereoScene, PlacedVehicle, make_sensor
from paceline.simulation.raytraced.scene_yaml import SpeedScene, StereoErrorsModel
from paceline.simulation.raytraced.sensor import Lens, Shutter, expose, render_exposure
from paceline.simulation.video import write_h264

BACKGROUND_SAMPLE_DIVISOR = 4  # where there is no vehicle: most of the time is spent there, nothing measured
VEHICLE_MARGIN_M = 0.1  # m around a vehicle's box that get all samples
SHADED_MARGIN_M = 1.2  # m around a vehicle in which it darkens the road
MAX_SHADOW_LENGTH_M = 40.0
IMAGE_SUFFIX = {"png": ".png", "jpeg": ".jpg", "h264": ".png"}


def write(
    scene: SpeedScene,
    directory: Path | str,
    progress: Progress | None = None,
    variant: str | None = None,
    states_cameras: bool = True,
) -> Path:
    """Render ``scene`` into ``directory`` and return the path of its clip.yaml.

    Without ``states_cameras``, and of cameras with errors, neither rig.yaml nor clip.yaml tells how ideal they are.

    Pictures that are there already, from a run that was interrupted, are kept. The same scene gives the same pictures
    bit for bit on the same variant of the renderer. Raises UnusableInput where the scene or the folder cannot be used.
    """
    placed = PlacedStereoScene(scene)
    placed.check_outlines()
    directory, variant = Path(directory), variant or default_variant()
    load_mitsuba(variant)  # is refused at once where it is not installed
    renderer = Renderer(placed.static_meshes(), placed.moving_groups(), placed.light, variant)
    truth = placed.truth(renderer)

    def hidden(view: PosedCamera, points: Array) -> Mask:
        renderer.place(placed.empty_placements())
        return np.asarray(renderer.distance(view.centre, points) <= 0.98 * np.linalg.norm(points - view.centre, axis=1))

    clip = clip_document(placed, truth, hidden)
    clip_folder.open_folder(directory, scene, variant)
    total, n_done = placed.clocks.size, 0
    for i, side in enumerate(("left", "right")):
        camera_renderer = _CameraRenderer(placed, renderer, i, directory / f".still-{side}.npy")
        suffix = IMAGE_SUFFIX["h264" if scene.is_video else scene.sensor.image_format]
        paths = [directory / side / f"{k:04d}{suffix}" for k in range(placed.clocks.shape[1])]
        video = directory / f"{side}.mp4"
        for k, path in enumerate(paths):
            if not path.exists() and not (scene.is_video and video.exists()):
                clip_folder.write_picture(path, camera_renderer.render(k), scene.sensor.quality)
            n_done += 1
            if progress:
                progress(n_done, total)
        if scene.is_video and not video.exists():
            times = placed.clocks[i].tolist()  # of its own clock, which does not know of an offset
            if placed.errors.crf is None:
                clip_folder.write_video(video, paths, times, scene.sensor.quality)
            else:
                write_h264(video, map(clip_folder.read_picture, paths), times, placed.errors.crf, streamed=True)
    rig = placed.written_rig
    if not states_cameras or scene.camera_errors != StereoErrorsModel():
        rig, _ = without_statements(rig), clip.pop("synchronised", None)
    _write_documents(placed, rig, clip, truth, directory)
    _remove_temporary_files(directory, scene)
    return directory / "clip.yaml"


def _write_documents(
    placed: PlacedStereoScene, rig: StereoRig, clip: dict[str, Any], truth: list[dict[str, Any]], directory: Path
) -> None:
    clip_folder.write_atomically(directory / "rig.yaml", rig_yaml(rig).encode())
    clip_folder.write_atomically(directory / "truth.json", json.dumps(truth).encode())
    clip_folder.write_atomically(directory / "true_rig.yaml", rig_yaml(placed.rig).encode())
    if "times" in clip:
        table = io.StringIO()
        table.write("frame,left_s,right_s\n")
        for k, (left, right) in enumerate(placed.clocks.T.tolist()):
            table.write(f"{k},{left:.6f},{right:.6f}\n")
        clip_folder.write_atomically(directory / "times.csv", table.getvalue().encode())
    clip_folder.write_yaml(directory / "clip.yaml", clip)


def _remove_temporary_files(directory: Path, scene: SpeedScene) -> None:
    for side in ("left", "right"):
        (directory / f".still-{side}.npy").unlink(missing_ok=True)
        if scene.is_video and (directory / side).is_dir():
            clip_folder.remove_pictures(directory / side)


class _CameraRenderer:
    """The pictures of one camera of a stage."""

    def __init__(self, placed: PlacedStereoScene, renderer: Renderer, i: int, cache: Path) -> None:
        self.placed, self.renderer, self.i, self.cache = placed, renderer, i, cache
        self.lens, self.shutter = Lens.of(placed.views[i].camera), placed.shutters[i]
        size, errors = placed.rig.cameras[i].image_size, placed.errors.cameras[i]
        self.recorded = RecordedLight(errors, size, placed.scene.seed, i)
        self._still: Radiance | None = None

    def view(self, t: float) -> PosedCamera:
        """The pinhole camera at ``t`` s."""
        true = self.placed.moving.view(self.i, t)
        return PosedCamera(self.lens.pinhole, true.R, true.t)

    def render(self, k: int) -> clip_folder.Picture:
        """The ``k``-th picture, (H, W) or (H, W, 3) uint8."""
        scene, time = self.placed.scene, float(self.placed.times[self.i, k])
        light = self.moved_static_meshes(k) if self.placed.moving.moves(self.i) else self.static_meshes().copy()
        shutter = self.banded_shutter(time)
        around = self.window(time, lambda car, t: _shadow_extent(car, t, self.placed.light))
        bodies = self.window(time, lambda car, t: _vehicle_box(car, t, VEHICLE_MARGIN_M))
        for part, (window, samples) in enumerate(
            ((around, scene.samples // BACKGROUND_SAMPLE_DIVISOR), (bodies, scene.samples))
        ):
            if window:
                x0, y0, x1, y1 = window
                frame_seed = int(np.random.SeedSequence([scene.seed, 17, self.i, k, part]).generate_state(1)[0])
                light[y0:y1, x0:x1] = render_exposure(
                    self.renderer,
                    self.placed.placements,
                    self.view,
                    time,
                    shutter,
                    max(1, samples),
                    frame_seed,
                    window,
                )
        white = self.placed.light.level_irradiance / np.pi
        noise = np.random.default_rng([scene.seed, 19, self.i, k])
        return expose(self.recorded(self.lens.distort(light), k), white, make_sensor(scene), noise)

    def static_meshes(self) -> Radiance:
        """The light (H, W, 3) without any vehicle, kept in a file in case of an interruption."""
        if self._still is None and self.cache.exists():
            self._still = np.load(self.cache)
        if self._still is None:
            self.renderer.place(self.placed.empty_placements())
            seed = int(np.random.SeedSequence([self.placed.scene.seed, 23, self.i]).generate_state(1)[0])
            samples = max(1, self.placed.scene.samples // BACKGROUND_SAMPLE_DIVISOR)
            self._still = self.renderer.render(self.view(0.0), samples, seed)
            content = io.BytesIO()
            np.save(content, self._still)
            clip_folder.write_atomically(self.cache, content.getvalue())
        return self._still

    def moved_static_meshes(self, k: int) -> Radiance:
        """The light (H, W, 3) without any vehicle in the ``k``-th picture of a camera that moves."""
        self.renderer.place(self.placed.empty_placements())
        samples, width = max(1, self.placed.scene.samples // BACKGROUND_SAMPLE_DIVISOR), self.lens.pinhole.image_size[0]
        time = float(self.placed.times[self.i, k])
        bands = list(self.placed.moving.static_bands(self.i, time))
        seeds = np.random.SeedSequence([self.placed.scene.seed, 23, self.i, k]).generate_state(len(bands)).tolist()
        if len(bands) == 1:
            return self.renderer.render(self.view(time), samples, seeds[0])
        return np.concatenate(
            [
                self.renderer.render(self.view(t), samples, seed, (0, rows.start, width, rows.stop))
                for (rows, t, _), seed in zip(bands, seeds, strict=True)
            ]
        )

    def banded_shutter(self, time: float) -> Shutter:
        """The shutter with as many bands as the motion of the vehicles at ``time`` s takes, where no other number is
        given."""
        model = self.placed.scene.camera_errors
        if not (model.left, model.right)[self.i].readout:
            return self.shutter
        motion, half = 0.0, self.shutter.readout / 2
        for car in self.placed.vehicles:
            if car.is_there(time - half) and car.is_there(time + half):
                ends = [(self.view(t), _vehicle_box(car, t, 0.0)) for t in (time - half, time + half)]
                if all((view.depth(box) > 0.5).all() for view, box in ends):
                    first, last = (view.project(box) for view, box in ends)
                    motion = max(motion, float(np.linalg.norm(last - first, axis=1).max()))
        count = int(np.clip(np.ceil(motion / MAX_MOTION_IN_BAND_PX), 1, self.lens.pinhole.image_size[1]))
        return replace(self.shutter, bands=count)

    def window(self, time: float, extent: Callable[[PlacedVehicle, float], Array]) -> Window | None:
        """The part of the picture that the ``extent`` of vehicles, points (N, 3) of the world at a time, takes up at
        ``time`` s; None where there is none."""
        reach = self.shutter.exposure / 2 + abs(self.shutter.readout) / 2
        moments = sorted({time - reach, time, time + reach})
        points = [(self.view(t), extent(car, t)) for car in self.placed.vehicles for t in moments if car.is_there(t)]
        if not points:
            return None
        width, height = self.lens.pinhole.image_size
        depth = np.concatenate([view.to_camera(around)[:, 2] for view, around in points])
        if (depth <= 0.5).all():
            return None
        if (depth <= 0.5).any():
            return 0, 0, width, height
        pixels = np.concatenate([view.project(around) for view, around in points])
        low = np.clip(np.floor(pixels.min(0)).astype(int) - 4, 0, (width, height))
        high = np.clip(np.ceil(pixels.max(0)).astype(int) + 5, 0, (width, height))
        return (int(low[0]), int(low[1]), int(high[0]), int(high[1])) if (high > low).all() else None


def _shadow_extent(car: PlacedVehicle, t: float, light: Light) -> Array:
    """Corners (N, 3), world, of a box around a vehicle with what lies close to it, and of its shadow."""
    box = _vehicle_box(car, t, SHADED_MARGIN_M)
    if light.clouds == 1:
        return box
    high = float(car.body.bounds[1][2]) + 0.2
    drop = min(high / max(float(light.direction[2]), 1e-3), MAX_SHADOW_LENGTH_M)
    return np.concatenate([box, box[1::2] - drop * light.direction])


def _vehicle_box(car: PlacedVehicle, t: float, margin: float) -> Array:
    """Corners (8, 3), world, of a vehicle's box, ``margin`` m wider and 0.2 m deeper; every other one is at its top."""
    R, origin = car.motion.pose(t)
    low, high = car.body.bounds
    low, high = low - [margin, margin, 0], high + [margin, margin, 0]
    low[2] = -0.2
    box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    return np.asarray(box @ R.T + origin)
