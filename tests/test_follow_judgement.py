"""What is thought of features that were found, one reason at a time."""

from dataclasses import replace

import numpy as np
import pytest

from paceline.cameras import Camera
from paceline.follow import judgement
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.features import Projection
from paceline.follow.fitting import Fit
from paceline.follow.judgement import FEW, JUMPS, UNLIKE, UNSIZED, Foreseen, Found, judged
from paceline.follow.measuring import Measurement
from paceline.targets.line_model import Target

CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
CAMERA = Camera((256, 242), np.array([[300.0, 0.0, 127.5], [0.0, 300.0, 120.5], [0.0, 0.0, 1.0]]))
PROJECTION = Projection(CAMERA, Target("box", 10.0, CORNERS, np.array([[0, 1], [1, 2], [2, 3], [3, 0]])))
SCALE = 1.25
SIZE = PROJECTION.size(SCALE)
THERE = np.array([128.0, 120.0, SCALE])
LINES = np.arange(7)
A_LITTLE = 1e-3


def found(picture=1.0, shows=1.0, support=1.0, discord=0.3, spread=0.005, agreeing=7, seen=7, grown=1.0, aside=0.0):
    """All seven lines, where they were foreseen and as ever, but for what is given. By themselves they tell another
    place."""
    location = THERE * [1.0, 1.0, grown] + [aside * SIZE, 0.0, 0.0]
    offsets = np.where(seen > LINES, 0.0, np.nan)
    covariance = np.diag([0.1, 0.1, (spread * grown * SCALE) ** 2])
    fit = Fit(location, covariance, np.ones(3), 0.1, offsets, seen > LINES)
    alone = replace(fit, location=location * [1.0, 1.0, 1.3], covariance=9.0 * covariance)
    points = np.zeros((0, 2)), np.zeros(0, np.int64)
    return Found(Measurement(alone, *points, 0.1, discord, 0.8, support, agreeing > LINES), fit, picture, shows, True)


def verdict(what, tau=1.0, lost=False, scale_doubt=0.01, **changed):
    foreseen = Foreseen(THERE, np.array([1.0, 1.0, scale_doubt * SCALE]), tau, lost)
    return judged(what, foreseen, PROJECTION, FollowConfiguration(**changed))


def complaint(what, **given):
    return verdict(what, **given).complaint


def test_what_shows_as_ever_is_clear_and_sure():
    assert verdict(found()) == ("", True, True)


def test_enough_lines_must_be_found_and_more_of_a_target_that_was_lost():
    for least, lost in ((judgement.SUPPORT, False), (judgement.CLEAR, True)):
        assert complaint(found(support=least), lost=lost) == ""
        assert complaint(found(support=least - A_LITTLE), lost=lost) == FEW
    assert complaint(found(agreeing=judgement.FEATURES - 1)) == FEW
    assert complaint(found(agreeing=judgement.FEATURES)) == ""
    assert complaint(found(support=0.2, picture=0.0, shows=0.0)) == FEW  # whatever else there is


def test_features_must_agree_and_more_closely_where_it_does_not_look_as_ever():
    usual, loose = 1.0 + A_LITTLE, judgement.LOOSE + A_LITTLE
    assert complaint(found(discord=loose, agreeing=5)) == judgement.APART
    assert complaint(found(discord=loose, agreeing=6)) == ""  # a single one that is another's edge
    assert complaint(found(discord=loose, agreeing=5, seen=6)) == ""
    assert complaint(found(discord=usual, agreeing=5)) == ""
    assert complaint(found(discord=usual, agreeing=5)._replace(proven=False)) == judgement.APART
    assert complaint(found(discord=usual, agreeing=5, picture=judgement.ALIKE)) == judgement.APART
    assert complaint(found(discord=usual, agreeing=5, shows=judgement.MOSTLY)) == judgement.APART


