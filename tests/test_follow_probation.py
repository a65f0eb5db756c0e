"""The rules by which a start is believed, corrected or left in doubt, and a lock given up: with evidence that is known.

A place of the model is where it is seen and how well it matches, image by image; nothing is drawn or measured.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.follow.configuration import FollowConfiguration
from paceline.follow.fitting import Fit
from paceline.follow.lock import Lock
from paceline.follow.measuring import Measurement
from paceline.follow.probation import EVERY, SWITCHED, Probation
from paceline.follow.recognition import Look
from paceline.follow.start import (
    AMISS,
    BESIDE,
    CLEAR,
    CONVINCING,
    CORRECTED,
    DOUBT,
    DOUBTED,
    EARLY,
    FAR,
    FARTHER,
    FLOOR,
    MUCH,
    NOWHERE,
    SEVERAL,
    STRIKING,
    UNTOLD,
    Start,
    told,
)
from paceline.targets.line_model import Target

SIZE = 100.0  # px at scale 1
LINES = 8
START = np.array([200.0, 150.0, 1.0])
IMAGE = np.zeros((4, 4), np.uint8)


CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
RING = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
BOX = Target("box", 10.0, CORNERS, RING)
FRAMED = Target("framed", 10.0, np.vstack([CORNERS, 0.9 * CORNERS]), np.vstack([RING, RING + 4]))


class Places:
    """Stands for a recogniser that sees the model in known places: (x and y in sizes from the start, scale, match);
    a match may be a function of the image's number."""

    def __init__(self, *places, target=BOX):
        self.places = places
        self.image = 0
        self.projection = self
        self.target = target

    def size(self, scale):
        return SIZE * scale

    def sizes(self, scale):
        return scale * np.array([SIZE, SIZE, 1.0])

    def distance(self, scale):
        return 10 / scale

    def drop(self, location):
        return 0.0

    def afresh(self):
        return self

    def learn(self, look):
        pass

    def put_by_hand(self, image, near):
        return None

    def anchor(self, image, place):
        self.anchored = place

    def measured_at(self, image, location):
        look = self.look_at(image, location, None)
        return None if look.fit is None else (look.fit.location, look.measurement.match)

    def all(self):
        """Location and match of every place in this image."""
        for x, y, scale, match in self.places:
            yield START * [1, 1, scale] + [SIZE * x, SIZE * y, 0], match(self.image) if callable(match) else match

    def look(self, image, expected, doubt, tau, lost):
        return self.look_at(image, expected, doubt)

    def look_at(self, image, location, doubt):
        for place, match in self.all():
            if np.abs((place - location) / [SIZE, SIZE, 1.0]).max() < 0.03:
                return seen(place, match)
        return Look("nothing is there")

    def carry(self, image, location):
        return SimpleNamespace(place=location, first=location[2], step=lambda image: location)  # nothing moves

    def survey(self, image, location, reach, count):
        return [place for place, match in sorted(self.all(), key=lambda found: -found[1]) if match > 0]

    def patrol(self, image, location, reach, turn):
        elsewhere = [f for f in self.all() if np.abs((f[0] - location) / [SIZE, SIZE, 1.0]).max() > 0.08 and f[1] > 0]
        return max(elsewhere, key=lambda found: found[1], default=None)


def seen(place, match):
    used = np.ones(LINES, bool)
    fit = Fit(place, np.diag([0.01, 0.01, 1e-6]), np.ones(3), 0.1, np.zeros(LINES), used)
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    return Look("", fit=fit, measurement=Measurement(fit, *none, 0.1, 0.1, match, 1.0, used))


class Watch:
    """A probation fed with images, at 15 frames/s, as the tracker feeds it."""

    def __init__(self, *places, target=BOX):
        configuration = FollowConfiguration()
        self.places = Places(*places, target=target)
        self.probation = Probation(Lock(START, self.places, configuration), configuration)

    def see(self, images=1, hidden=False):
        """The complaint or else the note of each image."""
        said = []
        for _ in range(images):
            time = self.places.image / 15
            for lock in self.probation.locks:
                lock.predict(time)
            look = Look("hidden") if hidden else self.probation.lock.look(IMAGE, False)
            look, note = self.probation.judge(IMAGE, time, look)
            if not look.complaint:
                self.probation.lock.learn(look, time)
            said.append(look.complaint or note)
            self.places.image += 1
        return said

    @property
    def at(self):
        """Where the lock is: x, y in sizes from the start, and scale."""
        return (self.probation.lock.expected - START * [1, 1, 0]) / [SIZE, SIZE, 1.0]


