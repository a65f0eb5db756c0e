"""Triangle meshes and their elements: sheets, boxes, tubes, bodies of revolution, creases."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from paceline.arrays import Array, Indices
from paceline.simulation.raytraced.meshes import Material, SceneMesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """``vertices`` (V, 3) m, ``triangles`` (T, 3) counter-clockwise seen from outside, ``uv`` (V, 2), zero where no
    texture is meant."""

    vertices: Array
    triangles: Indices
    uv: Array

    def transformed(self, t: ArrayLike, R: ArrayLike | None = None) -> Mesh:
        """The mesh at R X + t; without R it only shifts."""
        turned = self.vertices if R is None else self.vertices @ np.asarray(R, float).T
        return Mesh(turned + np.asarray(t, float), self.triangles, self.uv)

    def mirrored(self) -> Mesh:
        """Its image across the plane y = 0."""
        return Mesh(self.vertices * np.array([1.0, -1.0, 1.0]), self.triangles[:, ::-1], self.uv)

    def with_mirror_image(self) -> Mesh:
        """The mesh and its image across the plane y = 0."""
        return join_meshes([self, self.mirrored()])

    def with_material(self, name: str, material: Material, smooth: bool = False) -> SceneMesh:
        """The mesh made of ``material``; its texture coordinates go with it where the material has a texture."""
        textured = material.texture is not None or material.alpha is not None
        return SceneMesh(name, self.vertices, self.triangles, material, self.uv if textured else None, smooth)


NamedMesh = tuple[str, Mesh]  # a mesh and the name of what it is made of


def join_meshes(meshes: Iterable[Mesh]) -> Mesh:
    """All ``meshes`` (at least one) as one; no vertices are welded."""
    parts = list(meshes)
    starts = np.cumsum([0, *(len(m.vertices) for m in parts[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in parts]),
        np.concatenate([m.triangles + n for m, n in zip(parts, starts, strict=True)]),
        np.concatenate([m.uv for m in parts]),
    )


def sheet(points: ArrayLike, uv: ArrayLike | None = None) -> Mesh:
    """The surface through a grid of points (H, W, 3); its outer side is that from which the rows go down where the
    columns go right. ``uv`` (H, W, 2) defaults to the unit square."""
    p = np.asarray(points, float)
    h, w = p.shape[:2]
    if uv is None:
        uv = np.stack(np.meshgrid(np.linspace(0, 1, w), np.linspace(0, 1, h)), -1)
    k = np.arange(h * w).reshape(h, w)
    a, b, c, d = k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]
    triangles = np.stack([np.stack([a, d, c], -1), np.stack([a, c, b], -1)], 2)
    return Mesh(p.reshape(-1, 3), triangles.reshape(-1, 3), np.asarray(uv, float).reshape(-1, 2))


def quads(corners: ArrayLike) -> Mesh:
    """Flat rectangles (N, 4, 3), each with corners top-left, top-right, bottom-right, bottom-left seen from outside."""
    p = np.asarray(corners, float).reshape(-1, 4, 3)
    first = 4 * np.arange(len(p))[:, None]
    triangles = np.concatenate([first + [0, 3, 2], first + [0, 2, 1]])
    return Mesh(p.reshape(-1, 3), triangles, np.tile([[0.0, 0.0], [1, 0], [1, 1], [0, 1]], (len(p), 1)))


_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_BOX_FACES = [[5, 7, 6, 4], [3, 1, 0, 2], [7, 3, 2, 6], [1, 5, 4, 0], [3, 7, 5, 1], [6, 2, 0, 4]]  # ±x, ±y, ±z


def box(size: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
    """A box with edges along the axes."""
    return quads((_BOX_CORNERS * np.asarray(size, float) + np.asarray(center, float))[_BOX_FACES])


def boxes(sizes: ArrayLike, centers: ArrayLike) -> Mesh:
    """Many boxes: sizes and centres (N, 3)."""
    corners = _BOX_CORNERS * np.asarray(sizes, float)[:, None] + np.asarray(centers, float)[:, None]
    return quads(corners[:, _BOX_FACES].reshape(-1, 4, 3))


def revolve(profile: ArrayLike, count: int = 24) -> Mesh:
    """A profile (N, 2) of radii and heights, from the bottom up, turned about the z axis; outside is away from it."""
    radius, height = np.asarray(profile, float)[::-1].T
    angle = np.linspace(0, 2 * np.pi, count + 1)
    x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    return sheet(np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], -1))


def tube(path: ArrayLike, radius: ArrayLike, count: int = 8) -> Mesh:
    """A round tube along a path (N, 3) without sharp corners; ``radius`` is one or (N,)."""
    p = np.asarray(path, float)
    along = np.gradient(p, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    helper = np.eye(3)[np.argmin(np.abs(along).max(0))]  # the axis that the path follows least
    side = np.cross(along, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    angle = np.linspace(0, 2 * np.pi, count + 1)[:, None]
    r = np.broadcast_to(np.asarray(radius, float), len(p))[:, None, None]
    rim = np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]
    return sheet((p[:, None] + r * rim)[:, ::-1])


def ellipsoid(center: ArrayLike, radii: ArrayLike, rings: int = 10, count: int = 16) -> Mesh:
    """An ellipsoid with its axes along the coordinate axes."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    ball = revolve(np.column_stack([np.cos(latitude), np.sin(latitude)]), count)
    return Mesh(ball.vertices * np.asarray(radii, float) + np.asarray(center, float), ball.triangles, ball.uv)


