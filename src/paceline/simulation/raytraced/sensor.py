"""Image formation by lens, shutter and sensor: from linear radiance to pixel values in a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ive

from paceline.arrays import Array
from paceline.cameras import Camera, PosedCamera
from paceline.simulation.camera_errors import row_delay
from paceline.simulation.raytraced.light import LUMINANCE_WEIGHTS
from paceline.simulation.raytraced.meshes import Placement
from paceline.simulation.raytraced.renderer import Radiance, Renderer, Window


@dataclass(frozen=True)
class Sensor:
    """A camera's electronics. White is what a white card on open level ground reflects, divided by ``exposure``.

    ``full_well`` is the number of electrons at white, whose root is the photon noise; ``read_noise`` is in electrons.
    ``vignetting`` is the share of light lost in the corners. Values go as light to the power 1 / ``gamma``.
    ``blur_sigma`` (px) is the standard deviation by which lens and pixel together spread a point.
    """

    exposure: float = 1.2
    full_well: float = 8000.0
    read_noise: float = 12.0
    vignetting: float = 0.15
    gamma: float = 2.2
    color: bool = False
    blur_sigma: float = 0.55


def expose(radiance: Radiance, white: float, sensor: Sensor, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture, (H, W) grey or (H, W, 3) blue, green, red, that ``sensor`` makes of ``radiance`` (H, W, 3), where
    ``white`` is the radiance of a white card."""
    light = blur(
        radiance[..., ::-1] if sensor.color else radiance @ LUMINANCE_WEIGHTS.astype(np.float32), sensor.blur_sigma
    )
    falloff = vignette(radiance.shape[:2], sensor.vignetting).reshape(radiance.shape[:2] + (1,) * (light.ndim - 2))
    electrons = np.maximum(light * falloff, 0) * (sensor.exposure / white * sensor.full_well)
    charge = rng.poisson(electrons) + sensor.read_noise * rng.standard_normal(electrons.shape, np.float32)
    share = np.clip(charge / sensor.full_well, 0, 1)
    return np.asarray(np.rint(255 * share ** (1 / sensor.gamma)), np.uint8)


def blur(light: Radiance, sigma: float) -> Radiance:
    """``light`` (H, W[, 3]), means over pixels, spread until a point's image has the standard deviation ``sigma`` px.

    The discrete analogue of the Gaussian, whose variance is exact however small it is (Lindeberg 1990).
    """
    more = sigma**2 - 1 / 12  # the pixel's own square has the rest
    if more <= 0:
        return light
    reach = int(np.ceil(5 * sigma)) + 1
    kernel = ive(np.arange(-reach, reach + 1), more)
    return np.asarray(cv2.sepFilter2D(light, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)


def vignette(shape: tuple[int, int], loss: float) -> Array:
    """The share of light (H, W) that reaches each pixel: 1 in the middle, 1 - ``loss`` in the corners, by its square of
    the distance."""
    height, width = shape
    y, x = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return np.asarray(1 - loss * ((x * width) ** 2 + (y * height) ** 2) / (width**2 + height**2))


@dataclass(frozen=True)
class Shutter:
    """When light is taken. It is open for ``exposure`` s about a frame's time, rendered as ``steps`` moments in it.

    Rows are read one after another within ``readout`` s, the middle one at the frame's time (0: all at once). They are
    rendered in ``bands`` that each share one moment, so a row's time is wrong by at most ``readout`` / (2 ``bands``).
    """

    exposure: float = 0.0
    steps: int = 1
    readout: float = 0.0
    bands: int = 1

    def row_delay(self, row: Array | float, height: int) -> Array:
        """Seconds from a frame's time to that at which its ``row`` (…) of ``height`` is read."""
        return row_delay(row, self.readout, height)


def render_exposure(
    renderer: Renderer,
    placements: Callable[[float], Sequence[Placement]],
    view: Callable[[float], PosedCamera],
    time: float,
    shutter: Shutter,
    samples: int,
    seed: int,
    window: Window | None = None,
) -> Radiance:
    """The light (H, W, 3) that a pinhole camera takes at ``time`` s, in a ``window`` of its picture or the whole.

    ``placements`` and ``view`` give the poses of all meshes and of the camera at any time; ``samples`` are the rays per
    pixel in total.
    """
    width, height = view(time).camera.image_size
    x0, y0, x1, y1 = window or (0, 0, width, height)
    edges = np.linspace(0, height, shutter.bands + 1).astype(int).tolist()
    picture = np.zeros((y1 - y0, x1 - x0, 3), np.float32)
    samples_per_step = max(1, round(samples / shutter.steps))
    seeds = iter(np.random.SeedSequence([seed, 5]).generate_state(shutter.bands * shutter.steps))
    for top, bottom in zip(edges[:-1], edges[1:], strict=True):
        first, end = max(top, y0), min(bottom, y1)
        read = time + float(shutter.row_delay((top + bottom - 1) / 2, height))
        for step in range(shutter.steps):
            moment, step_seed = read + shutter.exposure * ((step + 0.5) / shutter.steps - 0.5), int(next(seeds))
            if first < end:
                renderer.place(placements(moment))
                part = renderer.render(view(moment), samples_per_step, step_seed, (x0, first, x1, end))
                picture[first - y0 : end - y0] += part / shutter.steps
    return picture


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens with distortion over a pinhole camera that sees as much: the ``pinhole`` is rendered, `distort` does the
    rest.

    ``offset`` (2,) are the ideal pixels of the pinhole's first pixel; ``x`` and ``y`` (H, W) are where each recorded
    pixel lies in its picture, None without distortion.
    """

    pinhole: Camera
    offset: tuple[int, int]
    x: NDArray[np.float32] | None = None
    y: NDArray[np.float32] | None = None

    @staticmethod
    def of(camera: Camera) -> Lens:
        if not camera.has_distortion:
            return Lens(camera, (0, 0))
        width, height = camera.image_size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
        ideal = camera.undistort_points(pixels)
        low = np.floor(ideal.reshape(-1, 2).min(0)).astype(int) - 2  # room for the interpolation
        high = np.ceil(ideal.reshape(-1, 2).max(0)).astype(int) + 2
        K = camera.K.copy()
        K[:2, 2] -= low
        x, y = np.moveaxis((ideal - low).astype(np.float32), -1, 0)
        w, h = (high - low + 1).tolist()
        return Lens(Camera((w, h), K), (int(low[0]), int(low[1])), x, y)

    def distort(self, picture: Radiance) -> Radiance:
        """The picture as recorded, (H, W, 3), of the pinhole's; by cubic interpolation."""
        if self.x is None or self.y is None:
            return picture
        return np.asarray(cv2.remap(picture, self.x, self.y, cv2.INTER_CUBIC), np.float32)


def distort_pixels(camera: Camera, pixels: Array) -> Array:
    """Pixels (…, 2) as recorded of ideal ``pixels`` (…, 2)."""
    if not camera.has_distortion:
        return np.asarray(pixels, float)
    rays = camera.rays(pixels).reshape(-1, 1, 3)
    recorded, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
    return np.asarray(recorded, float).reshape(np.shape(pixels))
