"""Feature places, their confidences, and the location that fits them, against plain computations."""

import numpy as np
import pytest

from paceline.follow import candidates, fitting

VERTICAL = np.array([True, True, False, False, False])
OFFSETS = np.array([-30.0, 30.0, -20.0, 5.0, 20.0])
TRUTH = np.array([150.0, 90.0, 1.2])


def ideal_places(x=TRUTH):
    return np.where(VERTICAL, x[0], x[1]) + x[2] * OFFSETS


def test_places_and_confidences_are_those_of_12_to_14():
    rng = np.random.default_rng(0)
    spread = [0.1, 1.0, 0.0]
    counts = [40, 60, 14]
    lengths = np.array([50.0, 50.0, 50.0])  # the third has 14 points, less than 0.3 of 50
    vertical = np.array([True, True, True])
    xs = [10 * (j + 1) + rng.normal(0, s, n) for j, (s, n) in enumerate(zip(spread, counts, strict=True))]
    points = np.column_stack([np.concatenate(xs), np.zeros(114), np.ones(114)]).astype(np.float32)
    owners = np.repeat([0, 1, 2], counts)
    places, weights = np.empty(3), np.empty(3)
    fitting.locate_features(points, owners, True, lengths, 0.3, 0.1, places, weights, vertical)
    np.testing.assert_allclose(places, [x.mean() for x in xs], atol=1e-4)
    assert weights[0] == pytest.approx(1 / np.sqrt(0.1))  # the cap of (14)
    assert weights[1] == pytest.approx(1 / xs[1].std(), rel=1e-4)
    assert weights[2] == 0.0
    lengths[2] = 46.0
    fitting.locate_features(points, owners, True, lengths, 0.3, 0.1, places, weights, vertical)
    assert weights[2] > 0.0


def test_the_location_is_the_weighted_least_squares_one_with_its_confidences():
    rng = np.random.default_rng(1)
    places, weights = ideal_places() + rng.normal(0, 1, 5), rng.uniform(0.5, 3, 5)
    A = np.column_stack([VERTICAL, ~VERTICAL, OFFSETS]).astype(float)
    x = np.linalg.lstsq(weights[:, None] * A, weights * places, rcond=None)[0]
    J = ((weights * (places - A @ x)) ** 2).sum()
    fit = fitting.locate(places, weights, VERTICAL, OFFSETS)
    np.testing.assert_allclose(fit.location, x, rtol=1e-9)
    assert fit.residual == pytest.approx(J, rel=1e-9)
    wx, wy = (weights[VERTICAL] ** 2).sum(), (weights[~VERTICAL] ** 2).sum()
    np.testing.assert_allclose(fit.weights, np.sqrt(np.array([wx, wy, wx + wy]) / J), rtol=1e-9)
    normal = np.linalg.inv(A.T @ np.diag(weights**2) @ A)
    np.testing.assert_allclose(fit.covariance, normal * max(1.0, J / 2) * (1 + fitting.UNCHECKED / 2), rtol=1e-8)


def test_features_without_confidence_take_no_part():
    places, weights = ideal_places(), np.ones(5)
    places[3], weights[3] = np.nan, 0.0
    fit = fitting.locate(places, weights, VERTICAL, OFFSETS)
    np.testing.assert_allclose(fit.location, TRUTH, atol=1e-9)
    assert fit.used.tolist() == [True, True, True, False, True]
    assert np.isnan(fit.offsets[3])


@pytest.mark.parametrize("seen", [[0, 1], [2, 3, 4], [0, 3], [0], []])
def test_too_few_features_determine_nothing(seen):
    weights = np.zeros(5)
    weights[seen] = 1.0
    assert fitting.locate(ideal_places(), weights, VERTICAL, OFFSETS) is None


def test_a_coordinate_that_no_line_tells_is_the_one_known_from_elsewhere_and_the_others_do_not_heed_that():
    """Level lines alone tell y and the size; with two upright ones the known centre has no say."""
    rng = np.random.default_rng(4)
    places, weights = ideal_places() + rng.normal(0, 0.3, 5), np.full(5, 2.0)
    center = np.array([[147.0, 3.0], [70.0, 2.0]])
    assert (fitting.locate(places, weights, VERTICAL, OFFSETS, center=center).location
            == fitting.locate(places, weights, VERTICAL, OFFSETS).location).all()  # fmt: skip
    fit = fitting.locate(places, np.where(VERTICAL, 0.0, weights), VERTICAL, OFFSETS, center=center)
    A = np.column_stack([np.ones(3), OFFSETS[~VERTICAL]])
    normal = np.linalg.inv(A.T @ A) / 4.0
    np.testing.assert_allclose(fit.location, [147.0, *np.linalg.lstsq(A, places[~VERTICAL], rcond=None)[0]], rtol=1e-9)
    inflation = fit.covariance[0, 0] / 9.0
    assert inflation >= 1.0 + fitting.UNCHECKED  # one feature to spare
    np.testing.assert_allclose(fit.covariance[1:, 1:], normal * inflation, rtol=1e-9)
    assert fit.weights[0] > 0.0 and not fit.used[VERTICAL].any()
    alone = np.array([0.0, 0.0, 2.0, 0.0, 0.0])  # a single line tells no size
    assert fitting.locate(places, alone, VERTICAL, OFFSETS, center=center) is None


