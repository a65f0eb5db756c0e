"""Renders what a chase camera sees: sky, ground, roadside and lead vehicle, through its lens, on its sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.simulation.chase import rasterizer
from paceline.simulation.chase.motion import SmoothNoise
from paceline.simulation.chase.projection import Faces, axis_ahead, draw_faces, face_vectors, join_faces
from paceline.simulation.chase.scene import ChaseScene
from paceline.simulation.chase.scenery import LANE_WIDTH_M, shade_map
from paceline.simulation.chase.world import ChaseWorld, WorldState
from paceline.simulation.road import POLYGON_STEP_M

ROAD_AHEAD_M = 260.0  # length of road ahead that is rendered
MAX_OBJECT_DISTANCE_M = 170.0  # of objects beside the road
ROWS_AT_ONCE = 8  # rows that a rolling shutter exposes at one time, which is off by half of what they take at most

Band = tuple[slice, WorldState]  # rows of the image, and the world as they are exposed


class Renderer:
    """Renders the images of a world, one at a time."""

    def __init__(self, world: ChaseWorld) -> None:
        self.world, self.scene = world, world.scene
        scene, rng = self.scene, np.random.default_rng([world.scene.seed, 23])
        self.sun = world.sun
        self.shade = shade_map(rng, scene.shadows, -world.sun.azimuth)
        self.coarse_shade = np.asarray(cv2.resize(self.shade, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))
        self.noise_texture = rng.standard_normal((256, 256)).astype(np.float32)
        asphalt, verge = rng.uniform(75, 125), rng.uniform(50, 95)
        direct = (1 - self.sun.ambient) * float(scene.shadows > 0 or rng.random() < 0.8)
        self.ground_appearance = np.array(
            [asphalt, verge, 215.0, 1 - direct, direct, rng.uniform(120, 320), rng.uniform(0, 320), LANE_WIDTH_M / 2]
        )
        self.sky_appearance = np.array(
            [rng.uniform(160, 225), rng.uniform(-90, -20), rng.uniform(0, 14), self.sun.azimuth]
        )
        self.skylines = _draw_skylines(rng)
        self.exposure = SmoothNoise(rng, 2.5, 20.0)
        self.noise = np.random.default_rng([scene.seed, 29])
        self.vignette = self._vignette()

    def render(
        self, state: WorldState, state_at: Callable[[float], WorldState] | None = None
    ) -> tuple[NDArray[np.uint8], float]:
        """Image (H, W), and the visible share of the lead's rear plane; each call draws new noise.

        ``state_at`` gives the world at the times, s, at which a rolling shutter exposes the rows; without it all are
        exposed with the middle one.
        """
        bands = [(slice(0, self.scene.image_size[1]), state)]
        if state_at is not None and self.scene.readout:
            bands = [(rows, state_at(state.time + later)) for rows, later in exposure_times(self.scene)]
        grey, hidden = self._render_grey(bands, self._blur(state))
        return self._expose(grey, state.time), self._visible_share(state, hidden)

    def _render_grey(self, bands: Sequence[Band], blur: tuple[float, float]) -> tuple[Image, Image | None]:
        """Grey levels (H, W) before the sensor, and the mask (H, W) of objects that occlude the lead, if any."""
        width, height = self.scene.image_size
        image = np.zeros((height, width, 2), np.float32)
        objects = [self._roadside(state) for _, state in bands]
        for (band, state), (faces, _) in zip(bands, objects, strict=True):
            self._draw_background(image[band], band.start, state, faces)
        grey = np.asarray(cv2.GaussianBlur(image[..., 0], (0, 0), blur[0], sigmaY=blur[1]), np.float32)
        patch = self._lead_window([state for _, state in bands if state.lead_present], blur)
        if patch is None:
            return grey, None
        rows, columns = patch
        lead = self._draw_lead(bands, rows, columns, blur)
        front = np.zeros((rows.stop - rows.start, columns.stop - columns.start, 2), np.float32)
        for (band, state), (faces, distance) in zip(bands, objects, strict=True):
            part = _overlap(band, rows)
            canvas = front[part.start - rows.start : part.stop - rows.start]
            shift = _translation(-columns.start, -part.start)
            before = faces[distance < state.gap]
            draw_faces(canvas, before, self.world.atlas, state.camera, self.sun, self.shade, shift)
        front = np.asarray(cv2.GaussianBlur(front, (0, 0), blur[0], sigmaY=blur[1]), np.float32)
        # front over lead over backdrop, where the backdrop already has the front over it
        under = grey[rows, columns] * (1 - lead[..., 1]) + lead[..., 1] * front[..., 0]
        grey[rows, columns] = under + (1 - front[..., 1]) * lead[..., 0]
        hidden = np.zeros((height, width), np.float32)
        hidden[rows, columns] = front[..., 1]
        return grey, hidden

    def _blur(self, state: WorldState) -> tuple[float, float]:
        """Sigma of the blur in x and y, px: the lens, and the image's motion during the exposure."""
        sweep = np.array(state.image_motion) * self.scene.focal * self.scene.shutter_s
        x, y = np.sqrt(self.scene.blur_sigma**2 + sweep**2 / 12)
        return float(x), float(y)

    def _draw_background(self, image: Image, row: int, state: WorldState, objects: Faces) -> None:
        """Draws sky, ground and ``objects`` into ``image`` (h, W, 2), the rows of the picture from ``row`` on."""
        camera = state.camera
        rays = camera.R.T @ np.linalg.inv(camera.K) @ _translation(0, row)
        rasterizer.draw_sky(
            image, rays, camera.heading, camera.K[0, 0], self.sky_appearance, self.skylines, self.noise_texture
        )
        self._paint_ground(image, rays, state)
        draw_faces(image, objects, self.world.atlas, camera, self.sun, self.shade, _translation(0, -row))

    def _paint_ground(self, image: Image, rays: Array, state: WorldState) -> None:
        camera, chase = state.camera, state.chase
        road = axis_ahead(self.world.road, chase.arc, chase.x, chase.y, camera.heading, ROAD_AHEAD_M)
        shadows, occlusion = self.world.shadow_outlines(state)
        rasterizer.draw_ground(
            image,
            rays,
            camera.height,
            road,
            POLYGON_STEP_M,
            chase.arc,
            self.ground_appearance,
            self.noise_texture,
            self.shade,
            np.asarray(self.coarse_shade, np.float32),
            shadows,
            occlusion,
        )

    def _roadside(self, state: WorldState) -> tuple[Faces, Array]:
        """All objects in view except the lead, the farthest first, and the distance ahead of each, m."""
        roadside = self.world.roadside_faces(state.chase.arc, state.chase.arc + MAX_OBJECT_DISTANCE_M)
        objects = join_faces([roadside, *self.world.moving_faces(state)])
        distance = state.camera.to_level(objects.x, objects.y)[1]
        order = np.argsort(-distance, kind="stable")
        return objects[order], distance[order]

    def _lead_window(self, states: Sequence[WorldState], blur: tuple[float, float]) -> tuple[slice, slice] | None:
        """Rows and columns of the image that the lead may touch; None where it is out of the image."""
        if not states:
            return None
        pixels = np.concatenate([self._lead_corners(state) for state in states])
        pad = 3 + int(np.ceil(4 * max(blur)))
        low = np.maximum(np.floor(pixels.min(0)).astype(int) - pad, 0)
        high = np.minimum(np.ceil(pixels.max(0)).astype(int) + pad + 1, self.scene.image_size)
        return None if (low >= high).any() else (slice(low[1], high[1]), slice(low[0], high[0]))

    def _lead_corners(self, state: WorldState) -> Array:
        """The corners (N, 2) px of all faces of the lead."""
        vectors = face_vectors(self.world.lead_faces(state), state.camera)
        steps = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1.0]])
        corners = state.camera.to_camera(steps @ vectors).reshape(-1, 3) @ state.camera.K.T
        return np.asarray(corners[:, :2] / corners[:, 2:])

    def _draw_lead(self, bands: Sequence[Band], rows: slice, columns: slice, blur: tuple[float, float]) -> Image:
        """Premultiplied grey and coverage (h, w, 2) of the lead."""
        size = columns.stop - columns.start, rows.stop - rows.start
        n = int(np.clip(round(240 / size[0]), 2, 4))
        canvas = np.zeros((size[1] * n, size[0] * n, 2), np.float32)
        painted = len(self.world.body.faces)
        for band, state in bands:
            part = _overlap(band, rows)
            strip = canvas[n * (part.start - rows.start) : n * (part.stop - rows.start)]
            # The centre of sub-pixel p lies at (p + 0.5) / n - 0.5 in the strip.
            to_strip = np.array([[n, 0, 0], [0, n, 0], [0, 0, 1.0]])
            to_strip[:2, 2] = n * (0.5 - np.array([columns.start, part.start])) - 0.5
            faces = self.world.lead_faces(state)
            arguments = (self.world.atlas, state.camera, self.sun, self.shade, to_strip)
            draw_faces(strip, faces[:painted], *arguments)
            draw_faces(strip, faces[painted:], *arguments, emission=2.2 if state.braking else 0.0)
        canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), blur[0] * n, sigmaY=blur[1] * n), np.float32)
        return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), np.float32)

    def _vignette(self) -> Image:
        width, height = self.scene.image_size
        v, u = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        return np.asarray((1 - self.scene.vignetting * (u**2 + v**2) / 2) * self.scene.exposure, np.float32)

    def _expose(self, grey: Image, time: float) -> NDArray[np.uint8]:
        """The sensor's image of the grey levels."""
        gain = np.float32(1 + self.scene.exposure_drift * self.exposure(time))
        level = np.minimum(grey * self.vignette * gain, 262)
        noise = self.noise.standard_normal(level.shape, np.float32)
        level += noise * np.sqrt(self.scene.noise_sigma**2 + self.scene.shot_noise * np.maximum(level, 0))
        return np.asarray(np.clip(np.rint(level), 0, 255), np.uint8)

    def _visible_share(self, state: WorldState, hidden: Image | None) -> float:
        """The part of the rear plane's area that is inside the image and not hidden."""
        x, y = (np.float64(v) for v in state.corners.T)
        area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
        if hidden is None:
            return 0.0
        mask = np.zeros(hidden.shape, np.float32)
        cv2.fillConvexPoly(mask, np.round(state.corners * 16).astype(np.int32), 1.0, cv2.LINE_AA, 4)
        return float(min((mask * (1 - np.minimum(hidden, 1))).sum() / area, 1.0))


