"""Textures of the ground, in linear reflectance, that repeat without a seam: asphalt, road paint, grass."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.arrays import Image
from paceline.simulation.raytraced.meshes import Texture


def mottle(rng: np.random.Generator, shape: tuple[int, int], grain: float) -> Image:
    """Smooth noise (H, W) of unit variance with features of about ``grain`` texels, the same at opposite borders."""
    cells = [max(2, round(3 * n / max(grain, 3.0))) for n in shape]
    pad = 8
    white = np.pad(rng.standard_normal(cells, np.float32), pad, mode="wrap")
    coarse = cv2.GaussianBlur(white, (0, 0), grain * cells[0] / shape[0] / 2)
    scale = np.array(cells) / shape
    to_cells = np.array([[scale[1], 0, 0.5 * scale[1] - 0.5 + pad], [0, scale[0], 0.5 * scale[0] - 0.5 + pad]])
    noise = cv2.warpAffine(coarse, to_cells, shape[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
    return np.asarray(noise / noise.std(), np.float32)


def smoothstep(x: Image, low: float, high: float) -> Image:
    """0 below ``low``, 1 above ``high``, smooth between."""
    u = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(u * u * (3 - 2 * u), np.float32)


def asphalt_texture(
    rng: np.random.Generator, width: float, length: float, tracks: list[float], density: float, reflectance: float
) -> Texture:
    """A stretch of asphalt (H, W, 3), ``width`` m across and ``length`` m along the rows, ``density`` texels per metre.

    Stones and pores, blotches, and at each of the ``tracks`` (m from the left border) the polish of tyres.
    """
    shape = round(length * density), round(width * density)
    stones = mottle(rng, shape, 1.0) + 0.6 * mottle(rng, shape, 2.5)
    value = 1 + 0.13 * stones - 0.35 * smoothstep(mottle(rng, shape, 2.0), 1.7, 2.4)
    value += 0.045 * mottle(rng, shape, 0.3 * density) + 0.04 * mottle(rng, shape, 1.2 * density)
    across = (np.arange(shape[1]) + 0.5) / density
    polish = np.sum([np.exp(-(((across - x) / 0.22) ** 2)) for x in tracks], axis=0)
    value *= 1 + rng.uniform(-0.2, 0.14) * polish * (1 + 0.25 * mottle(rng, shape, 0.6 * density))
    value *= 1 - _draw_cracks(rng, shape, density)
    grey = reflectance * np.clip(value, 0.15, 3.0)
    tint = np.array([1.0, rng.uniform(0.97, 1.0), rng.uniform(0.92, 1.0)])
    return np.asarray(grey[..., None] * tint, np.float32)


def _draw_cracks(rng: np.random.Generator, shape: tuple[int, int], density: float) -> Image:
    """How much darker cracks make a surface (H, W): a few wandering lines, mostly along or across."""
    lines = np.zeros((shape[0], 3 * shape[1]), np.uint8)  # wide enough that cracks may leave on both sides
    for _ in range(rng.poisson(3.0)):
        steps = int(rng.uniform(40, 160))
        heading = rng.choice([0.0, np.pi / 2]) + np.cumsum(rng.normal(0, 0.25, steps)) * 0.5
        step = 0.04 * density
        start = rng.uniform([shape[1], 0], [2 * shape[1], shape[0]])
        path = start + np.cumsum(step * np.column_stack([np.cos(heading), np.sin(heading)]), 0)
        for shift in (-shape[0], 0, shape[0]):  # it comes in again where it goes out
            points = np.round(16 * (path + [0, shift])).astype(np.int32)
            cv2.polylines(lines, [points], False, 255, 1 + int(rng.random() < 0.3), cv2.LINE_AA, 4)
    inner = lines[:, shape[1] : 2 * shape[1]].astype(np.float32) / 255
    return np.asarray(0.6 * inner * smoothstep(mottle(rng, shape, 8.0), -1.2, 0.3), np.float32)


def road_paint_texture(
    rng: np.random.Generator, width: float, length: float, density: float, wear: float, ground: float
) -> Texture:
    """A painted line (H, W, 3) through whose worn places the asphalt of reflectance ``ground`` shows."""
    shape = round(length * density), max(8, round(width * density))
    noise = mottle(rng, shape, 2.0) + 0.8 * mottle(rng, shape, 0.05 * density) + 0.7 * mottle(rng, shape, 0.4 * density)
    limit = np.quantile(noise, 1 - 0.9 * wear) if wear > 0 else np.inf
    wear_share = smoothstep(noise, limit - 0.4, limit + 0.6) if wear > 0 else np.zeros(shape, np.float32)
    paint = rng.uniform(0.42, 0.58) * (1 - 0.25 * wear) * (1 + 0.05 * mottle(rng, shape, 0.1 * density))
    under = ground * (1 + 0.2 * mottle(rng, shape, 1.0))
    grey = np.clip(paint * (1 - wear_share) + under * wear_share, 0.02, 0.8)
    return np.asarray(grey[..., None] * np.array([1.0, 0.99, 0.95]), np.float32)


def grass_texture(rng: np.random.Generator, side: int = 768) -> Texture:
    """Short grass with dry spots (H, W, 3), meant for about 10 m."""
    shape = (side, side)
    blades = mottle(rng, shape, 1.0) * 0.22 + mottle(rng, shape, 4.0) * 0.16 + mottle(rng, shape, 30.0) * 0.14
    grey = 0.08 * rng.uniform(0.8, 1.2) * np.clip(1 + blades, 0.2, 2.5)
    dry = smoothstep(mottle(rng, shape, 60.0) + 0.5 * mottle(rng, shape, 6.0), 0.2, 1.8)[..., None]
    green, straw = np.array([0.75, 1.15, 0.38]), np.array([1.5, 1.3, 0.75])
    return np.asarray(grey[..., None] * (green * (1 - dry) + straw * dry), np.float32)
