"""Procedural textures of vehicles and of objects beside a road, in grey levels 0–255."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Image

TEXELS_PER_METRE = 560.0  # a vehicle's, fine enough for its nearest views
TEXTURE_LEVELS = 6


@dataclass(frozen=True, eq=False)
class Texture:
    """Grey ``value`` (H, W) and coverage ``alpha`` (H, W) in 0–1, with a pyramid for area sampling.

    Texel (i, j) of every level covers its full cell, so all levels span exactly the same rectangle: H and W must be
    multiples of ``2 ** (TEXTURE_LEVELS - 1)``.
    """

    value: Image
    alpha: Image

    @cached_property
    def pyramid(self) -> list[Image]:
        """Premultiplied (H, W, 2) levels, each the area average of the one before."""
        levels = [np.ascontiguousarray(np.dstack([self.value * self.alpha, self.alpha]).astype(np.float32))]
        while len(levels) < TEXTURE_LEVELS:
            h, w = levels[-1].shape[:2]
            half = cv2.resize(levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA)
            levels.append(np.asarray(half, np.float32))
        return levels

    def to_light(self, gamma: float) -> Texture:
        """The light of which these are the grey values, as it goes by their power ``gamma``."""
        return Texture(grey_to_light(self.value, gamma), self.alpha)


def grey_to_light(values: Image, gamma: float) -> Image:
    """The light, 255 where they are that, of which ``values`` are the power 1 / ``gamma``."""
    return values if gamma == 1.0 else np.asarray(255 * (np.clip(values, 0, None) / 255) ** gamma, np.float32)


def light_to_grey(light: Image, gamma: float) -> Image:
    """The inverse of `grey_to_light`."""
    return grey_to_light(light, 1.0 / gamma)


class Canvas:
    """A texture being drawn; coordinates in metres from the top-left corner of a rectangle ``width`` × ``height``."""

    def __init__(
        self, width: float, height: float, grey: float = 0.0, alpha: float = 1.0, density: float = TEXELS_PER_METRE
    ) -> None:
        cell = 2 ** (TEXTURE_LEVELS - 1)
        columns = max(1, round(width * density / cell)) * cell
        rows = max(1, round(height * density / cell)) * cell
        self.width, self.height = width, height
        self.value: Image = np.full((rows, columns), grey, np.float32)
        self.alpha: Image = np.full((rows, columns), alpha, np.float32)

    def _texels(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Fixed-point texel coordinates (4 fractional bits) of ``points`` (N, 2) in metres."""
        scale = np.array([self.value.shape[1] / self.width, self.value.shape[0] / self.height])
        return np.asarray(np.round((points * scale - 0.5) * 16), np.int32)

    def polygon(self, points: list[tuple[float, float]], grey: float, alpha: float = 1.0) -> None:
        """A filled convex polygon."""
        p = self._texels(np.array(points, float))
        cv2.fillConvexPoly(self.value, p, grey, shift=4)
        cv2.fillConvexPoly(self.alpha, p, alpha, shift=4)

    def box(self, x: float, y: float, width: float, height: float, grey: float) -> None:
        """A filled rectangle with its top-left corner at (x, y)."""
        self.polygon([(x, y), (x + width, y), (x + width, y + height), (x, y + height)], grey)

    def ellipse(self, x: float, y: float, rx: float, ry: float, grey: float) -> None:
        """A filled ellipse with its centre at (x, y)."""
        a = np.linspace(0, 2 * np.pi, 49)[:-1]
        self.polygon([(x + rx * c, y + ry * s) for c, s in zip(np.cos(a), np.sin(a), strict=True)], grey)

    def mottle(self, rng: np.random.Generator, amplitude: float, grain: float) -> None:
        """Multiply by smooth noise with features of about ``grain`` metres."""
        rows, columns = self.value.shape
        cells = max(2, int(self.height / grain) + 1), max(2, int(self.width / grain) + 1)
        coarse = rng.standard_normal(cells).astype(np.float32)
        noise = cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)
        self.value *= 1 + amplitude * noise

    def shade(self, top: float, bottom: float) -> None:
        """Multiply by a vertical gradient."""
        self.value *= np.linspace(top, bottom, len(self.value), dtype=np.float32)[:, None]

    def finish(self) -> Texture:
        return Texture(np.clip(self.value, 2, 250), self.alpha)


@dataclass(frozen=True, eq=False)
class FacePart:
    """A texture on a rectangle of a vehicle, in the vehicle's face axes: metres from the centre of its main plane,
    x right and y down as seen from outside, ``depth`` behind the main plane."""

    texture: Texture
    x: float
    y: float
    width: float
    height: float
    depth: float


