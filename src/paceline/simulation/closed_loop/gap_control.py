"""Throttle and brake from the tracker's estimates: a filter of the lead's motion, and a time headway policy.

The control law is the constant time headway policy of Ioannou and Chien, "Autonomous intelligent cruise control"
(1993): with the gap's error e the acceleration is (lead's speed − own + λ e) / headway. Part of the lead's own
acceleration is added, and braking where the stopping distances of both require it. A lead that is not tracked is
assumed to brake.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array

LEAD_ACCELERATION_STD_MPS2 = 2.0  # m/s², standard deviation of the lead's acceleration
LEAD_ACCELERATION_TIME_S = 1.0  # s over which it is correlated (Singer's model)
MAX_UNTRACKED_S = 0.35  # s for which an unseen lead is taken to go on as it did
MIN_CONFIRMING_FRAMES = 4  # measurements in a row that must agree before a lead that was lost for longer is accepted
MAX_CONFIRMING_GAP_CHANGE = 0.1  # relative change of the gap within which they agree
RESTART_UNSEEN_S = 1.0  # s unseen, after which what is found may be anywhere
GATE_SIGMA = 5.0  # standard deviations
UNSEEN_BRAKING_MPS2 = 4.5  # m/s²: after that, it is taken to brake so hard
STANDING_SPEED_MPS = 0.15  # m/s


@dataclass(frozen=True)
class GapPolicy:
    """How to keep the distance, measured from the camera to the lead's rear."""

    standstill: float = 5.5  # m
    headway: float = 0.9  # s
    correction: float = 0.45  # λ, 1/s
    anticipation: float = 0.5  # part of the lead's acceleration that is followed at once
    comfort: float = 3.0  # m/s², the hardest braking in normal driving
    throttle: float = 1.8  # m/s², the strongest acceleration
    top_speed: float = 12.5  # m/s
    margin: float = 1.2  # m, less than the standstill gap, to which emergency braking may let it shrink
    reaction: float = 0.35  # s until brakes act
    lead_braking: float = 6.0  # m/s²: no lead is taken to brake harder

    def desired_gap(self, speed: float) -> float:
        """m, at ``speed`` in m/s."""
        return self.standstill + self.headway * speed


class LeadFilter:
    """A Kalman filter of the gap (m), the lead's speed (m/s) and its acceleration (m/s²)."""

    def __init__(self) -> None:
        self.state: Array | None = None  # (3,)
        self.covariance = np.zeros((3, 3))
        self._time = self._seen = 0.0
        self._last_gap, self._agreeing = 0.0, 0  # the last measured gap, and how many measurements in a row agree

    def update(self, time: float, own_speed: float, gap: float, std: float, tracked: bool) -> Array | None:
        """The state at ``time`` (s) with the ``gap`` measured to ``std`` m if the lead is ``tracked``; None before it
        was ever tracked."""
        if self.state is not None:
            self._predict(time, own_speed)
        self._agreeing = (
            self._agreeing + 1
            if tracked and abs(gap - self._last_gap) < MAX_CONFIRMING_GAP_CHANGE * gap
            else int(tracked)
        )
        self._last_gap = gap
        unseen_s = time - self._seen
        if tracked and (
            self.state is None or (unseen_s > RESTART_UNSEEN_S and self._agreeing >= MIN_CONFIRMING_FRAMES)
        ):
            self.state = np.array([gap, own_speed, 0.0])
            self.covariance = np.diag([std**2, 2.0**2, LEAD_ACCELERATION_STD_MPS2**2])
            self._seen = time
        elif (
            tracked
            and self._inside_gate(gap, std)
            and (unseen_s <= MAX_UNTRACKED_S or self._agreeing >= MIN_CONFIRMING_FRAMES)
        ):
            self._correct(gap, std)
            self._seen = time
        self._time = time
        return self.state

    def _predict(self, time: float, own_speed: float) -> None:
        assert self.state is not None
        dt = time - self._time
        d, v, a = self.state
        if time - self._seen > MAX_UNTRACKED_S:
            a = min(a, -UNSEEN_BRAKING_MPS2)
        later = max(v + a * dt, 0.0)
        decay = np.exp(-dt / LEAD_ACCELERATION_TIME_S)
        self.state = np.array([d + 0.5 * (v + later) * dt - own_speed * dt, later, a * decay])
        F = np.array([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, decay]])
        g = np.array([dt**2 / 2, dt, 1.0])
        self.covariance = F @ self.covariance @ F.T + LEAD_ACCELERATION_STD_MPS2**2 * (1 - decay**2) * np.outer(g, g)

    def _inside_gate(self, gap: float, std: float) -> bool:
        """Whether a vehicle can have moved there: what jumps is something else, and not seen."""
        assert self.state is not None
        return bool(abs(gap - self.state[0]) <= GATE_SIGMA * np.sqrt(self.covariance[0, 0] + std**2))

    def _correct(self, gap: float, std: float) -> None:
        assert self.state is not None
        P = self.covariance
        gain = P[:, 0] / (P[0, 0] + std**2)
        self.state = self.state + gain * (gap - self.state[0])
        self.state[1] = max(self.state[1], 0.0)
        self.covariance = P - np.outer(gain, P[0])


