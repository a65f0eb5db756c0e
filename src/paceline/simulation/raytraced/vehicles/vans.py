"""Vans and buses."""

from __future__ import annotations

import numpy as np

from paceline.simulation.raytraced.mesh_builders import box, tube
from paceline.simulation.raytraced.vehicles import parts
from paceline.simulation.raytraced.vehicles.builder import VehicleDraft
from paceline.simulation.raytraced.vehicles.cabin import loft_cabin
from paceline.simulation.raytraced.vehicles.hull import HullShape, hull_band, hull_walls
from paceline.simulation.raytraced.vehicles.sheet_metal import BodyBand, PanelFeature


def draft_van(rng: np.random.Generator) -> VehicleDraft:
    """A panel van."""
    wheelbase = rng.uniform(3.0, 3.7)
    front, rear = wheelbase + rng.uniform(0.88, 1.0), -rng.uniform(0.95, 1.2)
    half, height = rng.uniform(0.96, 1.03), rng.uniform(1.95, 2.5)
    lip, belt = rng.uniform(0.95, 1.05), rng.uniform(1.18, 1.28)
    radius, bumper = rng.uniform(0.33, 0.36), rng.uniform(0.56, 0.66)
    step, rear_step = rng.uniform(0.05, 0.1), rng.uniform(0.1, 0.18)
    cowl = front - rng.uniform(0.72, 0.85)
    header = cowl - rng.uniform(0.75, 0.95)
    post = header - rng.uniform(0.65, 0.8)
    form = HullShape(
        front=front,
        rear=rear,
        half=half,
        low=rng.uniform(0.24, 0.3),
        lip=lip,
        belt=belt,
        deck=belt,
        cowl=(cowl, belt + 0.05),
        header=(header, height - 0.05),
        rear_header=(rear + rear_step + 0.12, height - 0.05),
        rear_base=(rear + rear_step + 0.04, belt + 0.02),
        half_roof=half * rng.uniform(0.84, 0.89),
        panes=((header, post),),
        bumps=(
            (0.25, -0.06),
            (0.33, 0.0),
            (bumper - 0.03, 0.0),
            (bumper + 0.01, -step),
            (lip - 0.08, -step - 0.06),
            (lip, -step - 0.15),
        ),
        tail=((0.25, -0.05), (0.35, 0.0), (bumper - 0.06, 0.0), (bumper - 0.03, -rear_step), (belt, -rear_step - 0.02)),
        section=((0.25, 0.96), (0.5, 0.99), (0.75, 1.0), (belt, 0.985)),
        knee=bumper,
        axles=(wheelbase, 0.0),
        arch=radius + 0.06,
        axle_height=radius,
        bow=0.22,
        rear_bow=0.07,
        wrap=0.2,
        doors=(cowl - 0.2, post - 0.02, post - rng.uniform(1.0, 1.2)),
        rear_pane=bool(rng.random() < 0.7),
    )
    b = hull_band(form)
    draft = VehicleDraft(wheelbase, (front - rear, 2 * half, height))
    shell = loft_cabin(form, b) + hull_walls(
        form, b, _van_front_features(rng, form, b, draft, bumper), _van_rear_features(rng, form, b, draft, bumper)
    )
    base = b.points(b.at(form.cowl[0] - form.wrap - 0.12), lip)
    shell += parts.mirror(base + [0, 0.15, 0.14], 1.5, "plastic")
    handle = b.points(b.at(post + 0.14), lip - 0.05)
    shell.append(("plastic", box([0.17, 0.04, 0.04], handle + [0, 0.01, 0])))
    if rng.random() < 0.6:  # a rub strip along the side
        rail = [b.points(b.at(x), lip * 0.72, 0.004) for x in np.linspace(post, form.arch + 0.15, 8)]
        shell.append(("plastic", tube(rail, 0.03, 6)))
    draft.add(shell)
    tyre = parts.wheel(rng, radius, rng.uniform(0.21, 0.24), 0.62)
    for x in (0.0, wheelbase):
        draft.axle(tyre, x, half - 0.14, radius)
    return draft


