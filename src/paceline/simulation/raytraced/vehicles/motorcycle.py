"""Motorcycles with their riders.

Lengths are in metres. Axes: origin on the ground under the rear axle, x forward, y left, z up.
"""

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
    seat_height = rng.uniform(0.78, 0.84)
    draft = VehicleDraft(wheelbase, (wheelbase + 2 * radius + 0.08, 0.82, seat_height + 0.975))
    steering_head = np.array([wheelbase - 0.36, 0.0, 0.92])
    front_axle = np.array([wheelbase, 0.0, radius])
    meshes = [
        ("paint", ellipsoid([0.72, 0, 0.86], [0.3, 0.15, 0.13])),  # fuel tank
        ("plastic", ellipsoid([0.2, 0, seat_height - 0.05], [0.42, 0.13, 0.07])),  # seat
        ("rim", ellipsoid([0.62, 0, 0.5], [0.26, 0.2, 0.2])),  # engine
        ("dark", box([0.5, 0.22, 0.2], [0.6, 0, 0.36])),  # crankcase
        ("paint", ellipsoid([-0.18, 0, seat_height + 0.02], [0.2, 0.1, 0.06])),  # tail
        ("red", box([0.03, 0.16, 0.06], [-0.38, 0, seat_height - 0.02])),  # tail lamp
        ("plastic", box([0.3, 0.12, 0.03], [-0.22, 0, seat_height - 0.09])),  # underside of the tail
        ("housing", ellipsoid([steering_head[0] + 0.12, 0, 0.9], [0.12, 0.11, 0.11])),  # headlamp
        ("plastic", box([0.08, 0.2, 0.09], [steering_head[0] + 0.06, 0, 1.04])),  # instruments
        ("paint", _mudguard(front_axle, radius, 0.075, (0.3, 2.5))),  # front mudguard
        ("plastic", _mudguard(np.array([0.0, 0.0, radius]), radius, 0.1, (1.4, 3.0))),  # rear mudguard
        ("rubber", box([0.28, 0.17, 0.02], [-0.33, 0, 0.55])),  # inner mudguard
    ]
    meshes += parts.round_lamp([steering_head[0] + 0.24, 0, 0.9], 0.085, "front")
    meshes += parts.number_plate("rear", [-0.44, 0, seat_height - 0.2], 0.22, 0.16)
    draft.meshes += meshes
    draft.add(_side_parts(rng, wheelbase, steering_head, front_axle, seat_height))
    draft.meshes += _rider_parts(rng, seat_height, draft)
    for x, width in ((0.0, 0.17), (wheelbase, 0.12)):
        draft.wheels.append((_wheel(rng, radius, width), np.array([x, 0.0, radius]), radius))
    plate_x = -0.44
    draft.frame("rear", (np.array([plate_x, 0.11, seat_height - 0.28]), np.array([plate_x, -0.11, seat_height - 0.12])))
    tail_lamp_end = np.array([-0.395, 0.08, seat_height + 0.01])
    draft.edge("rear", tail_lamp_end, tail_lamp_end * [1, -1, 1])
    headlamp_side = np.array([steering_head[0] + 0.2, 0.08, 0.9])
    draft.edge("front", headlamp_side - [0, 0, 0.08], headlamp_side + [0, 0, 0.08])
    draft.outlined = {"front": (0.5, 0.6, 1.2), "rear": (0.36, 0.5, seat_height + 0.3)}
    return draft


def _side_parts(
    rng: np.random.Generator, wheelbase: float, steering_head: Array, front_axle: Array, seat_height: float
) -> list[NamedMesh]:
    """Fork, handlebar, mirror, indicators, swing arm, exhaust and foot rest of the left half."""
    grip = steering_head + [-0.12, 0.38, 0.12]
    bar = np.array([steering_head + [0.0, 0.04, 0.06], steering_head + [-0.02, 0.2, 0.13], grip])
    stalk = np.array([grip + [0.04, -0.08, 0.02], grip + [0.1, -0.02, 0.2]])
    shock_absorber = np.array([[0.0, 0.1, front_axle[2] + 0.05], [-0.05, 0.1, seat_height - 0.1]])
    meshes = [
        ("chrome", tube(np.array([front_axle + [0, 0.09, 0], steering_head + [0.03, 0.09, 0.05]]), 0.025, 10)),  # fork
        ("chrome", tube(bar, 0.013, 8)),  # handlebar
        ("rubber", tube(np.array([grip + [0.01, -0.12, 0.0], grip]), 0.02, 8)),  # grip
        ("dark", tube(stalk, 0.006, 6)),  # stalk of the mirror
        ("plastic", ellipsoid(stalk[1] + [0, 0.03, 0.02], [0.02, 0.06, 0.04])),  # housing of the mirror
        ("glass", box([0.006, 0.09, 0.055], stalk[1] + [-0.021, 0.03, 0.02])),  # mirror
        ("dark", tube(np.array([[0.0, 0.11, front_axle[2]], [0.55, 0.11, 0.42]]), 0.03, 8)),  # swing arm
        ("dark", tube(shock_absorber, 0.02, 8)),
        ("amber", ellipsoid([steering_head[0] + 0.1, 0.2, 0.86], [0.035, 0.03, 0.025])),  # front indicator
        ("amber", ellipsoid([-0.32, 0.15, seat_height - 0.06], [0.035, 0.03, 0.025])),  # rear indicator
        ("plastic", box([0.04, 0.16, 0.02], [0.45, 0.2, 0.38])),  # foot rest
    ]
    if rng.random() < 0.8:
        meshes.append(
            (  # exhaust
                "chrome",
                tube(np.array([[0.55, 0.16, 0.32], [0.2, 0.18, 0.33], [-0.3, 0.2, 0.42]]), [0.03, 0.045, 0.05], 12),
            )
        )
    return meshes


