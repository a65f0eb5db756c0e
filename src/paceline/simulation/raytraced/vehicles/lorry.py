"""Lorries: a cab over the front axle and a box on a frame."""

from __future__ import annotations

import numpy as np

from paceline.simulation.raytraced.mesh_builders import NamedMesh, box, boxes, revolve, tube
from paceline.simulation.raytraced.vehicles import parts
from paceline.simulation.raytraced.vehicles.builder import VehicleDraft
from paceline.simulation.raytraced.vehicles.cabin import loft_cabin
from paceline.simulation.raytraced.vehicles.hull import HullShape, hull_band, hull_walls
from paceline.simulation.raytraced.vehicles.sheet_metal import BodyBand, PanelFeature


def draft_lorry(rng: np.random.Generator) -> VehicleDraft:
    """A rigid lorry with a box body."""
    wheelbase = rng.uniform(4.3, 5.3)
    front, rear = wheelbase + rng.uniform(1.25, 1.4), -rng.uniform(1.9, 2.5)
    half = rng.uniform(1.16, 1.25)
    cab_rear = front - rng.uniform(1.95, 2.25)
    lip, height = rng.uniform(1.3, 1.45), rng.uniform(2.6, 2.95)
    radius, bumper = rng.uniform(0.46, 0.5), rng.uniform(0.72, 0.82)
    cowl, header = front - 0.27, front - rng.uniform(0.5, 0.7)
    step = rng.uniform(0.05, 0.09)
    form = HullShape(
        front=front,
        rear=cab_rear,
        half=half,
        low=0.42,
        lip=lip,
        belt=lip + 0.08,
        deck=lip + 0.08,
        cowl=(cowl, lip + 0.08),
        header=(header, height - 0.06),
        rear_header=(cab_rear + 0.1, height - 0.06),
        rear_base=(cab_rear + 0.03, lip + 0.1),
        half_roof=half * 0.9,
        panes=((header, cab_rear + 0.75),),
        bumps=((0.42, -0.05), (0.5, 0.0), (bumper - 0.03, 0.0), (bumper, -step), (lip, -step - 0.05)),
        tail=((0.42, 0.0), (lip, 0.0)),
        section=((0.42, 0.98), (0.8, 1.0), (lip, 0.99)),
        knee=bumper,
        axles=(wheelbase,),
        arch=radius + 0.09,
        axle_height=radius,
        bow=0.18,
        rear_bow=0.06,
        wrap=0.2,
        doors=(cowl - 0.25, cab_rear + 0.6),
        rear_pane=False,
    )
    b = hull_band(form)
    draft = VehicleDraft(wheelbase, (front - rear, 2 * half, 0.0))
    shell = loft_cabin(form, b) + hull_walls(
        form, b, _face(rng, form, b, draft, bumper), [PanelFeature("paint", (0, b.length), (0.42, lip))]
    )
    arm = np.array([[header - 0.12, 0.88 * half, height - 0.32], [cowl, half + 0.07, height - 0.33]])
    shell += [("plastic", tube(arm, 0.02, 6)), *parts.mirror(arm[1] + [0, 0.05, -0.25], 1.9, "plastic")]
    shell += parts.wiper([cowl, 0.05, lip + 0.14], [cowl - 0.16, 0.7, lip + 0.4], 0.05)
    top = _load(rng, draft, cab_rear - 0.12, rear, half * rng.uniform(1.0, 1.03))
    draft.add(shell)
    draft.size = (front - rear, 2 * half, max(top, height))
    tyre = parts.wheel(rng, radius, 0.28, 0.6, 10)
    twin = parts.wheel(rng, radius, 0.52, 0.6, 10)
    draft.axle(tyre, wheelbase, half - 0.2, radius)
    draft.axle(twin, 0.0, half - 0.32, radius)
    return draft


def _face(
    rng: np.random.Generator, f: HullShape, b: BodyBand, draft: VehicleDraft, bumper: float
) -> list[PanelFeature]:
    w, z0, z1 = f.half, bumper + 0.08, f.lip - 0.1
    grille = rng.uniform(0.55, 0.75) * w
    q = b.across(grille, "front")
    features = [PanelFeature("paint", (0, b.length), (bumper, f.lip))]
    bars = int(rng.integers(3, 6))
    bar_height = (z1 - z0) / bars
    for k in range(bars):
        low = z0 + k * bar_height
        features.append(PanelFeature("dark", (0, q), (low, low + 0.6 * bar_height), -0.05, 0.01))
    inner, outer = 0.55 * w, 0.93 * w
    q_at = {y: b.across(y, "front") for y in (inner, outer)}
    z = bumper - 0.22, bumper - 0.04
    features.append(PanelFeature("housing", (q_at[inner], q_at[outer]), z, -0.04, 0.012))
    for y in (inner + 0.12, outer - 0.13):
        draft.add(parts.round_lamp(b.points(b.across(y, "front"), sum(z) / 2, -0.012), 0.075, "front"))
    draft.meshes += parts.number_plate("front", b.points(0.0, bumper - 0.15, 0.015))
    draft.level("front", b, grille, z0)
    draft.level("front", b, grille, z1 - 0.4 * bar_height)
    draft.level("front", b, 0.9 * w, bumper - 0.02)
    draft.level("front", b, 0.85 * w, f.lip)
    for y in (inner, outer):
        draft.edge("front", b.points(q_at[y], z[0]), b.points(q_at[y], z[1]))
    draft.outlined["front"] = 2 * outer, 0.5, f.lip
    return features


