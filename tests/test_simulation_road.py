"""Rendered roads: exact axes and surfaces, painted lines where they are said to be, textures, what stands beside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.special import fresnel

from paceline.errors import UnusableInput
from paceline.simulation.raytraced import road_textures as textures
from paceline.simulation.raytraced.mesh_builders import Mesh, triangle_normals
from paceline.simulation.raytraced.meshes import SceneMesh
from paceline.simulation.raytraced.road_surface import road_meshes
from paceline.simulation.raytraced.scenery.placement import Scenery, build_scenery
from paceline.simulation.road import (
    POLYGON_STEP_M,
    ROAD_MARGIN_M,
    Axis,
    CircularAxis,
    IntegratedAxis,
    PolygonalAxis,
    Road,
    RoadShape,
)

Array = NDArray[np.float64]

CURVES = st.sampled_from(["straight", "circle", "clothoid", "winding"])
LENGTH = 120.0


@st.composite
def shapes(draw: st.DrawFn) -> RoadShape:
    kind = draw(CURVES)
    radius = None if kind == "straight" else draw(st.floats(40, 800)) * draw(st.sampled_from([-1, 1]))
    crest = draw(st.one_of(st.none(), st.floats(600, 4000).map(lambda r: r * draw(st.sampled_from([-1, 1])))))
    return RoadShape(kind, radius, draw(st.floats(-0.1, 0.1)), draw(st.floats(-0.1, 0.1)), crest)


def facing_up(solid: SceneMesh) -> Array:
    """Upward parts (T,) of the unit normals of a solid's triangles."""
    n = triangle_normals(Mesh(solid.vertices, solid.triangles, np.zeros((0, 2))))
    return np.asarray(n[:, 2] / np.linalg.norm(n, axis=1))


def named(solids: list[SceneMesh], name: str) -> SceneMesh:
    return next(s for s in solids if s.name == name)


# --- the axis ------------------------------------------------------------------------------------------------------


def waves(s: Array) -> Array:
    """The curvature of a road that winds right and left."""
    return np.asarray(np.sin(s / 15.0) / 60.0)


AXES = [
    (CircularAxis(0.0), 1e-9),
    (CircularAxis(1 / 70.0), 1e-9),
    (CircularAxis(-1 / 25.0), 1e-9),
    (IntegratedAxis(waves, LENGTH), 1e-8),
    (PolygonalAxis(waves(POLYGON_STEP_M * np.arange(2 * LENGTH + 1)), LENGTH), POLYGON_STEP_M / 60),
]


@pytest.mark.parametrize(("axis", "tolerance"), AXES)
def test_an_axis_heads_along_itself_and_turns_by_its_curvature(axis: Axis, tolerance: float) -> None:
    assert np.ravel(axis.pose(0.0)).tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    s, h = np.linspace(1.1, LENGTH - 1.1, 230), 1e-3
    before, after = (np.stack(axis.pose(at)) for at in (s - h, s + h))
    heading = axis.pose(s)[2]
    along, turning = (after[:2] - before[:2]) / (2 * h), (after[2] - before[2]) / (2 * h)
    np.testing.assert_allclose(along, [np.cos(heading), np.sin(heading)], atol=1e-7 + tolerance)
    np.testing.assert_allclose(turning, -axis.curvature(s), atol=1e-7 + tolerance / 15)  # positive to the right


@pytest.mark.parametrize(("axis", "tolerance"), AXES)
def test_points_beside_an_axis_are_found_again(axis: Axis, tolerance: float) -> None:
    s, lateral = np.meshgrid(np.linspace(5, 60, 23), np.linspace(-6, 6, 7))
    x, y, heading = axis.frame(s, lateral)
    on_axis = axis.pose(s)
    np.testing.assert_allclose(x - on_axis[0], lateral * np.sin(heading), atol=1e-12)
    np.testing.assert_allclose(y - on_axis[1], -lateral * np.cos(heading), atol=1e-12)
    found = axis.locate(x, y, s + 2.0)
    np.testing.assert_allclose(found, (s, lateral), atol=2e-6 + 8 * tolerance)


