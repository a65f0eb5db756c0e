"""The pixel kernels against brute force in double precision, and how the likelihood behaves on a textured image."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numba
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import map_coordinates

from paceline.speed.filter import likelihood, patch_features_cpu
from paceline.speed.filter.likelihood import PART_DISTANCE_CAP, SAMPLES_PER_REGION, PartGrid
from paceline.speed.geometry.quadrilaterals_cpu import inward_edges, unit_square_to

PARTS = [4, 6, 8, 10, 12, 16]
QUAD = np.array([[120.3, 90.7], [231.9, 98.2], [226.4, 150.1], [118.6, 141.8]])
BOX = np.array([[120.0, 90.0], [220.0, 90.0], [220.0, 130.0], [120.0, 130.0]])
UNIT = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


def texture(seed=0, size=(240, 360), grain=3.0, contrast=35.0):
    """A smooth random picture of whole grey levels."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=size), (0, 0), grain)
    return np.rint(np.clip(120 + contrast * noise / noise.std(), 0, 255)).astype(np.float32)


def observe(left, right, quads_left, quads_right, grid, cross=None):
    cross = np.repeat(np.eye(3)[None], len(quads_left), axis=0) if cross is None else cross
    return likelihood.observe(likelihood.pack(left), likelihood.pack(right), quads_left, quads_right, cross, grid)


# --- the definitions, in double precision --------------------------------------------------------------------------


def haar_matrix():
    """The orthonormal two-level transform (16, 16) of a 4 × 4 square given row by row."""
    low, high = np.array([1, 1]) / np.sqrt(2), np.array([1, -1]) / np.sqrt(2)
    kinds = [(low, high), (high, low), (high, high)]  # (down, across): left-right, up-down, diagonal
    low4 = np.ones(4) / 2
    rows = [np.kron(low4, low4)]
    rows += [np.kron(np.kron(d, low), np.kron(a, low)) for d, a in kinds]
    for y in np.eye(2):
        for x in np.eye(2):
            rows += [np.kron(np.kron(y, d), np.kron(x, a)) for d, a in kinds]
    return np.array(rows)


