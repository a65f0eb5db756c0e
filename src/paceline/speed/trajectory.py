"""The smooth motion of a plane along its path, as a function of a dozen parameters.

A :class:`Trajectory` turns them into what the refinement compares with the images: the homographies from the unit
square of the plane's region to both views at every frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from paceline.cameras import StereoRig
from paceline.speed.likelihood import unit_square_to
from paceline.speed.paths import Path, level_frames, rolled, rotation_minimising_roll
from paceline.speed.planes import FirstPlane

Array = NDArray[np.float64]

NAMES = (
    "log_depth",  # of the region's centre at the first frame
    "speed",  # m/s at the first frame
    "acceleration",  # m/s²
    "normal_yaw",  # rad, from the first plane's normal
    "normal_tilt",
    "yaw",  # rad, of the travel from the drawn path, to the right
    "curvature",  # 1/m and so on: the further terms of a polynomial in the distance travelled
    "curvature_slope",
    "curvature_bend",
    "pitch",  # rad, downwards
    "pitch_curvature",
    "pitch_slope",
)
INDEX = {name: i for i, name in enumerate(NAMES)}
STEPS = np.array([1e-5, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-6, 1e-7, 1e-8, 1e-5, 1e-6, 1e-7])
YAWS, PITCHES = slice(5, 9), slice(9, 12)

# How a driver departs from the path of the lane, one sigma: heading, curvature (lane keeping), and further terms
DRIVER = np.array([np.radians(1.0), 3e-4, 1e-5, 1e-7, np.radians(0.3), 1e-4, 1e-6])
# Without a path the direction is what the filter found, no better than this; a turn is another model
UNGUIDED = np.array([np.radians(15.0), 3e-4, 0.0, 0.0, np.radians(5.0), 1e-4, 0.0])
TURNING = 0.03  # 1/m, the curvature of a vehicle that turns
FIRST_SPEED = 30.0  # m/s, acceleration and depth: so wide that only their finiteness matters
HARD_BRAKING = 2.0  # m/s²
DEPTH = 0.3


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known without the images: the mean (12,) of all parameters, which are ``free``, and their information."""

    mean: Array
    free: NDArray[np.int64]
    information: Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A plane region ``quad`` (4, 2), outlined in the left view at time 0, carried along ``path``.

    ``plane`` gives the normal; ``times`` (F, 2) are each view's exposures in seconds since the outline.
    """

    rig: StereoRig
    quad: Array
    plane: FirstPlane
    path: Path
    times: Array

    @cached_property
    def _ray(self) -> Array:
        return np.asarray(self.rig.left.rays(self.quad.mean(0)))

    @cached_property
    def _square(self) -> Array:
        return np.asarray(unit_square_to(self.quad[None])[0])

    @cached_property
    def _normal_in_path_frame(self) -> Array:
        start = self.path.nearest(self.plane.centre)
        return np.asarray(self.path.frames(np.array(start)).T @ self.plane.normal)

    def distance(self, theta: Array) -> Array:
        """Distance travelled (F, 2) along the vehicle's own path since time 0, metres."""
        return np.asarray(theta[1] * self.times + 0.5 * theta[2] * self.times**2)

    def motion(self, theta: Array) -> tuple[Array, Array, Array, float]:
        """Rigid motions since time 0, rotations (F, 2, 3, 3) and translations (F, 2, 3); and the first n·P = d."""
        start = self._ray * np.exp(theta[0])
        s0 = self.path.nearest(start)
        travelled = self.distance(theta)
        ends = np.array([min(travelled.min(), 0.0), max(travelled.max(), 0.0)])
        u = np.linspace(ends[0] - 1.0, ends[1] + 1.0, 97)
        yaw, pitch = polynomial(theta[YAWS], u), polynomial(theta[PITCHES], u)
        F = self.path.frames(s0 + u)
        T = F[:, :, 0] + yaw[:, None] * F[:, :, 1] + pitch[:, None] * F[:, :, 2]
        tangent = CubicSpline(u, T / np.linalg.norm(T, axis=1, keepdims=True))
        gone = tangent.antiderivative()
        roll = rotation_minimising_roll(level_frames(T))
        here = rolled(level_frames(np.asarray(tangent(0.0))), np.asarray(np.interp(0.0, u, roll)))
        R = rolled(level_frames(np.asarray(tangent(travelled))), np.interp(travelled, u, roll)) @ here.T
        t = start + gone(travelled) - gone(0.0) - R @ start
        n = here @ turned(self._normal_in_path_frame, theta[3], theta[4])
        return R, t, n, float(n @ start)

    def homographies(self, theta: Array) -> tuple[Array, Array]:
        """H (F, 2, 3, 3) from the unit square to both views, and its change per metre of the plane's distance d."""
        R, t, n, d = self.motion(theta)
        rig = self.rig
        back = rig.left.K_inv @ self._square
        K = np.stack([rig.left.K, rig.right.K])
        R_view = np.stack([np.eye(3), rig.R])
        t_view = np.stack([np.zeros(3), rig.t])
        H_d = K @ (R_view @ R) @ back
        shift = (R_view @ t[..., None])[..., 0] + t_view
        return np.asarray(d * H_d + K @ (shift[..., None] * n) @ back), H_d

    def quads(self, theta: Array) -> Array:
        """The region in both views at every frame, (F, 2, 4, 2) px."""
        return corners_of(self.homographies(theta)[0])

    def centres(self, theta: Array) -> Array:
        """World points (F, 3) of the region's centre."""
        R, t, _, _ = self.motion(theta)
        return np.asarray(R[:, 0] @ (self._ray * np.exp(theta[0])) + t[:, 0])


