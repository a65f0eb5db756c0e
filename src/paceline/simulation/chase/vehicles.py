"""Vehicles seen from behind: a rear plane with painted lines, a bumper in front of that plane, sides, roof and wheels.

A vehicle's axes: x right, y down, z ahead, in metres from the centre of its rear plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paceline.simulation.textures import Canvas, Texture

REAR_TEXELS_PER_METRE = 400.0  # texels per metre of a rear plane


@dataclass(frozen=True, eq=False)
class Face:
    """A texture on a parallelogram in an object's axes: its top-left ``corner`` (3,) and its two edges (3,), m.

    Seen from where ``across`` points right and ``down`` points down; not seen from behind.
    """

    texture: Texture
    corner: tuple[float, float, float]
    across: tuple[float, float, float]
    down: tuple[float, float, float]


@dataclass(frozen=True)
class EdgeLine:
    """A painted or built edge from (x0, y0) to (x1, y1), ``z`` metres ahead of the rear plane."""

    x0: float
    y0: float
    x1: float
    y1: float
    z: float = 0.0


@dataclass(frozen=True, eq=False)
class Body:
    """A vehicle: ``faces`` from the farthest to the nearest, the lamps apart; ``lines`` are its strong edges.

    ``width`` and ``height`` are those of the rear plane, whose lower edge is ``clearance`` metres above the road;
    ``length`` and ``top`` (m above the plane's centre) outline the shadow that it casts.
    """

    kind: str
    faces: tuple[Face, ...]
    lamps: tuple[Face, ...]
    lines: tuple[EdgeLine, ...]
    width: float
    height: float
    clearance: float
    length: float
    top: float


class AntialiasedCanvas(Canvas):
    """A canvas whose boxes cover every texel exactly by the part of it that they fill."""

    def box(self, x: float, y: float, width: float, height: float, grey: float) -> None:
        rows, columns = self.value.shape
        across = _covered_share(columns, x * columns / self.width, (x + width) * columns / self.width)
        down = _covered_share(rows, y * rows / self.height, (y + height) * rows / self.height)
        cover = down[:, None] * across
        self.value += (grey - self.value) * cover
        self.alpha = np.maximum(self.alpha, cover)


def _covered_share(count: int, low: float, high: float) -> NDArray[np.float32]:
    cells = np.arange(count)
    return np.asarray(np.clip(np.minimum(cells + 1, high) - np.maximum(cells, low), 0, 1), np.float32)


def make_vehicle(rng: np.random.Generator, kind: str, paint: float) -> Body:
    """A vehicle of one of `DRAWN` whose ``paint`` is a grey level; details vary with ``rng``."""
    return {"van": _make_van, "saloon": _make_saloon, "lorry": _make_lorry, "bus": _make_bus}[kind](
        _BodyBuilder(rng, kind, paint)
    )


class _BodyBuilder:
    """Parts of all kinds of vehicles. The origin is the rear plane's centre, on a canvas its top left."""

    def __init__(self, rng: np.random.Generator, kind: str, paint: float) -> None:
        self.rng, self.kind, self.paint = rng, kind, paint
        self.glass = rng.uniform(18, 45) if paint > 65 else rng.uniform(110, 160)  # dark, or with the sky in it
        self.trim = rng.uniform(22, 40) if paint > 65 else rng.uniform(95, 130)
        self.lines: list[EdgeLine] = []

    def size(self, width: tuple[float, float], height: tuple[float, float], clearance: tuple[float, float]) -> None:
        self.width, self.height = self.rng.uniform(*width), self.rng.uniform(*height)
        self.clearance = self.rng.uniform(*clearance)
        self.rear = AntialiasedCanvas(self.width, self.height, self.paint, density=REAR_TEXELS_PER_METRE)
        self.rear.mottle(self.rng, 0.03, 0.3)
        self.rear.shade(1.06, 0.92)

    def paint_box(self, x: float, y: float, width: float, height: float, grey: float) -> None:
        """A box on the rear plane with its top-left corner at (x, y)."""
        self.rear.box(x + self.width / 2, y + self.height / 2, width, height, grey)

    def model(self, x0: float, y0: float, x1: float, y1: float, sides: str, z: float = 0.0) -> None:
        """Records the ``sides`` — of left, right, top, bottom — of a box as strong edges."""
        edges = {"l": (x0, y0, x0, y1), "r": (x1, y0, x1, y1), "t": (x0, y0, x1, y0), "b": (x0, y1, x1, y1)}
        self.lines += [EdgeLine(*edges[s], z) for s in sides]

    def outline(self, sides: str) -> None:
        self.model(-self.width / 2, -self.height / 2, self.width / 2, self.height / 2, sides)

    def gutter(self) -> None:
        """A dark seal under the roof's edge."""
        self.paint_box(-self.width / 2, -self.height / 2, self.width, 0.04, 0.3 * self.paint)

    def window(self, x0: float, y0: float, x1: float, y1: float, sides: str = "lrtb") -> None:
        self.paint_box(x0, y0, x1 - x0, y1 - y0, self.glass)
        self.paint_box(x0 + 0.05, y0 + 0.05, 0.4 * (x1 - x0), 0.15 * (y1 - y0), 1.25 * self.glass)
        self.model(x0, y0, x1, y1, sides)

    def plate(self, y: float) -> None:
        """A number plate with its upper edge at ``y``."""
        x = self.rng.uniform(-0.05, 0.05)
        self.paint_box(x - 0.26, y, 0.52, 0.115, 20)
        self.paint_box(x - 0.252, y + 0.008, 0.504, 0.099, 205)
        for k in np.flatnonzero(self.rng.random(8) < 0.85):
            self.paint_box(x - 0.225 + 0.057 * k, y + 0.025, self.rng.uniform(0.015, 0.04), 0.065, 30)

    def panel(self, width: float, height: float, grey: float, grain: float = 0.3) -> Texture:
        c = AntialiasedCanvas(width, height, grey, density=80)
        c.mottle(self.rng, 0.04, grain)
        return c.finish()

    def bumper(self, height: float, depth: float, grey: float) -> tuple[Face, Face]:
        """The bumper's top and rear, ``depth`` metres behind the rear plane, down to the plane's lower edge."""
        half, top = self.width / 2 - 0.01, self.height / 2 - height
        # One of the body's colour shows where its top ends, any other where the body ends.
        self.model(-half, top, half, top + height, "t", 0.0 if grey == self.trim else -depth)
        self.model(-half, top, half, top + height, "b", -depth)
        c = AntialiasedCanvas(2 * half, height, grey, density=REAR_TEXELS_PER_METRE)
        c.mottle(self.rng, 0.05, 0.2)
        c.box(0, 0.6 * height, 2 * half, 0.03, 0.5 * grey)
        above = self.panel(2 * half, max(depth, 0.08), 1.05 * grey)
        return (
            Face(above, (-half, top, 0.0), (2 * half, 0, 0), (0, 0, -depth)),
            Face(c.finish(), (-half, top, -depth), (2 * half, 0, 0), (0, height, 0)),
        )

    def lamps(self, x: float, y: float, width: float, height: float, z: float = 0.0) -> tuple[Face, Face]:
        """A pair of lamps with their outer upper corners at (± x, y)."""
        dull = self.rng.uniform(45, 80)
        c = AntialiasedCanvas(width, height, dull, density=REAR_TEXELS_PER_METRE)
        c.box(0.3 * width, 0.3 * height, 0.4 * width, 0.25 * height, 150)
        c.box(0, 0.0, width, 0.02, 25)
        texture = c.finish()
        return (
            Face(texture, (-x, y, z - 0.01), (width, 0, 0), (0, height, 0)),
            Face(texture, (x - width, y, z - 0.01), (width, 0, 0), (0, height, 0)),
        )

    def box_faces(self, length: float, top: float, bottom: float, z: float = 0.0, inset: float = 0.0) -> list[Face]:
        """Roof and sides of a box behind the plane from y = top to y = bottom."""
        half = self.width / 2 - inset
        side_height = bottom - top
        side = AntialiasedCanvas(length, side_height, self.paint, density=60)
        side.shade(1.05, 0.8)
        side.mottle(self.rng, 0.04, 0.5)
        if self.kind != "lorry":
            for k in range(max(1, int(length / 1.2))):
                side.box(0.25 + 1.2 * k, 0.12 * side_height, 0.95, 0.36 * side_height, self.glass)
        flank, roof = side.finish(), self.panel(2 * half, length, 1.02 * self.paint, 0.6)
        return [
            Face(roof, (-half, top, z + length), (2 * half, 0, 0), (0, 0, -length)),
            Face(flank, (half, top, z), (0, 0, length), (0, side_height, 0)),
            Face(flank, (-half, top, z + length), (0, 0, -length), (0, side_height, 0)),
        ]

    def underside(self, height: float) -> list[Face]:
        """Wheels and the dark gap between them, below the rear plane."""
        c = AntialiasedCanvas(self.width, height, 0.0, alpha=0.0, density=120)
        c.box(0.05, 0, self.width - 0.1, 0.4 * height, 8)
        for x in (0.04, self.width - 0.28):
            c.box(x, 0, 0.24, height, 14)
        c.mottle(self.rng, 0.1, 0.06)
        return [Face(c.finish(), (-self.width / 2, self.height / 2, 0.25), (self.width, 0, 0), (0, height, 0))]

    def finish(
        self, behind: list[Face], before: tuple[Face, ...], lamps: tuple[Face, ...], length: float, top: float
    ) -> Body:
        x, y = self.width / 2, self.height / 2
        rear = Face(self.rear.finish(), (-x, -y, 0), (2 * x, 0, 0), (0, 2 * y, 0))
        faces = (*self.underside(self.clearance), *behind, rear, *before)
        size = self.width, self.height, self.clearance
        return Body(self.kind, faces, lamps, tuple(self.lines), *size, length, top)


def _make_van(b: _BodyBuilder) -> Body:
    b.size((1.75, 2.05), (1.45, 1.85), (0.3, 0.42))
    w, h, rng = b.width, b.height, b.rng
    b.outline("lrt")
    b.gutter()
    x, top, bottom = rng.uniform(0.62, 0.78) * w / 2, rng.uniform(-0.4, -0.34) * h, rng.uniform(-0.1, 0.04) * h
    if rng.random() < 0.5:
        b.window(-x, top, x, bottom)
    else:
        b.window(-x, top, -0.09, bottom, "ltb")
        b.window(0.09, top, x, bottom, "rtb")
    b.paint_box(-0.007, -h / 2, 0.014, h, 12)
    b.paint_box(0.04, 0.12 * h, 0.16, 0.04, b.trim)
    b.plate(rng.uniform(0.14, 0.2) * h)
    bumper = b.bumper(rng.uniform(0.2, 0.27), rng.uniform(0.08, 0.2), b.trim)
    lamps = b.lamps(w / 2 - 0.02, rng.uniform(0.0, 0.08) * h, 0.11, rng.uniform(0.28, 0.42))
    length = rng.uniform(4.2, 5.2)
    return b.finish(b.box_faces(length, -h / 2, h / 2 - 0.1), bumper, lamps, length, h / 2)


def _make_saloon(b: _BodyBuilder) -> Body:
    b.size((1.68, 1.88), (0.7, 0.85), (0.24, 0.34))
    w, h, rng = b.width, b.height, b.rng
    b.outline("lr")
    b.paint_box(-w / 2, 0.02 * h, w, 0.012, 10)
    lamp = rng.uniform(0.2, 0.3), rng.uniform(0.14, 0.2)
    lamps = b.lamps(w / 2 - 0.01, -0.36 * h, *lamp)
    x, y = w / 2 - 0.01 - lamp[0], -0.36 * h
    b.model(-x, y, x, y + lamp[1], "lr")
    b.model(x, y, x + lamp[0], y + lamp[1], "b")
    b.model(-x - lamp[0], y, -x, y + lamp[1], "b")
    b.plate(rng.uniform(-0.12, -0.08) * h)
    body_coloured = rng.random() < 0.6
    bumper = b.bumper(rng.uniform(0.24, 0.32), rng.uniform(0.08, 0.18), 0.85 * b.paint if body_coloured else b.trim)
    boot, rake, tall, length = rng.uniform(0.2, 0.4), rng.uniform(0.5, 0.7), rng.uniform(0.48, 0.56), 4.3
    glass = AntialiasedCanvas(w, tall, 0.0, alpha=0.0, density=160)
    taper = 0.1 * w
    outer = [(taper, 0.0), (w - taper, 0.0), (w - 0.03, tall), (0.03, tall)]
    glass.polygon(outer, 0.97 * b.paint)
    b.model(0.13 - w / 2, -h / 2 - 0.04, w / 2 - 0.13, 0.0, "t", boot + 0.04 / tall * rake)  # the pane's lower edge
    pane = [(taper + 0.07, 0.07), (w - taper - 0.07, 0.07), (w - 0.13, tall - 0.04), (0.13, tall - 0.04)]
    glass.polygon(pane, b.glass)
    z = boot + rake
    behind = [
        *b.box_faces(1.5, -h / 2 - tall, -h / 2, z, taper),
        Face(glass.finish(), (-w / 2, -h / 2 - tall, z), (w, 0, 0), (0, tall, -rake)),
        *b.box_faces(length, -h / 2, h / 2 - 0.1)[1:],
        Face(b.panel(w, boot, 1.03 * b.paint), (-w / 2, -h / 2, boot), (w, 0, 0), (0, 0, -boot)),
    ]
    return b.finish(behind, bumper, lamps, length, h / 2 + tall)


def _make_lorry(b: _BodyBuilder) -> Body:
    b.size((2.35, 2.55), (2.1, 2.6), (0.85, 1.05))
    w, h, rng = b.width, b.height, b.rng
    b.outline("lrtb")
    frame = rng.uniform(0.09, 0.15)
    grey = 0.55 * b.paint if b.paint > 65 else 2.4 * b.paint
    for x in (-w / 2, w / 2 - frame):
        b.paint_box(x, -h / 2, frame, h, grey)
    for y in (-h / 2, h / 2 - frame):
        b.paint_box(-w / 2, y, w, frame, grey)
    b.model(frame - w / 2, frame - h / 2, w / 2 - frame, h / 2 - frame, "lrtb")
    b.paint_box(-0.012, frame - h / 2, 0.024, h - 2 * frame, 12)
    for x in rng.uniform(0.2, 0.75, int(rng.integers(1, 3))) * w / 2:
        for side in (-x, x):
            b.paint_box(side - 0.017, -h / 2, 0.034, h, 1.3 * grey)
    if rng.random() < 0.5:  # a sign painted on the doors
        b.paint_box(-0.3 * w, -0.28 * h, 0.6 * w, 0.14 * h, 0.6 * b.paint + 40)
    lamps = b.lamps(w / 2 - 0.12, h / 2 + 0.12, 0.36, 0.14, 0.05)
    bar = Face(b.panel(w, 0.14, b.trim), (-w / 2, h / 2 + 0.36, 0.12), (w, 0, 0), (0, 0.14, 0))
    carrier = Face(b.panel(w, 0.3, 25), (-w / 2, h / 2 + 0.03, 0.1), (w, 0, 0), (0, 0.28, 0))
    length = rng.uniform(6.0, 8.0)
    return b.finish([*b.box_faces(length, -h / 2, h / 2), carrier, bar], (), lamps, length, h / 2)


def _make_bus(b: _BodyBuilder) -> Body:
    b.size((2.4, 2.55), (2.45, 2.75), (0.32, 0.42))
    w, h, rng = b.width, b.height, b.rng
    b.outline("lrt")
    b.gutter()
    x = rng.uniform(0.72, 0.86) * w / 2
    b.window(-x, -0.4 * h, x, rng.uniform(-0.1, 0.02) * h)
    y, tall = rng.uniform(0.12, 0.16) * h, rng.uniform(0.12, 0.16) * h
    x = rng.uniform(0.4, 0.6) * w / 2
    b.paint_box(-x, y, 2 * x, tall, b.trim)
    for k in range(5):
        b.paint_box(-x + 0.03, y + (k + 0.3) * tall / 5, 2 * x - 0.06, 0.08 * tall, 1.6 * b.trim)
    b.model(-x, y, x, y + tall, "lrt")
    b.plate(0.315 * h)
    bumper = b.bumper(rng.uniform(0.3, 0.4), rng.uniform(0.08, 0.15), b.trim)
    lamps = b.lamps(w / 2 - 0.03, 0.1 * h, 0.16, 0.5)
    length = rng.uniform(8.0, 10.0)
    return b.finish(b.box_faces(length, -h / 2, h / 2 - 0.2), bumper, lamps, length, h / 2)