def front_parts(rng: np.random.Generator, width: float, height: float, relief: float) -> list[FacePart]:
    """Parts of a vehicle's front or rear from the farthest to the nearest; the main plane is ``width`` × ``height``."""
    body = float(rng.choice([28, 45, 70, 105, 140, 175, 205])) * rng.uniform(0.85, 1.15)
    contrast = rng.uniform(0.55, 1.0)
    grey = _ContrastScale(body, contrast)
    parts = [_cabin_part(rng, width, height, body), _underbody_part(rng, width, height)]

    main = Canvas(width, height, body)
    main.mottle(rng, 0.03, 0.25)
    main.shade(1.12, 0.86)
    bonnet = rng.uniform(0.08, 0.16) * height
    main.box(0, bonnet, width, 0.012, grey(12))  # the gap under the bonnet
    bumper = rng.uniform(0.58, 0.70) * height
    main.box(0, bumper, width, height - bumper, body * rng.uniform(0.78, 0.95))
    main.box(0, bumper, width, 0.014, grey(10))
    intake_width = rng.uniform(0.35, 0.6) * width
    main.box((width - intake_width) / 2, 0.86 * height, intake_width, 0.10 * height, grey(14))
    for side in (0.05, 0.95 - 0.1):
        main.box(side * width, 0.82 * height, 0.1 * width, 0.08 * height, grey(30))  # fog lamps
        main.ellipse((side + 0.05) * width, 0.86 * height, 0.028 * width, 0.026 * height, grey(200))
    main.mottle(rng, 0.02, 0.04)
    parts.append(FacePart(main.finish(), 0, 0, width, height, 0.0))

    lamp_w, lamp_h = rng.uniform(0.15, 0.23) * width, rng.uniform(0.2, 0.3) * height
    lamp_y = bonnet + 0.03 + lamp_h / 2
    offset = width / 2 - lamp_w / 2 - rng.uniform(0.01, 0.05) * width
    lamp = _lamp_texture(rng, lamp_w, lamp_h, grey)
    mirrored = Texture(lamp.value[:, ::-1].copy(), lamp.alpha[:, ::-1].copy())
    depths = rng.uniform(-1, 1, 3) * relief
    for texture, x in ((lamp, -offset), (mirrored, offset)):
        parts.append(FacePart(texture, x, lamp_y - height / 2, lamp_w, lamp_h, depths[0]))

    grille_w, grille_h = rng.uniform(0.36, 0.5) * width, rng.uniform(0.24, 0.36) * height
    grille_y = bonnet + 0.03 + grille_h / 2
    parts.append(
        FacePart(
            _grille_texture(rng, grille_w, grille_h, grey), 0, grille_y - height / 2, grille_w, grille_h, depths[1]
        )
    )
    plate_y = rng.uniform(0.70, 0.78) * height
    parts.append(
        FacePart(_plate_texture(rng, grey), rng.uniform(-0.03, 0.03), plate_y - height / 2, 0.52, 0.115, depths[2])
    )
    return parts


def side_parts(rng: np.random.Generator, width: float, height: float, relief: float) -> list[FacePart]:
    """Parts of a vehicle's side; the main plane is the ``width`` × ``height`` band of doors and wings."""
    body = float(rng.choice([28, 45, 70, 105, 140, 175, 205])) * rng.uniform(0.85, 1.15)
    grey = _ContrastScale(body, rng.uniform(0.55, 1.0))
    parts = [_windows_part(rng, width, height, body), _wheels_part(rng, width, height)]
    main = Canvas(width, height, body)
    main.mottle(rng, 0.04, 0.5)
    main.shade(1.15, 0.8)
    main.box(0, rng.uniform(0.4, 0.55) * height, width, 0.015, grey(235))  # a crease that catches the light
    main.box(0, 0.86 * height, width, 0.14 * height, grey(24))
    doors = np.cumsum([rng.uniform(0.22, 0.28), rng.uniform(0.22, 0.26), rng.uniform(0.16, 0.22)]) * width
    for x in doors:
        main.box(float(x), 0, 0.014, 0.9 * height, grey(8))
    for x in doors[1:]:
        main.box(float(x) - 0.24, 0.16 * height, 0.17, 0.035, grey(210))  # handles
        main.box(float(x) - 0.24, 0.16 * height + 0.035, 0.17, 0.02, grey(15))
    main.box(0, 0.08 * height, 0.07 * width, 0.2 * height, grey(215))
    main.box(0.95 * width, 0.05 * height, 0.05 * width, 0.25 * height, grey(40))
    main.ellipse(0.86 * width, 0.25 * height, 0.07, 0.07, grey(35))  # the filler cap
    main.mottle(rng, 0.025, 0.05)
    parts.append(FacePart(main.finish(), 0, 0, width, height, 0.0))
    trim = Canvas(0.3 * width, 0.08 * height, grey(20))
    trim.mottle(rng, 0.1, 0.03)
    depth = rng.uniform(-1, 1) * relief
    parts.append(FacePart(trim.finish(), -0.05 * width, 0.2 * height, 0.3 * width, 0.08 * height, depth))
    return parts