def _rider_parts(rng: np.random.Generator, seat_height: float, draft: VehicleDraft) -> list[NamedMesh]:
    """A sitting rider with hands on the bar."""
    hip, shoulder = np.array([0.22, 0.0, seat_height + 0.1]), np.array([0.36, 0.0, seat_height + 0.58])
    grip = np.array([draft.wheelbase - 0.48, 0.33, 1.05])
    torso = tube(np.linspace(hip, shoulder, 6), [0.17, 0.185, 0.19, 0.2, 0.19, 0.09], 16)
    widened_torso = Mesh(torso.vertices * [1, 1.15, 1], torso.triangles, torso.uv)
    helmet_center = shoulder + [0.06, 0, 0.24]
    helmet_material = "white" if rng.random() < 0.5 else "paint"
    shoulder_offset = np.array([0, 0.21, 0])  # from the middle to the left shoulder
    knee = np.array([0.62, 0.24, seat_height - 0.12])
    limbs = [
        tube(np.array([shoulder - [0.02, 0, 0.03], helmet_center]), 0.065, 10),  # neck
        tube(  # arm
            np.array([shoulder + shoulder_offset, (shoulder + grip) / 2 + [0, 0.13, -0.1], grip]),
            [0.075, 0.06, 0.045],
            10,
        ),
        tube(np.array([hip + [0, 0.1, -0.02], knee]), [0.11, 0.08], 10),  # thigh
        tube(np.array([knee + [0.02, 0, 0.03], [0.42, 0.24, 0.4]]), [0.075, 0.05], 10),  # lower leg
        ellipsoid([0.48, 0.24, 0.36], [0.15, 0.05, 0.05], 6, 10),  # foot
        ellipsoid(knee, [0.085, 0.085, 0.085], 6, 10),  # knee
        ellipsoid(shoulder + 0.9 * shoulder_offset, [0.09, 0.09, 0.09], 6, 10),  # shoulder
        ellipsoid(hip + [-0.03, 0.06, -0.03], [0.17, 0.13, 0.13], 6, 10),  # hip
    ]
    return [
        ("cloth", join_meshes([widened_torso, *(m.with_mirror_image() for m in limbs)])),
        (helmet_material, ellipsoid(helmet_center, [0.15, 0.125, 0.155], 10, 18)),
        ("glass", ellipsoid(helmet_center + [0.045, 0, 0.01], [0.113, 0.115, 0.06], 8, 16)),  # visor
    ]


def _mudguard(axle: Array, radius: float, half_width: float, angles: tuple[float, float]) -> Mesh:
    """A mudguard over a wheel, from the first to the last of ``angles`` (rad), which count from the front upwards."""
    angle = np.linspace(*angles, 16)[:, None]
    y = np.linspace(half_width, -half_width, 7)
    r = radius + 0.03 - 0.03 * (y / half_width) ** 4
    points = np.stack([r * np.cos(angle), np.broadcast_to(y, (16, 7)), r * np.sin(angle)], -1)
    return sheet(axle + points)


def _wheel(rng: np.random.Generator, radius: float, width: float) -> dict[str, Mesh]:
    """A wheel's meshes by the name of their material: tyre, rim with spokes, and brake disc on its left."""
    half_width = width / 2
    rim_radius = 0.72 * radius
    tyre = revolve(
        [
            [rim_radius, -0.6 * half_width],
            [0.88 * radius, -half_width],
            [0.97 * radius, -0.6 * half_width],
            [radius, 0.0],
            [0.97 * radius, 0.6 * half_width],
            [0.88 * radius, half_width],
            [rim_radius, 0.6 * half_width],
        ],
        32,
    )
    lip = revolve(
        [
            [0.96 * rim_radius, -0.5 * half_width],
            [rim_radius, -0.6 * half_width],
            [rim_radius, 0.6 * half_width],
            [0.96 * rim_radius, 0.5 * half_width],
        ],
        32,
    )
    brake_disc = revolve(
        [
            [0.45 * rim_radius, 0.72 * half_width],
            [0.8 * rim_radius, 0.72 * half_width],
            [0.8 * rim_radius, 0.78 * half_width],
            [0.45 * rim_radius, 0.78 * half_width],
        ],
        24,
    )
    hub = revolve([[0.0, -1.1 * half_width], [0.05, -half_width], [0.05, half_width], [0.0, 1.1 * half_width]], 12)
    spoke_count = int(rng.choice([3, 5, 6]))
    spoke_angles = 2 * np.pi * np.arange(spoke_count) / spoke_count
    spokes = [
        tube(
            np.array([[0.03 * np.cos(t), 0.03 * np.sin(t), 0], [rim_radius * np.cos(t), rim_radius * np.sin(t), 0]]),
            0.018,
            8,
        )
        for t in spoke_angles
    ]
    meshes = {"rubber": tyre, "rim": join_meshes([lip, hub, *spokes]), "chrome": brake_disc.transformed([0, 0, 0])}
    return {name: mesh.transformed([0, 0, 0], Z_TO_Y) for name, mesh in meshes.items()}
