"""The whole loop on drawn clips with exact truth: follows, knows when it does not, and says why."""

import gc
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from selection import slow_after

from paceline.cameras import Camera, Quantity
from paceline.errors import UnusableInput
from paceline.follow import association, candidates, edges_cpu, fitting, motion, picture_cpu, recognition, search_cpu
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.judgement import APART, UNLIKE, UNSIZED, Foreseen, Found, Verdict, judged
from paceline.follow.origin import CAME
from paceline.follow.search import Sighting
from paceline.follow.snapshot import RIGHT
from paceline.follow.tracker import FollowTracker, warm_up
from paceline.recordings.odometry import Pose
from paceline.targets.line_model import Target

K = np.array([[300.0, 0.0, 127.5], [0.0, 300.0, 120.5], [0.0, 0.0, 1.0]])
CAMERA = Camera((256, 242), K)
LENS = Camera((256, 242), K, np.array([-0.3, 0.1, 0.0, 0.0]))
CORNERS = np.array(
    [[-1, -0.75], [1, -0.75], [1, 0.75], [-1, 0.75], [-0.7, -0.5], [0.7, -0.5], [0.7, 0.05], [-0.7, 0.05]]
    + [[-1, 0.4], [1, 0.4]]
)
TARGET = Target(
    "van", 10.0, CORNERS, np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [8, 9]])
)
FACES = [
    ((-1, -0.75, 1, 0.75), 150),
    ((-0.7, -0.5, 0.7, 0.05), 60),
    ((-1, 0.4, 1, 0.75), 80),
    ((-0.3, 0.15, 0.3, 0.3), 200),
]
FINE = 6  # samples per pixel and axis


def scenery(seed):
    """A wide picture of poles, walls and ground behind the target, (H, W) grey levels."""
    rng = np.random.default_rng(seed)
    picture = np.full((600, 1600), 185.0)
    picture[300:] = 110.0
    for _ in range(60):
        x, w, top, grey = rng.integers(0, 1580), rng.integers(4, 80), rng.integers(150, 300), rng.uniform(40, 160)
        picture[top : rng.integers(300, 420), x : x + w] = grey
    return cv2.GaussianBlur(picture, (0, 0), 1.2)


def draw(position, background, shift, rng, camera=CAMERA, behind=None):
    """The target at ``position`` m before ``background`` moved by ``shift`` px, seen by ``camera``, with noise; what
    stands at ``behind`` m has its outline and its window and nothing else of it."""
    w, h = camera.image_size
    grid = (np.arange(w * FINE) + 0.5) / FINE - 0.5, (np.arange(h * FINE) + 0.5) / FINE - 0.5
    x, y = np.meshgrid(*grid)
    if camera.has_distortion:
        coarse = camera.undistort_points(np.stack(np.meshgrid(np.arange(-1, w + 1.0), np.arange(-1, h + 1.0)), -1))
        maps = [np.ascontiguousarray(coarse[..., k], np.float32) for k in (0, 1)]
        at = [np.asarray(v + 1, np.float32) for v in (x, y)]
        x, y = (cv2.remap(m, at[0], at[1], cv2.INTER_LINEAR).astype(float) for m in maps)
    ground = [np.asarray(v, np.float32) for v in (x + 600 + shift[0], y + 180 + shift[1])]
    image = cv2.remap(background.astype(np.float32), ground[0], ground[1], cv2.INTER_LINEAR)
    vehicles = [(position, FACES)] if behind is None else [(behind, FACES[:2]), (position, FACES)]
    for place, faces in vehicles:
        u = (x - K[0, 2]) * place[2] / K[0, 0] - place[0]
        v = (y - K[1, 2]) * place[2] / K[1, 1] - place[1]
        for (x0, y0, x1, y1), grey in faces:
            image[(u >= x0) & (u < x1) & (v >= y0) & (v < y1)] = grey
    image = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), 0.6) + rng.normal(0, 2.0, image.shape)
    return np.clip(image.round(), 0, 255).astype(np.uint8)


def film(frames=45, seed=0, bounce=3.0, camera=CAMERA, beside=0.0):
    """Frames (F, H, W) and positions (F, 3) of a vehicle that weaves and changes its gap, seen from a bumpy ride."""
    rng = np.random.default_rng(seed)
    background = scenery(seed)
    t = np.arange(frames) / 15
    bumps = rng.normal(0, bounce / 300 * 9, frames)
    phase = rng.uniform(0, 6, 3)
    z = 9 + 2 * np.sin(0.9 * t + phase[0])
    positions = np.column_stack([beside + 0.6 * np.sin(1.1 * t + phase[1]), 0.2 + bumps, z])
    shifts = np.column_stack([40 * np.sin(0.8 * t + phase[2]), -bumps * 30])
    images = [draw(p, background, s, rng, camera) for p, s in zip(positions, shifts, strict=True)]
    return images, positions


def begin(position, camera=CAMERA, configuration=None, off=(0.5, -0.4), size=1.005):
    center = camera.distort_points(CAMERA.project(position)) + off
    return FollowTracker(camera, TARGET, (*center, 10.0 / position[2] * size), configuration)


def follow(tracker, images, times=None, start=0):
    times = np.arange(start, start + len(images)) / 15 if times is None else times
    return [tracker.update(image, float(t), start + k) for k, (image, t) in enumerate(zip(images, times, strict=True))]


def followed(clip):
    """A tracker that has followed the first 20 frames of a clip."""
    images, positions = clip
    tracker = begin(positions[0])
    follow(tracker, images[:20])
    return tracker


def errors(estimates, positions):
    off = np.array([e.position for e in estimates]) - positions
    return off[:, 2] / positions[:, 2], off[:, 0]


@pytest.fixture(scope="module")
def clip():
    return film()


