"""A place carried on by its picture lies where the picture was moved to."""

import cv2
import numpy as np
import pytest
from moved_scenery import REACH, TARGET, camera, moved, scenery
from selection import slow_after

from paceline.follow.carrying import FARTHEST, MANY, STEP, UPRIGHT, Carried, correlated
from paceline.follow.carrying_cpu import sampled
from paceline.follow.features import Projection
from paceline.targets.line_model import Target


@pytest.mark.parametrize("seed", slow_after(2, range(4)))
@pytest.mark.parametrize("evened", [False, True])
@pytest.mark.parametrize(
    ("size", "focal", "scale", "reach"),
    [((256, 242), 300.0, 1.0, REACH), ((1280, 720), 1500.0, 1.1, 5 * REACH)],
)
def test_a_place_is_carried_through_bumps_growth_and_noise(seed, evened, size, focal, scale, reach):
    """Twenty images, each up to a bump from the one before and up to 2 % larger or smaller, in noise of a third of the
    contrast: to 0.7 px of the image that is searched and 2 % in the scale, however many images there were."""
    rng = np.random.default_rng(seed)
    scene, center = scenery(size, seed), np.array([0.5 * size[0], 0.55 * size[1]])
    projection = Projection(camera(size, focal), TARGET)
    place = np.array([*center, scale])
    carried = Carried(moved(scene, center, (0, 0), 1.0, 10.0, 100), projection, place, reach, evened=evened)
    side = max(1, int(min(TARGET.size * projection.magnification) * scale / 32))
    at, grown = np.zeros(2), 1.0
    for k in range(20):
        at = np.clip(at + rng.uniform(-0.8, 0.8, 2) * reach, -3 * reach, 3 * reach)
        grown *= 1 + rng.uniform(-0.02, 0.02)
        found = carried.step(moved(scene, center, at, grown, 10.0, k))
        assert np.abs(found[:2] - center - at).max() <= 0.7 * side
        assert found[2] / scale == pytest.approx(grown, rel=0.8 * STEP)
    assert carried.place is found


def test_a_shadow_that_passes_does_not_take_a_place_along():
    """Its edge goes over the target by 6 px an image, to a third of the light; the target stays. A picture that is not
    evened goes farther off, sometimes for good."""
    center, projection = np.array([128.0, 130.0]), Projection(camera((256, 242), 300.0), TARGET)
    off = {False: [], True: []}
    for seed in range(6):
        scene = scenery((256, 242), seed)
        images = [
            moved(scene * np.where(np.arange(256) < 100 + 6 * k, 0.33, 1.0), center, (0, 0), 1.0, 2.0, k)
            for k in range(10)
        ]
        for evened, most in off.items():
            carried = Carried(images[0], projection, np.array([*center, 1.0]), REACH, evened=evened)
            most.append(np.max([np.abs(carried.step(image) - [*center, 1.0]) for image in images[1:]], axis=0))
    plain, even = np.median(off[False], axis=0), np.median(off[True], axis=0)
    assert (np.max(off[True], axis=0) < [2.0, 0.5, 0.13]).all() and (np.max(off[False], axis=0) > [9.0, 9.0, 0.3]).any()
    assert (even[:2] < 0.8 * plain[:2]).all() and even[2] < 0.8 * plain[2]


def test_in_dim_light_an_evened_picture_is_told_that_what_is_bright_about_it_takes_along():
    """A target of a few grey levels, before a bright line that goes another way, as a road's paint does."""
    center, projection = np.array([128.0, 130.0]), Projection(camera((256, 242), 300.0), TARGET)
    right = {False: 0, True: 0}
    for seed in range(12):
        scene = 8.0 + 0.06 * (scenery((256, 242), seed) - 120.0)

        def image(shift, line, k, scene=scene):
            bright = np.where(np.abs(np.arange(242)[:, None] - (105.0 + line)) < 2.0, 230.0, 0.0)
            return moved(np.maximum(moved(scene, center, shift, 1.0, 0.0, 0), bright), center, (0, 0), 1.0, 0.5, k)

        for evened in right:
            carried = Carried(image((0, 0), 0.0, 1), projection, np.array([*center, 1.0]), REACH, evened=evened)
            found = carried.step(image((3, 5), -4.0, 2))
            right[evened] += bool((np.abs(found - [131.0, 135.0, 1.0]) < [1.5, 1.5, STEP]).all())
    assert right[True] >= 10 and right[False] <= 4


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