def headway_acceleration(
    policy: GapPolicy, speed: float, gap: float, lead_speed: float, lead_acceleration: float
) -> float:
    """The acceleration (m/s²) that keeps the policy's gap, at the chase vehicle's ``speed``."""
    error = gap - policy.desired_gap(speed)
    desired = (lead_speed - speed + policy.correction * error) / policy.headway
    desired += policy.anticipation * min(max(lead_acceleration, -policy.comfort), 1.0)
    desired = min(desired, policy.throttle, policy.top_speed - speed)
    braking = required_braking(policy, speed, gap, lead_speed, lead_acceleration)
    if braking > policy.comfort:
        return -1.1 * braking
    return max(desired, -policy.comfort)


def required_braking(policy: GapPolicy, speed: float, gap: float, lead_speed: float, lead_acceleration: float) -> float:
    """The constant deceleration (m/s²), begun after the reaction time, that just keeps the policy's least gap to a lead
    that goes on braking as it does; infinite where none does."""
    braking, tau = min(max(-lead_acceleration, 0.0), policy.lead_braking), policy.reaction
    later = max(lead_speed - braking * tau, 0.0)
    moves = lead_speed * tau - braking * tau**2 / 2 if later > 0 else lead_speed**2 / (2 * max(braking, 1e-9))
    available_distance, lead_speed = gap - (policy.standstill - policy.margin) + moves - speed * tau, later
    closing = max(speed - lead_speed, 0.0)
    if available_distance <= 0:
        return np.inf if closing > 0 else braking
    if 2 * available_distance * braking <= closing * lead_speed:  # both are equally fast before the lead stops
        return braking + closing**2 / (2 * available_distance)
    if braking == 0:
        return 0.0
    return speed**2 / (2 * (available_distance + lead_speed**2 / (2 * braking)))


class GapController:
    """Throttle and brake from estimates alone."""

    def __init__(self, policy: GapPolicy) -> None:
        self.policy, self.lead = policy, LeadFilter()

    def acceleration(self, time: float, speed: float, gap: float, std: float, tracked: bool) -> float:
        """m/s², to ask for at ``time``, s: the measured own ``speed``, and the ``gap`` with its ``std``, m."""
        state = self.lead.update(time, speed, gap, std, tracked)
        if state is None:
            return -self.policy.comfort
        command = headway_acceleration(self.policy, speed, *map(float, state))
        resting = speed < STANDING_SPEED_MPS and (
            not tracked or (state[1] < STANDING_SPEED_MPS * 4 and state[0] < self.policy.standstill + 1.0)
        )
        return min(command, -1.0) if resting else command
