"""The draft of a vehicle, to which its meshes, wheels and edges are added one after another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from paceline.arrays import Array
from paceline.simulation.raytraced.mesh_builders import Mesh, NamedMesh
from paceline.simulation.raytraced.vehicles.sheet_metal import BodyBand


@dataclass
class VehicleDraft:
    """Meshes by the name of what they are made of, wheels (meshes, centre, radius), strong edges (2, 3) and the
    outlined rectangle (width, bottom, top) of each end. ``size`` is length, width without mirrors, and height."""

    wheelbase: float
    size: tuple[float, float, float]
    meshes: list[NamedMesh] = field(default_factory=list)
    wheels: list[tuple[dict[str, Mesh], Array, float]] = field(default_factory=list)
    edges: dict[str, list[Array]] = field(default_factory=lambda: {"front": [], "rear": []})
    outlined: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    def add(self, named: Iterable[NamedMesh]) -> None:
        """Parts of the left half, and their mirror images."""
        self.meshes += [(name, mesh.with_mirror_image()) for name, mesh in named]

    def axle(self, mesh: dict[str, Mesh], x: float, y: float, radius: float) -> None:
        """A pair of wheels."""
        self.wheels.append((mesh, np.array([x, y, radius]), radius))
        self.wheels.append(({n: m.mirrored() for n, m in mesh.items()}, np.array([x, -y, radius]), radius))

    def edge(self, end: str, a: Array, b: Array) -> None:
        """A strong edge from a to b (3,), upright or level, whichever it is more; and its mirror image unless it
        crosses the middle."""
        a, b = np.array(a), np.array(b)
        same = 2 if abs(a[1] - b[1]) > abs(a[2] - b[2]) else 1
        a[same] = b[same] = (a[same] + b[same]) / 2
        self.edges[end].append(np.stack([a, b]))
        if not np.allclose(a * [1, -1, 1], b):
            self.edges[end].append(np.stack([a, b]) * [1, -1, 1])

    def level(self, end: str, b: BodyBand, y: float, z: float) -> None:
        """A horizontal edge across the middle, ``y`` to each side."""
        a = b.points(b.across(y, end), z)
        self.edge(end, a, a * [1, -1, 1])

    def frame(self, end: str, corners: tuple[Array, Array], sides: str = "lrtb") -> None:
        """The ``sides`` of an upright rectangle between two opposite corners (3,), mirrored as `edge` does."""
        (x0, y0, z0), (x1, y1, z1) = corners
        lines = {
            "l": ((x0, y0, z0), (x0, y0, z1)),
            "r": ((x1, y1, z0), (x1, y1, z1)),
            "b": ((x0, y0, z0), (x1, y1, z0)),
            "t": ((x0, y0, z1), (x1, y1, z1)),
        }
        for side in sides:
            a, b = lines[side]
            self.edge(end, np.array(a), np.array(b))
