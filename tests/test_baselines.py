"""The mathematics of the baselines against independent computation."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares

from paceline.baselines import image_cues, kalman, optical_flow, polynomial_track, sift, triangulation_covariance
from paceline.baselines.disparity import Rectification
from paceline.baselines.rigid_alignment import align
from paceline.baselines.template_tracking import ScaledShift, TemplateTracker, shift_between
from paceline.cameras import Camera, StereoRig
from paceline.geometry import triangulate
from paceline.recordings.stereo import StereoFrame
from paceline.sift_features import match_descriptors
from paceline.speed.geometry.paths import jacobian

Array = NDArray[np.float64]
Image = NDArray[np.float32]

PLACES = st.tuples(st.floats(-6, 6), st.floats(-3, 3), st.floats(12, 80)).map(np.array)


@pytest.fixture(scope="module")
def texture() -> Image:
    """A picture with structure of many sizes."""
    rng = np.random.default_rng(3)
    octaves = [cv2.resize(rng.normal(0, s, (n, n)), (512, 512), interpolation=cv2.INTER_CUBIC) for n, s in OCTAVES]
    return np.clip(128 + 22 * sum(octaves), 0, 255).astype(np.float32)


OCTAVES = ((16, 1.0), (40, 1.0), (100, 0.8), (200, 0.5))


# --- triangulation ---------------------------------------------------------------------------------------------------


def test_triangulation_is_the_brute_force_optimum(rig: StereoRig) -> None:
    rng = np.random.default_rng(0)
    for _ in range(25):
        place = rng.uniform([-5, -2, 12], [5, 2, 80])
        seen = np.concatenate(rig.project(place)) + rng.normal(0, 1.0, 4)

        def miss(X: Array, seen: Array = seen) -> Array:
            return np.concatenate(rig.project(X)) - seen

        found = triangulate(rig, seen[:2], seen[2:])
        best = least_squares(miss, place, x_scale=[0.01, 0.01, 1.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert (miss(found) ** 2).sum() == pytest.approx(2 * best.cost, rel=1e-4, abs=1e-6)
        assert found == pytest.approx(best.x, rel=2e-4, abs=1e-4)


@given(place=PLACES)
def test_the_image_jacobian_is_that_of_finite_differences(rig: StereoRig, place: Array) -> None:
    by_hand = jacobian(lambda X: np.concatenate(rig.project(X)), place, 1e-4)
    assert triangulation_covariance.image_jacobian(rig, place) == pytest.approx(by_hand, rel=1e-5, abs=1e-5)


def test_the_covariance_is_that_of_triangulated_points(rig: StereoRig) -> None:
    rng, n, sigma = np.random.default_rng(1), 4000, 0.05
    place = np.array([1.5, -0.5, 40.0])
    left, right = (p + rng.normal(0, sigma, (n, 2)) for p in rig.project(place))
    off = triangulate(rig, left, right) - place
    whitened = off @ np.linalg.cholesky(triangulation_covariance.triangulation_information(rig, place, sigma))
    # eigenvalues of a sample covariance of n draws in three dimensions, five standard deviations
    assert np.linalg.eigvalsh(np.cov(whitened.T)) == pytest.approx(np.ones(3), abs=5 * np.sqrt(2 / n) + 3 * 3 / n)
    assert triangulation_covariance.triangulation_covariance(
        rig, place, sigma
    ) @ triangulation_covariance.triangulation_information(rig, place, sigma) == pytest.approx(np.eye(3), abs=1e-9)


# --- Kalman filter ---------------------------------------------------------------------------------------------------


def test_the_kalman_filter_is_batch_least_squares() -> None:
    rng = np.random.default_rng(2)
    steps, strength = rng.uniform(0.05, 0.6, 11), 0.7
    places = rng.normal(0, 1, (12, 3)) + np.linspace([0, 0, 60], [5, 1, 20], 12)
    noises = [(lambda A: A @ A.T + 0.1 * np.eye(3))(rng.normal(0, 1, (3, 3))) for _ in places]

    belief = kalman.initial_state(places[0], noises[0])
    for dt, place, noise in zip(steps, places[1:], noises[1:], strict=True):
        belief = kalman.update(kalman.predict(belief, dt, strength), place, noise)

    # all twelve states at once: every measurement, the first velocity and every step is a row
    rows, values, n = [], [], 6 * len(places)

    def add(columns: list[tuple[int, Array]], value: Array, covariance: Array) -> None:
        root, row = np.linalg.inv(np.linalg.cholesky(covariance)), np.zeros((len(value), n))
        for k, block in columns:
            row[:, 6 * k : 6 * k + 6] = block
        rows.append(root @ row)
        values.append(root @ value)

    for k, (place, noise) in enumerate(zip(places, noises, strict=True)):
        add([(k, np.eye(3, 6))], place, noise)
    add([(0, np.eye(6)[3:])], np.zeros(3), kalman.INITIAL_VELOCITY_STD_MPS**2 * np.eye(3))
    for k, dt in enumerate(steps):
        Q = strength * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        F = np.eye(6) + dt * np.eye(6, k=3)
        add([(k, -F), (k + 1, np.eye(6))], np.zeros(6), np.kron(Q, np.eye(3)))
    A, b = np.concatenate(rows), np.concatenate(values)
    batch = np.linalg.lstsq(A, b)[0]
    assert belief.mean == pytest.approx(batch[-6:], abs=1e-9, rel=1e-9)
    assert belief.covariance == pytest.approx(np.linalg.inv(A.T @ A)[-6:, -6:], abs=1e-9, rel=1e-7)


# --- smooth ways -----------------------------------------------------------------------------------------------------


@given(degree=st.integers(1, 4), seed=st.integers(0, 10**6))
def test_a_track_through_exact_positions_is_exact(degree: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.1, 0.3, 9))
    coefficients = np.concatenate([rng.uniform(5, 20, (1, 3)), rng.uniform(-1, 1, (degree - 1, 3))])
    u = times - times[0]
    places = sum(c * u[:, None] ** (m + 1) for m, c in enumerate(coefficients))
    way = polynomial_track.fit_polynomial(times, places, np.eye(24), degree)
    assert isinstance(places, np.ndarray)
    velocity = sum((m + 1) * c * u[:, None] ** m for m, c in enumerate(coefficients))
    assert way.velocities(times) == pytest.approx(velocity, rel=1e-6, abs=1e-6)
    fine = np.linspace(0, u[-1], 20001)[:, None]
    curve = sum(c * fine ** (m + 1) for m, c in enumerate(coefficients))
    length = np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
    assert way.mean_speed()[0] == pytest.approx(length / u[-1], rel=1e-4)


def test_the_uncertainty_of_a_track_is_that_of_its_scatter() -> None:
    rng, trials, z = np.random.default_rng(4), 400, []
    times = np.arange(10) * 0.2
    velocity = np.array([3.0, 0.5, -20.0])
    count = np.eye(9) + np.ones((9, 9))
    for _ in range(trials):
        noisy = times[:, None] * velocity + rng.normal(0, 0.2, (10, 3))
        way = polynomial_track.fit_polynomial(times, noisy, np.kron(count, np.eye(3)), 1)
        speed, std = way.mean_speed()
        z.append((speed - np.linalg.norm(velocity)) / std)
        assert way.speeds(times)[1] == pytest.approx(np.full(10, std))
    expected = way.dof / (way.dof - 2)  # the variance of Student's t
    assert np.mean(np.square(z)) == pytest.approx(expected, abs=5 * expected * np.sqrt(2.5 / trials))


def test_too_few_positions_give_no_track() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        polynomial_track.fit_polynomial(np.array([0.0, 0.2]), np.zeros((2, 3)), np.eye(3))


# --- alignment -------------------------------------------------------------------------------------------------------


def _body(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Positions (6, 3), rotations (6, 3, 3) and points (80, 6, 3) of a vehicle that comes nearer in a bend."""
    rotations = np.stack([cv2.Rodrigues(np.array([0.0, a, 0.0]))[0] for a in np.linspace(0, 0.2, 6)])
    positions = np.linspace([2.0, 0.5, 50.0], [0.5, 0.4, 30.0], 6)
    body = rng.uniform([-0.9, -0.35, -0.05], [0.9, 0.35, 0.05], (80, 3))
    return positions, rotations, positions + np.einsum("kij,pj->pki", rotations, body)