@pytest.mark.slow
def test_heights_that_a_rolling_shutter_stretches_do_not_change_the_range(clip):
    """A camera of which it is known that all rows are read at once takes them for a change of size."""
    images, positions = clip
    stretches = np.random.default_rng(7).normal(0, 0.009, len(images))
    shaken = [
        cv2.warpAffine(image, np.array([[1, 0, 0], [0, 1 + k, -k * K[1, 2]]]), image.shape[::-1], flags=cv2.INTER_CUBIC)
        for image, k in zip(images, stretches, strict=True)
    ]
    rolling, at_once = (
        follow(begin(positions[0], replace(CAMERA, readout=Quantity(readout))), shaken) for readout in (0.02, 0.0)
    )
    assert [e.status for e in rolling] == ["tracking"] * len(images)
    spread = [np.diff(errors(estimates, positions)[0][10:]).std() for estimates in (rolling, at_once)]
    assert spread[0] < 0.6 * spread[1]


@pytest.mark.parametrize("seed", slow_after(1, [0, 1, 2]))
def test_follows_over_bumps_before_poles_and_walls(seed):
    images, positions = film(seed=seed, bounce=4.0)
    estimates = follow(begin(positions[0]), images)
    assert [e.status for e in estimates] == ["tracking"] * len(images)
    ranges, lateral = errors(estimates, positions)
    assert np.sqrt((ranges**2).mean()) < 0.01 and np.abs(ranges).max() < 0.03
    assert np.sqrt((lateral**2).mean()) < 0.03
    inside = np.abs(np.array([e.position for e in estimates]) - positions) < 1.96 * np.array(
        [e.position_std for e in estimates]
    )
    assert inside.mean() > 0.9


def test_the_estimate_is_complete(clip):
    images, positions = clip
    estimate = follow(begin(positions[0]), images[:5])[-1]
    assert (estimate.frame, estimate.time) == (4, pytest.approx(4 / 15))
    np.testing.assert_allclose(estimate.center, CAMERA.project(positions[4]), atol=0.6)
    np.testing.assert_allclose(10.0 / estimate.scale, estimate.position[2], rtol=1e-9)
    assert estimate.bearing == pytest.approx(np.arctan2(estimate.position[0], estimate.position[2]))
    assert estimate.weights.shape == (3,) and np.all(estimate.weights > 0)
    assert estimate.lines.shape == (9, 2, 2)
    assert len(estimate.points) == len(estimate.owners) > 100
    ends = estimate.lines[estimate.owners]  # every believed point lies near the line that owns it
    upright = TARGET.vertical[estimate.owners]
    across = np.where(upright, ends[:, 0, 0] - estimate.points[:, 0], ends[:, 0, 1] - estimate.points[:, 1])
    assert np.abs(across).max() < 4
    x0, y0, x1, y1 = estimate.window
    assert np.all(estimate.points >= [x0, y0]) and np.all(estimate.points < [x1, y1])
    assert 0 <= estimate.residual < 0.8 and estimate.latency > 0 and estimate.reason == ""


@pytest.mark.slow
def test_a_lens_changes_nothing():
    images, positions = film(20, seed=4, camera=LENS, beside=1.8)
    estimates = follow(begin(positions[0], LENS), images)
    assert {e.status for e in estimates} == {"tracking"}
    ranges, lateral = errors(estimates, positions)
    assert np.sqrt((ranges**2).mean()) < 0.01 and np.sqrt((lateral**2).mean()) < 0.03
    pinhole = [LENS.distort_points(CAMERA.project(p)) - CAMERA.project(p) for p in positions]
    assert np.abs(pinhole).max() > 0.5  # and there was something to change


def test_one_second_behind_another_vehicle_is_survived(clip):
    images, positions = clip
    hidden = [im.copy() for im in images]
    for im in hidden[15:30]:
        im[60:, :] = 95
    estimates = follow(begin(positions[0]), hidden)
    assert {e.status for e in estimates[15:30]} == {"coasting"}
    assert all(e.reason for e in estimates[15:30])
    assert [e.status for e in estimates[31:]] == ["tracking"] * 14
    back = next(e for e in estimates[30:] if e.status == "tracking")
    assert back.reason.startswith("reacquired after 1.")
    ranges, _ = errors(estimates[31:], positions[31:])
    assert np.abs(ranges).max() < 0.03
    assert np.all(np.diff([e.position_std[2] for e in estimates[16:29]]) > 0)  # it knows less and less


@pytest.mark.slow
def test_a_target_of_which_the_image_shows_six_tenths_is_reacquired():
    rng, background = np.random.default_rng(5), scenery(5)
    aside = -2.2 - np.clip(0.085 * (np.arange(45) - 7), 0.0, 1.0)
    positions = np.column_stack([aside, np.full(45, 0.2), np.full(45, 8.0)])
    images = [draw(p, background, (8 * k, 0.0), rng) for k, p in enumerate(positions)]
    shown = 0.5 * (positions[:, 0] + 1.0 - 8.0 * CAMERA.rays(np.zeros(2))[0])
    assert shown[20:].max() < 0.62
    images[22:27] = [None] * 5
    estimates = follow(begin(positions[0]), images)
    status = [e.status for e in estimates]
    assert status[:22] == ["tracking"] * 22 and status[35:] == ["tracking"] * 10
    off, aside = errors(estimates, positions)
    believed = np.array([s == "tracking" for s in status])
    assert np.abs(off[believed]).max() < 0.02 and np.abs(aside[believed]).max() < 0.05


def test_a_target_that_was_not_seen_for_a_while_is_found_wherever_it_is():
    rng, background, place = np.random.default_rng(7), scenery(7), np.array([0.0, 0.3, 14.0])
    tracker = begin(place)
    follow(tracker, [draw(place, background, (k, 0.0), rng) for k in range(20)])
    lock = tracker.lock
    search, appearance = lock.recogniser._search, lock.recogniser.appearance
    doubt = np.array([15.0, 15.0, 0.05 * lock.expected[2]])
    for k in range(12):
        there = place + rng.uniform([-2, -1, -1.5], [2, 1, 1.5])
        image = draw(there, background, (50 + 9 * k, 3.0), rng)
        found = search.find(image, lock.expected, doubt, np.zeros(len(TARGET.segments)), 8.0, appearance, True)
        assert np.abs(found.location[:2] - CAMERA.project(there)).max() < 0.6
        assert found.location[2] == pytest.approx(10.0 / there[2], rel=0.08)