def test_a_start_that_is_no_worse_than_any_other_place_is_believed_at_once():
    watch = Watch((0, 0, 1, 0.6), (0.3, 0, 1, 0.6), (0, 0.4, 0.7, 0.55))
    assert watch.see(10) == [""] * 10 and not watch.probation.pending
    np.testing.assert_allclose(watch.at, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(("better", "first"), [(0.09, ""), (0.11, DOUBT)])
def test_a_start_is_doubted_from_the_first_image_on_only_where_another_place_is_clearly_better(better, first):
    watch = Watch((0, 0, 1, 0.6), (0.12, 0, 1, 0.6 + better))
    assert watch.see(1) == [first] and watch.probation.pending == bool(first)


def test_a_place_hardly_beside_it_raises_no_doubt():
    watch = Watch((0, 0, 1, 0.5), (0.035, 0, 1, 0.7))
    assert watch.see(5) == [""] * 5
    np.testing.assert_allclose(watch.at, [0, 0, 1], atol=1e-6)


def test_a_clearly_better_place_is_told_however_near():
    watch = Watch((0, 0, 1, 0.5), (0.06, 0, 1, 0.7))
    assert watch.see(6) == [DOUBT] * EARLY + [CORRECTED, "", ""]
    np.testing.assert_allclose(watch.at, [0.06, 0, 1], atol=1e-6)


@pytest.mark.parametrize(("grown", "off", "there"), [(1.0, 0.05, False), (1.6, 0.05, True), (1.6, 0.1, False)])
def test_a_picture_that_has_grown_much_may_be_a_little_too_large(grown, off, there):
    start = Start(Lock(START, Places((0, 0, 1, 0.6)), FollowConfiguration()))
    start._places = [SimpleNamespace(place=START * [1, 1, grown], first=START[2])]
    assert start._is_there(0, seen(START * [1, 1, grown * np.exp(-off)], 0.6)) == there


def test_a_fit_that_goes_to_another_place_tells_nothing_of_its_own():
    """What is found from the operator's place lies nearer to the other one: it does not hold the doubt up."""
    watch = Watch((0.0, 0.0, 1, 0.3), (0.12, 0.0, 1, 0.6))
    look_at = watch.places.look_at
    watch.places.look_at = lambda image, location, doubt: look_at(
        image, START + [12.0, 0.0, 0.0] if watch.places.image else location, doubt
    )
    assert CORRECTED in watch.see(EARLY + 1)
    np.testing.assert_allclose(watch.at, [0.12, 0, 1], atol=1e-6)


def test_two_places_that_are_one_do_not_take_each_other_s_matches():
    """What is found from the operator's place is as near to another beside it; it counts for both, and a third one that
    matches better, but not by as much as it is farther off, is not believed."""
    watch = Watch((0.0, 0.0, 1, 0.36), (0.05, 0.0, 1, 0.36), (0.3, 0.0, 1, 0.52))
    look_at = watch.places.look_at

    def drawn(image, location, doubt):
        look = look_at(image, location, doubt)
        if look.fit is None or look.fit.location[0] > START[0] + 10.0 or not watch.places.image:
            return look
        return seen(START + [2.0 if watch.places.image % 2 else 3.0, 0.0, 0.0], look.measurement.match)

    watch.places.look_at = drawn
    assert CORRECTED not in watch.see(SEVERAL + 1) and not watch.probation.pending
    assert abs(watch.at[0]) < 0.05


def test_places_that_a_hand_reaches_are_followed_before_better_ones_that_it_hardly_does():
    far = [(0.3 * np.cos(a), 0.3 * np.sin(a), 1, 0.55) for a in np.arange(8) * np.pi / 4]
    watch = Watch((0, 0, 1, 0.2), *far, (0.1, 0.1, 1, lambda image: 0.5 if image < 1 else 0.8))
    assert CORRECTED in watch.see(EARLY + 1)
    np.testing.assert_allclose(watch.at, [0.1, 0.1, 1], atol=1e-6)


def test_a_much_better_place_is_doubted_first_and_soon_believed_with_a_note():
    watch = Watch((0, 0, 1, 0.2), (0.3, 0, 1, 0.8))
    assert watch.see(6) == [DOUBT] * EARLY + [CORRECTED, "", ""]
    np.testing.assert_allclose(watch.at, [0.3, 0, 1], atol=1e-6)


def test_a_place_that_is_better_by_less_than_hands_err_is_not_believed():
    """The farther off it is the better it has to match."""
    for away, right in ((0.12, True), (0.3, False)):
        watch = Watch((0, 0, 1, 0.34), (away, 0, 1, 0.48))
        assert (CORRECTED in watch.see(SEVERAL + 1)) == right and not watch.probation.pending
        np.testing.assert_allclose(watch.at, [away if right else 0, 0, 1], atol=1e-6)


def test_a_start_is_not_believed_either_where_something_far_off_matches_much_better():
    for more, doubted in ((-0.01, False), (0.01, True)):
        watch = Watch((0, 0, 1, 0.24), (0.4, 0, 1, 0.24 + AMISS + more))
        assert (watch.see(25)[-1] == DOUBT) == doubted
        np.testing.assert_allclose(watch.at, [0, 0, 1], atol=1e-6)


def test_what_a_target_looks_like_is_told_of_the_first_image_where_the_doubt_was_settled():
    for places in ([(0.02, 0, 1, lambda image: 0.25 if image else 0.0)], [(0, 0, 1, 0.2), (0.3, 0, 1, 0.8)]):
        watch = Watch(*places)
        watch.see(EARLY + 2)
        first = watch.probation.first
        assert not watch.probation.pending and watch.places.anchored is first


def test_where_two_places_match_alike_the_doubt_lasts_until_one_of_them_fades():
    watch = Watch((0, 0, 1, 0.2), (-0.3, 0, 1, 0.7), (0.3, 0, 1, lambda image: 0.7 if image < 15 else 0.3))
    assert watch.see(15) == [DOUBT] * 15 and watch.probation.pending
    said = watch.see(15)
    assert said[0] == DOUBT and CORRECTED in said and said[-1] == ""
    np.testing.assert_allclose(watch.at, [-0.3, 0, 1], atol=1e-6)


def test_a_doubt_that_lasts_is_given_up_for_good():
    watch = Watch((0, 0, 1, 0.2), (-0.3, 0, 1, 0.7), (0.3, 0, 1, lambda image: 0.7 if image < 40 else 0.3))
    inside = int(15 * DOUBTED) + 1
    assert watch.see(inside) == [DOUBT] * inside
    assert watch.see(60) == [UNTOLD] * 60 and watch.probation.locks == [watch.probation.lock]


def test_a_start_where_hardly_anything_matches_is_never_believed():
    watch = Watch((0, 0, 1, FLOOR - 0.01))
    assert watch.see(30) == [NOWHERE] * 30


def test_in_dim_light_a_start_is_believed_where_the_operator_put_it_and_nothing_fits_better():
    """Few of its edges show, but all lines are where the operator put them, and nothing else matches as well."""
    assert Watch((0, 0, 1, 0.25), (0.3, 0, 1, 0.2)).see(3) == [""] * 3
    watch = Watch((0, 0, 1, 0.25), (0.3, 0, 1, 0.35))
    assert watch.see(EARLY) == [DOUBT] * EARLY


def test_in_dim_light_a_start_that_shows_nothing_at_once_is_believed_when_it_goes_on_to_show_faintly():
    watch = Watch((0, 0, 1, lambda image: 0.25 if image else 0.0))
    assert watch.see(EARLY + 3) == [NOWHERE] * EARLY + [""] * 3


def test_what_is_measured_beside_the_place_that_was_carried_on_is_not_believed():
    assert {*Watch((0.045, 0, 1, 0.25)).see(31)} <= {DOUBT, NOWHERE}


@settings(deadline=None)
@given(st.integers(0, 2**16), st.integers(1, 12), st.integers(1, 6))
def test_the_place_told_is_the_one_that_is_worth_most(seed, images, count):
    """By the means, less what their distances cost, written out place by place."""
    rng = np.random.default_rng(seed)
    matches = rng.uniform(0, 1, count) + rng.normal(0, 0.05, (images, count))
    away = np.concatenate([[0.0], rng.uniform(BESIDE, 0.4, count - 1)])
    k = told(matches, away)
    if k is None:
        return
    means = [sum(column) / images for column in matches.T.tolist()]
    assert images >= EARLY and means[k] >= FLOOR
    farther = zip(means[1:], away[1:].tolist(), strict=True)
    cost = [0.0] + [min(CLEAR if m >= STRIKING else 1.0, MUCH + FARTHER * (d - BESIDE)) for m, d in farther]
    convincing = [m >= CONVINCING + FAR * max(d - BESIDE, 0.0) for m, d in zip(means, away.tolist(), strict=True)]
    others = [j for j in range(1, count) if convincing[j]]
    if k > 0:
        assert convincing[k] and all(means[k] - cost[k] > means[j] - cost[j] for j in others if j != k)
        assert means[k] - cost[k] > means[0]
    else:
        assert means[0] > max(means) - AMISS or max(means) < CONVINCING
        assert all(means[0] >= means[j] - cost[j] for j in others)


@pytest.mark.parametrize("far, match, told_there", [(0.1, 0.4, True), (0.45, 0.4, False), (0.45, 0.5, True)])
def test_the_farther_off_a_place_is_the_more_of_the_model_must_show_there(far, match, told_there):
    """Where the operator put it nothing shows; in the dark four tenths are somewhere by chance."""
    k = told(np.tile([0.0, match], (2 * SEVERAL, 1)), np.array([0.0, far]))
    assert (k == 1) == told_there and k != 0


@settings(max_examples=40, deadline=None)
@given(
    st.floats(0.7, 1.0),
    st.permutations([(-0.3, 0.0), (0.3, 0.3), (0.0, -0.3), (0.1, -0.2), (0.0, 0.0)]),
    st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4),
)
def test_whatever_else_there_is_a_place_that_matches_clearly_better_is_found(match, places, shares):
    others = [(*place, 1.0, share * (match - 0.35)) for place, share in zip(places[1:], shares, strict=True)]
    watch = Watch((*places[0], 1.0, match), *others)
    said = watch.see(SEVERAL + 1)
    assert said[-1] in ("", CORRECTED) and not watch.probation.pending
    np.testing.assert_allclose(watch.at, [*places[0], 1.0], atol=1e-6)


