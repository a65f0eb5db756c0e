"""What is found again is told by where it has come from: what was beside the target then is what has hidden it."""

import cv2
import numpy as np
import pytest
from moved_scenery import TARGET, camera, scenery

from paceline.follow.features import Projection
from paceline.follow.origin import MOST, SIGHTS, SURE, Origin

SIZE, FOCAL, SCALE = (256, 242), 300.0, 0.9
PROJECTION = Projection(camera(SIZE, FOCAL), TARGET)
HERE = np.array([125.0, 130.0])
COVERS = 12  # images within which what cuts in has come before the target


class Film:
    """A vehicle at `HERE`, and another, of ``grown`` times its size, that comes before it from ``side``; each has a
    picture of its own, or they are ``alike``. Bumps and noise as in [NIST]'s films."""

    def __init__(self, seed, side=1.0, grown=1.2, alike=False):
        self.rng = np.random.default_rng(seed)
        self.side, self.grown = side, grown
        self._behind = 120 + 0.4 * (scenery(SIZE, seed) - 120)  # a road and its sides are plainer than vehicles
        self._lead = self._vehicle(seed + 100)
        self._other = self._lead if alike else self._vehicle(seed + 200)
        self.bump = np.zeros(2)

    def _vehicle(self, seed):
        width, height = np.rint(TARGET.size * PROJECTION.magnification).astype(int)
        return 60 + 0.6 * scenery((width, height), seed)

    def image(self, aside):
        """The other vehicle ``aside`` of the lead by so many sizes of that; None: it is not there."""
        self.bump = self.rng.uniform(-1, 1, 2) * (0.5, 4.0)
        picture = self._behind.copy()
        self._put(picture, self._lead, self.place(0.0))
        if aside is not None:
            self._put(picture, self._other, self.place(aside, self.grown))
        picture += self.rng.normal(0, 3.0, picture.shape)
        return np.clip(np.rint(picture), 0, 255).astype(np.uint8)

    def place(self, aside, grown=1.0):
        scale = SCALE * grown
        size = PROJECTION.size(SCALE)
        return np.array([*(HERE + self.bump + (self.side * aside * size, 0.2 * (grown - 1.0) * size)), scale])

    def _put(self, picture, vehicle, place):
        x, y = place[:2] - 0.5 * place[2] * (np.array(vehicle.shape[::-1]) - 1)
        turn = np.array([[place[2], 0, x], [0, place[2], y]])
        there = cv2.warpAffine(np.ones_like(vehicle), turn, SIZE) > 0.5
        picture[there] = cv2.warpAffine(vehicle, turn, SIZE)[there]


def hidden(film, gap):
    """An `Origin` that has seen the lead, then what comes before it and hides it, in ``gap`` images."""
    origin = Origin(PROJECTION)
    for _ in range(10):
        origin.see(film.image(1.6), film.place(0.0))
    for k in range(gap):
        aside = max(1.6 - 1.6 * (k + 1) / COVERS, 0.0)
        image = film.image(aside)
        if aside > 0.8:
            origin.see(image, film.place(0.0))
        else:
            origin.miss(image, k / 15, film.place(0.0), k - COVERS / 2 + 1)
    return origin


@pytest.mark.parametrize("alike", [False, True], ids=["another", "a twin"])
@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["from the left", "from the right"])
@pytest.mark.parametrize("gap", [16, 60])
def test_what_came_before_the_target_is_told(gap, side, alike):
    for seed in range(3):
        film = Film(seed, side, alike=alike)
        origin = hidden(film, gap)
        image = film.image(0.0)
        assert origin.complains(image, film.place(0.0, film.grown)), seed


@pytest.mark.parametrize("alike", [False, True], ids=["another", "a twin"])
@pytest.mark.parametrize("gap", [16, 60])
def test_the_target_is_itself_when_it_shows_again(gap, alike):
    """What hid it goes on to the other side; the target has been where it is all the while."""
    for seed in range(3):
        film = Film(seed, alike=alike)
        origin = hidden(film, gap)
        for k in range(COVERS):
            aside = -1.6 * (k + 1) / COVERS
            origin.miss(film.image(aside), (gap + k) / 15, film.place(0.0), gap - COVERS / 2 + 1 + k)
        image = film.image(-1.6)
        assert not origin.complains(image, film.place(0.0)), seed


