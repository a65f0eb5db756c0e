"""Saloons, estates and vans."""

from __future__ import annotations

import numpy as np

from paceline.simulation.raytraced.mesh_builders import NamedMesh, box
from paceline.simulation.raytraced.vehicles import parts
from paceline.simulation.raytraced.vehicles.builder import VehicleDraft
from paceline.simulation.raytraced.vehicles.cabin import loft_cabin
from paceline.simulation.raytraced.vehicles.hull import HullShape, hull_band, hull_walls
from paceline.simulation.raytraced.vehicles.sheet_metal import BodyBand, PanelFeature


def draft_car(rng: np.random.Generator, estate: bool) -> VehicleDraft:
    """A saloon or an estate."""
    wheelbase = rng.uniform(2.58, 2.85)
    front = wheelbase + rng.uniform(0.82, 0.95)
    rear = -rng.uniform(0.85, 1.0) - (0.05 if estate else 0.12)
    half = rng.uniform(0.87, 0.935)
    height = rng.uniform(1.42, 1.49) + (0.03 if estate else 0.0)
    lip, belt = rng.uniform(0.72, 0.79), rng.uniform(0.90, 0.96)
    deck = belt + (rng.uniform(-0.02, 0.04) if estate else rng.uniform(0.02, 0.10))
    radius = rng.uniform(0.305, 0.335)
    step = rng.uniform(0.04, 0.10)  # of the bumper before the grille
    rear_step = rng.uniform(0.05, 0.12)
    cowl = wheelbase - rng.uniform(0.36, 0.48)
    header = cowl - rng.uniform(0.72, 0.85)
    if estate:
        rear_header, rear_base = rear + rng.uniform(0.30, 0.42), rear + 0.10
    else:
        rear_base = rear + rng.uniform(0.48, 0.62)
        rear_header = rear_base + rng.uniform(0.55, 0.7)
    post = cowl - rng.uniform(1.28, 1.4)
    third = rear_header + (0.75 if estate else 0.35)
    panes = ((header, post + 0.04), (post - 0.04, third)) + (((third - 0.09, rear_header + 0.14),) if estate else ())
    bumper = rng.uniform(0.50, 0.56)
    form = HullShape(
        front=front,
        rear=rear,
        half=half,
        low=rng.uniform(0.19, 0.23),
        lip=lip,
        belt=belt,
        deck=deck,
        cowl=(cowl, belt + 0.06),
        header=(header, height - 0.035),
        rear_header=(rear_header, height - 0.06),
        rear_base=(rear_base, deck + 0.03),
        half_roof=half * rng.uniform(0.66, 0.71),
        panes=panes,
        bumps=(
            (0.2, -0.09),
            (0.28, -0.01),
            (0.36, 0.0),
            (bumper - 0.05, -0.01),
            (bumper, -step),
            (lip - 0.06, -step - 0.04),
            (lip, -step - 0.12),
        ),
        tail=(
            (0.2, -0.12),
            (0.3, -0.01),
            (0.4, 0.0),
            (bumper - 0.03, -0.005),
            (bumper + 0.02, -rear_step),
            (deck - 0.05, -rear_step - 0.03),
            (deck, -rear_step - 0.06),
        ),
        section=((0.2, 0.93), (0.36, 0.975), (0.58, 1.0), (0.75, 0.99), (belt, 0.955)),
        knee=bumper,
        axles=(wheelbase, 0.0),
        arch=radius + rng.uniform(0.035, 0.06),
        axle_height=radius,
        doors=(cowl - 0.22, post, rear_header + 0.25),
    )
    b = hull_band(form)
    draft = VehicleDraft(wheelbase, (front - rear, 2 * half, height))
    ends = {"front": _front_features(rng, form, b, draft, bumper), "rear": _rear_features(rng, form, b, draft, bumper)}
    side = _side_parts(form, b, post)
    shell = loft_cabin(form, b) + hull_walls(form, b, ends["front"], ends["rear"])
    draft.add([*shell, *side])
    tyre = parts.wheel(rng, radius, rng.uniform(0.195, 0.23))
    for x in (0.0, wheelbase):
        draft.axle(tyre, x, half - 0.12, radius)
    return draft