def test_a_lock_is_given_up_for_a_place_that_matches_better_in_several_images():
    watch = Watch((0, 0, 1, 0.5), (0.15, 0, 1, lambda image: 0.8 if image >= 30 else 0.0))
    said = watch.see(60)
    assert said.count(SWITCHED) == 1 and said.index(SWITCHED) > 31 and set(said) == {"", SWITCHED}
    np.testing.assert_allclose(watch.at, [0.15, 0, 1], atol=1e-6)


def test_a_lock_is_kept_where_another_place_is_hardly_better():
    watch = Watch((0, 0, 1, 0.5), (0.15, 0, 1, lambda image: 0.55 if image >= 5 else 0.0))
    assert watch.see(120) == [""] * 120
    np.testing.assert_allclose(watch.at, [0, 0, 1], atol=1e-6)


def test_a_lock_is_kept_where_another_place_is_better_in_single_images():
    watch = Watch((0, 0, 1, 0.5), (0.15, 0, 1, lambda image: 0.8 if image and image % EVERY == 0 else 0.3))
    followed = 0
    for _ in range(120):
        assert watch.see() == [""]
        followed = max(followed, len(watch.probation.locks))
    assert followed == 2  # it was tried
    np.testing.assert_allclose(watch.at, [0, 0, 1], atol=1e-6)