def _van_front_features(
    rng: np.random.Generator, f: HullShape, b: BodyBand, draft: VehicleDraft, bumper: float
) -> list[PanelFeature]:
    w, z0, z1 = f.half, bumper + 0.04, f.lip - 0.08
    inner, outer = rng.uniform(0.56, 0.62) * w, rng.uniform(0.92, 0.97) * w
    grille = inner - rng.uniform(0.03, 0.1)
    q_at = {y: b.across(y, "front") for y in (grille, inner, outer)}
    features = [PanelFeature("paint", (0, b.length), (bumper + 0.01, f.lip))]
    features.append(PanelFeature("dark", (0, q_at[grille]), (z0, z1), -0.05, 0.01))
    bars = int(rng.integers(3, 5))
    for k in range(bars):
        z = z0 + (k + 0.5) / bars * (z1 - z0)
        name = "chrome" if rng.random() < 0.3 else "plastic"
        features.append(PanelFeature(name, (0, q_at[grille] - 0.01), (z - 0.014, z + 0.014), 0.004, 0.005))
    features.append(PanelFeature("housing", (q_at[inner], q_at[outer]), (z0, z1 + 0.05), -0.03, 0.012))
    features.append(PanelFeature("dark", (0, b.across(0.6 * w, "front")), (0.33, 0.42), -0.06, 0.012))
    size = 0.3 * (z1 + 0.05 - z0)
    draft.add(
        parts.round_lamp(b.points(b.across(inner + 1.25 * size, "front"), (z0 + z1 + 0.05) / 2, -0.012), size, "front")
    )
    low = b.across(outer - 0.09, "front")
    features.append(PanelFeature("amber", (low, q_at[outer] - 0.012), (z0 + 0.02, z1 + 0.03), -0.015, 0.005))
    draft.meshes += parts.number_plate("front", b.points(0.0, 0.49, 0.015))
    for z in (z0, z1):
        draft.level("front", b, grille, z)
    for z in (0.49 - 0.057, 0.49 + 0.057):
        draft.level("front", b, 0.26, z)
    draft.level("front", b, 0.8 * w, bumper)
    draft.edge("front", b.points(q_at[inner], z0), b.points(q_at[inner], z1 + 0.05))
    draft.edge("front", b.points(q_at[outer], z0), b.points(q_at[outer], z1 + 0.05))
    draft.outlined["front"] = 2 * outer, 0.38, f.lip
    return features


def _van_rear_features(
    rng: np.random.Generator, f: HullShape, b: BodyBand, draft: VehicleDraft, bumper: float
) -> list[PanelFeature]:
    w = f.half
    features = [PanelFeature("paint", (0, b.length), (bumper - 0.02, f.lip))]
    lamp = rng.uniform(0.10, 0.14)
    z0, z1 = bumper + rng.uniform(0.08, 0.2), f.lip
    q0, q1 = b.across(0.985 * w, "rear"), b.across(0.985 * w - lamp, "rear")
    features.append(PanelFeature("red", (q0, q1), (z0, z1), 0.01, 0.006))
    features.append(
        PanelFeature("amber", (q0 + 0.01, q1 - 0.01), (z0 + 0.4 * (z1 - z0), z0 + 0.6 * (z1 - z0)), 0.011, 0.003)
    )
    features.append(PanelFeature("white", (q0 + 0.01, q1 - 0.01), (z0 + 0.02, z0 + 0.16 * (z1 - z0)), 0.011, 0.003))
    features.append(PanelFeature("seam", (b.length - 0.006, b.length), (bumper, f.lip)))
    seam = b.across(0.985 * w - lamp - 0.02, "rear")
    features.append(PanelFeature("seam", (seam - 0.004, seam + 0.004), (bumper, f.lip)))
    zp = bumper + rng.uniform(0.08, 0.16)
    features.append(
        PanelFeature(
            "plastic", (b.across(0.05, "rear") - 0.16, b.across(0.05, "rear")), (zp + 0.14, zp + 0.18), 0.02, 0.006
        )
    )
    draft.meshes += parts.number_plate("rear", b.points(b.across(0.0, "rear"), zp, 0.014))
    for x in (0.0, 0.06):
        steps = b.points(b.across((0.5 + x) * w, "rear"), 0.45, -0.01)
        draft.add([("dark", box([0.02, 0.03, 0.08], steps))])
    if f.rear_pane:
        x, y = f.rear_base[0], (f.half_roof + f.half) / 2
        draft.meshes.append(
            ("paint", box([0.09, 0.16, f.header[1] - f.belt - 0.1], [x + 0.02, 0, (f.header[1] + f.belt) / 2]))
        )
        draft.frame("rear", (np.array([x, 0.08, f.belt + 0.06]), np.array([x, 0.8 * y, f.header[1] - 0.18])), "lb")
    for z in (zp - 0.057, zp + 0.057):
        draft.level("rear", b, 0.26, z)
    draft.level("rear", b, 0.95 * w, bumper - 0.03)
    draft.edge("rear", b.points(q1, z0), b.points(q1, z1))
    side = b.points(b.across(0.98 * w, "rear"), bumper)
    draft.edge("rear", side, side * [1, 1, 0] + [0, 0, f.belt])
    draft.outlined["rear"] = 1.9 * w, bumper - 0.15, f.belt
    return features


