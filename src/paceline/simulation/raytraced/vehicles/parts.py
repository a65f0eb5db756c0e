"""Parts that vehicles share: wheels, lamps, number plates, mirrors, wipers."""

from __future__ import annotations

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

Z_TO_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # turns a z axis to y


def number_plate(end: str, center: ArrayLike, width: float = 0.52, height: float = 0.114) -> list[NamedMesh]:
    """A number plate at ``center`` (3,), facing its end, on a dark holder."""
    x, y, z = np.asarray(center, float)
    outward = 1.0 if end == "front" else -1.0
    a, b = outward * width / 2, height / 2
    face = quads([[[x, y - a, z + b], [x, y + a, z + b], [x, y + a, z - b], [x, y - a, z - b]]])
    holder = box([0.012, width + 0.02, height + 0.02], [x - outward * 0.007, y, z])
    return [(f"{end} plate", face), ("plastic", holder)]


def round_lamp(center: ArrayLike, radius: float, end: str) -> list[NamedMesh]:
    """A round lamp's reflector ring with a ball of glass in it, facing an end."""
    outward = 1.0 if end == "front" else -1.0
    ring = revolve(
        [[radius, -0.03], [radius, 0.0], [0.86 * radius, 0.006], [0.7 * radius, -0.02], [0.05 * radius, -0.03]], 20
    )
    facing = np.array([[0, 0, outward], [0, outward, 0], [-1, 0, 0.0]])
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
