"""Whether what is found can be the target that was seen before: a vehicle on a road neither leaps nor flies."""

from __future__ import annotations

from math import sqrt

import numpy as np

from paceline.arrays import Array
from paceline.follow.features import Projection
from paceline.follow.motion import CYCLE

UNSTEADY = 0.06  # relative error of a scale that was measured, at most
HASTE, BRAKING = 1.5, 3.0  # m/s, m/s²: by how much the distance may change otherwise than was foreseen
SWAY, DRIFT, TURNING = 0.015, 0.15, 0.15  # rad, m and rad/s² by which it may be aside of where it was foreseen
NODDING = 0.06  # rad by which a bump and the road's grade may turn the camera up or down
RISE = 0.3  # m by which what is measured of a target may lie higher or lower than usual
LASTING, GRADE = 0.3, 0.025  # m and rad by which it may for longer, by the road's grade, say
RATE, LATELY = 0.3, 0.2  # of learning its height, per image: that of now, and of half a second
TILTED = 0.06  # rad, standard deviation of the angle between the camera's axis and the road ahead,
KEPT = 0.999  # of which so much stays from one image to the next
FIRST, WANDERS = 0.1, 0.006  # m, that of the height at one distance, at first and from image to image
ROUGH = 0.06  # rad, that of a bump, were it another in every image
DOUBTS = 2.0  # standard deviations by which the line may be off
SAME = 0.3  # sizes of the target, or relative scale, between two sights of the same

LEAPT = "what is found is farther off or nearer than the target can be by now"
ALOFT = "what is found is higher or lower than the target can be"


def veers(projection: Projection, aside: float, scale: float, tau: float) -> bool:
    """Whether a target of this ``scale`` is farther ``aside``, px, of where it was foreseen ``tau`` cycles after it was
    seen than a vehicle drives and a camera turns: unlike up and down, bumps move little there."""
    time = tau * CYCLE
    angle = SWAY + DRIFT / projection.distance(scale) + TURNING * time * time
    return aside > angle * float(projection.camera.K[0, 0])


def may_move(time: float) -> float:
    """By how many metres a distance may change otherwise than was foreseen, within a ``time``, s."""
    return (HASTE + BRAKING * time) * time


class Level:
    """How far below the camera's axis a target is that stays on the road, by its distance: ``height`` m at the distance
    ``at`` m where it was seen first, and ``tilt`` rad for every metre farther, as nobody says how the camera is tilted.
    A Kalman filter of the two."""

    def __init__(self, drop: float, distance: float) -> None:
        self._at = distance
        self._height, self._tilt = drop, 0.0
        self._hh, self._ht, self._tt = FIRST**2, 0.0, TILTED**2  # their covariance

    def expected(self, distance: float) -> tuple[float, float]:
        """The drop at a ``distance``, m, and its standard deviation."""
        away = distance - self._at
        variance = self._hh + 2.0 * away * self._ht + away * away * self._tt
        return self._height + away * self._tilt, sqrt(variance)

    def learn(self, drop: float, distance: float) -> None:
        """In the next image the target is believed to be ``drop`` m below at a ``distance``, m."""
        self._tilt *= KEPT
        self._hh += WANDERS**2
        self._ht *= KEPT
        self._tt = KEPT**2 * self._tt + (1.0 - KEPT**2) * TILTED**2
        away = distance - self._at
        h, t = self._hh + away * self._ht, self._ht + away * self._tt
        variance = h + away * t + (ROUGH * distance) ** 2
        surprise = drop - self._height - away * self._tilt
        self._height += h / variance * surprise
        self._tilt += t / variance * surprise
        self._hh -= h * h / variance
        self._ht -= h * t / variance
        self._tt -= t * t / variance


class Continuity:
    """Where the target was believed to be, at first at ``location`` (3,), ideal pixels and scale."""

    def __init__(self, projection: Projection, location: Array) -> None:
        self._projection = projection
        self._scale = float(location[2])
        self._drop = self._lately = projection.drop(location)
        self._level = Level(self._drop, projection.distance(self._scale))
        self._sighted = location
        self.steady = True  # the last two sights were of one place, whether believed or not

    def complaint(self, location: Array, expected: Array, unseen: float) -> str:
        """Why nothing that was seen ``unseen`` s ago and is ``expected`` (3,) somewhere can be at ``location`` (3,) in
        the image at hand; to be asked once for each."""
        distance = self._projection.distance(location[2])
        before, foreseen = (self._projection.distance(s) for s in (self._scale, expected[2]))
        moved = min(abs(distance - before), abs(distance - foreseen))
        if moved > UNSTEADY * max(distance, before) + may_move(unseen):
            return LEAPT
        drop = self._projection.drop(location)
        if abs(drop - self._drop) > RISE + NODDING * distance:
            return ALOFT
        self._lately += LATELY * (drop - self._lately)  # also of what is refused, or every other image were believed
        usual, doubt = self._level.expected(distance)
        return ALOFT if abs(self._lately - usual) > LASTING + GRADE * distance + DOUBTS * doubt else ""

    def sight(self, location: Array) -> None:
        """Something like the target is seen at ``location`` (3,)."""
        moved = np.abs(location - self._sighted) / self._projection.sizes(location[2])
        self.steady, self._sighted = bool(moved.max() < SAME), location

    def learn(self, location: Array) -> None:
        """The target is believed to be at ``location`` (3,)."""
        self._scale = float(location[2])
        drop = self._projection.drop(location)
        self._drop += RATE * (drop - self._drop)
        self._level.learn(drop, self._projection.distance(self._scale))
