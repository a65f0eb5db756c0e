"""A place carried on by its picture lies where the picture was moved to."""

import cv2
import numpy as np
import pytest

from paceline.cameras import Camera
from paceline.follow.carrying import STEP, Carried
from paceline.follow.features import Projection
from paceline.follow.target import Target

TARGET = Target(
    "rear",
    10.0,
    np.array([[-0.9, -0.7], [0.9, -0.7], [0.9, 0.7], [-0.9, 0.7]]),
    np.array([[0, 1], [1, 2], [2, 3], [3, 0]]),
)
REACH = np.array([9.0, 14.0])


def camera(size, focal, distortion=()):
    width, height = size
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return Camera(size, K, np.array(distortion)) if len(distortion) else Camera(size, K)


def scenery(size, seed):
    """A picture (H, W) of grey patches of several sizes."""
    rng = np.random.default_rng(seed)
    noise = sum(cv2.GaussianBlur(rng.normal(0, s, size[::-1]), (0, 0), s) for s in (2.0, 5.0))
    return 120 + 30 * noise / noise.std()


def moved(scene, center, shift, grown, noise, seed):
    """The scene with what is at ``center`` moved by ``shift`` px and ``grown``, and with noise."""
    turn = np.array([[grown, 0, center[0] + shift[0] - grown * center[0]], [0, grown, 0.0]])
    turn[1, 2] = center[1] + shift[1] - grown * center[1]
    image = cv2.warpAffine(scene, turn, scene.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    image += np.random.default_rng(seed).normal(0, noise, scene.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("size", "focal", "scale", "reach"),
    [((256, 242), 300.0, 1.0, REACH), ((1280, 720), 1500.0, 1.1, 5 * REACH)],
)
def test_a_place_is_carried_through_bumps_growth_and_noise(seed, size, focal, scale, reach):
    """Twenty images, each up to a bump from the one before and up to 2 % larger or smaller, in noise of a third of the
    contrast: to 0.7 px of the image that is searched and 2 % in the scale, however many images there were."""
    rng = np.random.default_rng(seed)
    scene, center = scenery(size, seed), np.array([0.5 * size[0], 0.55 * size[1]])
    projection = Projection(camera(size, focal), TARGET)
    place = np.array([*center, scale])
    carried = Carried(moved(scene, center, (0, 0), 1.0, 10.0, 100), projection, place, reach)
    side = max(1, int(min(TARGET.size * projection.magnification) * scale / 32))
    at, grown = np.zeros(2), 1.0
    for k in range(20):
        at = np.clip(at + rng.uniform(-0.8, 0.8, 2) * reach, -3 * reach, 3 * reach)
        grown *= 1 + rng.uniform(-0.02, 0.02)
        found = carried.step(moved(scene, center, at, grown, 10.0, k))
        assert np.abs(found[:2] - center - at).max() <= 0.7 * side
        assert found[2] / scale == pytest.approx(grown, rel=0.8 * STEP)
    assert carried.place is found


def test_a_lens_is_taken_into_account():
    """The place is in ideal pixels, the images are not."""
    lens = camera((640, 480), 500.0, (-0.25, 0.08, 0.0, 0.0, 0.0))
    scene, projection = scenery((640, 480), 7), Projection(lens, TARGET)
    place = np.array([150.0, 120.0, 0.6])
    shown = projection.shown(place).location
    carried = Carried(moved(scene, shown[:2], (0, 0), 1.0, 2.0, 0), projection, place, REACH)
    found = carried.step(moved(scene, shown[:2], (5, -8), 1.0, 2.0, 1))
    there = projection.ideal(np.array([*(shown[:2] + [5, -8]), shown[2]]))
    np.testing.assert_allclose(found[:2], there[:2], atol=1.0)
    assert found[2] == pytest.approx(there[2], rel=STEP)
