"""The renderer: exact in place and light, the same on both variants."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selection import slow_after

from paceline.cameras import Camera, PosedCamera
from paceline.simulation.raytraced import mitsuba_variant
from paceline.simulation.raytraced.light import LUMINANCE_WEIGHTS, Light
from paceline.simulation.raytraced.meshes import Material, SceneMesh
from paceline.simulation.raytraced.mitsuba_variant import FAST_VARIANT, PORTABLE_VARIANT, default_variant, find_llvm
from paceline.simulation.raytraced.renderer import Renderer, merge_meshes

Array = NDArray[np.float64]

GREY = Material("matte", (0.3, 0.3, 0.3))
DAY = Light(1.0, 0.8, clouds=0.0)


def quad(corners: Array, color: float) -> SceneMesh:
    return SceneMesh(
        "quad", np.asarray(corners, float), np.array([[0, 1, 2], [0, 2, 3]]), Material("matte", (color,) * 3)
    )


def ground(half: float = 20.0, color: float = 0.3) -> SceneMesh:
    return quad(half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), color)


def cube(center: Array, size: float) -> SceneMesh:
    v = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2 + center
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = np.array([[a, b, c] for a, b, c, d in faces] + [[a, c, d] for a, b, c, d in faces])
    return SceneMesh("cube", v, triangles, GREY)


def looking(camera: Camera, eye: Array, at: Array, roll: float = 0.0) -> PosedCamera:
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, [0.1, 0, 1.0])
    x /= np.linalg.norm(x)
    R = cv2.Rodrigues(np.array([0, 0, roll]))[0] @ np.array([x, np.cross(z, x), z])
    return PosedCamera(camera, R, -R @ eye)


def camera(width: int, height: int, f: float, cx: float, cy: float) -> Camera:
    return Camera((width, height), np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]))


def mark(center: Array, across: Array, down: Array, away: Array) -> list[SceneMesh]:
    """A square that shines by itself before a black one of twice its size."""
    square = np.array([-across - down, across - down, across + down, -across + down])
    shining = SceneMesh("lamp", center + square, np.array([[0, 2, 1], [0, 3, 2]]), Material("glow", (1e4, 1e4, 1e4)))
    return [shining, quad(center + 2 * square + 0.02 * away, 0.0)]


def centroid(corners: Array) -> Array:
    """Of the area of a polygon (N, 2)."""
    (x, y), (u, v) = corners.T, np.roll(corners, -1, 0).T
    turn = x * v - u * y
    return np.array([((x + u) * turn).sum(), ((y + v) * turn).sum()]) / (3 * turn.sum())


@pytest.mark.parametrize("distance", slow_after(1, [4.0, 80.0, 25.0]))
@pytest.mark.parametrize(
    ("lens", "roll"),
    [(camera(160, 120, 220.0, 70.3, 66.8), 0.0), (camera(121, 143, 900.0, 61.7, 80.2), 0.3)],
    ids=["short", "long"],
)
def test_points_project_where_they_are_rendered(lens: Camera, roll: float, distance: float) -> None:
    """The middle of a square's light lies within 0.02 px of that of its projection."""
    rng = np.random.default_rng(int(distance))
    eye, size = np.array([3.0, -2.0, 1.7]), np.array(lens.image_size)
    x, y = rng.uniform(40, size - 40)
    view = looking(lens, eye, eye + np.array([0.0, 1.0, 0.0]), roll)
    center = eye + distance * (np.linalg.inv(lens.K) @ [x, y, 1.0]) @ view.R
    half, turn = 8 * distance / lens.K[0, 0], rng.uniform(0.2, 0.6)
    across = half * np.array([np.cos(turn), 0.4 * np.sin(turn), np.sin(turn)])
    down = half * np.array([np.sin(turn), 0.3, -np.cos(turn)])
    solids = mark(center, across, down, np.array([0.0, 1.0, 0.0]) * distance / 20)
    picture = Renderer(solids, [], Light(-1.5, 0.6, clouds=1.0)).render(view, 512, 1) @ LUMINANCE_WEIGHTS
    expected = centroid(view.project(solids[0].vertices))
    v, u = np.mgrid[: size[1], : size[0]]
    light = np.where(np.maximum(abs(u - x), abs(v - y)) < 20, picture, 0)
    found = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
    assert light.sum() > 50 * 1e4
    assert np.linalg.norm(found - expected) < 0.02