def test_exact_points_are_aligned_exactly() -> None:
    rng = np.random.default_rng(5)
    positions, rotations, points = _body(rng)
    seen = rng.random((80, 6)) < 0.6
    initial = positions + rng.normal(0, 0.3, (6, 3))
    initial[0] = positions[0]  # which point of the body is meant
    assert align(points, seen, rotations, initial).positions == pytest.approx(positions, abs=1e-6)


def test_alignment_estimates_its_scatter_and_is_robust_to_false_matches() -> None:
    rng, misfits, sigma = np.random.default_rng(6), [], 2e-5  # times the square of the depth
    positions, rotations, exact = _body(rng)
    for _ in range(40):
        points = exact + rng.normal(0, sigma, exact.shape) * exact[..., 2:] ** 2
        found = align(points, np.ones((80, 6), bool), rotations, positions)
        off = (found.positions - positions)[1:].ravel()
        misfits.append(float(off @ np.linalg.solve(found.covariance, off)))
    # chi-squared of 15 each; weighting down the larger half of the errors costs some efficiency, and is counted
    assert np.mean(misfits) == pytest.approx(15, abs=0.25 * 15 + 5 * np.sqrt(30 / 40))
    wrong = rng.random((80, 6)) < 0.1
    points[wrong] += rng.normal(0, 3, (int(wrong.sum()), 3))
    found = align(points, np.ones((80, 6), bool), rotations, positions)
    assert np.abs(found.positions - positions).max() < 5 * np.sqrt(found.covariance.diagonal().max())


