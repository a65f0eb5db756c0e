"""The static background of a stereo scene: sky, road and its markings, buildings, trees and poles."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import PosedCamera
from paceline.simulation import textures
from paceline.simulation.stereo.scene import PlacedRoad, Pose, Scene
from paceline.simulation.stereo.textured_planes import TexturedPlane, composite, draw_planes

LANE_EDGE_M = 1.85  # m from a lane's centre to the marks on either side
STEREO_SHOULDER_WIDTH_M = 0.9  # m of asphalt beyond the outermost marks
MIN_RAY_SLOPE = 1e-3  # slope of the steepest ray that counts as seeing the ground


class StaticBackground:
    """A scene's standing surroundings; ``draw(view)`` gives their grey levels (H, W)."""

    def __init__(self, scene: Scene, road: PlacedRoad, seed: int) -> None:
        rng = np.random.default_rng([seed, 11])
        self.scene, self.road = scene, road
        self.lanes = sorted({v.lane for v in scene.vehicles})
        self.grain = rng.standard_normal((256, 256)).astype(np.float32)
        self.sky, self.asphalt, self.grass = rng.uniform(150, 215), rng.uniform(70, 100), rng.uniform(55, 85)
        self.cards = _place_roadside(scene, road, self.lanes, rng)

    def draw(self, view: PosedCamera, within: slice | None = None) -> Image:
        """Grey levels (H, W), or (h, W) of the rows ``within`` alone."""
        width, height = self.scene.image_size
        pad = 2 + int(np.ceil(4 * self.scene.blur_sigma))
        top, bottom = (0, height) if within is None else (max(within.start - pad, 0), min(within.stop + pad, height))
        u, v = np.meshgrid(np.arange(width), np.arange(top, bottom))
        rays = (np.stack([u, v, np.ones_like(u)], -1) @ view.camera.K_inv.T @ view.R).astype(np.float32)
        fall = rays @ self.road.down.astype(np.float32)
        image: Image = (self.sky + 260 * fall).astype(np.float32)
        rows = np.flatnonzero((fall > MIN_RAY_SLOPE).any(axis=1))
        if len(rows):
            below = slice(min(int(rows[0]), len(rays) - 2), None)  # slopes take two rows
            ground = self._ground(view, rays[below], np.maximum(fall[below], MIN_RAY_SLOPE))
            image[below] = np.where(fall[below] > MIN_RAY_SLOPE, ground, image[below])
        picture = np.empty((height, width), np.float32)
        picture[top:bottom] = cv2.GaussianBlur(image, (0, 0), max(self.scene.blur_sigma, 0.3))
        for card in self.cards:
            composite(picture, draw_planes([card], view, self.scene.blur_sigma, 2, within))
        return picture if within is None else picture[within]

    def _ground(self, view: PosedCamera, rays: Image, fall: Image) -> Image:
        """Grey levels of the ground along ``rays`` (h, w, 3), whose components downwards are ``fall`` (h, w)."""
        centre = view.centre
        distance = float((self.road.anchor - centre) @ self.road.down) / fall
        arc, lateral = (c.astype(np.float32) for c in self.road.coordinates(centre + distance[..., None] * rays))
        across = distance / self.scene.focal  # metres per pixel, across and along the line of sight
        pixel_length = across / fall
        left, right = self.lanes[0] - LANE_EDGE_M, self.lanes[-1] + LANE_EDGE_M
        paved = _box_coverage(lateral, left - STEREO_SHOULDER_WIDTH_M, right + STEREO_SHOULDER_WIDTH_M, across)
        surface = self.grass + (self.asphalt - self.grass) * paved
        for wavelength, amplitude in ((4.0, 0.05), (0.7, 0.05), (0.12, 0.06)):
            noise = cv2.remap(
                self.grain,
                np.mod(arc * (2 / wavelength), 256),
                np.mod(lateral * (2 / wavelength), 256),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_WRAP,
            )
            surface = surface * (1 + amplitude * np.exp(-((pixel_length / wavelength) ** 2)) * noise)
        sideways, lengthways = _pixel_gradient(lateral), _pixel_gradient(arc)
        marks = np.zeros_like(surface)
        for edge in sorted({round(lane + side, 3) for lane in self.lanes for side in (-LANE_EDGE_M, LANE_EDGE_M)}):
            line = _box_coverage(lateral, edge - 0.06, edge + 0.06, sideways)
            if left + 0.01 < edge < right - 0.01:
                line *= _box_coverage(np.mod(arc, 9.0), 3.0, 6.0, lengthways)
            marks = np.maximum(marks, line)
        return np.asarray(surface + (205 - surface) * 0.9 * marks, np.float32)


def make_occluder(road: PlacedRoad, poses: list[Pose], rng: np.random.Generator) -> TexturedPlane:
    """A pole that stands between the camera and the place of a vehicle half-way through its ``poses``."""
    target = poses[len(poses) // 2]
    foot = target.centre * rng.uniform(0.55, 0.7)
    foot = foot + road.down * (road.down @ (road.anchor - foot))
    width, height = rng.uniform(0.08, 0.16), 7.0
    return _upright_plane(textures.pole_texture(rng, width, height), road, foot, width, height)


def _box_coverage(values: Image, low: float, high: float, slope: Image) -> Image:
    """The part of each pixel in which ``values``, changing by ``slope`` over a pixel, lie between low and high."""
    upper = np.minimum(high, values + slope / 2)
    lower = np.maximum(low, values - slope / 2)
    return np.asarray(np.clip((upper - lower) / slope, 0, 1), np.float32)


def _pixel_gradient(values: Image) -> Image:
    """The change of ``values`` (H, W) from a pixel to the next, at least a millimetre."""
    return np.asarray(np.clip(np.hypot(np.gradient(values, axis=0), np.gradient(values, axis=1)), 1e-3, 1e3))


def _place_roadside(
    scene: Scene, road: PlacedRoad, lanes: list[float], rng: np.random.Generator
) -> list[TexturedPlane]:
    """Upright cards beside the road and behind it, the farthest first."""
    placed: list[tuple[float, TexturedPlane]] = []
    half_view = scene.image_size[0] / 2 / scene.focal
    for make, count, depths, widths, heights in (
        (textures.building_texture, 5, (110, 220), (12, 35), (7, 18)),
        (textures.tree_texture, 7, (45, 200), (5, 10), (6, 12)),
        (textures.pole_texture, 4, (35, 110), (0.16, 0.3), (5, 9)),
    ):
        for _ in range(count):
            z, width, height = rng.uniform(*depths), rng.uniform(*widths), rng.uniform(*heights)
            x = rng.uniform(-1.15, 1.15) * half_view * z
            foot = road.level @ np.array([x, scene.camera_height, z])
            _, lateral = road.coordinates(foot)
            if make is textures.building_texture or not lanes[0] - 4 < lateral < lanes[-1] + 4:
                placed.append((z, _upright_plane(make(rng, width, height), road, foot, width, height)))
    return [card for _, card in sorted(placed, key=lambda item: -item[0])]


def _upright_plane(
    texture: textures.Texture, road: PlacedRoad, foot: Array, width: float, height: float
) -> TexturedPlane:
    """A card that stands on the ground at ``foot`` (3,), facing the cameras."""
    across, down = road.level[:, 0] * width, road.down * height
    return TexturedPlane(texture, foot - across / 2 - down, across, down)