def sample_places(grid):
    """The unit square's sample points: u (columns,), v (rows,)."""
    columns, rows = grid.across * 4 * grid.samples[0], grid.down * 4 * grid.samples[1]
    return (np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows


def mapped(H, u, v):
    U, V = np.meshgrid(u, v)
    p = np.einsum("ij,jyx->iyx", H, np.stack([U, V, np.ones_like(U)]))
    return p[:2] / p[2]


def read(image, places):
    x, y = places
    return map_coordinates(image.astype(float), [y, x], order=1, mode="nearest")


def to_quad(quad):
    return cv2.getPerspectiveTransform(UNIT, quad.astype(np.float32)).astype(float)


def expected_features(image, quad, grid):
    """Wavelet features (parts, 16) of bilinear block sums."""
    values = read(image, mapped(to_quad(quad), *sample_places(grid)))
    blocks = values.reshape(grid.down * 4, grid.samples[1], grid.across * 4, grid.samples[0]).sum((1, 3))
    parts = [
        haar_matrix() @ blocks[4 * y : 4 * y + 4, 4 * x : 4 * x + 4].ravel()
        for y in range(grid.down)
        for x in range(grid.across)
    ]
    return np.array(parts)


def raw_features(left, right, quads_left, quads_right, grid):
    """What the kernel itself writes, (N, 2, parts, 16)."""
    H = np.stack([[to_quad(a), to_quad(b), to_quad(a)] for a, b in zip(quads_left, quads_right, strict=True)])
    features = np.empty((len(H), 2, grid.parts, 16), np.float32)
    patch_features_cpu.observe(
        likelihood.pack(left),
        likelihood.pack(right),
        H.reshape(-1, 3, 9).astype(np.float32),
        inward_edges(quads_right).astype(np.float32),
        grid.across,
        grid.down,
        grid.samples,
        features,
        np.empty(len(H), np.float32),
    )
    return features


def expected_ncc(left, right, quad_left, quad_right, cross, grid):
    u, v = sample_places(grid)
    H, crossed = to_quad(quad_left), cross @ to_quad(quad_left)
    v = v[:: patch_features_cpu.CORRELATION_ROW_STEP]
    x, y = places = mapped(crossed, u, v)
    a, b, c = np.linalg.inv(to_quad(quad_right)) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    inside = ((a / c > 0) & (a / c < 1) & (b / c > 0) & (b / c < 1)).reshape(x.shape)
    if inside.mean() < 0.25:
        return -1.0
    return np.corrcoef(read(left, mapped(H, u, v))[inside], read(right, places)[inside])[0, 1]


# --- packing, homographies, grids ----------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(arrays(np.float32, st.tuples(st.integers(1, 7), st.integers(1, 9)), elements=st.floats(-20, 300, width=32)))
def test_packing_holds_every_neighbourhood_byte_by_byte(image):
    packed = likelihood.pack(image).words
    levels = np.pad(np.floor(np.clip(image.astype(float) + 0.5, 0, 255)), ((0, 1), (0, 1)), mode="edge").astype(int)
    assert packed.dtype == np.uint32 and packed.shape == image.shape
    for y, x in np.ndindex(image.shape):
        a, b, c, d = levels[y, x], levels[y, x + 1], levels[y + 1, x], levels[y + 1, x + 1]
        assert packed[y, x] == a + 256 * (b + 256 * (c + 256 * d))


WHERE = [(0, 0), (-100, 0), (130, 0), (0, -80), (0, 110), (-180, -130), (300, 10), (5000, 4000), (np.nan, np.nan)]


@pytest.mark.parametrize("where", WHERE)
def test_what_is_packed_for_some_regions_serves_them_as_the_whole_image_does(where):
    left, right = texture(1), texture(2)
    quads = QUAD + where + np.random.default_rng(3).normal(0, 3, (20, 4, 2))
    quads[7] = np.nan
    packed = likelihood.pack(left, quads)
    whole = likelihood.pack(left)
    height, width = packed.words.shape
    np.testing.assert_array_equal(packed.words, whole.words[packed.top :, packed.left :][:height, :width])
    assert packed.words.size < 0.4 * whole.words.size
    cross = shifts(np.full(20, 2.5), np.full(20, -1.5))
    grid = PartGrid.for_region(10, QUAD)
    with np.errstate(invalid="ignore"):
        a, b = (
            likelihood.observe(*views, quads, quads + 1.5, cross, grid)
            for views in ((packed, likelihood.pack(right, quads + 1.5)), (whole, likelihood.pack(right)))
        )
    np.testing.assert_array_equal(a.features, b.features)
    np.testing.assert_array_equal(a.ncc, b.ncc)


@given(arrays(float, (4, 2), elements=st.floats(-0.3, 0.3)), st.floats(5, 400), st.floats(-50, 900))
def test_unit_squares_map_as_in_opencv(wobble, size, where):
    quad = (where + size * (UNIT + wobble * 0.8)).astype(np.float32).astype(float)  # what OpenCV can take
    d = np.roll(quad, -1, axis=0) - quad
    turn = d[:, 0] * np.roll(d[:, 1], -1) - d[:, 1] * np.roll(d[:, 0], -1)
    assume((turn > 0.05 * size**2).all())  # convex
    H = unit_square_to(np.stack([quad, quad + 3.0]))
    exact = cv2.getPerspectiveTransform(UNIT, quad.astype(np.float32), solveMethod=cv2.DECOMP_SVD)
    np.testing.assert_allclose(H[0], exact, rtol=1e-5, atol=1e-5)
    for h, q in zip(H, (quad, quad + 3.0), strict=True):
        corners = np.column_stack([UNIT, np.ones(4)]) @ h.T
        np.testing.assert_allclose(corners[:, :2] / corners[:, 2:], q, rtol=1e-9, atol=1e-7)


@given(arrays(float, (4, 2), elements=st.floats(-0.3, 0.3)), st.tuples(st.floats(-1, 2), st.floats(-1, 2)))
def test_inward_edges_are_positive_inside(wobble, point):
    quad = (100 * (UNIT + 0.8 * wobble)).astype(np.float32)
    d = np.roll(quad, -1, axis=0) - quad
    assume((d[:, 0] * np.roll(d[:, 1], -1) - d[:, 1] * np.roll(d[:, 0], -1) > 500).all())
    x, y = 100 * np.array(point)
    side = cv2.pointPolygonTest(quad, (x, y), True)
    assume(abs(side) > 0.01)
    edges = inward_edges(quad[None])[0] @ [x, y, 1.0]
    assert (edges.min() > 0) == (side > 0)


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("shape", [(100, 100), (180, 65), (300, 70), (50, 120)])
def test_grids_divide_the_region_into_nearly_square_parts(parts, shape):
    width, height = shape
    grid = PartGrid.for_region(parts, np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
    assert grid.parts == grid.across * grid.down == parts
    shapes = {a: abs(np.log((width / a) / (height / (parts // a)))) for a in range(1, parts + 1) if parts % a == 0}
    assert shapes[grid.across] == pytest.approx(min(shapes.values()))
    assert min(grid.samples) >= 2
    assert 0.6 * SAMPLES_PER_REGION <= 16 * parts * grid.samples[0] * grid.samples[1] <= 1.6 * SAMPLES_PER_REGION


# --- features and correlation --------------------------------------------------------------------------------------


def test_the_wavelets_are_orthonormal():
    np.testing.assert_allclose(haar_matrix() @ haar_matrix().T, np.eye(16), atol=1e-12)
    rng = np.random.default_rng(2)
    blocks = rng.uniform(0, 4000, (8, 20)).astype(np.float32)
    features = np.empty((10, 16), np.float32)
    patch_features_cpu._wavelets(blocks, 5, features)
    for part in range(10):
        square = blocks[4 * (part // 5) :, 4 * (part % 5) :][:4, :4].astype(float)
        np.testing.assert_allclose(features[part], haar_matrix() @ square.ravel(), atol=0.01)
        assert np.linalg.norm(features[part]) == pytest.approx(np.linalg.norm(square), rel=1e-6)


@pytest.mark.parametrize("parts", PARTS)
def test_features_are_the_wavelets_of_bilinear_block_sums(parts):
    left, right = texture(1), texture(2)
    quads = np.stack([QUAD, QUAD * 1.05 - 9.3, QUAD @ [[0.99, 0.08], [-0.1, 1.02]], BOX * 0.3 + 40.4])
    grid = PartGrid.for_region(parts, QUAD)
    found = raw_features(left, right, quads, quads + [7.1, -3.6], grid)
    samples = grid.samples[0] * grid.samples[1]
    for i, quad in enumerate(quads):
        expected = [expected_features(left, quad, grid), expected_features(right, quad + [7.1, -3.6], grid)]
        # single precision places samples to a few ten-thousandths of a pixel
        np.testing.assert_allclose(found[i] / samples, np.array(expected) / samples, atol=0.02)


def test_samples_are_those_that_opencv_reads():
    image, grid, box = texture(3), PartGrid(1, 1, (10, 8)), BOX + [0.25, 0.5]
    x, y = (p.astype(np.float32) for p in mapped(to_quad(box), *sample_places(grid)))
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR)
    blocks = values.reshape(4, 8, 4, 10).sum((1, 3))
    found = raw_features(image, image, box[None], box[None], grid)
    np.testing.assert_allclose(found[0, 1, 0], haar_matrix() @ blocks.ravel(), rtol=1e-4, atol=5)


def test_observations_are_the_kernels_features_normalised():
    left, right = texture(1), texture(2)
    quads, grid = np.stack([QUAD, QUAD + 3.3]), PartGrid.for_region(10, QUAD)
    seen = observe(left, right, quads, quads - 1.2, grid)
    raw = raw_features(left, right, quads, quads - 1.2, grid)
    np.testing.assert_allclose(seen.features, likelihood.normalised(raw), atol=1e-3)


@given(st.integers(0, 2**32 - 1), st.floats(0.3, 3), st.floats(-500, 500))
def test_normalised_features_are_invariant_to_brightness_and_contrast(seed, gain, offset):
    f = np.random.default_rng(seed).normal(0, 300, (3, 2, 10, 16)).astype(np.float32)
    changed = f * np.float32(gain)
    changed[..., 0] += np.float32(offset)
    before, after = likelihood.normalised(f), likelihood.normalised(changed)
    np.testing.assert_allclose(before, after, atol=1e-4)
    norms = np.linalg.norm(before, axis=-1)
    assert (norms < 1).all() and norms.max() > 0.8


def test_parts_without_contrast_do_not_show_their_noise_enlarged():
    f = np.random.default_rng(3).normal(0, 300, (1, 10, 16)).astype(np.float32)
    f[0, 4] = np.random.default_rng(4).normal(0, 5, 16)
    norms = np.linalg.norm(likelihood.normalised(f), axis=-1)[0]
    assert norms[4] < 0.5 < np.delete(norms, 4).min()
    flat = np.zeros((1, 10, 16), np.float32)
    flat[..., 0] = 12345.67
    np.testing.assert_allclose(likelihood.normalised(flat), 0, atol=1e-2)


@pytest.mark.parametrize("shift", [0.0, 1.7, 25.0, 70.0, 95.0, 300.0])
def test_the_correlation_is_that_of_the_samples_within_both_regions(shift):
    left = texture(4)
    right = np.roll(left, 5, axis=1) * 0.8 + 12 + texture(5, contrast=6.0) - 120
    cross = np.array([[1.01, 0.004, 2.0], [-0.003, 0.99, 1.5], [1e-5, -2e-5, 1.0]])
    quad_right = QUAD + [5.0 + shift, -1.0]
    grid = PartGrid.for_region(10, QUAD)
    seen = observe(left, np.rint(right), QUAD[None], quad_right[None], grid, cross[None])
    expected = expected_ncc(left, np.clip(np.rint(right), 0, 255), QUAD, quad_right, cross, grid)
    assert seen.ncc[0] == pytest.approx(expected, abs=5e-3)
    assert (expected == -1) == (shift >= 95)


def test_a_view_correlates_with_itself_and_against_its_negative():
    image, grid = texture(6), PartGrid.for_region(10, QUAD)
    assert observe(image, image, QUAD[None], QUAD[None], grid).ncc[0] == pytest.approx(1, abs=1e-4)
    assert observe(image, 255 - image, QUAD[None], QUAD[None], grid).ncc[0] == pytest.approx(-1, abs=1e-3)


@pytest.mark.parametrize("level", [0, 77, 255])
def test_a_view_without_any_contrast_correlates_with_nothing(level):
    """A black or saturated view: not one, not minus one, and certainly nothing beyond them."""
    grid = PartGrid.for_region(10, QUAD)
    for seed in range(3):
        image = texture(seed)
        flat = np.full_like(image, level)
        assert abs(observe(image, flat, QUAD[None], QUAD[None], grid).ncc[0]) < 0.05


def test_one_thread_gives_the_result_of_two():
    rng = np.random.default_rng(1)
    quads = QUAD + rng.normal(0, 3, (101, 4, 2))
    grid = PartGrid.for_region(12, QUAD)
    before = numba.get_num_threads()
    try:
        found = []
        for threads in (1, min(2, before)):
            numba.set_num_threads(threads)
            found.append(observe(texture(1), texture(2), quads, quads + 1.5, grid))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(found[0].features, found[1].features)
    np.testing.assert_array_equal(found[0].ncc, found[1].ncc)


def test_the_features_of_a_particle_do_not_depend_on_the_others():
    quads = QUAD + np.random.default_rng(2).normal(0, 3, (70, 4, 2))
    grid = PartGrid.for_region(8, QUAD)
    together = observe(texture(1), texture(2), quads, quads + 1.5, grid)
    for i in (0, 33, 69):
        alone = observe(texture(1), texture(2), quads[i : i + 1], quads[i : i + 1] + 1.5, grid)
        np.testing.assert_allclose(together.features[i], alone.features[0], atol=1e-5)
        assert together.ncc[i] == pytest.approx(alone.ncc[0], abs=1e-5)


@pytest.mark.parametrize("margins", [(0, 0, 13, 7), (31, 17, 0, 0), (64, 5, 3, 50)])
def test_only_the_region_matters_not_the_images_size(margins):
    left, right = texture(7), texture(8)
    x, y, more_x, more_y = margins
    grid = PartGrid.for_region(10, QUAD)
    small = observe(left, right, QUAD[None], QUAD[None] + 2.0, grid)
    wide = [np.pad(image, ((y, more_y), (x, more_x)), constant_values=9) for image in (left, right)]
    shift = np.array([x, y], float)
    cross = np.eye(3)[None]
    large = observe(*wide, QUAD[None] + shift, QUAD[None] + 2.0 + shift, grid, cross)
    np.testing.assert_allclose(large.features, small.features, atol=2e-3)
    assert large.ncc[0] == pytest.approx(small.ncc[0], abs=2e-3)


def test_the_two_views_may_differ_in_size():
    left, right = texture(7), texture(8)[:200, :300]
    grid = PartGrid.for_region(10, QUAD)
    seen = observe(left, right, QUAD[None], QUAD[None] + 2.0, grid)
    whole = observe(left, texture(8), QUAD[None], QUAD[None] + 2.0, grid)
    np.testing.assert_allclose(seen.features, whole.features, atol=1e-5)
    assert seen.ncc[0] == pytest.approx(whole.ncc[0], abs=1e-5)


# --- outside and degenerate ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", [(-170, 0), (250, 0), (0, -120), (0, 190), (-170, -120), (5000, 3000), (-1e7, 1e7)])
def test_regions_beyond_the_border_see_its_pixels_repeated(where):
    image, grid = texture(9), PartGrid.for_region(10, QUAD)
    quad = QUAD + np.array(where, float)
    seen = observe(image, image, quad[None], quad[None], grid)
    assert np.isfinite(seen.features).all() and np.isfinite(seen.ncc).all()
    if max(np.abs(where)) > 300:
        # wholly outside, nothing but the corner's pixel is left, and single precision of it
        assert (np.abs(seen.features) < 0.2).all()
        return
    samples = grid.samples[0] * grid.samples[1]
    found = raw_features(image, image, quad[None], quad[None], grid)[0, 0]
    # the last row and column are read a thousandth of a pixel inside
    np.testing.assert_allclose(found / samples, expected_features(image, quad, grid) / samples, atol=0.1)


def test_impossible_regions_are_unlikely_and_have_no_effect():
    """Regions without area or with infinities happen to wild particles; memory must not be read at their places."""
    program = """if True:
        import numpy as np
        from paceline.speed.filter import likelihood
        image = np.random.default_rng(0).uniform(0, 255, (240, 360)).astype(np.float32)
        box = np.array([[120.0, 90.0], [220.0, 90.0], [220.0, 130.0], [120.0, 130.0]])
        wild = [box, 0 * box + 100, box[[0, 1, 1, 0]], 1e30 * box, 1e39 * box, np.nan * box, box + [np.inf, 0.0],
                box[[0, 2, 1, 3]], box[[0, 3, 2, 1]], box[[0, 2, 3, 1]]]
        quads = np.array(wild)
        packed, grid = likelihood.pack(image), likelihood.PartGrid.for_region(10, box)
        with np.errstate(all="ignore"):
            cross = np.repeat(np.eye(3)[None], len(quads), axis=0)
            seen = likelihood.observe(packed, packed, quads, quads, cross, grid)
            values = likelihood.log_likelihood(seen, seen.features[0], 15.0, 20.0)
        assert values[0] > -0.1, values
        assert (values[1:] < -60).all(), values  # NaN fails too
        """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:] or f"ended by signal {-done.returncode}"


def test_no_region_however_wild_is_read_outside_the_image():
    program = """if True:
        import numpy as np
        from paceline.speed.filter import likelihood
        rng = np.random.default_rng(0)
        image = rng.uniform(0, 255, (240, 360)).astype(np.float32)
        box = np.array([[120.0, 90.0], [220.0, 90.0], [220.0, 130.0], [120.0, 130.0]])
        grid = likelihood.PartGrid.for_region(10, box)
        np.seterr(all="ignore")
        for _ in range(10):
            wide, near = (box + rng.normal(0, 10 ** rng.uniform(0, k, (400, 1, 1)), (400, 4, 2)) for k in (8, 3))
            wide[:100] = 20 * np.round(wide[:100] / 20)  # corners that coincide or lie on one line
            cross = np.eye(3) + rng.normal(0, 10 ** rng.uniform(-4, 3, (400, 1, 1)), (400, 3, 3))
            for left, right in ((wide, near), (near, wide)):
                views = likelihood.pack(image, left[:3]), likelihood.pack(image, right[:3])
                likelihood.observe(*views, left, right, cross, grid)
        """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:] or f"ended by signal {-done.returncode}"


# --- the likelihood ------------------------------------------------------------------------------------------------


def profile(image, changes, parts=10, quad=QUAD, move_right=True):
    """log p of regions changed by the homographies ``changes`` (N, 3, 3) about the true one."""
    grid = PartGrid.for_region(parts, quad)
    reference = observe(image, image, quad[None], quad[None], grid).features[0]
    p = np.column_stack([quad, np.ones(4)])
    q = np.einsum("nij,kj->nki", changes, p)
    quads = q[..., :2] / q[..., 2:]
    still = np.repeat(quad[None], len(quads), axis=0)
    seen = observe(image, image, quads, quads if move_right else still, grid)
    return likelihood.log_likelihood(seen, reference, 15.0, 20.0)


def shifts(dx, dy):
    H = np.repeat(np.eye(3)[None], len(dx), axis=0)
    H[:, 0, 2], H[:, 1, 2] = dx, dy
    return H


def scalings(factors):
    centre = QUAD.mean(0)
    H = np.repeat(np.eye(3)[None], len(factors), axis=0)
    H[:, 0, 0] = H[:, 1, 1] = factors
    H[:, :2, 2] = centre * (1 - factors[:, None])
    return H


@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("parts", PARTS)
def test_the_likelihood_peaks_at_the_truth_and_falls_to_both_sides(seed, parts):
    image = texture(seed)
    steps = np.linspace(-3, 3, 25)
    for changes in (shifts(steps, 0 * steps), shifts(0 * steps, steps), scalings(1 + 0.02 * steps)):
        for both in (True, False):
            values = profile(image, changes, parts, move_right=both)
            assert values[12] == pytest.approx(0, abs=0.02)
            assert np.argmax(values) == 12
            assert (np.diff(values[:13]) > 0).all() and (np.diff(values[12:]) < 0).all()
            ratio = values[10] / values[14]  # half a pixel to either side
            assert 0.6 < ratio < 1 / 0.6


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 0.0), (1.0, 30.0), (1.3, -40.0), (0.5, 70.0)])
def test_gain_and_offset_of_a_view_do_not_matter(gain, offset):
    image, grid = texture(14, contrast=20.0), PartGrid.for_region(10, QUAD)
    reference = observe(image, image, QUAD[None], QUAD[None], grid).features[0]
    other = np.clip(gain * image + offset, 0, 255)
    assert ((other > 0) & (other < 255)).all()
    seen = observe(other, image, QUAD[None], QUAD[None], grid)
    assert seen.ncc[0] == pytest.approx(1, abs=2e-3)
    np.testing.assert_allclose(seen.features[0], reference, atol=0.02)
    assert likelihood.log_likelihood(seen, reference, 15.0, 20.0)[0] > -0.2


@given(st.integers(0, 2**32 - 1))
def test_the_log_likelihood_is_the_sum_of_its_three_terms(seed):
    rng = np.random.default_rng(seed)
    f, g = (rng.normal(0, 0.15, s).astype(np.float32) for s in ((5, 2, 10, 16), (2, 10, 16)))
    ncc = rng.uniform(-1, 1, 5).astype(np.float32)
    values = likelihood.log_likelihood(likelihood.Observation(f, ncc), g, 7.0, 3.0)
    for i in range(5):
        expected = -3.0 * (1.0 - ncc[i]) ** 2
        for view in (0, 1):
            for part in range(10):
                expected -= 7.0 * min(PART_DISTANCE_CAP, float(((f[i, view, part] - g[view, part]) ** 2).sum()))
        assert values[i] == pytest.approx(expected, rel=1e-4)


@given(st.integers(0, 2**32 - 1), st.integers(0, 9))
def test_one_part_of_the_features_counts_no_more_than_the_cap(seed, part):
    rng = np.random.default_rng(seed)
    reference = rng.normal(0, 0.25, (2, 10, 16)).astype(np.float32)
    f = reference[None] + rng.normal(0, 0.05, (1, 2, 10, 16)).astype(np.float32)
    worse = f.copy()
    worse[0, 0, part] = rng.normal(0, 3, 16)
    change = likelihood.distances(worse, reference) - likelihood.distances(f, reference)
    assert change[0, 0] <= PART_DISTANCE_CAP + 1e-5 and change[0, 1] == 0


def occluded(image, grid, part, paint, box=BOX):
    """``image`` with one part of the upright ``box`` painted over."""
    w, h = (box[2] - box[0]) / [grid.across, grid.down]
    x, y = box[0] + [part % grid.across * w, part // grid.across * h]
    other = image.copy()
    other[int(y) : int(y + h), int(x) : int(x + w)] = paint
    return other


@pytest.mark.parametrize("paint", [0, 120, 255])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_occluder_over_one_part_costs_little_more_than_the_cap(seed, paint):
    """Brightness and contrast are taken from all the parts together, so the others feel it a little."""
    image, grid = texture(seed, grain=4.0), PartGrid.for_region(10, BOX)
    reference = observe(image, image, BOX[None], BOX[None], grid).features[0]
    for part in range(10):
        other = occluded(image, grid, part, paint)
        cost = likelihood.distances(observe(other, image, BOX[None], BOX[None], grid).features, reference)[0]
        assert cost[0] <= 2.1 * PART_DISTANCE_CAP, part
        assert cost[1] < 1e-4


@pytest.mark.parametrize("paint", [0, 255])
def test_an_occluded_part_does_not_move_the_peak(paint):
    image, grid = texture(5, grain=4.0), PartGrid.for_region(10, BOX)
    reference = observe(image, image, BOX[None], BOX[None], grid).features[0]
    steps = np.linspace(-3, 3, 25)
    for part in (0, 4, 7):
        other = occluded(image, grid, part, paint)
        quads = BOX + np.column_stack([steps, 0 * steps])[:, None]
        seen = observe(other, image, quads, quads, grid)
        values = likelihood.log_likelihood(seen, reference, 15.0, 20.0)
        assert abs(steps[np.argmax(values)]) <= 0.25
