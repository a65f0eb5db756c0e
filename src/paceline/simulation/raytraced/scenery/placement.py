"""Placement of the objects beside a road: trees, bushes, poles, signs, buildings, rails and fences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.simulation.raytraced.mesh_builders import NamedMesh, group_by_name
from paceline.simulation.raytraced.meshes import Material, SceneMesh
from paceline.simulation.raytraced.road_surface import VERGE_DROP_M, VERGE_WIDTH_M
from paceline.simulation.raytraced.scenery import buildings as built
from paceline.simulation.raytraced.scenery import posts, trees
from paceline.simulation.road import Road

Generator = np.random.Generator


@dataclass(frozen=True)
class Scenery:
    """``trees``, ``poles`` and ``buildings`` are densities from 0 (none) to 1 (close together); a ``parapet`` or guard
    rail runs along both edges of the road. Nothing but parapets stands within the circles ``clear``: arc length,
    lateral and radius in metres, such as around a camera and before it."""

    trees: float = 0.5
    poles: float = 0.3
    buildings: float = 0.0
    parapet: bool = False
    seed: int = 0
    clear: tuple[tuple[float, float, float], ...] = ()


def build_scenery(road: Road, spec: Scenery, start: float, end: float) -> list[SceneMesh]:
    """All that stands beside ``road`` from arc length ``start`` to ``end``; the same for the same ``spec``."""
    rng = np.random.default_rng([spec.seed, 41])
    place = _Placer(road, spec, start, end)
    named = [
        *_place_trees(rng, place, spec.trees),
        *_place_poles(rng, place, spec.poles),
        *_place_houses(rng, place, spec.buildings),
        *_place_barriers(rng, place, spec),
    ]
    made_of = _make_materials(rng)
    return [mesh.with_material(name, made_of[name]) for name, mesh in group_by_name(named).items()]


def _make_materials(rng: Generator) -> dict[str, Material]:
    colors = {
        "wood": (0.09, 0.07, 0.05),
        "timber": (0.16, 0.12, 0.08),
        "white": (0.55, 0.55, 0.54),
        "black": (0.02, 0.02, 0.02),
        "frame": (0.5, 0.5, 0.48),
        "roof": tuple(np.array([[0.16, 0.06, 0.04], [0.07, 0.07, 0.08]])[rng.integers(2)].tolist()),
    }
    textures = {
        "leaves": trees.leaf_palette(rng),
        "wall": built.wall_texture(rng),
        "concrete": built.concrete_texture(rng),
        "round sign": posts.round_sign_texture(rng),
        "board": posts.board_texture(rng),
    }
    result = {name: Material("matte", color) for name, color in colors.items()}
    result |= {name: Material("matte", tuple(t.mean((0, 1)).tolist()), t) for name, t in textures.items()}
    result["steel"] = Material("metal", (0.42, 0.43, 0.44), roughness=0.4)
    result["pane"] = Material("glass", (0.02, 0.025, 0.03), roughness=0.02)
    return result


class _Placer:
    """Finds places beside a road, away from the clear circles."""

    def __init__(self, road: Road, spec: Scenery, start: float, end: float) -> None:
        self.road, self.start, self.end = road, start, end
        clearings = [(road.frame(s, lateral)[0], radius) for s, lateral, radius in spec.clear]
        self.clear = np.array([[*p[:2], r] for p, r in clearings]).reshape(-1, 3)
        self._axis = road.frame(np.arange(start, end, 2.0))[0][:, :2]

    def is_beside(self, s: float, lateral: float) -> bool:
        """Whether a place is about as far from the whole road as from its own arc length: in a bend it may not be."""
        point = self.road.frame(s, lateral)[0][:2]
        return bool(np.linalg.norm(self._axis - point, axis=1).min() > 0.8 * abs(lateral))

    def stations(self, rng: Generator, spacing: float, probability: float) -> Array:
        """Arc lengths about ``spacing`` apart, each there with the given ``probability``."""
        s = np.arange(self.start, self.end, spacing)
        s = s + rng.uniform(0, spacing, len(s))
        return s[(rng.random(len(s)) < probability) & (s < self.end)]

    def stretches(self, lateral: float, start: float, end: float) -> list[tuple[float, float]]:
        """The parts, 5 m long at least, of the line at ``lateral`` that lie in no clear circle."""
        s = np.linspace(start, end, int(end - start) + 2)
        distance = np.linalg.norm(self.road.frame(s, lateral)[0][:, None, :2] - self.clear[:, :2], axis=2)
        free = s[(distance > self.clear[:, 2] + 1.0).all(1)]
        parts = np.split(free, np.flatnonzero(np.diff(free) > 1.5) + 1)
        return [(float(p[0]), float(p[-1])) for p in parts if len(p) and p[-1] - p[0] >= 5.0]

    def put(
        self, named: list[NamedMesh], s: float, lateral: float, turn: float = 0.0, min_clearance: float = 0.0
    ) -> list[NamedMesh]:
        """Parts moved to a place; their x along the road, turned by ``turn``, their y away from it. Nothing where a
        clear circle is nearer than ``min_clearance`` metres."""
        point, axes = self.road.frame(s, lateral)
        clearance = np.hypot(*(self.clear[:, :2] - point[:2]).T) - self.clear[:, 2]
        if (clearance < min_clearance).any():
            return []
        off_road = abs(lateral) - self.road.half_width
        forward = axes[:2, 0] if lateral < 0 else -axes[:2, 0]
        angle = np.arctan2(forward[1], forward[0]) + turn
        c, k = np.cos(angle), np.sin(angle)
        down = VERGE_DROP_M * np.clip(off_road / VERGE_WIDTH_M, 0, 1)
        R = np.array([[c, -k, 0], [k, c, 0], [0, 0, 1.0]])
        return [(name, mesh.transformed(point - [0, 0, down], R)) for name, mesh in named]


def _place_trees(rng: Generator, place: _Placer, density: float) -> list[NamedMesh]:
    """Rows of trees whose crowns reach over the road, bushes under them, and a wood behind."""
    if density <= 0:
        return []
    near = [trees.tree(rng, rng.uniform(6, 11)) for _ in range(5)]
    far = [trees.tree(rng, rng.uniform(9, 16), 0.25) for _ in range(4)]
    low = [trees.bush(rng, rng.uniform(0.8, 2.0)) for _ in range(3)]
    edge = place.road.half_width
    rows: list[tuple[list[trees.Tree], float, float, tuple[float, float], float]] = [
        (near, 7.0, density, (1.8, 6.5), 3.5),
        (low, 6.0, 0.6 * density, (2.5, 9.0), 1.5),
        (far, 9.0, min(1.0, 0.3 + density), (25.0, 60.0), 6.0),
        (far, 9.0, min(1.0, 0.3 + density), (60.0, 120.0), 6.0),
    ]
    result: list[NamedMesh] = []
    for kinds, spacing, probability, (inner, outer), room in rows:
        for side in (-1, 1):
            for s in place.stations(rng, spacing, probability):
                kind = kinds[rng.integers(len(kinds))]
                lateral = side * (edge + rng.uniform(inner, outer))
                turn = rng.uniform(0, 2 * np.pi)
                if place.is_beside(float(s), lateral):
                    result += place.put([("wood", kind.wood), ("leaves", kind.leaves)], float(s), lateral, turn, room)
    return result


def _place_poles(rng: Generator, place: _Placer, density: float) -> list[NamedMesh]:
    """Lamp posts or utility poles in a row on one side, signs and markers on both."""
    pole_side = int(rng.choice([-1, 1]))
    make: Callable[[Generator], list[NamedMesh]] = posts.lamp_post if rng.random() < 0.5 else posts.utility_pole
    pole, edge = make(rng), place.road.half_width
    result: list[NamedMesh] = []
    for s in np.arange(place.start + rng.uniform(0, 30), place.end, 30.0):
        if rng.random() < density:
            result += place.put(pole, float(s), pole_side * (edge + 1.2), 0.0, 0.3)
    for side in (-1, 1):
        for s in place.stations(rng, 45.0, density):
            result += place.put(posts.sign(rng), float(s), side * (edge + 1.6), 0.0, 0.8)
        for s in np.arange(place.start + 5, place.end, 25.0) if density > 0 else ():
            result += place.put(posts.marker(rng), float(s), side * (edge + 0.6), np.pi / 2, 0.1)
    return result


def _place_houses(rng: Generator, place: _Placer, density: float) -> list[NamedMesh]:
    result: list[NamedMesh] = []
    for side in (-1, 1):
        for s in place.stations(rng, 22.0, density):
            lateral = side * (place.road.half_width + rng.uniform(12, 22))
            result += place.put(built.house(rng), float(s), lateral, rng.normal(0, 0.08), 8.0)
    return result


def _place_barriers(rng: Generator, place: _Placer, spec: Scenery) -> list[NamedMesh]:
    """A parapet of concrete or a guard rail on both sides, or here and there a fence."""
    road, start, end = place.road, max(place.start, 0.0), min(place.end, place.road.length)
    result: list[NamedMesh] = []
    if spec.parapet:
        make = built.wall if rng.random() < 0.5 else built.guard_rail
        for side in (-1, 1):
            result += make(road, side, start, end)
    elif rng.random() < 0.5 * (spec.trees + spec.buildings):
        side = int(rng.choice([-1, 1]))
        for a, b in place.stretches(side * (road.half_width + built.FENCE_DISTANCE_M), start, end):
            result += built.fence(road, side, a, b)
    return result
