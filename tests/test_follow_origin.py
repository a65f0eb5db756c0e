"""What is found again is told by where it has come from: what was beside the target then is what has hidden it."""

import cv2
import numpy as np
import pytest
from moved_scenery import TARGET, camera, scenery

from paceline.follow.features import Projection
from paceline.follow.origin import BEFORE, MOST, Origin

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

    def image(self, aside, lead=True):
        """The other vehicle ``aside`` of the lead by so many sizes of that; None: it is not there."""
        self.bump = self.rng.uniform(-1, 1, 2) * (0.5, 4.0)
        picture = self._behind.copy()
        if lead:
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
    """An `Origin` that has seen the lead, then what hides it for a ``gap`` of images and the image after."""
    origin = Origin(PROJECTION)
    for _ in range(10):
        origin.keep(film.image(1.6), film.place(0.0), 0.0)
    for k in range(gap):
        aside = max(1.6 - 1.6 * (k + 1) / COVERS, 0.0)
        image = film.image(aside)
        seen = aside > 0.8
        origin.keep(image, film.place(0.0), 0.0 if seen else k - COVERS / 2 + 1)
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
            origin.keep(film.image(aside), film.place(0.0), gap - COVERS / 2 + 1 + k)
        image = film.image(-1.6)
        assert not origin.complains(image, film.place(0.0)), seed


def test_nothing_is_held_against_a_target_in_full_view():
    """Images that could not be used, say: it is where it was before."""
    for seed in range(5):
        film, origin = Film(seed), Origin(PROJECTION)
        for k in range(20):
            origin.keep(film.image(None), film.place(0.0), max(0.0, k - 12.0))
        image = film.image(None)
        assert not origin.complains(image, film.place(0.0))


def test_what_is_much_nearer_than_the_target_was_is_another():
    """It has hidden it from straight before it."""
    film = Film(4, grown=1.7)
    origin = Origin(PROJECTION)
    for k in range(16):
        shows = k >= 8
        origin.keep(film.image(0.0 if shows else None), film.place(0.0), k - 7.0 if shows else 0.0)
    image = film.image(0.0)
    assert origin.complains(image, film.place(0.0, film.grown))


def test_a_day_without_the_target_needs_no_more_memory():
    film, origin = Film(1), Origin(PROJECTION)
    image = film.image(None)
    for _ in range(40):
        origin.keep(image, film.place(0.0), 0.0)
    assert len(origin._past) == BEFORE
    for k in range(2000):
        origin.keep(image, film.place(0.0), k + 1.0)
        assert len(origin._past) <= MOST
    assert origin._past[0].tau == 0.0
    origin.keep(image, film.place(0.0), 0.0)
    assert len(origin._past) == 1


def test_an_image_is_kept_as_it_was():
    """A camera may write the next one into the same memory."""
    film, origin = Film(2), Origin(PROJECTION)
    image = film.image(None)
    before = image.copy()
    origin.keep(image, film.place(0.0), 0.0)
    image[:] = 0
    np.testing.assert_array_equal(origin._past[0].image, before)
