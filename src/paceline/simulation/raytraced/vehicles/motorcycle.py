"""Motorcycles with their riders."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array
from paceline.simulation.raytraced.mesh_builders import (
    Mesh,
    NamedMesh,
    box,
    ellipsoid,
    join_meshes,
    revolve,
    sheet,
    tube,
)
from paceline.simulation.raytraced.vehicles import parts
from paceline.simulation.raytraced.vehicles.builder import VehicleDraft
from paceline.simulation.raytraced.vehicles.parts import Z_TO_Y


def draft_motorcycle(rng: np.random.Generator) -> VehicleDraft:
    """A road motorcycle, its rider sitting upright in a helmet."""
    wheelbase = rng.uniform(1.38, 1.5)
    radius = rng.uniform(0.30, 0.325)
    seat = rng.uniform(0.78, 0.84)
    draft = VehicleDraft(wheelbase, (wheelbase + 2 * radius + 0.08, 0.82, seat + 0.975))
    head = np.array([wheelbase - 0.36, 0.0, 0.92])
    axle = np.array([wheelbase, 0.0, radius])
    named = [
        ("paint", ellipsoid([0.72, 0, 0.86], [0.3, 0.15, 0.13])),  # tank
        ("plastic", ellipsoid([0.2, 0, seat - 0.05], [0.42, 0.13, 0.07])),
        ("rim", ellipsoid([0.62, 0, 0.5], [0.26, 0.2, 0.2])),  # engine
        ("dark", box([0.5, 0.22, 0.2], [0.6, 0, 0.36])),
        ("paint", ellipsoid([-0.18, 0, seat + 0.02], [0.2, 0.1, 0.06])),
        ("red", box([0.03, 0.16, 0.06], [-0.38, 0, seat - 0.02])),
        ("plastic", box([0.3, 0.12, 0.03], [-0.22, 0, seat - 0.09])),
        ("housing", ellipsoid([head[0] + 0.12, 0, 0.9], [0.12, 0.11, 0.11])),
        ("plastic", box([0.08, 0.2, 0.09], [head[0] + 0.06, 0, 1.04])),
        ("paint", _mudguard(axle, radius, 0.075, (0.3, 2.5))),
        ("plastic", _mudguard(np.array([0.0, 0.0, radius]), radius, 0.1, (1.4, 3.0))),
        ("rubber", box([0.28, 0.17, 0.02], [-0.33, 0, 0.55])),
    ]
    named += parts.round_lamp([head[0] + 0.24, 0, 0.9], 0.085, "front")
    named += parts.number_plate("rear", [-0.44, 0, seat - 0.2], 0.22, 0.16)
    draft.meshes += named
    draft.add(_side_parts(rng, wheelbase, head, axle, seat))
    draft.meshes += _rider_parts(rng, seat, draft)
    for x, width in ((0.0, 0.17), (wheelbase, 0.12)):
        draft.wheels.append((_wheel(rng, radius, width), np.array([x, 0.0, radius]), radius))
    x = -0.44
    draft.frame("rear", (np.array([x, 0.11, seat - 0.28]), np.array([x, -0.11, seat - 0.12])))
    draft.edge("rear", np.array([-0.395, 0.08, seat + 0.01]), np.array([-0.395, -0.08, seat + 0.01]))
    y = np.array([head[0] + 0.2, 0.08, 0.9])
    draft.edge("front", y - [0, 0, 0.08], y + [0, 0, 0.08])
    draft.outlined = {"front": (0.5, 0.6, 1.2), "rear": (0.36, 0.5, seat + 0.3)}
    return draft


def _side_parts(rng: np.random.Generator, wheelbase: float, head: Array, axle: Array, seat: float) -> list[NamedMesh]:
    """Fork, handlebar, mirrors, indicators, swing arm, exhaust and foot rests of the left half."""
    grip = head + [-0.12, 0.38, 0.12]
    bar = np.array([head + [0.0, 0.04, 0.06], head + [-0.02, 0.2, 0.13], grip])
    stalk = np.array([grip + [0.04, -0.08, 0.02], grip + [0.1, -0.02, 0.2]])
    result = [
        ("chrome", tube(np.array([axle + [0, 0.09, 0], head + [0.03, 0.09, 0.05]]), 0.025, 10)),
        ("chrome", tube(bar, 0.013, 8)),
        ("rubber", tube(np.array([grip + [0.01, -0.12, 0.0], grip]), 0.02, 8)),
        ("dark", tube(stalk, 0.006, 6)),
        ("plastic", ellipsoid(stalk[1] + [0, 0.03, 0.02], [0.02, 0.06, 0.04])),
        ("glass", box([0.006, 0.09, 0.055], stalk[1] + [-0.021, 0.03, 0.02])),
        ("dark", tube(np.array([[0.0, 0.11, axle[2]], [0.55, 0.11, 0.42]]), 0.03, 8)),
        ("dark", tube(np.array([[0.0, 0.1, axle[2] + 0.05], [-0.05, 0.1, seat - 0.1]]), 0.02, 8)),
        ("amber", ellipsoid([head[0] + 0.1, 0.2, 0.86], [0.035, 0.03, 0.025])),
        ("amber", ellipsoid([-0.32, 0.15, seat - 0.06], [0.035, 0.03, 0.025])),
        ("plastic", box([0.04, 0.16, 0.02], [0.45, 0.2, 0.38])),
    ]
    if rng.random() < 0.8:
        result.append(
            (
                "chrome",
                tube(np.array([[0.55, 0.16, 0.32], [0.2, 0.18, 0.33], [-0.3, 0.2, 0.42]]), [0.03, 0.045, 0.05], 12),
            )
        )
    return result


def _rider_parts(rng: np.random.Generator, seat: float, draft: VehicleDraft) -> list[NamedMesh]:
    """A sitting rider with hands on the bar."""
    hip, shoulder = np.array([0.22, 0.0, seat + 0.1]), np.array([0.36, 0.0, seat + 0.58])
    grip = np.array([draft.wheelbase - 0.48, 0.33, 1.05])
    torso = tube(np.linspace(hip, shoulder, 6), [0.17, 0.185, 0.19, 0.2, 0.19, 0.09], 16)
    wide = Mesh(torso.vertices * [1, 1.15, 1], torso.triangles, torso.uv)
    center = shoulder + [0.06, 0, 0.24]
    helmet = "white" if rng.random() < 0.5 else "paint"
    y = np.array([0, 0.21, 0])
    knee = np.array([0.62, 0.24, seat - 0.12])
    limbs = [
        tube(np.array([shoulder - [0.02, 0, 0.03], center]), 0.065, 10),
        tube(np.array([shoulder + y, (shoulder + grip) / 2 + [0, 0.13, -0.1], grip]), [0.075, 0.06, 0.045], 10),
        tube(np.array([hip + [0, 0.1, -0.02], knee]), [0.11, 0.08], 10),
        tube(np.array([knee + [0.02, 0, 0.03], [0.42, 0.24, 0.4]]), [0.075, 0.05], 10),
        ellipsoid([0.48, 0.24, 0.36], [0.15, 0.05, 0.05], 6, 10),
        ellipsoid(knee, [0.085, 0.085, 0.085], 6, 10),
        ellipsoid(shoulder + 0.9 * y, [0.09, 0.09, 0.09], 6, 10),
        ellipsoid(hip + [-0.03, 0.06, -0.03], [0.17, 0.13, 0.13], 6, 10),
    ]
    return [
        ("cloth", join_meshes([wide, *(m.with_mirror_image() for m in limbs)])),
        (helmet, ellipsoid(center, [0.15, 0.125, 0.155], 10, 18)),
        ("glass", ellipsoid(center + [0.045, 0, 0.01], [0.113, 0.115, 0.06], 8, 16)),
    ]


def _mudguard(axle: Array, radius: float, half: float, span: tuple[float, float]) -> Mesh:
    """A mudguard over a wheel, between two angles above the horizontal (rad, from the front)."""
    angle = np.linspace(*span, 16)[:, None]
    y = np.linspace(half, -half, 7)
    r = radius + 0.03 - 0.03 * (y / half) ** 4
    points = np.stack([r * np.cos(angle), np.broadcast_to(y, (16, 7)), r * np.sin(angle)], -1)
    return sheet(axle + points)


def _wheel(rng: np.random.Generator, radius: float, width: float) -> dict[str, Mesh]:
    w = width / 2
    inner = 0.72 * radius
    tyre = revolve(
        [
            [inner, -0.6 * w],
            [0.88 * radius, -w],
            [0.97 * radius, -0.6 * w],
            [radius, 0.0],
            [0.97 * radius, 0.6 * w],
            [0.88 * radius, w],
            [inner, 0.6 * w],
        ],
        32,
    )
    lip = revolve([[0.96 * inner, -0.5 * w], [inner, -0.6 * w], [inner, 0.6 * w], [0.96 * inner, 0.5 * w]], 32)
    disc = revolve(
        [[0.45 * inner, 0.72 * w], [0.8 * inner, 0.72 * w], [0.8 * inner, 0.78 * w], [0.45 * inner, 0.78 * w]], 24
    )
    hub = revolve([[0.0, -1.1 * w], [0.05, -w], [0.05, w], [0.0, 1.1 * w]], 12)
    n = int(rng.choice([3, 5, 6]))
    angles = 2 * np.pi * np.arange(n) / n
    spokes = [
        tube(np.array([[0.03 * np.cos(t), 0.03 * np.sin(t), 0], [inner * np.cos(t), inner * np.sin(t), 0]]), 0.018, 8)
        for t in angles
    ]
    named = {"rubber": tyre, "rim": join_meshes([lip, hub, *spokes]), "chrome": disc.transformed([0, 0, 0])}
    return {name: mesh.transformed([0, 0, 0], Z_TO_Y) for name, mesh in named.items()}
