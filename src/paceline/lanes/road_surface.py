"""The road's surface in space: a quadratic height above a plane below the left camera.

Ground coordinates (x, z) are metres to the right and ahead of the point below the left camera; the surface has the
height  h(x, z) = Σ cⱼ φⱼ(x, z)  above the plane they are measured in. The φⱼ are 1, x, z, x², xz and z² about a
``middle``, in units of `SURFACE_SCALE_M`, which represents crest, sag, crossfall and changing superelevation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig

SURFACE_SCALE_M = 30.0  # distance at which each φⱼ is about 1
HEIGHT_TERMS = 6  # number of the φⱼ
NEWTON_STEPS = 5  # steps after which the error on roads is below a micrometre
MAX_RAY_M = 2e3  # length of a viewing ray


@dataclass(frozen=True, eq=False)
class RoadSurface:
    """A ground frame and the surface above it.

    ``origin`` (3,) and ``axes`` (3, 3), columns right, up and ahead, are in the world frame; ``heights`` (6,) are the
    cⱼ in metres, ``middle`` (2,) where the φⱼ are centred.
    """

    origin: Array
    axes: Array
    middle: Array
    heights: Array

    def basis(self, ground: Array) -> Array:
        """The φⱼ (…, 6) at ``ground`` (…, 2)."""
        x, z = np.moveaxis((np.asarray(ground, float) - self.middle) / SURFACE_SCALE_M, -1, 0)
        return np.stack([np.ones_like(x), x, z, x * x, x * z, z * z], axis=-1)

    def points(self, ground: Array) -> Array:
        """World points (…, 3) of the surface at ``ground`` (…, 2)."""
        g = np.asarray(ground, float)
        h = self.basis(g) @ self.heights
        local = np.stack([g[..., 0], h, g[..., 1]], axis=-1)
        return np.asarray(self.origin + local @ self.axes.T)

    def slopes(self, ground: Array) -> Array:
        """∂h/∂x and ∂h/∂z (…, 2) at ``ground`` (…, 2)."""
        x, z = np.moveaxis((np.asarray(ground, float) - self.middle) / SURFACE_SCALE_M, -1, 0)
        _, right, ahead, xx, xz, zz = self.heights / SURFACE_SCALE_M
        return np.stack([right + 2 * xx * x + xz * z, ahead + xz * x + 2 * zz * z], axis=-1)

    def intersect(self, centre: Array, rays: Array) -> Array:
        """Ground coordinates (…, 2) where ``rays`` (…, 3) from a ``centre`` (3,) meet the surface; NaN where none does.

        Newton's method along each ray, from where it meets the plane.
        """
        start, towards = self.axes.T @ (centre - self.origin), rays @ self.axes
        level = [0, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -start[1] / towards[..., 1]
            for _ in range(NEWTON_STEPS):
                depth = np.where((depth > 0) & (depth < MAX_RAY_M), depth, np.nan)
                ground = start[level] + depth[..., None] * towards[..., level]
                above = start[1] + depth * towards[..., 1] - self.basis(ground) @ self.heights
                depth = depth - above / (towards[..., 1] - (self.slopes(ground) * towards[..., level]).sum(-1))
        return np.asarray(start[level] + depth[..., None] * towards[..., level])

    def ground_at(self, rig: StereoRig, side: int, pixels: Array) -> Array:
        """Ground coordinates (…, 2) of the surface at ideal ``pixels`` (…, 2) of the left (0) or right (1) view."""
        centre, rays = viewing_rays(rig, side, pixels)
        return self.intersect(centre, rays)

    def with_heights(self, heights: Array) -> RoadSurface:
        return replace(self, heights=heights)


def viewing_rays(rig: StereoRig, side: int, pixels: Array) -> tuple[Array, Array]:
    """Centre (3,) of a camera of ``rig`` and the directions (…, 3) of its ``pixels`` (…, 2), in the world."""
    rays = rig.cameras[side].rays(pixels)
    return rig.centres[side], rays if side == 0 else rays @ rig.R


def plane_surface(normal: Array, distance: float, middle_ahead: float) -> RoadSurface:
    """The plane ``normal``·X = ``distance`` m below the left camera, ``normal`` (3,) pointing down."""
    down = normal / np.linalg.norm(normal)
    ahead = np.array([0.0, 0.0, 1.0]) - down[2] * down
    ahead /= np.linalg.norm(ahead)
    axes = np.stack([np.cross(down, ahead), -down, ahead], axis=1)
    return RoadSurface(distance * down, axes, np.array([0.0, middle_ahead]), np.zeros(HEIGHT_TERMS))
