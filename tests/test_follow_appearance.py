"""The target's pictures, of late and of long ago: what they tell of where it is."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.follow import picture_cpu
from paceline.follow.appearance import Appearance
from paceline.targets.line_model import Target

CORNERS = np.array([[-0.9, -0.7], [0.9, -0.7], [0.9, 0.7], [-0.9, 0.7]])
TARGET = Target("rear", 10.0, CORNERS, np.array([[0, 1], [1, 2], [2, 3], [3, 0]]))
M = np.array([30.0, 30.0])  # px per metre at scale 1
HERE = np.array([80.0, 60.0, 1.0])


def scene(seed=0):
    """(120, 160) a textured vehicle at `HERE` before a textured background."""
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.normal(110, 60, (120, 160)), (0, 0), 2.5)
    half = 0.5 * TARGET.size * M
    x0, y0, x1, y1 = np.round([*(HERE[:2] - half), *(HERE[:2] + half)]).astype(int)
    image[y0:y1, x0:x1] = cv2.GaussianBlur(rng.normal(90, 80, (y1 - y0, x1 - x0)), (0, 0), 2.0)
    return np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)


def learned(images, location=HERE):
    """The appearance after so many looks at ``location``."""
    appearance = Appearance(TARGET)
    for image in images:
        inside = appearance.look(image, location[:2], location[2] * M)
        appearance.learn(np.ones(4), 0.5, inside)
    return appearance


@pytest.mark.parametrize("slid", [(0.0, 0.0, 1.1), (0.0, 0.0, 0.92), (4.0, 0.0, 1.0), (2.5, -3.0, 1.07)])
def test_a_lock_that_slid_is_brought_back_by_the_picture_of_long_ago(slid):
    image = scene()
    appearance = learned([image] * 40)
    place = HERE * [1, 1, slid[2]] + [slid[0], slid[1], 0.0]
    for _ in range(60):  # the picture of late goes along
        appearance.learn(np.ones(4), 0.5, appearance.look(image, place[:2], place[2] * M))
    assert appearance.likeness() > 0.8
    back = appearance.went_from(image, place, M)
    assert back is not None
    assert np.all(np.abs(back - HERE) < [0.8, 0.8, 0.03])
    appearance.restore()
    appearance.look(image, place[:2], place[2] * M)
    assert appearance.likeness() < 0.9


def test_a_lock_in_its_place_has_not_slid():
    appearance = learned([scene()] * 40)
    for shift in (0.0, 0.5, -0.8):
        place = HERE + [shift, 0.0, 0.0]
        appearance.look(scene(), place[:2], place[2] * M)
        assert appearance.went_from(scene(), place, M) is None


def test_what_was_learned_from_few_pictures_or_is_not_there_tells_nothing():
    slid = HERE * [1, 1, 1.1]
    few = learned([scene()] * 20)
    few.look(scene(), slid[:2], slid[2] * M)
    assert few.went_from(scene(), slid, M) is None
    other = learned([scene()] * 40)
    other.look(scene(9), slid[:2], slid[2] * M)
    assert other.went_from(scene(9), slid, M) is None


def test_the_usual_match_follows_slowly():
    appearance = learned([scene()] * 5)
    assert appearance.match == pytest.approx(0.5)
    appearance.learn(np.ones(4), 0.1, 1.0)
    assert 0.48 < appearance.match < 0.5
    appearance.learn(np.ones(4), None, 1.0)
    assert 0.48 < appearance.match < 0.5
    for _ in range(100):
        appearance.learn(np.ones(4), 0.7, 1.0)
    assert 0.69 < appearance.match < 0.7


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 1.0), st.floats(0.0, 3.0), st.floats(-20.0, 20.0))
def test_likeness_is_the_mean_of_the_best_correlations_and_free_of_brightness_and_contrast(seed, share, gain, shift):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(100, 20, (2, 32, 40)).astype(np.float32)
    a = 0.5 * a + 0.5 * b
    scratch = np.zeros(20)
    found = picture_cpu.likeness(a, b, 8, 1.5, share, 0.5, scratch)
    cells = [(y, x) for y in range(0, 32, 8) for x in range(0, 40, 8)]
    rs = sorted(np.corrcoef(a[y : y + 8, x : x + 8].ravel(), b[y : y + 8, x : x + 8].ravel())[0, 1] for y, x in cells)
    assert found == pytest.approx(np.mean(rs[-max(1, round(share * 20)) :]), abs=2e-3)
    brighter = ((0.5 + gain) * a + shift).astype(np.float32)
    assert picture_cpu.likeness(brighter, b, 8, 1.5, share, 0.5, scratch) == pytest.approx(found, abs=5e-3)


def test_a_plain_picture_is_neither_like_nor_unlike():
    flat = np.full((32, 40), 80, np.float32)
    assert picture_cpu.likeness(flat, flat, 8, 1.5, 0.67, 0.5, np.zeros(20)) == 0.5