def test_a_polygon_follows_its_curve() -> None:
    s = np.linspace(0, LENGTH, 1001)
    curve, polygon = (np.stack(axis.pose(s)) for axis, _ in AXES[3:])
    np.testing.assert_allclose(polygon[:2], curve[:2], atol=4e-3)
    np.testing.assert_allclose(polygon[2], curve[2], atol=POLYGON_STEP_M**2 / 60)


def test_a_clothoid_that_climbs_is_fresnels_in_plan() -> None:
    """The places where its curvature begins and ends to change are no round numbers of metres in plan."""
    s, plan = np.linspace(0, LENGTH, 50), LENGTH / np.hypot(1, 0.08)
    points = Road(RoadShape("clothoid", 60.0, grade=0.08), LENGTH, 1).frame(s)[0]
    a = np.sqrt(np.pi * plan * 60.0)
    S, C = fresnel(s * plan / LENGTH / a)
    np.testing.assert_allclose(points, np.column_stack([a * C, -a * S, 0.08 * s * plan / LENGTH]), atol=1e-8)


def test_a_road_starts_at_the_origin_and_heads_east() -> None:
    point, axes = Road(RoadShape("clothoid", -90.0), LENGTH, 1).frame(0.0)
    np.testing.assert_allclose(point, 0, atol=1e-12)
    np.testing.assert_allclose(axes, np.eye(3), atol=1e-12)


@given(st.floats(30, 900), st.sampled_from([-1, 1]), st.floats(0, LENGTH), st.floats(-6, 6))
@settings(max_examples=30, deadline=None)
def test_a_circle_is_one(radius: float, sign: int, s: float, lateral: float) -> None:
    road = Road(RoadShape("circle", sign * radius), LENGTH, 1)
    point, axes = road.frame(s, lateral)
    turn = s / radius
    heading = np.array([np.cos(turn), -sign * np.sin(turn), 0.0])  # positive curvature turns right
    centre = np.array([0.0, -sign * radius, 0.0])
    outwards = np.array([np.sin(turn), sign * np.cos(turn), 0.0])
    np.testing.assert_allclose(point, centre + (radius - sign * lateral) * outwards, atol=1e-6)
    np.testing.assert_allclose(axes[:, 0], heading, atol=1e-8)


@pytest.mark.parametrize("radius", [60.0, -250.0])
def test_a_clothoid_is_fresnels(radius: float) -> None:
    s = np.linspace(0, LENGTH, 50)
    point, _ = Road(RoadShape("clothoid", radius), LENGTH, 1).frame(s)
    a = np.sqrt(np.pi * LENGTH * abs(radius))
    S, C = fresnel(s / a)
    np.testing.assert_allclose(point, np.column_stack([a * C, -np.sign(radius) * a * S, 0 * s]), atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_winding_road_bends_to_both_sides_and_no_tighter_than_stated(seed: int) -> None:
    road = Road(RoadShape("winding", 80.0), 600.0, seed)
    s = np.linspace(0, 600, 6001)
    _, axes = road.frame(s)
    curvature = -np.diff(np.unwrap(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))) / np.diff(s)
    assert np.abs(curvature).max() <= 1 / 80 + 1e-6
    assert curvature.max() > 0.4 / 80 and curvature.min() < -0.4 / 80


@given(shapes(), st.floats(1, LENGTH - 1), st.floats(-6, 6))
@settings(max_examples=60, deadline=None)
def test_the_frame_is_the_surfaces(shape: RoadShape, s: float, lateral: float) -> None:
    road, h = Road(shape, LENGTH, 5), 1e-3
    _, axes = road.frame(s, lateral)
    along = (road.frame(s + h, lateral)[0] - road.frame(s - h, lateral)[0]) / (2 * h)
    across = (road.frame(s, lateral + h)[0] - road.frame(s, lateral - h)[0]) / (2 * h)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[:, 0], along / np.linalg.norm(along), atol=1e-6)
    np.testing.assert_allclose(axes[:, 1], -across, atol=1e-8)
    on_axis = (road.frame(s + h)[0] - road.frame(s - h)[0]) / (2 * h)
    assert np.linalg.norm(on_axis) == pytest.approx(1, abs=1e-7)  # arc length is that of the axis


