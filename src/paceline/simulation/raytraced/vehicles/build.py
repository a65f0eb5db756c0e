"""Builds vehicles with real relief, procedurally from a seed; see `body` for the result."""

from __future__ import annotations

import numpy as np

from paceline.errors import UnusableInput
from paceline.simulation.raytraced.mesh_builders import Mesh, group_by_name, split_creases, weld
from paceline.simulation.raytraced.meshes import Material, SceneMesh
from paceline.simulation.raytraced.vehicles.body import Body, Plane, Wheel, end_plane
from paceline.simulation.raytraced.vehicles.builder import VehicleDraft
from paceline.simulation.raytraced.vehicles.cars import draft_car
from paceline.simulation.raytraced.vehicles.lorry import draft_lorry
from paceline.simulation.raytraced.vehicles.materials import vehicle_materials
from paceline.simulation.raytraced.vehicles.motorcycle import draft_motorcycle
from paceline.simulation.raytraced.vehicles.vans import draft_bus, draft_van
from paceline.simulation.vehicle_catalogue import RAYTRACED_KINDS

__all__ = ["Body", "Plane", "Wheel", "build"]


def build(kind: str, seed: int) -> Body:
    """A vehicle of one of `RAYTRACED_KINDS`; the same for the same seed. Raises UnusableInput for any other kind."""
    if kind not in RAYTRACED_KINDS:
        raise UnusableInput(f"vehicle kind {kind!r}: expected one of {', '.join(RAYTRACED_KINDS)}")
    rng = np.random.default_rng([seed, 43, RAYTRACED_KINDS.index(kind)])
    made_of = vehicle_materials(rng, fleet=kind in ("bus", "lorry"))
    draft = _draft_vehicle(kind, rng)
    solids = tuple(_make_mesh(name, mesh, made_of) for name, mesh in group_by_name(draft.meshes).items())
    wheels = tuple(
        Wheel(_make_mesh(name, mesh, made_of), center, radius)
        for named, center, radius in draft.wheels
        for name, mesh in named.items()
    )
    front, rear = (end_plane(solids, end, *draft.outlined[end]) for end in ("front", "rear"))
    edges = {end: np.array(found) for end, found in draft.edges.items()}
    return Body(kind, *draft.size, draft.wheelbase, solids, wheels, front, rear, edges)


def _make_mesh(name: str, mesh: Mesh, made_of: dict[str, Material]) -> SceneMesh:
    return split_creases(weld(mesh), 38.0).with_material(name, made_of[name], smooth=True)


def _draft_vehicle(kind: str, rng: np.random.Generator) -> VehicleDraft:
    match kind:
        case "van":
            return draft_van(rng)
        case "bus":
            return draft_bus(rng)
        case "lorry":
            return draft_lorry(rng)
        case "motorcycle":
            return draft_motorcycle(rng)
        case _:
            return draft_car(rng, estate=kind == "estate")