def test_a_target_that_goes_is_lost_and_nothing_else_is_taken_for_it(clip):
    images, positions = clip
    rng = np.random.default_rng(9)
    background = scenery(0)
    far = np.array([0.0, 0.0, 5000.0])
    empty = [draw(far, background, (8.0 * k, 2 * rng.normal()), rng) for k in range(60)]
    estimates = follow(begin(positions[0]), images[:20] + empty)
    assert "tracking" not in {e.status for e in estimates[20:]}
    assert estimates[-1].status == "lost" and estimates[-1].reason


def test_a_start_on_something_else_is_never_tracked():
    images, positions = film(30, seed=1)
    for center in ([40.0, 60.0], [215.0, 200.0]):
        estimates = follow(FollowTracker(CAMERA, TARGET, (*center, 0.9)), images)
        wrong = [e for e in estimates if e.status == "tracking" and abs(e.position[0] - positions[e.frame][0]) > 0.5]
        assert len(wrong) <= 1, center


@pytest.fixture(scope="module", params=[0, 1, 2])
def short_clip(request):
    return film(12, seed=request.param)


@pytest.mark.parametrize(
    "off", [(20.0, 0.0, 1.0), (0.0, -17.0, 1.0), (0.0, 0.0, 0.7), (0.0, 0.0, 1.4), (-12.0, 8.0, 0.85)]
)
def test_a_start_beside_the_target_is_put_right_or_not_believed(short_clip, off):
    images, positions = short_clip
    estimates = follow(begin(positions[0], off=off[:2], size=off[2]), images)
    tracked = [e for e in estimates if e.status == "tracking"]
    assert len(tracked) >= 8
    for e in tracked:
        assert abs(e.position[2] / positions[e.frame][2] - 1) < 0.05
        assert abs(e.position[0] - positions[e.frame][0]) < 0.1
    for e in estimates[: -len(tracked)]:
        assert e.status == "coasting" and e.reason.startswith("the start is in doubt")
    assert tracked[0].reason == "the start was off: the model fits better here"


def test_without_probation_the_same_start_is_not_put_right(short_clip):
    images, positions = short_clip
    begun = begin(positions[0], off=(0.0, 0.0), size=0.7, configuration=FollowConfiguration(probation=False))
    ranges, _ = errors(follow(begun, images), positions)
    assert np.abs(ranges).min() > 0.1


def film_beside_another(frames, shown, others):
    """Frames and positions of a vehicle that is seen where ``shown`` (F,), and of one with most of its lines 0.9 m to
    its left, that is seen where ``others`` (F,)."""
    rng, background, t = np.random.default_rng(0), scenery(0), np.arange(frames) / 15
    positions = np.column_stack([0.9 + 0.1 * np.sin(1.6 * t), np.full(frames, 0.2), 9 + 0.5 * np.sin(1.4 * t)])
    beside = np.column_stack([positions[:, :2] - [0.9, 0.0], np.full(frames, 10.5)])
    far = np.array([0.0, 0.0, 5000.0])
    images = []
    for k in range(frames):
        shift = (10 * np.sin(1.5 * t[k]), 0.0)
        behind = beside[k] if others[k] else None
        images.append(draw(positions[k] if shown[k] else far, background, shift, rng, behind=behind))
    return images, positions, beside


def is_right(estimates, positions):
    """(F,): whether the target is tracked where it is."""
    return np.array([e.status == "tracking" and abs(e.position[0] - positions[e.frame][0]) < 0.1 for e in estimates])


@pytest.mark.slow
def test_what_covers_part_of_a_target_is_not_taken_for_it():
    """It shows more of the model than that does now, and as much as that ever did; but it was not there before."""
    frames, comes = 80, 20
    images, positions, beside = film_beside_another(frames, np.arange(frames) >= comes, np.ones(frames, bool))
    estimates = follow(begin(beside[0]), images)
    right = is_right(estimates, beside)
    assert right[:comes].all()
    assert all(right[k] or estimates[k].status != "tracking" for k in range(comes, frames))
    assert any(CAME in e.reason for e in estimates[comes:])


@pytest.mark.parametrize(("off", "size"), slow_after(0, [((-25.0, 10.0), 0.85), ((0.0, 0.0), 0.7)]))
def test_a_start_that_was_put_right_is_not_held_against_the_target(off, size):
    """Nor is what was taken for it before: an image is missing right afterwards."""
    images, positions = film(60, seed=0)
    settled = next(e.frame for e in follow(begin(positions[0], off=off, size=size), images) if e.status == "tracking")
    images[settled + 2] = None
    estimates = follow(begin(positions[0], off=off, size=size), images)
    assert is_right(estimates[settled + 8 :], positions).all()


@pytest.mark.slow
def test_where_the_target_was_before_the_time_jumped_is_not_held_against_it():
    images, positions = (np.concatenate(parts) for parts in zip(film(40), film(40, beside=1.0), strict=True))
    k = np.arange(80)
    estimates = follow(begin(positions[0]), list(images), k / 15 + 3.0 * (k >= 40))
    assert is_right(estimates[:40], positions).all() and is_right(estimates[60:], positions).all()