def test_a_fit_and_a_place_from_elsewhere_are_weighed_by_their_covariances():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(3, 3))
    covariance, doubt = root @ root.T + 0.1 * np.eye(3), np.array([0.5, 1.5, 0.02])
    here, there = rng.normal(size=3), rng.normal(size=3)
    fit = fitting.Fit(here, covariance, np.ones(3), 0.0, np.zeros(5), np.ones(5, bool))
    both = fitting.combined(fit, there, doubt)
    information = np.linalg.inv(covariance) + np.diag(doubt**-2.0)
    np.testing.assert_allclose(both.covariance, np.linalg.inv(information), rtol=1e-7)
    mean = np.linalg.solve(information, np.linalg.solve(covariance, here) + there / doubt**2)
    np.testing.assert_allclose(both.location, mean, rtol=1e-6)


def test_what_a_place_errs_by_in_all_images_comes_to_the_covariance():
    """Against drawn errors of both; to five standard deviations of what a sample of so many tells."""
    rng, n = np.random.default_rng(4), 20_000
    root = rng.normal(size=(3, 3)) * [[0.5], [0.4], [0.03]]
    covariance, doubt, lasting = root @ root.T, np.array([0.4, 0.4, 0.02]), np.array([0.5, 0.3, 0.03])
    places = rng.normal(0, np.hypot(doubt, lasting), (n, 3))
    lines = rng.multivariate_normal(np.zeros(3), covariance, n)
    fits = [
        fitting.combined(fitting.Fit(x, covariance, np.ones(3), 0.0, np.zeros(5), []), place, doubt, lasting)
        for x, place in zip(lines, places, strict=True)
    ]
    stated = fits[0].covariance
    found = np.cov([f.location for f in fits], rowvar=False)
    spread = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    np.testing.assert_array_less(np.abs(found - stated) / spread, 5 * np.sqrt(2 / n))


def test_the_stated_covariance_is_that_of_the_errors():
    rng = np.random.default_rng(2)
    sigma = np.array([0.3, 0.5, 0.2, 0.4, 0.3])
    off, stated = [], []
    for _ in range(3000):
        fit = fitting.locate(ideal_places() + rng.normal(0, sigma), 1 / sigma, VERTICAL, OFFSETS)
        off.append(fit.location - TRUTH)
        stated.append(np.diag(fit.covariance))
    ratio = np.sqrt((np.array(off) ** 2).mean(0) / np.mean(stated, axis=0))
    assert np.all(ratio < 1.1)  # never less than the errors; a little more, for it is only ever enlarged
    assert np.all(ratio > 0.5)


def edge_points(places, rng, n=40, noise=0.2):
    """Near-vertical and near-horizontal points about ``places``, with their owners."""
    lists = []
    for upright in (True, False):
        chosen = np.flatnonzero(VERTICAL if upright else ~VERTICAL)
        across = np.concatenate([places[j] + rng.normal(0, noise, n) for j in chosen])
        rows = np.zeros((len(across), 3), np.float32)
        rows[:, 0 if upright else 1] = across
        lists.append((rows, np.repeat(chosen, n)))
    return lists


def robustly(lists, start, doubt, gate=8.0):
    lines = np.zeros((5, candidates.CANDIDATES, 3))
    expected = np.where(VERTICAL, start[0], start[1]) + start[2] * OFFSETS
    for (points, owners), upright in zip(lists, (True, False), strict=True):
        candidates.candidate_lines(points, owners, upright, expected, np.full(5, gate), 0.8, VERTICAL, lines)
    lengths = np.full(5, 50.0)
    places, weights = fitting.robust_lines(
        lines, start, doubt, VERTICAL, OFFSETS, lengths, 0.3, 0.1, np.full(5, 0.04), 0.8
    )
    return lines, fitting.locate(places, weights, VERTICAL, OFFSETS)


def test_a_stronger_line_beside_a_feature_does_not_move_the_model():
    rng = np.random.default_rng(3)
    lists = edge_points(ideal_places(), rng)
    pole = np.zeros((70, 3), np.float32)  # beside the left side, straight, strong and longer than it
    pole[:, 0] = ideal_places()[0] - 4.0
    rows, owners = lists[0]
    lists[0] = np.concatenate([rows, pole]), np.concatenate([owners, np.zeros(70, int)])
    start = TRUTH + [0.8, -0.6, 0.01]
    lines, fit = robustly(lists, start, np.array([1.0, 1.0, 0.02]))
    assert (lines[0, :, 1] > 0).sum() == 2
    assert np.all(np.abs(fit.location - TRUTH) < [0.15, 0.15, 0.01])

    places, weights = np.empty(5), np.empty(5)
    for (points, owner), upright in zip(lists, (True, False), strict=True):
        fitting.locate_features(points, owner, upright, np.full(5, 50.0), 0.3, 0.1, places, weights, VERTICAL)
    plain = fitting.locate(places, weights, VERTICAL, OFFSETS)
    assert abs(plain.location[0] - TRUTH[0]) > 0.15  # the mean of (12) is drawn to the pole