def _load(rng: np.random.Generator, draft: VehicleDraft, x1: float, x0: float, half: float) -> float:
    """Box, frame, tank, guards and the rear with its doors, bar and lamps; returns the box's top."""
    low, top = rng.uniform(0.98, 1.08), rng.uniform(3.2, 3.7)
    middle, length, height = (x0 + x1) / 2, x1 - x0, top - low
    frame = rng.uniform(0.07, 0.11)
    white = bool(rng.random() < 0.65)
    named: list[NamedMesh] = [
        ("white" if white else "paint", box([length, 2 * half, height], [middle, 0, (low + top) / 2]))
    ]
    rails = [[length + 0.02, 0.05, frame]] * 4 + [[0.05, 0.05, height]] * 4
    y = half - 0.015
    places = [[middle, s * y, z] for s in (-1, 1) for z in (low + frame / 2, top - frame / 2)]
    places += [[x, s * y, (low + top) / 2] for s in (-1, 1) for x in (x0 + 0.02, x1 - 0.02)]
    named.append(("housing", boxes(rails, places)))
    x = x0 - 0.012
    across = [[0.03, 2 * half, frame], [0.03, 2 * half, frame], [0.03, frame, height], [0.03, frame, height]]
    centers = [
        [x, 0, low + frame / 2],
        [x, 0, top - frame / 2],
        [x, half - frame / 2, (low + top) / 2],
        [x, frame / 2 - half, (low + top) / 2],
    ]
    named.append(("housing", boxes(across, centers)))
    named.append(("seam", box([0.01, 0.02, height - 2 * frame], [x0 - 0.004, 0, (low + top) / 2])))
    for y in sorted(rng.uniform(0.12, 0.75, int(rng.integers(1, 3))) * half):
        rod = tube([[x0 - 0.035, y, low - 0.02], [x0 - 0.035, y, top - 0.02]], 0.017, 8)
        grips = boxes([[0.05, 0.1, 0.05]] * 3, [[x0 - 0.03, y, low + u * height] for u in (0.12, 0.5, 0.9)])
        draft.add([("rim", rod), ("plastic", grips)])
    joints = np.arange(x0 + 1.2, x1 - 0.3, 1.2)
    draft.add([("housing", boxes([[0.04, 0.008, height]] * len(joints), [[x, half, (low + top) / 2] for x in joints]))])
    if rng.random() < 0.6:  # a sign on the sides
        size = np.array([rng.uniform(0.3, 0.6) * length, 0.012, rng.uniform(0.2, 0.4) * height])
        draft.add([("paint" if white else "white", box(size, [middle, half, low + 0.6 * height]))])
    hinges = boxes(
        [[0.02, 0.18, 0.05]] * 4, [[x0 - 0.02, half - frame - 0.06, low + u * height] for u in (0.1, 0.35, 0.65, 0.9)]
    )
    draft.add([("rim", hinges)])
    draft.add([("dark", box([length + 1.2, 0.09, 0.26], [middle + 0.5, 0.42, low - 0.17]))])
    bar = rng.uniform(0.42, 0.52)
    named.append(("plastic", box([0.1, 1.9 * half, 0.12], [x0 + 0.12, 0, bar])))
    draft.add([("dark", box([0.08, 0.08, low - bar - 0.1], [x0 + 0.2, 0.5, (low + bar) / 2]))])
    carrier = low - 0.16
    named.append(("dark", box([0.04, 1.96 * half, 0.2], [x0 + 0.08, 0, carrier])))
    lamp = rng.uniform(0.32, 0.42)
    outer = 0.96 * half
    thirds = [outer - lamp * (k + 0.5) / 3 for k in range(3)]
    for name, y in zip(("red", "amber", "white"), thirds, strict=True):
        draft.add([(name, box([0.05, lamp / 3 - 0.008, 0.13], [x0 + 0.04, y, carrier]))])
    draft.meshes += parts.number_plate("rear", [x0 + 0.05, 0.0, carrier])
    flap = box([0.02, 0.5, 0.45], [-0.75, half - 0.3, 0.5])
    tank = revolve([[0.0, -0.55], [0.27, -0.54], [0.3, -0.5], [0.3, 0.5], [0.27, 0.54], [0.0, 0.55]], 18)
    tank_along = tank.transformed(
        [0.5 * draft.wheelbase, half - 0.38, 0.66], np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    )
    guard = boxes([[1.6, 0.03, 0.1]] * 2, [[0.5 * draft.wheelbase - 0.1, half - 0.04, z] for z in (0.5, 0.78)])
    draft.add([("rubber", flap), ("rim", tank_along), ("rim", guard)])
    arch = np.linspace(0.1, np.pi - 0.1, 12)
    cover = tube(np.column_stack([0.58 * np.cos(arch), np.full(12, half - 0.3), 0.48 + 0.5 * np.sin(arch)]), 0.03, 6)
    draft.add([("plastic", cover)])
    draft.meshes += named
    x -= 0.015
    draft.frame("rear", (np.array([x, half, low]), np.array([x, -half, top])))
    inside = half - frame
    draft.frame("rear", (np.array([x, inside, low + frame]), np.array([x, -inside, top - frame])))
    x = x0 + 0.07
    draft.frame("rear", (np.array([x, 0.95 * half, bar - 0.06]), np.array([x, -0.95 * half, bar + 0.06])), "tb")
    draft.outlined["rear"] = 1.96 * half, low, top
    return top