def test_frames_without_common_points_are_not_aligned() -> None:
    positions, rotations, points = _body(np.random.default_rng(7))
    seen = np.ones((80, 6), bool)
    seen[:, 3] = False
    with pytest.raises(np.linalg.LinAlgError):
        align(points, seen, rotations, positions)


# --- regions and flow ------------------------------------------------------------------------------------------------


QUAD = np.array([[200.0, 220], [270, 220], [270, 250], [200, 250]])
DISPARITY = np.array([20.0, 0])


@pytest.fixture(scope="module")
def level() -> StereoRig:
    """Two equal cameras beside each other."""
    camera = Camera((512, 512), np.array([[900.0, 0, 256], [0, 900, 256], [0, 0, 1]]))
    return StereoRig(camera, camera, np.eye(3), np.array([-0.5, 0.0, 0.0]))


def _moved(image: Image, move: ScaledShift) -> Image:
    return np.asarray(cv2.warpAffine(image, move.matrix, (512, 512), flags=cv2.INTER_CUBIC), np.float32)


def _frame(left: Image, right: Image, time: float) -> StereoFrame:
    return StereoFrame(round(time / 0.2), time, left, right, 0.0, False)


def _regions(rig: StereoRig, texture: Image) -> TemplateTracker:
    """Of a vehicle at ``QUAD`` in the left view."""
    right = _moved(texture, ScaledShift(1.0, -DISPARITY))
    return TemplateTracker(rig, np.stack([QUAD, QUAD - DISPARITY]), _frame(texture, right, 0.0))


@pytest.mark.parametrize(("scale", "shift"), [(1.0, (0.0, 0.0)), (1.18, (-30.0, -18.0)), (0.84, (35.0, 28.0))])
def test_a_region_is_found_where_it_went(
    level: StereoRig, texture: Image, scale: float, shift: tuple[float, float]
) -> None:
    move, regions = ScaledShift(scale, np.array(shift)), _regions(level, texture)
    left, right = (_moved(image, move) for image in regions.images)
    found = regions.find(_frame(left, right, 0.2))
    assert found is not None
    for each, quad in zip(found, regions.quads, strict=True):
        assert each(quad) == pytest.approx(move(quad), abs=0.02 * 70)  # a step of the scales searched


@pytest.mark.parametrize("off", [(-15.0, 0.0), (12.0, 0.0), (0.0, 6.0)])
def test_views_that_show_different_things_do_not_count(
    level: StereoRig, texture: Image, off: tuple[float, float]
) -> None:
    """Too near, too far, and off the epipolar line."""
    regions = _regions(level, texture)
    right = _moved(regions.images[1], ScaledShift(1.0, np.array(off)))
    assert regions.find(_frame(texture, right, 0.2)) is None


def test_a_region_is_not_found_where_it_is_not(level: StereoRig, texture: Image) -> None:
    noise = np.random.default_rng(7).uniform(0, 255, (512, 512)).astype(np.float32)
    regions = _regions(level, texture)
    further = []
    for k in range(1, 5):
        assert regions.find(_frame(noise, noise, 0.2 * k)) is None
        further.append(regions.record_missed(0.2 * k))
    assert further == [True, True, True, False] and regions.status == "lost"


