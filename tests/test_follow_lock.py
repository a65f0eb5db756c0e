"""What a lock learns of how its target's size changes."""

from types import SimpleNamespace

import numpy as np
import pytest

from paceline.follow.configuration import FollowConfiguration
from paceline.follow.fitting import Fit
from paceline.follow.lock import Lock
from paceline.follow.motion import WRONG, MotionModels
from paceline.follow.recognition import Look

START = np.array([128.0, 120.0, 1.0])
PROJECTION = SimpleNamespace(
    size=lambda scale: 60.0 * scale,
    sizes=lambda scale: scale * np.array([60.0, 60.0, 1.0]),
    distance=lambda scale: 10.0 / scale,
    drop=lambda location: 0.0,
)


def lock():
    return Lock(START, SimpleNamespace(projection=PROJECTION, learn=lambda look: None), FollowConfiguration())


def learned(one, scales, std, first=0):
    """How far off the scale was, relatively, that was expected in each of the images, 15 in a second."""
    off = []
    for k, scale in enumerate(scales, first):
        one.predict(k / 15)
        off.append(one.expected[2] / scale - 1.0)
        covariance = np.diag([0.01, 0.01, (std * scale) ** 2])
        fit = Fit(np.array([*START[:2], scale]), covariance, np.ones(3), 0.1, np.zeros(8), np.ones(8, bool))
        one.learn(Look("", fit=fit), k / 15)
    return np.array(off)


@pytest.mark.parametrize("rate", [0.02, 0.03, 0.04])
def test_a_motion_that_goes_on_to_be_wrong_is_forgotten(monkeypatch, rate):
    """A lead draws away by a ``rate`` of its distance an image and then, within half a second, no more; before it
    brakes its size is known to 1 %, in the shade to 3 %."""
    rates = np.concatenate([np.full(25, rate), np.linspace(rate, 0.0, 8), np.zeros(25)])
    scales, off = np.exp(-np.cumsum(rates)), []
    for _ in range(2):
        one = lock()
        learned(one, scales[:25], 0.01)
        off.append(np.abs(learned(one, scales[25:], 0.03, 25)))
        monkeypatch.setattr(MotionModels, "forget_scale", lambda self: None)
    assert off[0].mean() < 0.8 * off[1].mean() and off[0][-1] < 0.6 * off[1][-1]


@pytest.mark.parametrize(("odd", "times"), [([1.06] * (WRONG - 1), 0), ([1.06, 0.94] * WRONG, 0), ([1.06] * WRONG, 1)])
def test_it_takes_several_surprises_in_a_row_and_to_one_side(monkeypatch, odd, times):
    one, forgotten = lock(), []
    learned(one, np.ones(25), 0.01)
    monkeypatch.setattr(one.motion, "forget_scale", lambda: forgotten.append(one.expected[2]))
    learned(one, np.array(odd), 0.01, 25)
    assert len(forgotten) == times