def draft_bus(rng: np.random.Generator) -> VehicleDraft:
    """A city or country bus."""
    wheelbase = rng.uniform(5.6, 6.2)
    front, rear = wheelbase + rng.uniform(2.5, 2.8), -rng.uniform(2.9, 3.4)
    half, height = rng.uniform(1.24, 1.275), rng.uniform(2.95, 3.25)
    lip = rng.uniform(1.0, 1.15)
    radius, bumper = rng.uniform(0.46, 0.5), rng.uniform(0.58, 0.68)
    step = rng.uniform(0.05, 0.1)
    cowl, header = front - 0.24, front - rng.uniform(0.42, 0.6)
    count = int(rng.integers(5, 8))
    borders = np.linspace(header - 0.1, rear + 0.9, count + 1)
    form = HullShape(
        front=front,
        rear=rear,
        half=half,
        low=0.3,
        lip=lip,
        belt=lip + 0.02,
        deck=lip + rng.uniform(0.25, 0.5),
        cowl=(cowl, lip + 0.06),
        header=(header, height - 0.06),
        rear_header=(rear + 0.25, height - 0.06),
        rear_base=(rear + 0.14, lip + 0.5),
        half_roof=half * 0.95,
        panes=tuple((float(a) - 0.05, float(c) + 0.05) for a, c in zip(borders[:-1], borders[1:], strict=True)),
        bumps=((0.3, -0.04), (0.38, 0.0), (bumper - 0.04, 0.0), (bumper, -step), (lip, -step - 0.05)),
        tail=((0.3, -0.03), (0.4, 0.0), (bumper - 0.04, 0.0), (bumper, -step), (lip + 0.2, -step)),
        section=((0.3, 0.985), (0.6, 1.0), (lip, 0.997)),
        knee=bumper,
        axles=(wheelbase, 0.0),
        arch=radius + 0.08,
        axle_height=radius,
        bow=0.2,
        rear_bow=0.12,
        wrap=0.22,
        pillar=0.06,
        doors=(front - 0.45, front - 1.6),
        side=(PanelFeature(str(rng.choice(["white", "seam", "paint", "red"])), (0.0, 99.0), (lip - 0.2, lip - 0.08)),),
    )
    b = hull_band(form)
    draft = VehicleDraft(wheelbase, (front - rear, 2 * half, height))
    shell = loft_cabin(form, b) + hull_walls(
        form, b, _bus_front_features(rng, form, b, draft, bumper), _bus_rear_features(rng, form, b, draft, bumper)
    )
    arm = np.array([[header - 0.15, 0.9 * half, height - 0.2], [front + 0.05, half + 0.05, height - 0.22]])
    arm = np.array([*arm, [front + 0.1, half + 0.12, height - 0.35]])
    shell += [("plastic", tube(arm, 0.025, 6)), *parts.mirror(arm[-1] - [0, 0, 0.2], 1.7, "plastic")]
    shell += parts.wiper([cowl, 0.06, lip + 0.1], [cowl - 0.12, 0.75, lip + 0.5], 0.05)
    draft.add(shell)
    tyre = parts.wheel(rng, radius, 0.3, 0.6, 10)
    for x in (0.0, wheelbase):
        draft.axle(tyre, x, half - 0.2, radius)
    return draft


