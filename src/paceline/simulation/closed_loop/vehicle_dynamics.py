"""The chase vehicle: a bicycle model whose actuators lag and whose body pitches and rolls on its springs.

Steady-state understeer and the axes follow Gillespie, "Fundamentals of Vehicle Dynamics": the turn's radius is
(wheelbase + understeer · speed²) / tan(steering angle). Plan view as in `chase.motion`; steering positive to the right.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from math import ceil

import numpy as np

from paceline.arrays import Array
from paceline.numba_cache import cached_njit

MAX_STEP_S = 0.005  # s, the longest step of the integration


@dataclass(frozen=True)
class VehicleParameters:
    """What the chase vehicle can do; the defaults are those of a HMMWV."""

    wheelbase: float = 3.3  # m
    understeer: float = 0.0025  # s²/m: metres of wheelbase that a speed of 1 m/s adds
    steering_limit: float = 0.6  # rad, of the front wheels
    steering_rate: float = 0.5  # rad/s
    steering_lag: float = 0.12  # s
    acceleration_limit: float = 2.2  # m/s²
    braking_limit: float = 7.0  # m/s²
    throttle_lag: float = 0.35  # s
    brake_lag: float = 0.2  # s
    grip: float = 7.0  # m/s², the greatest lateral acceleration
    nod: float = 0.006  # rad of pitch per m/s² of braking
    lean: float = 0.008  # rad of roll per m/s² of lateral acceleration
    spring: float = 1.4  # Hz, of the body on its springs
    damping: float = 0.35  # of its swing, 1 is critical
    camera_ahead: float = 1.8  # m, of the camera before the rear axle
    nose: float = 4.1  # m, of the front bumper before the rear axle
    tail: float = 0.9  # m, of the rear bumper behind it
    width: float = 2.16  # m


@dataclass(frozen=True)
class VehicleState:
    """The vehicle at one time: its rear axle's middle x, y (m), heading (rad), speed and acceleration, the steering
    angle (rad, to the right), and the body's pitch (nose down) and roll (to the right) with their rates."""

    x: float
    y: float
    heading: float
    speed: float
    acceleration: float = 0.0
    steering: float = 0.0
    pitch: float = 0.0
    pitch_rate: float = 0.0
    roll: float = 0.0
    roll_rate: float = 0.0


@cached_njit()
def state_derivative(s: Array, steering: float, acceleration: float, v: Array) -> Array:
    """The time derivative of a state (10,) under commands, for a vehicle ``v`` (the fields of `VehicleParameters`)."""
    wheelbase, understeer, limit, rate, lag, speed_up, slow_down, throttle_lag, brake_lag, grip = v[:10]
    nod, lean, spring, damping = v[10:14]
    d = np.empty(10)
    speed = max(s[3], 0.0)
    d[0] = speed * np.cos(s[2])
    d[1] = speed * np.sin(s[2])
    lateral = speed * speed * np.tan(s[5]) / (wheelbase + understeer * speed * speed)  # m/s², to the right
    lateral = min(max(lateral, -grip), grip)
    d[2] = -lateral / speed if speed > 1e-6 else 0.0
    d[3] = s[4] if s[3] > 0.0 or s[4] > 0.0 else 0.0
    target = min(max(acceleration, -slow_down), speed_up)
    d[4] = (target - s[4]) / (throttle_lag if target > s[4] and target > 0.0 else brake_lag)
    angle = min(max(steering, -limit), limit)
    d[5] = min(max((angle - s[5]) / lag, -rate), rate)
    omega = 2 * np.pi * spring
    body_acceleration = d[3]  # a standing body no longer nods
    d[6] = s[7]
    d[7] = -2 * damping * omega * s[7] - omega * omega * (s[6] + nod * body_acceleration)
    d[8] = s[9]
    d[9] = -2 * damping * omega * s[9] - omega * omega * (s[8] + lean * lateral)
    return d


@cached_njit()
def integrate(state: Array, steering: float, acceleration: float, vehicle: Array, step: float, steps: int) -> Array:
    """``state`` (10,) after ``steps`` steps of the classical Runge-Kutta method under constant commands."""
    s = state.copy()
    for _ in range(steps):
        k1 = state_derivative(s, steering, acceleration, vehicle)
        k2 = state_derivative(s + 0.5 * step * k1, steering, acceleration, vehicle)
        k3 = state_derivative(s + 0.5 * step * k2, steering, acceleration, vehicle)
        k4 = state_derivative(s + step * k3, steering, acceleration, vehicle)
        s = s + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if s[3] < 0.0:
            s[3] = 0.0  # brakes hold, they do not reverse
    return s


@dataclass(frozen=True)
class Command:
    """What the driver asks for from ``time`` (s) on: steering angle (rad, to the right) and acceleration (m/s²)."""

    time: float
    steering: float
    acceleration: float


class VehicleDynamics:
    """The vehicle in time: `queue` for what shall take effect later, `advance` to a time."""

    def __init__(self, vehicle: VehicleParameters, state: VehicleState, time: float = 0.0) -> None:
        self.vehicle, self.time = vehicle, time
        self._vehicle = np.array(astuple(vehicle)[:14])
        self._state = np.array(astuple(state))
        self._acting = Command(time, state.steering, state.acceleration)
        self._pending: list[Command] = []

    @property
    def state(self) -> VehicleState:
        return VehicleState(*map(float, self._state))

    @property
    def active_command(self) -> Command:
        """The command that acts now."""
        return self._acting

    def queue(self, command: Command) -> None:
        """Commands take effect in the order in which they are given; ValueError for one before the last."""
        last = self._pending[-1].time if self._pending else self.time
        if command.time < last:
            raise ValueError(f"command: expected a time from {last:g} s on, found {command.time:g}")
        self._pending.append(command)

    def advance(self, time: float) -> VehicleState:
        """Move on to ``time``, s, from one command to the next."""
        while self._pending and self._pending[0].time <= time:
            self._integrate(self._pending[0].time)
            self._acting = self._pending.pop(0)
        self._integrate(time)
        return self.state

    def _integrate(self, time: float) -> None:
        duration = time - self.time
        if duration > 0:
            steps = max(ceil(duration / MAX_STEP_S - 1e-9), 1)
            c = self._acting
            self._state = integrate(self._state, c.steering, c.acceleration, self._vehicle, duration / steps, steps)
        self.time = time


def point_ahead(state: VehicleState, metres: float) -> tuple[float, float]:
    """x and y of a point on the vehicle's axis, ``metres`` before its rear axle."""
    return state.x + metres * np.cos(state.heading), state.y + metres * np.sin(state.heading)
