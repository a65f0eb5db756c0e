"""A picture is found wherever it is in a wide view, at any size that is tried."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.follow.sweep import STEP, WORK, sweep

BOX = np.array([-1.1, -0.8, 1.1, 0.6])  # m: the centre is not in the middle
MAGNIFICATION = np.array([30.0, 30.0])  # px per metre at scale 1
PICTURE = cv2.GaussianBlur(np.random.default_rng(2).uniform(20, 220, (32, 40)).astype(np.float32), (0, 0), 1.5)


def view_of(center, scale, size=(160, 220), seed=0, brighter=1.0):
    """A view in which the picture lies about ``center`` (2,) px at ``scale``, before scenery of the same contrast."""
    rng = np.random.default_rng(seed)
    view = cv2.GaussianBlur(rng.uniform(20, 220, size).astype(np.float32), (0, 0), 3.0)
    x0, y0, x1, y1 = (BOX.reshape(2, 2) * MAGNIFICATION * scale + center).ravel()
    rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float32)
    u, v = (columns - x0) / (x1 - x0) * 40 - 0.5, (rows - y0) / (y1 - y0) * 32 - 0.5
    at = u.astype(np.float32), v.astype(np.float32)
    shown = cv2.remap(PICTURE, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (columns >= x0) & (columns <= x1) & (rows >= y0) & (rows <= y1)
    view[inside] = 30 + brighter * 0.6 * shown[inside]
    return np.clip(view + rng.normal(0, 2, size), 0, 255).astype(np.uint8)


@settings(deadline=None, max_examples=40)
@given(st.floats(60, 160), st.floats(50, 110), st.floats(0.85, 1.35), st.integers(0, 1000), st.floats(0.8, 1.2))
def test_the_picture_is_found_where_it_is_and_as_large_as_it_is(x, y, scale, seed, brighter):
    view = view_of(np.array([x, y]), scale, seed=seed, brighter=brighter)
    found = sweep(view, PICTURE, BOX, MAGNIFICATION, np.array([110.0, 80.0, 1.0]), 0.4, 3)
    off = np.abs(found[0] - [x, y, scale]) / [0.08 * 66 * scale, 0.08 * 66 * scale, 2.0 * STEP * scale]
    assert off.max() < 1.0


def test_places_are_apart_and_the_best_comes_first():
    view = view_of(np.array([60.0, 70.0]), 1.0, size=(140, 280))
    view[:, 140:] = view_of(np.array([60.0, 80.0]), 1.0, size=(140, 140), brighter=0.6)
    view[:, 140:] = np.clip(view[:, 140:] + np.random.default_rng(1).normal(0, 30, (140, 140)), 0, 255)
    found = sweep(view, PICTURE, BOX, MAGNIFICATION, np.array([140.0, 70.0, 1.0]), 0.15, 3)
    assert found[0, :2] == pytest.approx([60, 70], abs=3)
    assert found[1, :2] == pytest.approx([200, 80], abs=6)
    assert len(found) == 3
    for a in range(3):
        for b in range(a):
            assert (np.abs(found[a, :2] - found[b, :2]) > 0.25 * np.array([66, 42])).any()


def test_a_picture_larger_than_the_view_is_nowhere():
    view = view_of(np.array([60.0, 70.0]), 1.0)
    for rows, columns, scale in ((20, 30, 3.0), (7, 183, 6.0), (5, 5, 1.0)):
        found = sweep(view[:rows, :columns], PICTURE, BOX, MAGNIFICATION, np.array([9.0, 9.0, scale]), 0.2, 3)
        assert found.shape == (0, 3)


def test_in_a_large_view_only_the_part_about_the_place_is_looked_through(monkeypatch):
    view = view_of(np.array([700.0, 380.0]), 0.5, size=(800, 1100))
    sizes = []
    match = cv2.matchTemplate
    monkeypatch.setattr(cv2, "matchTemplate", lambda small, *others: sizes.append(small.size) or match(small, *others))
    found = sweep(view, PICTURE, BOX, MAGNIFICATION, np.array([640.0, 430.0, 0.52]), 0.5, 3)
    assert sum(sizes) < 1.05 * WORK
    assert found[0, :2] == pytest.approx([700, 380], abs=4)