def test_its_size_must_be_told_and_not_jump_unless_it_is_sharp_and_alike():
    assert complaint(found(spread=judgement.VAGUE + A_LITTLE)) == UNSIZED
    assert complaint(found(spread=judgement.VAGUE - A_LITTLE)) == ""
    blurred = 1.01 * judgement.SHARP
    for grown in (0.88, 1.12):  # by twelve standard deviations of 0.01
        assert complaint(found(grown=grown, spread=blurred)) == JUMPS
        assert complaint(found(grown=grown)) == ""
        assert complaint(found(grown=grown, picture=judgement.ALIKE)) == JUMPS
        assert complaint(found(grown=grown, spread=blurred), scale_doubt=0.1) == ""
        assert complaint(found(grown=grown, spread=0.05)) == ""


def needed(tau=1.0, lost=False, picture=0.8, continuity=True, **where):
    """How closely it has to be related there, by bisection of how much of the model shows."""
    low, high = 0.0, 2.0
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        what = found(picture=picture, shows=middle, **where)
        good = complaint(what, tau=tau, lost=lost, scale_doubt=1.0, continuity=continuity) == ""
        low, high = (low, middle) if good else (middle, high)
    return picture + high


@pytest.mark.parametrize(
    ("given", "least"),
    [
        ({}, judgement.RELATED),
        ({"grown": 1.0 + 1.1 * judgement.AS_FORESEEN}, judgement.STRAYED),
        ({"grown": 1.0 - 1.1 * judgement.AS_FORESEEN}, judgement.STRAYED),
        ({"grown": 1.0 + 0.9 * judgement.AS_FORESEEN}, judgement.RELATED),
        ({"tau": judgement.GONE}, judgement.AGAIN),
        ({"tau": judgement.GONE, "grown": 1.0 - 1.1 * judgement.NEARLY}, judgement.REGAINED),
        ({"tau": judgement.GONE, "aside": 1.1 * judgement.ASIDE, "continuity": False}, judgement.REGAINED),
        ({"tau": judgement.GONE, "aside": 0.9 * judgement.ASIDE, "continuity": False}, judgement.AGAIN),
        ({"aside": 0.3}, judgement.REGAINED),  # no vehicle moves so far within a cycle
        ({"aside": 0.3, "continuity": False}, judgement.RELATED),
        ({"lost": True}, judgement.REGAINED),
        ({"lost": True, "picture": 0.9}, judgement.REGAINED),
        ({"picture": 0.9}, 0.9),  # so alike that nothing else has to show
        ({"picture": 0.9, "tau": judgement.GONE}, 0.9),
        ({"picture": 0.9, "grown": 1.0 + 1.1 * judgement.NEARLY}, judgement.STRAYED),
        ({"picture": 0.9, "grown": 1.0 - 1.1 * judgement.NEARLY}, judgement.STRAYED),
    ],
)
def test_it_must_look_like_it_the_more_the_less_it_is_where_it_was_foreseen(given, least):
    assert needed(**given) == pytest.approx(least, abs=1e-5)


def test_what_does_not_look_like_it_is_said_to():
    assert complaint(found(picture=0.5, shows=0.5)) == UNLIKE
    assert verdict(found(picture=0.5, shows=0.5), appearance=False) == ("", True, False)


def test_it_is_clear_at_the_size_foreseen_and_sure_where_it_is_as_closely_related_as_one_found_again():
    assert not verdict(found(grown=1.0 + 1.1 * judgement.SHARP)).clear
    assert not verdict(found(grown=1.0 - 1.1 * judgement.SHARP)).clear
    assert not verdict(found(spread=1.01 * judgement.SHARP)).clear
    assert not verdict(found(discord=judgement.CLOSELY)).clear
    assert not verdict(found(support=judgement.CLEAR - A_LITTLE)).clear
    assert verdict(found(shows=judgement.REGAINED - 1.0)).sure
    assert not verdict(found(shows=judgement.REGAINED - 1.0 - A_LITTLE)).sure
    assert not verdict(found(agreeing=0)).sure
