"""The smooth motion of a plane along its path, as a function of a few parameters.

A :class:`Trajectory` turns them into what the refinement compares with the images: the homographies from the unit
square of the plane's region to both views at every frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.speed.geometry.initial_plane import InitialPlane
from paceline.speed.geometry.paths import Path, level_frames, rolled, rotation_minimising_roll
from paceline.speed.geometry.quadrilaterals_cpu import unit_square_to
from paceline.speed.refinement.path_deviation import Bends, smooth

NAMES = (
    "log_depth",  # of the region's centre at the first frame
    "speed",  # m/s at the first frame
    "acceleration",  # m/s²
    "normal_yaw",  # rad, from the first plane's normal
    "normal_tilt",
    "turn",  # 1/m, a curvature that the path does not have, to the right
)  # and then the amplitudes of bends and swerves, and of surges
INDEX = {name: i for i, name in enumerate(NAMES)}
EXTRAS = ("acceleration", "surge", "turn", "swerve")
STEPS = np.array([1e-5, 1e-4, 1e-4, 1e-5, 1e-5, 1e-6])
AMPLITUDE_STEP = 1e-3

TURNING = 0.03  # 1/m, the curvature of a vehicle that turns
FIRST_SPEED = 30.0  # m/s, acceleration and depth: so wide that only their finiteness matters
HARD_BRAKING = 2.0  # m/s²
SURGING = 2.0, 0.4  # m/s², s: an acceleration that does not stay as it is, and in what time it changes
STEADY = 0.15  # m/s², by which a driver who holds the speed fails to
DEPTH = 0.3


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known without the images: the mean (n,) of all parameters, which are ``free``, and their information."""

    mean: Array
    free: NDArray[np.int64]
    information: Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A plane region ``quad`` (4, 2), outlined in the left view at time 0, carried along ``path``.

    ``plane`` gives the normal; ``times`` (F, 2) are each view's exposures in seconds since the outline. The parameters
    ``theta`` (n,) are those of NAMES, followed by the amplitudes of ``bends`` and of surges: an acceleration that
    changes in the course of the clip, as a smooth random one.
    """

    rig: StereoRig
    quad: Array
    plane: InitialPlane
    path: Path
    times: Array
    bends: Bends

    @cached_property
    def steps(self) -> Array:
        """Steps (n,) at which differences give the parameters' derivatives."""
        return np.concatenate([STEPS, np.full(self._surges + len(self.bends.modes), AMPLITUDE_STEP)])

    def index(self, name: str) -> NDArray[np.int64]:
        """Where the parameters of an extra of the motion stand in ``theta``: one of EXTRAS, or all of the "way"."""
        n = len(self.steps)
        if name == "way":
            return np.arange(len(NAMES), n - self._surges)
        if name == "surge":
            return np.arange(n - self._surges, n)
        if name == "swerve":
            return np.arange(n - self._surges - self.bends.swerves, n - self._surges)
        return np.array([INDEX[name]])

    @cached_property
    def _surging(self) -> CubicSpline:
        """The accelerations (m/s²) of the surges by the time."""
        t = np.linspace(self.times.min() - 0.1, self.times.max() + 0.1, 81)
        return CubicSpline(t, smooth(t, *SURGING).T)

    @property
    def _surges(self) -> int:
        return int(self._surging.c.shape[-1])

    def grown(self, factor: float) -> Trajectory:
        """All that was reconstructed, by cameras ``factor`` times as far apart: no picture shows a difference."""
        return replace(
            self,
            path=self.path.scaled(factor),
            plane=replace(self.plane, centre=factor * self.plane.centre),
            bends=replace(self.bends, u=factor * self.bends.u),
        )

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
        return np.asarray(self._driven @ theta)

    @cached_property
    def _driven(self) -> Array:
        """What each parameter contributes (F, 2, n) to the distance, which is linear in all of them."""
        gained = self._surging.antiderivative()
        driven = gained.antiderivative()
        shares = np.zeros((*self.times.shape, len(self.steps)))
        shares[..., INDEX["speed"]], shares[..., INDEX["acceleration"]] = self.times, 0.5 * self.times**2
        surges = driven(self.times) - driven(0.0) - gained(0.0) * self.times[..., None]
        shares[..., self.index("surge")] = surges
        return shares

    @cached_property
    def speed_shares(self) -> Array:
        """What each parameter contributes (F, n) to the speed at the frames."""
        t = self.times.mean(1)
        gained = self._surging.antiderivative()
        shares = np.zeros((len(t), len(self.steps)))
        shares[:, INDEX["speed"]], shares[:, INDEX["acceleration"]] = 1.0, t
        shares[:, self.index("surge")] = gained(t) - gained(0.0)
        return shares

    @cached_property
    def mean_speed_shares(self) -> Array:
        """What each parameter contributes (n,) to the distance between the first and the last frame, over the time."""
        t = self.times.mean(1)
        driven = self._driven.mean(1)
        return np.asarray((driven[-1] - driven[0]) / (t[-1] - t[0]))

    def motion(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Rigid motions since time 0 by ``theta`` (…, n), rotations (…, F, 2, 3, 3) and translations (…, F, 2, 3); and
        the first n·P = d: n (…, 3) and d (…)."""
        many = theta.reshape(-1, theta.shape[-1])
        shape = theta.shape[:-1]
        start = self._ray * np.exp(many[:, :1])
        depths, which = np.unique(many[:, 0], return_inverse=True)
        s0 = np.array([self.path.nearest(self._ray * np.exp(depth)) for depth in depths])[which]
        travelled = np.tensordot(many, self._driven, (1, 2))
        u = np.linspace(min(travelled.min(), 0.0) - 1.0, max(travelled.max(), 0.0) + 1.0, 97)
        yaw, pitch = self.bends.turns(many[:, len(NAMES) :][:, : len(self.bends.modes)], u)
        yaw = yaw + many[:, INDEX["turn"], None] * u
        F = self.path.frames(s0[:, None] + u)
        T = F[..., 0] + yaw[..., None] * F[..., 1] + pitch[..., None] * F[..., 2]
        tangent = CubicSpline(u, T / np.linalg.norm(T, axis=-1, keepdims=True), axis=1)
        gone = tangent.antiderivative()
        roll = rotation_minimising_roll(level_frames(T))
        first = np.zeros((len(many), 1))
        here = rolled(level_frames(_each(tangent, first)), _each_between(u, roll, first))[:, 0]
        there = rolled(level_frames(_each(tangent, travelled)), _each_between(u, roll, travelled))
        R = there @ np.swapaxes(here, -1, -2)[:, None, None]
        origin = start[:, None, None]
        t = origin + _each(gone, travelled) - _each(gone, first)[:, None] - (R @ origin[..., None])[..., 0]
        turn = turned(self._normal_in_path_frame, many[:, INDEX["normal_yaw"]], many[:, INDEX["normal_tilt"]])
        n = (here @ turn[..., None])[..., 0]
        d = (n * start).sum(-1)
        return R.reshape(*shape, *R.shape[1:]), t.reshape(*shape, *t.shape[1:]), n.reshape(*shape, 3), d.reshape(shape)

    def homographies(self, theta: Array) -> tuple[Array, Array]:
        """By ``theta`` (…, n), H (…, F, 2, 3, 3) from the unit square to both views, and its change per metre of the
        plane's distance d."""
        return self._seen_by(self.rig, *self.motion(theta))

    def by_rigs(self, rigs: list[StereoRig], theta: Array) -> Array:
        """H (Q, F, 2, 3, 3) by ``theta`` (n,) as each of Q ``rigs`` that differ little sees the motion."""
        motion = self.motion(theta)
        return np.array([self._seen_by(rig, *motion)[0] for rig in rigs])

    def _seen_by(self, rig: StereoRig, R: Array, t: Array, n: Array, d: Array) -> tuple[Array, Array]:
        """`homographies` of a motion, as ``rig`` sees it."""
        back = rig.left.K_inv @ self._square
        K = np.stack([rig.left.K, rig.right.K])
        R_view = np.stack([np.eye(3), rig.R])
        t_view = np.stack([np.zeros(3), rig.t])
        H_d = K @ (R_view @ R) @ back
        shift = (R_view @ t[..., None])[..., 0] + t_view
        plane = shift[..., None] * n[..., None, None, None, :]
        return np.asarray(d[..., None, None, None, None] * H_d + K @ plane @ back), H_d

    def quads(self, theta: Array) -> Array:
        """The region in both views at every frame by ``theta`` (…, n), (…, F, 2, 4, 2) px."""
        return corners_of(self.homographies(theta)[0])

    def directions(self, theta: Array) -> Array:
        """Unit vectors (F, 2, 3), in the vehicle's axes, from the region's centre to the cameras, by ``theta`` (n,)."""
        R, t, _, _ = self.motion(theta)
        seen_from = ((self.rig.centres - t)[..., None, :] @ R)[..., 0, :] - self._ray * np.exp(theta[0])
        return np.asarray(seen_from / np.linalg.norm(seen_from, axis=-1, keepdims=True))

    def centres(self, theta: Array) -> Array:
        """World points (F, 3) of the region's centre."""
        R, t, _, _ = self.motion(theta)
        return np.asarray(R[:, 0] @ (self._ray * np.exp(theta[0])) + t[:, 0])


def _each(spline: PPoly, x: Array) -> Array:
    """The values (N, …, 3) of each of N curves, which ``spline`` holds together, at places ``x`` (N, …) of its own."""
    piece, curve = _pieces(spline.x, x)
    from_knot, value = (x - spline.x[piece])[..., None], np.zeros(())
    for coefficient in spline.c:
        value = value * from_knot + coefficient[piece, curve]
    return np.asarray(value)


def _each_between(u: Array, values: Array, x: Array) -> Array:
    """Each of N rows of ``values`` (N, M) over ``u`` (M,), interpolated at places ``x`` (N, …) of its own."""
    piece, row = _pieces(u, x)
    share = (x - u[piece]) / (u[piece + 1] - u[piece])
    return np.asarray((1.0 - share) * values[row, piece] + share * values[row, piece + 1])


def _pieces(u: Array, x: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Between which knots ``u`` places ``x`` (N, …) lie, and which of the N each belongs to."""
    piece = np.clip(np.searchsorted(u, x, "right") - 1, 0, len(u) - 2)
    return piece, np.arange(len(x)).reshape(-1, *(1,) * (x.ndim - 1))


def turned(normal: Array, yaw: Array | float, tilt: Array | float) -> Array:
    """A unit ``normal`` (3,) in path axes T, P, B, turned by ``yaw`` (…) about B and by ``tilt`` (…) about the
    horizontal: (…, 3)."""
    B = np.array([0.0, 0.0, 1.0])
    across = np.cross(B, normal)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    n = normal + np.asarray(yaw)[..., None] * across + np.asarray(tilt)[..., None] * B
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))


def corners_of(H: Array) -> Array:
    """Images (…, 4, 2) of the unit square's corners under ``H`` (…, 3, 3)."""
    square = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    p = square @ np.swapaxes(H, -1, -2)
    return np.asarray(p[..., :2] / p[..., 2:])


def prior(trajectory: Trajectory, speed: float, extras: tuple[str, ...] = ()) -> Prior:
    """What is known before the images: how drivers brake, turn and swerve, how fronts stand, the bends by their making.

    ``speed`` (m/s) is the first guess, on which the prior hardly depends. Of the ``extras``, which are
    of EXTRAS, those that are not named are held to zero, or, an acceleration, to what steady drivers do.
    """
    std = usual_sizes(trajectory)
    for name in EXTRAS:
        if name not in extras:
            std[trajectory.index(name)] = STEADY if name == "acceleration" else 0.0
    mean = np.zeros_like(std)
    mean[:2] = np.log(trajectory.plane.centre[2]), speed
    mean[INDEX["normal_tilt"]] = trajectory.plane.mean_tilt
    free = np.flatnonzero(std > 0)
    return Prior(mean, free, np.diag(1.0 / std[free] ** 2))


def usual_sizes(trajectory: Trajectory) -> Array:
    """Standard deviations (n,) of all parameters where every extra is there."""
    std = np.ones(len(trajectory.steps))
    std[: len(NAMES)] = DEPTH, FIRST_SPEED, HARD_BRAKING, *trajectory.plane.normal_std, TURNING
    return std