@pytest.mark.parametrize("azimuth", slow_after(2, [-2.6, 0.9, -0.4, 2.2]))
@pytest.mark.parametrize("elevation", [0.5, 1.1])
def test_shadows_fall_away_from_the_sun(azimuth: float, elevation: float) -> None:
    height = 1.5
    light = Light(azimuth, elevation, clouds=0.0)
    expected = -height / np.tan(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
    lens = camera(64, 64, 64.0, 31.5, 31.5)
    eye = np.array([*expected, 4.0])
    R = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # straight down, north up
    view = PosedCamera(lens, R, -R @ eye)
    still = [ground(), cube(np.array([0, 0, height]), 0.3)]
    picture = Renderer(still, [], light).render(view, 256, 3) @ LUMINANCE_WEIGHTS
    x, y = view.project(np.array([[0, 0, height]]))[0]
    v, u = np.mgrid[:64, :64]
    dark = (picture < 0.6 * np.median(picture)) & (np.hypot(u - x, v - y) > 12)  # not the cube itself
    assert 15 < dark.sum() < 120
    where = np.array([u[dark].mean(), v[dark].mean()])
    assert np.linalg.norm(where - view.project(np.array([[*expected, 0.0]]))[0]) < 0.6


@pytest.mark.parametrize("light", [DAY, Light(0.3, 0.4, clouds=0.5), Light(2.0, 1.2, clouds=1.0)])
def test_a_card_on_open_ground_returns_the_irradiance_that_is_stated(light: Light) -> None:
    R = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    view = PosedCamera(camera(16, 16, 40.0, 7.5, 7.5), R, -R @ np.array([0, 0, 3.0]))
    radiance = Renderer([ground(color=0.2)], [], light).render(view, 256, 5) @ LUMINANCE_WEIGHTS
    assert radiance.mean() == pytest.approx(0.2 * light.level_irradiance / np.pi, rel=0.03)


def corner_scene(variant: str) -> tuple[Renderer, PosedCamera]:
    paint = Material("paint", (0.4, 0.1, 0.05), roughness=0.1)
    metal = Material("metal", (0.5, 0.5, 0.5), roughness=0.3)
    rng = np.random.default_rng(3)
    texture = rng.uniform(0.05, 0.6, (8, 8, 3)).astype(np.float32)
    floor = ground(6.0)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    solids = [
        SceneMesh("floor", floor.vertices, floor.triangles, Material("matte", (0, 0, 0), texture), uv),
        SceneMesh("a", cube(np.array([0, 0, 0.5]), 1).vertices, cube(np.zeros(3), 1).triangles, paint),
        SceneMesh("b", cube(np.array([1, 1, 0.3]), 0.6).vertices, cube(np.zeros(3), 1).triangles, metal),
    ]
    view = looking(camera(48, 36, 60.0, 23.5, 17.5), np.array([3.0, -3.5, 2.0]), np.array([0.3, 0, 0.3]))
    return Renderer(solids, [[cube(np.zeros(3), 0.4)]], DAY, variant=variant), view


def test_variants_agree() -> None:
    """Means of pictures differ by no more than their noise, which pictures of other seeds tell."""
    if find_llvm() is None:
        pytest.skip("LLVM 19 is not installed: there is only one variant to render with")
    pictures = {}
    for variant in (FAST_VARIANT, PORTABLE_VARIANT):
        world, view = corner_scene(variant)
        world.place([(np.eye(3), np.array([0.5, -1.0, 0.9]))])
        pictures[variant] = np.array([world.render(view, 16, seed) @ LUMINANCE_WEIGHTS for seed in range(8)])
    a, b = pictures[FAST_VARIANT], pictures[PORTABLE_VARIANT]
    sigma = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / 8)
    z = (a.mean(0) - b.mean(0)) / np.maximum(sigma, 1e-4)
    assert abs(np.mean(z)) < 0.15  # neighbours share some of their rays: about 600 independent pixels
    assert np.mean(z**2) < 1.6  # of Student's t with 14 degrees of freedom it is 1.17
    assert a.mean() == pytest.approx(b.mean(), rel=0.01)