def weld(mesh: Mesh, cell_size: float = 1e-5) -> Mesh:
    """The mesh with vertices at the same place (m) made one; triangles that vanish are left out."""
    cells = np.round(mesh.vertices / cell_size).astype(np.int64)
    _, first, label = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    t = label.reshape(-1)[mesh.triangles]
    nondegenerate = (t[:, 0] != t[:, 1]) & (t[:, 1] != t[:, 2]) & (t[:, 2] != t[:, 0])
    return Mesh(mesh.vertices[first], t[nondegenerate], mesh.uv[first])


def triangle_normals(mesh: Mesh) -> Array:
    """Outward normals (T, 3) of its triangles, as long as twice their areas."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return np.asarray(np.cross(b - a, c - a))


def split_creases(mesh: Mesh, degrees: float = 35.0) -> Mesh:
    """The mesh with its vertices parted along the edges where it bends by more than ``degrees``.

    Corners of two triangles stay one where the triangles meet in an edge that bends less: vertices are the connected
    components of that relation.
    """
    t, count = mesh.triangles, len(mesh.triangles)
    n = triangle_normals(mesh)
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)
    corner = np.arange(3 * count).reshape(count, 3)
    begin, end = t.reshape(-1), np.roll(t, -1, 1).reshape(-1)
    key = np.minimum(begin, end) * len(mesh.vertices) + np.maximum(begin, end)
    order = np.argsort(key, kind="stable")
    i, j = order[:-1], order[1:]
    met = (key[i] == key[j]) & ((n[i // 3] * n[j // 3]).sum(1) > np.cos(np.radians(degrees)))
    i, j = i[met], j[met]
    at_begin, at_end = corner.reshape(-1), np.roll(corner, -1, 1).reshape(-1)
    same = begin[i] == begin[j]  # else the two triangles run along the edge in opposite senses, as they should
    pairs = np.concatenate(
        [
            np.stack([at_begin[i], np.where(same, at_begin[j], at_end[j])]),
            np.stack([at_end[i], np.where(same, at_end[j], at_begin[j])]),
        ],
        1,
    )
    links = coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(3 * count, 3 * count))
    _, label = connected_components(links, directed=False)
    _, first = np.unique(label, return_index=True)
    source = t.reshape(-1)[first]
    return Mesh(mesh.vertices[source], label.reshape(-1, 3).astype(np.int64), mesh.uv[source])


def group_by_name(named: Iterable[NamedMesh]) -> dict[str, Mesh]:
    """The parts of each name joined, in the order in which the names first occur."""
    parts: dict[str, list[Mesh]] = {}
    for name, mesh in named:
        parts.setdefault(name, []).append(mesh)
    return {name: join_meshes(meshes) for name, meshes in parts.items()}
