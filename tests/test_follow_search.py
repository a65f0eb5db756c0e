"""The search for the whole model: its loops against plain computations in NumPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import correlate

from paceline.cameras import Camera
from paceline.follow import measuring_cpu, search_cpu
from paceline.follow.appearance import Appearance
from paceline.follow.search import Search
from paceline.targets.line_model import Target

VERTICAL = np.array([True, True, False, False, False])
PLACES = np.array([-1.0, 1.0, -0.7, 0.1, 0.7])
SPANS = np.array([[-0.7, 0.7], [-0.7, 0.7], [-1.0, 1.0], [-0.5, 0.5], [-1.0, 1.0]])
SHIFTS = np.array([0.0, 0.3, -0.6, 0.0, 1.2])


def picture(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


@pytest.mark.parametrize("side", [1, 2, 3, 5])
def test_the_image_is_pooled_by_means_rounded_to_the_nearest(side):
    image, out = picture(47, 61), np.zeros((8, 11), np.uint8)
    search_cpu.pool(image, 4, 3, side, out)
    part = image[3 : 3 + 8 * side, 4 : 4 + 11 * side].astype(float)
    means = part.reshape(8, side, 11, side).mean((1, 3))
    np.testing.assert_array_equal(out, np.floor(means + 0.5))


def summed(image, soft=8.0):
    h, w = image.shape
    vertical, horizontal = np.full((h + 1, w), np.nan, np.float32), np.full((h, w + 1), np.nan, np.float32)
    search_cpu.evidence(image, soft, *np.zeros((2, 3, w), np.float32), vertical, horizontal)
    return vertical, horizontal


def plain_evidence(image, soft=8.0):
    kernel = np.array([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 4.0
    gx, gy = correlate(image.astype(float), kernel), correlate(image.astype(float), kernel.T)
    m = np.sqrt(gx**2 + gy**2 + 1e-6)
    found = [g * np.abs(g) / (m * (m + soft)) for g in (gx, gy)]
    for e in found:
        e[[0, -1]] = e[:, [0, -1]] = 0.0
    return found


@given(st.integers(5, 24), st.integers(5, 24), st.integers(0, 99))
def test_evidence_is_summed_down_the_columns_and_along_the_rows(height, width, seed):
    image = picture(height, width, seed)
    vertical, horizontal = summed(image)
    down, along = plain_evidence(image)
    np.testing.assert_allclose(vertical, np.pad(down.cumsum(0), ((1, 0), (0, 0))), atol=2e-5)
    np.testing.assert_allclose(horizontal, np.pad(along.cumsum(1), ((0, 0), (1, 0))), atol=2e-5)


def plain_responses(image, cx, cy, mx, my):
    """The mean evidence along each segment and half as much of the lines beside it."""
    h, w = image.shape
    out = []
    for upright, place, (begin, end), shift in zip(VERTICAL, PLACES, SPANS, SHIFTS, strict=True):
        found = plain_evidence(image)[0 if upright else 1]
        found = found if upright else found.T  # along a segment is down a column
        c, along, m, onward = (cx, cy, mx, my) if upright else (cy, cx, my, mx)
        column = int(np.floor(c + m * place + shift + 0.5))
        rows = [int(np.floor(along + onward * u + 0.5)) for u in (begin, end)]
        inside = 1 <= column < found.shape[1] - 1 and max(rows[0], 0) <= min(rows[1], found.shape[0] - 1)
        part = found[max(rows[0], 0) : rows[1] + 1, column - 1 : column + 2] if inside else np.zeros((0, 3))
        out.append((part @ [0.5, 1.0, 0.5]).sum() / (rows[1] - rows[0] + 1))
    return np.array(out)


@given(st.floats(-5, 50), st.floats(-5, 40), st.floats(4, 20), st.floats(4, 20))
def test_a_model_responds_by_the_mean_evidence_along_its_segments(cx, cy, mx, my):
    image, out = picture(34, 45), np.full(5, np.nan)
    search_cpu.responses(*summed(image), cx, cy, mx, my, VERTICAL, PLACES, SPANS, SHIFTS, out)
    np.testing.assert_allclose(out, plain_responses(image, cx, cy, mx, my), atol=2e-4)


def test_a_scan_finds_the_best_of_all_places_and_then_the_best_elsewhere():
    image = picture(60, 70)
    start, doubt, m = np.array([33.3, 28.7, 1.0]), np.array([4.0, 5.0, 0.1]), np.array([14.0, 13.0])
    scales, step, reach, modesty = np.array([0.9, 1.0, 1.1]), 1.5, np.array([4, 5]), 0.02
    signed, strength, weights = np.array([0.5, -0.4, 0.1, 0.3, -0.3]), np.full(5, 0.5), SPANS[:, 1] - SPANS[:, 0]
    best, found = np.zeros((2, 4)), np.empty(5)
    sums = summed(image)
    n = search_cpu.scan(
        *sums, start, start + 0.4, reach, step, scales, m, VERTICAL, PLACES, SPANS, SHIFTS,
        signed, strength, weights, doubt, modesty, np.zeros(3 * 9 * 11), best,
    )  # fmt: skip
    rated = []
    for k, scale in enumerate(scales):
        for j in range(-5, 6):
            for i in range(-4, 5):
                x, y = start[0] + i * step, start[1] + j * step
                search_cpu.responses(*sums, x, y, *(scale * m), VERTICAL, PLACES, SPANS, SHIFTS, found)
                off = (np.array([x, y, scale]) - start - 0.4) / doubt
                moved = off[0] ** 2 + off[1] ** 2
                loss = modesty * (off[2] ** 2 + moved / (1.0 + moved / 9.0))
                score = search_cpu.likeness(found, signed, strength, weights) - loss
                rated.append((score, i, j, k, (x, y, scale)))
    first = max(rated)
    second = max(r for r in rated if abs(r[1] - first[1]) > 3 or abs(r[2] - first[2]) > 3)
    assert n == 2
    for row, wanted in zip(best, (first, second), strict=True):
        np.testing.assert_allclose(row, [*wanted[4], wanted[0]], rtol=1e-12)


def test_how_well_features_agree_is_told_as_by_the_formulas():
    rng = np.random.default_rng(4)
    used = np.array([True, False, True, True, True])
    offsets, allowed, shares = rng.normal(0, 1, 5), rng.uniform(0.4, 1.0, 5), rng.uniform(0, 1, 5)
    offsets[~used] = np.nan
    lengths, shown = rng.uniform(10, 50, 5), np.array([1.0, 0.7, 1.0, 0.0, 1.0])
    residual, discord, match, support, agreeing = measuring_cpu.agreement(
        offsets, used, allowed, shares, lengths, shown
    )
    ratio = offsets[used] / allowed[used]
    assert residual == pytest.approx(np.sqrt((offsets[used] ** 2).mean()))
    assert discord == pytest.approx(np.sqrt((ratio**2).mean()))
    assert match == pytest.approx((shares[used] * np.exp(-0.5 * ratio**2)).sum() / 3.7)
    assert support == pytest.approx((lengths * shown)[agreeing].sum() / (lengths * shown).sum())
    np.testing.assert_array_equal(agreeing[used], np.abs(ratio) < 1.5)
    assert not agreeing[1]


@pytest.mark.parametrize("flat", [0.03, 0.3, 1.0])
@pytest.mark.parametrize("scale", [0.5, 7.0, 12.0])
def test_no_search_needs_more_than_its_scratch(monkeypatch, flat, scale):
    """Compiled code would write beyond it: a flat target, wider than the picture, whose place is doubtful."""
    scan, asked = search_cpu.scan, []

    def checked(vertical, horizontal, start, expected, steps, step, ladder, *rest):
        asked.append(len(ladder) * np.prod(2 * steps + 1) / len(rest[-2]))
        return scan(vertical, horizontal, start, expected, steps, step, ladder, *rest)

    monkeypatch.setattr(search_cpu, "scan", checked)
    corners = np.array([[-1.0, -0.75], [1.0, -0.75], [1.0, 0.75], [-1.0, 0.75]]) * [1.0, flat]
    target = Target("v", 10.0, corners, np.array([[0, 1], [1, 2], [2, 3], [3, 0]]))
    camera = Camera((256, 242), np.array([[200.0, 0, 127.5], [0, 200.0, 120.5], [0, 0, 1.0]]))
    search = Search(target, target.magnification(camera), camera.image_size, 4.0)
    image = np.random.default_rng(0).integers(0, 255, (242, 256)).astype(np.uint8)
    for doubt in (5.0, 120.0, 250.0):
        doubts = np.array([doubt, doubt, 0.01 * doubt * scale])
        search.find(image, np.array([128.0, 120.0, scale]), doubts, np.zeros(4), 0.0, Appearance(target), True)
    assert asked and max(asked) <= 1.0
