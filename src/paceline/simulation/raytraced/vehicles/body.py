"""A finished vehicle: its meshes, its rotating wheels, and the planes that an operator would outline."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from paceline.arrays import Array
from paceline.simulation.raytraced.meshes import SceneMesh


@dataclass(frozen=True, eq=False)
class Plane:
    """A vertical rectangle across a body, ``center`` (3,) in body axes, ``width`` × ``height`` m; ``end`` is "front"
    or "rear"."""

    center: Array
    width: float
    height: float
    end: str

    def corners(self) -> Array:
        """Corners (4, 3), body axes: top-left, top-right, bottom-right, bottom-left as seen from outside."""
        right = 1.0 if self.end == "front" else -1.0
        y, z = right * self.width / 2, self.height / 2
        return np.asarray(self.center + np.array([[0, -y, z], [0, y, z], [0, y, -z], [0, -y, -z]]))


@dataclass(frozen=True, eq=False)
class Wheel:
    """A part of a wheel: ``mesh`` about the wheel's centre with its axle along y, ``center`` (3,) in body axes,
    ``radius`` of the tyre, m. A tyre and its rim are two of these."""

    mesh: SceneMesh
    center: Array
    radius: float


@dataclass(frozen=True, eq=False)
class Body:
    """A vehicle in body axes: x forward, y left, z up, the origin on the road below the middle of the rear axle.

    ``length``, ``width`` (without mirrors) and ``height`` in metres; ``edges`` holds, for each end, its strong straight
    edges.
    """

    kind: str
    length: float
    width: float
    height: float
    wheelbase: float
    meshes: tuple[SceneMesh, ...]
    wheels: tuple[Wheel, ...]
    front: Plane
    rear: Plane
    edges: dict[str, Array]

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """The least and the greatest coordinates (3,) of its meshes."""
        vertices = np.concatenate([mesh.vertices for mesh in self.meshes])
        return vertices.min(0), vertices.max(0)

    def lines(self, end: str) -> Array:
        """The strong straight edges (S, 2, 3), horizontal or vertical, on or near the plane of ``end`` ("front" or
        "rear"), body axes."""
        return self.edges[end]


def end_plane(solids: Iterable[SceneMesh], end: str, width: float, bottom: float, top: float) -> Plane:
    """The plane of an end ``width`` m across from height ``bottom`` to ``top``, at the area-weighted mean depth of
    what is seen there from straight ahead; as bodies are symmetric, of their left half."""
    y, z = np.meshgrid((np.arange(20) + 0.5) / 40 * width, bottom + (np.arange(24) + 0.5) / 24 * (top - bottom))
    depth = visible_depth(solids, end, np.column_stack([y.ravel(), z.ravel()]))
    return Plane(np.array([np.nanmean(depth), 0.0, (bottom + top) / 2]), width, top - bottom, end)


def visible_depth(solids: Iterable[SceneMesh], end: str, points: Array) -> Array:
    """x (N,) of the surface first met at each (y, z) of ``points`` (N, 2) by who looks along the body's axis at the
    ``end``; nan where there is none."""
    sign = 1.0 if end == "front" else -1.0
    nearest = np.full(len(points), -np.inf)
    low, high = points.min(0), points.max(0)
    for solid in solids:
        a, b, c = np.moveaxis(solid.vertices[solid.triangles], 1, 0)
        facing = sign * np.cross(b - a, c - a)[:, 0] > 1e-12
        corners = np.stack([a, b, c], 1)[..., 1:]
        candidates = facing & (corners.max(1) >= low).all(1) & (corners.min(1) <= high).all(1)
        a, b, c = a[candidates, None], b[candidates, None], c[candidates, None]
        u, v, p = (b - a)[..., 1:], (c - a)[..., 1:], points - a[..., 1:]
        area = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
        s = (p[..., 0] * v[..., 1] - p[..., 1] * v[..., 0]) / area
        t = (u[..., 0] * p[..., 1] - u[..., 1] * p[..., 0]) / area
        x = a[..., 0] + s * (b - a)[..., 0] + t * (c - a)[..., 0]
        hit = (s >= 0) & (t >= 0) & (s + t <= 1)
        nearest = np.maximum(nearest, np.where(hit, sign * x, -np.inf).max(0, initial=-np.inf))
    return np.where(np.isfinite(nearest), sign * nearest, np.nan)
