"""Edge extraction against an independent computation, its sub-pixel places, and the moving window."""

import cv2
import numpy as np
import pytest

from paceline.follow.configuration import FollowConfiguration
from paceline.follow.edges import SIZES, EdgeExtractor, window_around

PUBLISHED = FollowConfiguration.as_published()


def noisy_picture(seed=0, size=(120, 100)):
    rng = np.random.default_rng(seed)
    w, h = size
    image = rng.normal(100, 4, (h, w))
    image[30:70, 40:90] += 60
    image[45:55, 50:80] -= 40
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8), 0, 255).astype(np.uint8)


def plainly(image, window, threshold, degrees):
    """(3), (4), non-maximum suppression and threshold with OpenCV's derivative and loops."""
    gx = cv2.Sobel(image, cv2.CV_64F, 1, 0) / 4
    gy = cv2.Sobel(image, cv2.CV_64F, 0, 1) / 4
    magnitude = np.hypot(gx, gy)
    lists = ([], [])
    x0, y0, x1, y1 = window
    for y in range(max(y0, 2), min(y1, image.shape[0] - 2)):
        for x in range(max(x0, 2), min(x1, image.shape[1] - 2)):
            m = magnitude[y, x]
            if m < threshold:
                continue
            theta = (
                np.degrees(np.arctan2(gx[y, x], gy[y, x])) % 180
            )  # 90 for a vertical edge, (3) up to its quarter turn
            if abs(theta - 90) <= degrees:
                if magnitude[y, x - 1] < m and m >= magnitude[y, x + 1]:
                    lists[0].append((x, y, np.sign(gx[y, x]) * m))
            elif min(theta, 180 - theta) <= degrees and magnitude[y - 1, x] < m and m >= magnitude[y + 1, x]:
                lists[1].append((x, y, np.sign(gy[y, x]) * m))
    return [np.array(rows) for rows in lists]


def test_agrees_with_an_independent_computation():
    image = noisy_picture()
    window = (20, 10, 110, 90)
    found = EdgeExtractor((120, 100), PUBLISHED).extract(image, window)
    expected = plainly(image, window, 8.0, 15.0)
    for rows, wanted in zip(found, expected, strict=True):
        assert len(rows) > 40
        np.testing.assert_allclose(rows, wanted, atol=1e-3)


def test_nothing_outside_of_the_window_and_nothing_below_the_threshold():
    image = noisy_picture()
    window = (35, 25, 60, 60)
    found = EdgeExtractor((120, 100), FollowConfiguration(edge_threshold=20.0, subpixel=False)).extract(image, window)
    for rows in found:
        assert len(rows)
        assert rows[:, 0].min() >= 35 and rows[:, 0].max() < 60
        assert rows[:, 1].min() >= 25 and rows[:, 1].max() < 60
        assert np.abs(rows[:, 2]).min() >= 20.0


@pytest.mark.parametrize("place", [40.0, 40.25, 40.5, 40.8])
def test_edges_are_placed_between_pixels(place):
    x = np.arange(100)
    step = 60 + 100 / (1 + np.exp(-(x - place) / 0.7))  # a blurred step, steepest at its place
    image = np.tile(step, (80, 1)).round().astype(np.uint8)
    extractor = EdgeExtractor((100, 80), FollowConfiguration())
    rows = extractor.extract(image, (0, 0, 100, 80)).near_vertical
    assert rows[:, 0].mean() == pytest.approx(place, abs=0.06)
    assert np.all(rows[:, 2] > 0)
    turned = EdgeExtractor((80, 100), FollowConfiguration()).extract(
        np.ascontiguousarray(255 - image.T), (0, 0, 80, 100)
    )
    assert turned.near_horizontal[:, 1].mean() == pytest.approx(place, abs=0.06)
    assert np.all(turned.near_horizontal[:, 2] < 0)


def test_a_window_without_room_gives_no_edges():
    extractor = EdgeExtractor((120, 100), PUBLISHED)
    found = extractor.extract(noisy_picture(), (119, 99, 120, 100))
    assert len(found.near_vertical) == len(found.near_horizontal) == 0


def test_the_window_comes_in_seven_sizes_and_holds_what_it_must():
    sizes = set()
    for half in np.linspace(2, 130, 300):
        x0, y0, x1, y1 = window_around(np.array([400.0, 300.0]), np.array([half, half * 0.7]), (800, 600))
        assert x0 <= 400 - half + 1 and x1 >= 400 + half and y0 <= 300 - 0.7 * half + 1 and y1 >= 300 + 0.7 * half
        sizes.add((x1 - x0, y1 - y0))
    whole = window_around(np.array([10.0, 590.0]), np.array([500.0, 10.0]), (800, 600))
    assert whole == (0, 0, 800, 600)
    for half in np.linspace(130, 500, 100):
        x0, y0, x1, y1 = window_around(np.array([400.0, 300.0]), np.array([half, half * 0.7]), (800, 600))
        sizes.add((x1 - x0, y1 - y0))
    assert len(sizes) == SIZES == 7


def test_the_window_follows_its_target():
    a = window_around(np.array([300.0, 300.0]), np.array([20.0, 20.0]), (800, 600))
    b = window_around(np.array([340.0, 310.0]), np.array([20.0, 20.0]), (800, 600))
    assert np.subtract(b, a).tolist() == [40, 10, 40, 10]