@given(shapes(), st.floats(1, LENGTH - 1), st.floats(-5, 5), st.floats(-0.5, 0.5))
@settings(max_examples=40, deadline=None)
def test_points_are_located_where_they_are(shape: RoadShape, s: float, lateral: float, high: float) -> None:
    road = Road(shape, LENGTH, 5)
    point, axes = road.frame(s, lateral)
    found = road.locate(point + high * axes[:, 2], s + 0.8, lateral - 0.5)
    np.testing.assert_allclose(found, (s, lateral), atol=1e-6)


def test_grade_bank_and_crest_are_what_they_are_called() -> None:
    rise = Road(RoadShape(grade=0.06, bank=0.04), LENGTH, 1)
    a, b = rise.frame(np.array([10.0, 60.0]))[0]
    assert (b[2] - a[2]) / (b[0] - a[0]) == pytest.approx(0.06)
    right = rise.frame(10.0, 2.0)[0]
    assert right[1] < a[1]  # lateral positions are positive to the right of an eastbound road
    np.testing.assert_allclose(np.linalg.norm(right - a), 2.0)
    flat = Road(RoadShape(bank=0.04), LENGTH, 1)
    assert flat.frame(10.0, 2.0)[0][2] == pytest.approx(-2 * np.sin(0.04))  # the right edge is the lower one
    crest = Road(RoadShape(crest_radius=900.0), LENGTH, 1)
    s = np.linspace(0, LENGTH, 25)
    points = crest.frame(s)[0]
    top = crest.frame(LENGTH / 2)[0]
    assert top[2] == pytest.approx(points[:, 2].max(), abs=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points - (top - [0, 0, 900.0]), axis=1), 900.0, atol=1e-6)


def test_lanes_and_lines_lie_left_to_right() -> None:
    road = Road(RoadShape(lanes=3, lane_width=3.5), LENGTH, 1)
    np.testing.assert_allclose(road.lanes, [-3.5, 0, 3.5])
    np.testing.assert_allclose(road.markings, [-5.25, -1.75, 1.75, 5.25])
    assert len(Road(RoadShape(lanes=3, markings="none"), LENGTH, 1).markings) == 2
    line = Road(RoadShape("circle", 80.0), LENGTH, 1).line(1.8, 10, 50, 0.25)
    np.testing.assert_allclose(np.hypot(line[:, 0], line[:, 1] + 80), 80 - 1.8, atol=1e-6)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert steps.max() <= 0.25 + 1e-6 and np.ptp(steps) < 1e-5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "spiral"}, "'spiral': expected one of straight"),
        ({"kind": "circle"}, "a circle road needs one"),
        ({"radius": 100.0}, "a straight road has none"),
        ({"kind": "circle", "radius": 6.0}, "more than 1.5 times its half width"),
        ({"markings": "dotted"}, "'dotted': expected dashed, solid or none"),
        ({"crest_radius": 90.0}, "crest radius 90 m"),
        ({"lanes": 0}, "at least one lane"),
    ],
)
def test_contradictions_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(UnusableInput, match=message):
        Road(replace(RoadShape(), **change), LENGTH, 1)


def test_far_beyond_its_ends_a_road_is_unknown() -> None:
    road = Road(RoadShape(), LENGTH, 1)
    road.frame(np.array([-ROAD_MARGIN_M, LENGTH + ROAD_MARGIN_M]))
    with pytest.raises(ValueError, match="expected 0 to 120 m"):
        road.frame(LENGTH + ROAD_MARGIN_M + 1)


# --- what it is made of --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def banked() -> tuple[Road, list[SceneMesh]]:
    road = Road(RoadShape("circle", -120.0, grade=0.03, bank=-0.06), 60.0, 3)
    return road, road_meshes(road)