class _ContrastScale:
    """Grey levels drawn towards the body's own: a vehicle of low contrast."""

    def __init__(self, body: float, contrast: float) -> None:
        self.body, self.contrast = body, contrast

    def __call__(self, grey: float) -> float:
        return self.body + self.contrast * (grey - self.body)


def _cabin_part(rng: np.random.Generator, width: float, height: float, body: float) -> FacePart:
    part_height = rng.uniform(0.55, 0.85)
    bonnet = 0.45  # seen from above between the windscreen, which is set back, and the front
    c = Canvas(width, part_height + bonnet, 0.0, alpha=0.0)
    c.box(0.02, part_height, width - 0.04, bonnet, body * 1.1)
    inset = rng.uniform(0.08, 0.16) * width
    c.polygon([(inset, 0), (width - inset, 0), (width - 0.02, part_height), (0.02, part_height)], body * 0.95)
    glass = rng.uniform(25, 60)
    c.polygon(
        [
            (inset + 0.06, 0.09),
            (width - inset - 0.06, 0.09),
            (width - 0.13, part_height - 0.05),
            (0.13, part_height - 0.05),
        ],
        glass,
    )
    for x in (0.33, 0.67):  # the occupants' seats
        c.ellipse(x * width, 0.55 * part_height, 0.11, 0.16, glass * 0.6)
    c.mottle(rng, 0.08, 0.15)
    centre = -height / 2 + 0.02 + (bonnet - part_height) / 2
    return FacePart(c.finish(), 0, centre, width, part_height + bonnet, rng.uniform(0.7, 1.2))


def _underbody_part(rng: np.random.Generator, width: float, height: float) -> FacePart:
    part_height = 0.36
    c = Canvas(width, part_height, 10.0, alpha=0.0)
    c.box(0.03 * width, 0, 0.94 * width, 0.15, 12)
    for x in (0.03, 0.97 - 0.13):
        c.box(x * width, 0, 0.13 * width, part_height, 16)
        c.box((x + 0.03) * width, 0.02, 0.02 * width, part_height - 0.03, 30)
    c.mottle(rng, 0.1, 0.05)
    return FacePart(c.finish(), 0, height / 2 + part_height / 2 - 0.01, width, part_height, 0.15)


def _windows_part(rng: np.random.Generator, width: float, height: float, body: float) -> FacePart:
    part_height = rng.uniform(0.45, 0.6)
    c = Canvas(width, part_height, 0.0, alpha=0.0)
    left, right = rng.uniform(0.2, 0.3) * width, rng.uniform(0.82, 0.95) * width
    c.polygon([(left, 0), (right, 0), (0.98 * width, part_height), (0.12 * width, part_height)], body)
    glass = rng.uniform(25, 70)
    middle = (left + right) / 2
    c.polygon(
        [(left + 0.05, 0.07), (middle - 0.04, 0.07), (middle - 0.04, part_height), (0.17 * width, part_height)], glass
    )
    c.polygon(
        [(middle + 0.04, 0.07), (right - 0.05, 0.07), (0.93 * width, part_height), (middle + 0.04, part_height)], glass
    )
    c.mottle(rng, 0.1, 0.2)
    return FacePart(c.finish(), 0, -height / 2 - part_height / 2 + 0.06, width, part_height, 0.12)


def _wheels_part(rng: np.random.Generator, width: float, height: float) -> FacePart:
    part_height = 0.66
    c = Canvas(width, part_height, 10.0, alpha=0.0)
    c.box(0, 0.25, width, 0.18, 12)
    for x in (0.18, 0.8):
        c.ellipse(x * width, 0.33, 0.32, 0.32, 20)
        c.ellipse(x * width, 0.33, 0.20, 0.20, rng.uniform(90, 170))
        c.ellipse(x * width, 0.33, 0.07, 0.07, 40)
    return FacePart(c.finish(), 0, height / 2 + 0.02, width, part_height, 0.06)