@pytest.mark.parametrize("grown", [0.91, 1.1])
def test_a_change_of_size_is_found_as_far_as_it_is_tried(grown):
    scene, center = scenery((256, 242), 3), np.array([128.0, 130.0])
    projection = Projection(camera((256, 242), 300.0), TARGET)
    carried = Carried(moved(scene, center, (0, 0), 1.0, 4.0, 0), projection, np.array([*center, 1.0]), REACH)
    assert abs(np.log(grown)) < STEP * FARTHEST
    found = carried.step(moved(scene, center, (2, -3), grown, 4.0, 1))
    assert (np.abs(found - [130.0, 127.0, grown]) < [0.7, 0.7, 0.8 * STEP]).all()
    assert 0.8 < carried.likeness < 1.0


LOW = Target("low", 10.0, TARGET.corners * [0.9, 0.25], TARGET.segments)


def carried_right(upright, noise, seeds):
    """How often a low target is carried to where it went."""
    right, center = 0, np.array([128.0, 130.0])
    projection = Projection(camera((256, 242), 300.0), LOW)
    for seed in seeds:
        scene, at = scenery((256, 242), seed), np.array([5.0, -7.0])
        first = moved(scene, center, (0, 0), 1.0, noise, 2 * seed)
        carried = Carried(first, projection, np.array([*center, 1.0]), 2 * REACH, upright)
        found = carried.step(moved(scene, center, at, 1.03, noise, 2 * seed + 1))
        right += bool((np.abs(found - [*(center + at), 1.03]) < [1.5, 1.5, 2 * STEP]).all())
    return right


def test_a_low_target_is_carried_by_what_is_above_and_below_it():
    """A band of a car between its lamps and bumper says little in noise: with its window and its wheels it is told."""
    seeds = range(100, 130)
    alone, whole = (carried_right(upright, 80.0, seeds) for upright in (0.0, UPRIGHT))
    assert whole >= 18 and alone <= 15
    assert carried_right(0.0, 6.0, seeds) == carried_right(UPRIGHT, 6.0, seeds) == len(seeds)


@pytest.mark.parametrize("grown", [0.97, 1.0, 1.03])
@pytest.mark.parametrize("size", [1.0, 1.8])
def test_noise_makes_nothing_larger_or_smaller(grown, size):
    """What is sampled between pixels is smoother than the pixels, and noise that is smooth is alike."""
    scales, center = [], np.array([128.0, 130.0])
    projection = Projection(camera((256, 242), 300.0), Target("low", 10.0, size * LOW.corners, LOW.segments))
    for seed in range(40):
        scene = scenery((256, 242), seed)
        first = moved(scene, center, (0, 0), 1.0, 60.0, 2 * seed)
        carried = Carried(first, projection, np.array([*center, 1.0]), REACH, UPRIGHT)
        scales.append(carried.step(moved(scene, center, (5.0, -7.0), grown, 60.0, 2 * seed + 1))[2])
    off = np.log(np.array(scales) / grown)
    assert abs(off.mean()) < 3.0 * off.std() / np.sqrt(len(off))


