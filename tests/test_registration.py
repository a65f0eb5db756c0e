"""Registration of rendered vehicles whose true place is known, and of pictures made worse on purpose."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from paceline.simulation.stereo.clip import Scene, Vehicle, World, render
from paceline.speed.filter import registration_cpu
from paceline.speed.filter.likelihood import PartGrid
from paceline.speed.filter.registration import PlaneGrid, register, rotation_about_y, sample

FRAMES = 4


class Clip:
    """A rendered approach from 40 m: pictures, exact sample points in every frame, and the texture in the first."""

    def __init__(self, seed, noise=0.0, road_direction=0.0, **vehicle):
        car = Vehicle("v0", 15.0, start_distance=40.0, texture_seed=seed, lateral=0.1 * seed, **vehicle)
        scene = Scene(
            seed,
            (car,),
            image_size=(640, 480),
            focal=1400.0,
            frames=FRAMES,
            noise_sigma=noise,
            road_direction=road_direction,
            road_depth=38.0 if road_direction else 0.0,
        )
        self.world = World(scene)
        self.rig = self.world.rig
        clip = render(scene)
        pairs = zip(clip.left, clip.right, strict=True)
        self.images = [(left.astype(np.float32), right.astype(np.float32)) for left, right in pairs]
        region = np.array(self.world.truth[0]["left"])
        self.grid = PlaneGrid(PartGrid.for_region(10, region), region)
        u, v, _ = self.grid.places
        flat = np.stack([(u - 0.5) * car.width, (v - 0.5) * car.height, 0 * u], axis=-1)
        self.poses = self.world.poses[0][0]
        self.points = [pose.centre + flat @ pose.axes.T for pose in self.poses]
        self.texture = sample(self.rig, self.images[0], self.points[0], self.grid).mean(0)

    def found(self, frame, offset, images=None, directions=None, views=(0, 1)):
        """Registration where the plane is expected ``offset`` (3,) metres from its true place."""
        directions = np.eye(3) if directions is None else directions
        images = images or self.images[frame]
        return register(self.rig, images, self.points[frame] + offset, self.texture, self.grid, directions, views)

    def pixel_error(self, frame, error):
        """What an ``error`` (3,) of place means in the two views, pixels (2, 2)."""
        centre = self.poses[frame].centre
        there, here = self.rig.project(centre + error), self.rig.project(centre)
        return np.array(there) - np.array(here)


@pytest.fixture(scope="module")
def clips():
    return [Clip(seed) for seed in range(3)]


@pytest.fixture(scope="module")
def noisy_clips():
    return [Clip(seed, noise=2.0) for seed in range(3, 6)]


def offsets(seed, n=4):
    """Places expected about half a pixel off in the pictures, and a third of a metre in depth."""
    return np.random.default_rng(seed).normal(0, 1, (n, 3)) * [0.015, 0.015, 0.3]


def normalised_squares(clips, prepare=lambda clip, frame: None):
    squares = []
    for k, clip in enumerate(clips):
        for frame in range(1, FRAMES):
            for offset in offsets([k, frame], 2):
                found = clip.found(frame, offset, prepare(clip, frame))
                error = found.shift + offset
                assert np.abs(clip.pixel_error(frame, error)).max() < 0.12
                assert found.similarity > 0.7
                squares.append(error @ np.linalg.solve(found.covariance, error))
    return np.array(squares)


# --- where the plane is --------------------------------------------------------------------------------------------


def test_a_plane_where_it_is_expected_is_found_there(clips):
    for clip in clips:
        found = clip.found(0, np.zeros(3))
        assert np.abs(clip.pixel_error(0, found.shift)).max() < 2e-3
        assert found.similarity > 0.999


def test_known_shifts_are_undone_within_the_stated_uncertainty(clips, noisy_clips):
    squares = normalised_squares(clips + noisy_clips)
    assert squares.max() < 30
    assert 0.7 < squares.mean() < 7  # three degrees of freedom


def test_the_start_does_not_matter(clips):
    clip = clips[0]
    shifts = [clip.found(2, offset).shift + offset for offset in offsets(9, 6)]
    stated = np.sqrt(np.diag(clip.found(2, np.zeros(3)).covariance))
    assert (np.ptp(shifts, axis=0) < 1.5 * stated).all()


def test_depth_is_known_worst_and_better_nearer_by(clips):
    far, near = (np.sqrt(np.diag(clips[1].found(k, np.zeros(3)).covariance)) for k in (0, FRAMES - 1))
    assert far[2] > 5 * far[:2].max()
    clip = Clip(1, width=0.9)
    assert clip.found(0, np.zeros(3)).covariance[2, 2] > far[2] ** 2  # half the picture


def test_shifts_are_looked_for_in_the_given_directions_only(clips):
    clip = clips[0]
    ray = (clip.poses[1].centre / np.linalg.norm(clip.poses[1].centre))[:, None]
    offset = 0.4 * ray[:, 0]
    found = clip.found(1, offset, directions=ray, views=(1,))
    assert np.linalg.norm(np.cross(found.shift, ray[:, 0])) < 1e-12
    error = (found.shift + offset) @ ray[:, 0]
    std = np.sqrt(np.trace(found.covariance))
    assert abs(error) < 5 * std < 0.2
    np.testing.assert_allclose(found.covariance, std**2 * ray @ ray.T, atol=1e-12)
    assert found.texture.shape == (1, *clip.texture.shape)


# --- pictures made worse -------------------------------------------------------------------------------------------


def test_gain_and_offset_of_each_view_do_not_matter(clips):
    def darker_left_brighter_right(clip, frame):
        left, right = clip.images[frame]
        return 0.6 * left + 5, 1.2 * right + 12

    squares = normalised_squares(clips, darker_left_brighter_right)
    assert squares.max() < 30 and squares.mean() < 7
    clip = clips[0]
    plain = clip.found(1, offsets(3, 1)[0])
    changed = clip.found(1, offsets(3, 1)[0], darker_left_brighter_right(clip, 1))
    assert np.abs(clip.pixel_error(1, changed.shift - plain.shift)).max() < 5e-3


@pytest.mark.parametrize("grey", [0.0, 128.0, 255.0])
@pytest.mark.parametrize("parts", [[7], [0, 5]])
def test_occluded_parts_do_not_draw_the_plane_away(clips, grey, parts):
    def occluded(clip, frame):
        images = tuple(image.copy() for image in clip.images[frame])
        for image, pixels in zip(images, clip.rig.project(clip.points[frame]), strict=True):
            for part in parts:
                hull = cv2.convexHull(np.round(pixels[part]).astype(np.int32))
                cv2.fillConvexPoly(image, hull, grey)
        return images

    squares = normalised_squares(clips, occluded)
    assert squares.max() < 40 and squares.mean() < 9
    for clip in clips:
        whole, partly = clip.found(1, np.zeros(3)), clip.found(1, np.zeros(3), occluded(clip, 1))
        assert partly.similarity < whole.similarity
        assert np.trace(partly.covariance) > np.trace(whole.covariance)


def test_another_picture_is_not_alike(clips):
    clip = clips[0]
    other = np.random.default_rng(0).normal(120, 40, clip.images[0][0].shape).astype(np.float32)
    assert clip.found(1, np.zeros(3), (other, other)).similarity < 0.4


@pytest.mark.parametrize("level", [0.0, 255.0])
def test_a_black_or_saturated_picture_is_not_alike(clips, level):
    flat = np.full_like(clips[0].images[0][0], level)
    assert clips[0].found(1, np.zeros(3), (flat, flat)).similarity < 0.1  # nor NaN, which compares as no less


def test_a_texture_without_contrast_determines_nothing(clips):
    clip = clips[0]
    flat = np.full_like(clip.texture, 90.0)
    with pytest.raises(np.linalg.LinAlgError):
        register(clip.rig, clip.images[1], clip.points[1], flat, clip.grid, np.eye(3))


@pytest.mark.parametrize("away", [[0.0, -7.0, 0.0], [10.0, 0.0, 0.0], [-9.0, 5.0, 0.0], [200.0, 100.0, 0.0]])
def test_planes_beyond_the_border_are_not_found_and_have_no_effect(clips, away):
    """A particle filter may expect a plane beside the image: that is unlike, never an error of the image library."""
    clip = clips[0]
    found = clip.found(1, np.array(away))
    assert found.similarity < 0.6


OUTLINE = np.array([[100.0, 100.0], [160.0, 100.0], [160.0, 130.0], [100.0, 130.0]])


# --- the grid of samples -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grid", [PartGrid(5, 2, (3, 5)), PartGrid(1, 4, (6, 7)), PartGrid(4, 4, (3, 3))])
def test_parts_of_the_grid_are_the_squares_of_the_region(grid):
    plane = PlaneGrid(grid, OUTLINE)
    u, v, one = plane.places
    samples = 16 * grid.samples[0] * grid.samples[1]
    assert u.shape == v.shape == (grid.parts, samples)
    assert (one == 1).all() and 0 < u.min() < 0.1 and 0 < v.min() < 0.1
    np.testing.assert_allclose([u.mean(), v.mean()], 0.5)
    for part in range(grid.parts):
        x, y = part % grid.across, part // grid.across
        # the parts share the region without its rim evenly
        assert int((u[part].mean() - u.min()) / (u.max() - u.min()) * grid.across) == x
        assert int((v[part].mean() - v.min()) / (v.max() - v.min()) * grid.down) == y
    whole = plane.as_grid(u)
    assert whole.shape == (4 * grid.down * grid.samples[1], 4 * grid.across * grid.samples[0])
    assert (np.diff(whole, axis=1) > 0).all() and (np.ptp(whole, axis=0) == 0).all()


@pytest.mark.parametrize("grid", [PartGrid(5, 2, (3, 5)), PartGrid(2, 3, (6, 7))])
def test_slopes_in_the_image_are_those_of_a_known_surface(grid):
    plane = PlaneGrid(grid, OUTLINE)
    u, v, _ = plane.places
    depth = 1 + 0.05 * u - 0.03 * v
    x, y = 60 * (u + 0.1 * v) / depth, 30 * (v - 0.05 * u) / depth  # the region, seen askew
    pixels = np.stack([x, y])
    du, dv = plane.image_gradient(3 * x - 2 * y, pixels)
    np.testing.assert_allclose(du, 3, atol=1e-9)
    np.testing.assert_allclose(dv, -2, atol=1e-9)
    inner = (u > u.min()) & (u < u.max()) & (v > v.min()) & (v < v.max())
    du, dv = plane.image_gradient(0.02 * x * x + 0.03 * x * y, pixels)[:, inner]
    np.testing.assert_allclose(du, (0.04 * x + 0.03 * y)[inner], atol=0.02)
    np.testing.assert_allclose(dv, 0.03 * x[inner], atol=0.02)


# --- the sums, beside the same in plain NumPy ----------------------------------------------------------------------

VIEWS, PARTS, SAMPLES_PER_REGION = 2, 6, 35


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("k", [1, 3])
def test_products_of_parts_are_those_of_the_sampled_picture(k, turns):
    rng = np.random.default_rng(k)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (60, 90)).astype(np.float32), (0, 0), 2.0)
    K = np.array([[800.0, 0, 40], [0, 900, 31], [0, 0, 1]])
    points = rng.uniform([-0.8, -0.6, 18], [0.8, 0.6, 22], (PARTS, SAMPLES_PER_REGION, 3))
    points[0, :9] *= [3, 3, 1]  # beyond the border, where its pixels repeat
    shift, directions = rng.normal(0, 0.05, 3), rng.normal(0, 1, (3, k))
    axis, pivot = rng.normal(0, 1, 3), np.array([0.1, -0.1, 20.0])
    k += turns
    slopes, texture = rng.normal(0, 9, (2, PARTS, SAMPLES_PER_REGION)), rng.normal(0, 30, (PARTS, SAMPLES_PER_REGION))
    texture -= texture.mean(1, keepdims=True)
    sampled, JJ, JT, JI = (np.empty((PARTS, *shape)) for shape in ((SAMPLES_PER_REGION,), (k, k), (k,), (k,)))
    TI, II = np.empty((2, PARTS))
    registration_cpu.part_products(
        image, K, np.ascontiguousarray(np.moveaxis(points, -1, 0)), shift, directions, axis, pivot, texture,
        slopes, sampled, JJ, JT, JI, TI, II,
    )  # fmt: skip
    P = points + shift
    x, y, _ = np.moveaxis(P @ K.T / P[..., 2:], -1, 0)
    expected = map_coordinates(image.astype(float), [y, x], order=1, mode="nearest")
    np.testing.assert_allclose(sampled, expected, atol=0.05)  # the border is read a thousandth of a pixel inside
    I = sampled - sampled.mean(1, keepdims=True)
    for p in range(PARTS):
        J = np.empty((SAMPLES_PER_REGION, k))
        for s, (X, Y, Z) in enumerate(P[p]):
            projection = np.array([[K[0, 0] / Z, 0, -K[0, 0] * X / Z**2], [0, K[1, 1] / Z, -K[1, 1] * Y / Z**2]])
            turning = np.cross(axis, points[p, s] - pivot)[:, None]
            J[s] = slopes[:, p, s] @ projection @ (np.hstack([directions, turning]) if turns else directions)
        J -= J.mean(0)
        for found, plain in ((JJ, J.T @ J), (JT, J.T @ texture[p]), (JI, J.T @ I[p])):
            np.testing.assert_allclose(found[p], plain, rtol=1e-10, atol=1e-7)
        np.testing.assert_allclose([TI[p], II[p]], [texture[p] @ I[p], I[p] @ I[p]], rtol=1e-10)


@pytest.mark.parametrize("contrast", [0.0, 0.01, 1.0, 40.0])  # of the picture beside the texture's
def test_normal_equations_are_those_of_weighted_least_squares_with_a_gain_for_each_view(contrast):
    """Without reweighting in between: rows √w·(J, T) of every view, the columns T one for each view."""
    rng, k = np.random.default_rng(1), 3
    T = rng.normal(0, 1, (PARTS, SAMPLES_PER_REGION))
    J = rng.normal(0, 5, (VIEWS, PARTS, SAMPLES_PER_REGION, k))
    I = contrast * (T + 0.3 * rng.normal(0, 1, (VIEWS, PARTS, SAMPLES_PER_REGION)))
    JJ, JT = np.einsum("vpsi,vpsj->vpij", J, J), np.einsum("vpsi,ps->vpi", J, T)
    JI, TT = np.einsum("vpsi,vps->vpi", J, I), (T * T).sum(1)
    TI, II = np.einsum("ps,vps->vp", T, I), (I * I).sum(2)
    before = rng.uniform(0.5, 2, (VIEWS, PARTS))
    w, normal, scores = before.copy(), np.empty((k, k)), np.empty((VIEWS, PARTS, k))
    registration_cpu.normal_equations(JJ, JT, JI, TT, TI, II, SAMPLES_PER_REGION, (0.2, 5.0), 0.1, w, normal, scores)
    gain = np.clip((before * TI).sum(1) / (before * TT).sum(1), 0.2, 5.0)
    r = I / gain[:, None, None] - T
    variance = (r * r).mean(2)
    np.testing.assert_allclose(w, 1 / (variance + 0.5 * np.median(variance, axis=1, keepdims=True) + 0.1), rtol=1e-8)
    root = np.sqrt(w)[..., None]
    gains = np.stack([root[v] * T * (u == v) for u in range(VIEWS) for v in range(VIEWS)])
    gains = gains.reshape(VIEWS, VIEWS * PARTS * SAMPLES_PER_REGION).T
    rows = (root[..., None] * J).reshape(-1, k)
    rows -= gains @ np.linalg.lstsq(gains, rows, rcond=None)[0]  # what a gain explains
    np.testing.assert_allclose(normal, rows.T @ rows, rtol=1e-7)
    np.testing.assert_allclose(scores.sum((0, 1)), rows.T @ (root * r).ravel(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("yaw", [-0.08, 0.05])
def test_a_turned_plane_is_found_where_it_is(yaw):
    """Seen obliquely it looks narrower or wider: without the yaw that is taken for another distance."""
    clip = Clip(1, noise=1.0, road_direction=0.5)
    points = clip.points[1]
    centre = points.reshape(-1, 3).mean(0)
    expected = (points - centre) @ rotation_about_y(yaw).T + centre
    turned, moved = (
        register(clip.rig, clip.images[1], expected, clip.texture, clip.grid, np.eye(3), with_yaw=with_yaw)
        for with_yaw in (True, False)
    )
    assert np.linalg.norm(turned.shift) < 0.5 * np.linalg.norm(moved.shift)
