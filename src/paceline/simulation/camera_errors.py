"""What is not ideal about the two cameras of a simulated stereo clip, and what their pictures show for it.

No file of a clip says any of it but truth.json, which has what the pictures show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import Camera, PosedCamera, StereoRig

SWAY_BANDS_HZ = ((0.85, 1.2), (1.3, 1.8), (2.0, 3.2), (4.0, 5.0))  # one mode of a mast about each axis is drawn of each
SWAY_MODE_SHARES = (1.0, 0.35, 0.2, 0.12)  # amplitudes of these modes
MAX_MOTION_IN_BAND_PX = 0.1  # while rows are read that are drawn as if at one time
ROW_TIME_ITERATIONS = 8  # each leaves the share of a picture that a point moves by while it is read
DIRT_RADII_PX = 8.0, 40.0  # of specks on a lens, far out of focus
DIRT_OPACITIES = 0.15, 0.5  # the light that they take in their middle
DROP_RADII_PX = 10.0, 50.0  # of drops of rain on a lens
DROP_BLUR_PX = 12.0  # standard deviation of the blur of what is seen through one
EXPOSURE_ADAPTATION_FRAMES = 1.5  # time constant of an automatic exposure


@dataclass(frozen=True)
class CameraErrors:
    """What is not ideal about one camera.

    ``readout``: time from the first row's exposure to the last one's, s, negative from the bottom up; a frame's time is
    its middle row's. ``zoom``: relative error of the focal length in rig.yaml, true = stated × (1 + zoom). ``turn``:
    about the camera's x, y, z since its calibration, rad. ``drift`` (px per frame) and ``knock`` (px, from the frame
    ``knock_frame`` on): how far the picture moves to the right and down, in its middle, because the camera turns.
    ``dirt`` and ``rain``: shares of the picture that lie behind specks and behind drops on the lens. ``exposure_step``:
    relative change of the exposure, made automatically from the frame ``exposure_frame`` on.
    """

    readout: float = 0.0
    zoom: float = 0.0
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drift: tuple[float, float] = (0.0, 0.0)
    knock: tuple[float, float] = (0.0, 0.0)
    knock_frame: int = 0
    dirt: float = 0.0
    rain: float = 0.0
    exposure_step: float = 0.0
    exposure_frame: int = 0


@dataclass(frozen=True)
class StereoErrors:
    """What is not ideal about the two cameras of a clip.

    ``offset``: the right camera exposes later by that, s, and ``rate_ppm``: its clock is slower by that, ppm. ``sway``:
    standard deviation of the mast's rotation about each axis, rad. ``crf``: the quality at which H.264 keeps the
    pictures, 0 (best) to 51; None where they are kept as images.
    """

    left: CameraErrors = CameraErrors()
    right: CameraErrors = CameraErrors()
    offset: float = 0.0
    rate_ppm: float = 0.0
    sway: float = 0.0
    crf: int | None = None

    @property
    def cameras(self) -> tuple[CameraErrors, CameraErrors]:
        return self.left, self.right

    def exposure_times(self, clocks: tuple[Array, Array]) -> tuple[Array, Array]:
        """Times (F,) s at which both cameras expose, of those that their ``clocks`` (F,) say."""
        left, right = clocks
        if self.offset or self.rate_ppm:
            right = right * (1 + 1e-6 * self.rate_ppm) + self.offset
        return left, right

    def true_rig(self, rig: StereoRig) -> StereoRig:
        """What has become of a ``rig`` since its calibration."""
        if not any(c.zoom or any(c.turn) for c in self.cameras):
            return rig
        left, right = (_zoomed(c, e.zoom) for c, e in zip(rig.cameras, self.cameras, strict=True))
        turns = [_rotation(np.array(e.turn)) for e in self.cameras]
        return replace(rig, left=left, right=right, R=turns[1] @ rig.R @ turns[0].T, t=turns[1] @ rig.t)


class MovingViews:
    """Two views that move as `StereoErrors` say, each about its camera's own centre, and what they show.

    ``views`` are both at rest, as they are at time 0; they take ``rate`` frames/s. The same ``seed`` gives the same
    sway.
    """

    def __init__(self, views: tuple[PosedCamera, PosedCamera], errors: StereoErrors, rate: float, seed: int) -> None:
        self.views, self.errors, self.rate = views, errors, rate
        rng = np.random.default_rng([seed, 29])
        frequency = np.stack([rng.uniform(low, high, 3) for low, high in SWAY_BANDS_HZ])  # (modes, axes) Hz
        self._pulsation, self._phase = 2 * np.pi * frequency, rng.uniform(0, 2 * np.pi, frequency.shape)
        shares = np.array(SWAY_MODE_SHARES)[:, None]
        self._amplitude = errors.sway * shares * np.sqrt(2 / (shares**2).sum())

    def sway(self, t: float) -> Array:
        """The mast's rotation vector (3,) about the left camera's axes at ``t`` s, against time 0, rad."""
        swing = np.sin(self._pulsation * t + self._phase) - np.sin(self._phase)
        return np.asarray((self._amplitude * swing).sum(0))

    def rotation(self, i: int, t: float) -> Array:
        """The rotation (3, 3) of view ``i`` at ``t`` s against time 0, in its own axes: X_camera(t) = D X_camera(0)."""
        errors, K = self.errors.cameras[i], self.views[i].camera.K
        between = self.views[i].R @ self.views[0].R.T  # from the left camera's axes to those of this one
        moved = np.array(errors.drift) * self.rate * t
        if t * self.rate > errors.knock_frame - 0.5:
            moved = moved + np.array(errors.knock)
        own = np.array([-moved[1] / K[1, 1], moved[0] / K[0, 0], 0.0])
        return np.asarray(_rotation(own) @ between @ _rotation(self.sway(t)) @ between.T)

    def moves(self, i: int) -> bool:
        """Whether view ``i`` does not stand still."""
        errors = self.errors.cameras[i]
        return bool(self.errors.sway or any(errors.drift) or any(errors.knock))

    def view(self, i: int, t: float) -> PosedCamera:
        """View ``i`` at ``t`` s."""
        rest = self.views[i]
        if not self.moves(i):
            return rest
        D = self.rotation(i, t)
        return PosedCamera(rest.camera, D @ rest.R, D @ rest.t)

    def project(self, i: int, t: float, points: Callable[[float], Array]) -> Array:
        """Ideal pixels (…, 2) of ``points`` (…, 3), world at a time, in view ``i`` of a frame of time ``t``: each where
        it is as its row is read."""
        readout, height = self.errors.cameras[i].readout, self.views[i].camera.image_size[1]
        return project_by_row(lambda s: self.view(i, s).project(points(s)), t, readout, height)

    def static_bands(self, i: int, t: float) -> Iterator[tuple[slice, float, PosedCamera]]:
        """The rows of view ``i`` in bands in which what stands still moves by less than `MAX_MOTION_IN_BAND_PX`, with
        the time and the view of each, in a frame of time ``t``."""
        readout, camera = self.errors.cameras[i].readout, self.views[i].camera
        width, height = camera.image_size
        corners = camera.rays(np.array([[0, 0], [width, 0], [0, height], [width, height]], float))
        first, last = (camera.project(corners @ self.rotation(i, t + s * readout).T) for s in (-0.5, 0.5))
        motion = np.linalg.norm(last - first, axis=1).max() if self.moves(i) else 0.0
        for rows, delay in row_bands(0, height, float(motion), readout, height):
            yield rows, t + delay, self.view(i, t + delay)


def row_delay(row: Array | float, readout: float, height: int) -> Array:
    """Seconds (…) from a frame's time to that at which its ``row`` (…) of ``height`` is read."""
    return np.asarray(readout * ((np.asarray(row) + 0.5) / height - 0.5))