def exposure_times(scene: ChaseScene) -> list[tuple[slice, float]]:
    """The rows that a rolling shutter exposes together, from the top down, and how long after the frame's time, s."""
    height = scene.image_size[1]
    bands = [slice(row, min(row + ROWS_AT_ONCE, height)) for row in range(0, height, ROWS_AT_ONCE)]
    return [(band, scene.readout * (0.5 * (band.start + band.stop - 1) / (height - 1) - 0.5)) for band in bands]


def _overlap(band: slice, rows: slice) -> slice:
    """The part of ``rows`` that lies in a ``band``; empty where there is none."""
    start = min(max(band.start, rows.start), rows.stop)
    return slice(start, max(start, min(band.stop, rows.stop)))


def _translation(right: float, down: float) -> Array:
    """(3, 3): a shift of pixels."""
    return np.array([[1.0, 0.0, right], [0.0, 1.0, down], [0.0, 0.0, 1.0]])


def _draw_skylines(rng: np.random.Generator) -> Array:
    """Slopes of a far and a near skyline over a full turn, and their grey levels in the last column."""
    azimuth = np.linspace(0, 2 * np.pi, 2048, endpoint=False)
    far = sum(rng.uniform(0, 0.014) * np.sin(k * azimuth + rng.uniform(0, 2 * np.pi)) for k in (3, 7, 13, 29))
    near = np.repeat(rng.uniform(0.005, 0.045, 256), 8) * np.repeat(rng.random(128) < 0.6, 16)
    near = near + 0.006 * np.abs(rng.standard_normal(2048))
    return np.vstack([np.append(0.03 + far, rng.uniform(110, 150)), np.append(near, rng.uniform(55, 95))])
