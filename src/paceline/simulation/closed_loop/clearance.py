"""Vehicles as rectangles in plan view, and the distance between them."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array


def vehicle_outline(x: float, y: float, heading: float, back: float, front: float, width: float) -> Array:
    """Corners (4, 2), m, of a vehicle that reaches from ``back`` to ``front`` metres ahead of (x, y)."""
    c, s, half = np.cos(heading), np.sin(heading), width / 2
    ends = np.array([[back, -half], [front, -half], [front, half], [back, half]])
    return np.asarray(ends @ np.array([[c, s], [-s, c]]) + (x, y))


def outline_distance(a: Array, b: Array) -> float:
    """The least distance (m) between two convex outlines (N, 2) and (M, 2); 0 where they touch or overlap."""
    if not (_separated(a, b) or _separated(b, a)):
        return 0.0
    return float(min(_edge_distances(a, b).min(), _edge_distances(b, a).min()))


def _separated(a: Array, b: Array) -> bool:
    """Whether the line along an edge of ``a`` lies between both."""
    edges = np.roll(a, -1, axis=0) - a
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    p, q = a @ normals.T, b @ normals.T
    return bool(((p.max(0) < q.min(0)) | (q.max(0) < p.min(0))).any())


def _edge_distances(points: Array, polygon: Array) -> Array:
    """Distances (N, M) from points to the edges of a polygon."""
    start, along = polygon, np.roll(polygon, -1, axis=0) - polygon
    d = points[:, None] - start
    share = np.clip((d * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(d - share[..., None] * along, axis=-1))
