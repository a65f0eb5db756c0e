"""Vehicles with real relief, procedural and seeded; see `body` for what they are to a world."""

from __future__ import annotations

import numpy as np

from paceline.errors import UnusableInput
from paceline.simulation.raytraced.mesh_builders import Mesh, creased, grouped, welded
from paceline.simulation.raytraced.meshes import Material, Solid
from paceline.simulation.raytraced.vehicles.body import Body, Plane, Wheel, plane_over
from paceline.simulation.raytraced.vehicles.builder import Draft
from paceline.simulation.raytraced.vehicles.cars import car
from paceline.simulation.raytraced.vehicles.lorry import lorry
from paceline.simulation.raytraced.vehicles.motorcycle import motorcycle
from paceline.simulation.raytraced.vehicles.parts import materials
from paceline.simulation.raytraced.vehicles.vans import bus, van
from paceline.simulation.vehicle_catalogue import MODELLED

__all__ = ["Body", "Plane", "Wheel", "build"]


def build(kind: str, seed: int) -> Body:
    """A vehicle of one of `MODELLED`; the same for the same seed. Raises UnusableInput for any other kind."""
    if kind not in MODELLED:
        raise UnusableInput(f"vehicle kind {kind!r}: expected one of {', '.join(MODELLED)}")
    rng = np.random.default_rng([seed, 43, MODELLED.index(kind)])
    made_of = materials(rng, fleet=kind in ("bus", "lorry"))
    draft = _draft(kind, rng)
    solids = tuple(_solid(name, mesh, made_of) for name, mesh in grouped(draft.meshes).items())
    wheels = tuple(
        Wheel(_solid(name, mesh, made_of), center, radius)
        for named, center, radius in draft.wheels
        for name, mesh in named.items()
    )
    front, rear = (plane_over(solids, end, *draft.outlined[end]) for end in ("front", "rear"))
    edges = {end: np.array(found) for end, found in draft.edges.items()}
    return Body(kind, *draft.size, draft.wheelbase, solids, wheels, front, rear, edges)


def _solid(name: str, mesh: Mesh, made_of: dict[str, Material]) -> Solid:
    return creased(welded(mesh), 38.0).solid(name, made_of[name], smooth=True)


def _draft(kind: str, rng: np.random.Generator) -> Draft:
    match kind:
        case "van":
            return van(rng)
        case "bus":
            return bus(rng)
        case "lorry":
            return lorry(rng)
        case "motorcycle":
            return motorcycle(rng)
        case _:
            return car(rng, estate=kind == "estate")
