"""What makes vehicles hard to find, painted on rendered pictures: moving shadows, bushes in the wind, rain, night."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.cameras import PosedCamera
from paceline.simulation import textures
from paceline.simulation.stereo.clip import Vehicle, World
from paceline.simulation.stereo.scene import PlacedRoad, Pose
from paceline.simulation.stereo.textured_planes import TexturedPlane, composite, draw_planes

Array = NDArray[np.float64]
Image = NDArray[np.float32]

TEXELS = 24.0  # per metre, of a shadow
DAYLIGHT = 0.07  # of it, left at night
LAMPS = (0.38, 0.3)  # from the middle and down, in parts of a face's width and height


@dataclass(frozen=True, eq=False)
class Shade:
    """A shadow on the road: how much light it leaves, ``light`` (H, W), over ``size`` (along, across) m about the arc
    length ``s`` and the lateral position ``x`` at time 0. It slides with ``velocity`` (along, across) m/s and swings by
    ``swing`` m at ``frequency`` Hz."""

    light: Image
    size: tuple[float, float]
    s: float
    x: float
    velocity: tuple[float, float] = (0.0, 0.0)
    swing: float = 0.0
    frequency: float = 0.0

    def cast(self, image: Image, road: PlacedRoad, view: PosedCamera, t: float) -> None:
        """Darken the part of ``image`` (H, W) on which it lies at time ``t``, in place."""
        swing = self.swing * np.sin(2 * np.pi * self.frequency * t)
        s, x = self.s + self.velocity[0] * t + swing, self.x + self.velocity[1] * t + swing
        half = 0.5 * np.array(self.size)
        arcs = np.array([s + half[0], s + half[0], s - half[0], s - half[0]])
        corners = road.point(arcs, x + np.array([-1, 1, 1, -1]) * half[1])
        if view.depth(corners).min() < 2.0:
            return
        h, w = self.light.shape
        source = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32) - np.float32(0.5)
        pixels = view.project(corners).astype(np.float32)
        low = np.maximum(np.floor(pixels.min(0)).astype(int), 0)
        high = np.minimum(np.ceil(pixels.max(0)).astype(int) + 1, image.shape[::-1])
        if (low >= high).any():
            return
        H = cv2.getPerspectiveTransform(source, pixels - low.astype(np.float32))
        size = int(high[0] - low[0]), int(high[1] - low[1])
        light = cv2.warpPerspective(self.light, H, size, flags=cv2.INTER_LINEAR, borderValue=1.0)
        image[low[1] : high[1], low[0] : high[0]] *= light


def blot(rng: np.random.Generator, along: float, across: float, darkest: float, dapples: float = 0.0) -> Image:
    """The light that a rounded shadow leaves, with as many sunny ``dapples`` per m² as below a tree."""
    h, w = max(8, round(along * TEXELS)), max(8, round(across * TEXELS))
    y, x = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j]
    edge = 1 + 0.25 * cv2.resize(rng.uniform(-1, 1, (5, 5)), (w, h), interpolation=cv2.INTER_CUBIC)
    light = np.where(x**2 + y**2 < 0.6 * edge, darkest, 1.0).astype(np.float32)
    for _ in range(int(dapples * along * across)):
        centre = rng.integers(0, [w, h])
        cv2.circle(light, (int(centre[0]), int(centre[1])), int(rng.integers(1, 5)), 1.0, -1)
    light[[0, -1]], light[:, [0, -1]] = 1.0, 1.0
    return np.asarray(cv2.GaussianBlur(light, (0, 0), 1.2), np.float32)


def shades(world: World, rng: np.random.Generator, seconds: float) -> list[Shade]:
    """Shadows of clouds, of birds and of trees in the wind, some of which drive along a lane like a vehicle."""
    lanes, found = sorted({v.lane for v in world.scene.vehicles}), []
    for _ in range(4):
        size = rng.uniform(1.2, 8.0), rng.uniform(1.0, 3.0)
        along, lane = rng.choice([-1, 1]) * rng.uniform(4, 22), float(rng.choice(lanes))
        start = rng.uniform(15, 60) - along * rng.uniform(0.2, 0.8) * seconds
        found.append(
            Shade(blot(rng, *size, rng.uniform(0.35, 0.75)), size, start, lane + rng.normal(0, 0.5), (along, 0.0))
        )
    for _ in range(2):
        size = rng.uniform(3.0, 7.0), rng.uniform(3.0, 7.0)
        place = rng.uniform(15, 50), float(rng.choice(lanes)) + rng.uniform(-2, 2)
        light = blot(rng, *size, rng.uniform(0.4, 0.7), dapples=6.0)
        found.append(Shade(light, size, *place, swing=rng.uniform(0.05, 0.3), frequency=rng.uniform(0.2, 0.7)))
    return found


@dataclass(frozen=True, eq=False)
class Bush:
    """Leaves beside the road that swing by ``swing`` m at ``frequency`` Hz."""

    card: TexturedPlane
    swing: float
    frequency: float
    phase: float

    def wave(self, image: Image, view: PosedCamera, t: float) -> None:
        a = 2 * np.pi * self.frequency * t + self.phase
        offset = self.swing * (np.sin(a) * self.card.across / np.linalg.norm(self.card.across))
        lift = 0.3 * self.swing * np.cos(1.7 * a) * self.card.down / np.linalg.norm(self.card.down)
        composite(image, draw_planes([replace(self.card, corner=self.card.corner + offset + lift)], view, 0.6, 1))


def bushes(world: World, rng: np.random.Generator) -> list[Bush]:
    """Bushes beside the outermost lanes, near enough to reach into the cards that stand there."""
    lanes, found = sorted({v.lane for v in world.scene.vehicles}), []
    for depth in np.sort(rng.uniform(14, 60, 6))[::-1]:
        width, height, side = rng.uniform(0.8, 2.5), rng.uniform(1.0, 3.0), rng.choice([-1, 1])
        lateral = (lanes[0] if side < 0 else lanes[-1]) + side * (1.9 + 0.5 * width)
        foot = world.road.point(np.array(depth), lateral)
        across, down = world.road.level[:, 0] * width, world.road.down * height
        card = TexturedPlane(textures.tree_texture(rng, width, height), foot - across / 2 - down, across, down)
        found.append(Bush(card, rng.uniform(0.05, 0.35), rng.uniform(0.3, 1.2), rng.uniform(0, 6)))
    return found


def rain(image: Image, rng: np.random.Generator, drops: int) -> None:
    """Streaks of falling drops, which every view and frame shows elsewhere, and a veil, in place."""
    height, width = image.shape
    image *= 0.8
    image += 30
    for x, y in rng.integers(0, [width, height], (drops, 2)).tolist():
        long, bright = int(rng.integers(4, 18)), float(rng.uniform(8, 35))
        image[y : y + long, x : x + 1 + (bright > 28)] += bright


def night(image: Image, world: World, i: int, k: int) -> None:
    """The picture of view ``i`` in frame ``k`` without the sun, by the vehicles' own lamps, in place. What a nearer
    vehicle hides does not shine, nor does it dazzle."""
    view = world.views[i]
    image *= DAYLIGHT
    hidden = np.zeros(image.shape, np.uint8)
    poses = [(vehicle, track[k]) for vehicle, track in zip(world.scene.vehicles, world.poses[i], strict=True)]
    for vehicle, pose in sorted(poses, key=lambda each: float(view.depth(each[1].centre))):
        if view.depth(pose.centre) >= 3.0:
            _shine(image, world, view, vehicle, pose, hidden)
        corners = body(vehicle, pose)
        if view.depth(corners).min() > 0.5:
            fill(hidden, view.project(corners))


def _shine(
    image: Image, world: World, view: PosedCamera, vehicle: Vehicle, pose: Pose, hidden: NDArray[np.uint8]
) -> None:
    """The light of a vehicle's lamps but for what is ``hidden`` of it, in place."""
    peak, size = (45.0, 0.09) if vehicle.receding else (700.0, 0.12)
    for side in (-1, 1):
        spot = np.array([side * LAMPS[0] * vehicle.width, LAMPS[1] * vehicle.height])
        centre = pose.centre + pose.axes[:, :2] @ spot
        at, sigma = view.project(centre), size * view.camera.K[0, 0] / float(view.depth(centre))
        blur = np.hypot(sigma, world.scene.blur_sigma)
        shown = _glow(image, at, blur, peak * (sigma / blur) ** 2, hidden)
        if not vehicle.receding:
            _glow(image, at, 5 * sigma, 0.05 * peak * shown, None)
            ahead = centre + world.road.down * 0.6 - 4.0 * pose.axes[:, 2]
            if view.depth(ahead) > 3.0:
                _glow(image, view.project(ahead), 7 * sigma, 0.03 * peak, hidden)


