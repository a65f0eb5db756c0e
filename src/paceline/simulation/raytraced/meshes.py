"""Triangle meshes with materials, of which every world is built, for any renderer.

Every world has x east, y north and z up, in metres; a body's own axes are x forward, y left and z up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Indices

Texture = NDArray[np.float32]
Placement = tuple[Array, Array]  # R (3, 3) and t (3,): world = R X + t


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface reflects or emits light; `renderer` has the BSDF of each kind.

    ``kind`` is "matte" (diffuse), "paint" (a diffuse coat under clear varnish), "glass" (a dark pane that mirrors),
    "metal" or "glow" (a lamp). ``color`` is the linear reflectance (3,), or, for a lamp, the radiance; ``texture``
    (H, W, 3), linear, replaces it where the solid has texture coordinates (v = 0 is the first row), and ``alpha``
    (H, W) is its opacity. ``roughness`` is that of the specular part.
    """

    kind: str
    color: tuple[float, float, float]
    texture: Texture | None = None
    alpha: Texture | None = None
    roughness: float = 0.1


@dataclass(frozen=True, eq=False)
class SceneMesh:
    """A mesh: ``vertices`` (V, 3) m, ``triangles`` (T, 3), counter-clockwise seen from outside, ``uv`` (V, 2) where its
    material has a texture. Vertices are shared only where the surface is smooth; ``smooth`` shades it so."""

    name: str
    vertices: Array
    triangles: Indices
    material: Material
    uv: Array | None = None
    smooth: bool = False

    def transformed(self, R: Array, t: Array) -> SceneMesh:
        """The solid at R X + t."""
        return replace(self, vertices=self.vertices @ np.asarray(R).T + t)