def test_nothing_is_held_against_a_target_in_full_view():
    """Images that could not be used, say: it is where it was before."""
    for seed in range(5):
        film, origin = Film(seed), Origin(PROJECTION)
        for _ in range(12):
            origin.see(film.image(None), film.place(0.0))
        for k in range(8):
            origin.miss(film.image(None), k / 15, film.place(0.0), k + 1.0)
        image = film.image(None)
        assert not origin.complains(image, film.place(0.0))


def behind_another(seed=4):
    """A film in which another vehicle stands before the lead from one image to the next."""
    film, origin = Film(seed, grown=1.7), Origin(PROJECTION)
    for _ in range(8):
        origin.see(film.image(None), film.place(0.0))
    for k in range(8):
        origin.miss(film.image(0.0), k / 15, film.place(0.0), k + 1.0)
    return film, origin


def test_what_is_much_nearer_than_the_target_was_is_another():
    film, origin = behind_another()
    image = film.image(0.0)
    assert origin.complains(image, film.place(0.0, film.grown))


def test_what_is_much_farther_off_has_not_hidden_it():
    """A picture that is carried to there has slid away."""
    film, origin = behind_another()
    slid = film.place(0.7, 0.5)
    assert origin._is_elsewhere(slid, origin._since[0]) and origin._has_slid(slid, origin._since[0])
    origin._is_elsewhere = lambda place, past: True  # what comes first decides
    origin._has_slid = lambda place, past: True
    image = film.image(0.0)
    assert not origin.complains(image, film.place(0.0, film.grown))


def test_of_a_target_that_was_not_seen_nothing_is_known():
    """A start in doubt, or a time that has jumped: what is in the images may be it."""
    film, origin = Film(3), Origin(PROJECTION)
    for k in range(8):
        origin.miss(film.image(1.0), k / 15, film.place(0.0), k + 1.0)
    image = film.image(1.0)
    assert not origin.complains(image, film.place(1.0, film.grown))


def test_after_a_while_nothing_is_asked_and_memory_is_bounded():
    film, origin = Film(1), Origin(PROJECTION)
    image = film.image(None)
    for _ in range(40):
        origin.see(image, film.place(0.0))
    assert len(origin._seen) == SIGHTS
    for k in range(2 * MOST):  # 30 images a second: every other one
        origin.miss(image, k / 30, film.place(0.0), 0.5 * (k + 1.0))
    assert len(origin._seen) == SIGHTS and len(origin._since) == MOST
    for k in range(2 * MOST, 4 * MOST):
        origin.miss(image, k / 30, film.place(0.0), 0.5 * (k + 1.0))
    assert not origin._seen and not origin._since
    for _ in range(SURE):
        origin.see(image, film.place(0.0))
    assert len(origin._seen) == SURE


def test_a_glimpse_of_something_else_is_held_against_nothing():
    """After a jump of the time, say, one image is taken for the target beside it; then it is seen where it is."""
    film, origin = Film(6), Origin(PROJECTION)
    for _ in range(SURE - 1):
        origin.see(film.image(None), film.place(1.0))
    for k in range(4):
        origin.miss(film.image(None), k / 15, film.place(1.0), k + 1.0)
    image = film.image(None)
    assert not origin.complains(image, film.place(0.0))
    for _ in range(SURE):  # and the same after it was seen well, and for a moment elsewhere
        origin.see(film.image(None), film.place(0.0))
    origin.miss(film.image(None), 1.0, film.place(0.0), 1.0)
    origin.see(film.image(None), film.place(1.0))
    origin.miss(film.image(None), 1.2, film.place(1.0), 1.0)
    image = film.image(None)
    assert not origin.complains(image, film.place(0.0))


def test_images_are_kept_as_they_were():
    """A camera may write the next one into the same memory."""
    film, origin = Film(2), Origin(PROJECTION)
    image = film.image(None)
    before = image.copy()
    for _ in range(SURE):
        origin.see(image, film.place(0.0))
    origin.miss(image, 0.1, film.place(0.0), 1.0)
    image[:] = 0
    for past in (*origin._seen, *origin._since):
        np.testing.assert_array_equal(past.image, before)
