"""What is found after a while is the target only where that can have driven there."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from paceline.follow.pace import AFTER, FASTER, HARD, OFF, PAUSE, WATCHED, Pace, needed
from paceline.recordings.odometry import Pose

RATE = 15  # images a second


def least_acceleration(ahead, faster, lasting, steps=200):
    """The same by a linear programme over accelerations that are constant for a short time each."""
    dt = lasting / steps
    until = lasting - (np.arange(steps) + 0.5) * dt  # from the middle of each to the end
    ends = np.column_stack([np.vstack([until * dt, np.full(steps, dt)]), np.zeros(2)])
    bounds = np.vstack([np.eye(steps), -np.eye(steps)])
    found = linprog(
        [*np.zeros(steps), 1.0],
        A_ub=np.column_stack([bounds, -np.ones(2 * steps)]),
        b_ub=np.zeros(2 * steps),
        A_eq=ends,
        b_eq=[ahead, faster],
        bounds=[(None, None)] * steps + [(0, None)],
    )
    return found.fun, found.x[:steps] * dt


@settings(max_examples=25, deadline=None)
@given(st.floats(-15, 15), st.floats(-8, 8), st.floats(1.0, 4.0))
def test_no_acceleration_is_needed_beyond_the_least_there_is(ahead, faster, lasting):
    acceleration, back = needed(ahead, faster, lasting)
    least, changes = least_acceleration(ahead, faster, lasting)
    assert acceleration == pytest.approx(least, rel=0.02, abs=0.02)
    # of the two signs there are the one comes first; what the other changes the speed by is what is told
    first = np.sign(2.0 * ahead - lasting * faster) or 1.0
    later = np.abs(changes[np.sign(changes) == -first]).sum()
    assert back == pytest.approx(later, rel=0.1, abs=0.1 + 0.02 * acceleration * lasting)


class Ride:
    """A chase vehicle at 10 m/s, which brakes by ``braking`` m/s² once its target is hidden after 2 s."""

    def __init__(self, braking=2.0, poses=True, noise=0.0, seed=0):
        self.pace, self.time, self.way, self.braking = Pace(), 0.0, 0.0, braking
        self._poses, self._noise, self._rng = poses, noise, np.random.default_rng(seed)
        self._speed, self.target = 10.0, 18.0
        for _ in range(2 * RATE):
            self.go()
            self.pace.learn(self.time, self.measured(self.target))

    def measured(self, place):
        return (place - self.way) * (1.0 + self._noise * self._rng.standard_normal())

    def go(self, braking=0.0, speed=10.0):
        self.time += 1 / RATE
        self._speed = max(self._speed - braking / RATE, 0.0)
        self.way += self._speed / RATE
        self.target += speed / RATE
        self.pace.move(Pose(0.6 * self.way, -0.8 * self.way, 0.3) if self._poses else None)

    def hide(self, seconds, speeds=10.0):
        n = round(seconds * RATE)
        for speed in np.broadcast_to(speeds, n):
            self.go(self.braking, speed)

    def find(self, seconds, behind=0.0, speed=10.0):
        """What is said to that which drives ``behind`` the target, in every image."""
        said = []
        for _ in range(round(seconds * RATE)):
            self.go(self.braking, speed)
            said.append(self.pace.complains(self.time, self.measured(self.target - behind)))
        return said


@pytest.mark.parametrize("poses", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_a_target_that_drives_on_is_believed_at_once(poses, seed):
    ride = Ride(poses=poses, noise=0.005, seed=seed)
    ride.hide(2.0)
    assert not any(ride.find(1.0))


@pytest.mark.parametrize("seconds", [1.5, 2.0, 3.0])
def test_a_vehicle_that_was_always_nearer_is_not(seconds):
    """As one that has come between, and looks like it: a target would have had to brake and to regain its speed, both
    by 3 m/s² and more, even if distances were 6 % wrong and speeds 1 m/s."""
    ride = Ride(noise=0.005)
    ride.hide(seconds)
    behind = 0.25 * HARD * seconds**2 + 0.5 * FASTER * seconds + 1.5 * OFF * (ride.target - ride.way)
    assert all(ride.find(2.0, behind=1.3 * behind))


def test_nor_after_it_was_not_seen_for_a_moment_but_the_target_is():
    ride = Ride(noise=0.005)
    ride.hide(1.8)
    ride.find(1.0, behind=8.0)
    ride.hide(0.6 * AFTER)
    assert all(ride.find(1.0, behind=8.0))
    assert not any(ride.find(1.0))


@pytest.mark.parametrize("braking", [3.0, 6.0])
def test_a_target_that_has_braked_is_believed_after_half_a_second(braking):
    ride = Ride(braking=braking, noise=0.003)
    speeds = np.maximum(10.0 - braking * np.arange(1, 1 + round(1.4 * RATE)) / RATE, 0.0)
    ride.hide(1.4, speeds)
    awaited = int(np.ceil(WATCHED * RATE))
    assert ride.find(1.0, speed=speeds[-1]) == [True] * awaited + [False] * (RATE - awaited)


@pytest.mark.parametrize("seconds", [0.7, 1.0])
@pytest.mark.parametrize("wrong", [-3.0, 3.5])
@pytest.mark.parametrize(("before", "after", "refused"), [(0, 1, 5), (3, 1, 6), (3, 3, 12), (0, 4, 15)])
def test_sights_that_are_metres_wrong_keep_nobody_from_being_believed(wrong, seconds, before, after, refused):
    """Half hidden by what passes in between a target looks as the whole farther off, or nearer: at last ``before`` it
    is hidden, and at first ``acceleration_start``, where it comes out again."""
    ride = Ride(noise=0.003)
    for _ in range(before):
        ride.go()
        ride.pace.learn(ride.time, ride.measured(ride.target + 0.5 * wrong))
    ride.hide(seconds)
    assert not any([*ride.find(after / RATE, behind=-wrong), *ride.find(2.0)][refused:])


def test_nothing_is_asked_that_was_seen_a_moment_ago_or_for_a_moment_only():
    ride = Ride()
    ride.hide(0.8 * PAUSE)
    assert not any(ride.find(0.1, behind=6.0))
    new = Pace()
    new.learn(0.0, 18.0)
    assert not any(new.complains(2.0 + k / RATE, 10.0) for k in range(RATE))


@pytest.mark.parametrize("every", [0.1, 0.25, 1.0])
def test_what_is_seen_seldom_is_awaited_but_not_for_ever(every):
    """A target that has braked, in images so many seconds apart: where they are too few, nothing is asked."""
    pace, said = Pace(), []
    for time in np.arange(-2.0, 4.0, every):
        place = 10.0 * time if time < 0 else 10.0 * time - 3.0 * min(time, 1.5) ** 2 - 9.0 * max(time - 1.5, 0.0)
        if time < 0:
            pace.learn(time, 18.0 + place)
        elif time > 1.2:
            said.append(pace.complains(time, 18.0 + place))
    assert not any(said[round(0.8 / every) :])


def test_nothing_grows():
    ride = Ride()
    ride.hide(2.0)
    ride.find(60.0, behind=8.0)
    assert max(len(ride.pace._seen), len(ride.pace._found), len(ride.pace._latest)) <= 2 * RATE