def body(vehicle: Vehicle, pose: Pose) -> Array:
    """The corners (4, 3) of a vehicle's face with what stands above it."""
    centre = pose.centre - pose.axes[:, 1] * 0.5 * vehicle.height
    return replace(pose, centre=centre).corners(1.1 * vehicle.width, 2.2 * vehicle.height)


def fill(mask: NDArray[np.uint8], corners: Array) -> None:
    """Mark what lies between ``corners`` (4, 2), px, in a ``mask``, in place."""
    cv2.fillConvexPoly(mask, np.clip(corners, -1e4, 1e4).round().astype(np.int32), 1)


def _glow(image: Image, at: Array, sigma: float, peak: float, hidden: NDArray[np.uint8] | None) -> float:
    """Light but for what is ``hidden``, in place, and the share of it that is not; all of it where it lies outside the
    picture, since nothing is known to hide it."""
    reach = int(np.ceil(3.5 * sigma))
    x, y = at.round().astype(int)
    rows, columns = slice(max(y - reach, 0), max(y + reach, 0)), slice(max(x - reach, 0), max(x + reach, 0))
    part = image[rows, columns]
    if not part.size:
        return 1.0
    v, u = np.ogrid[rows.start : rows.start + part.shape[0], columns.start : columns.start + part.shape[1]]
    across, down = np.exp(-((u - at[0]) ** 2) / (2 * sigma**2)), np.exp(-((v - at[1]) ** 2) / (2 * sigma**2))
    light = across * down
    shown = light if hidden is None else light * (hidden[rows, columns] == 0)
    part += (peak * shown).astype(np.float32)
    return float(shown.sum() / light.sum())
