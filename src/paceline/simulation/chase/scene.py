"""The description of a chase scene: road, two vehicles, light and camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from paceline.cameras import Camera

CHASE_PRESETS: dict[str, dict[str, Any]] = {
    "nist": {},  # 256 × 242 at 15 frames/s, 5–15 m, to 35 km/h
    "hd": {
        "image_size": (1280, 720),
        "rate": 30.0,
        "focal": 1100.0,
        "top_speed": 27.8,
        "gap": (8.0, 60.0),
        "radius": 450.0,
    },
    "full_hd": {
        "image_size": (1920, 1080),
        "rate": 30.0,
        "focal": 1600.0,
        "top_speed": 27.8,
        "gap": (8.0, 60.0),
        "radius": 450.0,
    },
}


@dataclass(frozen=True)
class Occlusion:
    """A "vehicle" or a "post" that crosses between the two vehicles: in front of the lead's middle at ``time`` s,
    overlapping it for ``duration`` s."""

    time: float
    duration: float = 0.8
    kind: str = "vehicle"


@dataclass(frozen=True)
class ChaseScene:
    """A chase scene: the road, the two vehicles, the light and the camera. Angles in rad.

    The chase vehicle drives at half of ``top_speed`` (m/s) to the whole of it on a road without turns tighter than
    ``radius`` (m). The lead is one of `RASTERIZED_KINDS`, painted in the grey level ``paint``; its rear plane keeps
    within ``gap`` (m) of the camera, weaves by up to ``weave`` (m) and is turned by ``yaw`` to the left of its path.
    The camera shakes: with 300 px of focal length and at 15 Hz the image moves up and down by about half of
    ``shake_px`` RMS from frame to frame, and by twice of it over bumps. Besides, it vibrates in its vehicle with
    ``vibration`` (rad RMS) about each of its axes, which the odometry does not tell; ``readout`` (s) is the time from
    the first row's exposure to the last one's, a frame's time being its middle row's, and 0 for all rows at once.

    ``object_density`` is the number of objects beside the road (about 1: a busy street), ``parallel_share`` (0–1) the
    share of objects whose edges are parallel and close to the lead's; ``shadows`` is the density of shadows on the
    road (1: a third of it), ``ambient`` the light in them. ``sun_azimuth`` is counted to the left of the first
    direction of travel: 0 is ahead. ``exposure_drift`` is the relative amplitude of the varying exposure,
    ``shutter_s`` the exposure time. ``model_error`` (m) is the standard deviation of the lines of the target file from
    the true ones.
    """

    seed: int
    frames: int = 450
    rate: float = 15.0
    image_size: tuple[int, int] = (256, 242)
    focal: float = 300.0
    camera_height: float = 2.1
    tilt: float = 0.05
    top_speed: float = 9.7
    gap: tuple[float, float] = (5.0, 15.0)
    radius: float = 110.0
    kind: str = "van"
    paint: float = 150.0
    weave: float = 0.7
    yaw: float = 0.0
    shake_px: float = 4.0
    vibration: float = 0.0
    readout: float = 0.0
    object_density: float = 1.0
    parallel_share: float = 0.2
    shadows: float = 0.7
    ambient: float = 0.45
    sun_azimuth: float = 2.5
    sun_elevation: float = 0.8
    traffic: bool = True
    brakes: bool = True
    occlusions: tuple[Occlusion, ...] = ()
    exposure: float = 0.8
    exposure_drift: float = 0.15
    vignetting: float = 0.2
    blur_sigma: float = 0.6
    shutter_s: float = 0.006
    noise_sigma: float = 1.5
    shot_noise: float = 0.02
    model_error: float = 0.0

    @property
    def camera(self) -> Camera:
        width, height = self.image_size
        K = np.array([[self.focal, 0, (width - 1) / 2], [0, self.focal, (height - 1) / 2], [0, 0, 1.0]])
        return Camera(self.image_size, K)