def test_painted_lines_are_centred_on_the_markings(banked: tuple[Road, list[SceneMesh]]) -> None:
    road, solids = banked
    for k, lateral in enumerate(road.markings):
        vertices = named(solids, f"marking {k}").vertices
        axis = road.frame(np.linspace(0, 60, 601))[0]
        nearest = np.linspace(0, 60, 601)[np.linalg.norm(vertices[:, None] - axis, axis=2).argmin(1)]
        s, found = road.locate(vertices, nearest, np.full(len(vertices), lateral))
        sides = found - lateral
        width = 0.15 if k in (0, 2) else 0.12
        np.testing.assert_allclose(np.abs(sides), width / 2, atol=1e-6)
        assert sides.mean() == pytest.approx(0, abs=1e-6)
        points, axes = road.frame(s, found)
        height = ((vertices - points) * axes[..., 2]).sum(-1)
        assert height.min() > 0.0005 and height.max() < 0.005  # above the asphalt, and hardly
        if k == 1:  # dashes of 3 m
            starts = np.unique(np.round(s, 3))
            gaps = np.diff(starts)
            assert gaps[gaps > 1].tolist() == pytest.approx([9.0] * (gaps > 1).sum(), abs=2e-3)


@pytest.mark.parametrize("name", ["asphalt", "marking 0", "marking 2", "land"])
def test_surfaces_look_up(banked: tuple[Road, list[SceneMesh]], name: str) -> None:
    assert facing_up(named(banked[1], name)).min() > 0.5


def test_the_verge_looks_up(banked: tuple[Road, list[SceneMesh]]) -> None:
    assert facing_up(named(banked[1], "verge")).min() > 0  # also its steep foot


@pytest.mark.parametrize("bank", [-0.1, 0.1])
def test_the_land_stays_below_the_road(bank: float) -> None:
    road = Road(RoadShape("circle", 90.0, grade=0.05, bank=bank), 80.0, 2)
    land = named(road_meshes(road), "land").vertices
    near = land[(np.abs(land[:, :2] - road.frame(40.0)[0][:2]) < 120).all(1)]
    height = LinearNDInterpolator(near[:, :2], near[:, 2])
    s, lateral = np.meshgrid(np.linspace(0, 80, 41), np.linspace(-road.half_width, road.half_width, 9))
    points = road.frame(s, lateral)[0].reshape(-1, 3)
    assert (points[:, 2] - height(points[:, :2])).min() > 0.1


def test_the_same_seed_gives_the_same_road() -> None:
    shape = RoadShape("winding", 150.0)
    one, two, other = (road_meshes(Road(shape, 40.0, seed)) for seed in (7, 7, 8))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.material.texture, b.material.texture)
    assert not np.array_equal(one[0].material.texture, other[0].material.texture)


def test_reflectances_are_real(banked: tuple[Road, list[SceneMesh]]) -> None:
    ground, paint, grass = (
        named(banked[1], n).material.texture.mean((0, 1)) for n in ("asphalt", "marking 0", "verge")
    )
    assert 0.05 < ground[0] < 0.12
    assert paint[0] > 3 * ground[0]
    assert 0.04 < grass[1] < 0.16 and grass[1] > grass[2]


def test_wear_takes_paint_away() -> None:
    fresh, worn, gone = (
        textures.road_paint_texture(np.random.default_rng(1), 0.15, 4.0, 160.0, wear, 0.08) for wear in (0.0, 0.4, 1.0)
    )
    assert fresh.min() > 0.3
    shares = [(t[..., 0] < 0.2).mean() for t in (worn, gone)]
    assert 0.15 < shares[0] < 0.6 and shares[1] > 0.75


@pytest.mark.parametrize("grain", [1.0, 5.0, 40.0])
def test_noise_repeats_without_a_seam(grain: float) -> None:
    noise = textures.mottle(np.random.default_rng(2), (180, 240), grain)
    assert noise.std() == pytest.approx(1, abs=1e-3)
    for axis in (0, 1):
        inner = np.diff(noise, axis=axis).std()
        seam = (np.take(noise, 0, axis) - np.take(noise, -1, axis)).std()
        assert seam < 1.5 * inner