@pytest.mark.slow
def test_whoever_appears_where_the_target_was_hidden_is_not_taken_for_it():
    k, hidden, comes, back = np.arange(60), 15, 25, 45
    images, positions, _ = film_beside_another(len(k), (k < hidden) | (k >= back), k >= comes)
    estimates = follow(begin(positions[0]), images)
    right = is_right(estimates, positions)
    assert right[:hidden].all() and right[back + 5 :].all()
    assert not any(e.status == "tracking" for e in estimates[hidden:back])


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda image, last: np.zeros_like(image), "black"),
        (lambda image, last: np.full_like(image, 255), "white"),
        (lambda image, last: np.full_like(image, 90), "no contrast"),
        (lambda image, last: last, "frozen"),
        (lambda image, last: None, "could not be read"),
    ],
)
def test_frames_that_show_nothing_are_coasted_over(clip, spoil, reason):
    images, positions = clip
    spoiled = list(images[:20])
    spoiled[10] = spoil(images[10], images[9])
    estimates = follow(begin(positions[0]), spoiled)
    assert estimates[10].status == "coasting" and reason in estimates[10].reason
    assert {e.status for e in estimates[:10] + estimates[11:]} == {"tracking"}
    assert np.isnan(estimates[10].residual) and not estimates[10].weights.any() and not len(estimates[10].points)


def test_a_first_frame_that_shows_nothing_only_delays(clip):
    images, positions = clip
    estimates = follow(begin(positions[0]), [np.zeros_like(images[0]), images[0], *images[1:12]])
    assert estimates[0].status == "coasting" and estimates[-1].status == "tracking"


def test_times_that_jump_are_told_and_survived(clip):
    images, positions = clip
    times = np.arange(len(images)) / 15
    times[20:] += 7.0
    times[30:] -= 3.0
    estimates = follow(begin(positions[0]), images, times)
    assert "jumps" in estimates[20].reason and "jumps" in estimates[30].reason
    assert [e.status for e in estimates].count("tracking") >= len(images) - 2
    assert all(np.isfinite(e.position).all() for e in estimates)


def test_a_clock_that_goes_back_does_not_undo_for_how_long_a_target_was_not_seen(clip):
    images, positions = clip
    black = np.zeros_like(images[0])
    shown = [*images[:15], *(black + k % 2 for k in range(45)), *images[15:25]]
    times = np.arange(len(shown)) / 15
    times[20:] -= 1000.0
    estimates = follow(begin(positions[0]), shown, times)
    assert [e.status for e in estimates[15:60]].count("lost") > 10
    assert estimates[60].status == "lost" and "waiting to be sure" in estimates[60].reason
    assert next(e.reason for e in estimates[60:] if e.status == "tracking").startswith("reacquired after 3.")


def test_after_a_start_in_doubt_its_snapshot_is_of_the_first_image():
    images, positions = film(12, seed=1, bounce=3.0)
    tracker = begin(positions[0], off=(12, 0), size=1.0)
    estimates = follow(tracker, images)
    assert estimates[0].status == "coasting" and estimates[-1].status == "tracking"
    snapshot = tracker.lock.recogniser._memory._last
    there = np.array([*CAMERA.project(positions[-1]), 10.0 / positions[-1][2]])
    told = snapshot.find(images[-1], there, 1.0)
    assert (np.abs(told - there) / tracker.projection.sizes(there[2]) < [0.02, 0.02, 0.02]).all()
    snapshot.find(images[0], tracker.probation.first, 1.0)
    assert snapshot._carried.likeness > 0.999


@pytest.mark.parametrize("seed", slow_after(1, range(4)))
def test_in_dim_light_lines_and_snapshot_together_tell_the_range(seed):
    """Lines of 2 to 5 grey levels in noise of 2, which show by a third: from a hand that is 2 % off."""
    images, positions = film(seed=seed, bounce=2.0)
    rng = np.random.default_rng(100 + seed)
    dim = [np.clip(np.rint(6 + 0.06 * im + rng.normal(0, 2.0, im.shape)), 0, 255).astype(np.uint8) for im in images]
    estimates = follow(begin(positions[0], size=1.02), dim)
    tracking = np.array([e.status == "tracking" for e in estimates])
    assert tracking.mean() > 0.8
    ranges, _ = errors(estimates, positions)
    stated = np.array([e.position_std[2] for e in estimates]) / positions[:, 2]
    assert np.sqrt((ranges[tracking] ** 2).mean()) < 0.015
    assert (np.abs(ranges) < 1.96 * stated)[tracking].mean() > 0.9


def test_a_hands_error_is_in_the_interval_of_what_its_picture_tells(clip, monkeypatch):
    """Held by the picture alone the range is no surer than a hand; weighed with lines it has the picture's share."""
    images, tracker = clip[0], followed(clip)
    recogniser = tracker.lock.recogniser
    monkeypatch.setattr(recogniser, "_conflicts", lambda look, place: False)
    tracker.lock.predict(20 / 15)
    bare = tracker.lock.look(images[20], False).fit

    def spread(apart, lasting):
        recogniser._memory._last = SimpleNamespace(
            compare=lambda image, place, expected, tau, sure: place.copy(),
            is_old=lambda scale: False,
            is_apart=lambda place, found: apart,
            lasting=np.full(3, lasting),
        )
        fit = tracker.lock.look(images[20], False).fit
        return np.sqrt(fit.covariance[2, 2]) / fit.location[2]

    assert spread(True, 0.03) == pytest.approx(np.hypot(RIGHT[2], 0.03))
    own = np.sqrt(bare.covariance[2, 2]) / bare.location[2]
    both = 1 / np.hypot(1 / own, 1 / RIGHT[2])
    assert spread(False, 0.0) == pytest.approx(both, rel=0.05)
    assert spread(False, 0.03) == pytest.approx(np.hypot(both, 0.03 * (both / RIGHT[2]) ** 2), rel=0.1)


