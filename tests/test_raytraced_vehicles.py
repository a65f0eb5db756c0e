"""Rendered vehicles: real measures, relief, planes where the mesh is, whole and symmetric meshes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from selection import slow_after

from paceline.errors import UnusableInput
from paceline.simulation.raytraced import mesh_builders
from paceline.simulation.raytraced.mesh_builders import Mesh
from paceline.simulation.raytraced.meshes import SceneMesh
from paceline.simulation.raytraced.vehicles.build import Body, build
from paceline.simulation.raytraced.vehicles.sheet_metal import smoothing_weights
from paceline.simulation.vehicle_catalogue import RAYTRACED_KINDS

Array = NDArray[np.float64]

SEEDS = (0, 3)
REAL = {  # length, width, height, wheelbase: from and to, m
    "saloon": ((4.2, 5.0), (1.70, 1.90), (1.38, 1.53), (2.5, 2.9)),
    "estate": ((4.2, 5.0), (1.70, 1.90), (1.38, 1.58), (2.5, 2.9)),
    "van": ((4.7, 6.2), (1.85, 2.1), (1.85, 2.6), (2.9, 3.8)),
    "lorry": ((7.0, 9.5), (2.25, 2.55), (3.1, 3.9), (4.2, 5.4)),
    "bus": ((10.5, 12.6), (2.4, 2.56), (2.9, 3.3), (5.5, 6.3)),
    "motorcycle": ((1.9, 2.3), (0.7, 1.0), (1.4, 1.9), (1.3, 1.55)),
}


@pytest.fixture(scope="module")
def bodies() -> dict[tuple[str, int], Body]:
    return {(kind, seed): build(kind, seed) for kind in RAYTRACED_KINDS for seed in SEEDS}


EACH = pytest.mark.parametrize(
    ("kind", "seed"), slow_after(len(RAYTRACED_KINDS), [(kind, seed) for seed in SEEDS for kind in RAYTRACED_KINDS])
)


def all_solids(body: Body) -> list[SceneMesh]:
    return [*body.meshes, *(w.mesh.transformed(np.eye(3), w.center) for w in body.wheels)]


def first_hits(solids: list[SceneMesh], origins: Array, direction: Array) -> tuple[Array, Array]:
    """Distances (N,) to the first triangles met by parallel rays, and how much those face them (cosine); inf and nan
    where none is met. By Möller and Trumbore."""
    corners = np.concatenate([s.vertices[s.triangles] for s in solids])
    side = np.linalg.svd(direction[None])[2][1:].T  # (3, 2), square to the rays
    low, high = (corners @ side).min(1), (corners @ side).max(1)
    distance, cosine = np.full(len(origins), np.inf), np.full(len(origins), np.nan)
    for k, origin in enumerate(origins):
        at = origin @ side
        a, b, c = np.moveaxis(corners[((low <= at) & (at <= high)).all(1)], 1, 0)
        e, f = b - a, c - a
        p = np.cross(direction, f)
        det = (e * p).sum(1)
        det = np.where(np.abs(det) > 1e-14, det, np.nan)  # seen edge on
        u = ((origin - a) * p).sum(1) / det
        q = np.cross(origin - a, e)
        v, t = q @ direction / det, (q * f).sum(1) / det
        hit = np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0))
        if len(hit):
            best = hit[t[hit].argmin()]
            normal = np.cross(e[best], f[best])
            distance[k], cosine[k] = t[best], -(normal @ direction) / np.linalg.norm(normal)
    return distance, cosine


@EACH
def test_measures_are_real(bodies: dict[tuple[str, int], Body], kind: str, seed: int) -> None:
    body = bodies[kind, seed]
    for value, (low, high) in zip((body.length, body.width, body.height, body.wheelbase), REAL[kind], strict=True):
        assert low < value < high
    vertices = np.concatenate([s.vertices for s in all_solids(body)])
    size = np.ptp(vertices, axis=0)
    assert body.length - 0.05 < size[0] < body.length + 0.3  # a bus's mirrors stand out ahead
    assert body.width - 0.06 < size[1] < body.width + 0.9  # mirrors stand out
    assert vertices[:, 2].max() == pytest.approx(body.height, abs=0.12)
    assert vertices[:, 2].min() == pytest.approx(0, abs=2e-3)  # tyres on the road
    assert sum(len(s.triangles) for s in all_solids(body)) < 30000


@EACH
def test_wheels_are_on_the_road_below_their_axles(bodies: dict[tuple[str, int], Body], kind: str, seed: int) -> None:
    body = bodies[kind, seed]
    for wheel in body.wheels:
        assert wheel.center[2] == wheel.radius
        assert min(abs(wheel.center[0]), abs(wheel.center[0] - body.wheelbase)) < 1e-9
        rim = np.hypot(wheel.mesh.vertices[:, 0], wheel.mesh.vertices[:, 2])
        assert rim.max() < wheel.radius + 1e-9
        if wheel.mesh.name == "rubber":
            assert rim.max() == pytest.approx(wheel.radius)
    spokes = next(w for w in body.wheels if w.mesh.name == "rim").mesh.vertices
    c, s = np.cos(0.3), np.sin(0.3)
    turned = spokes @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
    assert cKDTree(spokes).query(turned)[0].max() > 0.01  # that it turns can be seen


@EACH
def test_visible_sides_are_outer_ones(bodies: dict[tuple[str, int], Body], kind: str, seed: int) -> None:
    body = bodies[kind, seed]
    solids = all_solids(body)
    rng = np.random.default_rng(1)
    middle = np.array([body.wheelbase / 2, 0, 0.45 * body.height])
    for direction in ([-1, 0, 0], [1, 0, 0], [0, -1, 0], [-0.8, 0.3, -0.5], [0.6, -0.6, -0.4]):
        d = np.array(direction) / np.linalg.norm(direction)
        origins = middle - 20 * d + rng.normal(size=(60, 3)) * [body.length / 5, body.width / 5, body.height / 5]
        distance, cosine = first_hits(solids, origins, d)
        met = np.isfinite(distance)
        assert met.sum() > 20
        assert (cosine[met] > 0).mean() > (0.97 if kind != "motorcycle" else 0.85)  # whose tubes are open


@EACH
def test_bodies_are_symmetric(bodies: dict[tuple[str, int], Body], kind: str, seed: int) -> None:
    body = bodies[kind, seed]
    for solid in all_solids(body) if kind != "motorcycle" else body.meshes:
        mirrored = solid.vertices * [1, -1, 1]
        twin = [s.vertices for s in all_solids(body) if s.name == solid.name]
        if solid.name not in ("rim", "chrome", "dark"):  # how spokes of a wheel are mirrored is not theirs
            assert cKDTree(np.concatenate(twin)).query(mirrored)[0].max() < 1e-5


@EACH
@pytest.mark.parametrize("end", ["front", "rear"])
def test_planes_lie_where_the_mesh_is(bodies: dict[tuple[str, int], Body], kind: str, seed: int, end: str) -> None:
    body = bodies[kind, seed]
    plane, sign = (body.front, 1.0) if end == "front" else (body.rear, -1.0)
    assert plane.end == end
    corners = plane.corners()
    np.testing.assert_allclose(corners.mean(0), plane.center, atol=1e-12)
    assert corners[0, 2] > corners[3, 2] and sign * (corners[1, 1] - corners[0, 1]) > 0  # top-left, then top-right
    rng = np.random.default_rng(2)
    weights = rng.dirichlet(np.ones(4), 100)
    points = weights @ corners
    depth = first_hits(list(body.meshes), points + [sign * 15, 0, 0], np.array([-sign, 0.0, 0.0]))[0]
    x = sign * (15 - depth)  # ahead of the plane
    met = np.isfinite(depth)
    assert met.mean() > (0.97 if kind != "motorcycle" else 0.4)
    if kind != "motorcycle":
        assert np.abs(x[met]).max() < 0.8 and np.median(np.abs(x[met])) < 0.1
    across, up = np.meshgrid(np.linspace(-0.47, 0.47, 17), np.linspace(-0.46, 0.46, 12))
    grid = plane.center + np.stack([15 * sign + 0 * across, across * plane.width, up * plane.height], -1).reshape(-1, 3)
    depth = first_hits(list(body.meshes), grid, np.array([-sign, 0.0, 0.0]))[0]
    assert (15 - depth[np.isfinite(depth)]).mean() == pytest.approx(0, abs=0.03 if kind != "motorcycle" else 0.1)


@pytest.mark.parametrize("kind", ["saloon", "estate", "van", "bus", "lorry"])
def test_fronts_have_relief(bodies: dict[tuple[str, int], Body], kind: str) -> None:
    """The bumper stands 5 to 20 cm before the bottom of the grille."""
    for seed in SEEDS:
        body = bodies[kind, seed]
        plane = body.front
        z = np.linspace(0.3, plane.center[2] + plane.height / 2 - 0.03, 120)
        origins = np.column_stack([np.full(120, 30.0), np.full(120, 0.28), z])
        x = 30 - first_hits(list(body.meshes), origins, np.array([-1.0, 0, 0]))[0]
        z, x = z[np.isfinite(x)], x[np.isfinite(x)]
        half = z < (z[0] + z[-1]) / 2
        assert 0.05 < x[half].max() - x[~half].min() < 0.3
        steps = np.abs(np.diff(x)) > 0.015
        assert steps.sum() >= 3  # bars, edges and recesses


@EACH
@pytest.mark.parametrize("end", ["front", "rear"])
def test_lines_are_level_or_upright_and_near_the_plane(
    bodies: dict[tuple[str, int], Body], kind: str, seed: int, end: str
) -> None:
    body = bodies[kind, seed]
    lines = body.lines(end)
    assert lines.ndim == 3 and lines.shape[1:] == (2, 3) and len(lines) >= 2
    dy, dz = np.abs(lines[:, 1, 1:] - lines[:, 0, 1:]).T
    assert (np.minimum(dy, dz) < 1e-9).all() and (np.maximum(dy, dz) > 0.04).all()
    plane = body.front if end == "front" else body.rear
    assert np.abs(lines[..., 0] - plane.center[0]).max() < 0.7
    mirrored = np.sort(np.round(lines * [1, -1, 1], 6).reshape(-1, 6), axis=0)
    np.testing.assert_allclose(
        np.sort(mirrored[:, [0, 2, 3, 5]], 0), np.sort(np.round(lines, 6).reshape(-1, 6)[:, [0, 2, 3, 5]], 0)
    )


@pytest.mark.parametrize("kind", RAYTRACED_KINDS)
def test_the_same_seed_gives_the_same_vehicle(bodies: dict[tuple[str, int], Body], kind: str) -> None:
    one, two, other = bodies[kind, 3], build(kind, 3), bodies[kind, 0]
    for a, b in zip(all_solids(one), all_solids(two), strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.triangles, b.triangles)
        assert a.material.color == b.material.color
    assert one.length != other.length


def test_reflectances_and_textures_fit(bodies: dict[tuple[str, int], Body]) -> None:
    for body in bodies.values():
        for solid in all_solids(body):
            m = solid.material
            assert m.kind in ("matte", "paint", "glass", "metal")
            assert min(m.color) > 0 and max(m.color) < 0.85
            assert np.isfinite(solid.vertices).all() and solid.triangles.max() < len(solid.vertices)
            if m.texture is not None:
                assert solid.uv is not None and solid.uv.min() >= 0 and solid.uv.max() <= 1
                assert m.texture.dtype == np.float32 and m.texture.min() > 0 and m.texture.max() < 0.85
        assert {"front plate", "rear plate"} & {s.name for s in body.meshes}


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(UnusableInput, match="'tram': expected one of saloon, estate"):
        build("tram", 0)


# --- shapes --------------------------------------------------------------------------------------------------------


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def is_closed(mesh: Mesh) -> bool:
    """Whether each edge is run along once in each sense."""
    t = mesh_builders.weld(mesh).triangles
    edges = np.concatenate([t, np.roll(t, -1, 1)]).reshape(2, -1).T
    forward = {tuple(e) for e in edges.tolist()}
    return len(forward) == len(edges) and all((b, a) in forward for a, b in forward)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (mesh_builders.box([1.0, 2.0, 3.0], [5.0, 1.0, 0.0]), 6.0),
        (mesh_builders.boxes([[1, 1, 1], [2, 1, 1]], [[0, 0, 0], [5, 5, 5]]), 3.0),
        (mesh_builders.ellipsoid([1, 2, 3], [1.0, 2.0, 0.5], 60, 80), 4 / 3 * np.pi),
        (mesh_builders.revolve([[0, 0], [1, 0], [1, 2], [0, 2]], 120), 2 * np.pi),
    ],
)
def test_solids_are_closed_with_their_outside_out(mesh: Mesh, expected: float) -> None:
    assert is_closed(mesh)
    assert volume(mesh) == pytest.approx(expected, rel=5e-3)
    assert volume(mesh.mirrored()) == pytest.approx(expected, rel=5e-3)


def test_a_tube_keeps_its_distance_from_its_path() -> None:
    t = np.linspace(0, 1.5, 30)
    path = np.column_stack([np.sin(t), t, np.cos(t)])
    mesh = mesh_builders.tube(path, 0.1, 12)
    distance = np.linalg.norm(mesh.vertices[:, None] - path, axis=2).min(1)
    np.testing.assert_allclose(distance, 0.1, atol=2e-3)
    outward = mesh_builders.triangle_normals(mesh)
    middle = mesh.vertices[mesh.triangles].mean(1)
    nearest = path[np.linalg.norm(middle[:, None] - path, axis=2).argmin(1)]
    assert ((middle - nearest) * outward).sum(1).min() > 0


def test_creases_part_vertices_at_sharp_edges_only() -> None:
    box = mesh_builders.weld(mesh_builders.box([1, 1, 1]))
    assert len(box.vertices) == 8
    assert len(mesh_builders.split_creases(box, 35).vertices) == 24
    assert len(mesh_builders.split_creases(box, 100).vertices) == 8
    ball = mesh_builders.weld(mesh_builders.ellipsoid([0, 0, 0], [1, 1, 1], 24, 48))
    parted = mesh_builders.split_creases(ball, 35)
    assert len(parted.vertices) == len(ball.vertices)
    np.testing.assert_allclose(parted.vertices[parted.triangles], ball.vertices[ball.triangles])


def test_parts_of_one_name_become_one() -> None:
    named = [(name, mesh_builders.box([1, 1, 1])) for name in ("a", "b", "a")]
    assert [(name, len(mesh.triangles)) for name, mesh in mesh_builders.group_by_name(named).items()] == [
        ("a", 24),
        ("b", 12),
    ]


def test_corners_are_rounded_within_their_reach() -> None:
    control = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [8.0, 4.0]])
    weights, segments = smoothing_weights([0.0, 0.25, 0.0, 0.0], 3, 4)
    np.testing.assert_allclose(weights.sum(1), 1)
    line = weights @ control
    np.testing.assert_allclose(line[[0, -1]], control[[0, -1]])
    assert (np.linalg.norm(line - control[2], axis=1) < 1e-12).any()  # a sharp corner is kept
    gap = np.linalg.norm(line - control[1], axis=1).min()
    assert gap == pytest.approx(0.25 * 4 * np.sqrt(2) / 4)  # half as far as the middle of its chord
    assert np.all(np.diff(segments) >= 0) and set(segments) == {0, 1, 2}