def test_what_is_farther_off_than_a_lock_slides_is_another_thing():
    watch = Watch((0, 0, 1, 0.5), (0, 0.1, 0.6, lambda image: 0.8 if image >= 10 else 0.0))
    assert watch.see(120) == [""] * 120
    np.testing.assert_allclose(watch.at, [0, 0, 1], atol=1e-6)


def test_while_the_target_is_hidden_what_stands_beside_it_does_not_take_over():
    """A trial has just begun when it is hidden; the other place matches as well as it did, and no better."""
    watch = Watch((0, 0, 1, 0.6), (0.15, 0, 1, lambda image: 0.8 if image == 2 * EVERY else 0.62))
    watch.see(2 * EVERY + 1)
    assert len(watch.probation.locks) == 2
    assert watch.see(20, hidden=True) == ["hidden"] * 20 and len(watch.probation.locks) == 1
    assert watch.see(5) == [""] * 5
    np.testing.assert_allclose(watch.at, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(("match", "given_up"), [(0.56, False), (0.7, True)])
@pytest.mark.parametrize("hand", [0.0, 0.18])
def test_a_lock_is_given_up_only_for_what_makes_up_for_being_farther_from_a_hand_s_place(match, given_up, hand):
    """What is 0.18 sizes farther off has to match by 0.09 more than what tells nothing; what is nearer by no more."""
    watch = Watch((0, 0, 1, 0.4), (0.18, 0, 1, lambda image: match if image >= 30 else 0.0))
    watch.places.put_by_hand = lambda image, near: START + [SIZE * hand, 0.0, 0.0]
    said = watch.see(60)
    assert (SWITCHED in said) == (given_up or hand > 0.0)


def test_what_is_nearer_to_where_a_hand_has_put_the_target_has_to_match_better_all_the_same():
    watch = Watch((0, 0, 1, 0.4), (0.18, 0, 1, lambda image: 0.0 if image < 30 else 0.45 if image % EVERY else 0.56))
    watch.places.put_by_hand = lambda image, near: START + [SIZE * 0.18, 0.0, 0.0]
    tried = 0
    for _ in range(60):
        assert SWITCHED not in watch.see()
        tried = max(tried, len(watch.probation.locks))
    assert tried == 2


@pytest.mark.parametrize("lines_off", [0.15, 0.0, -0.08])
def test_how_far_off_a_place_is_counts_from_where_the_target_is_believed_to_be(lines_off):
    """Not from where its lines alone would have it: in dim light single fits of them lie anywhere about."""
    for away in (0.15, 0.3):
        watch = Watch((0, 0, 1, 0.4), (away, 0, 1, lambda image: 0.8 if image >= 30 else 0.0))
        look = watch.places.look

        def drawn(*args, look=look):
            believed = look(*args)
            m = believed.measurement
            return replace(believed, measurement=replace(m, fit=seen(START + [SIZE * lines_off, 0, 0], m.match).fit))

        watch.places.look = drawn
        watch.see(30 + 2 * EVERY)
        assert (len(watch.probation.locks) == 2 or abs(watch.at[0]) > 0.1) == (away == 0.15)


def test_a_lock_that_is_a_line_off_goes_where_a_little_more_of_the_model_shows():
    """By less than a rival has to be ahead; only models with lines side by side have such a place."""
    places = (0, 0, 1, 0.5), (0.025, 0.025, 0.95, lambda image: 0.54 if image >= 8 else 0.0)
    watch = Watch(*places, target=FRAMED)
    said = watch.see(120)
    assert said.count(SWITCHED) == 1 and set(said) == {"", SWITCHED}
    np.testing.assert_allclose(watch.at, [0.025, 0.025, 0.95], atol=1e-6)
    assert set(Watch(*places).see(120)) == {""}


@pytest.mark.parametrize("what", ["nothing", "found again", "slid back"])
def test_what_is_known_of_the_places_beside_a_lock_is_of_that_lock_alone(what):
    """Where the target was lost and found again, or the lock had slid, it is another one that has to prove itself."""
    places = (0, 0, 1, 0.5), (0.025, 0.025, 0.95, lambda image: 0.54 if image >= 8 else 0.0)
    when = Watch(*places, target=FRAMED).see(120).index(SWITCHED)
    watch = Watch(*places, target=FRAMED)
    watch.see(when - 1)
    look = watch.places.look
    if what == "found again":
        watch.probation.resume()
    elif what == "slid back":
        watch.places.look = lambda *args: replace(look(*args), slid=True)
    watch.see()
    watch.places.look = look
    assert (SWITCHED in watch.see(3)) == (what == "nothing")
    assert watch.see(when).count(SWITCHED) == (what != "nothing")


def test_without_probation_nothing_is_doubted():
    configuration = FollowConfiguration(probation=False)
    lock = Lock(START, Places((0, 0, 1, 0.4), (0.15, 0, 1, 0.9)), configuration)
    probation = Probation(lock, configuration)
    look = lock.look(IMAGE, False)
    assert probation.judge(IMAGE, 0.0, look) == (look, "") and probation.locks == [lock]