def test_the_same_seed_gives_the_same_picture() -> None:
    world, view = corner_scene(default_variant())
    world.place([(np.eye(3), np.array([0.5, -1.0, 0.9]))])
    first, again, other = (world.render(view, 4, seed) for seed in (7, 7, 8))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_picture_does_not_depend_on_those_before_it() -> None:
    """What is compiled is kept and replayed, for other places and windows as well."""
    places = [(np.eye(3), np.array([0.5, -1.0, h])) for h in (0.9, 1.4)]
    used, view = corner_scene(default_variant())
    for k, window in enumerate([(0, 0, 48, 36), (8, 6, 40, 30), (8, 6, 41, 33), (2, 2, 9, 9), (0, 0, 48, 36)]):
        used.place([places[k % 2]])
        used.render(view, 4, k, window)
    used.place([places[1]])
    fresh, _ = corner_scene(default_variant())
    fresh.place([places[1]])
    assert np.array_equal(used.render(view, 4, 9, (5, 3, 30, 20)), fresh.render(view, 4, 9, (5, 3, 30, 20)))


def test_samples_are_spread_evenly_over_the_lights() -> None:
    """Ground under sun and sky: each ray asks one of them, and 16 rays ask both as often as they should."""
    R = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    view = PosedCamera(camera(16, 16, 40.0, 7.5, 7.5), R, -R @ np.array([0, 0, 3.0]))
    picture = Renderer([ground(color=0.2)], [], DAY).render(view, 16, 5) @ LUMINANCE_WEIGHTS
    assert picture.std() < 0.06 * picture.mean()  # by chance alone it is about 0.13


def test_a_window_shows_what_the_whole_picture_shows() -> None:
    world, view = corner_scene(default_variant())
    world.place([(np.eye(3), np.array([0.5, -1.0, 0.9]))])
    whole, part = world.render(view, 256, 1), world.render(view, 256, 2, (8, 6, 40, 30))
    assert part.shape == (24, 32, 3)
    here, beside = (np.abs(whole[6:30, x : x + 32] - part).mean() for x in (8, 9))
    assert here < 0.5 * beside


def test_a_moved_placement_renders_like_an_original_one() -> None:
    R, t = cv2.Rodrigues(np.array([0.1, 0.2, 0.7]))[0], np.array([0.4, -0.3, 0.8])
    _, view = corner_scene(default_variant())
    moved = Renderer([ground()], [[cube(np.zeros(3), 0.8)]], DAY)
    moved.place([(np.eye(3), np.array([9.0, 9, 9]))])
    moved.place([(R, t)])
    stood = Renderer([ground(), cube(np.zeros(3), 0.8).transformed(R, t)], [], DAY)
    a, b = (w.render(view, 64, 3) for w in (moved, stood))
    assert np.abs(a - b).mean() < 0.02 * b.mean()


def test_distances_are_those_of_the_first_surface() -> None:
    world = Renderer([ground()], [[cube(np.zeros(3), 1.0)]], DAY)
    world.place([(np.eye(3), np.array([0, 0, 2.0]))])
    points = np.array([[0, 0, 0.0], [3, 0, 0.0], [0, 0, 9.0]])
    assert world.distance(np.array([0, 0, 4.0]), points) == pytest.approx([1.5, 5.0, np.inf], rel=1e-5)


def test_joining_keeps_every_triangle() -> None:
    a, b, c = cube(np.zeros(3), 1), cube(np.ones(3), 1), ground()
    together = merge_meshes([a, b, c])
    assert len(together) == 2
    corners = {s.name: s.vertices[s.triangles] for s in together}
    assert np.array_equal(corners["cube"], np.concatenate([s.vertices[s.triangles] for s in (a, b)]))


def test_a_library_that_is_no_llvm_19_is_not_used(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for wrong in ("/nonexistent/libLLVM.so.19.1", "libc.so.6"):
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", wrong)
        assert find_llvm.__wrapped__() is None
    monkeypatch.setattr(mitsuba_variant, "find_llvm", lambda: None)
    assert default_variant.__wrapped__() == PORTABLE_VARIANT
    notice = capsys.readouterr().err
    assert notice.startswith("note: LLVM 19 was not found") and notice.count("\n") == 1