def polynomial(coefficients: Array, u: Array) -> Array:
    """c₀ + c₁ u + c₂ u²/2 + c₃ u³/6 at ``u`` (N,)."""
    powers = np.stack([np.ones_like(u), u, u**2 / 2, u**3 / 6])
    return np.asarray(coefficients @ powers[: len(coefficients)])


def turned(normal: Array, yaw: float, tilt: float) -> Array:
    """A unit ``normal`` (3,) in path axes T, P, B, turned by ``yaw`` about B and by ``tilt`` about the horizontal."""
    B = np.array([0.0, 0.0, 1.0])
    across = np.cross(B, normal)
    n = normal + yaw * across / max(float(np.linalg.norm(across)), 1e-9) + tilt * B
    return np.asarray(n / np.linalg.norm(n))


def corners_of(H: Array) -> Array:
    """Images (…, 4, 2) of the unit square's corners under ``H`` (…, 3, 3)."""
    square = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    p = square @ np.swapaxes(H, -1, -2)
    return np.asarray(p[..., :2] / p[..., 2:])


def prior(trajectory: Trajectory, speed: float, on_path: bool, accelerating: bool, turning: bool = False) -> Prior:
    """What is known before the images: the path's reconstruction, how drivers keep to it, how fronts stand.

    ``speed`` (m/s) is the first guess, on which the prior hardly depends.
    """
    path, plane = trajectory.path, trajectory.plane
    mean = np.zeros(len(NAMES))
    mean[:2] = np.log(plane.centre[2]), speed
    variance = np.zeros((len(NAMES),) * 2)
    variance[range(5), range(5)] = (
        np.array([DEPTH, FIRST_SPEED, HARD_BRAKING if accelerating else 0.0, *plane.normal_std]) ** 2
    )
    heading = np.diag((DRIVER if on_path else UNGUIDED) ** 2)
    if on_path:
        heading += _heading_covariance(trajectory, speed)
    if turning:
        heading[1, 1] += TURNING**2
    terms = np.arange(7) if path.shape == "curve" else np.array([0, 1, 4, 5])
    index = 5 + terms
    variance[np.ix_(index, index)] = heading[np.ix_(terms, terms)]
    free = np.flatnonzero(np.diag(variance) > 0)
    return Prior(mean, free, np.asarray(np.linalg.inv(variance[np.ix_(free, free)]), float))


def _heading_covariance(trajectory: Trajectory, speed: float) -> Array:
    """Covariance (7, 7) of the heading's polynomial terms from the modes of the path's reconstruction."""
    path = trajectory.path
    length = max(abs(speed) * float(np.ptp(trajectory.times)), 5.0)
    u = np.linspace(0.0, length, 25)
    yaw, pitch = path.heading_modes(path.nearest(trajectory.plane.centre) + u)
    orders = (4, 3) if path.shape == "curve" else (1, 1)
    terms = np.zeros((len(yaw), 7))
    for modes, order, first in ((yaw, orders[0], 0), (pitch, orders[1], 4)):
        powers = np.stack([np.ones_like(u), u, u**2 / 2, u**3 / 6])[:order]
        terms[:, first : first + order] = np.linalg.lstsq(powers.T, modes.T)[0].T
    return np.asarray(terms.T @ terms)