@pytest.mark.slow
def test_what_was_learned_long_ago_and_is_not_believed_changes_nothing(monkeypatch):
    """Another place is looked at and refused: what is learned is the place that is believed."""
    images, positions = film(40, seed=2)
    plain, asked = begin(positions[0]), begin(positions[0])
    follow(plain, images)
    recogniser = asked.lock.recogniser

    def elsewhere(location, appearance):
        place = location + [4.0, 0.0, 0.0]
        return SimpleNamespace(location=place, doubt=np.array([1.0, 1.0, 0.01]))

    monkeypatch.setattr(recogniser._search, "went_from", elsewhere)
    monkeypatch.setattr(recogniser, "_as_good", lambda back, look: False)
    follow(asked, images)
    for name in ("_picture", "_keepsake", "signed"):
        np.testing.assert_array_equal(*(getattr(t.lock.recogniser.appearance, name) for t in (plain, asked)))


@pytest.mark.parametrize(("back", "believed"), [(0.38, True), (0.34, False), (0.26, False)])
def test_a_lock_is_not_put_back_to_where_much_is_hidden(clip, back, believed):
    """A part of the target looks as the whole did, farther off; where the lock is, 0.4 of the model shows, and 0.5
    does so usually."""
    images, tracker = clip[0], followed(clip)
    recogniser = tracker.lock.recogniser
    tracker.lock.predict(20 / 15)
    look = tracker.lock.look(images[20], False)
    recogniser.appearance.match = 0.5

    def showing(match):
        return replace(look, measurement=replace(look.measurement, match=match))

    assert recogniser._as_good(showing(back), showing(0.4)) == believed
    assert not recogniser._as_good(showing(0.3), showing(0.3))  # of both much is hidden


def test_a_learned_width_is_no_truer_for_a_target_that_is_tall():
    tall = Target("lorry", 10.0, CORNERS * [0.8, 1.8], TARGET.segments, 0.04)
    tracker = FollowTracker(CAMERA, tall, (127.5, 120.5, 0.7))
    estimate = tracker.update(np.full((242, 256), 90, np.uint8), 0.0, 0)
    z = estimate.position[2]
    assert estimate.position_std[2] >= 0.04 * z / 1.6
    assert estimate.position_std[2] == pytest.approx(np.hypot(0.04 * z / 1.6, 0.015 * z), rel=0.05)


@pytest.mark.parametrize("greys", slow_after(1, [((220, 50),), ((50, 220),)]))
def test_a_target_whose_lamps_are_switched_is_followed(greys, monkeypatch):
    lamps = [(-0.9, -0.3, -0.6, 0.0), (0.6, -0.3, 0.9, 0.0)]
    body = [((-1, -0.6, 1, 0.6), 160), ((-1, 0.3, 1, 0.6), 80), ((-0.4, -0.2, 0.4, 0.1), 190)]
    boxes = [*lamps, body[0][0]]
    corners = np.array([[x, y] for x0, y0, x1, y1 in boxes for x, y in [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]])
    ring, others = np.array([[0, 1], [1, 2], [2, 3], [3, 0]]), [[8, 11], [9, 10], [12, 13]]
    target = Target("saloon", 10.0, np.vstack([corners, [[-1, 0.3], [1, 0.3]]]), np.vstack([ring, ring + 4, others]))
    rng, wall, images = np.random.default_rng(3), np.full((600, 1600), 130.0), []
    positions = np.array([[0.3 * np.sin(0.2 * k), 0.2, 9.0] for k in range(24)])
    for k, position in enumerate(positions):
        monkeypatch.setattr(f"{__name__}.FACES", [*body, *((lamp, greys[k >= 8]) for lamp in lamps)])
        images.append(draw(position, wall, (0.0, 0.0), rng))
    tracker = FollowTracker(CAMERA, target, (*CAMERA.project(positions[0]), 10.0 / 9.0))
    estimates = follow(tracker, images)
    assert [e.status for e in estimates] == ["tracking"] * 24
    off, aside = errors(estimates, positions)
    assert np.abs(off).max() < 0.03 and np.abs(aside).max() < 0.05


@pytest.mark.parametrize("seed", slow_after(0, [0, 1]))
def test_a_light_lorry_before_the_sky_is_followed_while_shadows_dance_over_it(seed, monkeypatch):
    """Where it is shaded it is darker than the sky, not brighter: its outline has the other sign, and it looks
    otherwise. But all of its lines are where they were."""
    ribs = [(x, y) for x in (-0.5, 0.0, 0.5) for y in (-1.0, 0.75)]
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), *ribs, (-1, 0.75), (1, 0.75)], float)
    segments = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [6, 7], [8, 9], [10, 11]])
    target, rng = Target("lorry", 10.0, corners, segments), np.random.default_rng(seed)
    lorry = [((-1, -1, 1, 0.75), 210), ((-1, 0.75, 1, 1), 50)]
    lorry += [((x - 0.03, -1, x + 0.03, 0.75), 170) for x in (-0.5, 0.0, 0.5)]
    behind, images, t = np.full((600, 1600), 160.0), [], np.arange(60) / 15
    behind[300:] = 90.0
    height = -0.3 + rng.normal(0, 0.06, 60)
    positions = np.column_stack([0.5 * np.sin(1.1 * t), height, 11 + 2 * np.sin(1.3 * t)])
    for k, position in enumerate(positions):
        edge = rng.uniform(-1.0, 1.4) if 15 <= k < 50 else -1.0
        shaded = [((x0, y0, min(x1, edge), y1), 0.3 * grey) for (x0, y0, x1, y1), grey in lorry if x0 < edge]
        monkeypatch.setattr(f"{__name__}.FACES", [*lorry, *shaded])
        images.append(draw(position, behind, (0.0, 0.0), rng))
    tracker = FollowTracker(CAMERA, target, (*CAMERA.project(positions[0]), 10.0 / positions[0][2]))
    estimates = follow(tracker, images)
    assert {e.status for e in estimates} == {"tracking"}
    off, aside = errors(estimates, positions)
    assert np.abs(off).max() < 0.04 and np.abs(aside).max() < 0.1


