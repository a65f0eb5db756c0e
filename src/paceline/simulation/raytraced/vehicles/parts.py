"""Parts that vehicles share: what they are made of, wheels, lamps, number plates, mirrors, wipers."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from paceline.arrays import Array
from paceline.simulation.raytraced.mesh_builders import (
    Mesh,
    NamedMesh,
    box,
    ellipsoid,
    join_meshes,
    quads,
    revolve,
    sheet,
    tube,
)
from paceline.simulation.raytraced.meshes import Material, Texture
from paceline.simulation.raytraced.road_textures import mottle

PAINT_COLORS = {  # linear reflectance, share among cars and among buses and lorries
    "white": ((0.70, 0.70, 0.68), 0.24, 0.40),
    "black": ((0.012, 0.012, 0.013), 0.18, 0.02),
    "grey": ((0.10, 0.105, 0.11), 0.18, 0.05),
    "silver": ((0.36, 0.37, 0.38), 0.14, 0.08),
    "blue": ((0.02, 0.05, 0.20), 0.11, 0.14),
    "red": ((0.32, 0.016, 0.018), 0.09, 0.14),
    "green": ((0.02, 0.07, 0.035), 0.03, 0.08),
    "yellow": ((0.52, 0.30, 0.02), 0.01, 0.09),
    "beige": ((0.42, 0.36, 0.26), 0.02, 0.0),
}
Z_TO_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # turns a z axis to y


def vehicle_materials(rng: np.random.Generator, fleet: bool = False) -> dict[str, Material]:
    """What the named parts of a vehicle are made of, in a colour drawn as on the road; buses and lorries are a
    ``fleet``."""
    names = list(PAINT_COLORS)
    share = np.array([PAINT_COLORS[n][2 if fleet else 1] for n in names])
    coat = np.array(PAINT_COLORS[str(rng.choice(names, p=share / share.sum()))][0]) * rng.uniform(0.85, 1.1)
    trim = rng.uniform(0.015, 0.045)
    return {
        "paint": Material("paint", _rgb(coat), roughness=0.03),
        "bumper": Material("paint", _rgb(coat if rng.random() < 0.7 else np.full(3, trim)), roughness=0.05),
        "plastic": Material("paint", (trim,) * 3, roughness=0.35),
        "seam": Material("matte", (0.008,) * 3),
        "dark": Material("matte", (0.012,) * 3),
        "rubber": Material("matte", (0.022, 0.022, 0.023)),
        "glass": Material("glass", (0.012, 0.015, 0.015), roughness=0.01),
        "housing": Material("paint", (rng.uniform(0.10, 0.3),) * 3, roughness=0.06),
        "chrome": Material("metal", (0.65, 0.66, 0.68), roughness=0.2),
        "rim": Material("metal", (rng.uniform(0.3, 0.6),) * 3, roughness=0.35),
        "red": Material("paint", (0.22, 0.008, 0.008), roughness=0.02),
        "amber": Material("paint", (0.40, 0.13, 0.01), roughness=0.02),
        "white": Material("paint", (0.55,) * 3, roughness=0.03),
        "cloth": Material("matte", _rgb(rng.uniform(0.01, 0.08) * rng.uniform(0.6, 1.4, 3))),
        "front plate": Material("paint", (0.6,) * 3, plate_texture(rng, (0.62, 0.62, 0.6)), roughness=0.2),
        "rear plate": Material("paint", (0.6,) * 3, plate_texture(rng, (0.62, 0.62, 0.6)), roughness=0.2),
    }


def _rgb(values: ArrayLike) -> tuple[float, float, float]:
    r, g, b = np.asarray(values, float).tolist()
    return r, g, b


def plate_texture(rng: np.random.Generator, ground: tuple[float, float, float]) -> Texture:
    """A number plate's face (64, 296, 3) with characters and a rim."""
    face = np.full((64, 296), 255, np.uint8)
    cv2.rectangle(face, (2, 2), (293, 61), 0, 2)
    text = "".join(rng.choice(list("ABCDEFGHJKLMNPRSTUVWXYZ"), 2)) + "".join(rng.choice(list("0123456789"), 2))
    text += " " + "".join(rng.choice(list("ABCDEFGHJKLMNPRSTUVWXYZ"), 3))
    (w, h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.5, 5)
    cv2.putText(face, text, ((296 - w) // 2, (64 + h) // 2), cv2.FONT_HERSHEY_SIMPLEX, 1.5, 0, 5, cv2.LINE_AA)
    light = face[..., None].astype(np.float32) / 255
    return np.asarray(
        0.02 + light * (np.array(ground) - 0.02) * (1 + 0.02 * mottle(rng, face.shape, 20.0)[..., None]), np.float32
    )


def number_plate(end: str, center: ArrayLike, width: float = 0.52, height: float = 0.114) -> list[NamedMesh]:
    """A number plate at ``center`` (3,), facing its end, on a dark holder."""
    x, y, z = np.asarray(center, float)
    out = 1.0 if end == "front" else -1.0
    a, b = out * width / 2, height / 2
    face = quads([[[x, y - a, z + b], [x, y + a, z + b], [x, y + a, z - b], [x, y - a, z - b]]])
    holder = box([0.012, width + 0.02, height + 0.02], [x - out * 0.007, y, z])
    return [(f"{end} plate", face), ("plastic", holder)]


def round_lamp(center: ArrayLike, radius: float, end: str) -> list[NamedMesh]:
    """A round lamp's reflector ring with a ball of glass in it, facing an end."""
    out = 1.0 if end == "front" else -1.0
    ring = revolve(
        [[radius, -0.03], [radius, 0.0], [0.86 * radius, 0.006], [0.7 * radius, -0.02], [0.05 * radius, -0.03]], 20
    )
    facing = np.array([[0, 0, out], [0, out, 0], [-1, 0, 0.0]])
    ball = ellipsoid([0, 0, -0.012], [0.6 * radius, 0.6 * radius, 0.022], 6, 14)
    return [("chrome", ring.transformed(center, facing)), ("glass", ball.transformed(center, facing))]


def wheel(
    rng: np.random.Generator, radius: float, width: float, inner: float = 0.68, spokes: int | None = None
) -> dict[str, Mesh]:
    """A left wheel about its centre: "rubber", "rim" and "dark" parts; its outer face looks to +y."""
    r, w = radius, width / 2
    ri = inner * r
    tyre = revolve(
        [
            [ri, -0.85 * w],
            [0.86 * r, -w],
            [0.97 * r, -0.9 * w],
            [r, -0.7 * w],
            [r, 0.7 * w],
            [0.97 * r, 0.9 * w],
            [0.86 * r, w],
            [ri, 0.85 * w],
        ],
        32,
    )
    lip = revolve([[0.97 * ri, -0.8 * w], [1.02 * ri, 0.86 * w], [0.93 * ri, 0.84 * w], [0.88 * ri, 0.55 * w]], 32)
    back = revolve([[ri, 0.02 * w], [0.2 * ri, 0.1 * w], [0.0, 0.1 * w]], 24)
    hub = revolve([[0.24 * ri, 0.2 * w], [0.22 * ri, 0.66 * w], [0.13 * ri, 0.72 * w], [0.0, 0.72 * w]], 14)
    n = spokes or int(rng.choice([5, 6, 7, 9, 10]))
    broad = min(0.85, 2.6 / n) * ri * rng.uniform(0.5, 0.8)
    inner_y, outer_y = 0.68 * w, rng.uniform(0.55, 0.8) * w
    a, b = 0.15 * ri, 0.93 * ri
    flat = np.array(
        [[a, -0.4 * broad, inner_y], [b, -0.5 * broad, outer_y], [b, 0.5 * broad, outer_y], [a, 0.4 * broad, inner_y]]
    )
    deep = flat - [0, 0, 0.35 * w]
    faces = flat[[3, 2, 1, 0]], np.stack([flat[0], flat[1], deep[1], deep[0]]), np.stack([*flat[2:], *deep[[3, 2]]])
    spoke = quads(np.array(faces))
    turns = [
        np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])
        for t in 2 * np.pi * np.arange(n) / n
    ]
    arms = [spoke.transformed([0, 0, 0], turn) for turn in turns]
    parts = {"rubber": tyre, "rim": join_meshes([lip, hub, *arms]), "dark": back}
    return {name: mesh.transformed([0, 0, 0], Z_TO_Y) for name, mesh in parts.items()}


def mirror(center: ArrayLike, size: float, material: str) -> list[NamedMesh]:
    """A left door mirror with its glass looking back."""
    c = np.asarray(center, float)
    return [
        (material, ellipsoid(c, [0.065 * size, 0.125 * size, 0.085 * size], 8, 14)),
        ("glass", box([0.01, 0.17 * size, 0.11 * size], c - [0.056 * size, 0, 0])),
        ("plastic", box([0.05, 0.14, 0.03], c - [0, 0.12 * size, 0.06 * size])),
    ]


def wiper(foot: ArrayLike, tip: ArrayLike, up: float = 0.025) -> list[NamedMesh]:
    """An arm from foot to tip, ``up`` m above the pane."""
    a, b = np.asarray(foot, float), np.asarray(tip, float)
    rise = np.array([0.6 * up, 0, up])
    return [("dark", tube(np.linspace(a + rise, b + rise, 3), 0.011, 6))]


def wheel_arch_liner(points: Array, inward: float) -> Mesh:
    """The inside of a wheel arch, ``inward`` metres deep from its edge ``points`` (N, 3), front to rear."""
    inner = points * [1, 0, 1] + [0, 1, 0] * (points[:, 1:2] - inward)
    return sheet(np.stack([inner, points]))