def _bus_front_features(
    rng: np.random.Generator, f: HullShape, b: BodyBand, draft: VehicleDraft, bumper: float
) -> list[PanelFeature]:
    w, z0, z1 = f.half, bumper + 0.05, f.lip - 0.12
    grille = rng.uniform(0.3, 0.5) * w
    inner, outer = 0.62 * w, 0.95 * w
    q_at = {y: b.across(y, "front") for y in (grille, inner, outer)}
    features = [PanelFeature("paint", (0, b.length), (bumper, f.lip))]
    for k in range(int(rng.integers(2, 5))):
        z = z1 - 0.07 * k
        if z - 0.045 > z0:
            features.append(PanelFeature("dark", (0, q_at[grille]), (z - 0.04, z), -0.03, 0.006))
    features.append(PanelFeature("housing", (q_at[inner], q_at[outer]), (z0, min(z0 + 0.22, z1 + 0.05)), -0.035, 0.012))
    for y in (inner + 0.13, outer - 0.13):
        draft.add(
            parts.round_lamp(
                b.points(b.across(y, "front"), (z0 + min(z0 + 0.22, z1 + 0.05)) / 2, -0.01), 0.085, "front"
            )
        )
    features.append(PanelFeature("dark", (0, b.across(0.5 * w, "front")), (0.34, 0.4), -0.05, 0.01))
    draft.meshes += parts.number_plate("front", b.points(0.0, bumper - 0.11, 0.015))
    draft.level("front", b, grille, z1)
    draft.level("front", b, 0.9 * w, bumper - 0.02)
    draft.level("front", b, 0.85 * w, f.lip)
    for y in (inner, outer):
        draft.edge("front", b.points(q_at[y], z0), b.points(q_at[y], z0 + 0.2))
    for z in (bumper - 0.167, bumper - 0.053):
        draft.level("front", b, 0.26, z)
    draft.outlined["front"] = 2 * outer, 0.4, f.lip
    return features


def _bus_rear_features(
    rng: np.random.Generator, f: HullShape, b: BodyBand, draft: VehicleDraft, bumper: float
) -> list[PanelFeature]:
    w = f.half
    top = b.nominal(f.deck - 0.08, f.deck)
    features = [PanelFeature("paint", (0, b.length), (bumper, f.lip))]
    grille = rng.uniform(0.4, 0.6) * w
    q = b.across(grille, "rear")
    low = bumper + 0.26
    bars = int(rng.integers(4, 7))
    bar_height = (top - low) / bars
    for k in range(bars):
        z = low + k * bar_height
        features.append(
            PanelFeature("dark", (q, b.length), (z + 0.1 * bar_height, z + 0.75 * bar_height), -0.03, 0.005)
        )
    q0, q1 = b.across(0.96 * w, "rear"), b.across(0.96 * w - 0.15, "rear")
    for k, name in enumerate(("red", "amber", "white")):
        z1 = top - 0.16 * k
        features.append(PanelFeature(name, (q0, q1), (z1 - 0.14, z1), 0.015, 0.008))
    draft.meshes += parts.number_plate("rear", b.points(b.length, bumper + 0.12, 0.014))
    for height in (bumper + 0.063, bumper + 0.177):
        draft.level("rear", b, 0.26, height)
    draft.level("rear", b, 0.9 * w, bumper - 0.02)
    draft.level("rear", b, grille, top)
    draft.edge("rear", b.points(q, low), b.points(q, top))
    draft.edge("rear", b.points(q1, top - 0.46), b.points(q1, top))
    draft.outlined["rear"] = 1.92 * w, 0.45, f.deck
    return features