def test_a_frame_of_another_size_is_refused_in_one_line(clip):
    images, positions = clip
    tracker = begin(positions[0])
    tracker.update(images[0], 0.0, 0)
    with pytest.raises(UnusableInput, match="frame 7: expected a grey image of 256×242 bytes, found 200×242 of uint8"):
        tracker.update(np.ascontiguousarray(images[1][:, :200]), 0.1, 7)


@pytest.mark.parametrize(
    ("center", "scale", "message"),
    [
        ([-1.0, 50.0], 1.0, "center"),
        ([50.0, 242.0], 1.0, "center"),
        ([50.0, 50.0], 0.0, "scale"),
        ([50.0, 50.0], np.nan, "scale"),
    ],
)
def test_a_start_that_cannot_be_is_refused(center, scale, message):
    with pytest.raises(ValueError, match=message):
        FollowTracker(CAMERA, TARGET, (*center, scale))


def test_a_frame_of_another_kind_or_without_a_time_changes_nothing(clip):
    """A live loop may catch the error and go on."""
    images, positions = clip
    spoilt, kept = begin(positions[0]), begin(positions[0])
    for k, image in enumerate(images[:4]):
        with pytest.raises(UnusableInput, match=f"frame {k}: expected its time in seconds, found nan"):
            spoilt.update(image, float("nan"), k)
        with pytest.raises(UnusableInput, match=f"frame {k}: .* found 256×242×3 of uint8"):
            spoilt.update(np.repeat(image[..., None], 3, axis=2), k / 15, k)
        expected = kept.update(image, k / 15, k).position
        np.testing.assert_array_equal(spoilt.update(image, k / 15, k).position, expected)


def test_as_published_a_smooth_ride_is_followed():
    images, positions = film(30, seed=5, bounce=0.0)
    estimates = follow(begin(positions[0], configuration=FollowConfiguration.as_published()), images)
    tracked = [e for e in estimates if e.status == "tracking"]
    assert len(tracked) >= 25
    ranges, _ = errors(tracked, positions[[e.frame for e in tracked]])
    assert np.median(np.abs(ranges)) < 0.03


def test_as_published_a_bump_loses_what_the_wide_search_keeps():
    images, positions = film(30, seed=6, bounce=4.0)
    shares = []
    for configuration in (FollowConfiguration(), FollowConfiguration.as_published()):
        estimates = follow(begin(positions[0], configuration=configuration), images)
        ranges, lateral = errors(estimates, positions)
        good = [e.status == "tracking" and abs(r) < 0.05 for e, r in zip(estimates, ranges, strict=True)]
        shares.append(np.mean(good))
    assert shares[0] > 0.9 and shares[1] < 0.7


def test_a_pose_steers_along_the_path(clip):
    images, positions = clip
    tracker = begin(positions[0])
    for k in range(10):
        estimate = tracker.update(images[k], k / 15, k, Pose(0.5 * k, 0.0, 0.0))
    assert np.isfinite(estimate.steering)
    assert len(tracker.steering.path) >= 5


@pytest.mark.slow
def test_memory_is_flat(clip):
    images, positions = clip
    tracker = begin(positions[0])
    order = [*range(45), *range(43, 0, -1)]
    for k in range(88):
        tracker.update(images[order[k % 88]], k / 15, k)
    tracemalloc.start()
    for k in range(88, 176):
        tracker.update(images[order[k % 88]], k / 15, k)
    gc.collect()  # what is free already, but not yet given back, is not counted
    first = tracemalloc.get_traced_memory()[0]
    for k in range(176, 528):
        tracker.update(images[order[k % 88]], k / 15, k)
    gc.collect()
    grown = tracemalloc.get_traced_memory()[0] - first
    tracemalloc.stop()
    assert grown < 5_000


def test_after_the_warm_up_nothing_is_left_to_compile(clip):
    warm_up()
    kernels = {
        f"{room.__name__}.{name}": value
        for room in (association, candidates, edges_cpu, fitting, motion, picture_cpu, search_cpu)
        for name, value in vars(room).items()
        if hasattr(value, "signatures")
    }
    before = {name: len(kernel.signatures) for name, kernel in kernels.items()}
    assert before["paceline.follow.search_cpu.scan"] == 1
    images, positions = clip
    follow(begin(positions[0]), images[:10])
    follow(begin(positions[0], configuration=FollowConfiguration.as_published()), images[:10])
    assert {name: len(kernel.signatures) for name, kernel in kernels.items()} == before


def test_a_model_of_doubtful_width_has_wide_ranges() -> None:
    """Of a width known to 3 % the range is known to 3 % at best, wherever its lines are found."""
    doubtful = Target(TARGET.name, TARGET.nominal_range, TARGET.corners, TARGET.segments, tolerance=0.06)
    image = draw((0.1, 0.2, 9.0), scenery(1), (0, 0), np.random.default_rng(1))
    sure, unsure = (
        FollowTracker(CAMERA, target, (127.5 + 300 * 0.1 / 9, 120.5 + 300 * 0.2 / 9, 10 / 9)).update(image, 0.0, 0)
        for target in (TARGET, doubtful)
    )
    assert sure.status == unsure.status == "tracking"
    np.testing.assert_array_equal(sure.position, unsure.position)
    more = (0.06**2 - 0.01**2) * (sure.position[2] / 2.0) ** 2
    assert unsure.position_std[2] ** 2 == pytest.approx(sure.position_std[2] ** 2 + more, rel=1e-6)
    with pytest.raises(ValueError, match="tolerance: expected metres"):
        Target("x", 10.0, TARGET.corners, TARGET.segments, tolerance=-1.0)


