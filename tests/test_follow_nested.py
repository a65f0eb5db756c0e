"""A lock that has taken a line for the one beside it is put right; one that is right stays."""

from types import SimpleNamespace

import numpy as np
import pytest

from paceline.follow.nested import SLIGHT, Nested, moves_of
from paceline.targets.line_model import Target

BOX = np.array([[-1.0, -0.9], [1.0, -0.9], [1.0, 0.9], [-1.0, 0.9]])
RING = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
PLAIN = Target("box", 10.0, BOX, RING)
INNER = 0.1  # m from the outline to the frame inside
FRAMED = Target("framed", 10.0, np.vstack([BOX, BOX - INNER * np.sign(BOX)]), np.vstack([RING, RING + 4]))
IMAGE = np.zeros((4, 4), np.uint8)
HERE = np.array([120.0, 110.0, 1.2])
SIZE = 60.0  # px at scale 1


def test_the_moves_put_one_line_in_the_place_of_the_one_beside_it():
    """A lock with its left line on the outline and its right one on the frame: the move that mends it makes all lines
    lie where they are, to a thousandth of the size, and so for either side and axis."""
    moves = moves_of(FRAMED)
    x, width, size = 1.0, 2.0, 2.0
    for left, right, top, bottom in ((x, x - INNER, 0.9, 0.9 - INNER), (x - INNER, x, 0.9 - INNER, 0.9)):
        # where the lines of the lock lie in the picture of a target about (0, 0) of scale 1, and where that puts it
        factor, at = (left + right) / (2 * x), np.array([(right - left) / 2, (bottom - top) / 2])
        mended = [at + size * factor * np.array([dx, dy]) for dx, dy, _ in moves]
        off = [max(*np.abs(place) / size, abs(factor * m[2] - 1)) for place, m in zip(mended, moves, strict=True)]
        assert min(off) < 0.004
    assert len(moves) == 10 and INNER / width == pytest.approx(moves[0, 2] - 1)


def test_a_model_without_lines_side_by_side_has_no_moves_and_asks_nothing():
    assert moves_of(PLAIN).shape == (0, 3)
    nothing = SimpleNamespace()
    assert Nested(PLAIN).better(IMAGE, HERE, nothing) is None


class Matches:
    """Stands for a recogniser: every place fits where it is, with a match that `of` tells."""

    def __init__(self, of, hand=None):
        self._of, self.hand, self.asked = of, hand, 0
        self.projection = SimpleNamespace(size=lambda scale: SIZE * scale)

    def measured_at(self, image, location):
        self.asked += 1
        match = self._of(location)
        return None if match is None else (location, match)

    def put_by_hand(self, image, near):
        return self.hand


def told(matches, images=400):
    nested = Nested(FRAMED)
    for k in range(images):
        place = nested.better(IMAGE, HERE, matches)
        if place is not None:
            return k, place
    return images, None


def test_a_place_where_a_little_more_of_the_model_shows_is_told():
    rng, right = np.random.default_rng(0), moves_of(FRAMED)[6]
    there = np.array([*(HERE[:2] + SIZE * HERE[2] * right[:2]), HERE[2] * right[2]])
    matches = Matches(lambda place: rng.normal(0.34 if np.allclose(place, there) else 0.3, 0.02))
    k, place = told(matches)
    np.testing.assert_allclose(place, there)
    assert k < 100
    assert matches.asked <= 3 * (k + 1)  # here, the place that has done best and another


@pytest.mark.parametrize("seed", range(5))
def test_a_lock_stays_where_it_matches_better_or_nothing_fits_beside_it(seed):
    rng = np.random.default_rng(seed)
    assert told(Matches(lambda place: rng.normal(0.3 if place is HERE else 0.28, 0.02)))[1] is None
    assert told(Matches(lambda place: 0.3 if place is HERE else None))[1] is None


@pytest.mark.parametrize(
    "gain, hand, moves", [(0.1, "here", True), (0.03, "here", False), (0.03, "there", True), (0.03, "unseen", True)]
)
def test_the_farther_a_place_is_from_where_a_hand_has_put_the_target_the_more_it_has_to_gain(gain, hand, moves):
    """A tenth in scale, by lines that are found one beside on both sides, and some that never show."""
    rng, right = np.random.default_rng(0), moves_of(FRAMED)[4]
    there = np.array([*HERE[:2], HERE[2] * right[2]])
    assert abs(np.log(right[2])) > 0.09
    of = lambda place: rng.normal(0.4 + (SLIGHT + gain if np.allclose(place, there) else 0.0), 0.02)  # noqa: E731
    assert (told(Matches(of, {"here": HERE, "there": there}.get(hand)))[1] is not None) == moves


def test_while_a_part_of_the_target_is_hidden_another_place_proves_nothing():
    rng, images = np.random.default_rng(0), 0

    def match(place):
        nonlocal images
        images += place is HERE
        hidden = images > 20
        return rng.normal((0.33 if hidden else 0.55) if place is HERE else 0.42 if hidden else 0.5, 0.02)

    assert told(Matches(match), 300)[1] is None


@pytest.mark.parametrize("seed", range(20))
def test_a_place_that_matches_as_well_proves_nothing_by_chance(seed):
    rng = np.random.default_rng(seed)
    assert told(Matches(lambda place: rng.normal(0.3, 0.02)))[1] is None


def test_of_a_right_lock_the_other_places_are_asked_seldom_once_they_are_refuted():
    rng = np.random.default_rng(0)
    matches, nested = Matches(lambda place: rng.normal(0.5 if place is HERE else 0.4, 0.03)), Nested(FRAMED)
    asked = [0]
    for _ in range(2):
        for _ in range(200):
            nested.better(IMAGE, HERE, matches)
        asked.append(matches.asked)
    assert asked[2] - asked[1] < asked[1]


def test_a_lock_that_was_right_for_long_and_slips_is_put_right_soon():
    """Where other places were far behind they are not held against what is found there later."""
    rng, right, nested = np.random.default_rng(0), moves_of(FRAMED)[6], Nested(FRAMED)
    there = np.array([*(HERE[:2] + SIZE * HERE[2] * right[:2]), HERE[2] * right[2]])
    before = Matches(lambda place: rng.normal(0.5 if place is HERE else 0.2, 0.02))
    more = {True: 0.55, False: 0.2}
    after = Matches(lambda place: rng.normal(0.5 if place is HERE else more[np.allclose(place, there)], 0.02))
    assert all(nested.better(IMAGE, HERE, before) is None for _ in range(100))
    k = next(k for k in range(400) if nested.better(IMAGE, HERE, after) is not None)
    assert k < 80


def test_what_is_known_beside_one_lock_is_forgotten_for_another():
    nested, asked = Nested(FRAMED), Matches(lambda place: 0.5 if place is HERE else 0.55)
    while nested._steadiness().max() < 2.5:
        assert nested.better(IMAGE, HERE, asked) is None
    nested.forget()
    assert not nested._steadiness().any()
