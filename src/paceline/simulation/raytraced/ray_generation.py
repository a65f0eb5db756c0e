"""Rendering of windows of a Mitsuba scene: with generated rays in compiled variants, with Mitsuba's sensor in others.

Mitsuba traces its own code anew for each image, and compiles it anew for each image size. With generated rays, through
any pixels, both happen once per world, and the code is replayed for all its images.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.cameras import Camera
from paceline.simulation.raytraced.mitsuba_variant import PORTABLE_VARIANT

Radiance = NDArray[np.float32]
Window = tuple[int, int, int, int]  # pixels x0, y0, x1, y1 of a part of a picture, the last two beyond it

SAMPLER_PLUGIN = "multijitter"  # spreads samples evenly over a pixel and over the lights: far less noise than without


class WindowRenderer(Protocol):
    """Takes the picture (H, W, 3) of a ``window`` by a ``camera`` at X_camera = R X + t, with so many ``samples``, a
    power of two, per pixel. The same ``seed`` gives the same picture."""

    def __call__(self, camera: Camera, R: Array, t: Array, window: Window, samples: int, seed: int) -> Radiance: ...


def window_renderer(mi: Any, scene: Any) -> WindowRenderer:
    """What takes pictures of ``scene``, as it is when they are taken."""
    return _sensor_renderer(mi, scene) if mi.variant() == PORTABLE_VARIANT else _ray_renderer(mi, scene)


def _ray_renderer(mi: Any, scene: Any) -> WindowRenderer:
    import drjit as dr

    tracers: dict[int, Callable[..., Any]] = {}

    def tracer(samples: int) -> Callable[..., Any]:
        def trace(scene: Any, seed: Any, x: Any, y: Any, own: Any, to_world: Any, eye: Any) -> Any:
            """Radiances of pixels ``x`` and ``y``, ``own`` being the pixel of each ray."""
            sampler = mi.load_dict({"type": SAMPLER_PLUGIN, "sample_count": samples})
            sampler.set_samples_per_wavefront(samples)
            sampler.seed(seed, dr.width(own))
            within = sampler.next_2d()
            u, v = dr.gather(mi.Float, x, own) + within.x, dr.gather(mi.Float, y, own) + within.y
            towards = dr.normalize(to_world @ mi.Vector3f(u - 0.5, v - 0.5, 1.0))
            light, _, _ = scene.integrator().sample(scene, sampler, mi.RayDifferential3f(eye, towards))
            dr.eval(light)  # else each colour is traced for itself
            return [dr.block_sum(color, samples) / samples for color in light]

        return dr.freeze(trace, warn_after=1000)  # it is recorded anew for some sizes, which is no fault

    def take(camera: Camera, R: Array, t: Array, window: Window, samples: int, seed: int) -> Radiance:
        x0, y0, x1, y1 = window
        x, y = np.meshgrid(np.arange(x0, x1, dtype=np.float32), np.arange(y0, y1, dtype=np.float32))
        own = dr.arange(mi.UInt32, x.size * samples) // samples
        to_world, eye = mi.Matrix3f(R.T @ np.linalg.inv(camera.K)), mi.Point3f(*(-R.T @ t).tolist())
        start = mi.UInt32(seed)
        dr.make_opaque(own, to_world, eye, start)
        if samples not in tracers:
            tracers[samples] = tracer(samples)
        light = tracers[samples](scene, start, mi.Float(x.ravel()), mi.Float(y.ravel()), own, to_world, eye)
        return np.stack([np.array(color, np.float32).reshape(x.shape) for color in light], -1)

    return take


def _sensor_renderer(mi: Any, scene: Any) -> WindowRenderer:
    def take(camera: Camera, R: Array, t: Array, window: Window, samples: int, seed: int) -> Radiance:
        (width, height), K = camera.image_size, camera.K
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = R.T, -R.T @ t
        film = {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "crop_offset_x": window[0],
            "crop_offset_y": window[1],
            "crop_width": window[2] - window[0],
            "crop_height": window[3] - window[1],
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},  # others add up in an order that differs from run to run
        }
        sensor = {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(width / (2 * K[0, 0])))),
            "fov_axis": "x",
            "principal_point_offset_x": -(K[0, 2] + 0.5 - width / 2) / width,
            "principal_point_offset_y": -(K[1, 2] + 0.5 - height / 2) / height,
            "near_clip": 0.05,
            "far_clip": 1e5,
            "to_world": mi.ScalarTransform4f(to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])),
            "film": film,
            "sampler": {"type": SAMPLER_PLUGIN},
        }
        return np.array(mi.render(scene, sensor=mi.load_dict(sensor), spp=samples, seed=seed), np.float32)

    return take
