"""Lens, shutter and sensor against what physics says of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from paceline.cameras import Camera, PosedCamera
from paceline.simulation.raytraced.light import Light
from paceline.simulation.raytraced.meshes import Material, SceneMesh
from paceline.simulation.raytraced.renderer import Placement, Renderer
from paceline.simulation.raytraced.sensor import (
    Lens,
    Sensor,
    Shutter,
    blur,
    distort_pixels,
    expose,
    render_exposure,
    vignette,
)


@pytest.mark.parametrize("level", [0.1, 0.5])
@pytest.mark.parametrize(("full_well", "read_noise"), [(1000.0, 10.0), (4000.0, 40.0)])
def test_noise_is_photons_and_readout(level: float, full_well: float, read_noise: float) -> None:
    sensor = Sensor(1.0, full_well, read_noise, vignetting=0.0, gamma=1.0)
    light = np.full((200, 200, 3), level * 2.0, np.float32)
    picture = expose(light, 2.0, sensor, np.random.default_rng(1)).astype(float)
    variance = (255 / full_well) ** 2 * (level * full_well + read_noise**2) + 1 / 12  # the last by rounding
    sigma = np.sqrt(variance / picture.size)
    assert picture.mean() == pytest.approx(255 * level, abs=5 * sigma)
    assert picture.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / picture.size))


def test_gamma_bends_the_scale_and_white_is_the_end() -> None:
    sensor = Sensor(1.0, 1e9, 0.0, vignetting=0.0, gamma=2.0, blur_sigma=0.0)
    light = np.broadcast_to(np.array([0.0, 0.25, 1.0, 7.0])[:, None, None], (4, 3, 3)).astype(np.float32)
    picture = expose(light, 1.0, sensor, np.random.default_rng(1))
    assert picture[:, 0].tolist() == [0, 128, 255, 255]


def test_color_comes_as_blue_green_red() -> None:
    sensor = Sensor(1.0, 1e9, 0.0, vignetting=0.0, gamma=1.0, color=True)
    light = np.broadcast_to(np.array([1.0, 0.4, 0.2]), (2, 2, 3)).astype(np.float32)
    assert expose(light, 1.0, sensor, np.random.default_rng(1))[0, 0].tolist() == [51, 102, 255]


@pytest.mark.parametrize("sigma", [0.3, 0.55, 1.3])
def test_a_point_is_blurred_by_exactly_the_stated_sigma(sigma: float) -> None:
    point = np.zeros((31, 31), np.float32)
    point[15, 15] = 1.0
    spread, x = blur(point, sigma).sum(0), np.arange(31) - 15
    assert spread.sum() == pytest.approx(1.0, rel=1e-5)
    assert (spread * x**2).sum() + 1 / 12 == pytest.approx(sigma**2, rel=1e-4)


def test_corners_lose_light_and_the_middle_none() -> None:
    share = vignette((41, 61), 0.3)
    assert share[20, 30] == 1.0
    assert share[[0, 0, -1, -1], [0, -1, 0, -1]] == pytest.approx(0.7)
    assert share[20, 0] == pytest.approx(1 - 0.3 * 61**2 / (61**2 + 41**2))


LENS = Camera((80, 60), np.array([[70.0, 0, 40.2], [0, 70, 28.9], [0, 0, 1]]), np.array([-0.2, 0.05, 0.001, -0.002]))


def test_distorting_is_the_reverse_of_undistorting() -> None:
    pixels = np.random.default_rng(1).uniform(5, 55, (50, 2))
    assert LENS.undistort_points(distort_pixels(LENS, pixels)) == pytest.approx(pixels, abs=1e-6)


def test_lens_distortion_moves_each_ray_to_its_distorted_pixel() -> None:
    """A picture whose grey is the ideal pixel's place shows, once bent, the ideal place of each recorded pixel."""
    lens = Lens.of(LENS)
    w, h = lens.pinhole.image_size
    x, y = np.meshgrid(np.arange(w) + lens.offset[0], np.arange(h) + lens.offset[1])
    bent = lens.distort(np.stack([x, y, 0 * x], -1).astype(np.float32))
    at = np.stack(np.meshgrid(np.arange(80), np.arange(60)), -1).astype(float)
    assert bent[..., :2] == pytest.approx(LENS.undistort_points(at), abs=0.05)


WIDTH, HEIGHT, SPEED, AWAY = 64, 48, 40.0, 10.0


@pytest.fixture(scope="module")
def bar() -> Renderer:
    """An upright black bar before a wall that shines."""
    v = np.array([[-0.5, 0, -9], [0.5, 0, -9], [0.5, 0, 9], [-0.5, 0, 9.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    wall = SceneMesh("wall", 9 * v * [9, 1, 1] + [0, 2 * AWAY, 0], triangles, Material("glow", (1e4, 1e4, 1e4)))
    solid = SceneMesh("bar", v, triangles, Material("matte", (0.0, 0.0, 0.0)))
    return Renderer([wall], [[solid]], Light(0.0, -0.3, clouds=0.0))


def seen(bar: Renderer, shutter: Shutter) -> np.ndarray:
    """The bar as it crosses at `SPEED` px/s, in the middle at time 2: the light that it takes."""
    camera = Camera((WIDTH, HEIGHT), np.array([[64.0, 0, 31.5], [0, 64, 23.5], [0, 0, 1]]))
    view = PosedCamera(camera, np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))

    def placements(t: float) -> list[Placement]:
        return [(np.eye(3), np.array([(t - 2.0) * SPEED * AWAY / 64, AWAY, 0.0]))]

    light = render_exposure(bar, placements, lambda t: view, 2.0, shutter, 16, 3).sum(-1)
    return np.asarray(3e4 - light)


def centers(light: np.ndarray) -> np.ndarray:
    return np.asarray((light * np.arange(WIDTH)).sum(1) / light.sum(1))


def test_a_rolling_shutter_leans_what_crosses(bar: Renderer) -> None:
    shutter = Shutter(readout=0.2, bands=6)
    found = centers(seen(bar, shutter))
    expected = 31.5 + SPEED * shutter.row_delay(np.arange(HEIGHT), HEIGHT)
    bound = SPEED * shutter.readout / (2 * shutter.bands)  # the error that is documented
    assert np.abs(found - expected).max() < bound + 0.1
    assert found[-1] - found[0] == pytest.approx(SPEED * 0.2 * 5 / 6, abs=0.2)


def test_an_open_shutter_smears_what_crosses(bar: Renderer) -> None:
    sharp, smeared = (seen(bar, s).sum(0) for s in (Shutter(), Shutter(exposure=0.2, steps=4)))
    x = np.arange(WIDTH)

    def variance(light: np.ndarray) -> float:
        mean = (light * x).sum() / light.sum()
        return float((light * (x - mean) ** 2).sum() / light.sum())

    assert smeared.sum() == pytest.approx(sharp.sum(), rel=0.03)
    steps = SPEED * 0.2 * ((np.arange(4) + 0.5) / 4 - 0.5)
    assert variance(smeared) - variance(sharp) == pytest.approx(np.var(steps), rel=0.1)


def test_wide_lenses_see_enough() -> None:
    wide = Lens.of(LENS)
    corners = np.array([[0, 0], [79, 0], [79, 59], [0, 59.0]])
    ideal = LENS.undistort_points(corners) - wide.offset
    assert (ideal > 1).all() and (ideal < np.array(wide.pinhole.image_size) - 2).all()
    assert cv2.norm(wide.pinhole.K[:2, :2], LENS.K[:2, :2]) == 0