# --- what stands beside --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 4])
def test_clear_circles_are_empty_and_no_trunk_is_on_the_road(seed: int) -> None:
    road = Road(RoadShape("circle", 200.0), 100.0, 1)
    spec = Scenery(trees=1.0, poles=1.0, buildings=0.5, seed=seed, clear=((30.0, -9.0, 12.0),))
    solids = build_scenery(road, spec, 0.0, 100.0)
    centre = road.frame(30.0, -9.0)[0]
    axis = road.frame(np.linspace(0, 100, 401))[0]
    for solid in solids:
        away = np.linalg.norm(solid.vertices[:, :2] - centre[:2], axis=1)
        assert away.min() > (10.0 if solid.name == "leaves" else 11.0)
        low = solid.vertices[solid.vertices[:, 2] < 1.0]
        if len(low) and solid.name not in ("leaves", "wood"):  # a branch may hang over the road
            gap = np.linalg.norm(low[:, None, :2] - axis[:, :2], axis=2).min()
            assert gap > road.half_width
    assert {"leaves", "wood", "white", "wall"} <= {s.name for s in solids}


@pytest.mark.parametrize("radius", [-41.0, 60.0])
def test_no_tree_is_on_another_part_of_a_bend(radius: float) -> None:
    road = Road(RoadShape("circle", radius), 0.8 * 2 * np.pi * abs(radius), 1)
    wood = named(build_scenery(road, Scenery(trees=1.0, poles=0.0, seed=2), 0.0, road.length), "wood")
    axis = road.frame(np.arange(0, road.length))[0]
    low = wood.vertices[wood.vertices[:, 2] < -0.8]  # the feet of trunks
    gap = np.linalg.norm(low[:, None, :2] - axis[:, :2], axis=2).min(1)
    assert gap.min() > road.half_width + 0.3


def test_trees_shade_a_part_of_the_road() -> None:
    """A sun across the road throws the crowns' shadows on it, with gaps in them."""
    road = Road(RoadShape(), 60.0, 1)
    leaves = named(build_scenery(road, Scenery(trees=1.0, poles=0.0, seed=1), 0.0, 60.0), "leaves")
    corners = leaves.vertices[leaves.triangles]
    near = np.concatenate([corners.mean(1), *((corners + np.roll(corners, 1, 1)) / 2).swapaxes(0, 1)])
    near = near[np.abs(near[:, 1]) < 20]
    ground = near[:, :2] - near[:, 2:] * np.array([[0.2, 0.7]])  # the sun stands high in the north
    lane = ground[(ground[:, 0] > 5) & (ground[:, 0] < 55) & (np.abs(ground[:, 1]) < 3.6)]
    cells = np.unique(np.floor(lane / 0.2), axis=0)
    share = len(cells) / (50 / 0.2 * 7.2 / 0.2)
    assert 0.15 < share < 0.95


def test_a_parapet_runs_parallel_to_the_road() -> None:
    road = Road(RoadShape("circle", 150.0), 80.0, 1)
    found = set()
    for seed in range(6):
        for solid in build_scenery(road, Scenery(0, 0, 0, True, seed), 0.0, 80.0):
            found.add(solid.name)
            lateral = 150.0 - np.hypot(solid.vertices[:, 0], solid.vertices[:, 1] + 150.0)
            assert np.abs(np.abs(lateral) - road.half_width).max() < 0.6
            assert np.ptp(solid.vertices[:, 2]) < 1.6
    assert found == {"concrete", "steel"}


def test_the_same_seed_gives_the_same_scenery() -> None:
    road = Road(RoadShape(), 50.0, 1)
    one, two = (build_scenery(road, Scenery(seed=3, buildings=0.5), 0.0, 50.0) for _ in range(2))
    assert [s.name for s in one] == [s.name for s in two]
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