def test_a_region_that_drives_out_of_the_image_unseen_has_ended(rig: StereoRig, texture: Image) -> None:
    quad = np.array([[30.0, 220], [100, 220], [100, 250], [30, 250]])
    regions = TemplateTracker(rig, np.stack([quad, quad]), _frame(texture, texture, 0.0))
    regions.record_found(np.stack([quad - [20, 0]] * 2), _frame(texture, texture, 0.2))
    assert regions.status == "tracking"
    assert not regions.record_missed(0.4) and regions.status == "ended"


def test_a_region_without_texture_is_refused(rig: StereoRig) -> None:
    blank = np.full((512, 512), 90, np.float32)
    with pytest.raises(np.linalg.LinAlgError):
        TemplateTracker(rig, np.stack([QUAD, QUAD]), _frame(blank, blank, 0.0))


def test_the_move_between_quadrilaterals() -> None:
    quad = np.array([[10.0, 10], [60, 12], [58, 30], [9, 31]])
    move = ScaledShift(1.3, np.array([4.0, -7.0]))
    assert shift_between(quad, move(quad)).matrix == pytest.approx(move.matrix)


@pytest.mark.parametrize("exposure", [1.0, 0.8])
def test_points_are_tracked_to_a_fraction_of_a_pixel(texture: Image, exposure: float) -> None:
    quad = np.array([[200.0, 220], [290, 220], [290, 260], [200, 260]])
    points = optical_flow.detect_corners(texture, quad, np.empty((0, 2)))
    assert len(points) > 20
    true = ScaledShift(1.08, np.array([-12.4, -9.3]))
    after = np.asarray(cv2.warpAffine(texture, true.matrix, (512, 512), flags=cv2.INTER_CUBIC), np.float32)
    after = exposure * after + np.random.default_rng(8).normal(0, 1, after.shape).astype(np.float32)
    guess = ScaledShift(1.07, true.shift + 1.07 * quad.mean(0) * (1.08 / 1.07 - 1) + [0.8, -0.6])
    found, good = optical_flow.track_points(texture, after, points, guess, optical_flow.window_size(quad))
    assert good.mean() > 0.8
    off = np.linalg.norm(found - true(points), axis=1)[good]
    assert np.median(off) < 0.08
    across, good = optical_flow.match_points(texture, after, points, guess(points), optical_flow.window_size(quad))
    assert np.median(np.linalg.norm(across - true(points), axis=1)[good]) < 0.15  # at another scale


def test_new_corners_keep_clear_of_known_ones(texture: Image) -> None:
    quad = np.array([[200.0, 220], [290, 220], [290, 260], [200, 260]])
    some = optical_flow.detect_corners(texture, quad, np.empty((0, 2)))[::2]
    new = optical_flow.detect_corners(texture, quad, some)
    apart = np.linalg.norm(new[:, None] - some, axis=2)
    assert apart.min() >= optical_flow.MIN_CORNER_SPACING_PX - 1  # the mask is made of whole pixels


# --- depth -----------------------------------------------------------------------------------------------------------


def _turned(rig: StereoRig) -> StereoRig:
    """The same cameras, both rolled by a right angle: their baseline is upright."""
    roll = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    return StereoRig(rig.left, rig.right, roll @ rig.R @ roll.T, roll @ rig.t)


@pytest.mark.parametrize("upright", [False, True])
def test_the_depth_of_a_plane(rig: StereoRig, texture: Image, upright: bool) -> None:
    rig = _turned(rig) if upright else rig
    centre, normal = np.array([0.3, -0.2, 30.0]), np.array([0.25, -0.1, 1.0]) / np.linalg.norm([0.25, -0.1, 1.0])
    across = np.cross([0.0, 1, 0], normal)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(normal, across)], axis=1) * (5.0 / 512)  # metres per texel
    to_plane = np.column_stack([axes, centre - axes @ [256, 256]])  # texel to world
    images = []
    for camera, R, t in ((rig.left, np.eye(3), np.zeros(3)), (rig.right, rig.R, rig.t)):
        H = camera.K @ (R @ to_plane + np.outer(t, [0, 0, 1]))
        images.append(np.asarray(cv2.warpPerspective(texture, H, camera.image_size, flags=cv2.INTER_AREA), np.float32))
    rectified = Rectification(rig)
    assert rectified.rotation @ rectified.rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert rectified.rotation @ rig.R.T @ rig.t == pytest.approx([-rig.baseline, 0, 0], abs=1e-12)
    region = rectified.project(centre + 1.2 * np.array([[-1, -0.5, 0], [1, -0.5, 0], [1, 0.5, 0], [-1, 0.5, 0]]))
    found = rectified.depths((images[0], images[1]), region, 33.0)
    y, x = np.mgrid[: found.Z.shape[0], : found.Z.shape[1]]
    rays = rectified.rays(np.stack([x, y], axis=-1) + found.low)
    true = normal @ centre / (rays @ normal)
    known = np.isfinite(found.Z)
    assert known.mean() > 0.85
    off = rectified.fb * (1 / found.Z[known] - 1 / true[known])  # px of disparity
    assert np.median(np.abs(off)) < 0.25
    assert abs(np.median(off)) < 0.15


