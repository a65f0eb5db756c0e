"""Trees and bushes with individual leaves: crowns with gaps that let sunlight through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.simulation.raytraced.mesh_builders import Mesh, join_meshes, tube
from paceline.simulation.raytraced.meshes import Texture

LEAF_COLOR_COUNT = 16  # colours of leaves


@dataclass(frozen=True, eq=False)
class Tree:
    """A tree that stands at the origin, or a bush."""

    wood: Mesh
    leaves: Mesh


def leaf_palette(rng: np.random.Generator) -> Texture:
    """Greens (1, LEAF_COLOR_COUNT, 3), from those in the crown's depth to those at its rim."""
    light = np.linspace(0.6, 1.25, LEAF_COLOR_COUNT) * rng.uniform(0.9, 1.1, LEAF_COLOR_COUNT)
    green = rng.uniform([0.035, 0.075, 0.012], [0.06, 0.10, 0.022])
    autumn = np.outer(rng.random(LEAF_COLOR_COUNT) < 0.08, [0.05, 0.02, 0.0])
    return np.asarray((light[:, None] * green + autumn)[None], np.float32)


def leaves(rng: np.random.Generator, centers: Array, spread: Array, count: int, size: float) -> Mesh:
    """Clumps of ``count`` leaves about ``size`` m long around ``centers`` (N, 3), scattered by ``spread`` (N,) m; each
    is a triangle, for all are sorted for the rays whenever something moves."""
    n = len(centers) * count
    offset = rng.normal(size=(len(centers), count, 3)) * [1, 1, 0.7]
    offset *= (spread[:, None] / np.maximum(1.0, np.linalg.norm(offset, axis=-1) / 1.6))[..., None]
    positions = (centers[:, None] + offset).reshape(-1, 3)
    along = rng.normal(size=(n, 3)) * [1, 1, 0.6]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, rng.normal(size=(n, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    length = size * rng.uniform(0.7, 1.3, (n, 1))
    vertices = positions[:, None] + length[:, None] * np.stack([-along / 2, 0.6 * across, along / 2], 1)
    triangles = np.arange(3 * n).reshape(n, 3)
    rim = np.linalg.norm(offset.reshape(-1, 3), axis=1) / np.repeat(spread, count) / 1.6
    shade = np.clip((LEAF_COLOR_COUNT - 1) * (0.25 + 0.5 * rim) + rng.normal(0, 2.5, n), 0, LEAF_COLOR_COUNT - 1)
    u = np.repeat((np.floor(shade) + 0.5) / LEAF_COLOR_COUNT, 3)
    return Mesh(vertices.reshape(-1, 3), triangles, np.column_stack([u, np.full(3 * n, 0.5)]))


def tree(rng: np.random.Generator, height: float, detail: float = 1.0) -> Tree:
    """A broad-leaved tree; ``detail`` is how many leaves it has, its leaves grow as their number falls."""
    radius = height * rng.uniform(0.26, 0.38)
    base = height * rng.uniform(0.22, 0.34)
    middle = np.array([*rng.normal(0, 0.04 * height, 2), (height + base) / 2])
    lean = middle * [0.5, 0.5, 0]
    clumps = int(44 * rng.uniform(0.85, 1.2))
    direction = rng.normal(size=(clumps, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    far = rng.uniform(0.35, 0.95, (clumps, 1)) ** 0.6
    centers = middle + direction * far * [radius, radius, (height - base) / 2]
    spread = rng.uniform(0.14, 0.26, clumps) * radius + 0.1
    count = max(8, int(60 * detail))
    crown = leaves(rng, centers, spread, count, 0.055 * radius / np.sqrt(detail) + 0.07)
    trunk = np.array([[0, 0, -1.0], [0, 0, 0.3], [*(0.5 * lean[:2]), base], [*lean[:2], 0.8 * height]])
    thick = 0.018 * height + 0.06
    wood = [tube(trunk, [1.3 * thick, thick, 0.75 * thick, 0.02], 9)]
    for c in centers[: int(14 * min(1.0, detail) + 4)]:
        fork = np.array([*(0.6 * lean[:2]), rng.uniform(0.8 * base, min(0.75 * height, max(c[2], base)))])
        wood.append(tube([fork, (fork + c) / 2 + [0, 0, 0.12 * radius], c], [0.4 * thick, 0.25 * thick, 0.02], 6))
    return Tree(join_meshes(wood), crown)


def bush(rng: np.random.Generator, height: float) -> Tree:
    """A bush about as wide as high."""
    n = 10
    centers = rng.uniform([-0.6, -0.6, 0.25], [0.6, 0.6, 0.8], (n, 3)) * height
    stems = [tube([[0, 0, -0.3], 0.5 * c, c], [0.03, 0.02, 0.01], 5) for c in centers[:5]]
    return Tree(join_meshes(stems), leaves(rng, centers, np.full(n, 0.24 * height), 40, 0.06 + 0.03 * height))