def _front_features(
    rng: np.random.Generator, f: HullShape, b: BodyBand, draft: VehicleDraft, bumper: float
) -> list[PanelFeature]:
    """Grille, lamps, intake and plate of a car's front."""
    w, z0, z1 = f.half, bumper + 0.025, f.lip - 0.05
    inner, outer = rng.uniform(0.50, 0.58) * w, rng.uniform(0.90, 0.97) * w
    grille = inner - rng.uniform(0.02, 0.16)
    q = {name: b.across(y, "front") for name, y in (("grille", grille), ("inner", inner), ("outer", outer))}
    recess = rng.uniform(0.03, 0.06)
    features = [PanelFeature("paint", (0, b.length), (bumper, f.lip))]
    features += [PanelFeature("chrome", (0, q["grille"]), (z0 - 0.012, z1 + 0.012), 0.008, 0.004)]
    features += [PanelFeature("dark", (0, q["grille"] - 0.014), (z0, z1), -recess, 0.008)]
    bars = int(rng.integers(3, 6))
    name = str(rng.choice(["plastic", "chrome", "chrome"]))
    for k in range(bars):
        z = z0 + (k + 1) / (bars + 1) * (z1 - z0)
        features.append(PanelFeature(name, (0, q["grille"] - 0.02), (z - 0.007, z + 0.007), -0.012, 0.003))
    features.append(PanelFeature("housing", (q["inner"], q["outer"]), (z0, z1 + 0.02), -0.035, 0.01))
    intake = rng.uniform(0.45, 0.75) * w, rng.uniform(0.25, 0.28), rng.uniform(0.33, 0.37)
    features.append(PanelFeature("dark", (0, b.across(intake[0], "front")), intake[1:], -0.05, 0.012))
    z = (z0 + z1 + 0.02) / 2
    size = min(0.45 * (z1 + 0.02 - z0), 0.075)
    for y in np.linspace(inner + 1.2 * size, outer - 1.6 * size, 2 if outer - inner > 4 * size else 1):
        center = b.points(b.across(float(y), "front"), z, -0.015)
        draft.add(parts.round_lamp(center, size, "front"))
    plate_center = b.points(0.0, 0.435, 0.02)
    draft.meshes += parts.number_plate("front", plate_center)
    for height in (z0, z1):
        draft.level("front", b, grille, height)
    draft.level("front", b, 0.26, 0.435 + 0.057)
    draft.level("front", b, 0.26, 0.435 - 0.057)
    draft.level("front", b, intake[0], intake[2])
    for name in ("inner", "outer"):
        draft.edge("front", b.points(q[name], z0), b.points(q[name], z1 + 0.02))
    draft.outlined["front"] = 2 * outer, 0.36, f.lip
    return features


def _rear_features(
    rng: np.random.Generator, f: HullShape, b: BodyBand, draft: VehicleDraft, bumper: float
) -> list[PanelFeature]:
    """Lamps, plate recess and boot seam of a car's rear."""
    w = f.half
    height = rng.uniform(0.11, 0.16)
    z1 = b.nominal(f.deck - 0.03, f.deck)
    z0 = b.nominal(f.deck - 0.03 - height, f.deck)
    inner, outer = rng.uniform(0.52, 0.68) * w, rng.uniform(0.93, 0.985) * w
    q = {name: b.across(y, "rear") for name, y in (("inner", inner), ("outer", outer))}
    split = q["outer"] + rng.uniform(0.3, 0.45) * (q["inner"] - q["outer"])
    features = [PanelFeature("paint", (0, b.length), (bumper, f.lip))]
    features += [PanelFeature("seam", (b.across(0.62 * w, "rear"), b.length), (bumper + 0.012, bumper + 0.02))]
    features += [PanelFeature("red", (q["outer"], q["inner"]), (z0, z1), 0.012, 0.008)]
    features += [
        PanelFeature(
            "white",
            (q["inner"] - 0.35 * (q["inner"] - split), q["inner"] - 0.01),
            (z0 + 0.01, z0 + 0.4 * (z1 - z0)),
            0.01,
            0.004,
        )
    ]
    features += [PanelFeature("amber", (q["outer"] + 0.01, split), (z1 - 0.45 * (z1 - z0), z1 - 0.01), 0.01, 0.004)]
    high = rng.random() < 0.6
    zp = b.nominal((f.deck + bumper) / 2 - 0.02, f.deck) if high else 0.42
    if high:
        features.append(
            PanelFeature("paint", (b.across(0.32, "rear"), b.length), (zp - 0.04, zp + 0.04), -0.018, 0.012)
        )
    else:
        features.append(
            PanelFeature("chrome", (b.across(0.3, "rear"), b.length), (z0 + 0.02, z0 + 0.045), 0.015, 0.005)
        )
    features.append(PanelFeature("plastic", (b.across(0.75 * w, "rear"), b.length), (0.24, 0.32), -0.015, 0.01))
    draft.meshes += parts.number_plate("rear", b.points(b.length, zp, 0.004 if high else 0.014))
    for z in (zp - 0.057, zp + 0.057):
        draft.level("rear", b, 0.26, z)
    draft.level("rear", b, 0.9 * w, bumper)
    draft.level("rear", b, 0.8 * w, f.lip)
    draft.edge("rear", b.points(q["inner"], z0), b.points(q["inner"], z1))
    draft.edge("rear", b.points(q["inner"], z0), b.points(q["outer"], z0))
    draft.outlined["rear"] = 2 * 0.95 * w, 0.34, f.deck
    return features


def _side_parts(f: HullShape, b: BodyBand, post: float) -> list[NamedMesh]:
    """Mirrors and door handles of the left side."""
    x = f.cowl[0] - f.wrap - 0.12
    base = b.points(b.at(x), f.lip)
    result = parts.mirror(base + [0.02, 0.13, 0.06], 1.0, "paint")
    for handle_x in (post + 0.16, post - 0.78):
        p = b.points(b.at(handle_x), f.lip - 0.06)
        result.append(("paint", box([0.17, 0.035, 0.03], p + [0, 0.01, 0])))
    return result