def test_candidates_are_the_places_where_points_crowd():
    rng = np.random.default_rng(4)
    rows = np.zeros((90, 3), np.float32)
    rows[:50, 0] = 100.3 + rng.normal(0, 0.1, 50)
    rows[50:, 0] = 104.1 + rng.normal(0, 0.1, 40)
    lines = np.zeros((1, candidates.CANDIDATES, 3))
    candidates.candidate_lines(
        rows, np.zeros(90, int), True, np.array([102.0]), np.array([6.0]), 0.8, np.array([True]), lines
    )
    assert lines[0, 0, 0] == pytest.approx(rows[:50, 0].mean(), abs=1e-3)
    assert lines[0, 1, 0] == pytest.approx(rows[50:, 0].mean(), abs=1e-3)
    assert lines[0, :, 1].tolist() == [50, 40, 0]


def test_a_fused_scale_gives_way_only_to_what_is_new_in_an_image():
    fit = fitting.locate(ideal_places(), np.full(5, 2.0), VERTICAL, OFFSETS)
    doubt = np.array([1, 1, np.sqrt(fitting.FRESH * fit.covariance[2, 2])])
    fused = fitting.fused(fit, np.array([0, 0, 1.3]), doubt)
    assert fused.location[2] == pytest.approx(1.25)
    np.testing.assert_array_equal(fused.covariance, fit.covariance)


def test_a_turned_target_is_not_taken_for_a_farther_one():
    narrower = 1 - np.cos(np.radians(10))
    places = ideal_places() - np.where(VERTICAL, narrower * TRUTH[2] * OFFSETS, 0.0)
    weights = np.full(5, 5.0)
    square = fitting.locate(places, weights, VERTICAL, OFFSETS)
    turned = fitting.locate(places, weights, VERTICAL, OFFSETS, TRUTH[2], fitting.TURNED)
    assert abs(turned.location[2] / TRUTH[2] - 1) < 0.6 * abs(square.location[2] / TRUTH[2] - 1)
    assert turned.covariance[2, 2] > fit_variance(weights)


def test_a_target_seen_squarely_is_hardly_taken_for_a_nearer_one():
    turned = fitting.locate(ideal_places(), np.full(5, 5.0), VERTICAL, OFFSETS, TRUTH[2], fitting.TURNED)
    assert 0.0 <= turned.location[2] / TRUTH[2] - 1.0 < 0.0008


def fit_variance(weights):
    return fitting.locate(ideal_places(), weights, VERTICAL, OFFSETS).covariance[2, 2]


def faint(image, brighter, length=40.0, reach=4.0):
    """What is found of one vertical feature expected at x = 30."""
    lines = np.zeros((1, candidates.CANDIDATES, 3))
    candidates.faint_lines(
        image,
        np.array([30.0]),
        np.array([[10.0, 10.0 + length]]),
        reach,
        np.array([True]),
        np.array([brighter]),
        0.3,
        4.0,
        lines,
    )
    return lines[0, 0]


def test_a_step_smaller_than_the_noise_is_found_in_the_mean_profile():
    rng = np.random.default_rng(5)
    off, missed, other = [], 0, 0
    for _ in range(200):
        image = 100 + rng.normal(0, 2.0, (60, 60))
        image[:, 32:] += 3.0  # the edge lies at x = 31.5
        image = np.clip(image.round(), 0, 255).astype(np.uint8)
        found = faint(image, 1)
        missed += found[1] == 0
        other += faint(image, -1)[1] > 0
        if found[1]:
            off.append(found[0] - 31.5)
    assert missed < 10 and other < 30
    assert np.sqrt(np.mean(np.square(off))) < 0.6


def test_edge_points_that_suffice_are_left_alone_and_the_border_is_kept():
    image = np.full((60, 60), 100, np.uint8)
    image[:, 32:] = 130
    lines = np.zeros((1, candidates.CANDIDATES, 3))
    lines[0, 0] = 29.0, 35, 0.1
    spans = np.array([[10.0, 50.0]])
    one = np.array([True]), np.array([1]), 0.3, 4.0
    candidates.faint_lines(image, np.array([30.0]), spans, 4.0, *one, lines)
    assert lines[0, 0].tolist() == [29.0, 35, 0.1]
    lines[:] = 0
    candidates.faint_lines(image, np.array([58.0]), spans, 4.0, *one, lines)
    candidates.faint_lines(image, np.array([30.0]), spans + 20, 4.0, *one, lines)
    assert not lines.any()
