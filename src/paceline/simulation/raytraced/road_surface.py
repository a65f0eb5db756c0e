"""Meshes and materials of a road: asphalt, repairs, painted lines, verge and the surrounding land."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from paceline.arrays import Array
from paceline.simulation.raytraced import road_textures as textures
from paceline.simulation.raytraced.mesh_builders import Mesh, join_meshes, sheet, split_creases
from paceline.simulation.raytraced.meshes import Material, SceneMesh

STATION_STEP_M = 0.5  # m, between the stations of the surface's mesh
ASPHALT_TILE_M = 16.0  # m, after which the asphalt's texture repeats
ASPHALT_TEXELS_PER_METRE = 140.0  # texels per metre of asphalt
LINE_WIDTH_M = 0.12  # m
EDGE_LINE_WIDTH_M = 0.15  # m
LINE_HEIGHT_M = 0.003  # height of the paint above the asphalt
DASH_LENGTH_M, DASH_GAP_M = 3.0, 9.0  # m
VERGE_WIDTH_M = 7.0  # m of grass beside the shoulder, beyond which the land begins
VERGE_DROP_M = 0.5  # m from the shoulder's edge down to the land


class RoadAppearance(Protocol):
    @property
    def lane_width(self) -> float: ...
    @property
    def markings(self) -> str: ...
    @property
    def wear(self) -> float: ...


class RoadGeometry(Protocol):
    """What this module needs to know of a road."""

    length: float
    seed: int
    half_width: float
    lanes: tuple[float, ...]
    markings: tuple[float, ...]

    @property
    def shape(self) -> RoadAppearance: ...

    def frame(self, s: ArrayLike, lateral: ArrayLike = 0.0) -> tuple[Array, Array]: ...


def road_meshes(road: RoadGeometry) -> list[SceneMesh]:
    """Asphalt, repairs, markings, verge and land of ``road``; the same for the same road and seed."""
    rng = np.random.default_rng([road.seed, 37])
    reflectance = rng.uniform(0.06, 0.11)
    tracks = [road.half_width + lane + side for lane in road.lanes for side in (-0.75, 0.75)]
    cover = Material(
        "matte",
        (reflectance,) * 3,
        textures.asphalt_texture(
            rng, 2 * road.half_width, ASPHALT_TILE_M, tracks, ASPHALT_TEXELS_PER_METRE, reflectance
        ),
    )
    grass = Material("matte", (0.06, 0.09, 0.03), textures.grass_texture(rng))
    stations = _stations(road, 0.0, road.length)
    columns = np.sort([-road.half_width, *road.markings, *road.lanes, road.half_width])
    return [
        surface_strip(road, stations, columns, 0.0, (2 * road.half_width, ASPHALT_TILE_M)).with_material(
            "asphalt", cover
        ),
        *_repairs(road, rng, reflectance),
        *_markings(road, rng, reflectance),
        split_creases(_verge(road, rng, stations), 30.0).with_material("verge", grass, smooth=True),
        _land(road, rng).with_material("land", grass, smooth=True),
    ]


def _stations(road: RoadGeometry, start: float, end: float) -> Array:
    return np.linspace(start, end, max(2, int(np.ceil((end - start) / STATION_STEP_M)) + 1))


def surface_strip(
    road: RoadGeometry, stations: Array, laterals: Array, height: ArrayLike, tile: tuple[float, float]
) -> Mesh:
    """The surface over ``stations`` (S,) and ``laterals`` (C,) or (S, C), ``height`` (broadcast to (S, C)) above the
    road; its texture spans ``tile`` metres across and along."""
    points, axes = road.frame(stations[:, None], laterals)
    raised = points + np.broadcast_to(height, points.shape[:2])[..., None] * axes[..., 2]
    v, u = np.broadcast_arrays(stations[:, None] / tile[1], (laterals - laterals.min()) / tile[0])
    return sheet(raised[::-1], np.stack([u, v], -1)[::-1])


def _markings(road: RoadGeometry, rng: np.random.Generator, ground: float) -> list[SceneMesh]:
    """Painted lines, each a little wider or narrower than its middle but centred on it."""
    result = []
    for k, lateral in enumerate(road.markings):
        edge = k in (0, len(road.markings) - 1)
        width = EDGE_LINE_WIDTH_M if edge else LINE_WIDTH_M
        if edge or road.shape.markings == "solid":
            pieces = [(0.0, road.length)]
        else:
            first = rng.uniform(-DASH_LENGTH_M, DASH_GAP_M)
            starts = np.arange(first, road.length, DASH_LENGTH_M + DASH_GAP_M)
            pieces = [(max(0.0, a), min(a + DASH_LENGTH_M, road.length)) for a in starts if a + DASH_LENGTH_M > 0.5]
        sides = lateral + np.array([-width / 2, width / 2])
        meshes = [surface_strip(road, _stations(road, a, b), sides, LINE_HEIGHT_M, (width, 12.7)) for a, b in pieces]
        paint = textures.road_paint_texture(rng, width, 12.7, 160.0, road.shape.wear, ground)
        result.append(join_meshes(meshes).with_material(f"marking {k}", Material("matte", (0.45, 0.45, 0.43), paint)))
    return result


def _repairs(road: RoadGeometry, rng: np.random.Generator, ground: float) -> list[SceneMesh]:
    """Patches of newer or older asphalt, a millimetre above the old."""
    count = rng.poisson(road.length / 25)
    if count == 0:
        return []
    grey = ground * rng.uniform(0.65, 1.35)
    cover = Material("matte", (grey,) * 3, textures.asphalt_texture(rng, 5.0, 5.0, [], ASPHALT_TEXELS_PER_METRE, grey))
    meshes = []
    for _ in range(count):
        a = rng.uniform(0, road.length)
        b = min(a + rng.choice([rng.uniform(0.5, 2.0), rng.uniform(3, 12)]), road.length)
        x = rng.uniform(-road.half_width + 0.2, road.half_width - 1.2)
        sides = np.array([x, min(x + rng.uniform(0.4, 2.5), road.half_width)])
        if b > a + 0.1:
            meshes.append(surface_strip(road, _stations(road, a, b), sides, 0.001, (5.0, 5.0)))
    return [join_meshes(meshes).with_material("repairs", cover)] if meshes else []


def _verge(road: RoadGeometry, rng: np.random.Generator, stations: Array) -> Mesh:
    """Grass that falls away on both sides, uneven by a few centimetres, with a ragged border over the asphalt."""
    distances = np.array([0.0, 0.25, 0.8, 1.6, 3.0, 5.0, VERGE_WIDTH_M, VERGE_WIDTH_M + 0.8])
    fall = _verge_height(distances) + np.where(distances > 0, -0.03, 0.004)
    fall[-1] -= 0.8  # below the land
    meshes = []
    for side in (-1, 1):
        ragged = np.outer(rng.uniform(-0.1, 0.0, len(stations)), distances == 0)
        bumps = rng.normal(0, 0.03, (len(stations), len(distances))) * (distances > 0.5)
        laterals, height = side * (road.half_width + distances + ragged), fall + bumps
        if side < 0:
            laterals, height = laterals[:, ::-1], height[:, ::-1]
        meshes.append(surface_strip(road, stations, laterals, height, (10.0, 10.0)))
    return join_meshes(meshes)


def _verge_height(distance: Array) -> Array:
    """Height of the verge ``distance`` metres beyond the shoulder, relative to the banked plane of the road."""
    u = np.clip(distance / VERGE_WIDTH_M, 0, 1)
    return np.asarray(-VERGE_DROP_M * u * u * (3 - 2 * u))


def _land(road: RoadGeometry, rng: np.random.Generator) -> Mesh:
    """Rolling land as far as one sees: at the verge's foot beside the road, below it under the road; far away coarser,
    and there a little lower so that the near land covers it."""
    stations = np.arange(0.0, road.length + 1.0, 1.0).clip(max=road.length)
    phase = rng.uniform(0, 2 * np.pi, 4)
    near_ground = _ground(road, stations, phase, 6.0, (0.0, 130.0))
    return join_meshes([near_ground, _ground(road, stations, phase, 40.0, (60.0, 1500.0)).transformed([0, 0, -0.5])])


def _ground(road: RoadGeometry, stations: Array, phase: Array, cell: float, reach: tuple[float, float]) -> Mesh:
    """Land in cells of ``cell`` metres from one distance of the road's axis to another."""
    axis, frames = road.frame(stations)
    low, high = axis[:, :2].min(0) - reach[1], axis[:, :2].max(0) + reach[1]
    x, y = (np.arange(a, b + cell, cell) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y[::-1]), -1)
    distance, nearest = (found.ravel() for found in cKDTree(axis[:, :2]).query(grid))
    flat = sheet(np.concatenate([grid, np.zeros((*grid.shape[:2], 1))], -1), grid / 10.0)
    triangles = flat.triangles[((distance > reach[0]) & (distance < reach[1]))[flat.triangles].all(1)]
    used, triangles = np.unique(triangles, return_inverse=True)
    ground, distance, nearest = flat.vertices[used, :2], distance[used], nearest[used]
    edge = road.half_width + VERGE_WIDTH_M
    left = frames[nearest, :, 1]
    to_left = ((ground - axis[nearest, :2]) * left[:, :2]).sum(1)
    bank = np.clip(to_left, -edge, edge) * left[:, 2]
    X, Y = ground.T
    waves = np.sin(X / 37 + phase[0]) * np.sin(Y / 43 + phase[1])
    waves += 1.6 * np.sin(X / 91 + phase[2]) * np.sin(Y / 83 + phase[3])
    rolling = 1.2 * waves * (1 - np.exp(-np.maximum(distance - edge, 0.0) / 60))
    height = axis[nearest, 2] + bank - VERGE_DROP_M - 0.05 + rolling
    return Mesh(np.column_stack([ground, height]), triangles.reshape(-1, 3), flat.uv[used])