# --- cues ------------------------------------------------------------------------------------------------------------


def test_histograms_distinguish_boxes(texture: Image) -> None:
    here = np.array([[100.0, 100], [160, 100], [160, 130], [100, 130]])
    boxes = np.stack([here, here + 0.4, here + [150, 90]])
    seen = image_cues.histograms(image_cues.sample_nearest(texture, image_cues.sample_points(boxes)))
    assert seen.sum(1) == pytest.approx(np.ones(3))
    alike = image_cues.bhattacharyya(seen, seen[0])
    assert alike[0] == pytest.approx(1) and alike[0] > alike[1] > alike[2]


def test_outside_the_picture_nothing_is_known(texture: Image) -> None:
    box = np.array([[[-60.0, 100], [60, 100], [60, 130], [-60, 130]]])
    values = image_cues.sample_nearest(texture, image_cues.sample_points(box))
    mean, share = image_cues.mean_of_finite(values)
    assert share[0] == pytest.approx(0.5)
    assert mean[0] == pytest.approx(np.nanmean(values))
    assert image_cues.mean_of_finite(np.full((1, 4), np.nan)) == (pytest.approx([0.0]), pytest.approx([0.0]))


def test_edges_are_strongest_at_the_outline() -> None:
    picture = np.full((200, 200), 40, np.float32)
    picture[80:120, 60:140] = 200
    outline = np.array([[59.5, 79.5], [139.5, 79.5], [139.5, 119.5], [59.5, 119.5]])
    offsets = np.array([[0, 0], [3, 0], [0, 3], [-4, 2], [30, 30]])
    strengths = image_cues.edge_strengths(image_cues.image_gradients(picture), outline + offsets[:, None])
    assert strengths.argmax() == 0
    assert strengths[-1] < 0.5 * strengths[0]


# --- features --------------------------------------------------------------------------------------------------------


def test_matches_are_mutual_and_clear() -> None:
    rng = np.random.default_rng(9)
    a, b = (rng.normal(0, 1, (n, 128)).astype(np.float32) for n in (30, 40))
    b[:20] = a[:20] + 0.1 * rng.normal(0, 1, (20, 128)).astype(np.float32)
    b[20] = a[0]  # two that are alike: neither is clear
    b[0] = a[0]
    found = set(zip(*(rows.tolist() for rows in match_descriptors(a, b, 0.8)), strict=True))
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    expected = set()
    for i, row in enumerate(distance):
        order = np.argsort(row)
        if row[order[0]] < 0.8 * row[order[1]] and distance[:, order[0]].argmin() == i:
            expected.add((i, int(order[0])))
    assert found == expected and {(i, i) for i in range(1, 20)} <= found
    assert not any(i == 0 for i, _ in found)


def test_few_features_match_nothing() -> None:
    none, one = np.empty((0, 128), np.float32), np.ones((1, 128), np.float32)
    for a, b in ((none, one), (one, one)):
        assert [len(rows) for rows in match_descriptors(a, b, 0.8)] == [0, 0]


def test_features_stay_inside_their_region(texture: Image) -> None:
    quad = np.array([[200.0, 220], [290, 225], [285, 270], [205, 262]])
    places, descriptors = sift.features_inside(cv2.SIFT.create(), texture, quad)
    assert len(places) == len(descriptors) > 5
    inside = [cv2.pointPolygonTest(quad.astype(np.float32), tuple(map(float, p)), True) for p in places]
    assert min(inside) > -1.5  # the mask is made of whole pixels


def test_an_upright_rig_is_still_a_rig(rig: StereoRig) -> None:
    camera = Camera((64, 64), np.array([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]]))
    swapped = StereoRig(camera, camera, np.eye(3), np.array([0.5, 0.0, 0.0]))  # the right camera to the left
    for each in (rig, _turned(rig), swapped):
        assert np.linalg.det(Rectification(each).rotation) == pytest.approx(1)
