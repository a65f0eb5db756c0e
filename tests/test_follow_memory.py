"""Which snapshots are taken of a target, and what is told by them; what they are is put by fakes."""

import numpy as np
import pytest

from paceline.cameras import Camera
from paceline.follow import memory
from paceline.follow.carrying import GROWN, UPRIGHT
from paceline.follow.features import Projection
from paceline.follow.fitting import Fit, combined
from paceline.follow.judgement import Foreseen
from paceline.follow.memory import Memory
from paceline.follow.snapshot import RIGHT, WITHIN
from paceline.targets.line_model import Target

CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
CAMERA = Camera((256, 242), np.array([[300.0, 0.0, 127.5], [0.0, 300.0, 120.5], [0.0, 0.0, 1.0]]))
PROJECTION = Projection(CAMERA, Target("box", 10.0, CORNERS, np.array([[0, 1], [1, 2], [2, 3], [3, 0]])))
REACH = np.array([20.0, 15.0])
IMAGES = [np.full((242, 256), k, np.uint8) for k in range(4)]
THERE = np.array([130.0, 118.0, 1.25])
SIZES = PROJECTION.sizes(THERE[2])
FORESEEN = Foreseen(THERE + [2.0, 0.0, 0.05], np.array([1.0, 1.0, 0.02]), 2.5)
FIT = Fit(THERE, np.diag([0.25, 0.5, 1e-4]), np.ones(3), 0.1, np.zeros(4), np.ones(4, bool))
LASTING = np.array([0.02, 0.02, 0.03])


class Carried:
    def __init__(self, image, projection, place, reach, upright=0.0, evened=False, grown=GROWN):
        self.image, self.place, self.reach = image, place, reach
        self.how = (upright, evened, grown)


class Snapshot:
    """Tells what it is told to, and writes down what it was asked."""

    def __init__(self, whole, own, inner, size, last=None):
        self.whole, self.own, self.inner, self.size, self.last = whole, own, inner, size, last
        self.old = self.confirmed = self.apart = False
        self.tells, self.lasting, self.asked = THERE, LASTING, []

    def find(self, image, expected, tau):
        self.asked.append(("find", image, expected, tau))
        return self.tells

    def compare(self, image, place, expected, tau, sure):
        self.asked.append(("compare", image, place, expected, tau, sure))
        return self.tells

    def as_put(self, image, near):
        return self.whole.place

    def is_old(self, scale):
        return self.old

    def is_apart(self, place, found):
        return self.apart


@pytest.fixture(autouse=True)
def fakes(monkeypatch):
    monkeypatch.setattr(memory, "Snapshot", Snapshot)
    monkeypatch.setattr(memory, "Carried", Carried)


def remembering(fit=FIT):
    one = Memory(PROJECTION, REACH)
    one.remember(IMAGES[0], fit, FORESEEN, clear=False, proven=False)
    return one, one._last


def test_the_first_snapshot_is_of_the_mean_of_what_is_seen_and_what_was_foreseen():
    _, first = remembering()
    place = combined(FIT, FORESEEN.location, FORESEEN.doubt).location
    assert (place > THERE)[[0, 2]].all() and (place < FORESEEN.location)[[0, 2]].all()
    for part in (first.whole, first.own, first.inner):
        assert part.image is IMAGES[0]
        np.testing.assert_allclose(part.place, place)


def test_of_what_parts_a_snapshot_is_made():
    _, first = remembering()
    assert first.whole.how == (UPRIGHT, True, GROWN)
    assert first.own.how == (0.0, True, GROWN)
    assert first.inner.how == (0.0, False, WITHIN)
    np.testing.assert_array_equal(first.whole.reach, REACH)
    for part in (first.own, first.inner):
        assert (part.reach < 0.02 * SIZES[:2]).all() and (part.reach > 0).all()
    assert first.size == PROJECTION.size(1.0)


@pytest.mark.parametrize(
    ("old", "clear", "confirmed", "proven", "taken"),
    [
        (True, True, False, True, True),
        (True, False, True, True, True),
        (True, False, False, True, False),
        (True, True, True, False, False),
        (False, True, True, True, False),
    ],
)
def test_another_snapshot_is_taken_of_another_size_that_shows_well(old, clear, confirmed, proven, taken):
    one, first = remembering()
    first.old, first.confirmed = old, confirmed
    one.remember(IMAGES[1], FIT, FORESEEN, clear, proven)
    assert (one._last is not first) == taken
    if taken:
        assert one._last.last is first  # what is known of it goes on
        assert one._last.whole.image is IMAGES[1]
        np.testing.assert_array_equal(one._last.whole.place, THERE)


def test_the_lock_that_a_hand_has_begun_renews_where_it_has_put_the_target_and_another_lock_does_not():
    one, first = remembering()
    first.old = True
    one.remember(IMAGES[1], FIT, FORESEEN, clear=True, proven=True)
    np.testing.assert_array_equal(one.as_put(IMAGES[2], THERE), THERE)
    other = one.afresh()
    assert other.told(IMAGES[2], None, FORESEEN, False) is None
    aside = THERE + [5.0, 0.0, 0.1]
    elsewhere = Fit(aside, FIT.covariance, FIT.weights, 0.1, FIT.offsets, FIT.used)
    other.remember(IMAGES[2], elsewhere, FORESEEN, clear=True, proven=True)
    other._last.old = True
    other.remember(IMAGES[3], elsewhere, FORESEEN, clear=True, proven=True)
    np.testing.assert_array_equal(other._last.whole.place, aside)
    np.testing.assert_array_equal(other.as_put(IMAGES[3], THERE), THERE)
    assert one._last.whole.image is IMAGES[1]  # what another one remembers is its own


def test_a_hand_says_where_the_target_was_in_an_image():
    one, _ = remembering()
    one.anchor(IMAGES[3], THERE)
    assert one._last.whole.image is IMAGES[3] and one._last.last is None
    np.testing.assert_array_equal(one.as_put(IMAGES[0], THERE), THERE)


def test_nothing_is_told_before_anything_was_seen():
    one = Memory(PROJECTION, REACH)
    assert one.told(IMAGES[0], FIT, FORESEEN, True) is None and one.as_put(IMAGES[0], THERE) is None


@pytest.mark.parametrize("apart", [False, True])
def test_what_is_told_is_where_to_within_what_and_whether_the_lock_agrees(apart):
    one, first = remembering()
    first.apart = apart
    told = one.told(IMAGES[1], FIT, FORESEEN, True)
    assert told.place is THERE and told.apart == apart
    np.testing.assert_allclose(told.doubt, RIGHT * SIZES)
    np.testing.assert_allclose(told.lasting, LASTING * SIZES)
    question, image, place, expected, tau, sure = first.asked.pop()
    assert (question, tau, sure) == ("compare", 2.5, True) and image is IMAGES[1]
    assert place is FIT.location and expected is FORESEEN.location


def test_a_target_that_the_lock_does_not_see_is_looked_for_where_it_was_foreseen():
    one, first = remembering()
    assert one.told(IMAGES[1], None, FORESEEN, False).apart
    assert first.asked == [("find", IMAGES[1], FORESEEN.location, 2.5)]
    first.tells = None
    assert one.told(IMAGES[1], None, FORESEEN, False) is None
    assert one.told(IMAGES[1], FIT, FORESEEN, False) is None
