"""Built objects: houses, and rails, walls and fences that run along a road."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array
from paceline.simulation.raytraced.mesh_builders import Mesh, NamedMesh, box, boxes, join_meshes, quads, sheet
from paceline.simulation.raytraced.meshes import Texture
from paceline.simulation.raytraced.road_textures import mottle
from paceline.simulation.road import Road

# Cross sections (lateral away from the road, height), from the foot on the road's side over the top.
WALL_PROFILE = np.array([[0.0, -0.4], [0.0, 0.08], [0.18, 0.33], [0.24, 0.85], [0.46, 0.85], [0.55, -0.4]])
BEAM_PROFILE = np.array(
    [[0.0, 0.43], [-0.05, 0.47], [-0.05, 0.52], [0.0, 0.57], [0.0, 0.61], [-0.05, 0.66], [-0.05, 0.71], [0.0, 0.75]]
)
FENCE_DISTANCE_M = 5.0  # m from the road's edge


def house(rng: np.random.Generator) -> list[NamedMesh]:
    """A house with its middle at the origin, gables across x, windows on the long sides."""
    length, depth, storeys = rng.uniform(8, 18), rng.uniform(7, 10), int(rng.integers(1, 4))
    eaves = 2.9 * storeys + 0.3
    ridge = eaves + depth / 2 * rng.uniform(0.5, 0.9)
    x, y = length / 2, depth / 2
    walls = [box([length, depth, eaves + 4.0], [0, 0, eaves / 2 - 2.0])]
    gable = [[[s * x, s * y, eaves], [s * x, 0, ridge], [s * x, 0, ridge], [s * x, -s * y, eaves]] for s in (-1, 1)]
    walls.append(quads(np.array(gable)[:, [1, 1, 0, 3]]))
    over = 0.35
    foot = eaves - over * (ridge - eaves) / y
    roof = [
        [
            [s * (x + over), 0, ridge],
            [-s * (x + over), 0, ridge],
            [-s * (x + over), -s * (y + over), foot],
            [s * (x + over), -s * (y + over), foot],
        ]
        for s in (1, -1)
    ]
    roofs = quads(np.array(roof)[:, [1, 0, 3, 2]])
    panes, frames = [], []
    count = int(length / rng.uniform(2.2, 3.2))
    for storey in range(storeys):
        for window_x in (np.arange(count) + 0.5) / count * (length - 1) - (length - 1) / 2:
            z = 2.9 * storey + 1.6
            panes += [[[window_x - 0.5, s * (y + 0.01), z]] for s in (-1, 1)]
            frames += [[window_x, s * (y + 0.0), z - 0.78] for s in (-1, 1)]
    centers = np.array(panes).reshape(-1, 3) + [0.5, 0, 0]
    glass = boxes(np.tile([1.0, 0.06, 1.4], (len(centers), 1)), centers)
    bars = boxes(np.tile([0.06, 0.1, 1.4], (len(centers), 1)), centers)
    sills = boxes(np.tile([1.2, 0.24, 0.07], (len(frames), 1)), frames)
    chimney = box([0.6, 0.6, 1.6], [0.3 * length, 0.15 * depth, ridge])
    return [
        ("wall", join_meshes([*walls, chimney])),
        ("roof", roofs),
        ("pane", glass),
        ("frame", join_meshes([bars, sills])),
    ]


def wall_texture(rng: np.random.Generator) -> Texture:
    """Plaster (128, 128, 3)."""
    color = np.array([[0.45, 0.42, 0.36], [0.30, 0.14, 0.09], [0.5, 0.5, 0.48], [0.4, 0.33, 0.2]])[rng.integers(4)]
    shade = 1 + 0.025 * mottle(rng, (128, 128), 3.0) + 0.05 * mottle(rng, (128, 128), 30.0)
    return np.asarray(np.clip(shade, 0.5, 1.5)[..., None] * color, np.float32)


def concrete_texture(rng: np.random.Generator) -> Texture:
    """Weathered concrete (256, 512, 3), streaked downwards."""
    streaks = mottle(rng, (1, 512), 10.0) * np.linspace(0.0, 0.1, 256, dtype=np.float32)[:, None]
    shade = 1 + 0.08 * mottle(rng, (256, 512), 2.0) + 0.07 * mottle(rng, (256, 512), 40.0) - np.abs(streaks)
    return np.asarray(0.24 * np.clip(shade, 0.4, 1.4)[..., None] * [1.0, 0.98, 0.93], np.float32)


def extrude_along(road: Road, profile: Array, lateral: float, start: float, end: float, tile: float = 4.0) -> Mesh:
    """A ``profile`` (P, 2) drawn along ``road`` at ``lateral``, facing its axis; textures repeat each ``tile`` m."""
    s = np.linspace(start, end, max(2, int((end - start) / 1.0) + 1))
    side = np.sign(lateral)
    points, axes = road.frame(s[:, None], lateral + side * profile[None, :, 0])
    raised = points + profile[None, :, 1:] * axes[..., 2]
    u, v = np.broadcast_arrays(s[:, None] / tile, np.linspace(0, 1, len(profile)))
    grid, uv = np.swapaxes(raised, 0, 1)[::-1], np.swapaxes(np.stack([u, v], -1), 0, 1)[::-1]
    return sheet(grid, uv) if side < 0 else sheet(grid[:, ::-1], uv[:, ::-1])


def guard_rail(road: Road, side: int, start: float, end: float) -> list[NamedMesh]:
    """A steel beam on posts."""
    lateral = side * (road.half_width + 0.35)
    posts = repeat_along(road, box([0.1, 0.08, 1.2], [0, 0.08, 0.15]), lateral, np.arange(start + 0.5, end, 2.0))
    return [("steel", extrude_along(road, BEAM_PROFILE, lateral, start, end)), ("steel", posts)]


def wall(road: Road, side: int, start: float, end: float) -> list[NamedMesh]:
    """A concrete safety barrier at the edge of the asphalt."""
    return [("concrete", extrude_along(road, WALL_PROFILE, side * (road.half_width - 0.1), start, end))]


def fence(road: Road, side: int, start: float, end: float) -> list[NamedMesh]:
    """A timber fence beyond the verge."""
    lateral = side * (road.half_width + FENCE_DISTANCE_M)
    posts = repeat_along(road, box([0.1, 0.1, 1.8], [0, 0, 0.1]), lateral, np.arange(start, end, 2.4))
    rails = [
        extrude_along(road, np.array([[0.0, z], [0.0, z + 0.1], [0.04, z + 0.1]]) - [0, 0.35], lateral, start, end)
        for z in (0.4, 0.8)
    ]
    return [("timber", join_meshes([posts, *rails]))]


def repeat_along(road: Road, mesh: Mesh, lateral: float, places: Array) -> Mesh:
    """Copies of ``mesh`` at arc lengths ``places`` (N,); its x runs along the road and its y away from it."""
    points, axes = road.frame(places, lateral)
    turn = axes if lateral < 0 else axes * [-1, -1, 1]
    return join_meshes(mesh.transformed(p, R) for p, R in zip(points, turn, strict=True))