def test_the_likeness_at_a_place_is_that_of_a_step_there_and_less_elsewhere():
    scene, center = scenery((256, 242), 3), np.array([128.0, 130.0])
    projection, there = Projection(camera((256, 242), 300.0), TARGET), np.array([130.0, 127.0, 1.02])
    carried = Carried(moved(scene, center, (0, 0), 1.0, 4.0, 0), projection, np.array([*center, 1.0]), np.full(2, 2.0))
    image = moved(scene, center, (2, -3), 1.02, 4.0, 1)
    at = carried.likeness_at(image, there)
    np.testing.assert_array_equal(carried.place, [*center, 1.0])
    carried.place = there
    carried.step(image)
    assert at == pytest.approx(carried.likeness, abs=0.01) and at > 0.9
    for elsewhere in ([20.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 0.4]):
        assert carried.likeness_at(image, there + elsewhere) < at - 0.2


# --- the loops -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.6, 1.0, 1.37])
@pytest.mark.parametrize("first", [(7.3, 5.9), (-2.4, -1.0), (30.2, 21.7)])  # the last two reach beyond the border
def test_samples_are_those_of_cubics_and_the_border_goes_on(first, step):
    pixels = np.random.default_rng(3).uniform(0.0, 255.0, (31, 40)).astype(np.float32)
    out = np.empty((14, 17), np.float32)
    sampled(pixels, *first, step, out)
    x, y = np.meshgrid(first[0] + step * np.arange(17), first[1] + step * np.arange(14))
    wanted = cv2.remap(
        np.pad(pixels, 20, mode="edge"), (x + 20).astype(np.float32), (y + 20).astype(np.float32), cv2.INTER_CUBIC
    )
    np.testing.assert_allclose(out, wanted, atol=3.0)  # it places samples on a 32nd of a pixel


@pytest.mark.parametrize(("shape", "many"), [((9, 13), False), ((20, 4), False), ((5, 6), True)])
def test_correlations_are_those_of_every_whole_shift(shape, many):
    rng = np.random.default_rng(4)
    part = rng.uniform(0.0, 255.0, (34, 25)).astype(np.float32)
    part[:20, :14] = 90.0  # nothing shows there
    picture = rng.standard_normal(shape).astype(np.float32)
    picture -= picture.mean()
    picture /= np.linalg.norm(picture)
    scores = correlated(picture, part)
    h, w = shape
    assert scores.shape == (34 - h + 1, 25 - w + 1) and (scores.size >= MANY) == many
    for y, x in np.ndindex(scores.shape):
        under = part[y : y + h, x : x + w]
        flat = under.std() == 0.0
        wanted = 0.0 if flat else np.corrcoef(picture.ravel(), under.ravel())[0, 1]
        assert scores[y, x] == pytest.approx(wanted, abs=2e-4)


@pytest.mark.parametrize("grey", [0, 1, 30, 90, 200, 255])
@pytest.mark.parametrize("scale", [0.9, 1.0, 1.3])
def test_a_face_that_shows_nothing_is_like_nothing(grey, scale):
    """An overexposed face, or a black one: the rounding of its grey is no picture."""
    projection, center = Projection(camera((256, 242), 300.0), TARGET), np.array([128.0, 130.0])
    carried = Carried(np.full((242, 256), grey, np.uint8), projection, np.array([*center, 1.0]), REACH)
    carried.place = np.array([*center, scale])
    carried.step(moved(scenery((256, 242), 5), center, (0, 0), 1.0, 4.0, 0))
    assert carried.likeness == 0.0


def test_a_place_is_looked_for_no_farther_than_its_reach():
    """Whatever is there: each size is looked for beside the place of the one before, but not ever farther away."""
    projection, center = Projection(camera((256, 242), 300.0), TARGET), np.array([128.0, 130.0])
    reach = np.array([6.0, 9.0])
    for seed in range(12):
        first = moved(scenery((256, 242), seed), center, (0, 0), 1.0, 4.0, 0)
        carried = Carried(first, projection, np.array([*center, 1.0]), reach)
        found = carried.step(moved(scenery((256, 242), 50 + seed), center, (0, 0), 1.0, 4.0, 1))
        assert (np.abs(found[:2] - center) <= reach + 2.5).all()  # a sample beyond, and the peak's own fraction