@pytest.mark.parametrize(
    ("narrow", "wide", "complaint", "likeness", "taken"),
    [
        (0.6, 0.9, "", (0.8, 0.82), True),
        (0.6, 0.9, "it is not it", (0.8, 0.82), False),
        (0.6, 0.9, "", (0.9, 0.88), False),  # as on other ribs of a lorry that is half hidden
        (0.6, 0.63, "", (0.8, 0.82), False),
        (0.95, 1.2, "", (0.8, 0.82), False),
    ],
)
def test_where_less_shows_than_usual_lines_are_looked_for_farther_away(
    clip, monkeypatch, narrow, wide, complaint, likeness, taken
):
    """As shares of the usual match; what adds little, or is not the target or less alike, is not taken."""
    images, tracker = clip[0], followed(clip)
    recogniser, there = tracker.lock.recogniser, tracker.lock.expected
    usual, near = recogniser.appearance.match, np.array([1.0, 1.0, 0.01])
    looks = {
        reach: recognition.Look(said, inside=1.0, measurement=SimpleNamespace(match=share * usual))
        for reach, share, said in ((1.0, narrow, ""), (recognition.WIDER, wide, complaint))
    }
    monkeypatch.setattr(recogniser, "_measured_with", lambda signs, image, start, near, *rest: looks[near[0]])
    monkeypatch.setattr(recogniser, "_thought_of", lambda measurement, image, start, near, *rest: looks[near[0]])
    measure = SimpleNamespace(measure=lambda image, start, near, *rest: (looks[near[0]].measurement, (0, 0, 0, 0)))
    monkeypatch.setattr(recogniser, "_measurer", measure)
    told = list(likeness)
    monkeypatch.setattr(recogniser.appearance, "likeness", lambda: told.pop(0))
    look = recogniser._measured(images[20], there, near, Foreseen(there, near))
    assert look is looks[recognition.WIDER if taken else 1.0]


@pytest.mark.parametrize(
    ("said", "shows", "other", "support", "likeness", "taken"),
    [
        (UNLIKE, 0.7, 0.9, 0.9, 0.5, True),
        (APART, 0.7, 0.9, 0.9, 0.5, True),
        (UNSIZED, 0.7, 0.9, 0.9, 0.5, False),
        (UNLIKE, 0.7, 0.9, 0.8, 0.5, False),  # a part of it is hidden, as by what has edges there
        (UNLIKE, 0.7, 0.9, 0.9, 0.4, False),  # it is another
        (UNLIKE, 0.7, 0.75, 0.9, 0.5, False),
    ],
)
def test_lines_of_either_sign_are_believed_where_nearly_all_show_and_clearly_more(
    clip, monkeypatch, said, shows, other, support, likeness, taken
):
    """Where something is complained of that has the signs of late; the likeness there is 0.5."""
    images, tracker = clip[0], followed(clip)
    recogniser, there = tracker.lock.recogniser, tracker.lock.expected
    near = np.array([1.0, 1.0, 0.01])
    signed, either = (
        recognition.Look(
            what,
            inside=1.0,
            measurement=SimpleNamespace(match=match, support=support),
            fit=SimpleNamespace(location=there),
        )
        for what, match in ((said, shows), ("", other))
    )
    told = iter([0.5, likeness])
    monkeypatch.setattr(recogniser.appearance, "likeness", lambda: next(told))
    monkeypatch.setattr(recogniser, "_usual_share", lambda measurement: 1.0)
    monkeypatch.setattr(recogniser, "_measured_with", lambda *given: signed)
    monkeypatch.setattr(recogniser, "_thought_of", lambda *given: either)
    asked = []
    measure = lambda *given: (asked.append(given[3]), (either.measurement, (0, 0, 0, 0)))[1]  # noqa: E731
    monkeypatch.setattr(recogniser, "_measurer", SimpleNamespace(measure=measure))
    assert recogniser._measured(images[20], there, near, Foreseen(there, near)) is (either if taken else signed)
    assert not any(signs.any() for signs in asked)


@pytest.mark.parametrize(
    ("share", "beside", "complaint", "likeness", "tau", "taken"),
    [
        (0.5, 0.8, "", (0.7, 0.75), 1.0, True),
        (0.5, 0.8, "it is not it", (0.7, 0.75), 1.0, False),
        (0.5, 0.8, "", (0.6, 0.65), 1.0, False),  # there is another vehicle
        (0.5, 0.8, "", (0.9, 0.75), 1.0, False),  # or what stands before half of it
        (0.5, 0.8, "", (0.7, 0.75), 5.0, False),  # or its twin, while it was hidden
        (0.5, 0.53, "", (0.7, 0.75), 1.0, False),
        (0.9, 1.0, "", (0.7, 0.75), 1.0, False),
    ],
)
def test_where_lamps_are_switched_the_model_may_be_where_the_search_saw_it_less_well(
    clip, monkeypatch, share, beside, complaint, likeness, tau, taken
):
    """As shares of the usual match, at the best place and at another one a size aside."""
    images, tracker = clip[0], followed(clip)
    recogniser, there = tracker.lock.recogniser, tracker.lock.expected
    usual, other = recogniser.appearance.match, there + [recogniser.projection.size(there[2]), 0.0, 0.0]
    here, found = (
        recognition.Look(
            said, inside=1.0, measurement=SimpleNamespace(match=s * usual), fit=SimpleNamespace(location=x)
        )
        for s, said, x in ((share, "", there), (beside, complaint, other))
    )
    asked, told = [], list(likeness)

    def measure(image, start, near, signs, aspect):
        asked.append((start, signs))
        return found.measurement, (0, 0, 0, 0)

    monkeypatch.setattr(recogniser, "_measurer", SimpleNamespace(measure=measure))
    monkeypatch.setattr(recogniser, "_thought_of", lambda *given: found)
    monkeypatch.setattr(recogniser.appearance, "likeness", lambda: told.pop(0))
    sighting = Sighting(there, np.ones(3), (0, 0, 256, 242), 0.8, (other,))
    foreseen = Foreseen(there, np.ones(3), tau)
    look = recogniser._or_elsewhere(here, sighting, images[20], foreseen)
    assert look is (found if taken else here)
    for start, signs in asked:
        np.testing.assert_allclose(start, other)
        assert not signs.any()