def _lamp_texture(rng: np.random.Generator, width: float, height: float, grey: _ContrastScale) -> Texture:
    c = Canvas(width, height, grey(rng.uniform(110, 225)))
    c.mottle(rng, 0.08, 0.05)
    for x in (0.3, 0.68):
        r = rng.uniform(0.28, 0.4) * min(width * 0.5, height)
        c.ellipse(x * width, 0.52 * height, r, r, grey(rng.uniform(30, 90)))
        c.ellipse(x * width, 0.52 * height, 0.55 * r, 0.55 * r, grey(245))
    edge = 0.012
    for y in (0, height - edge):
        c.box(0, y, width, edge, grey(20))
    for x in (0, width - edge):
        c.box(x, 0, edge, height, grey(20))
    return c.finish()


def _grille_texture(rng: np.random.Generator, width: float, height: float, grey: _ContrastScale) -> Texture:
    c = Canvas(width, height, grey(12))
    bright = grey(rng.uniform(90, 225))
    bars = int(rng.integers(3, 7))
    for k in range(bars):
        if bars % 2:
            c.box(0.015, (k + 0.35) * height / bars, width - 0.03, 0.3 * height / bars, bright)
        else:
            n = 3 * bars
            for j in range(3):
                c.box((3 * k + j + 0.3) * width / n, 0.02, 0.4 * width / n, height - 0.04, bright)
    c.mottle(rng, 0.05, 0.05)
    c.ellipse(width / 2, height / 2, 0.065, 0.055, grey(235))  # the badge
    c.ellipse(width / 2, height / 2, 0.045, 0.036, grey(60))
    c.box(width / 2 - 0.03, height / 2 - 0.006, 0.06, 0.012, grey(235))
    return c.finish()


def _plate_texture(rng: np.random.Generator, grey: _ContrastScale) -> Texture:
    width, height = 0.52, 0.115
    c = Canvas(width, height, grey(20))
    c.box(0.006, 0.006, width - 0.012, height - 0.012, grey(225))
    for k in range(7):
        x = 0.03 + 0.067 * k
        strokes = rng.random(7) < 0.62
        strokes[int(rng.integers(7))] = True
        for is_drawn, (dx, dy, w, h) in zip(strokes, _GLYPH_STROKES, strict=True):
            if is_drawn:
                c.box(x + dx, 0.02 + dy, w, h, grey(25))
    return c.finish()


# The seven strokes of a glyph 45 × 75 mm: x, y, width, height in metres.
_GLYPH_STROKES = (
    (0.0, 0.0, 0.045, 0.012),
    (0.0, 0.031, 0.045, 0.012),
    (0.0, 0.063, 0.045, 0.012),
    (0.0, 0.0, 0.011, 0.04),
    (0.034, 0.0, 0.011, 0.04),
    (0.0, 0.035, 0.011, 0.04),
    (0.034, 0.035, 0.011, 0.04),
)


def building_texture(rng: np.random.Generator, width: float, height: float) -> Texture:
    """A façade with rows of windows."""
    c = Canvas(width, height, rng.uniform(60, 170), density=768 / max(width, height))
    c.mottle(rng, 0.05, 0.1 * width)
    rows, columns = max(2, round(height / 3.2)), max(2, round(width / 3.0))
    for r in range(rows):
        for k in range(columns):
            w, h = 0.5 * width / columns, 0.45 * height / rows
            c.box((k + 0.25) * width / columns, (r + 0.25) * height / rows, w, h, rng.uniform(20, 70))
    return c.finish()


def tree_texture(rng: np.random.Generator, width: float, height: float) -> Texture:
    """A crown of leaves on a trunk."""
    c = Canvas(width, height, 0.0, alpha=0.0, density=512 / max(width, height))
    c.box(0.46 * width, 0.6 * height, 0.08 * width, 0.4 * height, 35)
    for _ in range(40):
        r, angle, reach = rng.uniform(0.06, 0.13), rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0, 1))
        x, y = (0.5 + 0.34 * reach * np.cos(angle)) * width, (0.36 + 0.26 * reach * np.sin(angle)) * height
        c.ellipse(x, y, r * width, 0.8 * r * height, rng.uniform(38, 75))
    c.mottle(rng, 0.25, 0.12 * width)
    c.mottle(rng, 0.25, 0.04 * width)
    return c.finish()


def pole_texture(rng: np.random.Generator, width: float, height: float) -> Texture:
    """A round pole, lit from one side."""
    c = Canvas(width, height, rng.uniform(50, 140), density=64 / width)
    c.value *= (1.15 - 0.7 * np.abs(np.linspace(-0.6, 1, c.value.shape[1], dtype=np.float32)))[None]
    c.mottle(rng, 0.06, 0.3)
    return c.finish()