def project_by_row(project: Callable[[float], Array], t: float, readout: float, height: int) -> Array:
    """Pixels (…, 2) of what a camera shows at ``project(time)`` in a frame of time ``t``: each where it is as its row
    is read. In between, it moves on a parabola through where it is as the first, the middle and the last row are."""
    middle = project(t)
    if not readout:
        return middle
    first, last = project(t - readout / 2), project(t + readout / 2)
    pixels = middle
    for _ in range(ROW_TIME_ITERATIONS):
        share = row_delay(pixels[..., 1:], 2.0, height).clip(-2, 2)  # -1 in the first row, 1 in the last one
        pixels = middle + share * (last - first) / 2 + share**2 * (last - 2 * middle + first) / 2
    return np.asarray(pixels)


def row_bands(top: int, bottom: int, motion: float, readout: float, height: int) -> list[tuple[slice, float]]:
    """The rows from ``top`` to before ``bottom`` in bands with each one's seconds after the frame's time, such that
    what moves by ``motion`` px during ``readout`` moves by less than `MAX_MOTION_IN_BAND_PX` within one."""
    count = max(1, int(np.ceil(motion * (bottom - top) / height / MAX_MOTION_IN_BAND_PX))) if readout else 1
    edges = np.unique(np.linspace(top, bottom, count + 1).round().astype(int)).tolist()
    delays = [float(row_delay((a + b - 1) / 2, readout, height)) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    return [(slice(a, b), delay) for a, b, delay in zip(edges[:-1], edges[1:], delays, strict=True)]


class RecordedLight:
    """What is left of the light (H, W) or (H, W, C) that falls on the lens of view ``i``, of a ``size`` (width, height)
    px, as it is recorded: behind specks and drops, with the exposure of its frame."""

    def __init__(self, errors: CameraErrors, size: tuple[int, int], seed: int, i: int) -> None:
        self.errors = errors
        self._size, self._seed, self._view = size, seed, i

    @cached_property
    def _passed(self) -> Image:
        return 1 - _specks(self.errors.dirt, DIRT_RADII_PX, DIRT_OPACITIES, self._size, [self._seed, 31, self._view])

    @cached_property
    def _behind_drops(self) -> Image:
        return _specks(self.errors.rain, DROP_RADII_PX, (1.0, 1.0), self._size, [self._seed, 37, self._view])

    def exposure(self, frame: int) -> float:
        """The exposure of a ``frame`` over that of the first one."""
        since = max(frame - self.errors.exposure_frame + 1, 0)
        return 1.0 + self.errors.exposure_step * (1.0 - float(np.exp(-since / EXPOSURE_ADAPTATION_FRAMES)))

    def __call__(self, light: Image, frame: int) -> Image:
        """The ``light`` of a ``frame`` as it is recorded."""
        if self.errors.rain:
            blurred = cv2.GaussianBlur(light, (0, 0), DROP_BLUR_PX)
            light = light + self._shaped(self._behind_drops, light) * (blurred - light)
        if self.errors.dirt:
            light = light * self._shaped(self._passed, light)
        return np.asarray(light * np.float32(self.exposure(frame)), np.float32) if self.errors.exposure_step else light

    @staticmethod
    def _shaped(mask: Image, light: Image) -> Image:
        return mask.reshape(*mask.shape, *(1,) * (light.ndim - 2))


def _specks(
    share: float, radii: tuple[float, float], opacities: tuple[float, float], size: tuple[int, int], seed: list[int]
) -> Image:
    """The opacity (H, W) of specks that cover a ``share`` of a picture, with ``radii`` (px) and ``opacities`` between
    these."""
    rng, (width, height) = np.random.default_rng(seed), size
    passed = np.ones((height, width), np.float32)
    v, u = np.mgrid[:height, :width].astype(np.float32)
    while (passed < 1).mean() < share:
        x, y, radius = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(*radii)
        depth = np.clip(1 - ((u - x) ** 2 + (v - y) ** 2) / radius**2, 0, 1)
        passed *= 1 - np.float32(rng.uniform(*opacities)) * depth
    return 1 - passed


def _zoomed(camera: Camera, zoom: float) -> Camera:
    return replace(camera, K=camera.K * [[1 + zoom, 1 + zoom, 1], [1, 1 + zoom, 1], [1, 1, 1]])


def _rotation(vector: Array) -> Array:
    return np.asarray(cv2.Rodrigues(vector)[0], float)