def test_half_a_target_is_believed_where_it_was_foreseen_and_not_aside(clip):
    """What covers the lead from one side draws a lock onto itself at once; after a while it may have driven there."""
    images, tracker = clip[0], followed(clip)
    projection, look = tracker.projection, tracker.lock.look_here(images[19])
    found = Found(look.measurement, look.fit, picture=0.75, shows=0.75, proven=True)

    def complaint(sizes, tau, continuity=True):
        aside = [sizes * projection.size(look.fit.location[2]), 0.0, 0.0]
        foreseen = Foreseen(look.fit.location + aside, tracker.lock.doubt, tau)
        return judged(found, foreseen, projection, FollowConfiguration(continuity=continuity)).complaint

    assert [complaint(sizes, 1.0) for sizes in (-0.3, 0.0, 0.3)] == [UNLIKE, "", UNLIKE]
    assert [complaint(sizes, 10.0) for sizes in (-0.3, 0.0, 0.3)] == ["", "", ""]
    assert complaint(0.3, 1.0, continuity=False) == ""


def test_a_target_is_held_where_a_snapshot_gainsays_its_features(clip, monkeypatch):
    """In dim light, where the search sees nothing well."""
    images, tracker = clip[0], followed(clip)
    recogniser = tracker.lock.recogniser
    aside = recogniser.projection.size(1.0) * np.array([0.3, 0.0, 0.0])
    monkeypatch.setattr(recogniser, "_conflicts", lambda look, place: False)
    recogniser._memory._last = SimpleNamespace(
        compare=lambda image, place, expected, tau, sure: expected + aside,
        is_old=lambda scale: False,
        is_apart=lambda place, found: True,
        lasting=np.zeros(3),
    )
    tracker.lock.predict(20 / 15)
    look = tracker.lock.look(images[20], False)
    assert look.note.endswith(recognition.ASTRAY) and not look.complaint and look.measurement is None
    np.testing.assert_allclose(look.fit.location, tracker.lock.expected + aside)
    recogniser._memory._last.is_apart = lambda place, found: False
    assert tracker.lock.look(images[20], False).measurement is not None


@pytest.mark.parametrize(
    ("grown", "tau", "held"), [(0.88, 1.0, True), (0.88, 5.0, False), (0.92, 5.0, True), (1.12, 5.0, True)]
)
def test_a_target_that_was_gone_is_not_found_again_by_a_picture_alone_and_smaller(clip, monkeypatch, grown, tau, held):
    """Where a car has come before the lower half of a lorry the two look as a whole lorry farther off."""
    images, tracker = clip[0], followed(clip)
    recogniser = tracker.lock.recogniser
    recogniser._memory._last = SimpleNamespace(
        find=lambda image, expected, tau: expected * [1.0, 1.0, grown], lasting=np.zeros(3)
    )
    monkeypatch.setattr(recogniser, "_found", lambda *given: recognition.Look(UNLIKE))
    look = recogniser.look(images[20], tracker.lock.expected, tracker.lock.doubt, tau, False)
    assert look.complaint == ("" if held else UNLIKE)


@pytest.mark.parametrize("match", [0.2, 0.5])
def test_a_target_of_which_hardly_a_line_shows_does_not_show_well(clip, monkeypatch, match):
    """All that usually shows of it may be there, and yet be so little that it is a matter of chance."""
    images, tracker = clip[0], followed(clip)
    recogniser, told = tracker.lock.recogniser, []
    found = recogniser._found

    def dimmed(*given):
        look = found(*given)
        return replace(look, measurement=replace(look.measurement, match=match), sure=True)

    monkeypatch.setattr(recogniser, "_found", dimmed)
    recogniser._memory._last = SimpleNamespace(compare=lambda image, place, expected, tau, sure: told.append(sure))
    tracker.lock.predict(20 / 15)
    tracker.lock.look(images[20], False)
    assert told == [match >= recognition.BY_CHANCE]


def test_a_target_whose_lines_do_not_tell_its_size_is_held_by_its_picture(clip, monkeypatch):
    images, tracker = clip[0], followed(clip)
    recogniser, there = tracker.lock.recogniser, tracker.lock.expected.copy()
    recogniser._memory._last = None
    monkeypatch.setattr(recognition, "judged", lambda *given: Verdict(UNSIZED, False, False))
    tracker.lock.predict(20 / 15)
    look = tracker.lock.look(images[20], False)
    assert look.note.endswith(UNSIZED) and not look.complaint and look.measurement is None
    assert recogniser.projection.size(there[2]) * 0.2 > np.abs(look.fit.location - tracker.lock.expected)[:2].max()
    recogniser._proven = recognition.PROVEN - 1  # as long as its features have hardly shown it
    assert tracker.lock.look(images[20], False).complaint == UNSIZED


def test_a_snapshot_does_not_gainsay_what_the_search_sees_well(clip):
    """One that tells another place, for sure and unasked, moves nothing while the target shows well."""
    images, positions = clip
    trackers = begin(positions[0]), begin(positions[0])
    for k in range(20):
        for tracker in trackers:
            tracker.update(images[k], k / 15, k)
    recogniser = trackers[1].lock.recogniser
    astray = recogniser.projection.size(1.0) * np.array([0.3, 0.0, 0.0])
    recogniser._memory._last = SimpleNamespace(
        compare=lambda image, place, expected, tau, sure: place + astray,
        find=lambda image, expected, tau: expected + astray,
        is_old=lambda scale: False,
        is_apart=lambda place, found: True,
        lasting=np.zeros(3),
    )
    for k in range(20, 40):
        told, gainsaid = (tracker.update(images[k], k / 15, k) for tracker in trackers)
        assert gainsaid.status == told.status == "tracking"
        np.testing.assert_allclose(gainsaid.position, told.position, rtol=0.01, atol=0.02)
